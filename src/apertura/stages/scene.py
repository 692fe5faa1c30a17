"""Rules `scene` and `terrain`: the grid of the campaign with all `auto` settings resolved, and its terrain heights."""

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

# ---- Configured terrain: flat at a height, or a DEM ------------------------------------------------------------------

_BLOCKS = 32


@dataclass(frozen=True)
class ConfiguredGround:
    """Configured terrain, flat at a height or from a DEM, with the required files.

    Attributes
    ----------
    flat_m
        Height of flat terrain above `height_datum`, metres.
    dem
        DEM; None: flat terrain.
    geoid
        Geoid grid to which `flat_m` refers; None: `flat_m` is ellipsoidal.
    crs
        CRS of the scene.
    """

    flat_m: float
    dem: Dem | None
    geoid: Path | None
    crs: str

    @classmethod
    def of(cls, requested: Scene, files: Mapping[str, Path], *, crs: str) -> "ConfiguredGround":
        """Open the terrain of section `scene`; `files` are those of `Campaign.height_files`."""
        geoid_path = files.get("geoid")
        if requested.dem and requested.dem_datum:
            dem = open_dem(files["dem"], crs, datum=requested.dem_datum, geoid=geoid_path)
            return cls(requested.height_m, dem, None, crs)
        geoid = None if requested.height_datum == "ellipsoid" else geoid_file(requested.height_datum, geoid_path)
        return cls(requested.height_m, None, geoid, crs)

    @property
    def inputs(self) -> dict[str, str]:
        """Role → SHA-256 of the DEM and of the geoid grid, as far as they are used."""
        files = {"dem": self.dem.path if self.dem else None, "geoid": self.dem.geoid if self.dem else self.geoid}
        return {role: sha256_file(path) for role, path in files.items() if path}

    def height_at(self, x_m: float, y_m: float) -> float:
        """Return the ellipsoidal terrain height (m) at a point in the scene's CRS; raise CampaignError if unknown."""
        if self.dem:
            height_m = float(self.dem.heights(SceneGrid(self.crs, x_m - 0.5, y_m + 0.5, 1.0, (1, 1)))[0, 0])
            if np.isfinite(height_m):
                return height_m
            raise CampaignError(
                f"no height at ({x_m:.1f}, {y_m:.1f}) below the track, required for scene.bounds_m: auto",
                where=self.dem.path,
                expected="a DEM that covers this point without a void",
                remedy="Extend the DEM, fill the void, or configure scene.bounds_m.",
            )
        if self.geoid is None:
            return self.flat_m
        latitude, longitude, _ = geodetic_from_ecef(frame_from_map(self.crs, x_m, y_m, 0.0))
        return self.flat_m + float(undulation(self.geoid, longitude, latitude))

    def level(self, grid: SceneGrid) -> FlatGround:
        """Return flat terrain for a whole grid: at the configured height, or at the mean of the DEM (rounded to 1 mm).

        Raises
        ------
        CampaignError
            If the DEM does not cover the grid.
        """
        xmin, ymin, xmax, ymax = grid.bounds_m
        if self.dem is None:
            return FlatGround(self.height_at((xmin + xmax) / 2, (ymin + ymax) / 2))
        self.dem.check_cover(grid)
        heights = self.dem.heights(grid.coarse(_BLOCKS))
        finite = np.isfinite(heights)
        return FlatGround(round(float(heights[finite].mean()), 3) if finite.any() else 0.0)

    @property
    def reason(self) -> dict[str, str]:
        """Origin of the height of `level`; empty if the config states it as an ellipsoidal height."""
        if self.dem:
            return {"height_m": "mean of the DEM over the scene"}
        return {"height_m": "height_m plus the geoid undulation at the scene centre"} if self.geoid else {}


# ---- Grid and terrain of a campaign, from its results or its config --------------------------------------------------

_FARTHEST_M = 1e9

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Flown:
    """Geometry and band of a flight, from which `auto` derives the grid.

    Attributes
    ----------
    aperture
        Aperture in ECEF or the local frame.
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
        """Join the geometry of all pairs of a flight; the grid of a campaign does not depend on the imaged pair."""
        tx_m, rx_m = (np.concatenate([flown.aperture.legs[leg] for flown in pairs]) for leg in (0, 1))
        return cls(Aperture(tx_m, rx_m), pairs[0].frequency_hz, min(flown.path_limit_m for flown in pairs))


@dataclass(frozen=True)
class OpenScene:
    """Grid and terrain of a campaign.

    Attributes
    ----------
    grid
        Grid of every raster.
    level
        Flat terrain at the configured height, or at the mean of the DEM.
    terrain
        Terrain: `level`, or the heights of the DEM.
    parents
        Stage `terrain` if there is a DEM, for the provenance of results that depend on it.
    inputs
        Role → SHA-256 of the files of heights.
    chosen
        Key of section `scene` → reason for its automatic value.
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
        """Scene centre on the terrain, (3,) float64 metres in the frame of the pixels."""
        return self.grid.positions_at(*self._middle)

    @cached_property
    def axes(self) -> NDArray[np.float64]:
        """Unit vectors along easting, northing and height at the scene centre, the rows of (3, 3) float64."""
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
        """Report on the terrain for image.json; empty for flat terrain."""
        return {"terrain": self.parents[0].attrs["terrain"]} if self.parents else {}

    @property
    def flags(self) -> dict[str, str]:
        """Flags of the terrain for images."""
        step = self.report.get("terrain", {}).get("steepest_step")
        if step is None:
            return {}
        return {
            "terrain_step": f"the DEM has a step of {step['height_m']:.0f} m over {step['over_m']:.0f} m at "
            f"x {step['x_m']:.1f}, y {step['y_m']:.1f}"
        }


def settled_scene(campaign: Campaign) -> OpenScene:
    """Return the scene of results/scene.json with flat terrain; `open_scene` also opens the terrain heights.

    Raises
    ------
    CampaignError
        If scene.json does not exist yet, or is damaged.
    """
    path = campaign.result("scene.json")
    document = open_document(path)
    with undamaged(path, expected="the grid that step scene writes", remedy=remake(path)):
        grid, level = document["grid"], FlatGround(_number(document["height_m"]))
        metres = {name: _number(grid[name]) for name in ("west_m", "north_m", "spacing_m")}
        shape, first = ((operator.index(grid[name][0]), operator.index(grid[name][1])) for name in ("shape", "first"))
        crs, name = plain_crs(_text(grid["crs"])), _text(grid["name"])
        try:
            whole = SceneGrid(crs, **metres, shape=shape, first=first, name=name)
        except CampaignError as error:
            raise ValueError(error.found) from error
        return OpenScene(whole, level, level, (), dict(document["inputs"]), dict(document["chosen"]))


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{quoted(value)} is not text")
    return value


def _number(value: object) -> float:
    if not isinstance(value, int | float) or not abs(value) < _FARTHEST_M:
        raise TypeError(f"{quoted(value)} is not a length in metres")
    return float(value)


def open_scene(campaign: Campaign) -> OpenScene:
    """Return the scene of results/scene.json with its terrain; heights of a DEM are read by windows."""
    scene = settled_scene(campaign)
    if campaign.settings.scene.dem is None:
        return scene
    folder = campaign.stage("terrain")
    stage = open_stage(folder, "terrain")
    heights = GridHeights(scene.grid, open_array(folder, "height", mode="r"))
    return replace(scene, terrain=heights, parents=(stage,))


def expected_scene(campaign: Campaign, flown: Callable[[], Flown]) -> OpenScene:
    """Return the scene with its terrain, from finished results or else from the config.

    `flown` returns the apertures of the first image flight; it is called only for `auto` settings. Voids of a DEM raise
    CampaignError when heights are read.
    """
    requested = campaign.settings.scene
    is_automatic = "auto" in {requested.crs, requested.bounds_m, requested.spacing_m}
    if is_automatic and campaign.is_current(campaign.result("scene.json")):
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
    """Return the configured grid with `auto` settings derived from a flight, its terrain, and the reasons.

    Parameters
    ----------
    campaign
        Campaign with its settings.
    flown
        Returns the apertures of the first image flight; called only for `auto` settings.
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
        height_m = ground.height_at(float(east), float(north))  # below the track
        bounds = auto_bounds(first.aperture, crs=crs, height_m=height_m, path_limit_m=first.path_limit_m)
        chosen["bounds_m"] = "area that the first image flight illuminates well (docs/theory.md, eq. 8)"
    if spacing == "auto":
        finest = _spacing(flown(), ground, bounds, height_m)
        chosen["spacing_m"] = "a third of the finest resolution cell (docs/theory.md, eq. 8)"
        most = most_pixels(len(flown().aperture), len(flown().frequency_hz))
        spacing = coarsened(finest, bounds, most) if requested.bounds_m == "auto" else finest
        if spacing > finest:
            megapixels = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1]) / finest**2 / 1e6
            chosen["spacing_m"] = (
                f"coarser than {finest:g} m, a third of the finest resolution cell: with automatic bounds that spacing "
                f"requires {megapixels:.3g} Mpx, more than the limit of {most / 1e6:.3g} Mpx for this flight; for a "
                "finer spacing, configure scene.bounds_m"
            )
    if "auto" in {requested.bounds_m, requested.spacing_m}:
        xmin, ymin, xmax, ymax = bounds
        columns, rows = (int(np.ceil(extent / spacing - 1e-9)) for extent in (xmax - xmin, ymax - ymin))
        bounds = (xmin, ymax - rows * spacing, xmin + columns * spacing, ymax)
    grid = SceneGrid.from_bounds(crs, bounds, spacing_m=spacing, name=campaign.settings.campaign)
    return grid, ground, chosen | ground.reason


def _spacing(flown: Flown, ground: ConfiguredGround, bounds: Bounds, height_m: float | None) -> float:
    """Return the automatic pixel spacing; with configured bounds, the mean height is computed on a coarse grid."""
    if height_m is None:
        xmin, ymin, xmax, ymax = bounds
        side_m = min(xmax - xmin, ymax - ymin) / COVER_NODES
        height_m = ground.level(SceneGrid.from_bounds(ground.crs, bounds, spacing_m=side_m)).height_m
    where: dict[str, Any] = {"crs": ground.crs, "bounds_m": bounds, "height_m": height_m}
    return auto_spacing(flown.aperture, flown.frequency_hz, **where)


def _middle(flown: Flown) -> NDArray[np.float64]:
    return np.asarray(np.median(np.concatenate(flown.aperture.legs), axis=0))


# ---- Rule `scene`: the grid of the campaign, with all `auto` settings resolved ---------------------------------------


def scene(campaign: Campaign) -> Path:
    """Write results/scene.json: the configured grid, its mean terrain height, and the reasons for automatic values."""
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
        If the config names no DEM, or the DEM does not cover the scene or has voids within it.
    """
    scene, folder = settled_scene(campaign), campaign.stage("terrain")
    grid, ground = scene.grid, ConfiguredGround.of(campaign.settings.scene, campaign.height_files(), crs=scene.grid.crs)
    if ground.dem is None:
        raise CampaignError(
            "no DEM",
            where="config/config.yaml: scene.dem",
            expected="a GeoTIFF of heights",
            remedy="Configure dem and dem_datum; flat terrain does not require this step.",
        )
    lineage = result_of(campaign, "terrain").begin(campaign.root)
    ground.dem.check_cover(grid)
    windows = list(grid.tiles(campaign.settings.processing.tile_px))
    with writing(folder) as wip:
        missing = resume(wip, _empty_terrain(scene, ground, lineage), "height", windows)
        count = number_of(len(windows), "tile")
        print(f"reading {len(missing)} of {count} from {ground.dem.path.name}", flush=True)
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
    """Return stage `terrain` with provenance and without heights."""
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
