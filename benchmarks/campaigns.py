"""Random small campaigns as arrays, test cases of the planner: ranges 30 m to 10 km, carriers 0.4 to 10 GHz."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.job import Job
from apertura.core.echo.compression import window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.job import imaging_job
from apertura.core.imaging.range_profiles import GUARD_SAMPLES, OVERSAMPLING, range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import swath
from apertura.core.scene.terrain import FlatGround, GroundModels
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers

FLAT = FlatGround(0.0)


@dataclass(frozen=True)
class Drawn:
    """Random campaign: its echo, its grid and the requested accuracy."""

    name: str
    history: PhaseHistory
    profiles: Profiles
    grid: SceneGrid
    job: Job
    accuracy_db: float


def draw(generator: np.random.Generator, *, pixels: int = 80, pulses: int = 160) -> Drawn:
    """Draw all parameters of a campaign and simulate the campaign."""

    def between(low: float, high: float) -> float:
        return float(np.exp(generator.uniform(np.log(low), np.log(high))))

    carrier, range_m = between(0.4e9, 10e9), between(30, 10e3)
    bandwidth = min(between(50e6, 600e6), 0.4 * carrier)
    wavelength = C / carrier
    spacing = min(between(wavelength / 8, 1.0), range_m / pixels)
    grid = SceneGrid("local", 0.0, pixels * spacing, spacing, (pixels, pixels - 7))
    tx, rx = _fly(
        generator, grid, range_m, wavelength, pulses=pulses, step_m=between(wavelength / 60, range_m / pulses)
    )
    window = str(generator.choice(["hann", "none"]))
    history = _record(generator, grid, tx, rx, carrier_hz=carrier, bandwidth_hz=bandwidth, window=window)
    accuracy = float(generator.choice([-50.0, -60.0, -70.0, -80.0]))
    profiles = compressed(history, grid, window)
    name = f"{carrier / 1e9:.2f} GHz, {range_m:.0f} m, spacing {spacing:.3g} m, {window}, {accuracy:.0f} dB"
    ground = GroundModels.flat(0.0)
    job = imaging_job(history.aperture, history.frequency_hz, history.weight, grid, ground, integration="all")
    return Drawn(name, history, profiles, grid, job, accuracy)


def _fly(
    generator: np.random.Generator,
    grid: SceneGrid,
    range_m: float,
    wavelength_m: float,
    *,
    pulses: int,
    step_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    look, heading = np.radians(generator.uniform(25, 70)), generator.uniform(0, 2 * np.pi)
    middle = np.array([grid.x_m.mean(), grid.y_m.mean(), 0.0])
    away = np.array([np.cos(heading), np.sin(heading), 0.0])
    ahead = np.array([-away[1], away[0], 0.0])
    start = middle - range_m * np.sin(look) * away + [0.0, 0.0, range_m * np.cos(look)]
    along = step_m * (np.arange(pulses) - pulses / 2 + generator.uniform(-0.2, 0.2) * pulses)

    def wobble() -> NDArray[np.float64]:
        phase_rad = generator.uniform(0.5, 3, (3, 3)) * np.linspace(0, 2 * np.pi, pulses)[:, None, None]
        size = generator.uniform(0, 0.2) * wavelength_m
        return size * np.sin(phase_rad + generator.uniform(0, 6, (3, 3))).sum(-1)

    tx = start + along[:, None] * ahead + wobble()
    if generator.random() < 0.4:
        return tx, tx
    separation = generator.uniform(-0.3, 0.3, 3) * range_m * [1, 1, 0.2]
    return tx, start + separation + 0.9 * along[:, None] * ahead + wobble()


def _record(
    generator: np.random.Generator,
    grid: SceneGrid,
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    *,
    carrier_hz: float,
    bandwidth_hz: float,
    window: str,
) -> PhaseHistory:
    near, far = swath(grid, FLAT, Aperture(tx, rx))
    cells = (far - near).max() * bandwidth_hz / C + 2 * GUARD_SAMPLES / OVERSAMPLING
    count = int(np.ceil(1.2 * cells)) + 16
    frequency = carrier_hz + bandwidth_hz * (np.arange(count) / count - 0.5)
    targets = generator.integers(1, 25)
    rows, columns = (generator.uniform(0, size - 1, targets) for size in grid.shape)
    places = grid.positions_at(rows, columns, 0.0)
    gains = generator.standard_normal(targets) + 1j * generator.standard_normal(targets)
    flown = Aperture(tx, rx)
    echoes = transfer(Scatterers(places, gains), flown, frequency, longer_m=-near, spreading=False)
    noise = 10 ** (generator.uniform(-60, 10) / 20)
    white = generator.standard_normal(echoes.shape) + 1j * generator.standard_normal(echoes.shape)
    weights = window_weights(window, count)
    return PhaseHistory((echoes + noise * white).astype(np.complex64), frequency, weights, near / C, flown)


def compressed(history: PhaseHistory, grid: SceneGrid, window: str) -> Profiles:
    """Range-compress an echo with a window, as in the profile step."""
    weighted = replace(history, weight=window_weights(window, len(history.frequency_hz)))
    return range_compress(weighted, grid, FLAT)
