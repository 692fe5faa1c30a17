"""Rule `cube`: every image of the campaign on one grid, each flight's pairs added up, and phases between images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from apertura.common.contracts import STAGES, Window
from apertura.common.cube_variables import MEASURED, RASTERS
from apertura.common.documents import undamaged
from apertura.common.flags.raised import Flags
from apertura.core.combination.clutter import clutter_reduction_db
from apertura.core.combination.sums import coherent_sum, magnitude_sum, noncoherent_sum
from apertura.core.quality.measures import survey
from apertura.core.scene.grid import SceneGrid
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.agreement import agreement_of, agreement_report
from apertura.pipeline.opening.results import assessment_of
from apertura.pipeline.opening.scene import settled_scene
from apertura.pipeline.steps.cube_labels import Images, labels, reference_flights
from apertura.pipeline.steps.cube_phases import compared, shared_band, window_of, write_phase
from apertura.pipeline.steps.stamping import stamped
from apertura.pipeline.store import create, finish, open_array, open_stage, writing

_PHASE = "coherence", "phase"


def cube(campaign: Campaign) -> Path:
    """Write results/cube.zarr: images (flight, pair, y, x), sums of each flight, coherence and phase between images.

    Tile by tile; a tile that no pulse of a pair sees is not stored and reads as NaN, as in its image.
    """
    flights, lineage = campaign.image_flights, result_of(campaign, "cube").begin(campaign.root)
    images = {
        (flight.name, pair): open_stage(campaign.stage("image", flight.name, pair), "image")
        for flight in flights
        for pair in flight.pairs
    }
    assessed = {flight.name: assessment_of(campaign, flight.name) for flight in flights}
    grid, side = settled_scene(campaign).grid, campaign.settings.processing.tile_px
    folder, windows = campaign.stage("cube"), list(grid.tiles(side))
    with undamaged(folder, expected="images as this version forms them", remedy="Run the workflow again."):
        described = _empty(images, assessed, grid)
    with writing(folder) as wip:
        empty = stamped(
            described,
            "cube",
            modules=lineage.modules,
            parents={"/".join(name): image for name, image in images.items()},
            settings={"fusion": {name: one["fusion"] for name, one in assessed.items()}},
        )
        tile = {"y": side, "x": side, "flight": 1, "pair": 1}
        chunks = {name: tuple(tile[dim] for dim in STAGES["cube"].variables[name].dims) for name in RASTERS}
        create(wip, empty, chunks | {name: empty[name].shape for name in MEASURED}, consolidated=True)
        held = _Held({name: open_array(wip, name) for name in (*RASTERS, *MEASURED)}, [*assessed], empty.attrs["pairs"])
        for flight, one in assessed.items():
            _add_up(images, one["fusion"]["phases_rad"], held, flight, windows)
            single_db = [
                images[flight, pair].attrs["quality"]["noise_floor_db"] for pair in one["fusion"]["phases_rad"]
            ]
            sum_db = survey(held.plane("coherent", flight), windows).noise_floor_db
            held.plane("coherent_noise_floor", flight)[()] = sum_db
            held.plane("clutter_reduction", flight)[()] = clutter_reduction_db(single_db, sum_db)
        _compare(images, {flight: one["reference"] for flight, one in assessed.items()}, held, grid, side=side)
        finish(wip, folder, lineage=lineage)
    return folder


@dataclass(frozen=True)
class _Plane:
    """What an array holds of one flight, or of one pair of it."""

    array: Any
    place: tuple[int, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the plane."""
        shape: tuple[int, ...] = self.array.shape[len(self.place) :]
        return shape

    def __getitem__(self, window: Window) -> Any:
        return self.array[(*self.place, *window)]

    def __setitem__(self, window: Window | tuple[()], values: Any) -> None:
        self.array[(*self.place, *window)] = values


@dataclass(frozen=True)
class _Held:
    """The arrays of the cube, by name, flight and pair."""

    arrays: Mapping[str, Any]
    flights: Sequence[str]
    pairs: Sequence[str]

    def plane(self, name: str, flight: str, pair: str | None = None) -> _Plane:
        """Return a plane of an array, to be read and written by windows."""
        place = (self.flights.index(flight), *([] if pair is None else [self.pairs.index(pair)]))
        return _Plane(self.arrays[name], place)


def _add_up(images: Images, phases_rad: Mapping[str, float], held: _Held, flight: str, windows: list[Window]) -> None:
    """Copy the images of a flight and write their sums, tile by tile; `phases_rad` of those added coherently."""
    present = {pair: image for (name, pair), image in images.items() if name == flight}
    peaks = np.array([image.attrs["quality"]["brightest"]["amplitude"] for image in present.values()])
    added = np.array([pair in phases_rad for pair in present])
    turned = np.array([phases_rad[pair] for pair in present if pair in phases_rad])
    copies = [held.plane("image", flight, pair) for pair in present]
    sums = {name: held.plane(name, flight) for name in ("coherent", "noncoherent", "magnitude")}
    for window in windows:
        stack = np.stack([image.image[window].values for image in present.values()])
        there = ~np.isnan(stack).all(axis=(1, 2))
        for copy, block in zip(compress(copies, there), stack[there], strict=True):
            copy[window] = block
        if there[added].any():
            sums["coherent"][window] = coherent_sum(stack[added], peaks[added], turned)
        if there.any():
            sums["noncoherent"][window] = noncoherent_sum(stack, peaks)
            sums["magnitude"][window] = magnitude_sum(stack, peaks)


def _compare(images: Images, references: Mapping[str, str], held: _Held, grid: SceneGrid, *, side: int) -> None:
    """Write coherence and phase of each image with its flight's reference pair and its pair's first flight."""
    window = window_of(images, grid.spacing_m)
    for kind, rows in compared(images, references, reference_flights(images, held.pairs)).items():
        for one, other in rows.items():
            both, planes = (images[one], images[other]), [held.plane(f"{kind}_{name}", *one) for name in _PHASE]
            told = write_phase(both, (planes[0], planes[1]), grid, side=side, window=window)
            for name, value in zip(("looks", "chance", "common_band"), (*told, shared_band(*both)), strict=True):
                held.plane(f"{kind}_{name}", *one)[()] = value


def _between_flights(references: Mapping[str, xr.Dataset], grid: SceneGrid) -> dict[str, Any]:
    """Return how each flight's reference image lies against the first flight's, and its flags."""
    (first, image), *others = references.items()
    between: dict[str, Any] = {}
    flags: dict[str, Flags] = {}
    for name, other in others:
        found = agreement_of(image, other, grid)
        between[name] = agreement_report(found)
        if found is not None and found.shifted:
            line = (
                f"{found.points} bright points of flight {name} lie {100 * found.shift_m:.1f} ± "
                f"{100 * found.shift_std_m:.1f} cm from where flight {first} has them, {100 * found.shift_east_m:+.1f} "
                f"cm east and {100 * found.shift_north_m:+.1f} cm north: a base station, datum or time system differs"
            )
            flags[name] = Flags({"flights_apart": line})
    return {"agreement": {"reference": first, "flights": between}, "flags": flags}


def _empty(images: Images, assessed: Mapping[str, Mapping[str, Any]], grid: SceneGrid) -> xr.Dataset:
    """Return the cube without the values of its rasters, and of what is measured on them."""
    pairs = sorted({pair for _, pair in images})
    named = labels(images, assessed, pairs)
    sizes = {**named.sizes, "y": grid.shape[0], "x": grid.shape[1]}
    for name, (dims, dtype, _, _) in {**RASTERS, **MEASURED}.items():
        nothing = np.full((), complex(np.nan, np.nan) if dtype == "complex64" else np.nan, dtype)
        named[name] = dims, np.broadcast_to(nothing, tuple(sizes[dim] for dim in dims))
    references = {flight: images[flight, one["reference"]] for flight, one in assessed.items()}
    return named.assign_coords(grid.coordinates).assign_attrs(
        Conventions="CF-1.11",
        flights=[*assessed],
        pairs=pairs,
        fusion={flight: one["fusion"] for flight, one in assessed.items()},
        coherence_window=window_of(images, grid.spacing_m),
        **_between_flights(references, grid),
    )
