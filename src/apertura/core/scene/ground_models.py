"""The ground of a scene and its two cheaper models: level, and a plane through it."""

from dataclasses import dataclass

import numpy as np

from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, Plane, Terrain

_BLOCKS = 33


@dataclass(frozen=True)
class GroundModels:
    """The ground of a scene and its two cheaper models, with how far they are off.

    Attributes
    ----------
    full, level, plane
        The ground, the same at one height, and the plane through it.
    relief_m, off_plane_m
        Largest difference of the ground from `level` and from `plane`, metres.
    """

    full: Terrain
    level: FlatGround
    plane: Plane
    relief_m: float
    off_plane_m: float

    @classmethod
    def of(cls, terrain: Terrain, level: FlatGround | None, grid: SceneGrid) -> "GroundModels":
        """Return the models of a ground from its heights in the middle of blocks of pixels.

        Without a level it is their mean, or the ground itself where that is flat.

        Examples
        --------
        >>> grid = SceneGrid("local", 0.0, 8.0, 1.0, (8, 8))
        >>> models = GroundModels.of(Plane(0.0, 4.0, 7.0, east=0.0, north=0.5), FlatGround(7.0), grid)
        >>> models.relief_m, round(models.off_plane_m, 9)
        (1.75, 0.0)
        """
        blocks = grid.coarse(_BLOCKS)
        heights = terrain.heights(blocks)
        if level is None:
            level = terrain if isinstance(terrain, FlatGround) else FlatGround(float(np.nanmean(heights)))
        heights = np.where(np.isfinite(heights), heights, level.height_m)  # a void between pixels is not imaged
        plane = Plane.through(blocks, heights)
        off_m = (np.abs(heights - model.heights(blocks)).max() for model in (level, plane))
        return cls(terrain, level, plane, *map(float, off_m))

    @classmethod
    def flat(cls, height_m: float = 0.0) -> "GroundModels":
        """Return the models of flat ground, which is its own."""
        level = FlatGround(height_m)
        return cls(level, level, Plane(0.0, 0.0, height_m, 0.0, 0.0), 0.0, 0.0)

    def called(self, name: str) -> Terrain:
        """Return the model that a decision names: 'plane' (level), 'tilted_plane' or 'dem'."""
        return {"plane": self.level, "tilted_plane": self.plane, "dem": self.full}[name]
