"""Rule `cube`: every image of the campaign on one grid, sums over each flight's pairs, and interferometric phases."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from pyproj import CRS
from rasterio.warp import transform_bounds

from apertura import __version__
from apertura.campaign.config import FUSED
from apertura.campaign.digests import Lineage
from apertura.campaign.folder import Campaign
from apertura.campaign.store import (
    attributes_of,
    create,
    describe_stage,
    finish,
    open_array,
    open_stage,
    replacing,
)
from apertura.common.confined import ConfinedPath
from apertura.common.contracts import MEASURED, QUOTED, RASTERS, SUMMED, Window
from apertura.common.documents import undamaged
from apertura.common.leap_seconds import GPS_EPOCH
from apertura.common.provenance import canonical_json, sha256_file, sha256_text
from apertura.core.combination import clutter_reduction_db, coherent_sum, magnitude_sum, noncoherent_sum
from apertura.core.quality.focus import focus_with_flags
from apertura.core.quality.measures import BlockRaster, held, image_statistics
from apertura.core.scene.grid import SceneGrid
from apertura.methods.interferometry.coherence import chance, coherence, common_band, window_px
from apertura.stages.agreement import assessment_of
from apertura.stages.scene import settled_scene
from apertura.stages.tags import stamped
from apertura.workflow.lineage import result_of

# ---- Coordinates and quality of each flight and pair ----------------------------------------------------------------

Images = Mapping[tuple[str, str], xr.Dataset]
"""Flight and pair → stage `image`, of which only the attributes are needed."""

_TEXTS = np.dtypes.StringDType()


Sums = Mapping[str, Mapping[str, Any]]
"""Flight with several pairs → its coherent sum, as chosen by step `assess`."""


def labels(images: Images, assessed: Mapping[str, Mapping[str, Any]], sums: Sums, pairs: Sequence[str]) -> xr.Dataset:
    """Return the coordinates flight, pair, time, reference pair and reference flight, and the values of every image.

    Parameters
    ----------
    images
        Images that were formed.
    assessed
        Flight → its assessment by step `assess`.
    sums
        Coherent sums of the flights with several pairs.
    pairs
        Every pair of the campaign.
    """
    shape = len(assessed), len(pairs)
    values: dict[str, Any] = {
        name: np.full(shape, "", _TEXTS) if dtype == "T" else np.full(shape, np.nan)
        for name, (_, dtype, _, _) in QUOTED.items()
    }
    for row, (flight, assessment) in enumerate(assessed.items()):
        for pair in pairs:
            if (flight, pair) in images:
                measures = _quoted_values(images[flight, pair], assessment["pairs"][pair])
                measures["phase_removed"] = sums[flight]["phases_rad"].get(pair) if flight in sums else None
                for name, value in measures.items():
                    if value is not None:
                        values[name][row, pairs.index(pair)] = value
    return xr.Dataset(
        {
            name: (QUOTED[name][0], array, {"coverage_content_type": "auxiliaryInformation"})
            for name, array in values.items()
        },
        coords={
            "flight": ("flight", np.array([*assessed], _TEXTS)),
            "pair": ("pair", np.array(pairs, _TEXTS)),
            "time": (
                "flight",
                np.array([_middle_time(images, flight) for flight in assessed]),
                {"standard_name": "time"},
            ),
            "reference_pair": ("flight", np.array([flight["reference"] for flight in assessed.values()], _TEXTS)),
            "reference_flight": ("pair", np.array([*reference_flights(images, pairs).values()], _TEXTS)),
        },
    )


def reference_flights(images: Images, pairs: Sequence[str]) -> dict[str, str]:
    """Return pair → the first flight with an image of that pair."""
    return {pair: next(flight for flight, other in images if other == pair) for pair in pairs}


def _middle_time(images: Images, flight: str) -> Any:
    """Return the mid-time of the pulses of all pairs of a flight, UTC."""
    views = [image.attrs["quality"]["view"] for (name, _), image in images.items() if name == flight]
    ends = np.array([view[end] for view in views for end in ("first_utc", "last_utc")], "datetime64[ns]")
    return ends.min() + (ends.max() - ends.min()) // 2


def _quoted_values(image: xr.Dataset, assessed: Mapping[str, Any]) -> dict[str, float | str | None]:
    """Return the quality of an image and its assessment: name of a row of `QUOTED` → value or None."""
    quality = image.attrs["quality"]
    # images from phase histories have no pulse counts
    view, focus, pulses = quality["view"], quality["focus"], quality.get("pulses", {})
    flags = {*image.attrs["flags"], *assessed["flags"]}
    return {
        "heading": view["heading_deg"],
        "look_direction": view["look_deg"],
        "incidence": view["incidence_deg"],
        "bistatic_angle": view["bistatic_angle_deg"],
        "range": view["range_m"],
        "height": view["height_m"],
        "centre_frequency": view["centre_hz"],
        "bandwidth": view["band_hz"],
        "resolution_cell": focus["cell_m"],
        "loss": focus.get("loss_db"),
        "numerical_error": quality["numerical_error_db"],
        "entropy": quality["entropy"],
        "noise_floor": quality["noise_floor_db"],
        "pulses_used": pulses.get("used"),
        "pulses_dropped": pulses.get("dropped"),
        "peak": quality["brightest"]["amplitude"],
        "verdict": focus_with_flags(focus, flags, error_db=quality["numerical_error_db"])["verdict"],
        "flags": ",".join(sorted(flags)),
    }


# ---- Coherence and phase between the images of a cube ---------------------------------------------------------------

_TILES_AT_ONCE = 4
"""Number of tiles along each side of a block that is read at once, so that tiles share the margins of their windows."""

Compared = Mapping[str, Mapping[tuple[str, str], tuple[str, str]]]
"""'pair' or 'flight' → flight and pair of an image → flight and pair of its reference image."""


def compared(images: Images, references: Mapping[str, str], first_flights: Mapping[str, str]) -> Compared:
    """Return the images to compare: each with its flight's reference pair, and with its pair in the reference flight.

    Parameters
    ----------
    images
        Images that were formed.
    references
        Flight → its reference pair.
    first_flights
        Pair → its reference flight.
    """
    partners = {
        "pair": {(flight, pair): (flight, references[flight]) for flight, pair in images},
        "flight": {(flight, pair): (first_flights[pair], pair) for flight, pair in images},
    }
    return {kind: {one: other for one, other in rows.items() if one != other} for kind, rows in partners.items()}


def window_of(images: Sequence[xr.Dataset], spacing_m: float) -> int:
    """Return the side of the coherence window, which contains at least 16 looks of both images, in pixels."""
    return max(window_px(_spectrum(image), spacing_m) for image in images)


def shared_band(one: xr.Dataset, other: xr.Dataset) -> float:
    """Return the coherence of unchanged terrain, docs/theory/interferometry.md, eq. 1a."""
    carriers = tuple(np.array(image.attrs["quality"]["view"]["carrier_cycles_m"]) for image in (one, other))
    return common_band((carriers[0], carriers[1]), (_spectrum(one), _spectrum(other)))


def write_phase(
    images: tuple[BlockRaster, BlockRaster],
    arrays: tuple[Any, Any],
    grid: SceneGrid,
    *,
    side: int,
    window: int,
    workers: Executor,
) -> tuple[float, float]:
    """Write coherence and phase of two images tile by tile; return looks and coherence bias of unrelated images.

    Parameters
    ----------
    images
        An image and its reference image.
    arrays
        Arrays of coherence and phase, (y, x) float32; tiles missing in one of the images are not written.
    grid
        Grid of the images and arrays.
    side, window
        Sides of a tile and of the coherence window, pixels.
    workers
        Threads that measure tiles; their number does not affect the result.

    Returns
    -------
    tuple
        Looks and coherence bias; NaN for images without a common tile.
    """
    inverse_looks: list[float] = []
    for block in grid.tiles(_TILES_AT_ONCE * side):
        with_margin = _widened(block, window // 2, grid.shape)
        first, second = (np.asarray(image[with_margin]) for image in images)

        def measured(
            tile: Window, with_margin: Window = with_margin, first: Any = first, second: Any = second
        ) -> float | None:
            around = _widened(tile, window // 2, grid.shape)
            part, middle = _relative_to(around, with_margin), _relative_to(tile, around)
            if not (np.isfinite(first[part]) & np.isfinite(second[part])).any():
                return None
            magnitude, phase, looks = coherence(first[part], second[part], window=window)
            if not np.isfinite(magnitude[middle]).any():
                return None
            for array, values in zip(arrays, (magnitude, phase), strict=True):
                array[tile] = values[middle]
            return 1 / looks

        tiles = workers.map(measured, _subwindows(grid, block, side))
        inverse_looks += [value for value in tiles if value is not None]
    looks = 1 / float(np.mean(inverse_looks)) if inverse_looks else float("nan")
    return looks, chance(looks) if inverse_looks else looks


def _spectrum(image: xr.Dataset) -> Any:
    return np.array(image.attrs["quality"]["focus"]["spectrum_cycles2_m2"])


def _subwindows(grid: SceneGrid, block: Window, side: int) -> Iterator[Window]:
    for rows, columns in grid[block].tiles(side):
        top, left = block[0].start, block[1].start
        yield slice(rows.start + top, rows.stop + top), slice(columns.start + left, columns.stop + left)


def _widened(window: Window, by: int, shape: tuple[int, int]) -> Window:
    rows, columns = (
        slice(max(0, part.start - by), min(size, part.stop + by)) for part, size in zip(window, shape, strict=True)
    )
    return rows, columns


def _relative_to(window: Window, whole: Window) -> Window:
    """Return a window with indices relative to the first pixel of another window."""
    rows, columns = (slice(part.start - of.start, part.stop - of.start) for part, of in zip(window, whole, strict=True))
    return rows, columns


# ---- Rule `cube`: all images, sums of each flight, phases between images --------------------------------------------

_PHASE = "coherence", "phase"

_LEVEL = "overviews/{}"
"""Group of an overview, by the ratio of its pixel spacing to that of the images."""

_CHUNKED = {**RASTERS, "power": RASTERS["image"]}
"""Rasters of the cube and of its overviews."""

_FLIGHTS_PER_CHUNK = 256
"""Length of the chunks of coordinates and measures along `flight`.

The length does not depend on the number of flights, so that readers with the earlier metadata can read chunks to which
a flight was added.
"""


def cube(campaign: Campaign, *, threads: int = 1) -> Path:
    """Write results/cube.zarr: images (flight, pair, y, x), sums of each flight, coherence and phase between images.

    The cube has sums if any flight has two or more pairs; the sums are NaN for flights with a single pair. Tiles that
    no pulse of a pair illuminates are not stored and are read as NaN, as in the image.

    Chunks contain values of one flight, which depend on this flight and on its reference images only (see `_origins`).
    Chunks of flights that have not changed since the cube was last written are not computed again: they remain where
    they are if further flights follow them, and are linked into a new folder otherwise.
    """
    flights, lineage = campaign.image_flights, result_of(campaign, "cube").begin(campaign.root)
    images = {
        (flight.name, pair): describe_stage(campaign.stage("image", flight.name, pair))
        for flight in flights
        for pair in flight.pairs
    }

    @cache
    def opened(flight: str, pair: str) -> xr.Dataset:
        return open_stage(campaign.stage("image", flight, pair), "image")

    assessed = {flight.name: assessment_of(campaign, flight.name) for flight in flights}
    sums = {flight.name: assessed[flight.name]["fusion"] for flight in flights if FUSED in flight.images}
    grid, side = settled_scene(campaign).grid, campaign.settings.processing.tile_px
    folder, windows = campaign.stage("cube"), list(grid.tiles(side))
    with undamaged(folder, expected="images formed by this version", remedy="Run the workflow again."):
        template = _empty_cube(campaign, images, assessed, sums, grid)
    template.attrs["origins"] = _origins(campaign, images, lineage)
    with replacing(folder) as (wip, recorded), ThreadPoolExecutor(threads) as workers:
        empty = stamped(
            template,
            "cube",
            modules=lineage.modules,
            parents={"/".join(name): image for name, image in images.items()},
            settings={"fusion": sums},
        )
        tile = {"y": side, "x": side, "flight": 1, "pair": 1}
        chunks = {name: tuple(tile[dim] for dim in dims) for name, (dims, *_) in RASTERS.items() if name in empty}
        measured = {name: empty[name].values.copy() for name in MEASURED if name in empty}
        whole = {name: (_FLIGHTS_PER_CHUNK, *values.shape[1:]) for name, values in measured.items()}
        levels = overview_grids(grid, side)
        groups = {_LEVEL.format(factor): _empty_level(empty, level, tile) for factor, level in levels.items()}
        create(wip, empty, chunks | whole, lengths={"flight": _FLIGHTS_PER_CHUNK}, groups=groups, consolidated=True)
        chunks |= {f"{group}/{name}": shape for group, (_, shapes) in groups.items() for name, shape in shapes.items()}
        earlier = _EarlierCube.of(folder, recorded)
        kept = earlier.kept(empty.attrs["origins"])
        appended = earlier.is_continued(empty, kept, chunks)
        known = earlier.carry(kept, empty, measured, chunks, None if appended else wip)
        rasters = {name: open_array(wip, name) for name in chunks}
        arrays = _CubeArrays({**rasters, **measured}, [*assessed], empty.attrs["pairs"])
        changed = [flight for flight in assessed if flight not in kept]
        for flight in changed:
            present = {pair: opened(flight, pair) for pair in campaign.flight(flight).pairs}
            _write_images(present, sums.get(flight), arrays, flight, windows, workers)
            for pair in present:
                planes = [arrays.plane(f"{group}/power", flight, pair) for group in groups]
                _write_overviews(arrays.plane("image", flight, pair), planes, levels.values(), side, workers)
            if flight in sums:
                planes = [arrays.plane(f"{group}/noncoherent", flight) for group in groups]
                _write_overviews(arrays.plane("noncoherent", flight), planes, levels.values(), side, workers)
        for flight, fusion in sums.items():
            if flight in changed:
                single_db = [images[flight, pair].attrs["quality"]["noise_floor_db"] for pair in fusion["phases_rad"]]
                sum_db = image_statistics(arrays.plane("coherent", flight), windows).noise_floor_db
                arrays.plane("coherent_noise_floor", flight)[()] = sum_db
                arrays.plane("clutter_reduction", flight)[()] = clutter_reduction_db(single_db, sum_db)
        references = {flight: assessment["reference"] for flight, assessment in assessed.items()}
        _compare(images, opened, references, arrays, grid, changed, side=side, workers=workers)
        for name, values in measured.items():
            open_array(wip, name)[...] = values
        finish(wip, folder, lineage=lineage, known=known, appended=appended)
    return folder


def _origins(campaign: Campaign, images: Images, lineage: Lineage) -> dict[str, str]:
    """Return flight → hash of everything on which the chunks of the flight depend.

    These are the code, the tile size, the grid, the images and the assessment of the flight, and the images of its
    pairs in their reference flights. A further flight changes the origin of no other flight.
    """
    digests, settings = lineage.sources.digests, campaign.settings.processing.tile_px
    shared = [lineage.result.code_sha256, settings, digests[campaign.manifest("scene")]]
    pairs, origins = sorted({pair for _, pair in images}), dict[str, str]()
    references = reference_flights(images, pairs)
    for flight in campaign.image_flights:
        own = [
            campaign.manifest("image", name, pair) for pair in flight.pairs for name in (flight.name, references[pair])
        ]
        named = {name: digests[name] for name in (*own, campaign.manifest("assessment", flight.name))}
        origins[flight.name] = sha256_text(canonical_json([*shared, named]))
    return origins


@dataclass(frozen=True)
class _EarlierCube:
    """Cube that was written before, whose chunks of unchanged flights are kept.

    Attributes
    ----------
    folder
        Its folder.
    recorded
        File → SHA-256; empty if there is no such cube.
    attributes
        Its attributes.
    """

    folder: ConfinedPath
    recorded: Mapping[str, str]
    attributes: Mapping[str, Any]

    @classmethod
    def of(cls, folder: ConfinedPath, recorded: Mapping[str, str]) -> "_EarlierCube":
        """Return the cube in a folder; `recorded` as yielded by `replacing`."""
        attributes = attributes_of(folder) if recorded else {}
        return cls(folder, recorded, {"origins": {}, "flights": [], "pairs": []} | attributes)

    @property
    def _chunks(self) -> Iterator[tuple[str, int, str]]:
        """Chunks of rasters: file, row along `flight`, SHA-256."""
        for name, digest in self.recorded.items():
            array, _, place = name.partition("/c/")
            if place and array.rpartition("/")[2] in _CHUNKED:
                yield name, int(place.split("/")[0]), digest

    def kept(self, origins: Mapping[str, str]) -> set[str]:
        """Return the unchanged flights; if all are unchanged, flights with damaged chunks count as changed."""
        earlier, flights = self.attributes["origins"], self.attributes["flights"]
        kept = {flight for flight in origins if origins[flight] == earlier.get(flight)}
        if kept == origins.keys():
            kept -= {flights[row] for name, row, digest in self._chunks if sha256_file(self.folder / name) != digest}
        return kept

    def is_continued(self, empty: xr.Dataset, kept: Collection[str], chunked: Collection[str]) -> bool:
        """Return True if all flights are kept, and further flights follow them; `chunked` as in `carry`."""
        flights = self.attributes["flights"]
        arrays = {name.removesuffix("/zarr.json") for name in self.recorded if name.endswith("/zarr.json")}
        return (
            bool(flights)
            and set(flights) == {*kept}
            and empty.attrs["flights"][: len(flights)] == flights
            and empty.attrs["pairs"] == self.attributes["pairs"]
            and {*empty.variables} | {*chunked} <= arrays
            and {name for name in arrays if name.rpartition("/")[2] in _CHUNKED} == {*chunked}
        )

    def carry(
        self,
        kept: Collection[str],
        empty: xr.Dataset,
        measured: Mapping[str, Any],
        chunked: Collection[str],
        wip: ConfinedPath | None,
    ) -> dict[str, str]:
        """Copy the measures of kept flights to `measured`, and link their chunks to a new cube.

        Without `wip`, the chunks remain in their place. `chunked` contains the rasters of the new cube. Return the
        files of these chunks in the new cube and their hashes.
        """
        flights, pairs, carried = self.attributes["flights"], self.attributes["pairs"], dict[str, str]()
        rows = {flights.index(flight): empty.attrs["flights"].index(flight) for flight in kept}
        columns = {
            at: empty.attrs["pairs"].index(pair) for at, pair in enumerate(pairs) if pair in empty.attrs["pairs"]
        }
        for name, row, digest in self._chunks:
            array, _, place = name.partition("/c/")
            _, *rest = place.split("/")
            if row in rows and array in chunked:
                if "pair" in _CHUNKED[array.rpartition("/")[2]][0]:
                    rest[0] = str(columns[int(rest[0])])
                new = "/".join([array, "c", str(rows[row]), *rest])
                carried[new] = digest
                if wip is not None:
                    (self.folder / name).link_or_copy_to(wip / new)
        for name, values in measured.items():
            if rows and f"{name}/zarr.json" in self.recorded:
                old = open_array(self.folder, name, "r")[...]
                for row, new_row in rows.items():
                    if values.ndim == 1:
                        values[new_row] = old[row]
                    else:
                        values[new_row, [*columns.values()]] = old[row, [*columns]]
        return carried


@dataclass(frozen=True)
class _Plane:
    """Plane of an array for one flight, or for one pair of a flight."""

    array: Any
    indices: tuple[int, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the plane."""
        shape: tuple[int, ...] = self.array.shape[len(self.indices) :]
        return shape

    def __getitem__(self, window: Window) -> Any:
        return self.array[(*self.indices, *window)]

    def __setitem__(self, window: Window | tuple[()], values: Any) -> None:
        self.array[(*self.indices, *window)] = values


@dataclass(frozen=True)
class _CubeArrays:
    """Arrays of the cube, by name, flight and pair."""

    arrays: Mapping[str, Any]
    flights: Sequence[str]
    pairs: Sequence[str]

    def plane(self, name: str, flight: str, pair: str | None = None) -> _Plane:
        """Return a plane of an array, which is read and written by windows."""
        indices = (self.flights.index(flight), *([] if pair is None else [self.pairs.index(pair)]))
        return _Plane(self.arrays[name], indices)


def _write_images(
    present: Mapping[str, xr.Dataset],
    fusion: Mapping[str, Any] | None,
    arrays: _CubeArrays,
    flight: str,
    windows: list[Window],
    workers: Executor,
) -> None:
    """Copy the images of a flight and write their sums, tile by tile; `fusion` is None if the flight has no sums."""
    copies = [arrays.plane("image", flight, pair) for pair in present]
    phases_rad = {} if fusion is None else fusion["phases_rad"]
    peaks = np.array([image.attrs["quality"]["brightest"]["amplitude"] for image in present.values()])
    added = np.array([pair in phases_rad for pair in present])
    removed_rad = np.array([phases_rad[pair] for pair in present if pair in phases_rad])
    sum_names = () if fusion is None else ("coherent", "noncoherent", "magnitude")
    sums = {name: arrays.plane(name, flight) for name in sum_names}

    def write(window: Window) -> None:
        stack = np.stack([image.image[window].values for image in present.values()])
        illuminated = ~np.isnan(stack).all(axis=(1, 2))
        for copy, block in zip(compress(copies, illuminated), stack[illuminated], strict=True):
            copy[window] = block
        if sums and illuminated[added].any():
            sums["coherent"][window] = coherent_sum(stack[added], peaks[added], removed_rad)
        if sums and illuminated.any():
            sums["noncoherent"][window] = noncoherent_sum(stack, peaks)
            sums["magnitude"][window] = magnitude_sum(stack, peaks)

    for _ in workers.map(write, windows):
        pass


def overview_grids(grid: SceneGrid, side: int) -> dict[int, SceneGrid]:
    """Return the grids of the overviews, by the ratio of pixel spacings.

    The coarsest overview fits into a tile of `side` pixels.

    Examples
    --------
    >>> grids = overview_grids(SceneGrid("local", 0.0, 0.0, 0.5, (600, 401)), 256)
    >>> {factor: (level.shape, level.spacing_m) for factor, level in grids.items()}
    {2: ((300, 201), 1.0), 4: ((150, 101), 2.0)}
    """
    (step, _, west, _, _, north), grids, factor = grid.transform, dict[int, SceneGrid](), 1
    while max(grid.shape) > side * factor:
        factor *= 2
        rows, columns = (-(-size // factor) for size in grid.shape)
        grids[factor] = SceneGrid(grid.crs, west, north, step * factor, (rows, columns), name=grid.name)
    return grids


def _empty_level(
    empty: xr.Dataset, grid: SceneGrid, tile: Mapping[str, int]
) -> tuple[xr.Dataset, dict[str, tuple[int, ...]]]:
    """Return an overview of the cube without values, and the chunks of its rasters."""
    level = empty[["flight", "pair"]].assign_coords(grid.coordinates).assign_attrs(convention_attributes(grid))
    sizes = {**empty.sizes, "y": grid.shape[0], "x": grid.shape[1]}
    rows = {"power": (RASTERS["image"][0], "mean power of the pixels of `image`")}
    if "noncoherent" in empty:
        rows["noncoherent"] = RASTERS["noncoherent"][0], "mean of the pixels of `noncoherent`"
    for name, (dims, meaning) in rows.items():
        nan = np.broadcast_to(np.float32(np.nan), tuple(sizes[dim] for dim in dims))
        level[name] = dims, nan, {"units": "1", "long_name": meaning, "coverage_content_type": "image"}
    return level, {name: tuple(tile[dim] for dim in dims) for name, (dims, _) in rows.items()}


def _write_overviews(
    source: _Plane, targets: Sequence[_Plane], grids: Iterable[SceneGrid], side: int, workers: Executor
) -> None:
    """Write the overviews of an image or a power, each from the next finer one: means of 2 × 2 pixels, without NaN."""
    for target, grid in zip(targets, grids, strict=True):

        def write(window: Window, source: _Plane = source, target: _Plane = target) -> None:
            values = source[tuple(slice(2 * part.start, 2 * part.stop) for part in window)]  # type: ignore[index]
            power = np.abs(values) ** 2 if np.iscomplexobj(values) else values
            rows, columns = power.shape
            padded = np.pad(power, ((0, rows % 2), (0, columns % 2)), constant_values=np.nan)
            blocks = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
            count = np.isfinite(blocks).sum(axis=(1, 3))
            if count.any():
                total = np.nansum(blocks, axis=(1, 3), dtype=np.float64)
                target[window] = np.where(count, total / np.maximum(count, 1), np.nan).astype(np.float32)

        for _ in workers.map(write, grid.tiles(side)):
            pass
        source = target


def _compare(
    images: Images,
    opened: Callable[[str, str], xr.Dataset],
    references: Mapping[str, str],
    arrays: _CubeArrays,
    grid: SceneGrid,
    changed: Collection[str],
    *,
    side: int,
    workers: Executor,
) -> None:
    """Write coherence and phase of each image of the changed flights relative to its reference images."""
    for kind, partners in compared(images, references, reference_flights(images, arrays.pairs)).items():
        rows = {image: reference for image, reference in partners.items() if image[0] in changed}
        for reference in dict.fromkeys(rows.values()):
            reference_raster = held(opened(*reference).image)
            for name in (image for image, partner in rows.items() if partner == reference):
                window = window_of([images[name], images[reference]], grid.spacing_m)
                planes = [arrays.plane(f"{kind}_{measure}", *name) for measure in _PHASE]
                rasters, outputs = (held(opened(*name).image), reference_raster), (planes[0], planes[1])
                measures = write_phase(rasters, outputs, grid, side=side, window=window, workers=workers)
                shared = shared_band(images[name], images[reference])
                values = (window, *measures, shared)
                for measure, value in zip(("window", "looks", "chance", "common_band"), values, strict=True):
                    arrays.plane(f"{kind}_{measure}", *name)[()] = value


def _empty_cube(
    campaign: Campaign,
    images: Images,
    assessed: Mapping[str, Mapping[str, Any]],
    sums: Sums,
    grid: SceneGrid,
) -> xr.Dataset:
    """Return the cube with its coordinates and labels; rasters and measures computed from them are NaN."""
    pairs = sorted({pair for _, pair in images})
    empty = labels(images, assessed, sums, pairs)
    sizes = {**empty.sizes, "y": grid.shape[0], "x": grid.shape[1]}
    for name, (dims, dtype, _, _) in {**RASTERS, **MEASURED}.items():
        if name in SUMMED and not sums:
            continue
        nan = np.full((), complex(np.nan, np.nan) if dtype == "complex64" else np.nan, dtype)
        content = {"coverage_content_type": "image" if name in RASTERS else "qualityInformation"}
        empty[name] = dims, np.broadcast_to(nan, tuple(sizes[dim] for dim in dims)), content
    return empty.assign_coords(grid.coordinates).assign_attrs(
        Conventions="CF-1.11, ACDD-1.3",
        **acdd_attributes(campaign, [image.attrs["quality"]["view"] for image in images.values()], grid),
        **convention_attributes(grid, campaign.settings.processing.tile_px),
        history="written by rule cube of apertura; runspec, inputs and code_sha256 state settings, data and code",
        flights=[*assessed],
        pairs=pairs,
        fusion=sums,
        agreement={
            "reference": campaign.image_flights[0].name,
            "flights": {
                name: one["first_flight"]["agreement"] for name, one in assessed.items() if one["first_flight"]
            },
        },
        flags={name: flags for name, one in assessed.items() if (flags := one["first_flight"].get("flags"))},
    )


_CONVENTIONS = {
    "spatial": ("689b58e2-cf7b-45e0-9fff-9cfc0883d6b4", "Spatial coordinate information"),
    "proj": ("f17cb550-5864-4468-aeb7-f3180cfb622f", "Coordinate reference system information for geospatial data"),
    "multiscales": ("d35379db-88df-4056-af3a-620245f8e347", "Multiscale layout of zarr datasets"),
}
"""Convention of https://github.com/zarr-conventions, version 0.1 → UUID and description."""


def convention_attributes(grid: SceneGrid, side: int | None = None) -> dict[str, Any]:
    """Return the attributes of the Zarr conventions `spatial` and `proj`; a local frame has no registered CRS.

    For a group with overviews, `side` is the side of a tile in pixels, and the attributes include the convention
    `multiscales`.

    Examples
    --------
    >>> attributes = convention_attributes(SceneGrid("EPSG:32632", 570000.0, 5363000.0, 0.5, (40, 60)))
    >>> attributes["spatial:bbox"], attributes["proj:code"]
    ([570000.0, 5362980.0, 570030.0, 5363000.0], 'EPSG:32632')
    """
    crs = {} if grid.frame == "local" else {"proj:code": grid.crs, "proj:wkt2": CRS(grid.crs_wkt).to_wkt()}
    levels = {} if side is None else overview_grids(grid, side)
    layout = [{"asset": "image", **_placed(grid)}]
    for factor, level in levels.items():
        derived = {"derived_from": layout[-1]["asset"], "transform": {"scale": [1.0, 1.0, 2.0, 2.0]}}
        layout.append({"asset": f"{_LEVEL.format(factor)}/power", **derived, **_placed(level)})
    names = ["spatial", *(["proj"] if crs else []), *(["multiscales"] if levels else [])]
    return {
        "zarr_conventions": [
            {
                "schema_url": f"https://raw.githubusercontent.com/zarr-conventions/{name}/refs/tags/v0.1/schema.json",
                "spec_url": f"https://github.com/zarr-conventions/{name}/blob/v0.1/README.md",
                "uuid": _CONVENTIONS[name][0],
                "name": name,
                "description": _CONVENTIONS[name][1],
            }
            for name in names
        ],
        "spatial:dimensions": ["y", "x"],
        "spatial:bbox": [float(side) for side in grid.bounds_m],
        "spatial:registration": "pixel",
        **_placed(grid),
        **crs,
        **({"multiscales": {"layout": layout, "resampling_method": "average"}} if levels else {}),
    }


def _placed(grid: SceneGrid) -> dict[str, Any]:
    return {"spatial:shape": [*grid.shape], "spatial:transform": [float(value) for value in grid.transform]}


def acdd_attributes(campaign: Campaign, views: Sequence[Mapping[str, Any]], grid: SceneGrid) -> dict[str, str | float]:
    """Return the global attributes of the cube according to the Attribute Convention for Data Discovery, ACDD-1.3.

    Attributes that require wall-clock time (date_created) are omitted, because identical inputs give identical cubes.

    Parameters
    ----------
    campaign
        Campaign of the images.
    views
        `apertura.core.imaging.view.view_report` of every image.
    grid
        Grid of the images; without a geodetic position, there are no geospatial attributes.
    """
    stated, name = campaign.settings.metadata, campaign.settings.campaign
    first, last = min(view["first_utc"] for view in views), max(view["last_utc"] for view in views)
    has_clock = np.datetime64(first) >= GPS_EPOCH  # times of a recording without a clock start in 1970
    duration_s = (np.datetime64(last) - np.datetime64(first)) / np.timedelta64(1, "s")
    people = stated.creators
    urls = [f"https://orcid.org/{person.orcid}" for person in people if person.orcid]
    attributes: dict[str, str | float | None] = {
        "title": stated.title or f"SAR images of campaign {name}",
        "summary": f"Complex SAR images of campaign {name}, formed by time-domain backprojection of UAV-borne radar "
        "recordings: every flight and pair of transmitter and receiver on one grid, sums of the pairs, and coherence "
        "and phase between images.",
        "keywords": "SYNTHETIC APERTURE RADAR, BACKPROJECTION, UAV, RADAR BACKSCATTER, INTERFEROMETRY",
        "project": name,
        "id": stated.doi,
        "naming_authority": "org.doi" if stated.doi else None,
        "metadata_link": f"https://doi.org/{stated.doi}" if stated.doi else None,
        "comment": "date_created is omitted: identical inputs give identical cubes",
        "source": "UAV-borne radar recordings; their hashes are in attribute inputs",
        "processing_level": "L1",
        "product_version": __version__,
        "standard_name_vocabulary": "CF Standard Name Table",
        "license": stated.licence,
        "creator_name": ", ".join(person.name for person in people) or None,
        "creator_type": "person" if people else None,
        "creator_url": ", ".join(urls) or None,
        "creator_institution": ", ".join(dict.fromkeys(one.affiliation for one in people if one.affiliation)) or None,
        "institution": stated.institution,
        "publisher_name": stated.institution,
        "publisher_type": "institution" if stated.institution else None,
        "references": stated.citation(name, int(first[:4]) if has_clock else None),
        "platform": stated.platform,
        "instrument": stated.instrument,
    }
    if has_clock:
        attributes |= {
            "time_coverage_start": f"{first[:26]}Z",
            "time_coverage_end": f"{last[:26]}Z",
            "time_coverage_duration": f"PT{duration_s:.6f}S",
        }
    return {key: value for key, value in attributes.items() if value is not None} | _geospatial(grid)


def _geospatial(grid: SceneGrid) -> dict[str, str | float]:
    """Return bounds and resolution of a grid as ACDD attributes; empty in a local frame."""
    if grid.frame == "local":
        return {}
    west, south, east, north = transform_bounds(grid.crs_wkt, "EPSG:4326", *grid.bounds_m)
    corners = ((north, west), (south, west), (south, east), (north, east), (north, west))
    outline = ", ".join(f"{latitude:.7f} {longitude:.7f}" for latitude, longitude in corners)
    sides = {"lat_min": south, "lat_max": north, "lon_min": west, "lon_max": east}
    return {
        "geospatial_bounds": f"POLYGON (({outline}))",
        "geospatial_bounds_crs": "EPSG:4326",
        "geospatial_lat_units": "degrees_north",
        "geospatial_lon_units": "degrees_east",
        "geospatial_lat_resolution": f"{grid.spacing_m:g} m",
        "geospatial_lon_resolution": f"{grid.spacing_m:g} m",
        **{f"geospatial_{side}": round(value, 7) for side, value in sides.items()},
    }
