"""The filter that removes a pulse from its echoes: its band, the choice between inverse and matched, and its loss.

A pulse is sent once, so a capture that contains it and its echoes to their end is a linear convolution: a DFT as long
as the capture turns it into a product, exactly, bin by bin (docs/theory/waveforms.md, eq. 1).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.units import decibels

BAND_FLOOR_DB = -10.0
"""dB below the highest power of the pulse, at which a band that is not stated ends."""

NULL_DB = -20.0
"""dB below the mean, at which bins are attenuated, not divided: noise is amplified by a hundred at most."""

FLAT_DB = -30.0
"""dB of ripple power below which a spectrum needs no division: its range sidelobes lie below."""

SIDELOBES_DB = -25.0
"""dB, sidelobes above which are flagged; those of the Hann window are -31.5 dB."""

MOST_LOSS_DB = 6.0
"""dB of signal to noise ratio, the largest loss of a chosen division; a requested one beyond it is flagged."""

_SMOOTH = 64  # parts of the sampled band over which its level is averaged


@dataclass(frozen=True)
class PulseFilter:
    """The filter of echoes, and its loss.

    Attributes
    ----------
    inverse
        (bin,) complex64, by which the DFT of a capture is multiplied.
    report
        Name of the filter, its reason, loss_db (of signal to noise ratio against the matched filter) and sidelobes_db
        (the highest beside a point in range, by a Hann window).
    flags
        Edge crossed → what was measured, in one line.
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
        Samples, possibly fractional, that a capture begins before the pulse.
    length
        Samples of the capture.

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
    """Return the first and the last number of the DFT's bins, counted from baseband zero, between which a pulse lies.

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
    strong = first + np.flatnonzero(ordered[first : last + 1] >= threshold)  # the mean runs over the edges of the band
    return int(strong[0]) - length // 2, int(strong[-1]) - length // 2


def pulse_filter(spectrum: NDArray[np.complexfloating], *, requested: str) -> PulseFilter:
    """Return the filter of a pulse.

    Parameters
    ----------
    spectrum
        (bin,) complex, S over the band.
    requested
        inverse, matched, or auto: matched for a flat spectrum, else inverse where it is adequate.

    Raises
    ------
    ValueError
        If the band has no energy.

    Notes
    -----
    Source: docs/theory/waveforms.md, "Which filter".

    Examples
    --------
    >>> chirp = np.exp(1j * np.pi * np.arange(-50, 50) ** 2 / 125)
    >>> pulse_filter(pulse_spectrum(chirp, lead=0, length=200)[:60], requested="auto").report["filter"]
    'inverse'
    """
    power = np.abs(np.asarray(spectrum, np.complex128)) ** 2
    mean = float(power.mean())
    if not mean > 0:
        raise ValueError("the band holds no energy")
    inverse = np.conj(spectrum) / np.maximum(power, mean * 10 ** (NULL_DB / 10))
    uneven_db, loss_db = decibels(max(float(power.var() / mean**2), 1e-10)), _loss_db(spectrum, inverse)
    sidelobes_db = _sidelobes_db(spectrum * inverse)
    if requested != "auto":
        name, reason = requested, "asked for"
    elif uneven_db <= FLAT_DB:
        name, reason = "matched", f"a flat spectrum: matched scatters {uneven_db:.1f} dB in range"
    elif loss_db <= MOST_LOSS_DB and sidelobes_db <= SIDELOBES_DB:
        name, reason = "inverse", f"matched would scatter {uneven_db:.1f} dB in range; inverse loses {loss_db:.2f} dB"
    else:
        name, reason = "matched", f"inverse would lose {loss_db:.1f} dB, and leave sidelobes of {sidelobes_db:.1f} dB"
    chosen = inverse if name == "inverse" else np.conj(spectrum) / mean
    loss_db, sidelobes_db = _loss_db(spectrum, chosen), _sidelobes_db(spectrum * chosen)
    flags = {}
    if sidelobes_db > SIDELOBES_DB:
        flags["waveform_sidelobes"] = f"{name} leaves sidelobes of {sidelobes_db:.1f} dB in range beside every point"
    if loss_db > MOST_LOSS_DB:
        flags["waveform_noise"] = (
            f"{name} loses {loss_db:.1f} dB of the signal to noise ratio: {np.mean(power < mean / 10):.0%} of the band "
            "lies 10 dB below its mean"
        )
    report = {"filter": name, "reason": reason, "loss_db": round(loss_db, 2), "sidelobes_db": round(sidelobes_db, 1)}
    return PulseFilter(np.asarray(chosen, np.complex64), report, flags)


def truncation_flags(
    delay_s: Floats, *, lead_s: float, pulse_s: float, listen_s: float, cell_s: float
) -> dict[str, str]:
    """Return the flag of captures that truncate the direct pulse; none: {}.

    Parameters
    ----------
    delay_s
        (pulse,) float64, of the direct path, seconds after `lead_s`, modulo the length of the capture; NaN: unknown.
    lead_s, pulse_s, listen_s
        Parts of a capture, seconds.
    cell_s
        1/B, by which a delay may err.

    Examples
    --------
    >>> truncation_flags(np.array([0.1, -0.4, 1.1]), lead_s=0.2, pulse_s=1.0, listen_s=1.0, cell_s=0.05)
    {'pulse_truncated': 'captures of 2 of 3 pulses begin in the direct pulse, or end in it'}
    """
    known = delay_s[np.isfinite(delay_s)]
    length_s = lead_s + pulse_s + listen_s
    # a delay is known modulo the capture's length: half of the pulse may be missing on either side
    after_s = (known + lead_s + pulse_s / 2) % length_s - pulse_s / 2
    cut = int(((after_s < -cell_s) | (after_s > lead_s + listen_s + cell_s)).sum())
    line = f"captures of {cut} of {len(delay_s)} pulses begin in the direct pulse, or end in it"
    return {"pulse_truncated": line} if cut else {}


def _loss_db(spectrum: NDArray[np.complexfloating], filtered: NDArray[np.complexfloating]) -> float:
    """Return the loss of signal to noise ratio of a filter against the matched one, dB (Schwarz: 0 or more)."""
    gain = abs(np.vdot(np.conj(filtered), spectrum)) ** 2
    kept = gain / ((np.abs(filtered) ** 2).sum() * (np.abs(spectrum) ** 2).sum())
    return -decibels(min(kept, 1.0)) + 0.0


def _sidelobes_db(response: NDArray[np.complexfloating]) -> float:
    """Return the highest sidelobe in range of a response over the band, dB: a Hann window's main lobe left out."""
    window = np.hanning(len(response))
    profile = np.abs(scipy.fft.ifft(response * window, 4 * len(response)))
    lobe = 4 * 2 + 2  # two cells to its first null
    beyond = profile[lobe:-lobe].max(initial=1e-12 * profile[0])
    return float(20 * np.log10(beyond / profile[0]))
