"""Prediction of error and cost for settings of the GPU kernel, and sizes and bounds compiled into the kernel."""

import os
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np

from apertura.core.backprojection.engines.engine import (
    Setting,
    option_values,
    power_sum_db,
)
from apertura.core.backprojection.engines.native import OVERSAMPLINGS, TOLERANCES_RAD, View, view_of
from apertura.core.backprojection.engines.native_binding import KERNEL
from apertura.core.backprojection.engines.range_interpolation import design_table, ratio
from apertura.core.backprojection.job import Job

SIDE = KERNEL.patch_side
"""Number of pixels along a patch, which is summed by one thread block; tiles start at multiples of this number."""


TAPS = KERNEL.taps
"""Number of taps of the table filters."""


DEGREE = 2
"""Degree of the polynomials in a cell. Degree 1 would save two of six look-ups but require 1.7 times as many cells."""


CHUNK = 64
"""Number of pulses summed in float32; the partial sums are added in float64."""


LAST_ORDER, LAST_TERM = 6, 21 / 1024
"""First order of √(1 + s) that is neglected in eq. 8, and its coefficient. The sum of all neglected terms is at most
this term divided by 1 − |s|."""


FARTHEST = 0.5
"""Largest |s| at which the series is used; for larger |s|, the error bound is too loose."""


FLOAT32_ERROR, FLOAT32_RMS = 2.5e-7, 3.2e-8
"""Float32 error of eq. 8 relative to D: bound, and RMS over 20 000 random pixels at each of five ranges."""


MOST_CELLS = 2.0**20
"""Number of cells across a patch, above which float32 cannot resolve adjacent cells."""


ANGLE_ERROR, ANGLE_RMS = 1e-6, 2e-7
"""Float32 error of the angle of a pixel in a cut, rad: bound, and RMS."""


PLACE_ERROR, PLACE_RMS = 3e-7, 3.2e-8
"""Float32 error of s in docs/theory/integration.md, eq. 1, relative to D/R: bound, and RMS."""


def simulated() -> bool:
    """Return True if the simulator of numba, which is thousands of times slower, replaces the device, as in tests.

    Examples
    --------
    >>> simulated()
    False
    """
    return os.environ.get("NUMBA_ENABLE_CUDASIM", "0") not in ("", "0")


@cache
def device_rates() -> tuple[float, float]:
    """Return the float32 and float64 rates of the device relative to an H200, from its number of units and its clock.

    Examples
    --------
    >>> device_rates() > (0, 0)
    True
    """
    if simulated():
        return 1.0, 1.0
    from numba import cuda

    if not cuda.is_available():
        return 1.0, 1.0
    device = cuda.get_current_device()
    major, minor = device.compute_capability
    units = 64 if (major, minor) in _HALF_UNITS else 128  # float32 units of a multiprocessor
    single = device.MULTIPROCESSOR_COUNT * units * device.CLOCK_RATE / _H200
    return single, single * (1 if (major, minor) in _FAST_DOUBLES else 1 / 32)


_HALF_UNITS = {(6, 0), (7, 0), (7, 2), (7, 5), (8, 0)}
_FAST_DOUBLES = {(6, 0), (7, 0), (8, 0), (9, 0), (10, 0)}  # half the rate of float32; other devices: 1/64
_H200 = 132 * 128 * 1.98e6  # multiprocessors, float32 units, clock in kHz


# ratio of RMS to maximum of a sixth power along the diagonal of a square patch, √(2/13 − 2/14)
_WORST_TO_RMS = 0.105


_FLOAT32_RAD = 2e-6  # rounding error of tables and look-ups, as in native


_NO_ERROR = 1e-20  # added before taking a logarithm


# Seconds measured on an NVIDIA H200 (docs/theory/engine.md, "A GPU"). On other devices, the first four are divided by
# `device_rates`.
_PIXEL_S, _EXACT_S = 2.6e-12, 7.9e-12  # per pixel and pulse: by the series, by exact paths


_SECTOR_S, _BEAM_S = 6e-12, 1e-11  # additional time at the edge of a sector and for each beam


_CELL_S, _SAMPLE_S = 2e-11, 1.2e-9  # per pulse and coefficient of a cell; per pulse and sample


_PLACE_S = 6e-9  # per pixel: transfer of position and sum


_TILE_S = 1e-2  # per tile: copies, launch, and multiprocessors without work at the end of the kernel


_START_S = 2.0  # import of numba.cuda and first kernel, if the kernels were compiled in an earlier run; else 7


_SIMULATED_S = 1e-4  # per pixel and pulse in the simulator, and half of that per weight (measured)


def candidates(job: Job, *, pulses: int, requested: Mapping[str, Any]) -> Iterator[Setting]:
    """Yield settings of the GPU engine, as described in `apertura.core.backprojection.engines.engine.Engine`.

    Notes
    -----
    Source: docs/theory/engine.md, "A GPU".
    """
    view = view_of(job)
    weights = weights_error(job, view)
    for oversampling in option_values(requested, "oversampling", OVERSAMPLINGS[DEGREE]):
        for tolerance_rad in option_values(requested, "tolerance_rad", TOLERANCES_RAD):
            yield _setting(job, view, weights, pulses, oversampling, tolerance_rad)


def series(view: View, *, wavenumber_rad_m: float, tolerance_rad: float) -> tuple[float, float]:
    """Return the fraction of patch-pulse pairs with exact paths, and the phase error of all paths.

    Parameters
    ----------
    view
        Imaging geometry of the scene.
    wavenumber_rad_m
        2πf_mid/c.
    tolerance_rad
        Largest tolerated phase error of the path series.

    Returns
    -------
    exact : float
        Fraction of patch-pulse pairs.
    error_rad : float
        RMS phase error over patches, pulses and pixels, rad.

    Examples
    --------
    >>> near, far = (View(np.full((2, 1, 1), m), np.full((2, 1, 1), 0.05), 0.05) for m in (1.0, 100.0))
    >>> limits = {"wavenumber_rad_m": 25.0, "tolerance_rad": 1e-3}
    >>> series(near, **limits)[0], series(far, **limits)[0]
    (1.0, 0.0)
    """
    reach = np.sqrt(2) * (SIDE - 1) / 2 * view.spacing_m
    most = reach * (2 * view.range_m + reach) / view.range_m**2
    within = np.minimum(most, FARTHEST)
    neglected = (LAST_TERM * view.range_m * within**LAST_ORDER / (1 - within)).sum(axis=0)
    worst = wavenumber_rad_m * (neglected + 2 * FLOAT32_ERROR * reach)
    uses_series = (worst <= tolerance_rad) & (most.max(axis=0) < FARTHEST)
    error = wavenumber_rad_m * np.hypot(_WORST_TO_RMS * neglected, np.sqrt(2) * FLOAT32_RMS * reach)
    return float(1 - uses_series.mean()), float(np.sqrt((np.where(uses_series, error, 0.0) ** 2).mean()))


def weights_error(job: Job, view: View) -> float:
    """Return the RMS float32 error of weights, relative to a weight of one.

    Parameters
    ----------
    job
        Job with beams and sector.
    view
        Imaging geometry of the scene.

    Notes
    -----
    Source: docs/theory/engine.md, "A GPU": angle errors multiplied by the steepest slopes of the cuts, and error of s
    divided by the width of the sector's edge.
    """
    if job.beams is None:
        return 0.0
    slopes = [beam.steepest for beam in (job.beams.transmit, job.beams.receive) if beam is not None]
    squared = (ANGLE_RMS * np.linalg.norm(slopes)) ** 2
    if job.sector is not None:
        reach = np.sqrt(2) * (SIDE - 1) / 2 * view.spacing_m
        error = PLACE_RMS * (reach / view.range_m.min() + 2 * job.sector.half)
        squared += view.weights.edge * (1.5 * error / (job.sector.outer - job.sector.inner)) ** 2
    return float(np.sqrt(squared))


def _pixel_seconds(view: View, exact: float) -> float:
    """Return the predicted seconds per pixel and summed pulse."""
    weights = view.weights
    if simulated():
        return (1 - weights.dark) * (1 + (weights.antennas + weights.edge) / 2) * _SIMULATED_S
    single, double = device_rates()
    series_s = (_PIXEL_S + weights.antennas * _BEAM_S + weights.edge * _SECTOR_S) / single
    exact_s = _EXACT_S * (1 + weights.antennas + weights.edge) / double
    return (1 - weights.dark) * ((1 - exact) * series_s + exact * exact_s)


def _setting(job: Job, view: View, weights: float, pulses: int, oversampling: int, tolerance_rad: float) -> Setting:
    signal, k = job.signal, job.signal.wavenumber_rad_m
    design = design_table(signal.oversampling, k * signal.step_m, oversampling=oversampling, degree=DEGREE)
    table_db = design.error_db(signal.window)
    exact, path_rad = series(view, wavenumber_rad_m=k, tolerance_rad=tolerance_rad)
    paths_db = 20 * np.log10(path_rad + _FLOAT32_RAD)
    weights_db = 20 * np.log10(weights + _NO_ERROR)
    weighted = f", weights {weights_db:.1f} dB" if job.weights else ""
    up, down = ratio(signal.oversampling, oversampling)
    coefficients = pulses * ((signal.samples - 1) * up // down + 1) * (DEGREE + 1)
    # Threads share the device: the time of the device does not depend on their number.
    device_s = job.pixels * pulses * job.share * _pixel_seconds(view, exact) + job.tiles * _TILE_S
    return Setting(
        "cuda",
        {"oversampling": oversampling},
        {"tolerance_rad": tolerance_rad},
        power_sum_db(table_db, paths_db, weights_db),
        device_s * min(job.threads, job.tiles) + job.pixels * _PLACE_S,
        table_seconds=_START_S + _CELL_S * coefficients + _SAMPLE_S * pulses * signal.samples,
        table_bytes=8 * coefficients,
        reasons={
            "oversampling": f"predicted errors: table {table_db:.1f} dB, paths {paths_db:.1f} dB{weighted}",
            "tolerance_rad": f"exact float64 paths for {100 * exact:.0f} % of pixel-pulse pairs",
        },
    )
