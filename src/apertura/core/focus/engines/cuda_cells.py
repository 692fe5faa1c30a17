"""What makes tables of profiles on a GPU; imported only where that is done, as `cuda_kernels`."""

import numpy as np
from numba import cuda

from apertura.core.focus.engines.cuda_constants import TAPS


@cuda.jit
def expand(samples, taps, lead, down, carrier, turn, cells):  # type: ignore[no-untyped-def]  # noqa: PLR0917
    """Fill cells (pulse, 6, cell) from samples (pulse, range): one thread a cell, (2)."""
    used, length, up = cells.shape[2], samples.shape[1], len(lead)
    number = cuda.grid(1)
    if number >= len(samples) * used:
        return
    p, i = number // used, number % used
    position = i % up
    first = i // up * down + lead[position]
    phase = carrier[i] * turn[p]
    level, slope, curvature = np.complex64(0), np.complex64(0), np.complex64(0)
    for tap in range(TAPS):
        n = first + tap
        if 0 <= n < length:
            sample = samples[p, n]
            level += sample * taps[position, 0, tap]
            slope += sample * taps[position, 1, tap]
            curvature += sample * taps[position, 2, tap]
    level, slope, curvature = level * phase, slope * phase, curvature * phase
    cells[p, 0, i], cells[p, 1, i] = level.real, level.imag
    cells[p, 2, i], cells[p, 3, i] = slope.real, slope.imag
    cells[p, 4, i], cells[p, 5, i] = curvature.real, curvature.imag
