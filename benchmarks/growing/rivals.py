"""fastsar on a scene: `ExactFormer`, `ImageFormer` (factorized) and its backprojection of points, in complete calls.

Images of fastsar are (column, row) on a plane centred on the origin, and its samples refer to one-way range.
"""

import time
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.scene.terrain import FlatGround
from growing.contestants import PATIENCE, Contestant, Image, SkippedError, share_of
from growing.scene import Scene

_AXES = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0))  # columns to the east, rows to the south
_POINT_S, _EXACT_S = 2.5e-8, 4.5e-9  # approximate seconds per pixel and pulse


class Fastsar:
    """Scene in the conventions of fastsar."""

    def __init__(self, scene: Scene):
        import fastsar
        from fastsar import bp

        self.package, self.compress, self.scene = fastsar, bp.range_compress, scene
        history = scene.history
        step_hz = float(history.frequency_hz[1] - history.frequency_hz[0])
        self.sampling = (float(history.frequency_hz[0]), step_hz)
        self.one_way_m = history.reference_delay_s * SPEED_OF_LIGHT_M_S / 2
        self.middle = scene.grid.positions_at([scene.size // 2], [scene.size // 2], 0.0)[0]

    def factorized(self, name: str, finer: int = 1, **options: Any) -> Contestant:
        """Return the factorized `ImageFormer` with planning, on pixels that are finer by a factor and then decimated.

        The smallest patches of `ImageFormer` have 16 pixels; only finer pixels reduce their size and the image error.
        """
        scene = self.scene
        if scene.geometry == "bistatic":
            raise SkippedError("ImageFormer supports monostatic geometries only")
        if not isinstance(scene.ground, FlatGround):
            raise SkippedError("ImageFormer supports planes only")
        size, spacing = scene.size * finer, scene.grid.spacing_m / finer
        if size > 16384:
            raise SkippedError(f"{size}² pixels do not fit into memory")

        def run() -> tuple[Image, float, float]:
            begin = time.process_time()
            with warnings.catch_warnings(action="ignore"):  # warns of the accuracy, which is measured below
                former = self.package.ImageFormer(*self._grid(size, spacing), **self._options, **options)
            planned = time.process_time()
            image = former(scene.history.transfer)
            formed = time.process_time()
            return image[::finer, ::finer].T[*scene.checks], planned - begin, formed - planned

        settings = [f"{name}={value}" for name, value in options.items()] + ([f"pixels/{finer}"] if finer > 1 else [])
        return Contestant(name, " ".join(settings) or "defaults", scene, run, from_echoes=True)

    def exact(self, limit_s: float) -> Contestant:
        """Return `ExactFormer` for planes, tile by tile; range compression, part of every call, is counted once."""
        scene = self.scene
        if scene.geometry == "bistatic" or not isinstance(scene.ground, FlatGround):
            raise SkippedError("ExactFormer supports monostatic geometries and planes only")
        predicted, every = _EXACT_S * scene.size**2 * len(scene.history), 1
        while predicted / every > limit_s and scene.tiles(2 * every) != scene.tiles(every):
            every *= 2
        tiles = scene.tiles(every)
        if predicted * share_of(scene, tiles) > PATIENCE * limit_s:
            raise SkippedError(f"the smallest representative part takes {predicted * share_of(scene, tiles):.0f} s")

        def run() -> tuple[Image, float, float]:
            image = np.zeros(scene.grid.shape, np.complex64)
            compression = self._compression(8)
            begin = time.process_time()
            for rows, columns in tiles:
                side = columns.stop - columns.start
                centre = scene.grid.positions_at([rows.start + side // 2], [columns.start + side // 2], 0.0)[0]
                options = {**self._options, "center": centre - self.middle}
                former = self.package.ExactFormer(*self._grid(side, scene.grid.spacing_m), **options)
                image[rows, columns] = former(scene.history.transfer).T
            spent = time.process_time() - begin
            return image[*scene.checks], compression, max(0.0, spent - len(tiles) * compression)

        share = share_of(scene, tiles)
        return Contestant("fastsar exact", "cubic, 8×", scene, run, share, from_echoes=True)

    def points(self, limit_s: float) -> Contestant:
        """Return the bistatic backprojection of the centres of the fields; the cost grows with their number."""
        scene, sample = self.scene, scene_points(self.scene)
        predicted = _POINT_S * sample.shape[0] * sample.shape[1] * sample.shape[2] * len(scene.history)
        if predicted > PATIENCE * limit_s:
            raise SkippedError(f"the smallest representative part takes {predicted:.0f} s")
        legs = [leg - self.middle for leg in scene.history.aperture.legs]
        options = {"rcv": legs[1], "ref": self.one_way_m, "backend": "cpu", "window": False}

        def run() -> tuple[Image, float, float]:
            compression = self._compression(8)
            begin = time.process_time()
            image = self.package.backproject(
                scene.history.transfer, legs[0], *self.sampling, sample - self.middle, **options
            )
            spent = time.process_time() - begin
            full = np.zeros(scene.grid.shape, np.complex64)
            for window, part in zip(scene.inner, image.reshape(sample.shape[:3]), strict=True):
                full[window] = part
            return full[*scene.checks], compression, max(0.0, spent - compression)

        return Contestant("fastsar points", "8×", scene, run, share_of(scene, scene.inner), from_echoes=True)

    def _grid(self, size: int, spacing_m: float) -> tuple[Any, ...]:
        antenna = self.scene.history.aperture.tx_m - self.middle
        return (antenna, *self.sampling, len(self.scene.history.frequency_hz), size, size, spacing_m, spacing_m, *_AXES)

    @property
    def _options(self) -> dict[str, Any]:
        return {"backend": "cpu", "window": False, "ref": self.one_way_m}

    def _compression(self, upsample: int) -> float:
        """Return CPU seconds of the range compression of fastsar with its chunk size."""
        history = self.scene.history.transfer
        begin = time.process_time()
        for first in range(0, len(history), 256):
            self.compress(history[first : first + 256], upsample * history.shape[1])
        return time.process_time() - begin


def scene_points(scene: Scene) -> NDArray[np.float64]:
    """Return positions of the pixels at the centres of fields, (field, row, column, 3) metres."""
    return np.stack([scene.ground.positions(scene.grid[window]) for window in scene.inner])
