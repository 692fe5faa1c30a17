"""Disturbances of a sidelink that its echoes do not share: pulses with an outlying phase, and periodic modulation.

Oscillator, trigger and motion of the nodes change the phase of sidelink and echo alike, and the correction removes
them. A rotor blade or the airframe in the line of sight changes the sidelink alone, and the correction imprints the
change on the echo. Equations: docs/theory/sidelink_spikes.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.core.echo.line_of_sight import LineOfSight
from apertura.core.echo.sidelink_state import ECHO_DB

WINDOW = 9
"""Pulses of the running median; outliers are detected if they are the minority of each window."""

SCALE_WINDOW = 129
"""Pulses over which the standard deviation is estimated, with a relative standard deviation of 10 %."""

SIGMAS = 6.0
"""Deviation of an outlier from the running median, standard deviations: false alarms below 10⁻⁵ per pulse (eq. 4)."""

MEASURABLE_RAD = 2.0
"""Limit of an outlier up to which phases have a median; random phases of a receiver have none."""

EXCLUDED_RAD = np.pi / 3
"""Phase error above which a pulse degrades the image more than its absence does (eq. 5)."""

TOLERATED_LOSS_DB = 0.2
"""Peak loss by the remaining outliers below which they are not reported; the minimum loss that images resolve."""

LINE_FALSE_ALARM = 1e-6
"""Probability that noise alone causes a line in the spectrum of a flight."""

MOTION_HZ = 3.0
"""Frequency below which modulation is attributed to the motion of the platforms."""

_LEAST_PULSES = 64  # for the standard deviation
_DETREND = 33  # pulses over which the rotation of the phase is averaged
_SEGMENT = 256  # pulses of a periodogram, during which the speed of a rotor is nearly constant
_NEAR, _FAR = 4, 19  # distance of the bins, from a line, whose mean is its noise floor


@dataclass(frozen=True)
class SidelinkSpikes:
    """Outlying pulses and periodic modulation of a sidelink.

    Attributes
    ----------
    error_rad
        (pulse,) float64, deviation of the phase from the running median in outlying pulses; 0 in other pulses.
    excluded
        (pulse,) bool, outlying pulses whose phase error exceeds `EXCLUDED_RAD`.
    flags
        Flag → measured values, one line.
    """

    error_rad: Floats
    excluded: NDArray[np.bool_]
    flags: Mapping[str, str]


def find_spikes(
    path: LineOfSight, length_cells: Floats, time_s: Floats, *, cycles_per_cell: float, wave_m: float
) -> SidelinkSpikes:
    """Detect pulses in which sidelink and echo have different phase errors, and periodic modulation.

    Parameters
    ----------
    path
        Direct path in each pulse.
    length_cells
        (pulse,) float64, length of the sidelink from the flight logs, cells of c/B.
    time_s
        (pulse,) float64, time of transmission, seconds from any origin, ascending.
    cycles_per_cell
        f_mid/B.
    wave_m
        Wavelength at f_mid, metres.

    Notes
    -----
    Source: docs/theory/sidelink_spikes.md, eqs. 1 to 6.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(size=(3, 300))
    >>> phase = 0.05 * noise[0]
    >>> phase[[70, 200]] += 2.0
    >>> ones = np.ones(300)
    >>> path = LineOfSight(1e-3 * noise[1], phase, ones + 0.01 * noise[2], 1e-2 * ones, ones > 0)
    >>> found = find_spikes(path, 0 * ones, np.arange(300) / 50, cycles_per_cell=3.0, wave_m=0.25)
    >>> np.flatnonzero(found.excluded)
    array([ 70, 200])
    """
    nothing = np.zeros(len(time_s)), np.zeros(len(time_s), bool)
    locked = np.flatnonzero(path.locked)
    if locked.size < _LEAST_PULSES:
        return SidelinkSpikes(*nothing, {})
    apart_s = np.diff(time_s[locked])
    # a low quantile, because most pulses may be missing; steps are rounded singly, so that its error does not add up
    steps = np.maximum(1, np.rint(apart_s / np.quantile(apart_s, 0.1)))
    number = np.concatenate([[0], np.cumsum(steps)]).astype(np.intp)
    prf_hz = float(number[-1] / apart_s.sum())
    late_cells = path.delay_cells[locked] - length_cells[locked]
    # eqs. 1 and 2: the phase of a shift of the time base follows the carrier (`triggered`) or not (`phase`)
    phase = path.phase_rad[locked] + 2 * np.pi * cycles_per_cell * length_cells[locked]
    triggered = phase + 2 * np.pi * cycles_per_cell * late_cells
    residuals = [_Residual.of(angle, number) for angle in (phase, triggered)]
    measurable = [residual.limit_rad < MEASURABLE_RAD for residual in residuals]
    outlying = measurable[0] | measurable[1]
    for residual, usable in zip(residuals, measurable, strict=True):
        outlying &= ~usable | (np.abs(residual.deviation_rad) > residual.limit_rad)
    errors = np.where(measurable[0], residuals[0].deviation_rad, residuals[1].deviation_rad)
    error_rad, excluded = nothing
    error_rad[locked] = np.where(outlying, errors, 0.0)
    excluded[:] = np.abs(error_rad) > EXCLUDED_RAD
    steadier = min(residuals, key=lambda residual: float(np.median(residual.limit_rad)))
    cleaned = np.where(outlying, 0.0, steadier.detrended_rad)
    level = np.log(path.amplitude[locked])
    level -= scipy.ndimage.uniform_filter1d(level, _DETREND)
    flags = {**_spike_flags(error_rad, excluded, wave_m), **_line_flags(cleaned, level, number, prf_hz)}
    return SidelinkSpikes(error_rad, excluded, flags)


@dataclass(frozen=True)
class _Residual:
    """Derotated phase, its deviation from the running median, and the outlier threshold."""

    detrended_rad: Floats
    deviation_rad: Floats
    limit_rad: Floats

    @classmethod
    def of(cls, phase_rad: Floats, number: NDArray[np.intp]) -> "_Residual":
        """Return the residual of phases of pulses of the given numbers, from which pulses may be missing."""
        step = np.diff(number)
        turning = np.where(step == 1, np.exp(1j * np.diff(phase_rad)), 0)
        rotation = np.angle(scipy.ndimage.uniform_filter1d(turning, _DETREND))
        unit = np.exp(1j * (phase_rad - np.concatenate([[0.0], np.cumsum(rotation * step)])))
        middle = _around(unit, WINDOW)
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(unit, WINDOW // 2, mode="symmetric"), WINDOW)
        angles = np.angle(windows * middle.conj()[:, None])
        others = np.delete(angles, WINDOW // 2, axis=1)  # a pulse that is itself the median has no deviation
        spread = np.abs(np.angle(np.exp(1j * (angles[:, WINDOW // 2] - np.median(others, axis=1)))))
        limit = SIGMAS * 1.4826 * scipy.ndimage.median_filter(spread, SCALE_WINDOW)
        # the median of all pulses, this one included, is that of the pulses on the same side of a step of the clock
        deviation = np.angle(np.exp(1j * (angles[:, WINDOW // 2] - np.median(angles, axis=1))))
        return cls(np.angle(unit * _around(unit, _DETREND).conj()), deviation, limit)


def _around(unit: NDArray[np.complex128], pulses: int) -> NDArray[np.complex128]:
    """Return unit phasors of the mean over neighbouring pulses."""
    return np.asarray(np.exp(1j * np.angle(scipy.ndimage.uniform_filter1d(unit, pulses))))


def _spike_flags(error_rad: Floats, excluded: NDArray[np.bool_], wave_m: float) -> dict[str, str]:
    """Return the flag of outlying pulses, if some are excluded or the others cost more than is tolerated."""
    outlying, count = error_rad != 0, error_rad.size
    kept = error_rad[outlying & ~excluded]
    loss_db = abs(20 * np.log10(np.abs(1 + np.sum(np.exp(1j * kept) - 1) / max(1, count - int(excluded.sum())))))
    if not excluded.any() and loss_db < TOLERATED_LOSS_DB:
        return {}
    rms, largest = float(np.sqrt(np.mean(error_rad[outlying] ** 2))), float(np.abs(error_rad).max())
    cm = 100 * wave_m / (2 * np.pi)
    line = (
        f"{outlying.sum()} of {count} pulses ({100 * outlying.mean():.2f} %) deviate from their neighbours by "
        f"{rms:.2f} rad rms ({rms * cm:.1f} cm), at most {largest:.2f} rad ({largest * cm:.1f} cm); {excluded.sum()} "
        f"above {EXCLUDED_RAD:.2f} rad excluded, loss by the others {loss_db:.2f} dB"
    )
    return {"sidelink_spikes": line}


def _line_flags(phase_rad: Floats, level: Floats, number: NDArray[np.intp], prf_hz: float) -> dict[str, str]:
    """Return the flag of a line in the spectrum of the phase whose paired echoes exceed the tolerated level."""
    even = np.arange(number[-1] + 1)
    phase_power, level_power = (_periodogram(np.interp(even, number, values)) for values in (phase_rad, level))
    segments = max(1, even.size // _SEGMENT)
    frequency_hz = np.arange(phase_power.size) * prf_hz / min(_SEGMENT, even.size)
    near = np.abs(np.subtract.outer(np.arange(phase_power.size), np.arange(phase_power.size)))
    beside = (near >= _NEAR) & (near <= _FAR)
    floor = np.maximum((beside @ phase_power) / beside.sum(1), 1e-30)
    # eq. 6: neighbouring bins of a Hann window are correlated, which halves the degrees of freedom of the floor
    degrees = 2 * segments, segments * beside.sum(1)
    threshold = scipy.special.fdtri(*degrees, 1 - LINE_FALSE_ALARM / phase_power.size)
    ratio = np.where(frequency_hz > max(MOTION_HZ, 2 * prf_hz / _DETREND), phase_power / floor / threshold, 0.0)
    line = int(np.argmax(ratio))
    lobe = slice(max(0, line - 2), line + 3)
    mean_gain = scipy.special.diric(2 * np.pi * frequency_hz[line] / prf_hz, _DETREND)  # of the mean over `_DETREND`
    depth_rad = float(2 * np.sqrt(max(0.0, phase_power[lobe].sum() - floor[lobe].sum()))) / (1 - mean_gain) ** 2
    depth_db = float(2 * np.sqrt(level_power[lobe].sum())) / (1 - mean_gain) * 20 / np.log(10)
    ghost_db = 20 * np.log10(max(depth_rad / 2, 1e-6))
    if ratio[line] <= 1 or ghost_db < ECHO_DB:
        return {}
    text = (
        f"modulation at {frequency_hz[line]:.1f} Hz, or at a frequency that differs from it or its negative by a "
        f"multiple of {prf_hz:.4g} Hz: phase ±{depth_rad:.2f} rad, amplitude ±{depth_db:.2f} dB; not corrected, ghosts "
        f"of {ghost_db:.1f} dB unless the echo has the same modulation"
    )
    return {"sidelink_modulation": text}


def _periodogram(values: Floats) -> Floats:
    """Return the mean periodogram of segments; a line of amplitude d has the power d²/4, summed over its bins."""
    length = min(_SEGMENT, values.size)
    segments = values[: values.size // length * length].reshape(-1, length)
    taper = scipy.signal.windows.hann(length, sym=False)
    power = np.abs(scipy.fft.rfft((segments - segments.mean(1, keepdims=True)) * taper, axis=1)) ** 2
    return np.asarray(power.mean(0) / (length * (taper**2).sum()))
