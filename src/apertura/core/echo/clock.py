"""Clock offset of a receiver relative to the transmitter: measurement on the sidelink, and decision on correction.

The symbol has the period 1/Δf and is longer than one period. The start of a capture is therefore repeated at the end,
rotated by the carrier offset and shifted by the sampling offset. The measurement requires neither the code nor the
delay. For a pulse without repetition, the clock offset is not measurable, and is not required for the division by the
sidelink (docs/theory/waveforms.md, "Clock").
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.units import decibels
from apertura.core.echo.captures import AT_ONCE, spread
from apertura.core.echo.demodulate import Numerology

SIGMAS = 3.0
"""Number of standard deviations below which a clock offset is not significant and is not corrected."""

AMBIGUOUS_SHARE = 0.4
"""Carrier offset relative to Δf above which the sign is uncertain, because offsets beyond half of Δf are ambiguous."""

GROUPS = 16
"""Number of parts of the flight, from the scatter of which the standard deviation of the clock offset is computed."""

_SMALLEST_REPEAT = 32  # minimum number of repeated samples in a capture
_TAPERED = 0.25
"""Tapered fraction of the repeated samples, both ends together. A capture that is triggered late extends beyond the end
of the symbol. Without a taper, the phase error for a chirp-like code was 70 standard deviations, 0.1 ppm or more."""


@dataclass(frozen=True)
class ClockOffset:
    """Frequency offsets of a receiver relative to the transmitter.

    Attributes
    ----------
    cfo_hz
        Oscillator frequency of the receiver minus that of the transmitter, at the midpoint of the flight, hertz.
    cfo_slope_hz
        Change of the carrier offset per pulse, hertz; 0 if the change is not significant.
    sfo_ppm
        Relative offset of the receiver's sampling rate from the transmitter's, parts per million.
    cfo_std_hz, sfo_std_ppm
        Standard deviations from the scatter over the flight; for `sfo_ppm`, that of the direct measurement.
    one_clock
        True if `sfo_ppm` is derived from the carrier offset because this agrees with the direct measurement.
    """

    cfo_hz: float
    cfo_slope_hz: float
    sfo_ppm: float
    cfo_std_hz: float
    sfo_std_ppm: float
    one_clock: bool

    def ppm(self, numerology: Numerology) -> tuple[float, float | None]:
        """Return the offset of the oscillator and its standard deviation, ppm; None if the latter is unknown."""
        std_ppm = self.cfo_std_hz / numerology.carrier_hz * 1e6
        return self.cfo_hz / numerology.carrier_hz * 1e6, std_ppm if np.isfinite(std_ppm) else None

    def cfo_of_pulses_hz(self, pulses: int) -> Floats:
        """Return the carrier offset in each pulse of the flight, (pulse,) float64, hertz."""
        return np.asarray(self.cfo_hz + self.cfo_slope_hz * (np.arange(pulses) - (pulses - 1) / 2))


@dataclass(frozen=True)
class ClockDecision:
    """Decision on the clock correction, its reason, and the interference floor without correction."""

    correct: bool
    reason: str
    floor_db: float
    flags: dict[str, str]


def estimate_clock(sidelink: Complexes, numerology: Numerology) -> ClockOffset:
    """Measure the clock offset of a receiver on the sidelink of a whole flight, (pulse, sample); see `clock_of`.

    Examples
    --------
    >>> numerology = Numerology(1e9, 64e6, np.arange(32), prefix_samples=16, dft_samples=64)
    >>> tones = np.exp(2j * np.pi * np.outer(np.arange(32), np.arange(120) / 64) + 1j * np.arange(32)[:, None] ** 2)
    >>> turning = tones.sum(0) * np.exp(-2j * np.pi * 5e3 * np.arange(120) / 64e6)
    >>> clock = estimate_clock(np.tile(turning, (4, 1)).astype(np.complex64), numerology)
    >>> round(clock.cfo_hz), round(clock.sfo_ppm), clock.one_clock
    (5000, 0, False)
    """
    groups = spread(len(sidelink), groups=GROUPS, each=len(sidelink))
    return clock_of((sidelink[group] for group in groups), numerology, pulses=len(sidelink))


def clock_of(groups: Iterable[Complexes], numerology: Numerology, *, pulses: int) -> ClockOffset:
    """Measure the clock offset of a receiver on its sidelink.

    Parameters
    ----------
    groups
        (pulse, sample) complex64 each, groups of captures from equal parts of the flight. Captures extend from the
        start of the cyclic prefix to the end of the symbol (T_cp + T) at most; pulses without signal are permitted.
    numerology
        Numerology of the symbol.
    pulses
        Number of pulses of the whole flight.

    Raises
    ------
    ValueError
        If captures contain too few repeated samples, or if the transmitted signal has no repetition.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Clock". The result is unambiguous for |CFO| < Δf/2.
    """
    if not numerology.repeats:
        raise ValueError(
            "clock offset not measurable in pulses without repetition (and not required for division by the sidelink)"
        )
    period_s = 1 / numerology.spacing_hz
    frequency_hz, parts, _ = _repetition(groups, numerology)
    phase, slope, centre_hz = _phase_and_slope(parts.sum(0), frequency_hz, start=(0.0, 0.0))
    fits = np.array([_phase_and_slope(part, frequency_hz, start=(phase, slope))[:2] for part in parts])
    growth, phase_std = _line(fits[:, 0])
    ppm = 1e6 / (2 * np.pi * period_s)
    sfo_ppm, sfo_std_ppm = -slope * ppm, _line(fits[:, 1])[1] * ppm
    joint_ppm = -phase * ppm / (numerology.carrier_hz + centre_hz)  # if one clock drives oscillator and converter
    one_clock = abs(sfo_ppm - joint_ppm) <= 3 * sfo_std_ppm
    sfo_ppm = joint_ppm if one_clock else sfo_ppm
    cfo_std_hz = phase_std / (2 * np.pi * period_s)
    if not one_clock:  # add the error of the slope, with which the carrier offset is extrapolated from the band centre
        cfo_std_hz = float(np.hypot(cfo_std_hz, centre_hz * sfo_std_ppm * 1e-6))
    return ClockOffset(
        cfo_hz=-phase / (2 * np.pi * period_s) - centre_hz * sfo_ppm * 1e-6,
        cfo_slope_hz=-growth * len(parts) / (2 * np.pi * period_s * pulses),
        sfo_ppm=sfo_ppm,
        cfo_std_hz=cfo_std_hz,
        sfo_std_ppm=sfo_std_ppm,
        one_clock=bool(one_clock),
    )


def decide_clock(offset: ClockOffset, numerology: Numerology, *, accuracy_db: float) -> ClockDecision:
    """Decide on the correction of a clock offset for a tolerated error of `accuracy_db` relative to the peak.

    Examples
    --------
    >>> numerology = Numerology(1.2e9, 1.024e9, np.arange(4096), prefix_samples=3200, dft_samples=10240)
    >>> for ppm in (0.5, 8.0):
    ...     clock = ClockOffset(1200 * ppm, 0.0, ppm, cfo_std_hz=1.0, sfo_std_ppm=0.1, one_clock=True)
    ...     print(decide_clock(clock, numerology, accuracy_db=-60).reason)
    clock +0.50 ± 0.00 ppm (CFO 600 Hz, SFO 0.50 ppm): floor -71.0 dB, -60 dB tolerated: not corrected
    clock +8.00 ± 0.00 ppm (CFO 9600 Hz, SFO 8.00 ppm): floor -47.0 dB, -60 dB tolerated: samples corrected
    """
    floor_db = interference_floor_db(offset.cfo_hz, offset.sfo_ppm, numerology)
    ppm, std_ppm = offset.ppm(numerology)
    residual_db = 0.0  # floor caused by the error of the correction
    if std_ppm is not None:
        sfo_std_ppm = std_ppm if offset.one_clock else offset.sfo_std_ppm
        residual_db = interference_floor_db(offset.cfo_std_hz, sfo_std_ppm, numerology)
    significant = abs(offset.cfo_hz) > SIGMAS * offset.cfo_std_hz or (
        not offset.one_clock and abs(offset.sfo_ppm) > SIGMAS * offset.sfo_std_ppm
    )
    correct = floor_db > accuracy_db and significant
    uncorrected = "not corrected" if significant else f"not corrected: below {SIGMAS:g} σ"
    reason = (
        f"clock {ppm:+.2f} ± {0 if std_ppm is None else std_ppm:.2f} ppm (CFO {offset.cfo_hz:.0f} Hz, "
        f"SFO {offset.sfo_ppm:.2f} ppm): floor {floor_db:.1f} dB, {accuracy_db:g} dB tolerated: "
        f"{'samples corrected' if correct else uncorrected}"
    )
    flags = {}
    if abs(offset.cfo_hz) > AMBIGUOUS_SHARE * numerology.spacing_hz:
        flags["clock_ambiguous"] = (
            f"CFO {offset.cfo_hz:+.0f} Hz is close to half a subcarrier ({numerology.spacing_hz / 2:.0f} Hz): "
            "the measured CFO may be wrong by an integer number of subcarriers"
        )
    if residual_db > accuracy_db:
        flags["clock_uncertain"] = (
            f"standard deviation of the clock offset {offset.cfo_std_hz:.0f} Hz, which causes a floor of "
            f"{residual_db:.1f} dB; {accuracy_db:g} dB tolerated"
        )
    return ClockDecision(correct, reason, floor_db, flags)


def interference_floor_db(cfo_hz: float, sfo_ppm: float, numerology: Numerology) -> float:
    """Return the interference floor caused by a clock offset in a range profile, dB relative to the peak.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Clock": a tone offset by δ bins retains sinc²(δ) of its power. In the echo and
    in the sidelink, the remaining power leaks into the other subcarriers; compression spreads it over N cells.

    Examples
    --------
    >>> numerology = Numerology(1.2e9, 1.024e9, np.arange(4096), prefix_samples=3200, dft_samples=10240)
    >>> round(interference_floor_db(10e3, 0.0, numerology), 1)
    -48.0
    """
    offset_bins = (cfo_hz + numerology.numbers * numerology.spacing_hz * sfo_ppm * 1e-6) / numerology.spacing_hz
    leakage = float(np.mean(1 - np.sinc(offset_bins) ** 2))
    return decibels(2 * leakage / numerology.numbers.size)


_INTERFERED = 20.0
"""Power relative to the median, above which a frequency is not used."""


def repeated_share(captures: Complexes, numerology: Numerology) -> float:
    """Return the share S/(S + N) of repeated signals in the power of captures, (pulse, sample); 0.1 or less in noise.

    Parameters
    ----------
    captures
        At least 64 captures, from the start of the cyclic prefix to the end of the symbol; echoes need no code.

    Raises
    ------
    ValueError
        As `clock_of`.

    Notes
    -----
    The share is the median over the frequencies of the coherence between start and end, which excludes tones.

    Examples
    --------
    >>> numerology = Numerology(1e9, 64e6, np.arange(32), prefix_samples=16, dft_samples=64)
    >>> noise = np.random.default_rng(1).normal(size=(100, 120, 2)).astype(np.float32).view(np.complex64)[..., 0]
    >>> repeated_share(noise, numerology) < 0.2, repeated_share(np.tile(noise[:, :64], 2)[:, :120], numerology) > 0.99
    (True, True)
    """
    _, cross, power = _repetition([captures], numerology)
    return float(np.median(np.abs(cross[0]) / np.maximum(power[0], np.finfo(float).tiny)))


def _repetition(
    groups: Iterable[Complexes], numerology: Numerology
) -> tuple[Floats, NDArray[np.complex128], NDArray[np.float64]]:
    """Return the occupied frequencies, and the cross-spectra and mean power spectra of end and start in each group."""
    spectra = [_cross_spectrum(pulses, numerology) for pulses in groups]
    size = spectra[0][0].size
    lowest_hz = numerology.middle_hz - numerology.sample_rate_hz / 2
    frequency_hz = (
        scipy.fft.fftfreq(size, 1 / numerology.sample_rate_hz) - lowest_hz
    ) % numerology.sample_rate_hz + lowest_hz
    occupied = np.abs(frequency_hz - numerology.middle_hz) <= numerology.numbers.size * numerology.spacing_hz / 2
    parts, power = (np.array(part)[:, occupied] for part in zip(*spectra, strict=True))
    # Interference repeats with another phase. The signal itself has nearly the same power at all frequencies.
    interfered = np.abs(parts) > _INTERFERED * np.median(np.abs(parts), axis=1, keepdims=True)
    return frequency_hz[occupied], np.where(interfered, 0, parts), power


def _cross_spectrum(sidelink: Complexes, numerology: Numerology) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    period, prefix, count = numerology.dft_samples, numerology.prefix_samples, sidelink.shape[1]
    start = prefix if count - period - prefix >= prefix // 2 else prefix // 2
    length = count - period - start
    if length < _SMALLEST_REPEAT:
        raise ValueError(f"captures of {count} samples repeat only {length} samples; {_SMALLEST_REPEAT} are required")
    taper = _taper(length)
    size = scipy.fft.next_fast_len(length)
    cross, power = np.zeros(size, np.complex128), np.zeros(size)
    for first in range(0, len(sidelink), AT_ONCE):
        block = sidelink[first : first + AT_ONCE].astype(np.complex128)
        early = scipy.fft.fft(block[:, start : start + length] * taper, size, axis=1)
        late = scipy.fft.fft(block[:, start + period : start + period + length] * taper, size, axis=1)
        cross += (late * early.conj()).sum(0)
        power += (np.abs(late) ** 2 + np.abs(early) ** 2).sum(0) / 2
    return cross, power


def _taper(length: int) -> Floats:
    """Return a Tukey window with the tapered fraction `_TAPERED`; importing scipy.signal would take a second."""
    edge = np.minimum(np.arange(length), np.arange(length)[::-1]) / (_TAPERED / 2 * (length - 1))
    return np.asarray((1 - np.cos(np.pi * np.minimum(edge, 1))) / 2)


def _phase_and_slope(
    cross: NDArray[np.complex128], frequency_hz: Floats, *, start: tuple[float, float]
) -> tuple[float, float, float]:
    """Fit a line to the phase: return phase (rad) at the weighted mean frequency, slope (rad/Hz) and this frequency."""
    weight = np.abs(cross)
    centre_hz = float(np.average(frequency_hz, weights=weight))
    off_hz = frequency_hz - centre_hz
    phase, slope = start
    for _ in range(6):
        rotated = cross * np.exp(-1j * (phase + slope * off_hz))
        slope += float((off_hz * rotated.imag).sum() / (off_hz**2 * rotated.real).sum())
        phase += float(np.angle(rotated.sum()))
    return phase, slope, centre_hz


def _line(values: Floats) -> tuple[float, float]:
    """Return the slope per step (0 below four standard deviations), and the standard deviation of the mean."""
    count = values.size
    if count < 3:
        return 0.0, np.inf
    step = np.arange(count) - (count - 1) / 2
    slope = float(step @ values / (step @ step))
    scatter = float(np.sqrt(((values - values.mean() - slope * step) ** 2).sum() / (count - 2)))
    slope_std = scatter / float(np.sqrt(step @ step))
    return (slope if abs(slope) > 4 * slope_std else 0.0), scatter / float(np.sqrt(count))
