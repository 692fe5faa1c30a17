"""Measures the constants of the cost model on this machine, on small made-up jobs."""

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from apertura.antenna.beam import Beam, Beams
from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.focus.engines import ENGINES, native, numba, reference
from apertura.focus.inputs import Profiles, Spectra
from apertura.focus.presum import design, thin
from apertura.geometry.geodesy import LOCAL
from apertura.planning.cost import Costs
from apertura.planning.machine import default_costs, machine
from apertura.scene.grid import SceneGrid

BANDWIDTH_HZ, CENTRE_HZ = 400e6, 1.2e9
_SPACINGS_M = {"shared": 0.03, "wide": 0.18, "exact": 1.5}
"""Pixel spacing at which native takes each form: see `view.forms`."""


def measure_costs(*, repeats: int = 3, size: int = 160, pulses: int = 256) -> Costs:
    """Return the cost model's constants, each the least of some repeats; about ten seconds.

    Parameters
    ----------
    repeats
        Least of that many: other work on the machine only adds.
    size, pulses
        Pixels along a side and pulses of the jobs that are timed.
    """
    found = dict(default_costs(machine()).seconds)

    def least(work: Callable[[], object]) -> float:
        return min(_timed(work) for _ in range(repeats))

    profiles, grid = _job(size, pulses, _SPACINGS_M["shared"])
    pixels, work = grid.positions(0.0), size * size * pulses
    if ENGINES["native"].available():
        found |= _native_costs(least, size=size, pulses=pulses)
        found |= _beam_costs(least, profiles, pixels)
    fine = numba.prepare(profiles, oversampling=8)
    numba.form(fine, pixels[:2, :2])  # compile
    found["numba.table"] = least(lambda: numba.prepare(profiles, oversampling=8)) / fine.samples.size
    found["numba.pixel"] = least(lambda: numba.form(fine, pixels[: size // 4])) / (work / 4)
    beams, some = _beams(profiles, pixels, np.ones(2)), pixels[:8, :32].reshape(-1, 3)
    centres = (profiles.tx_position_m, profiles.rx_position_m)
    found["weight"] = least(lambda: beams.weight(*centres, some)) / (2 * len(some) * pulses)
    found["reference.subcarrier"] = _reference_cost(least, profiles, pixels)
    found["place.local"] = least(lambda: grid.positions(0.0)) / grid.shape[0] / grid.shape[1]
    placed = SceneGrid("EPSG:32632", 5e5, 5.3e6, 0.1, grid.shape)
    found["place.ecef"] = least(lambda: placed.positions(0.0)) / grid.shape[0] / grid.shape[1]
    presum = design(pulses, 4, widest_cycles=0.01)
    if presum is not None:
        found["thin"] = least(lambda: thin(profiles, presum, pixels[size // 2, size // 2])) / profiles.samples.size
    return Costs(found, f"measured on this machine ({machine()})")


def _timed(work: Callable[[], object]) -> float:
    begin = perf_counter()
    work()
    return perf_counter() - begin


def _native_costs(least: Callable[[Callable[[], object]], float], *, size: int, pulses: int) -> dict[str, float]:
    found = {}
    for name, spacing_m in _SPACINGS_M.items():
        profiles, grid = _job(size, pulses, spacing_m)
        pixels = grid.positions(0.0)
        for degree in (1, 2):
            tables = native.prepare(profiles, oversampling=6, degree=degree)
            # The curvature of a patch does not decide here, only its windows.
            seconds = least(lambda tables=tables, pixels=pixels: native.form(tables, pixels, tolerance_rad=0.5))  # type: ignore[misc]
            found[f"native.{name}.{degree}"] = seconds / (size * size * pulses)
        if name == "wide":
            tables = native.prepare(profiles, oversampling=6)
            seconds = least(lambda profiles=profiles: native.prepare(profiles, oversampling=6))  # type: ignore[misc]
            found["native.table"] = seconds / (tables.cells.size / 2)
    return found


def _beam_costs(
    least: Callable[[Callable[[], object]], float], profiles: Profiles, pixels: NDArray[np.float64]
) -> dict[str, float]:
    """Time weights of two antennas: as a polynomial over each patch, pixel by pixel, and outside the pattern."""
    tables, work = native.prepare(profiles, oversampling=6), len(profiles.samples) * pixels[..., 0].size
    ahead = _beams(profiles, pixels, np.ones(2))
    behind = (beam and replace(beam, axes=-beam.axes) for beam in (ahead.transmit, ahead.receive))
    patterns = {
        "beam": _beams(profiles, pixels, np.cos(np.linspace(-1, 1, 129))),
        "edge": _beams(profiles, pixels, np.tile([0.0, 1.0], 129)),
        "dark": Beams(*behind),
    }
    plain = least(lambda: native.form(tables, pixels)) / work
    found = {
        f"native.{name}": least(lambda beams=beams: native.form(tables, pixels, beams=beams)) / work  # type: ignore[misc]
        for name, beams in patterns.items()
    }
    return found | {"native.beam": max(found["native.beam"] - plain, 0.1 * plain)}


def _beams(profiles: Profiles, pixels: NDArray[np.float64], gain: NDArray[np.float64]) -> Beams:
    """Return two antennas that look at the middle of the pixels, with a gain over ±50° of azimuth."""
    angle, level = np.linspace(-1, 1, 2) * np.radians(50), np.ones(2)
    across = np.linspace(angle[0], angle[1], len(gain))

    def one(position_m: NDArray[np.float64]) -> Beam:
        ahead = pixels[pixels.shape[0] // 2, pixels.shape[1] // 2] - position_m
        ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right, axis=-1, keepdims=True)
        return Beam(np.stack([ahead, right, np.cross(right, ahead)], 1), across, gain, angle, level)

    return Beams(one(profiles.tx_position_m), one(profiles.rx_position_m))


def _reference_cost(
    least: Callable[[Callable[[], object]], float], profiles: Profiles, pixels: NDArray[np.float64]
) -> float:
    pulses, subcarriers, some = 32, 256, pixels[:8, :32]
    spectra = Spectra(
        np.ones((pulses, subcarriers), np.complex64),
        CENTRE_HZ + BANDWIDTH_HZ * (np.arange(subcarriers) / subcarriers - 0.5),
        np.full(subcarriers, 1 / subcarriers),
        np.zeros(pulses),
        profiles.tx_position_m[:pulses],
        profiles.rx_position_m[:pulses],
    )
    return least(lambda: reference.form(spectra, some)) / (pulses * subcarriers * some[..., 0].size)


def _job(size: int, pulses: int, spacing_m: float) -> tuple[Profiles, SceneGrid]:
    """Return noise seen from a straight track, far enough that a patch shares one curvature."""
    grid = SceneGrid(LOCAL, -size * spacing_m / 2, size * spacing_m / 2, spacing_m, (size, size))
    range_m = 60.0 * max(1.0, spacing_m / 0.1)
    along = np.linspace(-0.1, 0.1, pulses) * range_m
    tx = np.stack([np.full(pulses, -0.8 * range_m), along, np.full(pulses, 0.6 * range_m)], -1)
    rx = tx + [0.0, 0.02 * range_m, 0.0]
    corners = grid.positions(0.0)[[0, 0, -1, -1], [0, -1, 0, -1]]
    path = sum(np.linalg.norm(corners - antenna[:, None], axis=-1) for antenna in (tx, rx))
    step = SPEED_OF_LIGHT_M_S / BANDWIDTH_HZ / 2
    start = np.asarray(path).min(axis=1) - 20 * step - 2 * spacing_m
    count = int(np.ceil((np.asarray(path).max(axis=1) - start).max() / step)) + 40
    generator = np.random.default_rng(0)
    samples = generator.standard_normal((pulses, count, 2)).astype(np.float32).view(np.complex64)[..., 0]
    profiles = Profiles(samples, start, step, CENTRE_HZ, 2.0, tx, rx)
    return profiles, grid
