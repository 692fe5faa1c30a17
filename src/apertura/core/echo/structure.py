"""Structure of captures, estimated with the transmitted signal: channels, DFT length, band, order of I and Q."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.core.echo.demodulate import subcarrier_numbers

MOST_CHANNELS = 2
"""Largest number of interleaved channels that is tested: radar and sidelink."""

_BANDS: tuple[Literal["band_start", "band_centre"], ...] = ("band_start", "band_centre")

_CLEARER = 1.5
"""Ratio of compressions above which a hypothesis with more channels, or conjugate samples, is preferred."""

_FALSE_ALARM = 0.01
"""Probability at which captures of another signal are taken for the transmitted signal."""

_MOST_PERIODS = 4
"""Number of peaks of the autocorrelation whose lags are tested with the code."""

_SILENCE = 1e-6
"""Energy of an overlap, relative to the largest, below which rounding errors dominate."""


@dataclass(frozen=True)
class CaptureStructure:
    """Structure of captures that contain a known transmitted signal.

    Attributes
    ----------
    channels
        Number of interleaved channels.
    iq
        complex, or conjugate if the samples are the conjugates of the transmitted signal, as with I and Q swapped.
    sent_samples
        Number of code symbols, or of samples of the pulse.
    compression
        Largest fraction of the recorded energy that a single delay explains, 0 to 1; mean over captures and channels.
    dft_samples
        Period of an OFDM symbol, f_s/Δf; None for a pulse.
    carrier_is
        Position of the carrier in the band of an OFDM symbol, band_start or band_centre; None for a pulse.
    """

    channels: int
    iq: Literal["complex", "conjugate"]
    sent_samples: int
    compression: float
    dft_samples: int | None = None
    carrier_is: Literal["band_start", "band_centre"] | None = None


def capture_structure(
    captures: NDArray[np.complexfloating], sent: NDArray[np.complexfloating], *, channels: int | None = None
) -> CaptureStructure | None:
    """Estimate the structure of captures; None if they do not contain the transmitted signal.

    Parameters
    ----------
    captures
        (capture, number) complex, numbers I + jQ in the order of the file, with interleaved channels.
    sent
        (subcarrier,) code symbols of an OFDM symbol, or (sample,) samples of a pulse; both are tested. Code symbols
        that change from pulse to pulse: (capture, subcarrier).
    channels
        Number of channels, if it is known.

    Notes
    -----
    Source: docs/theory/recordings.md, eqs. 3 to 5.

    Examples
    --------
    >>> codes = np.exp(2j * np.pi * np.random.default_rng(1).random(48))
    >>> symbol = np.fft.ifft(codes, 80)
    >>> found = capture_structure(np.tile(np.concatenate([symbol, symbol[:20]]), (8, 1)), codes)
    >>> found.channels, found.dft_samples, found.carrier_is, round(found.compression, 3)
    (1, 80, 'band_start', 1.0)
    """
    hypotheses, best = list(_hypotheses(captures, sent, channels)), None
    for tested in hypotheses:
        needed = best and best.compression * (
            _CLEARER if tested.channels > best.channels or tested.iq != best.iq else 1.0
        )
        if needed is None or tested.compression > needed:
            best = tested
    # without the signal, each of N values of each hypothesis exceeds x with probability exp(-N·x)
    least = np.log(sent.shape[-1] * max(len(hypotheses), 1) / _FALSE_ALARM) / sent.shape[-1]
    return best if best is not None and best.compression > least else None


def _hypotheses(
    captures: NDArray[np.complexfloating], sent: NDArray[np.complexfloating], channels: int | None
) -> Iterator[CaptureStructure]:
    for count in range(1, MOST_CHANNELS + 1) if channels is None else (channels,):
        if captures.shape[1] % count:
            continue
        split = captures.reshape(len(captures), -1, count).transpose(0, 2, 1).reshape(len(captures) * count, -1)
        periods = _periods(split, sent.shape[-1])
        codes = np.repeat(sent, count, axis=0) if sent.ndim > 1 else sent[None]
        orders: dict[Literal["complex", "conjugate"], NDArray[np.complexfloating]]
        orders = {"complex": split, "conjugate": split.conj()}
        for iq, samples in orders.items():
            if sent.ndim == 1 and split.shape[1] >= sent.size:
                yield CaptureStructure(count, iq, sent.size, _pulse_compression(samples, sent))
            for period, carrier_is in product(periods, _BANDS):
                bins = subcarrier_numbers(sent.shape[-1], carrier_is=carrier_is) % period
                share = _code_compression(samples[:, -period:], codes, bins)
                yield CaptureStructure(count, iq, sent.shape[-1], share, period, carrier_is)


def _periods(samples: NDArray[np.complexfloating], subcarriers: int) -> list[int]:
    """Return the lags D of the largest normalised autocorrelation (eq. 3), at least N samples; none if too short."""
    length = samples.shape[1]
    if length <= subcarriers:
        return []
    size = scipy.fft.next_fast_len(2 * length)
    power = np.abs(samples) ** 2
    lags = np.arange(subcarriers, length)
    correlation = scipy.fft.ifft(np.abs(scipy.fft.fft(samples, size, axis=1)) ** 2, axis=1)[:, lags].sum(axis=0)
    before = np.concatenate([[0.0], np.cumsum(power.sum(axis=0))])
    energy = np.sqrt(before[length - lags] * (before[length] - before[lags]))
    # few overlapping samples correlate by chance, equally in all captures, because all pulses are identical
    level = np.abs(correlation) / np.maximum(energy, max(_SILENCE * energy.max(), 1e-300)) - 3 / np.sqrt(length - lags)
    padded = np.pad(level, 1, constant_values=-np.inf)
    is_peak = (level > padded[:-2]) & (level >= padded[2:]) & energy.any()
    strongest = np.argsort(-level[is_peak], kind="stable")[:_MOST_PERIODS]
    return [int(lag) for lag in lags[is_peak][strongest]]


def _code_compression(
    window: NDArray[np.complexfloating], codes: NDArray[np.complexfloating], bins: NDArray[np.int64]
) -> float:
    """Return the compression of a DFT window by the code, (capture, subcarrier) or one row (eq. 4)."""
    spectrum = scipy.fft.fft(window, axis=1)
    energy = (np.abs(spectrum) ** 2).sum(axis=1)
    matched = scipy.fft.ifft(spectrum[:, bins] * codes.conj(), axis=1) * codes.shape[1]
    return _share(matched, energy * (np.abs(codes) ** 2).sum(axis=1))


def _pulse_compression(samples: NDArray[np.complexfloating], pulse: NDArray[np.complexfloating]) -> float:
    """Return the compression of captures by the pulse (eq. 5)."""
    size = scipy.fft.next_fast_len(samples.shape[1] + pulse.size)
    matched = scipy.fft.ifft(scipy.fft.fft(samples, size, axis=1) * scipy.fft.fft(pulse, size).conj(), axis=1)
    energy = (np.abs(samples) ** 2).sum(axis=1) * float((np.abs(pulse) ** 2).sum())
    return _share(matched, energy)


def _share(matched: NDArray[np.complexfloating], energy: NDArray[np.float64]) -> float:
    has_signal = energy > 0
    peaks = (np.abs(matched[has_signal]) ** 2).max(axis=1)
    return float((peaks / energy[has_signal]).mean()) if has_signal.any() else 0.0
