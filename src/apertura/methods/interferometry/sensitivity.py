"""Sensitivity of the phase between two images to height and to errors of the tracks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.quality.path_errors import autocorrelation

Legs = tuple[Floats, Floats]
"""Phase centres of transmitter and receiver of the pulses that make each place, (place, pulse, 3) metres each."""

PROBE = 0.02
"""Height step of the finite difference, as a share of the range: large against rounding, small against the range."""

_STEPS = 4  # of Gauss and Newton; the first is right to first order in PROBE, each other squares what is left


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Change of the phase between two images with the height of the ground above the assumed one.

    Attributes
    ----------
    slope, bend
        (...) float64: phase = slope · h + bend · h², rad for h in metres; of the first image less that of the second.
    shift
        (..., 2) float64, metres east and north that the ground shown by a pixel lies away from it, per metre of height.
    overlap
        (...) float64, share of what the two images sample of the scene's spectrum that both do; 0: no coherence.
    range_m
        (...) float64, half the mean of both total paths.

    Notes
    -----
    Source: docs/theory/interferometry.md, eqs. 9 to 11 and 14.
    """

    slope: Floats
    bend: Floats
    shift: Floats
    overlap: Floats
    range_m: Floats

    @property
    def ambiguity_m(self) -> Floats:
        """Height that turns the phase once, metres; infinite where height does not turn it."""
        with np.errstate(divide="ignore"):
            return np.asarray(2 * np.pi / np.abs(self.slope))

    def height(self, phase_rad: Floats) -> Floats:
        """Return the height above the ground that was assumed, metres; NaN where no height has such a phase.

        Examples
        --------
        >>> one = np.ones(1)
        >>> Sensitivity(4 * one, 2 * one, np.zeros((1, 2)), one, one).height(np.array([4 * 0.5 + 2 * 0.25]))
        array([0.5])
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.sqrt(self.slope**2 + 4 * self.bend * phase_rad)
            return np.asarray(2 * phase_rad / (self.slope + np.copysign(root, self.slope)))


def sensitivity(
    places_m: Floats,
    axes: Floats,
    first: Legs,
    second: Legs,
    *,
    band_hz: tuple[float, float],
    window: Floats | None = None,
) -> Sensitivity:
    """Return the sensitivity of the phase between two images to height at some places.

    Parameters
    ----------
    places_m
        (place, 3) float64, metres: pixels on the ground that both images assume.
    axes
        (3, 3) float64, unit vectors east, north and up.
    first, second
        Phase centres of pulses spread over each image's aperture, place by place, in the frame of `places_m`.
    band_hz
        Lowest and highest frequency.
    window
        (subcarrier,) float64, weights over the band, which the overlap counts with; flat by default.

    Examples
    --------
    Two tracks along x, 20 m away and 20 m high, the second 1 m higher, so that it looks 0.0244 rad steeper: 4π/λ times
    that over sin θ = 0.7, and higher ground appears nearer by cot θ.

    >>> along = np.linspace(-4.0, 4.0, 9)[None, :, None] * [1.0, 0.0, 0.0]
    >>> low, high = along + [0.0, -20.0, 20.0], along + [0.0, -20.0, 21.0]
    >>> sensed = sensitivity(np.zeros((1, 3)), np.eye(3), (low, low), (high, high), band_hz=(1.1e9, 1.3e9))
    >>> sensed.slope.round(2), sensed.shift.round(2), sensed.overlap.round(2)
    (array([-1.75]), array([[-0.  ,  1.03]]), array([0.84]))
    """
    wavenumber = np.pi * (band_hz[0] + band_hz[1]) / SPEED_OF_LIGHT_M_S
    paths = [_path(places_m, legs) for legs in (first, second)]
    range_m = np.mean([path.mean(axis=-1) for path in paths], axis=0) / 2
    probe = PROBE * range_m
    phases, shifts = [], []
    for height_m in (probe, -probe):
        moved = _moved(places_m, axes, (first, second), paths, height_m)
        one, other = (_less(paths[at], moved, legs) for at, legs in enumerate((first, second)))
        phases.append(wavenumber * (one.mean(axis=-1) - other.mean(axis=-1)))
        shifts.append((moved - places_m) @ axes[:2].T)
    return Sensitivity(
        slope=(phases[0] - phases[1]) / (2 * probe),
        bend=(phases[0] + phases[1]) / (2 * probe**2),
        shift=(shifts[0] - shifts[1]) / (2 * probe[:, None]),
        overlap=_overlap(places_m, axes, (first, second), band_hz, window),
        range_m=range_m,
    )


def _moved(places_m: Floats, axes: Floats, images: tuple[Legs, Legs], paths: list[Floats], height_m: Floats) -> Floats:
    """Locate ground that is `height_m` higher if it shows at `places_m` in both images.

    Its path differs by the same from pulse to pulse, else it would be sharp elsewhere along the track, and by nothing
    in the mean of both images, else it would be elsewhere in range (docs/theory/interferometry.md, eq. 10).
    """
    east_north, moved = axes[:2], places_m + height_m[:, None] * axes[2]
    for _ in range(_STEPS):
        wrong, turned = [], []
        for legs, path in zip(images, paths, strict=True):
            left, gradient = -_less(path, moved, legs), _gradient(moved, legs) @ east_north.T
            wrong.append(left)
            turned.append(gradient)
        # Unknowns east and north: residuals of each image about their mean over pulses, and the mean of both images.
        rows = [left - left.mean(axis=1, keepdims=True) for left in wrong]
        slopes = [one - one.mean(axis=1, keepdims=True) for one in turned]
        rows.append(sum(left.mean(axis=1, keepdims=True) for left in wrong) / 2)
        slopes.append(sum(one.mean(axis=1, keepdims=True) for one in turned) / 2)
        design, missed = np.concatenate(slopes, axis=1), np.concatenate(rows, axis=1)
        step = np.einsum("pij,pj->pi", np.linalg.pinv(design), -missed)
        moved = moved + step @ east_north
    return np.asarray(moved)


def _path(places_m: Floats, legs: Legs) -> Floats:
    """Return the total paths, (place, pulse)."""
    tx, rx = (np.linalg.norm(places_m[:, None] - leg, axis=-1) for leg in legs)
    return np.asarray(tx + rx)


def _less(path: Floats, moved: Floats, legs: Legs) -> Floats:
    """Return the paths to places less those to places moved."""
    return np.asarray(path - _path(moved, legs))


def _gradient(places_m: Floats, legs: Legs) -> Floats:
    """Return the gradients of the total paths, (place, pulse, 3)."""
    total = np.zeros_like(legs[0])
    for leg in legs:
        offset_m = places_m[:, None] - leg
        total += offset_m / np.linalg.norm(offset_m, axis=-1, keepdims=True)
    return total


def _overlap(
    places_m: Floats, axes: Floats, images: tuple[Legs, Legs], band_hz: tuple[float, float], window: Floats | None
) -> Floats:
    """Return the share of the spectrum that both images sample: along range, times across it."""
    ground = [_gradient(places_m, legs) @ axes[:2].T for legs in images]
    middle = [one.mean(axis=1) for one in ground]
    along = middle[0] + middle[1]
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-12)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    in_range = [np.sort(np.multiply.outer((one * along).sum(-1), np.array(band_hz)), axis=-1) for one in middle]
    turned = [np.einsum("pmi,pi->pm", one, across) for one in ground]
    in_angle = [np.stack([one.min(axis=1), one.max(axis=1)], axis=-1) for one in turned]
    along_range = _shared(in_range[0], in_range[1]) if window is None else _correlated(in_range[0], in_range[1], window)
    return np.asarray(along_range * _shared(*in_angle))


def _shared(one: Floats, other: Floats) -> Floats:
    """Return the length that two intervals (place, 2) share over the geometric mean of theirs."""
    both = np.minimum(one[:, 1], other[:, 1]) - np.maximum(one[:, 0], other[:, 0])
    mean = np.sqrt((one[:, 1] - one[:, 0]) * (other[:, 1] - other[:, 0]))
    return np.asarray(np.clip(both / np.maximum(mean, 1e-12), 0, 1))


def _correlated(one: Floats, other: Floats, window: Floats) -> Floats:
    """Return ∫W₁W₂ over √(∫W₁² ∫W₂²) of two intervals (place, 2) over which a window lies."""
    count = len(window)
    correlation = np.correlate(window, window, mode="full")[count - 1 :] / (window**2).sum()
    width = np.sqrt((one[:, 1] - one[:, 0]) * (other[:, 1] - other[:, 0]))
    separation = np.abs(one.mean(axis=1) - other.mean(axis=1)) / np.maximum(width, 1e-12)
    return np.asarray(np.interp(separation * (count - 1), np.arange(count), correlation, right=0.0))


# ---- Errors of the tracks -------------------------------------------------------------------------------------------

_BINS = 128  # of time, over which the errors of a track are taken as one
_FINER = 8  # points of the aperture for each pulse given
_WITHIN = 33  # lags at which the correlation of two bins is averaged, odd
_NODES = 1024  # places in work at once
_REFERENCES = 256  # places whose mean phase stands for that of all


@dataclass(frozen=True, eq=False)
class FlownAntenna:
    """One antenna of one of two images, and what is known of its positions.

    Attributes
    ----------
    platform
        Antennas of one platform in one flight have one error.
    sign
        1 for the first image, -1 for the second.
    position_m
        (place, pulse, 3) float64, metres: at pulses spread over the aperture of each place.
    time_s
        (place, pulse) float64, seconds of a clock that all antennas share.
    std_m
        (3,) float64, standard deviation of its positions east, north and up, metres.
    correlation_s
        As `apertura.core.quality.path_errors.autocorrelation`.
    """

    platform: str
    sign: int
    position_m: Floats
    time_s: Floats
    std_m: Floats
    correlation_s: float


@dataclass(frozen=True, eq=False)
class TrackPhase:
    """Errors of the phase between two images that come from the tracks.

    Attributes
    ----------
    places_m
        (place, 3) float64, metres, on the ground.
    axes
        (3, 3) float64, unit vectors east, north and up.
    antennas
        Of both images; those whose errors nobody knows are left out.
    wavenumber_rad_m
        Of the band's middle.

    Notes
    -----
    Source: docs/theory/interferometry.md, eq. 8a.
    """

    places_m: Floats
    axes: Floats
    antennas: Sequence[FlownAntenna]
    wavenumber_rad_m: float

    def std(self, reference: Sequence[int]) -> Floats:
        """Return the deviation of the phase of each place less the mean phase of some, (place,) float64 rad.

        Parameters
        ----------
        reference
            Places that the phase counts from; empty: all.

        Examples
        --------
        Two flights past a scene 30 m away; the second errs by 1 cm along its line of sight to the first place, for
        longer than it flies: nothing there, k (1 cm) sin 45° for a place seen from 45° aside.

        >>> places = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 30.0]])
        >>> antenna = np.broadcast_to([0.0, -30.0, 0.0], (2, 5, 3))
        >>> time = np.broadcast_to(np.arange(5.0), (2, 5))
        >>> flown = FlownAntenna("f02/uav1", -1, antenna, time, np.array([0.0, 0.0, 0.01]), 1e6)
        >>> TrackPhase(places, np.eye(3), [flown], 25.0).std([0]).round(3)
        array([0.   , 0.177])
        """
        count = len(self.places_m)
        chosen = np.array(reference or np.arange(count)[:: max(1, count // _REFERENCES)])
        variance = np.zeros(count)
        for platform in dict.fromkeys(one.platform for one in self.antennas):
            some = [one for one in self.antennas if one.platform == platform]
            first = min(float(one.time_s.min()) for one in some)
            width_s = max(max(float(one.time_s.max()) for one in some) - first, 1e-9) / _BINS
            between = _between_bins(width_s, some[0].correlation_s)
            mean = self._per_error(some, chosen, first, width_s).mean(axis=0)
            for start in range(0, count, _NODES):
                part = np.arange(start, min(start + _NODES, count))
                difference = self._per_error(some, part, first, width_s) - mean
                variance[part] += np.einsum("pab,pab->p", difference @ between, difference)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def _per_error(
        self, antennas: Sequence[FlownAntenna], places: np.ndarray, first_s: float, width_s: float
    ) -> Floats:
        """Return the phase of some places per deviation of a platform's error along each axis in each bin of time."""
        total = np.zeros(len(places) * 3 * _BINS)
        rows = np.arange(len(places))[:, None, None]
        for one in antennas:
            away = one.position_m[places] - self.places_m[places][:, None]
            along = away / np.linalg.norm(away, axis=-1, keepdims=True) @ self.axes.T * one.std_m
            pulses = along.shape[1]
            at = np.linspace(0, pulses - 1, _FINER * pulses)
            low = np.minimum(at.astype(np.int64), max(0, pulses - 2))
            high, share = np.minimum(low + 1, pulses - 1), at - low
            along = along[:, low] + (along[:, high] - along[:, low]) * share[:, None]
            time_s = one.time_s[places]
            time_s = time_s[:, low] + (time_s[:, high] - time_s[:, low]) * share
            bins = np.clip(((time_s - first_s) / width_s).astype(np.int64), 0, _BINS - 1)[:, :, None]
            index = (rows * 3 + np.arange(3)) * _BINS + bins
            phase = one.sign * self.wavenumber_rad_m / len(at) * along
            total += np.bincount(index.ravel(), phase.ravel(), minlength=total.size)
        return total.reshape(len(places), 3, _BINS)


def _between_bins(width_s: float, correlation_s: float) -> Floats:
    """Return the correlation of the mean errors of two bins of time, (bin, bin)."""
    within = np.linspace(-1, 1, _WITHIN)
    weight = 1 - np.abs(within)
    lag = np.abs(np.arange(_BINS)[:, None] + within) * width_s
    row = (autocorrelation(lag, correlation_s) * weight).sum(axis=1) / weight.sum()
    return np.asarray(row[np.abs(np.subtract.outer(np.arange(_BINS), np.arange(_BINS)))])
