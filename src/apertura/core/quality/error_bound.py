"""How far an image is from the exact sum: estimated from drawn pixels, with an upper bound at 95 % confidence."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CONFIDENCE = 0.95

_SIGMAS = 2.0  # 1.645 would leave out 5 % of a Gaussian; sums of skewed errors reach further


@dataclass(frozen=True)
class ErrorBound:
    """RMS difference of an image from the exact sum over all its pixels, relative to the RMS of the image.

    Attributes
    ----------
    bound_db
        What it stays below with a confidence of 95 %, dB.
    estimate_db
        What it is expected to be, dB.
    peak_db
        Largest difference at the drawn pixels over the image's peak, dB.
    """

    bound_db: float
    estimate_db: float
    peak_db: float


def error_bound(
    computed: NDArray[np.complexfloating],
    exact: NDArray[np.complexfloating],
    density: NDArray[np.float64],
    *,
    power: float | NDArray[np.float64],
    peak: float | None = None,
) -> ErrorBound:
    """Return the error of a whole image from pixels drawn at random, after one complex gain.

    Parameters
    ----------
    computed, exact
        (draw,) complex, the drawn pixels; a pixel drawn twice stands twice.
    density
        (draw,) float64, how often a draw like this takes that pixel on average.
    power
        Σ|I|² over all pixels of the image; or (draw,) float64, |I|² around each draw.
    peak
        Largest magnitude of the image; by default of the draws.

    Notes
    -----
    Source: docs/theory.md, eq. 6a.

    Examples
    --------
    >>> noise = 1e-3 * np.exp(2j * np.pi * np.random.default_rng(1).random(256))
    >>> found = error_bound(np.ones(256), 1 + noise, np.full(256, 0.01), power=25600.0)
    >>> round(found.estimate_db, 1), 0 < found.bound_db - found.estimate_db < 0.2
    (-60.0, True)
    """
    values = computed.astype(np.complex128)
    weighed = (np.abs(values) ** 2 / density).sum()
    gain = complex((values.conj() * exact / density).sum() / weighed) if weighed else 0j
    difference = np.abs(gain * values - exact) ** 2
    errors, levels = difference / density, np.zeros(len(values))
    if isinstance(power, float):
        total = power * abs(gain) ** 2
    else:
        levels = power / density * abs(gain) ** 2
        total = float(levels.sum())
    largest = float(levels.max())
    error = float(errors.sum())
    if not error or total <= largest:
        nothing = _db(0.0 if not error else np.inf)
        return ErrorBound(nothing, nothing, nothing)
    spread = np.sqrt(errors.size) * float((errors - error / total * levels).std())
    # a draw as large as the largest may have been missed, and the brightest may have been met by luck
    above = (error + float(errors.max())) / (total - largest) * np.exp(_SIGMAS * spread / error)
    top = abs(gain) * (peak if peak is not None else float(np.abs(values).max()))
    return ErrorBound(_db(above), _db(error / total), _db(float(difference.max()) / top**2))


def _db(power: float) -> float:
    """Return a ratio of powers that cannot exceed 1, once the difference is counted to the exact sum; 0 is -313 dB."""
    least = np.finfo(np.float64).eps ** 2
    return float(10 * np.log10(max(power / (1 + power) if np.isfinite(power) else 1.0, least)))
