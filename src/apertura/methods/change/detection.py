"""Changes between two images of one scene: mask at a false-alarm rate, and regions, docs/theory/change.md."""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Bools, Floats
from apertura.common.flags import Flags
from apertura.methods.change.statistics import (
    MOST_COHERENCE,
    MOST_LOOKS,
    CoherenceDistribution,
    matched_looks,
    ratio_probability,
    window_modes,
)
from apertura.methods.interferometry.coherence import box_sum, chance, coherence, unbiased

UNCHANGED, BRIGHTER, DARKER, INCOHERENT, NO_DATA = 0, 1, 2, 3, 255
"""Classes of a pixel of the second image relative to the first."""

CLASS_NAMES = {UNCHANGED: "unchanged", BRIGHTER: "brighter", DARKER: "darker", INCOHERENT: "coherent change"}
"""Class → meaning."""

LEAST_LOOKS = 2.0
"""Minimum number of looks of a window; with fewer, neither ratio nor coherence of unchanged terrain is bounded."""

POINT_LOOKS = 2.0
"""Number of looks over which the energy of a window is spread below which a point dominates the window."""

STRONG_POINT_LOOKS = 1.2
"""As `POINT_LOOKS`, for points whose sidelobes also affect the windows beside; not reached in homogeneous terrain."""

POINT_GAIN_STD_DB = 0.5
"""Standard deviation of the gain of a point between two flights: focus and aspect angle differ."""

MOST_SCENE_LOSS = 0.1
"""Largest loss of coherence common to a scene that is attributed to the accuracy of the expected coherence."""

_SURROUNDINGS = 5  # windows along a side of the surroundings in which a lower coherence is recognised
_SIGNIFICANT = 3.0  # standard deviations by which the coherence of the surroundings is lower than expected
_STABLE = 0.75  # quantile at which measured and expected coherence are compared; most of the scene may be changed
_LEAST_WINDOWS = 30  # windows side by side from which the coherence of unchanged terrain varies over the scene
_OUTLIER = 2.5  # standard deviations beyond which a pixel does not determine the coherence of unchanged terrain
_BLOCK = 3  # windows along a side of a block, which determines that coherence if most of its pixels agree with it
_FITS = 8  # fits of that coherence
_POWER = 0.99  # share of the power in the modes that are counted as independent samples
_SAMPLES = 100_000  # pixels from which the coherence ratio of the scene is estimated


@dataclass(frozen=True, eq=False)
class Changes:
    """Changes of a second image relative to a first one.

    Attributes
    ----------
    classes
        (y, x) uint8, a key of `CLASS_NAMES` or `NO_DATA`.
    ratio_db
        (y, x) float32, mean power of the second image over that of the first, without the gain; NaN without data.
    coherence
        (y, x) float32, estimated coherence, NaN without data.
    coherence_loss
        (y, x) float32, expected minus measured coherence without bias, NaN without data.
    probability
        (y, x) float64, probability of a change as significant as measured in unchanged terrain; NaN without data.
    looks, matched
        Number of looks of a window, and number for the probabilities at the false-alarm rate.
    samples
        Number of independent samples of a window: modes that contain 99 % of its power.
    gain_db
        Power of the second image over that of the first, median of the scene, dB.
    scene_ratio
        Ratio of measured and expected coherence, common to the scene.
    expected
        Median coherence of unchanged terrain, including `scene_ratio`.
    least_detected
        Estimated coherence below which unchanged terrain of that median coherence is reported as changed.
    """

    classes: NDArray[np.uint8]
    ratio_db: NDArray[np.float32]
    coherence: NDArray[np.float32]
    coherence_loss: NDArray[np.float32]
    probability: Floats
    looks: float
    matched: float
    samples: int
    gain_db: float
    scene_ratio: float
    expected: float
    least_detected: float

    @property
    def valid(self) -> int:
        """Number of pixels with data."""
        return int((self.classes != NO_DATA).sum())

    def tests(self, window: int) -> float:
        """Return the number of independent samples of the valid pixels, docs/theory/change.md, eq. 8."""
        return self.valid * self.samples / window**2


def detect_changes(
    first: NDArray[np.complex64],
    second: NDArray[np.complex64],
    expected: NDArray[np.floating],
    *,
    window: int,
    rate: float,
    phase_std_rad: float = 0.0,
) -> Changes:
    """Detect changes of amplitude and coherence between two images of one scene.

    Parameters
    ----------
    first, second
        (y, x) complex64 on one grid, NaN where no image is formed; expected phase difference zero.
    expected
        (y, x) float, coherence expected for unchanged terrain, 0 to 1; NaN excludes a pixel.
    window
        Pixels along a side of the window, odd.
    rate
        False-alarm rate: probability that a pixel of unchanged terrain is reported as changed.
    phase_std_rad
        Standard deviation of the phase difference of an unchanged point, in addition to noise.

    Notes
    -----
    Source: docs/theory/change.md. Windows that contain a pixel without data have no data.

    Examples
    --------
    A square of other scatterers is a coherent change; the amplitude of its terrain is the same.

    >>> generator = np.random.default_rng(0)
    >>> draw = lambda: (generator.normal(size=(64, 64)) + 1j * generator.normal(size=(64, 64))).astype(np.complex64)
    >>> first = draw()
    >>> second = (first + 0.2 * draw()).astype(np.complex64)
    >>> second[20:40, 20:40] = draw()[20:40, 20:40]
    >>> changes = detect_changes(first, second, np.full((64, 64), 0.98), window=5, rate=1e-4)
    >>> CLASS_NAMES[changes.classes[30, 30].item()], CLASS_NAMES[changes.classes[10, 50].item()]
    ('coherent change', 'unchanged')
    """
    modes = window_modes(first, window)
    looks = min(float(1 / (modes**2).sum()), MOST_LOOKS)
    if looks < LEAST_LOOKS:
        return _no_changes(first.shape, looks)
    matched = min(matched_looks(modes, rate / 2), MOST_LOOKS)
    magnitude, phase, _ = coherence(second, first, window=window)
    powers = [box_sum(np.abs(np.where(np.isfinite(image), image, 0).astype(np.complex128)) ** 2, window)
              for image in (first, second)]  # fmt: skip
    counted = box_sum((np.isfinite(first) & np.isfinite(second) & np.isfinite(expected)).astype(np.float64), window)
    valid = (counted == window**2) & np.isfinite(magnitude) & (powers[0] > 0) & (powers[1] > 0)
    if not valid.any():
        return _no_changes(first.shape, looks)
    at = np.flatnonzero(valid)  # from here on, one element per valid pixel
    estimate, explained = (plane.ravel()[at].astype(np.float64) for plane in (magnitude, expected))
    log_ratio = np.log(powers[1].ravel()[at] / powers[0].ravel()[at])
    gain = float(np.median(log_ratio))
    log_ratio -= gain
    # Coherence of unchanged terrain (eq. 5), and that of decorrelated surroundings for the ratio (eq. 3).
    distribution = CoherenceDistribution(round(matched, 2))
    unchanged = _unchanged_coherence(modes, estimate, explained, np.argwhere(valid), window)
    surrounding = _surroundings(magnitude, valid, window, looks).ravel()[at]
    deviation = 2 * unchanged * (1 - unchanged**2) / np.sqrt(2 * looks * _SURROUNDINGS**2)
    is_lower = surrounding < unchanged**2 - _SIGNIFICANT * deviation
    around = np.where(is_lower, np.sqrt(np.maximum(surrounding, 0)), unchanged)
    of_ratio = ratio_probability(log_ratio, around, matched)
    of_coherence = distribution.probability(estimate, unchanged)
    # Windows with a dominant point: amplitude and phase of the point (eq. 6).
    energy = looks * _shared(first, second, window)
    beside = scipy.ndimage.maximum_filter(energy < STRONG_POINT_LOOKS, 2 * window - 1)
    points = ((energy < POINT_LOOKS) | beside).ravel()[at]
    noise = np.maximum(1 - estimate[points] ** 2, 0) / (2 * looks - 2)
    gain_std = POINT_GAIN_STD_DB * np.log(10) / 10
    angle = np.minimum(np.abs(phase.ravel()[at][points].astype(np.float64)), np.pi / 2)
    for values, score in (
        (of_ratio, np.sinh(np.abs(log_ratio[points]) / 2) / np.sqrt(noise + gain_std**2 / 4)),
        (of_coherence, estimate[points] * np.sin(angle) / np.sqrt(noise + (estimate[points] * phase_std_rad) ** 2)),
    ):
        values[points] = 2 * scipy.special.stdtr(2 * looks - 2, -score)
    # Two tests at half the rate each (eq. 7).
    classes = np.full(first.shape, NO_DATA, np.uint8)
    changed = np.where(log_ratio > 0, BRIGHTER, DARKER)
    changed = np.where(of_ratio < rate / 2, changed, np.where(of_coherence < rate / 2, INCOHERENT, UNCHANGED))
    classes.ravel()[at] = changed
    probability = np.minimum(2 * np.minimum(of_ratio, of_coherence), 1.0)
    loss = explained - unbiased(estimate.astype(np.float32), looks)
    level = float(np.median(unchanged))

    def plane(values: Floats) -> Floats:
        filled = np.full(first.shape, np.nan)
        filled.ravel()[at] = values
        return filled

    return Changes(
        classes=classes,
        ratio_db=plane(10 / np.log(10) * log_ratio).astype(np.float32),
        coherence=plane(estimate).astype(np.float32),
        coherence_loss=plane(loss).astype(np.float32),
        probability=plane(probability),
        looks=looks,
        matched=matched,
        samples=int(np.searchsorted(np.cumsum(np.sort(modes)[::-1]), _POWER)) + 1,
        gain_db=10 / np.log(10) * gain,
        scene_ratio=float(np.median(unchanged / np.maximum(explained, 1e-3))),
        expected=level,
        least_detected=distribution.quantile(rate / 2, level),
    )


def _no_changes(shape: tuple[int, ...], looks: float) -> Changes:
    """Return a result without valid pixels."""
    empty = np.full(shape, np.nan, np.float32)
    none = np.full(shape, NO_DATA, np.uint8)
    return Changes(none, empty, empty, empty, empty.astype(np.float64), looks, looks, 1, 0.0, 1.0, 0.0, 0.0)


def _unchanged_coherence(
    modes: Floats, estimate: Floats, explained: Floats, places: NDArray[np.int64], window: int
) -> Floats:
    """Return the coherence of unchanged terrain, docs/theory/change.md, eq. 5.

    Parameters
    ----------
    modes
        As from `window_modes`.
    estimate, explained
        (pixel,) float64, estimated and expected coherence.
    places
        (pixel, 2) int64, rows and columns.
    window
        Pixels along a side of a window.
    """
    looks = min(matched_looks(modes, 2 * (1 - _STABLE)), MOST_LOOKS)
    distribution = CoherenceDistribution(round(looks, 2))
    some = np.s_[:: max(1, len(estimate) // _SAMPLES)]
    # Ratio common to the scene: a quantile of the estimates equals its probability.
    low, high = 0.0, 1.0 / max(float(np.median(explained)), 1e-3)
    for _ in range(20):
        ratio = (low + high) / 2
        probability = distribution.probability(estimate[some], np.clip(ratio * explained[some], 0, MOST_COHERENCE))
        low, high = (ratio, high) if np.quantile(probability, _STABLE) > _STABLE else (low, ratio)
    level = np.arctanh(np.clip(ratio * explained, 0, MOST_COHERENCE))
    # Variation over the scene: quadratic polynomial of the pixels that agree with it.
    centre, span = places.mean(axis=0), np.maximum(np.ptp(places, axis=0) / 2, 1)
    north, east = ((places - centre) / span).T
    powers = [(0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 0)][: 6 if len(places) > _LEAST_WINDOWS * window**2 else 1]
    terms = np.stack([north**i * east**j for i, j in powers], -1)
    factors = np.zeros(len(powers))
    found = np.arctanh(np.clip(estimate[some], 0, 1 - 1e-6))
    _, block = np.unique(places[some] // (_BLOCK * window), axis=0, return_inverse=True)
    for _ in range(_FITS):
        residual = found - distribution.median(np.tanh(level[some] + terms[some] @ factors))
        kept = np.abs(residual) < _OUTLIER / np.sqrt(2 * looks)
        # In a changed block, the few pixels that agree by chance would determine the polynomial.
        kept &= (np.bincount(block, kept) > 0.5 * np.bincount(block))[block]
        if kept.sum() < len(powers):
            break
        factors += np.linalg.lstsq(terms[some][kept], residual[kept], rcond=None)[0]
    return np.asarray(np.clip(np.tanh(level + terms @ factors), 0, MOST_COHERENCE))


def _surroundings(magnitude: NDArray[np.float32], valid: Bools, window: int, looks: float) -> Floats:
    """Return the squared coherence of the surroundings, unbiased by docs/theory/interferometry.md, eq. 5."""
    side = _SURROUNDINGS * window
    total, count = (
        scipy.ndimage.uniform_filter(plane, side, mode="constant")
        for plane in (np.where(valid, magnitude.astype(np.float64) ** 2, 0.0), valid.astype(np.float64))
    )
    return np.asarray((looks * total / np.maximum(count, 1 / side**2) - 1) / (looks - 1))


def _shared(first: NDArray[np.complex64], second: NDArray[np.complex64], window: int) -> Floats:
    """Return (Σp)²/(N Σp²) of the product p of the magnitudes, docs/theory/interferometry.md, eq. 6."""
    product = np.abs(first.astype(np.complex128) * second)
    product = np.where(np.isfinite(product), product, 0)
    squares = box_sum(product**2, window)
    return np.asarray(box_sum(product, window) ** 2 / np.maximum(window**2 * squares, np.finfo(np.float64).tiny))


# ---- Limits of the method and their flags ---------------------------------------------------------------------------


def change_flags(changes: Changes) -> Flags:
    """Return flag → measured values for the limits that a change detection exceeds.

    Examples
    --------
    >>> sorted(change_flags(_no_changes((4, 4), 1.5)))
    ['change_looks']
    """
    flags = Flags()
    if changes.looks < LEAST_LOOKS:
        flags["change_looks"] = f"{changes.looks:.1f} looks in a window; at least {LEAST_LOOKS:.0f} are required"
        return flags
    if not changes.valid:
        return flags
    independent = chance(changes.looks)
    if changes.least_detected < independent:
        flags["change_insensitive"] = (
            f"coherence {changes.expected:.2f} expected for unchanged terrain: only estimates below "
            f"{changes.least_detected:.2f} are significant, and other scatterers have {independent:.2f} on average"
        )
    if changes.expected * (1 / max(changes.scene_ratio, 1e-3) - 1) > MOST_SCENE_LOSS:
        flags["change_decorrelated"] = (
            f"coherence of the scene is {changes.scene_ratio:.2f} times the expected coherence; changes are reported "
            "relative to this level"
        )
    return flags


# ---- Regions --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Region:
    """Connected changed pixels.

    Attributes
    ----------
    number
        Label of the region in the raster of labels, from 1.
    kind
        ``brighter``, ``darker``, ``brighter and darker`` or ``coherent change``.
    row, column
        Pixel of the smallest probability.
    pixels
        Number of pixels.
    ratio_db
        Ratio of largest magnitude, dB.
    coherence, coherence_loss
        Smallest estimated coherence, and largest loss.
    probability
        Smallest probability of a pixel.
    expected_false
        Expected number of regions as significant in an unchanged scene, at most (docs/theory/change.md, eq. 8).
    """

    number: int
    kind: str
    row: int
    column: int
    pixels: int
    ratio_db: float
    coherence: float
    coherence_loss: float
    probability: float
    expected_false: float

    @property
    def confidence(self) -> float:
        """Probability that an unchanged scene of this size contains no region as significant, eq. 8."""
        return float(np.exp(-self.expected_false))


def change_regions(
    changes: Changes, *, window: int, least_pixels: float = 1.0
) -> tuple[list[Region], NDArray[np.int32]]:
    """Return the connected regions of changed pixels, and the raster of their labels.

    Parameters
    ----------
    changes, window
        Result and window of `detect_changes`.
    least_pixels
        Smallest size of a region; smaller regions are omitted.

    Returns
    -------
    list of Region
        In the order of their labels.
    labels
        (y, x) int32, 0 outside the regions.

    Examples
    --------
    >>> generator = np.random.default_rng(0)
    >>> draw = lambda: (generator.normal(size=(64, 64)) + 1j * generator.normal(size=(64, 64))).astype(np.complex64)
    >>> first = draw()
    >>> second = (first + 0.2 * draw()).astype(np.complex64)
    >>> second[30, 30] = 40
    >>> changes = detect_changes(first, second, np.full((64, 64), 0.98), window=5, rate=1e-4)
    >>> regions, _ = change_regions(changes, window=5)
    >>> [(region.kind, region.pixels) for region in regions]
    [('brighter', 25)]
    """
    is_changed = (changes.classes != UNCHANGED) & (changes.classes != NO_DATA)
    labels, count = scipy.ndimage.label(is_changed, structure=np.ones((3, 3)), output=np.int32)
    kept = np.bincount(labels.ravel(), minlength=count + 1) >= least_pixels
    kept[0] = False
    labels = (np.cumsum(kept) * kept).astype(np.int32)[labels]
    tests = changes.tests(window)
    regions = []
    for number, box in enumerate(scipy.ndimage.find_objects(labels), start=1):
        inside = labels[box] == number
        classes = set(changes.classes[box][inside].tolist())
        names = [CLASS_NAMES[one] for one in (BRIGHTER, DARKER) if one in classes]
        probability = np.where(inside, changes.probability[box], np.inf)
        row, column = np.unravel_index(np.argmin(probability), probability.shape)
        ratio = changes.ratio_db[box][inside]
        regions.append(
            Region(
                number=number,
                kind=" and ".join(names) or CLASS_NAMES[INCOHERENT],
                row=int(row) + box[0].start,
                column=int(column) + box[1].start,
                pixels=int(inside.sum()),
                ratio_db=float(ratio[np.argmax(np.abs(ratio))]),
                coherence=float(changes.coherence[box][inside].min()),
                coherence_loss=float(changes.coherence_loss[box][inside].max()),
                probability=float(probability.min()),
                expected_false=float(probability.min() * tests),
            )
        )
    return regions, labels
