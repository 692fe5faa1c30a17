"""The ground under a scene as the config tells it: flat at a height, or a DEM, and the files that takes."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from apertura.errors import CampaignError
from apertura.geometry.geodesy import geodetic_from_ecef
from apertura.provenance import sha256_file
from apertura.scene.dem import open_terrain
from apertura.scene.geoid import geoid_file, undulation
from apertura.scene.grid import SceneGrid
from apertura.scene.terrain import Terrain
from apertura.settings import Scene

_COARSE = 32


@dataclass(frozen=True)
class Ground:
    """What the config says of the ground: flat at a height, or a DEM; and the files that takes.

    Attributes
    ----------
    flat_m
        Height of flat ground above what `height_datum` says.
    terrain
        The DEM; None: flat ground.
    geoid
        Grid of the geoid that `flat_m` counts from; None: the ellipsoid.
    crs
        Of the scene.
    """

    flat_m: float
    terrain: Terrain | None
    geoid: Path | None
    crs: str

    @classmethod
    def of(cls, asked: Scene, root: Path, *, crs: str) -> "Ground":
        """Open what section `scene` names; paths count from the campaign folder."""
        named = root / asked.geoid if asked.geoid else None
        if asked.dem and asked.dem_datum:
            terrain = open_terrain(root / asked.dem, crs, datum=asked.dem_datum, geoid=named)
            return cls(asked.height_m, terrain, None, crs)
        geoid = None if asked.height_datum == "ellipsoid" else geoid_file(asked.height_datum, named)
        return cls(asked.height_m, None, geoid, crs)

    @property
    def inputs(self) -> dict[str, str]:
        """Role → sha256 of the DEM and of the grid of the geoid, as far as there are any."""
        geoid = self.terrain.geoid if self.terrain else self.geoid
        files = {"dem": self.terrain.path if self.terrain else None, "geoid": geoid}
        return {role: sha256_file(path) for role, path in files.items() if path}

    def height_under(self, x_m: float, y_m: float) -> float:
        """Return the ellipsoidal height (m) of the ground at a place in the scene's CRS."""
        place = SceneGrid(self.crs, x_m - 0.5, y_m + 0.5, 1.0, (1, 1), 0.0)
        if self.terrain:
            height_m = float(self.terrain.heights(place)[0, 0])
            if np.isfinite(height_m):
                return height_m
            raise CampaignError(
                f"no height at ({x_m:.1f}, {y_m:.1f}) under the track, where scene.bounds_m: auto starts from",
                where=self.terrain.path,
                expected="a DEM that reaches there and has no void there",
                remedy="Get the missing part, fill the void, or state scene.bounds_m.",
            )
        if self.geoid is None:
            return self.flat_m
        latitude, longitude, _ = geodetic_from_ecef(place.positions()[0, 0])
        return self.flat_m + float(undulation(self.geoid, longitude, latitude))


def on_the_ground(grid: SceneGrid, ground: Ground) -> tuple[SceneGrid, dict[str, str]]:
    """Return the grid at its reference height, and why: the config, or the mean of the DEM (to the millimetre)."""
    xmin, ymin, xmax, ymax = grid.bounds_m
    if ground.terrain is None:
        height_m = ground.height_under((xmin + xmax) / 2, (ymin + ymax) / 2)
        why = {"height_m": "height_m and the undulation at the scene's middle"} if ground.geoid else {}
        return replace(grid, height_m=height_m), why
    ground.terrain.check_cover(grid)
    side = max(1, max(grid.shape) // _COARSE)
    rows, columns = (max(1, size // side) for size in grid.shape)
    heights = ground.terrain.heights(replace(grid, spacing_m=grid.spacing_m * side, shape=(rows, columns)))
    known = np.isfinite(heights)
    height_m = round(float(heights[known].mean()), 3) if known.any() else 0.0
    return replace(grid, height_m=height_m), {"height_m": "mean of the DEM over the scene"}
