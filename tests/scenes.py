"""Small radar scenes as arrays: straight flights over flat ground, rotated frames, antenna beams."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.antenna.beam import Beam, antenna_axes, gaussian_cut
from apertura.core.backprojection.engines import native, native_binding
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.job import Job, Signal
from apertura.core.geometry.aperture import Aperture
from apertura.core.planning.plan import Plan
from apertura.core.planning.planner import make_plan
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, GridHeights, GroundModels
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers

compiled = pytest.mark.skipif(not native.available(), reason="apertura was installed without a compiler")
WAVELENGTH = C / 1.2e9


def without_library(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate an installation without a compiler."""
    monkeypatch.setattr(native_binding, "library_path", lambda: Path("nowhere/_backprojection.so"))


# A straight flight along east, flat ground north of it


def ground_points(size_m: float = 10.0, *, north_m: float = 20.0, count: int = 5) -> NDArray[np.float64]:
    """Return (count, count, 3) points on flat ground north of the track, in rows from north to south."""
    east, north = np.meshgrid(np.linspace(-size_m / 2, size_m / 2, count), north_m + np.linspace(size_m, 0, count))
    return np.stack([east, north, 0 * east], -1)


def straight_track(
    pulses: int = 300, *, length_m: float = 6.0, height_m: float = 10.0, wobble_m: float = 0.0
) -> NDArray[np.float64]:
    """Return a (pulse, 3) eastward track at north 0; `wobble_m` is the amplitude of a vertical oscillation."""
    along = np.linspace(-length_m / 2, length_m / 2, pulses)
    return np.stack([along, 0 * along, height_m + wobble_m * np.sin(2 * np.pi * along / length_m * 3)], -1)


def monostatic(track_m: NDArray[np.float64]) -> Aperture:
    return Aperture(track_m, track_m)


def planning_job(**changes: Any) -> Job:
    """Return the planner's job for the straight flight, with 400 MHz at 1.2 GHz."""
    signal = Signal(1.2e9, 2.0, C / 800e6, 120)
    plain = Job(
        monostatic(straight_track()), ground_points(), (200, 200), 0.05, 1.2e9, 400e6, 512, signal, frame="local"
    )
    return replace(plain, **changes)


def plan(accuracy_db: float = -60.0, *, overrides: Mapping[str, Any] | None = None, **changes: Any) -> Plan:
    """Return the plan of the straight flight."""
    return make_plan(planning_job(**changes), accuracy_db=accuracy_db, overrides=overrides)


def ground_of(heights: NDArray[np.float64], level_m: float = 0.0) -> GroundModels:
    """Return terrain with one height per pixel of 5 cm."""
    grid = SceneGrid("local", 0.0, 10.0, 0.05, heights.shape)
    return GroundModels.of(GridHeights(grid, heights), FlatGround(level_m), grid)


TARGET = np.array([[1.25, -0.75, 0.0]])
TARGET_GRID = SceneGrid("local", -4.0, 4.0, 0.05, (160, 160))


def point_history(pulses: int = 96) -> PhaseHistory:
    """Return echoes of `TARGET` from a straight track 20 m south of the centre of `TARGET_GRID`."""
    frequency = 1.2e9 + 2e6 * np.arange(200)
    along = np.linspace(-4, 4, pulses)
    track = np.stack([along, np.full(pulses, -20.0), np.full(pulses, 10.0)], -1)
    flown = Aperture(track, track + [0.5, 0.0, 0.0])
    echo = transfer(Scatterers(TARGET, np.ones(1)), flown, frequency, spreading=False)
    return PhaseHistory(echo, frequency, np.full(200, 1 / 200), np.zeros(pulses), flown)


def strip_history(aperture: Aperture, targets_m: NDArray[np.float64], subcarriers: int = 64) -> PhaseHistory:
    """Return echoes of targets (target, 3) along any aperture, with a band of 96 MHz about 1.25 GHz."""
    frequency = 1.2e9 + 1.5e6 * np.arange(subcarriers)
    echo = transfer(Scatterers(targets_m, np.ones(len(targets_m))), aperture, frequency, spreading=False)
    weight = np.full(subcarriers, 1 / subcarriers)
    return PhaseHistory(echo, frequency, weight, np.zeros(len(aperture)), aperture)


UTM_GRID = SceneGrid("EPSG:32632", 500020.0, 5400060.0, 0.5, (70, 90))

# A curved bistatic flight in ECEF, with arbitrarily rotated axes

AXES, PLACE = np.linalg.qr(np.random.default_rng(4).standard_normal((3, 3)))[0], np.array([4.1e6, 0.9e6, 4.8e6])
SUBCARRIERS, BANDWIDTH_HZ = 128, 409.6e6
OFFSET_HZ = (np.arange(SUBCARRIERS) - (SUBCARRIERS - 1) / 2) * BANDWIDTH_HZ / SUBCARRIERS
GUARD = 12


def ecef(local: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert local east, north, up to ECEF: rotated axes reveal any dependence on their alignment."""
    return local @ AXES.T + PLACE


@dataclass(frozen=True)
class Scene:
    """A flight and the calibrated spectra of its echoes; positions in ECEF."""

    transfer: NDArray[np.complex64]
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    carrier_hz: float

    def path_m(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        return sum(np.linalg.norm(place - antenna[:, None], axis=-1) for antenna in (self.tx, self.rx))

    def history(self) -> PhaseHistory:
        silent = np.zeros(len(self.tx))
        frequency = self.carrier_hz + OFFSET_HZ
        return PhaseHistory(self.transfer, frequency, np.ones(SUBCARRIERS), silent, Aperture(self.tx, self.rx))

    def profiles(self, around: NDArray[np.float64]) -> Profiles:
        paths = self.path_m(around.reshape(-1, 3))
        step_m = C / BANDWIDTH_HZ / 2
        start = paths.min(1) - GUARD * step_m
        length = int(np.ceil((paths.max(1) - start).max() / step_m)) + GUARD
        at = start[:, None] + step_m * np.arange(length)
        phasors = np.exp(2j * np.pi * at[..., None] / C * OFFSET_HZ)
        samples = np.einsum("pln,pn->pl", phasors, self.transfer).astype(np.complex64)
        return Profiles(samples, start, step_m, self.carrier_hz, 2.0, Aperture(self.tx, self.rx))

    def exact(self, places: NDArray[np.float64]) -> NDArray[np.complex128]:
        delay = self.path_m(places) / C
        inner = np.einsum("pxn,pn->px", np.exp(2j * np.pi * delay[..., None] * OFFSET_HZ), self.transfer)
        return (inner * np.exp(2j * np.pi * self.carrier_hz * delay)).sum(0)


def fly(
    targets: NDArray[np.float64],
    *,
    pulses: int = 70,
    bistatic: bool = True,
    carrier_hz: float = 1.2e9,
    range_m: float = 12.0,
) -> Scene:
    """Return echoes of targets (local metres, around x = range_m) from a height and with an aperture of range_m."""
    along = np.linspace(-0.5, 0.5, pulses)[:, None] * range_m
    bend = np.sin(np.linspace(0, 7, pulses))[:, None]
    tx = ecef(np.hstack([0.03 * bend, along, range_m + 0.05 * bend]))
    rx = ecef(np.hstack([-1.5 + along / 7, 3 + 0.8 * along, 1.2 * range_m - 0.04 * bend])) if bistatic else tx.copy()
    return observed(targets, tx, rx, carrier_hz)


def observed(
    targets: NDArray[np.float64], tx: NDArray[np.float64], rx: NDArray[np.float64], carrier_hz: float
) -> Scene:
    """Return echoes of targets (local metres) of unit modulus from antennas in ECEF."""
    points = Scatterers(ecef(targets), np.exp(2j * np.pi * np.arange(len(targets)) * 0.618))
    return Scene(transfer(points, Aperture(tx, rx), carrier_hz + OFFSET_HZ, spreading=False), tx, rx, carrier_hz)


def pixel_grid(
    rows: int, columns: int, *, spacing_m: float = 0.05, turned_deg: float = 0.0, range_m: float = 12.0
) -> NDArray[np.float64]:
    """Return (y, x, 3) local pixels around (range_m, 0)."""
    across, along = np.meshgrid(
        spacing_m * (np.arange(columns) - columns / 2), spacing_m * (np.arange(rows) - rows / 2)
    )
    rotation_rad = np.radians(turned_deg)
    x, y = (
        across * np.cos(rotation_rad) - along * np.sin(rotation_rad),
        across * np.sin(rotation_rad) + along * np.cos(rotation_rad),
    )
    return np.stack([x + range_m, y, 0 * x], -1)


def scatter(pixels: NDArray[np.float64], count: int = 25) -> NDArray[np.float64]:
    """Return randomly chosen pixels as target positions."""
    return pixels.reshape(-1, 3)[np.random.default_rng(2).integers(0, pixels[..., 0].size, count)]


def error_db(scene: Scene, pixels: NDArray[np.float64], image: NDArray[np.complex64], count: int = 150) -> float:
    """Return the RMS error of random pixels, without removing a gain."""
    pick = np.random.default_rng(3).integers(0, image.size, count)
    truth = scene.exact(ecef(pixels).reshape(-1, 3)[pick])
    return decibels(image.ravel()[pick] - truth, truth)


def decibels(difference: NDArray[np.complexfloating], truth: NDArray[np.complexfloating]) -> float:
    return float(10 * np.log10(np.sum(np.abs(difference) ** 2) / np.sum(np.abs(truth) ** 2) + 1e-30))


# Antenna beams


def side_beam(
    width_deg: tuple[float, float] = (40.0, 60.0),
    *,
    boresight_deg: tuple[float, float] = (-90.0, -25.0),
    pulses: int = 300,
    cutoff_db: float = -20.0,
) -> Beam:
    """Return a beam to the left (north) of a body that flies east."""
    body = np.broadcast_to(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), (pulses, 3, 3))
    cuts = (
        gaussian_cut(w, cutoff_db=cutoff_db, limit_rad=x) for w, x in zip(width_deg, (np.pi, np.pi / 2), strict=True)
    )
    return Beam(antenna_axes(body, boresight_deg), *(part for cut in cuts for part in cut))


def swaying_beam(
    antenna: NDArray[np.float64], at: tuple[float, float, float], width_deg: float = 40.0, *, sway_deg: float = 15.0
) -> Beam:
    """Return a Gaussian beam (half-power width, cut off at negligible gain) pointed at one local point, with a sway."""
    boresight = ecef(np.array(at)) - antenna
    boresight /= np.linalg.norm(boresight, axis=-1, keepdims=True)
    sideways = np.cross(AXES[:, 2], boresight)
    sideways /= np.linalg.norm(sideways, axis=-1, keepdims=True)
    axes = np.stack([boresight, sideways, np.cross(boresight, sideways)], 1)
    sway = np.radians(sway_deg) * np.sin(np.arange(len(antenna)))
    rotation = np.zeros((len(antenna), 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(sway)
    rotation[:, 0, 1], rotation[:, 1, 0], rotation[:, 2, 2] = np.sin(sway), -np.sin(sway), 1
    edge = np.radians(2.2 * width_deg)
    angle = np.linspace(-edge, edge, 701)
    gain = np.exp(-2 * np.log(2) * (angle / np.radians(width_deg)) ** 2)
    return Beam(rotation @ axes, angle, gain, angle[150:-150], gain[150:-150])


def hard_beam(soft: Beam, half_deg: float) -> Beam:
    """Return a beam with the same axes and unit gain up to `half_deg`."""
    angle = np.radians([-half_deg, 0, half_deg])
    return Beam(soft.axes, angle, np.ones(3), angle, np.ones(3))
