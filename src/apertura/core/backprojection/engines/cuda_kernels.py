"""Kernels of the GPU: tables of profiles, and their sums over patches; imported only where that is done."""

import math
import warnings

import numpy as np
from numba import cuda

from apertura.core.backprojection.engines.cuda_prediction import (
    CHUNK,
    FARTHEST,
    FLOAT32_ERROR,
    LAST_ORDER,
    LAST_TERM,
    MOST_CELLS,
    SIDE,
    TAPS,
)

# ---- Tables of profiles on a GPU


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


# ---- Sums of tables over patches on a GPU
#
# numba compiles these functions for the device, or its simulator runs them as Python (NUMBA_ENABLE_CUDASIM=1).
# Literals are float64 to numba: float32 constants have names, since one literal would slow every pixel down.
# Equations are those of docs/theory/engine.md, "A GPU".

warnings.filterwarnings("ignore", "Grid size .* low occupancy")  # expected of the certificate's patches

ROWS = 4
"""Rows of threads of a patch: each thread sums every fourth pixel of a column, and reads their common values once."""

_PIXELS, _EACH = SIDE * SIDE, SIDE // ROWS
_SKIPPED, _SERIES, _EXACT = 0, 1, 2
_NO_CELL = 2**32 - 1
_ROUNDER = np.float32(1.5 * 2**23)  # adding and subtracting it rounds
_ONE, _NONE = np.float32(1), np.float32(0)
_B1, _B2, _B3, _B4 = np.float32(-1 / 4), np.float32(1 / 8), np.float32(-5 / 64), np.float32(7 / 128)  # of (8)
_LEG, _MIDDLE, _WORDS = 5, 10, 11  # of a pulse in shared memory: five numbers of each leg, and the origin's place
_PER_CELL, _WAVENUMBER, _TOLERANCE, _CELLS, _TURN = range(5)  # places in `numbers`


@cuda.jit
def form(pixels, antennas, start_m, cells, numbers, image):  # type: ignore[no-untyped-def]
    """Sum the cells over an image (y, x): a block of threads a patch, a thread four pixels of a column."""
    place = cuda.shared.array((3, _PIXELS), np.float64)
    patch = cuda.shared.array(4, np.float64)  # origin, reach
    words = cuda.shared.array((CHUNK, _WORDS), np.float32)
    steps = cuda.shared.array((CHUNK, 2), np.int32)  # way, cell of the origin
    near = cuda.local.array((_EACH, 4), np.float32)  # from the origin: x, y, z, squared
    total = cuda.local.array((_EACH, 2), np.float64)
    lane = cuda.threadIdx.y * SIDE + cuda.threadIdx.x
    _place(pixels, lane, place)
    cuda.syncthreads()
    _fit(lane, place, patch)
    _offsets(lane, place, patch, near, total)
    turn = _carrier(numbers)
    for first in range(0, len(start_m), CHUNK):
        count = min(CHUNK, len(start_m) - first)
        if lane < count:
            _view(antennas[first + lane], start_m[first + lane], patch, numbers, (words[lane], steps[lane]))
        cuda.syncthreads()
        _chunk(first, count, (lane, place, near, total), (words, steps), (antennas, start_m, cells, turn, numbers))
        cuda.syncthreads()
    for n in range(_EACH):
        row, column = cuda.blockIdx.y * SIDE + cuda.threadIdx.y + n * ROWS, cuda.blockIdx.x * SIDE + cuda.threadIdx.x
        if row < image.shape[0] and column < image.shape[1]:
            nowhere = math.isnan(place[0, lane + n * ROWS * SIDE])
            image[row, column] = complex(math.nan, math.nan) if nowhere else complex(total[n, 0], total[n, 1])


@cuda.jit(device=True)
def _carrier(numbers):  # type: ignore[no-untyped-def]
    """Return float32 arguments of `_carrier_at`: four coefficients of cosine, four of sine, half turns a cell."""
    a, b, c, d = numbers[_TURN], numbers[_TURN + 1], numbers[_TURN + 2], numbers[_TURN + 3]
    e, f, g, h = numbers[_TURN + 4], numbers[_TURN + 5], numbers[_TURN + 6], numbers[_TURN + 7]
    cosine = (np.float32(a), np.float32(b), np.float32(c), np.float32(d))
    return cosine + (np.float32(e), np.float32(f), np.float32(g), np.float32(h), np.float32(numbers[_TURN + 8]))


@cuda.jit(device=True)
def _place(pixels, lane, place):  # type: ignore[no-untyped-def]
    """Put the positions of a patch into shared memory; x is NaN where a pixel has none or lies beyond the image."""
    for n in range(_EACH):
        row, column = cuda.blockIdx.y * SIDE + cuda.threadIdx.y + n * ROWS, cuda.blockIdx.x * SIDE + cuda.threadIdx.x
        inside = row < pixels.shape[0] and column < pixels.shape[1]
        known = inside
        for axis in range(3):
            value = pixels[row, column, axis] if inside else math.nan
            known = known and math.isfinite(value)
            place[axis, lane + n * ROWS * SIDE] = value
        if not known:
            place[0, lane + n * ROWS * SIDE] = math.nan


@cuda.jit(device=True)
def _fit(lane, place, patch):  # type: ignore[no-untyped-def]
    """Put the middle of a patch's box, and how far its pixels lie from it, into shared memory."""
    if lane < 3:
        low, high = math.inf, -math.inf
        for other in range(_PIXELS):
            if not math.isnan(place[0, other]):
                low, high = min(low, place[lane, other]), max(high, place[lane, other])
        patch[lane] = (low + high) / 2
    cuda.syncthreads()
    if lane == 0:
        reach = 0.0
        for other in range(_PIXELS):
            if not math.isnan(place[0, other]):
                x, y, z = place[0, other] - patch[0], place[1, other] - patch[1], place[2, other] - patch[2]
                reach = max(reach, x * x + y * y + z * z)
        patch[3] = math.sqrt(reach)
    cuda.syncthreads()


@cuda.jit(device=True)
def _offsets(lane, place, patch, near, total):  # type: ignore[no-untyped-def]
    """Fill the offsets of a thread's pixels; a pixel without a position is summed at the origin, and not written."""
    for n in range(_EACH):
        at = lane + n * ROWS * SIDE
        squared = _NONE
        for axis in range(3):
            offset = _NONE if math.isnan(place[0, at]) else np.float32(place[axis, at] - patch[axis])
            near[n, axis] = offset
            squared += offset * offset
        near[n, 3] = squared
        total[n, 0] = 0.0
        total[n, 1] = 0.0


@cuda.jit(device=True)
def _view(antennas, start_m, patch, numbers, shared):  # type: ignore[no-untyped-def]
    """Put into shared memory the series of one pulse's paths over a patch, (8), and the path variant of its pixels."""
    words, step = shared
    reach, per_cell = patch[3], numbers[_PER_CELL]
    path, error = 0.0, 2 * FLOAT32_ERROR * reach
    for leg in range(2):
        x, y, z = patch[0] - antennas[leg, 0], patch[1] - antennas[leg, 1], patch[2] - antennas[leg, 2]
        squared = x * x + y * y + z * z
        distance = math.sqrt(squared)
        path += distance
        most = reach * (2 * distance + reach)
        if most < FARTHEST * squared:
            most /= squared
            error += LAST_TERM * distance * most**LAST_ORDER / (1 - most)
            words[leg * _LEG] = 2 * x / squared
            words[leg * _LEG + 1] = 2 * y / squared
            words[leg * _LEG + 2] = 2 * z / squared
            words[leg * _LEG + 3] = 1 / squared
            words[leg * _LEG + 4] = distance / 2 * per_cell
        else:
            error = math.inf
    middle, spread = (path - start_m) * per_cell, 2 * reach * per_cell
    if not (middle + spread > -1 and middle - spread < numbers[_CELLS]):
        step[0] = _SKIPPED
    elif numbers[_WAVENUMBER] * error <= numbers[_TOLERANCE] and spread < MOST_CELLS:
        nearest = math.floor(middle + 0.5)
        step[0] = _SERIES
        step[1] = int(nearest)
        words[_MIDDLE] = middle - nearest
    else:
        step[0] = _EXACT


@cuda.jit(device=True)
def _chunk(first, count, mine, shared, given):  # type: ignore[no-untyped-def]
    """Add some pulses to a thread's pixels; they are summed in float32 first."""
    lane, place, near, total = mine
    words, steps = shared
    antennas, start_m, cells, turn, numbers = given
    part = cuda.local.array((_EACH, 2), np.float32)
    for n in range(_EACH):
        part[n, 0], part[n, 1] = _NONE, _NONE
    for number in range(count):
        c, p = np.uint64(number), np.uint64(first + number)  # signed ones would be taken as counted from the end
        if steps[c, 0] == _SKIPPED:
            continue
        rows = (cells[p, 0], cells[p, 1], cells[p, 2], cells[p, 3], cells[p, 4], cells[p, 5])
        if steps[c, 0] == _SERIES:
            w = words[c]
            word = (w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7], w[8], w[9], w[10])
            for n in range(_EACH):
                at, u = _by_series(word, steps[c, 1], near[n, 0], near[n, 1], (near[n, 2], near[n, 3]))
                _add(rows, at, u, turn, part[n])
        else:
            for n in range(_EACH):
                at, u = _exact(antennas[p], start_m[p], numbers, place, lane + n * ROWS * SIDE)
                _add(rows, at, u, turn, part[n])
    for n in range(_EACH):
        total[n, 0] += part[n, 0]
        total[n, 1] += part[n, 1]


@cuda.jit(device=True)
def _by_series(word, middle, x, y, rest):  # type: ignore[no-untyped-def]
    """Return cell and place in it of a pixel's path, (8)."""
    z, squared = rest
    s = word[3] * squared + word[0] * x + word[1] * y + word[2] * z
    t = word[8] * squared + word[5] * x + word[6] * y + word[7] * z
    path = word[10] + word[4] * s * _root(s) + word[9] * t * _root(t)
    rounded = (path + _ROUNDER) - _ROUNDER
    return np.uint32(middle + np.int32(rounded)), path - rounded


@cuda.jit(device=True)
def _root(s):  # type: ignore[no-untyped-def]
    """Return 2 (√(1 + s) − 1) / s by its series."""
    return _ONE + s * (_B1 + s * (_B2 + s * (_B3 + s * _B4)))


@cuda.jit(device=True)
def _exact(antennas, start_m, numbers, place, at):  # type: ignore[no-untyped-def]
    """Return cell and place in it of a pixel's path in float64; no cell where the table does not reach it."""
    path = 0.0
    for leg in range(2):
        x, y, z = place[0, at] - antennas[leg, 0], place[1, at] - antennas[leg, 1], place[2, at] - antennas[leg, 2]
        path += math.sqrt(x * x + y * y + z * z)
    middle = (path - start_m) * numbers[_PER_CELL]
    if not -0.5 <= middle < numbers[_CELLS] - 0.5:
        return np.uint32(_NO_CELL), _NONE
    nearest = math.floor(middle + 0.5)
    return np.uint32(nearest), np.float32(middle - nearest)


@cuda.jit(device=True)
def _add(rows, i, u, turn, part):  # type: ignore[no-untyped-def]
    """Add the polynomial of a cell at place u, times the carrier there, (2); nothing where there is no such cell."""
    if i >= np.uint32(len(rows[0])):
        return
    re = rows[0][i] + u * (rows[2][i] + u * rows[4][i])
    im = rows[1][i] + u * (rows[3][i] + u * rows[5][i])
    cosine, sine = _carrier_at(turn, u)
    part[0] = part[0] + re * cosine - im * sine
    part[1] = part[1] + re * sine + im * cosine


@cuda.jit(device=True)
def _carrier_at(turn, u):  # type: ignore[no-untyped-def]
    """Return cosine and sine of the carrier at place u of a cell; where it turns often, half turns are removed."""
    sign = _ONE
    if turn[8] != _NONE:
        scaled = u * turn[8]
        turns = (scaled + _ROUNDER) - _ROUNDER
        u = scaled - turns
        if np.int32(turns) & 1:
            sign = -_ONE
    v = u * u
    cosine = turn[0] + v * (turn[1] + v * (turn[2] + v * turn[3]))
    sine = turn[4] + v * (turn[5] + v * (turn[6] + v * turn[7]))
    return sign * cosine, sign * u * sine
