"""Captures of a pair: reading in blocks of pulses, saturation check, and resampling to the transmitter's clock."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.errors import number_of
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.echo.demodulate import Numerology
from apertura.core.windowed_sinc import kaiser_beta, kaiser_sinc

# ---- Blocks of captures, and saturation

Samples = NDArray[np.int16 | np.float32]
Pulses = NDArray[np.int64]

Read = Callable[[Pulses], Mapping[str, Samples]]
"""Ascending capture numbers → channel → (capture, sample, 2), I and Q from the start of the prefix."""

AT_ONCE = 64
"""Captures processed at a time; their number is limited by the processor caches."""

SATURATED_SHARE = 1e-4
"""Share of samples at the full-scale codes of a converter, above which it clips; a symbol 12 dB below has one or two
such samples."""


def ordered(iq: Samples, order: str) -> Samples:
    """Return I and Q of samples recorded in the given order: complex, swapped or conjugate.

    Examples
    --------
    >>> [ordered(np.array([3, 4], np.int16), order).tolist() for order in ("complex", "swapped", "conjugate")]
    [[3, 4], [4, 3], [3, -4]]
    """
    return conjugates(iq) if order == "conjugate" else iq[..., ::-1] if order == "swapped" else iq


def conjugates(iq: Samples) -> Samples:
    """Return I and Q of the conjugate samples, in the same type; the lowest integer saturates at the highest.

    Examples
    --------
    >>> conjugates(np.array([[3, -32768], [1, 5]], np.int16)).tolist()
    [[3, 32767], [1, -5]]
    """
    conjugate: Any = iq.copy()
    if conjugate.dtype.kind == "i":
        conjugate[..., 1] = np.maximum(conjugate[..., 1], -np.iinfo(conjugate.dtype).max)
    np.negative(conjugate[..., 1], out=conjugate[..., 1])
    return np.asarray(conjugate)


def blocks_of(pulses: Pulses, size: int = AT_ONCE) -> Iterator[Pulses]:
    """Yield pulse numbers in blocks of `size`.

    Examples
    --------
    >>> [block.tolist() for block in blocks_of(np.arange(5), 2)]
    [[0, 1], [2, 3], [4]]
    """
    for first in range(0, len(pulses), size):
        yield pulses[first : first + size]


def spread(count: int, *, groups: int, each: int) -> list[Pulses]:
    """Return groups of neighbouring pulses, centred in equal parts of a flight; of a short flight, all pulses.

    Properties common to all pulses are estimated from a few thousand pulses, for any length of the flight.

    Examples
    --------
    >>> [[group.tolist() for group in spread(count, groups=2, each=3)] for count in (100, 5)]
    [[[23, 24, 25], [73, 74, 75]], [[0, 1, 2], [3, 4]]]
    """
    if count <= groups * each:
        return np.array_split(np.arange(count), max(1, min(groups, count)))
    middles = (np.arange(groups) + 0.5) * count / groups
    return [np.arange(int(middle - each / 2), int(middle - each / 2) + each) for middle in middles]


def sampled_pulses(count: int) -> list[Pulses]:
    """Return the pulses on which a pair is tested for interference and background: 64 groups of 8 neighbours.

    Examples
    --------
    >>> groups = sampled_pulses(100_000)
    >>> len(groups), groups[0].tolist()
    (64, [777, 778, 779, 780, 781, 782, 783, 784])
    """
    return spread(count, groups=64, each=8)


def runs(pulses: Sequence[Pulses], parts: Sequence[Complexes]) -> list[Complexes]:
    """Join the transfer functions of groups whose pulses follow each other, as in a short flight.

    Examples
    --------
    >>> groups = [np.array([0, 1]), np.array([2]), np.array([7, 8])]
    >>> [part.shape[0] for part in runs(groups, [np.zeros((len(group), 4), np.complex64) for group in groups])]
    [3, 2]
    """
    joined: list[list[Complexes]] = []
    last = -2
    for group, part in zip(pulses, parts, strict=True):
        if group[0] == last + 1:
            joined[-1].append(part)
        else:
            joined.append([part])
        last = int(group[-1])
    return [np.concatenate(run) for run in joined]


_CREST_SAMPLES = 256
"""Number of samples used for the crest factor of a capture; for noise alone it is below 3 in 2 of 10⁶ captures."""

_LIMITED_CREST = 3.0
"""Largest crest factor (peak power over mean power) of a limited capture. It is 6 to 10 for noise and OFDM, and 1 for a
square wave."""

_LIMITED_SHARE = 0.5
"""Limit of peak power and of crest factor relative to unlimited captures: for a limited capture, both are below it."""

_LIMITED_CAPTURES = 0.02
"""Tolerated share of limited captures: their distortion is 34 dB below the image. Without a limiter, 2 of 1000 symbols
of 128 subcarriers have a low crest factor, because their samples are not independent."""


class Saturation:
    """Counter of samples at a converter's full-scale codes, and of captures limited below them, block by block.

    Notes
    -----
    With a clipping converter of any number of bits, samples accumulate at the full-scale codes; without clipping the
    extreme values occur once or twice. A limiter in front of the converter lowers both the peak of a capture and its
    crest factor, max|s|²/mean|s|². A weak capture has a lower peak and an unchanged crest factor; a strong tone has a
    lower crest factor and an unchanged peak. Captures are compared with the 90th percentile of all captures.

    A stable tone, such as the direct path in a beat signal, reaches its crest again and again without clipping: next to
    the crest A of a sine, its largest code occurs 1/(√2 - 1) = 2.4 times as often as the code below it; at the code of
    a clipping converter, this ratio is tens to hundreds. With `contrast`, an extreme counts only if it occurs that many
    times as often as the adjacent value of the same block.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> waves = rng.normal(0, 3000, (4, 5000, 2))
    >>> for recorded in (waves, waves.clip(-8191, 8191)):
    ...     saturation = Saturation()
    ...     for block in recorded.astype(np.int16):
    ...         saturation.count({"radar": block[None]})
    ...     print({name: round(share, 4) for name, share in saturation.shares.items()})
    {'radar': 0.0}
    {'radar': 0.0054}
    """

    def __init__(self, contrast: float = 0.0) -> None:
        self._contrast = contrast
        self._extremes: dict[str, list[_Extreme]] = {}
        self._samples: dict[str, int] = {}
        self._powers: dict[str, list[Floats]] = {}
        self._captures: dict[str, list[Floats]] = {}

    def count(self, iq: Mapping[str, Samples]) -> None:
        """Count the samples of a block of captures, channel → (capture, sample, 2)."""
        for name, samples in iq.items():
            self._samples[name] = self._samples.get(name, 0) + samples.size
            extremes = self._extremes.setdefault(name, [_Extreme(sign, self._contrast) for sign in (+1, -1)])
            highest, lowest = samples.max(axis=(1, 2)), samples.min(axis=(1, 2))
            for extreme, value in zip(extremes, (highest.max().item(), lowest.min().item()), strict=True):
                extreme.count(samples, value)
            step = max(1, samples.shape[1] // _CREST_SAMPLES)
            power = (samples[:, ::step].astype(np.float64) ** 2).sum(axis=-1)
            self._captures.setdefault(name, []).append(np.stack([highest, lowest, power.mean(axis=1)]))
            if power.shape[1] >= _CREST_SAMPLES:
                self._powers.setdefault(name, []).append(np.stack([power.max(axis=1), power.mean(axis=1)]))

    @property
    def shares(self) -> dict[str, float]:
        """Share of each channel's samples that repeat its largest or smallest value."""
        return {
            name: sum(extreme.repeats for extreme in self._extremes[name]) / count
            for name, count in self._samples.items()
        }

    @property
    def flags(self) -> Flags:
        """Flags of channels with a clipping converter, and of captures limited in front of the converter."""
        limited = [self._limited(name, *np.concatenate(powers, axis=1)) for name, powers in self._powers.items()]
        return Flags.merged(self.clipped, *limited)

    @property
    def clipped(self) -> dict[str, str]:
        """Flags of channels with a clipping converter."""
        return {
            f"saturated_{name}": f"{share:.2%} of the samples of channel {name} are at full scale, {self._where(name)}"
            for name, share in self.shares.items()
            if share > SATURATED_SHARE
        }

    def _where(self, channel: str) -> str:
        """Return the number of saturated captures, and their power relative to the others: high for interference."""
        highest, lowest, power = np.concatenate(self._captures[channel], axis=1)
        high, low = (extreme.value for extreme in self._extremes[channel])
        saturated = (highest >= high) | (lowest <= low)
        line = f"in {saturated.sum()} of {number_of(len(saturated), 'capture')}"
        if saturated.all():
            return line
        ratio = float(np.median(power[saturated]) / max(np.median(power[~saturated]), np.finfo(np.float64).tiny))
        return f"{line}, whose power is {decibels(ratio):+.1f} dB relative to that of the others"

    @staticmethod
    def _limited(channel: str, peak: Floats, mean: Floats) -> Flags:
        """Raise a flag if captures have both a lower peak and a lower crest factor than the others."""
        crest = peak / np.maximum(mean, np.finfo(float).tiny)
        usual_peak, usual_crest = (float(np.percentile(values, 90)) for values in (peak, crest))
        limited = (
            (peak < _LIMITED_SHARE * usual_peak) & (crest < _LIMITED_SHARE * usual_crest) & (crest < _LIMITED_CREST)
        )
        if limited.mean() <= _LIMITED_CAPTURES:
            return Flags()
        limited_db, usual_db = (decibels(float(value)) for value in (np.median(crest[limited]), usual_crest))
        line = (
            f"{int(limited.sum())} of {len(peak)} captures of channel {channel}: crest factor {limited_db:.1f} dB, "
            f"compared with {usual_db:.1f} dB of the others"
        )
        return Flags({"captures_limited": line})


class _Extreme:
    """The largest or, with `sign` -1, the smallest value so far, and its number of occurrences."""

    def __init__(self, sign: int, contrast: float) -> None:
        self.sign, self.value, self.times = sign, -sign * np.inf, 0
        self.contrast, self.adjacent = contrast, 0

    @property
    def repeats(self) -> int:
        """Number of further occurrences: a single one is not a repetition; 0 if the adjacent value is too frequent."""
        return self.times - 1 if self.times > self.contrast * self.adjacent else 0

    def count(self, samples: Samples, value: float) -> None:
        if self.sign * value < self.sign * self.value:
            return
        if value != self.value:
            self.value, self.times, self.adjacent = value, 0, 0
        at_value = samples == value
        self.times += int(np.count_nonzero(at_value))
        others = samples[~at_value] if self.contrast else samples[:0]
        if others.size:
            self.adjacent += int(np.count_nonzero(others == (others.max() if self.sign > 0 else others.min())))


# ---- Captures that repeat earlier ones

HEAD = 16
"""Samples of a capture compared first, so that few captures are read completely."""


def repeated(heads: Iterable[NDArray[Any]], whole: Callable[[int], NDArray[Any]]) -> NDArray[np.bool_]:
    """Find captures that are bit-identical to an earlier capture, which noise would prevent.

    Parameters
    ----------
    heads
        Some samples of each capture, in order; captures whose heads are unique are not read further.
    whole
        Function that returns all samples of a capture.

    Returns
    -------
    ndarray
        (capture,) bool.

    Examples
    --------
    >>> captures = np.array([[1, 2, 3], [1, 2, 4], [5, 6, 7], [1, 2, 3]])
    >>> repeated(captures[:, :2], lambda number: captures[number]).tolist()
    [False, False, False, True]
    """
    count, candidates = 0, dict[bytes, list[int]]()
    for head in heads:
        candidates.setdefault(head.tobytes(), []).append(count)
        count += 1
    repeats = np.zeros(count, bool)
    for numbers in candidates.values():
        known = set[bytes]()
        for number in numbers if len(numbers) > 1 else ():
            digest = hashlib.blake2b(whole(number).tobytes(), digest_size=16).digest()
            repeats[number] = digest in known
            known.add(digest)
    return repeats


def repeat_flags(repeats: NDArray[np.bool_], node: str, *, first: int, remark: str = "") -> Flags:
    """Return a flag if captures of a node repeat earlier ones; `first`: number of the first of them."""
    if not repeats.any():
        return Flags()
    line = f"{int(repeats.sum())} of {len(repeats)} captures of {node}, first at capture {first}{remark}"
    return Flags({"captures_repeated": line})


# ---- Correction of clock offsets


_REJECTION_DB = 100.0


def correct_clock(samples: Complexes, numerology: Numerology, *, cfo_hz: Floats, sfo_ppm: float) -> Complexes:
    """Resample captures to the transmitter's clock.

    Parameters
    ----------
    samples
        (pulse, sample) complex64 of radar or sidelink, from the start of the cyclic prefix.
    numerology
        Numerology of the symbol.
    cfo_hz
        (pulse,) float64, receiver's oscillator frequency minus transmitter's.
    sfo_ppm
        Receiver's sampling rate above nominal, parts per million.

    Returns
    -------
    ndarray
        (pulse, prefix_samples + dft_samples) complex64.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Clock": rotation, then interpolation at the fractional sample positions by a
    Kaiser-windowed sinc, which is shortest if the occupied band is centred on zero.

    Examples
    --------
    >>> numerology = Numerology(1e9, 64e6, np.arange(32), prefix_samples=16, dft_samples=64)
    >>> turning = np.exp(-2j * np.pi * 5e3 * np.arange(100) / 64e6)[None].astype(np.complex64)
    >>> bool(np.allclose(correct_clock(turning, numerology, cfo_hz=np.array([5e3]), sfo_ppm=0.0), 1, atol=1e-5))
    True
    """
    count = numerology.prefix_samples + numerology.dft_samples
    rate_hz = numerology.sample_rate_hz * (1 + sfo_ppm * 1e-6)
    recorded_s, resampled_s = np.arange(samples.shape[1]) / rate_hz, np.arange(count) / numerology.sample_rate_hz
    index, taps = _fractional_taps(resampled_s * rate_hz, numerology)
    # beyond the ends of the capture, the symbol is continued periodically
    index = np.where(index >= samples.shape[1], index - numerology.dft_samples, index)
    index = np.where(index < 0, index + numerology.dft_samples, index)
    to_band = np.exp(2j * np.pi * numerology.middle_hz * resampled_s)
    corrected = np.empty((len(samples), count), np.complex64)
    for pulse, capture in enumerate(samples):
        centred = capture * np.exp(2j * np.pi * (cfo_hz[pulse] - numerology.middle_hz) * recorded_s)
        corrected[pulse] = np.einsum("kt,kt->k", centred[index], taps) * to_band
    return corrected


def _fractional_taps(position: Floats, numerology: Numerology) -> tuple[NDArray[np.int64], Floats]:
    """Return sample numbers and weights, (output sample, tap), that interpolate at the fractional `position`."""
    occupied = numerology.numbers.size / numerology.dft_samples
    length = (_REJECTION_DB - 8) / (2.285 * 2 * np.pi * max(1 - occupied, 0.05))  # Kaiser's rule
    half = int(np.ceil(length / 2)) + 1
    index = np.floor(position).astype(np.int64)[:, None] + np.arange(1 - half, half + 1)
    return index, kaiser_sinc(position[:, None] - index, half=half, beta=kaiser_beta(_REJECTION_DB))
