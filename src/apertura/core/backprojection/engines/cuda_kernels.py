"""GPU kernels for tables of profiles and for weighted sums over patches; imported only if a device is used."""

import hashlib
import math
import warnings
from typing import Any

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
    simulated,
)

# numba stores compiled kernels under their names, and compiles them again if this file changes. The constants of
# `cuda_prediction` are therefore part of the name.
_CONSTANTS = (CHUNK, FARTHEST, FLOAT32_ERROR, LAST_ORDER, LAST_TERM, MOST_CELLS, SIDE, TAPS)
_DIGEST = hashlib.sha256(repr(_CONSTANTS).encode()).hexdigest()[:16]


def _kernel(function: Any, **options: Any) -> Any:
    """Return a kernel that is compiled at its first call and stored for later processes."""
    function.__qualname__ += _DIGEST
    return cuda.jit(function) if simulated() else cuda.jit(function, cache=True, **options)


# ---- Tables of profiles on a GPU


@_kernel
def expand(samples, taps, lead, down, carrier, turn, cells):  # type: ignore[no-untyped-def]  # noqa: PLR0917
    """Fill cells (pulse, 3·cell) from samples (pulse, range) by eq. 2, with one thread per cell; the last cell is 0."""
    count, length, up = cells.shape[1] // 3, samples.shape[1], len(lead)
    number = cuda.grid(1)
    if number >= len(samples) * count:
        return
    p, i = number // count, number % count
    level, slope, curvature = np.complex64(0), np.complex64(0), np.complex64(0)
    if i < count - 1:
        position = i % up
        first = i // up * down + lead[position]
        for tap in range(TAPS):
            n = first + tap
            if 0 <= n < length:
                sample = samples[p, n]
                level += sample * taps[position, 0, tap]
                slope += sample * taps[position, 1, tap]
                curvature += sample * taps[position, 2, tap]
        phase = carrier[i] * turn[p]
        level, slope, curvature = level * phase, slope * phase, curvature * phase
    for n, value in enumerate((level, slope, curvature)):
        cells[p, 3 * i + n] = _packed(value)


# numba reads a complex64 as two words of 32 bits. Coefficients are stored as words of 64 bits, which are read at once.


@cuda.jit(device=True)
def _packed(value):  # type: ignore[no-untyped-def]
    """Return real and imaginary part in the low and high half of a uint64."""
    low, high = np.float32(value.real).view(np.uint32), np.float32(value.imag).view(np.uint32)
    return np.uint64(high) << np.uint64(32) | np.uint64(low)


@cuda.jit(device=True)
def _real(word):  # type: ignore[no-untyped-def]
    """Return the float32 in the low half of a word."""
    return np.uint32(word).view(np.float32)


@cuda.jit(device=True)
def _imaginary(word):  # type: ignore[no-untyped-def]
    """Return the float32 in the high half of a word."""
    return np.uint32(word >> np.uint64(32)).view(np.float32)


# ---- Sums of tables over patches on a GPU
#
# numba compiles these functions for the device, or the simulator of numba runs them as Python functions
# (NUMBA_ENABLE_CUDASIM=1). numba treats literals as float64; float32 constants have names, because a single literal
# would slow down every pixel. Equation numbers refer to docs/theory/engine.md, section "A GPU"; for weights, they refer
# to section "Antennas" and to integration.md.

# This warning, which begins with the code of a colour, is expected for patches of certificates.
warnings.filterwarnings("ignore", ".*Grid size .* low occupancy")

ROWS = 4
"""Number of rows of threads of a patch. Each thread sums every fourth pixel of a column and reads common values once.
"""

_REGISTERS = {False: 64, True: 96}
"""Largest number of registers of a thread without and with weights."""

_PIXELS, _EACH, _LANES = SIDE * SIDE, SIDE // ROWS, SIDE * ROWS
# indices of the VARIANTS of the engine; _UNSEEN: a whole chunk without an echo
_SERIES, _EXACT, _SKIPPED, _UNSEEN = range(4)
_NO_CELL = 2**32 - 1
_ROUNDER = np.float32(1.5 * 2**23)  # adding and subtracting this number rounds to an integer
_ONE, _ZERO, _TWO, _THREE = np.float32(1), np.float32(0), np.float32(2), np.float32(3)
# coefficients of eq. 8
_B1, _B2, _B3, _B4 = np.float32(-1 / 4), np.float32(1 / 8), np.float32(-5 / 64), np.float32(7 / 128)
_LEG, _MIDDLE, _WORDS = 5, 10, 11  # layout of a pulse in shared memory: five words per leg, position of the origin
_CELLS_PER_M, _WAVENUMBER, _TOLERANCE, _CELLS, _PHASE = range(5)  # indices in `numbers`
_CENTRE, _INNER, _OUTER = 13, 14, 15  # indices of the sector parameters in `numbers`
_X, _Y, _Z, _REACH, _PATCH_CENTRE, _CENTRE_REACH = range(
    6
)  # indices in `patch`: origin (three), reach of the patch, sector centre, reach of the sector centre
_VARIANT, _ORIGIN, _ZONE = range(3)  # indices in `steps`: path variant, cell of the origin, zone of the sector


def _over_an_image(weighed):  # type: ignore[no-untyped-def]
    """Return the kernel that sums cells over an image (y, x), with one thread block per patch and 4 pixels per thread.

    Arguments of the kernel: pixels; phase centres, starts and cells; numbers; axes of the sector and of beams, cuts,
    gains, ends of the sector, spread of chunks; image and counts. `weighed` is a compile-time constant, so that a sum
    without weights uses no registers for weights.
    """
    width, own = (_WEIGHED_WORDS, _PIXELS) if weighed else (_WORDS, 1)

    def kernel(pixels, tables, numbers, weights, results):  # type: ignore[no-untyped-def]
        positions = cuda.shared.array((3, _PIXELS), np.float64)
        patch = cuda.shared.array(6, np.float64)
        words = cuda.shared.array((CHUNK, width), np.float32)
        steps = cuda.shared.array((CHUNK, 3), np.int32)
        centres = cuda.shared.array(own, np.float64)
        reached = cuda.shared.array(_LANES, np.int32)
        near = cuda.local.array((_EACH, 5), np.float32)  # x, y, z from the origin, squared; sector centre offset
        total = cuda.local.array((_EACH, 2), np.float64)
        tally = cuda.local.array(4, np.int64)
        lane = cuda.threadIdx.y * SIDE + cuda.threadIdx.x
        # Patch: positions, origin and offsets of the pixels; with weights, also their sector centres.
        _load_positions(pixels, lane, positions)
        cuda.syncthreads()
        _fit(lane, positions, patch)
        _offsets(lane, positions, patch, near, total)
        if weighed:
            _centres(lane, positions, weights, numbers, (patch, centres, near))
        for variant in range(4):
            tally[variant] = 0
        turn, pulses = _carrier(numbers), len(tables[1])
        for first in range(0, pulses, CHUNK):
            count = min(CHUNK, pulses - first)
            # Skip whole chunks of pulses with zero weight over the patch.
            if weighed and not _is_reached(first // CHUNK, lane, patch, numbers, (tables, weights, reached, words)):
                tally[_UNSEEN] += count if lane == 0 else 0
                continue
            # One thread per pulse: compute the series of the paths, and the weights.
            if lane < count:
                _view(first + lane, patch, numbers, tables, (words[lane], steps[lane]))
                if weighed:
                    _weigh(first + lane, patch, numbers, (tables, weights), (words[lane], steps[lane]))
                tally[steps[lane, _VARIANT]] += 1
            cuda.syncthreads()
            # Four pixels per thread: sum over these pulses.
            _chunk(
                (first, count),
                (lane, positions, near, total),
                (words, steps, patch),
                (tables, turn, numbers),
                (weights, weighed),
            )
            cuda.syncthreads()
        _write(lane, positions, total, tally, results)

    # The kernel would use 108 registers without weights. With 64, twice as many threads run on a multiprocessor, and
    # the rate is 1.2 times as high (H200).
    return _kernel(kernel, max_registers=_REGISTERS[weighed])


@cuda.jit(device=True)
def _write(lane, positions, total, tally, results):  # type: ignore[no-untyped-def]
    """Write the sums of a thread to the image; add the numbers of contributions to the counts of the variants."""
    image, counts = results
    above, left = cuda.blockIdx.y * SIDE, cuda.blockIdx.x * SIDE
    for n in range(_EACH):
        row, column = above + cuda.threadIdx.y + n * ROWS, left + cuda.threadIdx.x
        if row < image.shape[0] and column < image.shape[1]:
            unknown = math.isnan(positions[0, lane + n * ROWS * SIDE])
            image[row, column] = complex(math.nan, math.nan) if unknown else complex(total[n, 0], total[n, 1])
    pixels = min(SIDE, image.shape[0] - above) * min(SIDE, image.shape[1] - left)
    for variant in range(4):
        if tally[variant]:
            cuda.atomic.add(counts, variant, tally[variant] * pixels)


@cuda.jit(device=True)
def _carrier(numbers):  # type: ignore[no-untyped-def]
    """Return float32 arguments of `_carrier_at`: four cosine and four sine coefficients, and half cycles per cell."""
    a, b, c, d = numbers[_PHASE], numbers[_PHASE + 1], numbers[_PHASE + 2], numbers[_PHASE + 3]
    e, f, g, h = numbers[_PHASE + 4], numbers[_PHASE + 5], numbers[_PHASE + 6], numbers[_PHASE + 7]
    cosine = (np.float32(a), np.float32(b), np.float32(c), np.float32(d))
    return cosine + (np.float32(e), np.float32(f), np.float32(g), np.float32(h), np.float32(numbers[_PHASE + 8]))


@cuda.jit(device=True)
def _load_positions(pixels, lane, positions):  # type: ignore[no-untyped-def]
    """Write the positions of a patch to shared memory; x is NaN if a pixel has no position or is outside the image."""
    for n in range(_EACH):
        row, column = cuda.blockIdx.y * SIDE + cuda.threadIdx.y + n * ROWS, cuda.blockIdx.x * SIDE + cuda.threadIdx.x
        inside = row < pixels.shape[0] and column < pixels.shape[1]
        known = inside
        for axis in range(3):
            value = pixels[row, column, axis] if inside else math.nan
            known = known and math.isfinite(value)
            positions[axis, lane + n * ROWS * SIDE] = value
        if not known:
            positions[0, lane + n * ROWS * SIDE] = math.nan


@cuda.jit(device=True)
def _fit(lane, positions, patch):  # type: ignore[no-untyped-def]
    """Write the centre of a patch's bounding box, and the largest distance of a pixel from it, to shared memory."""
    if lane < 3:
        low, high = math.inf, -math.inf
        for other in range(_PIXELS):
            if not math.isnan(positions[0, other]):
                low, high = min(low, positions[lane, other]), max(high, positions[lane, other])
        patch[lane] = (low + high) / 2
    cuda.syncthreads()
    if lane == 0:
        reach = 0.0
        for other in range(_PIXELS):
            if not math.isnan(positions[0, other]):
                x, y, z = positions[0, other] - patch[0], positions[1, other] - patch[1], positions[2, other] - patch[2]
                reach = max(reach, x * x + y * y + z * z)
        patch[_REACH] = math.sqrt(reach)
    cuda.syncthreads()


@cuda.jit(device=True)
def _offsets(lane, positions, patch, near, total):  # type: ignore[no-untyped-def]
    """Fill the offsets of a thread's pixels; pixels without positions are summed at the origin but not written."""
    for n in range(_EACH):
        at = lane + n * ROWS * SIDE
        squared = _ZERO
        for axis in range(3):
            offset = _ZERO if math.isnan(positions[0, at]) else np.float32(positions[axis, at] - patch[axis])
            near[n, axis] = offset
            squared += offset * offset
        near[n, 3] = squared
        near[n, 4] = _ZERO
        total[n, 0] = 0.0
        total[n, 1] = 0.0


@cuda.jit(device=True)
def _view(p, patch, numbers, tables, shared):  # type: ignore[no-untyped-def]
    """Write the series of the paths of a pulse over a patch (eq. 8) and the path variant to shared memory."""
    antennas, start_m = tables[0][p], tables[1][p]
    words, step = shared
    reach, per_cell = patch[_REACH], numbers[_CELLS_PER_M]
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
        step[_VARIANT] = _SKIPPED
    elif numbers[_WAVENUMBER] * error <= numbers[_TOLERANCE] and spread < MOST_CELLS:
        nearest = math.floor(middle + 0.5)
        step[_VARIANT] = _SERIES
        step[_ORIGIN] = int(nearest)
        words[_MIDDLE] = middle - nearest
    else:
        step[_VARIANT] = _EXACT


@cuda.jit(device=True)
def _chunk(chunk, mine, shared, inputs, weighing):  # type: ignore[no-untyped-def]
    """Add a chunk of pulses to the pixels of a thread; the chunk is first summed in float32."""
    first, count = chunk
    lane, positions, near, total = mine
    words, steps, patch = shared
    (antennas, start_m, cells), turn, numbers = inputs
    weights, weighed = weighing
    # Sum this chunk in float32; rows of cells are read once for all pixels of a thread.
    part = cuda.local.array((_EACH, 2), np.float32)
    for n in range(_EACH):
        part[n, 0], part[n, 1] = _ZERO, _ZERO
    weight, last = _ONE, np.uint32(cells.shape[1] // 3 - 1)
    for number in range(count):
        c, p = np.uint64(number), np.uint64(first + number)  # unsigned, because signed indices may count from the end
        if steps[c, _VARIANT] == _SKIPPED:
            continue
        if steps[c, _VARIANT] == _SERIES:
            w = words[c]  # series of the pulse about the origin of the patch, eq. 8
            word = (w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7], w[8], w[9], w[10])
            for n in range(_EACH):
                at, u, legs = _by_series(word, steps[c, _ORIGIN], near[n, 0], near[n, 1], (near[n, 2], near[n, 3]))
                if weighed:
                    weight = _weight(w, steps[c, _ZONE], near[n], legs, (weights, numbers))
                _add((cells[p], last), at, u, turn, (weight, part[n]))
        else:
            for n in range(_EACH):
                pixel = lane + n * ROWS * SIDE
                at, u = _exact(antennas[p], start_m[p], numbers, positions, pixel)
                if weighed:
                    centre = patch[_PATCH_CENTRE] + near[n, 4]
                    weight = _exact_weight(p, steps[c, _ZONE], (positions, pixel), centre, (antennas, weights, numbers))
                _add((cells[p], last), at, u, turn, (weight, part[n]))
    for n in range(_EACH):
        total[n, 0] += part[n, 0]
        total[n, 1] += part[n, 1]


@cuda.jit(device=True)
def _by_series(word, middle, x, y, rest):  # type: ignore[no-untyped-def]
    """Return the cell of a pixel's path and the position in the cell by eq. 8, and s of both one-way paths."""
    z, squared = rest
    s = word[3] * squared + word[0] * x + word[1] * y + word[2] * z
    t = word[8] * squared + word[5] * x + word[6] * y + word[7] * z
    path = word[10] + word[4] * s * _root(s) + word[9] * t * _root(t)
    rounded = (path + _ROUNDER) - _ROUNDER
    return np.uint32(middle + np.int32(rounded)), path - rounded, (s, t)


@cuda.jit(device=True)
def _root(s):  # type: ignore[no-untyped-def]
    """Return the series of 2 (√(1 + s) − 1) / s."""
    return _ONE + s * (_B1 + s * (_B2 + s * (_B3 + s * _B4)))


@cuda.jit(device=True)
def _exact(antennas, start_m, numbers, positions, at):  # type: ignore[no-untyped-def]
    """Return the cell of a pixel's path and the position in the cell in float64; `_NO_CELL` outside the table."""
    path = 0.0
    for leg in range(2):
        x, y, z = (
            positions[0, at] - antennas[leg, 0],
            positions[1, at] - antennas[leg, 1],
            positions[2, at] - antennas[leg, 2],
        )
        path += math.sqrt(x * x + y * y + z * z)
    middle = (path - start_m) * numbers[_CELLS_PER_M]
    if not -0.5 <= middle < numbers[_CELLS] - 0.5:
        return np.uint32(_NO_CELL), _ZERO
    nearest = math.floor(middle + 0.5)
    return np.uint32(nearest), np.float32(middle - nearest)


@cuda.jit(device=True)
def _add(table, i, u, turn, sums):  # type: ignore[no-untyped-def]
    """Add the weighted polynomial of a cell at position u, multiplied by the carrier (eq. 2).

    The last cell, which is 0, replaces cells outside the table: a branch would keep the reads of the pixels of a thread
    from being executed at the same time.
    """
    (cells, last), (weight, part) = table, sums
    first = min(i, last) * np.uint64(3)
    level, slope, curvature = cells[first], cells[first + np.uint64(1)], cells[first + np.uint64(2)]
    re = weight * (_real(level) + u * (_real(slope) + u * _real(curvature)))
    im = weight * (_imaginary(level) + u * (_imaginary(slope) + u * _imaginary(curvature)))
    cosine, sine = _carrier_at(turn, u)
    part[0] = part[0] + re * cosine - im * sine
    part[1] = part[1] + re * sine + im * cosine


@cuda.jit(device=True)
def _carrier_at(turn, u):  # type: ignore[no-untyped-def]
    """Return cosine and sine of the carrier at position u of a cell, reduced by multiples of π if required."""
    sign = _ONE
    if turn[8] != _ZERO:
        scaled = u * turn[8]
        half_cycles = (scaled + _ROUNDER) - _ROUNDER
        u = scaled - half_cycles
        if np.int32(half_cycles) & 1:
            sign = -_ONE
    v = u * u
    cosine = turn[0] + v * (turn[1] + v * (turn[2] + v * turn[3]))
    sine = turn[4] + v * (turn[5] + v * (turn[6] + v * turn[7]))
    return sign * cosine, sign * u * sine


# ---- Weights of pulses: antenna beams and the integrated sector
#
# Values for the weights of a pulse are prepared once for a patch and stored after the series of the paths. The weights
# of pixels are computed from these values and from the offsets of the pixels from the origin.

_INSIDE, _EDGE, _OUTSIDE = range(3)
"""Zones of a patch by weight: one inside the sector, variable at the edge of the sector, zero outside the sector or
outside a beam."""

_ENDS, _SPREAD = 4, 5  # indices in `weights`
# layout of a cut: first angle, samples per radian, index of the last sample (-1: no beam)
_FIRST, _PER_RAD, _LAST = range(3)
_ANTENNA_SPREAD, _BEAM_SPREAD, _SECTOR_SPREAD = range(
    3
)  # largest differences of the pulses of a chunk from the middle pulse
_SECTOR, _S, _BEAM, _BEAM_WORDS = 11, 19, 20, 12  # layout of a pulse in shared memory, after the series of its paths
_WEIGHED_WORDS = 45  # odd, to avoid bank conflicts between threads that write these words
_HALF_PI = np.float32(math.pi / 2)
_PI = np.float32(math.pi)
# margin of angles, rad, and of s: exceeds the float32 error, so that a weight of zero or one is valid at each pixel
_MARGIN = 1e-5


@_kernel
def spread_of_chunks(antennas, sector_axes, beam_axes, spread):  # type: ignore[no-untyped-def]
    """Fill the spread of each chunk, (chunk, 2, 3), with one thread per chunk.

    The spread of each antenna is the largest difference between the pulses of the chunk and the middle pulse in
    position (metres), beam axes and sector axis. The last row applies to a single pulse and contains zeros.
    """
    chunk = cuda.grid(1)
    if chunk >= len(spread):
        return
    pulses = len(antennas)
    first, middle = chunk * CHUNK, min(chunk * CHUNK + CHUNK // 2, pulses - 1)
    for leg in range(2):
        most_antenna, most_beam, most_sector = 0.0, 0.0, 0.0
        for p in range(first, min(first + CHUNK, pulses)):
            antenna, beam, sector = 0.0, 0.0, 0.0
            for n in range(3):
                antenna += (antennas[p, leg, n] - antennas[middle, leg, n]) ** 2
                if len(sector_axes):
                    sector += (sector_axes[p, leg, n] - sector_axes[middle, leg, n]) ** 2
                if len(beam_axes):
                    for axis in range(3):
                        beam += (beam_axes[p, leg, axis, n] - beam_axes[middle, leg, axis, n]) ** 2
            most_antenna, most_beam = max(most_antenna, antenna), max(most_beam, beam)
            most_sector = max(most_sector, sector)
        spread[chunk, leg, _ANTENNA_SPREAD] = math.sqrt(most_antenna)
        spread[chunk, leg, _BEAM_SPREAD] = math.sqrt(most_beam / 2)  # the largest change of a direction by a rotation
        spread[chunk, leg, _SECTOR_SPREAD] = math.sqrt(most_sector)


@cuda.jit(device=True)
def _centres(lane, positions, weights, numbers, mine):  # type: ignore[no-untyped-def]
    """Compute the sector centres of pixels (integration.md, eq. 4), the midpoint of their range, and the offsets."""
    ends, (patch, centres, near) = weights[_ENDS], mine
    for n in range(_EACH):
        at = lane + n * ROWS * SIDE
        centres[at] = _centre(positions[0, at], positions[1, at], positions[2, at], ends, numbers)
    cuda.syncthreads()
    if lane == 0:
        low, high = math.inf, -math.inf
        for other in range(_PIXELS):
            if not math.isnan(positions[0, other]):
                low, high = min(low, centres[other]), max(high, centres[other])
        patch[_PATCH_CENTRE], patch[_CENTRE_REACH] = (low + high) / 2, (high - low) / 2
    cuda.syncthreads()
    for n in range(_EACH):
        at = lane + n * ROWS * SIDE
        if not math.isnan(positions[0, at]):
            near[n, 4] = centres[at] - patch[_PATCH_CENTRE]


@cuda.jit(device=True)
def _centre(x, y, z, ends, numbers):  # type: ignore[no-untyped-def]
    """Return the sector centre of a pixel: configured, or the nearest one with the sector within the flight."""
    if not len(ends):
        return numbers[_CENTRE]
    low, high = math.inf, -math.inf
    for end in range(len(ends)):
        s = 0.0
        for leg in range(2):
            antenna, axis = ends[end, 0, leg], ends[end, 1, leg]
            u, v, w = x - antenna[0], y - antenna[1], z - antenna[2]
            s += (u * axis[0] + v * axis[1] + w * axis[2]) / math.sqrt(u * u + v * v + w * w)
        low, high = min(low, s), max(high, s)
    middle = (low + high) / 2
    lowest, highest = min(low + numbers[_OUTER], middle), max(high - numbers[_OUTER], middle)
    return min(max(numbers[_CENTRE], lowest), highest)


@cuda.jit(device=True)
def _is_reached(chunk, lane, patch, numbers, inputs):  # type: ignore[no-untyped-def]
    """Return True if any pulse of a chunk may have nonzero weight in a patch; each thread evaluates one chunk."""
    tables, weights, reached, words = inputs
    if chunk % _LANES == 0:
        spread, mine = weights[_SPREAD], chunk + lane
        cuda.syncthreads()  # wait until no thread reads the values that are overwritten below
        reached[lane] = 0
        if mine < len(spread) - 1:
            middle = min(mine * CHUNK + CHUNK // 2, len(tables[1]) - 1)
            reached[lane] = _zone(middle, spread[mine], patch, numbers, (tables[0], weights, words[lane])) != _OUTSIDE
        cuda.syncthreads()
    return reached[chunk % _LANES] != 0


@cuda.jit(device=True)
def _weigh(p, patch, numbers, inputs, shared):  # type: ignore[no-untyped-def]
    """Write the weights of a pulse over a patch, and the zone, to shared memory; skip a pulse with zero weights."""
    (tables, weights), (word, step) = inputs, shared
    if step[_VARIANT] != _SKIPPED:
        spread = weights[_SPREAD]
        step[_ZONE] = _zone(p, spread[len(spread) - 1], patch, numbers, (tables[0], weights, word))
        if step[_ZONE] == _OUTSIDE:
            step[_VARIANT] = _SKIPPED


@cuda.jit(device=True)
def _zone(p, spread, patch, numbers, pulse):  # type: ignore[no-untyped-def]
    """Return the zone of a patch for a pulse, and for all pulses that differ from this pulse by at most `spread`.

    The values from which the weights of pixels are computed are written to `word`. For each antenna, these are the
    sector axis divided by the range, and s at the origin (integration.md, eq. 1). The sum of s over both antennas minus
    the centre follows. For each beam, the vector from antenna to origin in the axes of the beam, and the axes, follow.
    """
    antennas, (sector_axes, beam_axes, cuts, _, _, _), word = pulse
    s, slack = -patch[_PATCH_CENTRE], patch[_CENTRE_REACH] + _MARGIN
    for leg in range(2):
        x, y, z = patch[_X] - antennas[p, leg, 0], patch[_Y] - antennas[p, leg, 1], patch[_Z] - antennas[p, leg, 2]
        distance, reach = math.sqrt(x * x + y * y + z * z), patch[_REACH] + spread[leg, _ANTENNA_SPREAD]
        if len(sector_axes):
            axis, at = sector_axes[p, leg], _SECTOR + 4 * leg
            a, b, c = axis[0] / distance, axis[1] / distance, axis[2] / distance
            along = a * x + b * y + c * z
            word[at], word[at + 1], word[at + 2], word[at + 3] = a, b, c, along
            # A direction changes by at most asin(reach / distance) ≤ π/2 · reach / distance.
            change = math.pi / 2 * reach / distance if reach < distance else 2.0
            s += along
            slack += change * distance * math.sqrt(a * a + b * b + c * c) + spread[leg, _SECTOR_SPREAD]
        if len(beam_axes) and cuts[leg, 0, _LAST] > _ZERO:
            at = _BEAM + leg * _BEAM_WORDS
            for n in range(3):
                axis = beam_axes[p, leg, n]
                word[at + n] = axis[0] * x + axis[1] * y + axis[2] * z
                first = at + 3 + 3 * n
                word[first], word[first + 1], word[first + 2] = axis[0], axis[1], axis[2]
            # A rotation of the axes changes the coordinates of a point along them by the angle times its distance.
            beam_reach = reach + spread[leg, _BEAM_SPREAD] * (distance + reach)
            if _misses(word[at], word[at + 1], word[at + 2], np.float32(beam_reach), cuts[leg]):
                return _OUTSIDE
    if not len(sector_axes):
        return _INSIDE
    word[_S] = s
    if abs(s) + slack <= numbers[_INNER]:
        return _INSIDE
    return _OUTSIDE if abs(s) - slack >= numbers[_OUTER] else _EDGE


@cuda.jit(device=True)
def _misses(ahead, right, above, reach, cuts):  # type: ignore[no-untyped-def]
    """Return True if a sphere about a point, in the axes of an antenna, lies outside one of the cuts."""
    margin, level = np.float32(_MARGIN), np.float32(math.sqrt(ahead * ahead + right * right))
    if reach < np.float32(math.sqrt(level * level + above * above)):
        elevation = np.float32(math.atan2(above, level))
        near = _HALF_PI * reach / np.float32(math.sqrt(level * level + above * above)) + margin
        if elevation + near < cuts[1, _FIRST] or elevation - near > _last_angle(cuts[1]):
            return True
    if reach < level:
        azimuth, near = np.float32(math.atan2(right, ahead)), _HALF_PI * reach / level + margin
        if abs(azimuth) + near < _PI:  # not across the branch cut at π
            return azimuth + near < cuts[0, _FIRST] or azimuth - near > _last_angle(cuts[0])
    return False


@cuda.jit(device=True)
def _last_angle(cut):  # type: ignore[no-untyped-def]
    return cut[_FIRST] + cut[_LAST] / cut[_PER_RAD]


@cuda.jit(device=True)
def _weight(w, zone, near, legs, inputs):  # type: ignore[no-untyped-def]
    """Return the weight of a pulse at a pixel from the pixel's offset, in float32; `legs` are the values s of eq. 8."""
    (_, _, cuts, gains, _, _), numbers = inputs
    x, y, z, weight = near[0], near[1], near[2], _ONE
    if zone == _EDGE:
        # s of eq. 1 changes little over a patch, and only this change has float32 errors.
        s = w[_S] - near[4]
        s += _change(w[_SECTOR] * x + w[_SECTOR + 1] * y + w[_SECTOR + 2] * z, w[_SECTOR + 3], legs[0])
        s += _change(w[_SECTOR + 4] * x + w[_SECTOR + 5] * y + w[_SECTOR + 6] * z, w[_SECTOR + 7], legs[1])
        outer, inner = np.float32(numbers[_OUTER]), np.float32(numbers[_INNER])
        weight = _smooth((outer - abs(s)) / (outer - inner))
    for leg in range(2):
        if cuts[leg, 0, _LAST] > _ZERO:
            b = _BEAM + leg * _BEAM_WORDS
            ahead = w[b] + (w[b + 3] * x + w[b + 4] * y + w[b + 5] * z)
            right = w[b + 1] + (w[b + 6] * x + w[b + 7] * y + w[b + 8] * z)
            above = w[b + 2] + (w[b + 9] * x + w[b + 10] * y + w[b + 11] * z)
            weight *= _gain(ahead, right, above, cuts[leg], gains[leg])
    return weight


@cuda.jit(device=True)
def _change(along, s, relative):  # type: ignore[no-untyped-def]
    """Return the difference of s of one antenna from the value at the origin, eq. 8a."""
    longer = relative * _root(relative) / _TWO
    return (along - s * longer) / (_ONE + longer)


@cuda.jit(device=True)
def _smooth(depth):  # type: ignore[no-untyped-def]
    """Return the smooth step of integration.md, eq. 3."""
    clipped = min(max(depth, _ZERO), _ONE)
    return clipped * clipped * (_THREE - _TWO * clipped)


@cuda.jit(device=True)
def _gain(ahead, right, above, cuts, gains):  # type: ignore[no-untyped-def]
    """Return the gain of an antenna in a direction given in the axes of the antenna, eq. 6."""
    azimuth = np.float32(math.atan2(right, ahead))
    elevation = np.float32(math.atan2(above, np.float32(math.sqrt(ahead * ahead + right * right))))
    return _look_up(azimuth, cuts[0], gains[0]) * _look_up(elevation, cuts[1], gains[1])


@cuda.jit(device=True)
def _look_up(radians, cut, gains):  # type: ignore[no-untyped-def]
    """Return the gain at an angle of a cut, interpolated linearly; zero beyond the samples."""
    position = (radians - cut[_FIRST]) * cut[_PER_RAD]
    if not _ZERO <= position <= cut[_LAST]:
        return _ZERO
    index = np.uint32(min(position, cut[_LAST] - _ONE))
    low, high = gains[index], gains[index + np.uint32(1)]
    return low + (position - np.float32(index)) * (high - low)


@cuda.jit(device=True)
def _exact_weight(p, zone, pixel, centre, inputs):  # type: ignore[no-untyped-def]
    """Return the weight of a pulse at a pixel from the position of the pixel, in float64."""
    antennas, (sector_axes, beam_axes, cuts, gains, _, _), numbers = inputs
    positions, at = pixel
    s, weight = -centre, _ONE
    for leg in range(2):
        x, y, z = (
            positions[0, at] - antennas[p, leg, 0],
            positions[1, at] - antennas[p, leg, 1],
            positions[2, at] - antennas[p, leg, 2],
        )
        if zone == _EDGE:
            axis = sector_axes[p, leg]
            s += (x * axis[0] + y * axis[1] + z * axis[2]) / math.sqrt(x * x + y * y + z * z)
        if cuts[leg, 0, _LAST] > _ZERO:
            axes = beam_axes[p, leg]
            ahead = np.float32(axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z)
            right = np.float32(axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z)
            above = np.float32(axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z)
            weight *= _gain(ahead, right, above, cuts[leg], gains[leg])
    if zone == _EDGE:
        weight *= _smooth(np.float32((numbers[_OUTER] - abs(s)) / (numbers[_OUTER] - numbers[_INNER])))
    return weight


form, form_weighed = map(_over_an_image, (False, True))
