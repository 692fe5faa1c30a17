"""The sidelink's measured delay against the baseline of the tracks: a check of the association of pulses."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Floats

EXPLAINED_M = 0.05
"""Metres of movement of a sidelink that errors of the logged positions alone may explain."""

SIGMAS = 5.0
"""Standard deviations of a median's noise that one of a thousand windows reaches by chance once in 3000 flights."""

_MEDIAN_PULSES = 15, 61, 241
"""Lengths of the running medians that separate movement from jitter, odd: the longer, the less noise and the slower."""

_ENOUGH = 64  # disjoint windows from which their noise is estimated


@dataclass(frozen=True)
class BaselineResidual:
    """Residual of the measured delay against the baseline, without a constant and a linear drift.

    Attributes
    ----------
    residual_m, noise_m
        RMS of the residual's running median, metres, and the standard deviation of that median by jitter alone.
    jitter_m
        Standard deviation of a single pulse, metres: of the trigger, mostly.
    largest_m, pulse
        Largest running median, metres, and its pulse.
    excess
        `largest_m` relative to what noise and position errors explain, over running medians of several lengths.
    """

    residual_m: float
    noise_m: float
    jitter_m: float
    largest_m: float
    pulse: int
    excess: float


def baseline_residual(delay_m: Floats, baseline_m: Floats) -> BaselineResidual | None:
    """Return the residual of a sidelink's measured path from its geometry; None of less than 30 pulses.

    Parameters
    ----------
    delay_m, baseline_m
        (pulse,) float64, metres: measured delay of the sidelink times c, NaN where it did not lock, and distance
        between its antennas.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Association". Of each length only full windows count: a window that runs over
    the end would repeat its last pulse.

    Examples
    --------
    >>> distance = 5 + np.sin(np.arange(200) / 20)
    >>> [baseline_residual(moved, distance).residual_m.__round__(1) for moved in (distance, np.roll(distance, 9))]
    [0.0, 0.3]
    """
    pulse = np.flatnonzero(np.isfinite(delay_m) & np.isfinite(baseline_m))
    if pulse.size < 2 * _MEDIAN_PULSES[0]:
        return None
    residual = delay_m[pulse] - baseline_m[pulse]
    jitter = 1.4826 * float(np.median(np.abs(np.diff(residual)))) / 2**0.5
    residuals = [_smoothed(pulse, residual, jitter, width) for width in _MEDIAN_PULSES if 2 * width <= pulse.size]
    return max(residuals, key=lambda one: one.excess)


def _smoothed(pulse: NDArray[np.intp], residual: Floats, jitter_m: float, width: int) -> BaselineResidual:
    inside = slice(width // 2, -(width // 2))  # full windows
    smooth, middle = scipy.ndimage.median_filter(residual, width)[inside], pulse[inside]
    smooth = smooth - np.polyval(np.polyfit(middle, smooth, 1), middle)
    noise_m = 1.2533 * jitter_m / np.sqrt(width)  # standard deviation of a median of so many Gaussian samples
    steps = np.diff(smooth[::width])
    if steps.size >= _ENOUGH:  # jitter need not be normal: the median of a uniform one is noisier
        noise_m = max(noise_m, 1.4826 * float(np.median(np.abs(steps))) / 2**0.5)
    worst = int(np.argmax(np.abs(smooth)))
    largest_m = float(abs(smooth[worst]))
    return BaselineResidual(
        float(np.sqrt(np.mean(smooth**2))),
        float(noise_m),
        jitter_m,
        largest_m,
        int(middle[worst]),
        largest_m / max(EXPLAINED_M, sigmas(smooth.size) * float(noise_m)),
    )


def sigmas(windows: int) -> float:
    """Return the threshold in standard deviations for the highest of so many windows, of equal false alarm per flight.

    Examples
    --------
    >>> sigmas(500), round(sigmas(300_000), 2)
    (5.0, 6.03)
    """
    return float(np.sqrt(SIGMAS**2 + 2 * np.log(max(1.0, windows / 1000))))


def detect_wrong_association(residual: BaselineResidual | None) -> str | None:
    """Return one line on where the measured sidelink deviates from the geometry of its pulses, or None.

    A constant and a linear drift are of the clocks. A residual that moves by more than `EXPLAINED_M` and by more than
    five times its own noise, six of a long flight, cannot come from trigger jitter: pulses have positions of other
    pulses, or wrong ones.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Association". Two nodes that keep their distance give no evidence either way:
    the baseline must change for a wrong pair to be detected.

    Examples
    --------
    >>> distance = 5 + np.sin(np.arange(200) / 20)
    >>> detect_wrong_association(baseline_residual(distance + 3.0, distance)) is None
    True
    >>> detect_wrong_association(baseline_residual(np.roll(distance, 9), distance))
    'sidelink leaves its geometry by ... m at pulse ... (noise ... m): pulses or positions are wrongly associated'
    """
    if residual is None or residual.excess <= 1:
        return None
    return (
        f"sidelink leaves its geometry by {residual.largest_m:.2f} m at pulse {residual.pulse} "
        f"(noise {residual.noise_m:.3f} m): pulses or positions are wrongly associated"
    )


def best_baseline(delay_m: Floats, baselines_m: Mapping[str, Floats]) -> tuple[str, float] | None:
    """Return the baseline that fits the measured delay best, and its residual (m); None if no other is better.

    Parameters
    ----------
    delay_m
        (pulse,) float64, metres, as measured; NaN where the sidelink did not lock.
    baselines_m
        Name → (pulse,) float64, metres, the first as stated: with a log shifted in time, tracks exchanged, a lever arm
        rotated. Another is better if its residual is at most half of that of the first, and that exceeds noise.

    Examples
    --------
    >>> at = np.arange(400) / 20
    >>> stated, late = (5 + np.sin((at - shift) / 2) for shift in (0.0, 1.8))
    >>> best_baseline(late + 2.0, {"as stated": stated, "1.8 s later": late, "0.9 s later": 5 + np.sin((at - 0.9) / 2)})
    ('1.8 s later', 0.0)
    """
    residuals = {name: baseline_residual(delay_m, baseline_m) for name, baseline_m in baselines_m.items()}
    rms_m = {name: (one.residual_m, one.noise_m) for name, one in residuals.items() if one is not None}
    if len(rms_m) < 2:
        return None
    first, best = next(iter(rms_m)), min(rms_m, key=lambda name: rms_m[name][0])
    if rms_m[best][0] > rms_m[first][0] / 2 or rms_m[first][0] < 3 * rms_m[first][1]:
        return None
    return best, round(rms_m[best][0], 6)
