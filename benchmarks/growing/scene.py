"""Scenes of clutter and noise whose aperture grows with the image.

The flight goes back and forth next to the image over the full width of the image; its height and distance, 10 m and 5 m
at 512 pixels of 5 cm, grow with the image, except for geometry `low`, where they are constant. Geometry `spotlight` is
a straight flight at 10 km.

Fields of clutter are spread over the tiles of the image, one per row and column of tiles; every sample contains noise
of equal power, so that errors of single pulses are as large as the planner predicts. Compared pixels are in the fields,
so that the error is not dominated by a few bright pixels.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from job import _wobble
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.backprojection.engines import reference
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, GridHeights, Terrain
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers

Geometry = Literal["monostatic", "bistatic", "low", "spotlight"]
Surface = Literal["flat", "smooth", "rough"]
Window = tuple[slice, slice]

TILE_PX, FIELD_PX, INNER_PX = 512, 64, 32
_FIELDS, _CHECKS, _SCATTERER_PX = 16, 40, 4


@dataclass(frozen=True, eq=False)
class Scene:
    """Simulated scene with its echoes.

    Attributes
    ----------
    geometry, surface
        Kinds of flight and terrain.
    history
        Transfer functions, with the delay of the scene centre removed.
    grid, ground
        Grid and terrain of the image, in a local frame.
    fields
        Windows of clutter.
    checks, exact
        Rows and columns of the compared pixels, (2, check), and the double sum over pulses and subcarriers at these
        pixels, (check,) complex128.
    """

    geometry: Geometry
    surface: Surface
    history: PhaseHistory
    grid: SceneGrid
    ground: Terrain
    fields: list[Window]
    checks: NDArray[np.int64]
    exact: NDArray[np.complex128]

    @property
    def inner(self) -> list[Window]:
        """Windows of the compared pixels, at the centre of each field."""
        return [_inner(field) for field in self.fields]

    @property
    def size(self) -> int:
        """Pixels per side."""
        return self.grid.shape[0]

    @property
    def name(self) -> str:
        """Size, pulses, geometry and terrain."""
        return f"{self.size}² × {len(self.history)}, {self.geometry}, {self.surface}"

    def tiles(self, every: int) -> list[Window]:
        """Return one tile in `every`, evenly over the columns; all sets are nested and contain the fields."""
        return _tiles(self.size, every)

    def error_db(self, value: NDArray[np.complex64]) -> float:
        """Return the RMS error of the image at the checks, after one complex gain, dB."""
        value = value.astype(np.complex128)
        gain = np.vdot(value, self.exact) / np.vdot(value, value)
        return float(20 * np.log10(np.linalg.norm(gain * value - self.exact) / np.linalg.norm(self.exact)))


def build(size: int, pulses: int, geometry: Geometry, surface: Surface, *, noise_db: float = 0.0) -> Scene:
    """Simulate a scene; `noise_db` is the noise power of the image relative to its clutter."""
    generator = np.random.default_rng(1)
    flight, spacing_m, west_m, centre_hz, cell_m = _flight(geometry, size, pulses, generator)
    half_m = size * spacing_m / 2
    grid = SceneGrid("local", west_m, half_m, spacing_m, (size, size))
    ground = _ground(grid, surface, generator)
    edge = grid.sample_points(17, 0.0).reshape(-1, 3)
    ends = flight[flight.sample(512)].path(edge)
    subcarriers = _round_up(1.1 * np.ptp(ends, axis=1).max() / cell_m + 40)
    step_hz = C / cell_m / subcarriers
    frequency = centre_hz + step_hz * (np.arange(subcarriers) - (subcarriers - 1) / 2)
    middle = grid.positions_at([size // 2], [size // 2], 0.0)
    delay = flight.path(middle)[:, 0] / C
    fields = _fields(size, generator)
    clutter = _clutter(_places(fields, grid, ground, generator), generator)
    echoes = transfer(clutter, flight, frequency, longer_m=-C * delay, spreading=False, gridded=True)
    weight = np.full(subcarriers, 1 / subcarriers)
    history = PhaseHistory(echoes, frequency, weight, delay, flight)
    inside = generator.integers(0, INNER_PX, (_FIELDS, _CHECKS, 2))
    corner = np.array([(rows.start, columns.start) for rows, columns in map(_inner, fields)])
    checks = (corner[:, None] + inside).reshape(-1, 2).T
    places = ground.positions_at(grid, *checks)
    power = np.mean(np.abs(reference.form(history, places[::10])) ** 2) / pulses**2
    amplitude = np.float32(np.sqrt(power * pulses * subcarriers * 10 ** (noise_db / 10) / 2))
    for first in range(0, pulses, 64):
        part = echoes[first : first + 64]
        part += amplitude * generator.standard_normal((len(part), 2 * subcarriers), np.float32).view(np.complex64)
    return Scene(geometry, surface, history, grid, ground, fields, checks, reference.form(history, places))


def _flight(
    geometry: Geometry, size: int, pulses: int, generator: np.random.Generator
) -> tuple[Aperture, float, float, float, float]:
    """Return the flight, the pixel spacing, the west edge of the image, the carrier and the cell c/B of total path."""
    if geometry == "spotlight":  # 10 km distance, grazing angle 30°: resolution 0.3 m along and across
        wavelength, spacing_m = C / 9.6e9, 0.2
        along = np.linspace(-0.5, 0.5, pulses) * 1e4 * wavelength / 0.6
        track = np.stack([np.full(pulses, -1e4 * np.cos(np.pi / 6)), along, np.full(pulses, 5e3)], -1)
        return Aperture(track, track), spacing_m, -size * spacing_m / 2, 9.6e9, 0.6
    spacing_m, wavelength = 0.05, C / 1.2e9
    scale, length = 1.0 if geometry == "low" else size / 512, 1.25 * size * spacing_m
    travelled = np.arange(pulses) * wavelength / 8
    passes = max(1.0, travelled[-1] / length)
    along = np.abs(np.remainder(travelled, 2 * length) - length) - length / 2
    along += 0.5 * (length - travelled[-1]) if passes == 1 else 0.0
    drift = np.linspace(-0.5, 0.5, pulses) * (passes - 1)
    wobble = [_wobble(generator, pulses, sigma) for sigma in (0.05, 0.02, 0.05, 0.05, 0.02, 0.05)]
    tx = [wobble[0] - drift * scale, along + wobble[1], (10 + drift) * scale + wobble[2]]
    rx = [
        -1.5 * scale + along / 7.5 + wobble[3],
        6 * scale + 0.8 * along + wobble[4],
        13 * scale + along / 30 + wobble[5],
    ]
    legs = [np.stack(leg, -1) for leg in (tx, rx if geometry == "bistatic" else tx)]
    return Aperture(*legs), spacing_m, 5 * scale, 1.2e9, C / 409.6e6


def _ground(grid: SceneGrid, surface: Surface, generator: np.random.Generator) -> Terrain:
    """Return flat terrain, or relief of 1 m over 8 m, smooth or with a roughness of 1 cm RMS over a quarter metre."""
    if surface == "flat":
        return FlatGround(0.0)
    heights = np.sin(grid.x_m / 8) * np.cos(grid.y_m[:, None] / 10)
    if surface == "rough":
        rough = gaussian_filter(generator.standard_normal(grid.shape), 0.25 / grid.spacing_m)
        heights += 0.01 * rough / rough.std()
    return GridHeights(grid, heights)


def _tiles(size: int, every: int) -> list[Window]:
    count = -(-size // TILE_PX)
    chosen = [(r, c) for r in range(count) for c in range(count) if (r + 5 * c) % min(every, count) == 0]
    return [tuple(slice(at * TILE_PX, min(size, (at + 1) * TILE_PX)) for at in tile) for tile in chosen]  # type: ignore[misc]


def _fields(size: int, generator: np.random.Generator) -> list[Window]:
    """Draw separate windows, equally many in each tile of the smallest set."""
    tiles, fields = _tiles(size, size), []
    for tile in tiles:
        first = np.stack(np.meshgrid(*(np.arange(part.start, part.stop, FIELD_PX) for part in tile)), -1).reshape(-1, 2)
        fields += generator.permutation(first)[: _FIELDS // len(tiles)].tolist()
    return [(slice(row, row + FIELD_PX), slice(column, column + FIELD_PX)) for row, column in fields]


def _inner(field: Window) -> Window:
    edge = (FIELD_PX - INNER_PX) // 2
    rows, columns = (slice(part.start + edge, part.stop - edge) for part in field)
    return rows, columns


def _places(
    fields: list[Window], grid: SceneGrid, ground: Terrain, generator: np.random.Generator
) -> NDArray[np.float64]:
    count = (FIELD_PX // _SCATTERER_PX) ** 2
    places = [(part.start + generator.uniform(-0.5, FIELD_PX - 0.5, count) for part in field) for field in fields]
    rows, columns = (np.concatenate(axis) for axis in zip(*places, strict=True))
    return ground.positions_at(grid, np.clip(rows, 0, grid.shape[0] - 1), np.clip(columns, 0, grid.shape[1] - 1))


def _clutter(places: NDArray[np.float64], generator: np.random.Generator) -> Scatterers:
    return Scatterers(places, generator.standard_normal((2, len(places))).T.copy().view(np.complex128)[:, 0])


def _round_up(count: float) -> int:
    """Round a number of subcarriers up to 2^a or 3·2^a."""
    power = 2 ** int(np.ceil(np.log2(count)))
    return power * 3 // 4 if power * 3 // 4 >= count else power
