"""Measures the constants of the cost model on this machine, on small made-up jobs."""

from collections.abc import Callable
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.image.cost import Costs, default_costs, machine
from apertura.image.engines import ENGINES, native, numba, reference
from apertura.image.grid import LOCAL, SceneGrid
from apertura.image.history import Profiles, Spectra
from apertura.image.thinning import design, thin

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
    pixels, work = grid.positions(), size * size * pulses
    if ENGINES["native"].available():
        found |= _native_costs(least, size=size, pulses=pulses)
    fine = numba.prepare(profiles, oversampling=8)
    numba.form(fine, pixels[:2, :2])  # compile
    found["numba.table"] = least(lambda: numba.prepare(profiles, oversampling=8)) / fine.samples.size
    found["numba.pixel"] = least(lambda: numba.form(fine, pixels[: size // 4])) / (work / 4)
    found["reference.subcarrier"] = _reference_cost(least, profiles, pixels)
    found["place.local"] = least(grid.positions) / grid.shape[0] / grid.shape[1]
    placed = SceneGrid("EPSG:32632", 5e5, 5.3e6, 0.1, grid.shape, 0.0)
    found["place.ecef"] = least(placed.positions) / grid.shape[0] / grid.shape[1]
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
        pixels = grid.positions()
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
    grid = SceneGrid(LOCAL, -size * spacing_m / 2, size * spacing_m / 2, spacing_m, (size, size), 0.0)
    range_m = 60.0 * max(1.0, spacing_m / 0.1)
    along = np.linspace(-0.1, 0.1, pulses) * range_m
    tx = np.stack([np.full(pulses, -0.8 * range_m), along, np.full(pulses, 0.6 * range_m)], -1)
    rx = tx + [0.0, 0.02 * range_m, 0.0]
    corners = grid.positions()[[0, 0, -1, -1], [0, -1, 0, -1]]
    path = sum(np.linalg.norm(corners - antenna[:, None], axis=-1) for antenna in (tx, rx))
    step = SPEED_OF_LIGHT_M_S / BANDWIDTH_HZ / 2
    start = np.asarray(path).min(axis=1) - 20 * step - 2 * spacing_m
    count = int(np.ceil((np.asarray(path).max(axis=1) - start).max() / step)) + 40
    generator = np.random.default_rng(0)
    samples = generator.standard_normal((pulses, count, 2)).astype(np.float32).view(np.complex64)[..., 0]
    profiles = Profiles(samples, start, step, CENTRE_HZ, 2.0, tx, rx)
    return profiles, grid
