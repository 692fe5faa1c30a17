"""Scenes of scatterers on flat ground, 18 m × 20 m: points, texture, weak points over clutter, speckle."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.core.scene.grid import SceneGrid
from apertura.simulation.scene import Scatterers

AREA_M = (-9.0, 5.0, 9.0, 25.0)
GRID = SceneGrid("local", -10.0, 26.0, 0.05, (440, 400))
CELL_M2 = 0.07 * 0.4
"""A resolution cell of the flight past the scene, roughly."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TargetScene(Scatterers):
    """Scatterers at places east, north and up, some of them targets.

    Attributes
    ----------
    targets
        (target,) int64, the scatterers whose peaks can be measured.
    """

    targets: NDArray[np.int64]


def _five(generator: np.random.Generator) -> TargetScene:
    places = np.array([(0, 5, 0), (-4, 10, 0), (0, 15, 0), (4, 20, 0), (0, 25, 0)], float)
    return TargetScene(places, _phases(5, generator), np.arange(5))


def _forty(generator: np.random.Generator) -> TargetScene:
    """Points within 20 dB at the receiver; the fifteen brightest are measured."""
    places = _spread(40, generator)
    level = 10 ** (generator.uniform(-20, 0, 40) / 20)
    amplitude = level * _phases(40, generator) * (np.hypot(places[:, 1], 10) / 18) ** 2
    return TargetScene(places, amplitude, np.argsort(-level)[:15])


def _texture(generator: np.random.Generator) -> TargetScene:
    """Clutter whose power is log-normal, in spots of half a metre."""
    clutter = _clutter(6000, generator)
    spots = generator.standard_normal((64, 64))
    waves = np.fft.fftfreq(64)[:, None] ** 2 + np.fft.fftfreq(64) ** 2
    spots = np.fft.ifft2(np.fft.fft2(spots) * np.exp(-waves * (0.7 / (20 / 64)) ** 2 * 2 * np.pi**2)).real
    low, size = np.array(AREA_M[:2]), np.array(AREA_M[2:]) - AREA_M[:2]
    east, north = ((clutter.position_m[:, :2] - low) / size * 63).astype(int).T
    return TargetScene(
        clutter.position_m, clutter.amplitude * np.exp(0.6 * spots / spots.std())[east, north], clutter.targets
    )


def _points_over_clutter(above_db: float) -> Callable[[np.random.Generator], TargetScene]:
    def scene(generator: np.random.Generator) -> TargetScene:
        """Eight points so far above the clutter of one cell."""
        clutter, places = _clutter(6000, generator), _spread(8, generator)
        places[:, 0] *= 0.8
        in_cell = CELL_M2 * 6000 / _area_m2()
        amplitude = 10 ** (above_db / 20) * np.sqrt(in_cell) * _phases(8, generator)
        return TargetScene(
            np.vstack([clutter.position_m, places]), np.append(clutter.amplitude, amplitude), 6000 + np.arange(8)
        )

    return scene


def _field(generator: np.random.Generator) -> TargetScene:
    """Speckle that goes on beyond the scene on all sides: no edge of it is seen."""
    return _clutter(60_000, generator, (-18.0, 1.0, 18.0, 37.0))


def _dense(generator: np.random.Generator) -> TargetScene:
    """Fully developed speckle: three scatterers in a cell, no point."""
    return _clutter(40_000, generator)


SCENES: Mapping[str, Callable[[np.random.Generator], TargetScene]] = {
    "five": _five,
    "forty": _forty,
    "texture": _texture,
    "clutter+10": _points_over_clutter(10.0),
    "clutter+20": _points_over_clutter(20.0),
    "dense": _dense,
    "field": _field,
}


def _clutter(
    count: int, generator: np.random.Generator, area_m: tuple[float, float, float, float] = AREA_M
) -> TargetScene:
    parts = generator.standard_normal((2, count)) / np.sqrt(2)
    return TargetScene(_spread(count, generator, area_m), parts[0] + 1j * parts[1], np.zeros(0, np.int64))


def _spread(count: int, generator: np.random.Generator, area_m: tuple[float, float, float, float] = AREA_M) -> Floats:
    east, north, far_east, far_north = area_m
    places = generator.uniform((east, north), (far_east, far_north), (count, 2))
    return np.concatenate([places, np.zeros((count, 1))], axis=1)


def _phases(count: int, generator: np.random.Generator) -> NDArray[np.complex128]:
    return np.asarray(np.exp(2j * np.pi * generator.random(count)))


def _area_m2() -> float:
    return (AREA_M[2] - AREA_M[0]) * (AREA_M[3] - AREA_M[1])
