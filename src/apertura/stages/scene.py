"""Rules `scene` and `terrain`: the campaign's one grid, every `auto` settled once, and the height of each pixel."""

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import Scene
from apertura.campaign.config.section import plain_crs
from apertura.campaign.digests import Lineage
from apertura.campaign.folder import Campaign
from apertura.campaign.store import (
    finish,
    open_array,
    open_document,
    open_stage,
    remake,
    resume,
    save_document,
    writing,
)
from apertura.common.documents import undamaged
from apertura.common.errors import CampaignError, number_of, quoted
from apertura.common.provenance import sha256_file
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import frame_from_map, geodetic_from_ecef, map_from_frame
from apertura.core.scene.auto_grid import auto_bounds, auto_spacing, coarsened, most_pixels, utm_crs
from apertura.core.scene.dem import COVER_NODES, Dem, UncheckedDem, height_range, open_dem, steepest_step
from apertura.core.scene.geoid import geoid_file, undulation
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, GridHeights, Terrain
from apertura.stages.tags import stamped
from apertura.workflow.lineage import result_of

# ---- Ground of the config: flat at a height, or a DEM ---------------------------------------------------------------

_BLOCKS = 32


@dataclass(frozen=True)
class ConfiguredGround:
    """Ground stated in the config: flat at a height, or a DEM; and the files that it needs.

    Attributes
    ----------
    flat_m
        Height of flat ground above `height_datum`, metres.
    dem
        The DEM; None: flat ground.
    geoid
        Grid of the geoid that `flat_m` counts from; None: the ellipsoid.
    crs
        Of the scene.
    """

    flat_m: float
    dem: Dem | None
    geoid: Path | None
    crs: str

    @classmethod
    def of(cls, requested: Scene, files: Mapping[str, Path], *, crs: str) -> "ConfiguredGround":
        """Open what section `scene` names; `files` are those of `Campaign.height_files`."""
        named = files.get("geoid")
        if requested.dem and requested.dem_datum:
            dem = open_dem(files["dem"], crs, datum=requested.dem_datum, geoid=named)
            return cls(requested.height_m, dem, None, crs)
        geoid = None if requested.height_datum == "ellipsoid" else geoid_file(requested.height_datum, named)
        return cls(requested.height_m, None, geoid, crs)

    @property
    def inputs(self) -> dict[str, str]:
        """Role → sha256 of the DEM and of the grid of the geoid, as far as there are any."""
        files = {"dem": self.dem.path if self.dem else None, "geoid": self.dem.geoid if self.dem else self.geoid}
        return {role: sha256_file(path) for role, path in files.items() if path}

    def height_at(self, x_m: float, y_m: float) -> float:
        """Return the ellipsoidal height (m) of the ground at a place in the scene's CRS; raise where it has none."""
        if self.dem:
            height_m = float(self.dem.heights(SceneGrid(self.crs, x_m - 0.5, y_m + 0.5, 1.0, (1, 1)))[0, 0])
            if np.isfinite(height_m):
                return height_m
            raise CampaignError(
                f"no height at ({x_m:.1f}, {y_m:.1f}) under the track, where scene.bounds_m: auto starts from",
                where=self.dem.path,
                expected="a DEM that reaches there and has no void there",
                remedy="Get the missing part, fill the void, or state scene.bounds_m.",
            )
        if self.geoid is None:
            return self.flat_m
        latitude, longitude, _ = geodetic_from_ecef(frame_from_map(self.crs, x_m, y_m, 0.0))
        return self.flat_m + float(undulation(self.geoid, longitude, latitude))

    def level(self, grid: SceneGrid) -> FlatGround:
        """Return flat ground for a whole grid: at the height stated, or at the mean of the DEM (to the millimetre).

        Raises
        ------
        CampaignError
            If the DEM does not reach over the grid.
        """
        xmin, ymin, xmax, ymax = grid.bounds_m
        if self.dem is None:
            return FlatGround(self.height_at((xmin + xmax) / 2, (ymin + ymax) / 2))
        self.dem.check_cover(grid)
        heights = self.dem.heights(grid.coarse(_BLOCKS))
        known = np.isfinite(heights)
        return FlatGround(round(float(heights[known].mean()), 3) if known.any() else 0.0)

    @property
    def reason(self) -> dict[str, str]:
        """Why flat ground lies where `level` puts it; nothing where the config states it."""
        if self.dem:
            return {"height_m": "mean of the DEM over the scene"}
        return {"height_m": "height_m and the undulation at the scene's middle"} if self.geoid else {}


# ---- Grid and ground of a campaign, from its results or its config --------------------------------------------------

_FARTHEST_M = 1e9

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Flown:
    """Geometry and band from which `auto` settles the grid.

    Attributes
    ----------
    aperture
        In ECEF or the local frame.
    frequency_hz
        (subcarrier,) float64.
    path_limit_m
        Longest total path inside the cyclic prefix, metres.
    """

    aperture: Aperture
    frequency_hz: NDArray[np.float64]
    path_limit_m: float

    @classmethod
    def together(cls, pairs: Sequence["Flown"]) -> "Flown":
        """Join the geometry of all pairs of a flight: a campaign has one grid, whichever pair is imaged."""
        tx_m, rx_m = (np.concatenate([flown.aperture.legs[leg] for flown in pairs]) for leg in (0, 1))
        return cls(Aperture(tx_m, rx_m), pairs[0].frequency_hz, min(flown.path_limit_m for flown in pairs))


@dataclass(frozen=True)
class OpenScene:
    """A campaign's grid and ground.

    Attributes
    ----------
    grid
        Of every raster.
    level
        Flat ground: where it is stated, or at the mean of the DEM.
    terrain
        The ground itself: `level`, or the DEM's heights.
    parents
        The stage `terrain`, or nothing: what is made on it inherits its provenance.
    inputs
        Role → sha256 of the files that the heights come from.
    chosen
        Key of the config's `scene` → why it was settled so.
    """

    grid: SceneGrid
    level: FlatGround
    terrain: Terrain
    parents: tuple[xr.Dataset, ...]
    inputs: dict[str, str]
    chosen: dict[str, str]

    @property
    def spec(self) -> dict[str, Any]:
        """Grid and level as JSON values, for scene.json and for provenance."""
        return {"grid": asdict(self.grid), "height_m": self.level.height_m}

    @cached_property
    def middle_m(self) -> NDArray[np.float64]:
        """The ground in the middle, (3,) float64 metres in the frame of the pixels."""
        return self.grid.positions_at(*self._middle)

    @cached_property
    def axes(self) -> NDArray[np.float64]:
        """Unit vectors along easting, northing and height there, the rows of (3, 3) float64."""
        row, column, height_m = self._middle
        steps = [
            self.grid.positions_at(row, column + 1, height_m) - self.middle_m,
            self.grid.positions_at(row - 1, column, height_m) - self.middle_m,
            self.grid.positions_at(row, column, height_m + 1) - self.middle_m,
        ]
        return np.array([step / np.linalg.norm(step) for step in steps])

    @cached_property
    def _middle(self) -> tuple[int, int, float]:
        row, column = (size // 2 for size in self.grid.shape)
        return row, column, float(self.terrain.heights_at(self.grid, row, column))

    @property
    def report(self) -> dict[str, Any]:
        """Terrain for image.json; empty for flat ground."""
        return {"terrain": self.parents[0].attrs["terrain"]} if self.parents else {}

    @property
    def flags(self) -> dict[str, str]:
        """Flags of the terrain for images: name → what was measured, in one line."""
        step = self.report.get("terrain", {}).get("steepest_step")
        if step is None:
            return {}
        return {
            "terrain_step": f"the DEM has a step of {step['height_m']:.0f} m over {step['over_m']:.0f} m at "
            f"x {step['x_m']:.1f}, y {step['y_m']:.1f}"
        }


def settled_scene(campaign: Campaign) -> OpenScene:
    """Return the scene of results/scene.json on level ground; `open_scene` also opens the ground itself.

    Raises
    ------
    CampaignError
        If the grid is not settled yet, or its file is damaged.
    """
    path = campaign.result("scene.json")
    document = open_document(path)
    with undamaged(path, expected="the grid that the workflow settles", remedy=remake(path)):
        grid, level = document["grid"], FlatGround(_number(document["height_m"]))
        places = {name: _number(grid[name]) for name in ("west_m", "north_m", "spacing_m")}
        shape, first = ((operator.index(grid[name][0]), operator.index(grid[name][1])) for name in ("shape", "first"))
        crs, name = plain_crs(_text(grid["crs"])), _text(grid["name"])
        try:
            whole = SceneGrid(crs, **places, shape=shape, first=first, name=name)
        except CampaignError as none:
            raise ValueError(none.found) from none
        return OpenScene(whole, level, level, (), dict(document["inputs"]), dict(document["chosen"]))


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{quoted(value)} is no text")
    return value


def _number(value: object) -> float:
    if not isinstance(value, int | float) or not abs(value) < _FARTHEST_M:
        raise TypeError(f"{quoted(value)} is no number of metres")
    return float(value)


def open_scene(campaign: Campaign) -> OpenScene:
    """Return the settled scene with its ground: the stage `terrain`, read by windows, where there is a DEM."""
    scene = settled_scene(campaign)
    if campaign.settings.scene.dem is None:
        return scene
    folder = campaign.stage("terrain")
    stage = open_stage(folder, "terrain")
    heights = GridHeights(scene.grid, open_array(folder, "height", mode="r"))
    return replace(scene, terrain=heights, parents=(stage,))


def expected_scene(campaign: Campaign, flown: Callable[[], Flown]) -> OpenScene:
    """Return the scene as `open_scene`, or before that as planned; voids of a DEM are rejected here too.

    `flown` gives the apertures of the first image flight; needed only where something is `auto`.
    """
    requested = campaign.settings.scene
    settles = "auto" in {requested.crs, requested.bounds_m, requested.spacing_m}
    if settles and campaign.is_current(campaign.result("scene.json")):
        scene = settled_scene(campaign)
    else:
        grid, ground, chosen = settled(campaign, flown)
        level = ground.level(grid)
        scene = OpenScene(grid, level, level, (), ground.inputs, chosen)
    if requested.dem is None:
        return scene
    if campaign.is_current(campaign.result("scene.json")) and campaign.is_current(campaign.stage("terrain")):
        return open_scene(campaign)
    dem = ConfiguredGround.of(requested, campaign.height_files(), crs=scene.grid.crs).dem
    return replace(scene, terrain=UncheckedDem(dem, scene.grid)) if dem else scene


def settled(campaign: Campaign, flown: Callable[[], Flown]) -> tuple[SceneGrid, ConfiguredGround, dict[str, str]]:
    """Return the requested grid, every `auto` decided from a flight; its ground; and the reasons.

    Parameters
    ----------
    campaign
        With its settings.
    flown
        Gives the apertures of the first image flight; needed only where something is `auto`.
    """
    requested, chosen = campaign.settings.scene, {}
    crs, bounds, spacing = requested.crs, requested.bounds_m, requested.spacing_m
    if crs == "auto":
        crs, chosen["crs"] = utm_crs(_middle(flown())), "UTM zone of the first image flight"
    ground = ConfiguredGround.of(requested, campaign.height_files(), crs=crs)
    height_m = None
    if bounds == "auto":
        first = flown()
        east, north = map_from_frame(crs, _middle(first))[:2]
        height_m = ground.height_at(float(east), float(north))  # under the track
        bounds = auto_bounds(first.aperture, crs=crs, height_m=height_m, path_limit_m=first.path_limit_m)
        chosen["bounds_m"] = "ground that the first image flight illuminates well (docs/theory.md, eq. 8)"
    if spacing == "auto":
        finest = _spacing(flown(), ground, bounds, height_m)
        chosen["spacing_m"] = "a third of the finest resolution cell (docs/theory.md, eq. 8)"
        most = most_pixels(len(flown().aperture), len(flown().frequency_hz))
        spacing = coarsened(finest, bounds, most) if requested.bounds_m == "auto" else finest
        if spacing > finest:
            megapixels = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1]) / finest**2 / 1e6
            chosen["spacing_m"] = (
                f"coarser than a third of the finest resolution cell, {finest:g} m, which on automatic bounds makes "
                f"{megapixels:.3g} Mpx, more than the {most / 1e6:.3g} Mpx that this pass fills: state scene.bounds_m"
            )
    if "auto" in {requested.bounds_m, requested.spacing_m}:
        xmin, ymin, xmax, ymax = bounds
        columns, rows = (int(np.ceil(extent / spacing - 1e-9)) for extent in (xmax - xmin, ymax - ymin))
        bounds = (xmin, ymax - rows * spacing, xmin + columns * spacing, ymax)
    grid = SceneGrid.from_bounds(crs, bounds, spacing_m=spacing, name=campaign.settings.campaign)
    return grid, ground, chosen | ground.reason


def _spacing(flown: Flown, ground: ConfiguredGround, bounds: Bounds, height_m: float | None) -> float:
    """Return automatic spacing; on stated bounds the ground's level is taken on pixels made just for that."""
    if height_m is None:
        xmin, ymin, xmax, ymax = bounds
        side_m = min(xmax - xmin, ymax - ymin) / COVER_NODES
        height_m = ground.level(SceneGrid.from_bounds(ground.crs, bounds, spacing_m=side_m)).height_m
    where: dict[str, Any] = {"crs": ground.crs, "bounds_m": bounds, "height_m": height_m}
    return auto_spacing(flown.aperture, flown.frequency_hz, **where)


def _middle(flown: Flown) -> NDArray[np.float64]:
    return np.asarray(np.median(np.concatenate(flown.aperture.legs), axis=0))


# ---- Rule `scene`: the campaign's one grid, every `auto` decided once -----------------------------------------------


def scene(campaign: Campaign) -> Path:
    """Write results/scene.json: the grid requested in config/config.yaml, the height of its ground, and reasons."""
    lineage = result_of(campaign, "scene").begin(campaign.root)
    grid, ground, chosen = settled(campaign, cache(lambda: _first_flight(campaign)))
    path, height_m = campaign.result("scene.json"), ground.level(grid).height_m
    document = {"grid": asdict(grid), "height_m": height_m, "chosen": chosen, "inputs": ground.inputs}
    save_document(path, document, lineage)
    return path


def _first_flight(campaign: Campaign) -> Flown:
    flight = campaign.image_flights[0]
    echoes = [open_stage(campaign.stage("echo", flight.name, pair), "echo") for pair in flight.pairs]
    return Flown.together(
        [
            Flown(
                Aperture(echo.tx_position.values, echo.rx_position.values),
                echo.frequency.values,
                float(echo.path_limit.min()),
            )
            for echo in echoes
        ]
    )


# ---- Rule `terrain`: height of every pixel from the DEM -------------------------------------------------------------


def terrain(campaign: Campaign) -> Path:
    """Write results/terrain.zarr: ellipsoidal height (y, x) of the grid, tile by tile.

    Raises
    ------
    CampaignError
        If the config names no DEM, or the DEM does not reach over the scene or has voids in it.
    """
    scene, folder = settled_scene(campaign), campaign.stage("terrain")
    grid, ground = scene.grid, ConfiguredGround.of(campaign.settings.scene, campaign.height_files(), crs=scene.grid.crs)
    if ground.dem is None:
        raise CampaignError(
            "no DEM",
            where="config/config.yaml: scene.dem",
            expected="a GeoTIFF of heights",
            remedy="Flat ground needs no terrain; name a DEM and its dem_datum, or leave this step out.",
        )
    lineage = result_of(campaign, "terrain").begin(campaign.root)
    ground.dem.check_cover(grid)
    windows = list(grid.tiles(campaign.settings.processing.tile_px))
    with writing(folder) as wip:
        missing = resume(wip, _empty_terrain(scene, ground, lineage), "height", windows)
        print(f"{len(missing)} of {number_of(len(windows), 'tile')} to read from {ground.dem.path.name}", flush=True)
        heights = open_array(wip, "height")
        for window in missing:
            heights[window] = ground.dem.heights(grid[window])
        written = GridHeights(grid, heights)
        lowest_m, highest_m = height_range(written, grid, where=ground.dem.path)
        step = steepest_step(written, grid)
        report = {
            "dem": ground.dem.path.name,
            "geoid": ground.dem.geoid.name if ground.dem.geoid else None,
            "lowest_m": lowest_m,
            "highest_m": highest_m,
            "steepest_step": None if step is None else step._asdict(),
            "datum": campaign.settings.scene.dem_datum,
        }
        finish(wip, folder, lineage=lineage, terrain=report)
    return folder


def _empty_terrain(scene: OpenScene, ground: ConfiguredGround, lineage: Lineage) -> xr.Dataset:
    """Return the stamped stage without its heights."""
    return stamped(
        xr.Dataset(
            {"height": (("y", "x"), np.broadcast_to(np.float64(0), scene.grid.shape))},
            coords=scene.grid.coordinates,
            attrs={"frame": scene.grid.frame, "terrain": {}},
        ),
        "terrain",
        modules=lineage.modules,
        settings={**lineage.result.settings, **scene.spec},
        inputs=ground.inputs,
    )
