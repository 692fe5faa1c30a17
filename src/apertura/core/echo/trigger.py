"""Continuous recordings: pulse framing, detection of preambles, and extraction of captures."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Complexes
from apertura.common.units import decibels
from apertura.core.echo.captures import Samples

# ---- Framing: preamble and frame counter

ABSENT = -1
"""Frame number of a pulse whose payload was not decoded."""


@dataclass(frozen=True)
class PulseFraming:
    """Framing of a pulse: preamble | counter, most significant bit first | inverted counter | guard | prefix, symbol.

    Attributes
    ----------
    preamble
        (chip,) int of ±1.
    chip_samples
        Samples per chip.
    centre_hz
        Baseband frequency of the carrier that is modulated by the chips.
    sample_rate_hz
        Complex samples per second.
    counter_bits
        Width of the frame counter; 0 without payload.
    bit_chips
        Chips per payload bit; all chips of a bit have the same sign, +1 for a one and -1 for a zero.
    guard_samples
        Length of the guard interval between payload and cyclic prefix, samples.
    """

    preamble: NDArray[np.int64]
    chip_samples: int
    centre_hz: float
    sample_rate_hz: float
    counter_bits: int = 16
    bit_chips: int = 15
    guard_samples: int = 0

    @property
    def payload_samples(self) -> int:
        """Number of samples of the counter and its inverse."""
        return 2 * self.counter_bits * self.bit_chips * self.chip_samples

    @property
    def lead_samples(self) -> int:
        """Number of samples from the start of the preamble to the start of the cyclic prefix."""
        return len(self.preamble) * self.chip_samples + self.payload_samples + self.guard_samples

    def template(self) -> NDArray[np.complex64]:
        """Return the undelayed preamble, (sample,) complex64."""
        return np.asarray(np.repeat(self.preamble, self.chip_samples) * self._carrier(0, len(self.preamble)))

    def read_counter(self, samples: Samples) -> int:
        """Decode the frame number of a capture that starts with the preamble; return -1 if a bit is uncertain.

        Parameters
        ----------
        samples
            (sample, 2), at least the samples of preamble and payload.

        Examples
        --------
        >>> framing = PulseFraming(np.array([1, 1, -1, 1, -1]), 2, 0.0, 1e6, counter_bits=2, bit_chips=3)
        >>> chips = np.concatenate([framing.preamble, np.repeat([1, -1, -1, 1], 3)])
        >>> capture = np.stack([np.repeat(chips, 2) * 100, np.zeros(34, int)], -1).astype(np.int16)
        >>> framing.read_counter(capture), framing.read_counter(capture[:-8])
        (2, -1)
        """
        length = len(self.preamble) * self.chip_samples
        if self.counter_bits == 0 or len(samples) < length + self.payload_samples:
            return ABSENT
        iq = samples[: length + self.payload_samples, 0] + 1j * samples[: length + self.payload_samples, 1]
        phase = np.vdot(self.template(), iq[:length])
        if phase == 0:
            return ABSENT
        carrier = self._carrier(len(self.preamble), 2 * self.counter_bits * self.bit_chips)
        sums = (iq[length:] * carrier.conj()).reshape(2 * self.counter_bits, -1).sum(1)
        soft, inverse = np.split(np.real(sums * phase.conj()) / np.abs(phase) ** 2 * length, 2)
        expected = self.bit_chips * self.chip_samples  # magnitude of a noise-free bit
        bits = soft > inverse
        if (np.sign(soft) == np.sign(inverse)).any() or (np.abs(soft - inverse) < expected).any():
            return ABSENT
        return int("".join("1" if bit else "0" for bit in bits), 2)

    def _carrier(self, first_chip: int, chips: int) -> NDArray[np.complex64]:
        sample = np.arange(first_chip * self.chip_samples, (first_chip + chips) * self.chip_samples)
        return np.asarray(np.exp(2j * np.pi * self.centre_hz / self.sample_rate_hz * sample), np.complex64)


# ---- Detection of preambles at a constant false-alarm rate


_SMALLEST_TRANSFORM = 2**16
# energy over the length of a preamble relative to the energy of the window, below which rounding errors dominate
_NO_SIGNAL = 1e-10


@dataclass(frozen=True)
class Detection:
    """Preamble detected in a recording.

    Attributes
    ----------
    sample
        First sample of the preamble, counted from the start of the recording.
    score
        Squared normalised correlation, 0…1: fraction of the energy that is due to the preamble.
    snr_db
        SNR per sample, derived from the score.
    """

    sample: int
    score: float
    snr_db: float


def find_preambles(
    blocks: Iterable[Samples], framing: PulseFraming, *, symbol_samples: int, false_alarms_per_s: float
) -> Iterator[Detection]:
    """Yield the preambles of a recording in order of time, with a bounded number of samples in memory.

    Parameters
    ----------
    blocks
        (sample, 2) each, I and Q of the trigger channel in consecutive blocks of any length.
    framing
        Framing of the symbols.
    symbol_samples
        (T_cp + T)·f_s; from a preamble to the end of the following symbol, no other preamble is searched.
    false_alarms_per_s
        Tolerated rate of triggers caused by noise alone.

    Raises
    ------
    ValueError
        If the false-alarm rate is not positive.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Trigger". The threshold does not depend on the noise level, because the
    correlation is normalised by the energy of the same samples.

    Examples
    --------
    >>> framing = PulseFraming(np.array([1, 1, 1, -1, 1, -1, -1] * 9), 2, 0.0, 1e6, counter_bits=0, bit_chips=0)
    >>> noise = np.random.default_rng(1).normal(0, 50, (5000, 2))
    >>> noise[1234 : 1234 + 126, 0] += 100 * framing.template().real
    >>> detections = find_preambles([noise.astype(np.int16)], framing, symbol_samples=200, false_alarms_per_s=0.1)
    >>> [detection.sample for detection in detections]
    [1234]
    """
    template = framing.template()
    threshold = score_threshold(template.size, false_alarms_per_s / framing.sample_rate_hz)
    search = _PeakSearch(threshold, template.size, framing.lead_samples + symbol_samples)
    for first, scores in _scores(blocks, template):
        yield from search.feed(first, scores)
    yield from search.finish()


def score_threshold(template_samples: int, false_alarm: float) -> float:
    """Return the score that is exceeded by noise with probability `false_alarm` at one sample.

    For white Gaussian noise, the score is the squared cosine between two directions, one of which is random. At any
    noise level, its distribution is Beta(1, L-1), so that P(score > γ) = (1-γ)^(L-1).

    Examples
    --------
    >>> round(score_threshold(4092, 1e-11), 5)
    0.00617
    """
    if not 0 < false_alarm < 1:
        raise ValueError(f"{false_alarm=}: the probability per sample must lie between 0 and 1")
    return float(-np.expm1(np.log(false_alarm) / (template_samples - 1)))


def _scores(blocks: Iterable[Samples], template: Complexes) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield the first sample and the scores of each window, one per template position, by the overlap-save method."""
    length = template.size
    size = max(_SMALLEST_TRANSFORM, 1 << int(8 * length - 1).bit_length())
    matched = scipy.fft.fft(template, size).conj() / np.sqrt((np.abs(template) ** 2).sum())
    energy = np.zeros(size + 1)
    for first, window in _windows(blocks, size, overlap=length - 1):
        fitting = window.size - length + 1
        matches = scipy.fft.ifft(scipy.fft.fft(window, size) * matched)[:fitting]
        energy[1 : window.size + 1] = np.cumsum(_power(window), dtype=np.float64)
        under = (energy[length : window.size + 1] - energy[:fitting]).astype(np.float32)
        least = np.float32(_NO_SIGNAL * energy[window.size]) + np.finfo(np.float32).tiny  # samples may have any unit
        yield first, np.asarray(_power(matches) / np.maximum(under, least), np.float32)


def _power(samples: Complexes) -> NDArray[np.float32]:
    return np.square(samples.real) + np.square(samples.imag)


def _windows(blocks: Iterable[Samples], size: int, *, overlap: int) -> Iterator[tuple[int, Complexes]]:
    """Yield the first sample number and the samples of overlapping windows of length `size` (or less at the end)."""
    window = np.empty(size, np.complex64)
    parts = window.view(np.float32).reshape(size, 2)
    first, filled, new = 0, 0, 0
    for block in blocks:
        copied = 0
        while copied < len(block):
            count = min(size - filled, len(block) - copied)
            parts[filled : filled + count] = block[copied : copied + count]
            copied, filled, new = copied + count, filled + count, new + count
            if filled == size:
                yield first, window
                window[:overlap] = window[size - overlap :].copy()
                first, filled, new = first + size - overlap, overlap, 0
    if new and filled > overlap:
        yield first, window[:filled]


class _PeakSearch:
    """Search for the highest score within one preamble length after a threshold crossing, followed by a dead time.

    Sidelobes of a strong preamble exceed the threshold up to one preamble length before the main peak. The dead time is
    the length of a frame.
    """

    def __init__(self, threshold: float, reach: int, dead_time: int) -> None:
        self.threshold, self.reach, self.dead_time = threshold, reach, dead_time
        self.search_from = 0
        self.best: tuple[int, float] | None = None
        self.until = 0

    def feed(self, first: int, scores: NDArray[np.float32]) -> Iterator[Detection]:
        """Add the scores of consecutive samples from `first` on; yield the detections completed by these scores."""
        above = np.flatnonzero(scores > self.threshold)
        samples = above + first
        at = 0
        while True:
            if self.best is None:
                at = int(np.searchsorted(samples, self.search_from))
                if at == samples.size:
                    return
                self.best, self.until = (int(samples[at]), float(scores[above[at]])), int(samples[at]) + self.reach
            end = int(np.searchsorted(samples, self.until))
            if end > at:
                top = at + int(np.argmax(scores[above[at:end]]))
                if scores[above[top]] > self.best[1]:
                    self.best = int(samples[top]), float(scores[above[top]])
            if self.until > first + scores.size:
                return
            yield from self.finish()

    def finish(self) -> Iterator[Detection]:
        """Yield the current candidate, if any, and start the dead time."""
        if self.best is None:
            return
        sample, score = self.best
        self.best, self.search_from = None, sample + self.dead_time
        # the score of a signal of SNR ρ per sample is about (ρL + 1)/(L·(ρ + 1)), L: length of the preamble
        ratio = max(score * self.reach - 1, 1e-3) / (self.reach * max(1 - score, 1e-9))
        yield Detection(sample, score, decibels(ratio))


# ---- Extraction of captures from a continuous recording

_SAMPLES_AT_ONCE = 2**18


class SampleSource(Protocol):
    """(sample, 2), I and Q: an array, or an object that reads slices of an array from a file."""

    def __len__(self) -> int: ...

    def __getitem__(self, span: slice, /) -> Samples: ...


@dataclass(frozen=True)
class TriggeredCaptures:
    """Captures extracted from a continuous recording, as a triggered recorder would store them.

    Attributes
    ----------
    start
        (capture,) int64, first sample of the cyclic prefix of each symbol.
    frame
        (capture,) int64, frame number of each symbol; -1 if it is not decoded.
    report
        Number of captures, false-alarm rate, median SNR, duty cycle and mean data rate.
    """

    start: NDArray[np.int64]
    frame: NDArray[np.int64]
    report: dict[str, Any]


def trigger_captures(
    samples: SampleSource,
    framing: PulseFraming,
    *,
    symbol_samples: int,
    false_alarms_per_s: float,
    sample_bits: int = 32,
) -> TriggeredCaptures:
    """Extract the complete symbols after preambles from a continuous recording.

    Parameters
    ----------
    samples
        (sample, 2), I and Q of the trigger channel, which are read in blocks.
    framing, symbol_samples, false_alarms_per_s
        As for `find_preambles`.
    sample_bits
        Bits per recorded sample of one channel.
    """
    blocks = (samples[start : start + _SAMPLES_AT_ONCE] for start in range(0, len(samples), _SAMPLES_AT_ONCE))
    detections = [
        detection
        for detection in find_preambles(
            blocks, framing, symbol_samples=symbol_samples, false_alarms_per_s=false_alarms_per_s
        )
        if detection.sample + framing.lead_samples + symbol_samples <= len(samples)
    ]
    starts = np.array([detection.sample for detection in detections], np.int64)
    numbers = [framing.read_counter(samples[start : start + framing.lead_samples]) for start in starts]
    duty_cycle = len(detections) * symbol_samples / len(samples)
    report = {
        "captures": len(detections),
        "false_alarms_per_s": false_alarms_per_s,
        "snr_db": round(float(np.median([detection.snr_db for detection in detections])), 2) if detections else None,
        "duty_cycle": duty_cycle,
        "mean_rate_bit_s": framing.sample_rate_hz * sample_bits * duty_cycle,  # of one channel
    }
    return TriggeredCaptures(starts + framing.lead_samples, np.array(numbers, np.int64), report)
