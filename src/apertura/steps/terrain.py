"""Rule `terrain`: the DEM becomes the height of every pixel, once, for every flight and pair."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.contracts import Window
from apertura.errors import CampaignError
from apertura.load.ground import Ground
from apertura.scene.grid import LOCAL, SceneGrid
from apertura.scene.terrain import Terrain
from apertura.steps.scene import grid_coordinates, grid_spec, scene_grid
from apertura.steps.stamping import stamped
from apertura.store import finish, manifest_of, open_array, open_stage, resume, writing

_TILE_PX = 512


def terrain(campaign: Campaign) -> Path:
    """Write results/terrain.zarr: ellipsoidal height (y, x) of the grid, tile by tile.

    Raises
    ------
    CampaignError
        If the config names no DEM, or the DEM does not reach over the scene or has voids in it.
    """
    grid, folder = scene_grid(campaign), campaign.stage("terrain")
    ground = Ground.of(campaign.settings.scene, campaign.root, crs=grid.crs)
    if ground.terrain is None:
        raise CampaignError(
            "no DEM",
            where="config/config.yaml: scene.dem",
            expected="a GeoTIFF of heights",
            remedy="Flat ground needs no terrain; name a DEM and its dem_datum, or leave this step out.",
        )
    ground.terrain.check_cover(grid)
    empty = stamped(
        xr.Dataset(
            {"height": (("y", "x"), np.broadcast_to(np.float64(0), grid.shape))},
            coords=grid_coordinates(grid, campaign.settings.campaign),
            attrs={"frame": "local" if grid.crs == LOCAL else "ecef", "terrain": {}},
        ),
        "terrain",
        module=__name__,
        settings={**campaign.relevant("terrain"), "grid": grid_spec(grid)},
        inputs=ground.inputs,
    )
    windows = list(grid.tiles(campaign.settings.processing.tile_px))
    with writing(folder) as wip:
        missing = resume(wip, empty, "height", windows)
        print(f"{len(missing)} of {len(windows)} tiles to read from {ground.terrain.path.name}", flush=True)
        target = open_array(wip, "height")
        for window in missing:
            target[window] = ground.terrain.heights(grid[window])
        report = _report(lambda window: np.asarray(target[window]), windows, grid, ground.terrain)
        finish(wip, folder, terrain=report | {"datum": campaign.settings.scene.dem_datum})
    return folder


def _report(
    heights_of: Callable[[Window], NDArray[np.float64]], windows: Iterable[Window], grid: SceneGrid, source: Terrain
) -> dict[str, Any]:
    """Return what image.json may say of the terrain; raise where a pixel has no height."""
    voids, first, low, high = 0, "", np.inf, -np.inf
    for window in windows:
        heights = heights_of(window)
        void = np.isnan(heights)
        if void.any() and not voids:
            row, column = np.argwhere(void)[0]
            x, y = grid[window].map_at(row, column)
            first = f"x {x:.2f}, y {y:.2f}"
        voids += int(void.sum())
        if not void.all():
            low, high = min(low, float(np.nanmin(heights))), max(high, float(np.nanmax(heights)))
    if voids:
        total = grid.shape[0] * grid.shape[1]
        raise CampaignError(
            f"no height at {voids} of {total} pixels of the scene ({100 * voids / total:.2f} %), first at {first}",
            where=source.path,
            expected="a height at every post under the scene",
            remedy="Fill the voids (NaN or nodata) of the DEM with a GIS, or make scene.bounds_m smaller.",
        )
    return {
        "dem": source.path.name,
        "geoid": source.geoid.name if source.geoid else None,
        "lowest_m": low,
        "highest_m": high,
    }


@dataclass(frozen=True)
class Heights:
    """The ground that imaging sees.

    Attributes
    ----------
    parents
        The stage `terrain`, or nothing: what was made with it inherits its provenance.
    of
        Window → (row, column) float64 metres; None: flat ground at the grid's height.
    """

    parents: tuple[xr.Dataset, ...]
    of: Callable[[Window], NDArray[np.float64]] | None

    @property
    def report(self) -> dict[str, Any]:
        """What image.json says of the terrain; nothing of flat ground."""
        return {"terrain": self.parents[0].attrs["terrain"]} if self.parents else {}

    def at(self, row: NDArray[Any], column: NDArray[Any]) -> NDArray[np.float64] | None:
        """Return the heights (m) at fractional pixel indices, bilinear; None where the ground is flat."""
        if self.of is None:
            return None
        pairs = zip(np.ravel(row), np.ravel(column), strict=True)
        return np.reshape([self._at(float(down), float(right), self.of) for down, right in pairs], np.shape(row))

    def _at(self, row: float, column: float, of: Callable[[Window], NDArray[np.float64]]) -> float:
        window = (slice(int(row), int(row) + 2), slice(int(column), int(column) + 2))
        found = of(window)  # one row or column less at the southern and eastern edge
        share = [
            np.array([1 - place % 1, place % 1])[:size] for place, size in zip((row, column), found.shape, strict=True)
        ]
        return float(share[0] @ found @ share[1] / (share[0].sum() * share[1].sum()))


def open_heights(campaign: Campaign) -> Heights:
    """Return the finished stage `terrain` to be read by windows, or flat ground where there is no DEM."""
    if campaign.settings.scene.dem is None:
        return Heights((), None)
    folder = campaign.stage("terrain")
    stage = open_stage(folder, "terrain")
    array = zarr.open_array(folder / "height", mode="r")
    return Heights((stage,), lambda window: np.asarray(array[window], np.float64))


def expected_heights(campaign: Campaign, grid: SceneGrid) -> Heights:
    """Return the ground as `open_heights`, or before stage `terrain` is made what it will hold; refuse its voids."""
    if campaign.settings.scene.dem is None or manifest_of(campaign.stage("terrain")).is_file():
        return open_heights(campaign)
    source = Ground.of(campaign.settings.scene, campaign.root, crs=grid.crs).terrain
    if source is None:
        return Heights((), None)

    def read(window: Window) -> NDArray[np.float64]:
        return source.heights(grid[window])

    def checked(window: Window) -> NDArray[np.float64]:
        heights = read(window)
        if np.isnan(heights).any():  # to be refused as the stage will be, with the count over the whole scene
            _report(read, grid.tiles(_TILE_PX), grid, source)
        return heights

    return Heights((), checked)
