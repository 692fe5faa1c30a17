"""The ground under a scene as the config states it: flat at a height, or a DEM, and the files that takes."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.core.geometry.geodesy import frame_from_map, geodetic_from_ecef
from apertura.core.scene.dem import Dem
from apertura.core.scene.dem_file import open_dem
from apertura.core.scene.geoid import geoid_file
from apertura.core.scene.geoid_grid import undulation
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.pipeline.config import Scene

_BLOCKS = 32


@dataclass(frozen=True)
class Ground:
    """What the config says of the ground: flat at a height, or a DEM; and the files that takes.

    Attributes
    ----------
    flat_m
        Height of flat ground above what `height_datum` says.
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
    def of(cls, asked: Scene, files: Mapping[str, Path], *, crs: str) -> "Ground":
        """Open what section `scene` names; `files` are those of `Campaign.height_files`."""
        named = files.get("geoid")
        if asked.dem and asked.dem_datum:
            dem = open_dem(files["dem"], crs, datum=asked.dem_datum, geoid=named)
            return cls(asked.height_m, dem, None, crs)
        geoid = None if asked.height_datum == "ellipsoid" else geoid_file(asked.height_datum, named)
        return cls(asked.height_m, None, geoid, crs)

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
