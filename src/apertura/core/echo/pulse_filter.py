"""Compression filter for a pulse without repetition: occupied band, choice of inverse or matched filter, and loss.

A capture that contains the pulse and the complete echoes is a linear convolution. A DFT of the length of the capture
transforms this convolution into an exact product, bin by bin (docs/theory/waveforms.md, eq. 1).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.units import decibels

BAND_FLOOR_DB = -10.0
"""Level of the band edges if the band is not configured, dB relative to the highest spectral power of the pulse."""

NULL_DB = -20.0
"""Spectral level, dB relative to the mean, below which the inverse filter attenuates bins instead of inverting them;
limits the noise amplification to 20 dB."""

FLAT_DB = -30.0
"""Ripple power, dB, below which a spectrum is not inverted: the range sidelobes from ripple are below this level."""

SIDELOBES_DB = -25.0
"""Level of range sidelobes above which a flag is raised, dB; the sidelobes of the Hann window are at -31.5 dB."""

MOST_LOSS_DB = 6.0
"""Largest SNR loss for which the inverse filter is chosen, dB. A flag is raised if the loss of a requested filter is
larger."""

_SMOOTH = 64  # the spectral level is averaged over 1/64 of the sampled band


@dataclass(frozen=True)
class PulseFilter:
    """Compression filter of echoes, and loss of the filter.

    Attributes
    ----------
    inverse
        (bin,) complex64, factor by which the DFT of a capture is multiplied.
    report
        Name of the filter, reason for its choice, loss_db (SNR loss relative to the matched filter), and sidelobes_db
        (highest range sidelobe of a point with a Hann window).
    flags
        Flag → measured values, one line.
    """

    inverse: NDArray[np.complex64]
    report: dict[str, Any]
    flags: dict[str, str]


def pulse_spectrum(pulse: NDArray[np.complexfloating], *, lead: float, length: int) -> NDArray[np.complex128]:
    """Return the DFT of a capture of the pulse alone, (length,) complex128, in the units of `demodulate`.

    Parameters
    ----------
    pulse
        (sample,) complex.
    lead
        Number of samples of the capture before the pulse; may be fractional.
    length
        Number of samples of the capture.

    Notes
    -----
    Source: docs/theory/waveforms.md, eq. 2.

    Examples
    --------
    >>> pulse_spectrum(np.array([4.0 + 0j]), lead=1, length=4).round(6) + 0
    array([ 1.+0.j,  0.-1.j, -1.+0.j,  0.+1.j])
    """
    number = scipy.fft.fftfreq(length, 1 / length)
    return np.asarray(scipy.fft.fft(pulse, length, norm="forward") * np.exp(-2j * np.pi * number * lead / length))


def occupied_band(power: Floats) -> tuple[int, int]:
    """Return the first and the last DFT bin of the occupied band of a pulse, counted from baseband zero.

    Parameters
    ----------
    power
        (bin,) float64, |S|² in the order of a DFT.

    Examples
    --------
    >>> occupied_band(np.where(abs(scipy.fft.fftfreq(640, 1 / 640)) <= 50, 1.0, 1e-6))
    (-50, 50)
    """
    length = len(power)
    ordered = scipy.fft.fftshift(power)
    level = scipy.ndimage.uniform_filter1d(ordered, max(1, length // _SMOOTH), mode="wrap")
    threshold = level.max() * 10 ** (BAND_FLOOR_DB / 10)
    below = np.flatnonzero(level < threshold)
    top = int(level.argmax())
    first = int(below[below < top].max(initial=-1)) + 1
    last = int(below[below > top].min(initial=length)) - 1
    # the running mean widens the band: restrict the band to bins with a power above the threshold
    strong = first + np.flatnonzero(ordered[first : last + 1] >= threshold)
    return int(strong[0]) - length // 2, int(strong[-1]) - length // 2


def pulse_filter(spectrum: NDArray[np.complexfloating], *, requested: str) -> PulseFilter:
    """Choose the compression filter of a pulse.

    Parameters
    ----------
    spectrum
        (bin,) complex, spectrum S of the pulse over the band.
    requested
        'inverse', 'matched', or 'auto': matched for a flat spectrum; otherwise inverse if loss and sidelobes are
        acceptable.

    Raises
    ------
    ValueError
        If the band has no energy.

    Notes
    -----
    Source: docs/theory/waveforms.md, "Selection of the filter".

    Examples
    --------
    >>> chirp = np.exp(1j * np.pi * np.arange(-50, 50) ** 2 / 125)
    >>> pulse_filter(pulse_spectrum(chirp, lead=0, length=200)[:60], requested="auto").report["filter"]
    'inverse'
    """
    power = np.abs(np.asarray(spectrum, np.complex128)) ** 2
    mean = float(power.mean())
    if not mean > 0:
        raise ValueError("the spectrum of the pulse has no energy in the band")
    inverse = np.conj(spectrum) / np.maximum(power, mean * 10 ** (NULL_DB / 10))
    uneven_db, loss_db = decibels(max(float(power.var() / mean**2), 1e-10)), _loss_db(spectrum, inverse)
    sidelobes_db = _sidelobes_db(spectrum * inverse)
    if requested != "auto":
        name, reason = requested, "requested"
    elif uneven_db <= FLAT_DB:
        name, reason = "matched", f"flat spectrum: ripple of {uneven_db:.1f} dB"
    elif loss_db <= MOST_LOSS_DB and sidelobes_db <= SIDELOBES_DB:
        name = "inverse"
        reason = f"spectrum with ripple of {uneven_db:.1f} dB; inverse filter with an SNR loss of {loss_db:.2f} dB"
    else:
        name = "matched"
        reason = f"the inverse filter has an SNR loss of {loss_db:.1f} dB and sidelobes of {sidelobes_db:.1f} dB"
    chosen = inverse if name == "inverse" else np.conj(spectrum) / mean
    loss_db, sidelobes_db = _loss_db(spectrum, chosen), _sidelobes_db(spectrum * chosen)
    flags = {}
    if sidelobes_db > SIDELOBES_DB:
        flags["waveform_sidelobes"] = f"range sidelobes of {sidelobes_db:.1f} dB after the {name} filter"
    if loss_db > MOST_LOSS_DB:
        flags["waveform_noise"] = (
            f"SNR loss of the {name} filter {loss_db:.1f} dB: {np.mean(power < mean / 10):.0%} of the band is more "
            "than 10 dB below the mean of the band"
        )
    report = {"filter": name, "reason": reason, "loss_db": round(loss_db, 2), "sidelobes_db": round(sidelobes_db, 1)}
    return PulseFilter(np.asarray(chosen, np.complex64), report, flags)


def truncation_flags(
    delay_s: Floats, *, lead_s: float, pulse_s: float, listen_s: float, cell_s: float
) -> dict[str, str]:
    """Return a flag for captures that truncate the direct pulse; {} if there are none.

    Parameters
    ----------
    delay_s
        (pulse,) float64, delay of the direct path, seconds after `lead_s`, modulo the length of the capture; NaN:
        unknown.
    lead_s, pulse_s, listen_s
        Lengths of the parts of a capture before, during and after the pulse, seconds.
    cell_s
        Tolerated error of a delay, 1/B, seconds.

    Examples
    --------
    >>> truncation_flags(np.array([0.1, -0.4, 1.1]), lead_s=0.2, pulse_s=1.0, listen_s=1.0, cell_s=0.05)
    {'pulse_truncated': 'captures of 2 of 3 pulses start or end within the direct pulse'}
    """
    known = delay_s[np.isfinite(delay_s)]
    length_s = lead_s + pulse_s + listen_s
    # a delay is known only modulo the length of the capture: up to half of the pulse may be missing at either end
    after_s = (known + lead_s + pulse_s / 2) % length_s - pulse_s / 2
    cut = int(((after_s < -cell_s) | (after_s > lead_s + listen_s + cell_s)).sum())
    line = f"captures of {cut} of {len(delay_s)} pulses start or end within the direct pulse"
    return {"pulse_truncated": line} if cut else {}


def _loss_db(spectrum: NDArray[np.complexfloating], filtered: NDArray[np.complexfloating]) -> float:
    """Return the SNR loss of a filter relative to the matched filter, dB; 0 or more (Cauchy-Schwarz)."""
    gain = abs(np.vdot(np.conj(filtered), spectrum)) ** 2
    kept = gain / ((np.abs(filtered) ** 2).sum() * (np.abs(spectrum) ** 2).sum())
    return -decibels(min(kept, 1.0)) + 0.0


def _sidelobes_db(response: NDArray[np.complexfloating]) -> float:
    """Return the highest range sidelobe of a response over the band, outside the main lobe of a Hann window, dB."""
    window = np.hanning(len(response))
    profile = np.abs(scipy.fft.ifft(response * window, 4 * len(response)))
    lobe = 4 * 2 + 2  # the first null is at two cells
    highest = profile[lobe:-lobe].max(initial=1e-12 * profile[0])
    return float(20 * np.log10(highest / profile[0]))
