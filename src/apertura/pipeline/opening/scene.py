"""A campaign's grid and the ground under it, opened together: from the results, or as they will be."""

import operator
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.documents import undamaged
from apertura.common.errors import quoted
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import map_from_frame
from apertura.core.scene.auto_grid import auto_bounds, auto_spacing, utm_crs
from apertura.core.scene.dem import COVER_NODES, UncheckedDem
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, GridHeights, Terrain
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config.section import plain_crs
from apertura.pipeline.opening.ground import Ground
from apertura.pipeline.store import manifest_of, open_array, open_document, open_stage, remake

_FARTHEST_M = 1e9

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Flown:
    """What `auto` settles the grid from.

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
        """Return what all pairs of a flight flew: a campaign has one grid, whichever pair is imaged."""
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
        """What image.json says of the terrain; nothing of flat ground."""
        return {"terrain": self.parents[0].attrs["terrain"]} if self.parents else {}


def settled_scene(campaign: Campaign) -> OpenScene:
    """Return what results/scene.json settled, on level ground: whoever needs the ground itself opens the scene.

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
        whole = SceneGrid(plain_crs(_text(grid["crs"])), **places, shape=shape, first=first, name=_text(grid["name"]))
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
    """Return the scene as `open_scene`, or what it will be; voids of a DEM are refused here as they will be.

    `flown` gives what the first image flight flew; asked only where something is `auto`.
    """
    asked = campaign.settings.scene
    if "auto" in {asked.crs, asked.bounds_m, asked.spacing_m} and manifest_of(campaign.result("scene.json")).is_file():
        scene = settled_scene(campaign)
    else:
        grid, ground, chosen = settled(campaign, flown)
        level = ground.level(grid)
        scene = OpenScene(grid, level, level, (), ground.inputs, chosen)
    if asked.dem is None:
        return scene
    if manifest_of(campaign.stage("terrain")).is_file():
        return open_scene(campaign)
    dem = Ground.of(asked, campaign.height_files(), crs=scene.grid.crs).dem
    return replace(scene, terrain=UncheckedDem(dem, scene.grid)) if dem else scene


def settled(campaign: Campaign, flown: Callable[[], Flown]) -> tuple[SceneGrid, Ground, dict[str, str]]:
    """Return the grid that is asked for, every `auto` settled from a flight; its ground; and why.

    Parameters
    ----------
    campaign
        Whose config asks.
    flown
        Gives what the first image flight flew; asked only where something is `auto`.
    """
    asked, chosen = campaign.settings.scene, {}
    crs, bounds, spacing = asked.crs, asked.bounds_m, asked.spacing_m
    if crs == "auto":
        crs, chosen["crs"] = utm_crs(_middle(flown())), "UTM zone of the first image flight"
    ground = Ground.of(asked, campaign.height_files(), crs=crs)
    height_m = None
    if bounds == "auto":
        bounds, height_m = _bounds(flown(), ground)
        chosen["bounds_m"] = "ground that the first image flight sees well (docs/theory.md, eq. 8)"
    if spacing == "auto":
        spacing = _spacing(flown(), ground, bounds, height_m)
        chosen["spacing_m"] = "a third of the finest resolution cell (docs/theory.md, eq. 8)"
    if "auto" in {asked.bounds_m, asked.spacing_m}:
        bounds = _whole_pixels(bounds, spacing)
    grid = SceneGrid.from_bounds(crs, bounds, spacing_m=spacing, name=campaign.settings.campaign)
    return grid, ground, chosen | ground.reason


def _bounds(flown: Flown, ground: Ground) -> tuple[Bounds, float]:
    """Return automatic bounds and the height (m) of the ground under the track that they start from."""
    east, north = map_from_frame(ground.crs, _middle(flown))[:2]
    height_m = ground.height_at(float(east), float(north))
    limit_m = flown.path_limit_m
    return auto_bounds(flown.aperture, crs=ground.crs, height_m=height_m, path_limit_m=limit_m), height_m


def _spacing(flown: Flown, ground: Ground, bounds: Bounds, height_m: float | None) -> float:
    """Return automatic spacing; on stated bounds the ground's level is taken on pixels made just for that."""
    if height_m is None:
        xmin, ymin, xmax, ymax = bounds
        side_m = min(xmax - xmin, ymax - ymin) / COVER_NODES
        height_m = ground.level(SceneGrid.from_bounds(ground.crs, bounds, spacing_m=side_m)).height_m
    where: dict[str, Any] = {"crs": ground.crs, "bounds_m": bounds, "height_m": height_m}
    return auto_spacing(flown.aperture, flown.frequency_hz, **where)


def _middle(flown: Flown) -> NDArray[np.float64]:
    return np.asarray(np.median(np.concatenate(flown.aperture.legs), axis=0))


def _whole_pixels(bounds: Bounds, spacing: float) -> Bounds:
    xmin, ymin, xmax, ymax = bounds
    columns, rows = (int(np.ceil(extent / spacing - 1e-9)) for extent in (xmax - xmin, ymax - ymin))
    return (xmin, ymax - rows * spacing, xmin + columns * spacing, ymax)
