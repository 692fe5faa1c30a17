"""Probabilities of amplitude ratio and coherence of two unchanged images over a window, docs/theory/change.md."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Floats

_SIDE = 21  # samples along a side of the window whose correlation matrix is decomposed, docs/theory/change.md, eq. 1
_CROP = 256  # smallest side of the part of the image in which the correlation is measured, pixels
_LEAST_MODE = 1e-6  # modes below this fraction of the largest one are rounding errors
_LOG_RATIOS = (1e-3, 9.0)  # range of the logarithm of the ratio in which the looks are matched
_LOOKS = (1.01, 1e5)  # range of the matched looks

MOST_COHERENCE = 0.995
"""Largest coherence of unchanged terrain; images of one flight apart by noise of -23 dB do not exceed it."""

MOST_LOOKS = 250.0
"""Largest number of looks of the tabulated distribution; windows with more looks are treated as having this number."""

# Grid of eq. 4 in atanh of coherence: spacing smaller than half the width 1/√(2L) of the estimate for `MOST_LOOKS`.
_COHERENCES = np.linspace(0.0, np.arctanh(MOST_COHERENCE), 101)
_ESTIMATES = np.linspace(0.0, 6.0, 601)


def window_modes(image: NDArray[np.complex64], window: int) -> Floats:
    """Return the share of each independent mode in the mean power of a window, sum 1.

    Parameters
    ----------
    image
        (y, x) complex64; NaN is excluded.
    window
        Pixels along a side.

    Returns
    -------
    ndarray
        (mode,) float64, eigenvalues of the correlation matrix of the pixels of a window, over their sum.

    Notes
    -----
    Source: docs/theory/change.md, eq. 1.

    Examples
    --------
    Nine independent pixels have nine modes, equal up to the error of the local carrier.

    >>> generator = np.random.default_rng(0)
    >>> noise = (generator.normal(size=(512, 512)) + 1j * generator.normal(size=(512, 512))).astype(np.complex64)
    >>> modes = window_modes(noise, 3)
    >>> len(modes), round(1 / float((modes**2).sum()), 1)
    (9, 8.5)
    """
    side = max(_CROP, 4 * window)
    rows, columns = (slice(max(0, (size - side) // 2), max(0, (size - side) // 2) + side) for size in image.shape)
    part = np.nan_to_num(image[rows, columns].astype(np.complex128))
    # Points have no more weight than terrain.
    power = scipy.ndimage.uniform_filter(np.abs(part) ** 2, 3 * window, mode="constant")
    part = np.where(power > 0, part / np.sqrt(np.where(power > 0, power, 1)), 0)
    step = -(-window // _SIDE)
    carrier = [np.angle(_smooth(_lagged(part, *lag), 2 * window)) for lag in ((1, 0), (0, 1))]
    lags = [(row, column) for row in range(0, window, step) for column in range(step - window, window, step)]
    found = {}
    for i, j in lags:
        # Phase of the local carrier over the lag; without it, the carriers of distant pixels would cancel.
        turned = _lagged(part, i, j) * np.exp(-1j * (i * carrier[0] + j * carrier[1]))
        found[i, j] = turned.sum().real / ((part.shape[0] - i) * (part.shape[1] - abs(j)))
    if not found[0, 0] > 0:
        return np.ones(1)
    pixels = np.arange(0, window, step)
    row, column = (axis.ravel() for axis in np.meshgrid(pixels, pixels, indexing="ij"))
    plane = np.zeros((2 * window, 2 * window))  # correlation of lag (i, j) at [i, j], negative lags from the end
    for (i, j), value in found.items():
        plane[i, j] = plane[-i, -j] = value
    modes = np.linalg.eigvalsh(plane[row[:, None] - row, column[:, None] - column])
    modes = modes[modes > _LEAST_MODE * modes.max()]
    return np.asarray(modes / modes.sum())


def _lagged(image: NDArray[np.complex128], row: int, column: int) -> NDArray[np.complex128]:
    """Return the product of the image displaced by half a lag and its conjugate displaced back, 0 beyond the edges."""
    product = np.zeros_like(image)
    high, wide = image.shape[0] - row, image.shape[1] - abs(column)
    ahead = image[row:, max(column, 0) : max(column, 0) + wide]
    behind = image[:high, max(-column, 0) : max(-column, 0) + wide]
    product[row // 2 : row // 2 + high, abs(column) // 2 : abs(column) // 2 + wide] = ahead * behind.conj()
    return product


def _smooth(values: NDArray[np.complex128], side: int) -> NDArray[np.complex128]:
    return np.asarray(scipy.ndimage.uniform_filter(values, side, mode="constant"))


def matched_looks(modes: Floats, rate: float) -> float:
    """Return the number of equal modes whose mean-power ratio has the same quantile as that of the given modes.

    Parameters
    ----------
    modes
        (mode,) float64, as from `window_modes`.
    rate
        Probability that the ratio of two independent images exceeds the quantile, in either direction.

    Notes
    -----
    Source: docs/theory/change.md, eqs. 1 to 3.

    Examples
    --------
    Equal modes are counted. For unequal modes, the number exceeds that of the variance, 1/Σλ².

    >>> round(matched_looks(np.full(9, 1 / 9), 1e-3), 1)
    9.0
    >>> modes = np.repeat([0.2, 0.01], [4, 20])
    >>> round(matched_looks(modes, 1e-3), 1), round(1 / float((modes**2).sum()), 1)
    (7.5, 6.2)
    """
    low, high = _LOG_RATIOS

    def excess(log_ratio: float) -> float:
        return float(np.log(_exceedance(modes, np.exp(log_ratio)) / (rate / 2)))

    log_ratio = high if excess(high) > 0 else scipy.optimize.brentq(excess, low, high)

    def probability(log_looks: float) -> float:
        looks = np.exp(log_looks)
        return max(float(ratio_probability(np.array(log_ratio), np.array(0.0), looks)), np.finfo(float).tiny)

    ends = [np.log(looks) for looks in _LOOKS]
    if probability(ends[0]) < rate:
        return _LOOKS[0]
    return float(np.exp(scipy.optimize.brentq(lambda at: np.log(probability(at) / rate), *ends)))


def _exceedance(modes: Floats, ratio: float) -> float:
    """Return P(Σλa > r Σλb) of exponentials a and b by the saddlepoint approximation, docs/theory/change.md, eq. 1."""

    def slope(s: float) -> float:
        return float((modes / (1 - s * modes)).sum() - (ratio * modes / (1 + s * ratio * modes)).sum())

    at = scipy.optimize.brentq(slope, 0.0, (1 - 1e-12) / modes.max())
    cumulant = -np.log1p(-at * modes).sum() - np.log1p(at * ratio * modes).sum()
    curvature = ((modes / (1 - at * modes)) ** 2).sum() + ((ratio * modes / (1 + at * ratio * modes)) ** 2).sum()
    first, second = np.sqrt(-2 * cumulant), at * np.sqrt(curvature)
    return max(float(scipy.special.ndtr(-(first + np.log(second / first) / first))), np.finfo(float).tiny)


def ratio_probability(log_ratio: Floats, coherence: Floats, looks: float) -> Floats:
    """Return the probability that unchanged terrain has a power ratio further from 1 than the given one.

    Parameters
    ----------
    log_ratio
        (...) float64, natural logarithm of the ratio of the mean powers of both images.
    coherence
        (...) float64, true coherence of the images, below 1.
    looks
        Number of looks of the means.

    Notes
    -----
    Source: docs/theory/change.md, eq. 3.

    Examples
    --------
    Independent images follow the F distribution with 2L and 2L degrees of freedom; coherence narrows the distribution.

    >>> log_ratio = np.array([1.0, 1.0])
    >>> ratio_probability(log_ratio, np.array([0.0, 0.9]), 16.0).round(4)
    array([0.0059, 0.    ])
    >>> round(2 * float(scipy.special.fdtrc(32, 32, np.e)), 4)
    0.0059
    """
    score = np.sqrt(2 * looks) * np.sinh(np.abs(log_ratio) / 2) / np.sqrt(1 - coherence**2)
    return np.asarray(2 * scipy.special.stdtr(2 * looks, -score))


@dataclass(frozen=True, eq=False)
class CoherenceDistribution:
    """Distribution of the estimated coherence of Gaussian images, docs/theory/change.md, eq. 4.

    Attributes
    ----------
    looks
        Number of looks of the estimate, more than 1 and at most `MOST_LOOKS`.
    """

    looks: float

    def probability(self, magnitude: Floats, coherence: Floats) -> Floats:
        """Return the probability of an estimate of at most `magnitude` at a true `coherence`, (...) float64.

        Examples
        --------
        The estimate of independent images exceeds m with the probability (1 - m²)^(L - 1).

        >>> distribution = CoherenceDistribution(16.0)
        >>> distribution.probability(np.array([0.5]), np.array([0.0])).round(4), round(1 - 0.75**15, 4)
        (array([0.9866]), 0.9866)
        """
        highest = np.tanh(_ESTIMATES[-1])
        estimates = np.arctanh(np.clip(magnitude, 0, highest)) / _ESTIMATES[1]
        coherences = np.arctanh(np.clip(coherence, 0, MOST_COHERENCE)) / _COHERENCES[1]
        column, row = (
            np.minimum(at.astype(np.int64), len(knots) - 2)
            for at, knots in ((estimates, _ESTIMATES), (coherences, _COHERENCES))
        )
        right, down = estimates - column, coherences - row
        table = _log_probabilities(self.looks)
        near = table[row, column] * (1 - right) + table[row, column + 1] * right
        far = table[row + 1, column] * (1 - right) + table[row + 1, column + 1] * right
        return np.asarray(np.exp(near * (1 - down) + far * down))

    def median(self, coherence: Floats) -> Floats:
        """Return the median of the inverse hyperbolic tangent of the estimate at a true `coherence`, (...) float64.

        Examples
        --------
        >>> CoherenceDistribution(16.0).median(np.array([0.0, 0.9])).round(2), round(float(np.arctanh(0.9)), 2)
        (array([0.22, 1.51]), 1.47)
        """
        medians = [np.interp(np.log(0.5), row, _ESTIMATES) for row in _log_probabilities(self.looks)]
        return np.interp(np.arctanh(np.clip(coherence, 0, MOST_COHERENCE)), _COHERENCES, medians)

    def quantile(self, rate: float, coherence: float) -> float:
        """Return the estimate that is not exceeded with the probability `rate` at a true `coherence`.

        Examples
        --------
        >>> round(CoherenceDistribution(16.0).quantile(1e-4, 0.9), 3)
        0.671
        """
        magnitudes = np.tanh(_ESTIMATES)
        log_probability = np.log(self.probability(magnitudes, np.full(len(magnitudes), coherence)))
        return float(np.interp(np.log(rate), log_probability, magnitudes))


@lru_cache(maxsize=8)
def _log_probabilities(looks: float) -> Floats:
    """Return the logarithm of the distribution at all `_COHERENCES` and `_ESTIMATES`, (coherence, estimate)."""
    middle = (_ESTIMATES[1:] + _ESTIMATES[:-1]) / 2
    estimate, coherence = np.tanh(middle), np.tanh(_COHERENCES)[:, None]
    both = (coherence * estimate) ** 2
    # The density over atanh of the estimate; Euler's transformation of the hypergeometric function has positive terms.
    log_density = (
        np.log(estimate)
        + (looks - 1) * np.log1p(-(estimate**2))
        + looks * np.log1p(-(coherence**2))
        + (1 - 2 * looks) * np.log1p(-both)
        + np.log(scipy.special.hyp2f1(1 - looks, 1 - looks, 1, both))
    )
    density = np.exp(log_density - log_density.max(axis=1, keepdims=True))
    total = np.cumsum(density, axis=1)
    total = np.concatenate([total[:, :1] * 1e-9, total], axis=1) / total[:, -1:]
    return np.asarray(np.log(np.maximum(total, 1e-300)))
