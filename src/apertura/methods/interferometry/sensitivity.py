"""Sensitivity of the interferometric phase to terrain height and to track errors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.contracts import Window
from apertura.core.quality.path_errors import autocorrelation
from apertura.core.scene.looks import Lattice

Legs = tuple[Floats, Floats]
"""Phase centres of transmitter and receiver for the pulses that illuminate a point, (point, pulse, 3) metres each."""

PROBE = 0.02
"""Height step of the finite difference relative to the range: large compared with rounding errors, small compared with
the range.
"""

_STEPS = 4  # Gauss-Newton steps; the first is accurate to first order in PROBE, and each further step squares the error


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Sensitivity of the phase between two images to the terrain height above the assumed height.

    Attributes
    ----------
    slope, bend
        (...) float64, phase = slope · h + bend · h², rad for h in metres; phase of the first image minus that of the
        second.
    shift
        (..., 2) float64, displacement of the imaged terrain from the pixel, metres east and north per metre of height.
    overlap
        (...) float64, spectral overlap of the two images; 0 means no coherence.
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

    def between(self, lattice: Lattice, window: Window) -> "Sensitivity":
        """Interpolate values at the nodes of a lattice, (node row, node column), bilinearly at the pixels of a window.

        Examples
        --------
        >>> lattice, one = Lattice.of((1, 17)), np.array([[0.0, 1.0]])
        >>> nodes = Sensitivity(one, one, np.zeros((1, 2, 2)), one, one)
        >>> nodes.between(lattice, (slice(0, 1), slice(4, 6))).slope
        array([[0.25  , 0.3125]])
        """
        return Sensitivity(**{name: lattice.between(values, window) for name, values in vars(self).items()})

    @property
    def ambiguity_m(self) -> Floats:
        """Height of ambiguity, metres; infinite if the phase does not depend on height."""
        with np.errstate(divide="ignore"):
            return np.asarray(2 * np.pi / np.abs(self.slope))

    def height(self, phase_rad: Floats) -> Floats:
        """Return the height above the assumed terrain, metres; NaN if no height has the given phase.

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
    """Return the sensitivity of the phase between two images to height at given points.

    Parameters
    ----------
    places_m
        (point, 3) float64, pixels on the assumed terrain, metres.
    axes
        (3, 3) float64, unit vectors east, north and up.
    first, second
        Phase centres of pulses spread over each image's aperture, for each point, in the frame of `places_m`.
    band_hz
        Lowest and highest frequency.
    window
        (subcarrier,) float64, weights over the band, which affect the overlap; flat by default.

    Examples
    --------
    Two tracks along x are 20 m away and 20 m high; the second is 1 m higher, so that its line of sight is steeper by
    0.0244 rad. The slope is 4π/λ times 0.0244 rad over sin θ = 0.7, and terrain that is 1 m higher is displaced towards
    the radar by cot θ.

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
        first_change_m, second_change_m = (_less(paths[at], moved, legs) for at, legs in enumerate((first, second)))
        phases.append(wavenumber * (first_change_m.mean(axis=-1) - second_change_m.mean(axis=-1)))
        shifts.append((moved - places_m) @ axes[:2].T)
    return Sensitivity(
        slope=(phases[0] - phases[1]) / (2 * probe),
        bend=(phases[0] + phases[1]) / (2 * probe**2),
        shift=(shifts[0] - shifts[1]) / (2 * probe[:, None]),
        overlap=_overlap(places_m, axes, (first, second), band_hz, window),
        range_m=range_m,
    )


def baseline(place_m: Floats, axes: Floats, first: Legs, second: Legs) -> tuple[float, float]:
    """Return the distances of two tracks perpendicular to the line of sight and the first track, and along the track.

    Parameters
    ----------
    place_m
        (3,) float64, point on the terrain.
    axes
        As for `sensitivity`.
    first, second
        (pulse, 3) float64 for transmitter and receiver of each image; the middle of both is the phase centre.

    Returns
    -------
    tuple of float
        Perpendicular baseline, positive if the second track lies on the upper side of the line of sight, and offset
        along the first track, metres.

    Notes
    -----
    Source: docs/theory/stack.md, eq. 8.

    Examples
    --------
    >>> track = np.linspace(-4.0, 4.0, 9)[:, None] * [1.0, 0.0, 0.0] + [0.0, -20.0, 20.0]
    >>> higher = track + [0.5, 0.0, 1.0]
    >>> [round(one, 3) for one in baseline(np.zeros(3), np.eye(3), (track, track), (higher, higher))]
    [0.707, 0.5]
    """
    phase_centres = [(tx + rx) / 2 for tx, rx in (first, second)]
    middles = [centre.mean(axis=0) for centre in phase_centres]
    along = phase_centres[0][-1] - phase_centres[0][0]
    along = along / max(float(np.linalg.norm(along)), 1e-12)
    across = np.cross(middles[0] - place_m, along)
    across *= np.copysign(1.0, across @ axes[2]) / max(float(np.linalg.norm(across)), 1e-12)
    offset = middles[1] - middles[0]
    return float(offset @ across), float(offset @ along)


def _moved(places_m: Floats, axes: Floats, images: tuple[Legs, Legs], paths: list[Floats], height_m: Floats) -> Floats:
    """Locate the terrain that is `height_m` higher and imaged at `places_m` in both images.

    The path difference of this terrain is constant over the pulses; otherwise the terrain would be focused at another
    position along the track. The path difference has a mean of zero over both images; otherwise the terrain would be
    imaged at another range (docs/theory/interferometry.md, eq. 10).
    """
    east_north, moved = axes[:2], places_m + height_m[:, None] * axes[2]
    for _ in range(_STEPS):
        residuals, gradients = [], []
        for legs, path in zip(images, paths, strict=True):
            residuals.append(-_less(path, moved, legs))
            gradients.append(path_gradient(moved, legs) @ east_north.T)
        # Unknowns east and north; residuals: path differences of each image about their mean, and mean of both images.
        rows = [residual - residual.mean(axis=1, keepdims=True) for residual in residuals]
        slopes = [gradient - gradient.mean(axis=1, keepdims=True) for gradient in gradients]
        rows.append(sum(residual.mean(axis=1, keepdims=True) for residual in residuals) / 2)
        slopes.append(sum(gradient.mean(axis=1, keepdims=True) for gradient in gradients) / 2)
        design, misfit = np.concatenate(slopes, axis=1), np.concatenate(rows, axis=1)
        step = np.einsum("pij,pj->pi", np.linalg.pinv(design), -misfit)
        moved = moved + step @ east_north
    return np.asarray(moved)


def _path(places_m: Floats, legs: Legs) -> Floats:
    """Return the total paths, (point, pulse)."""
    tx, rx = (np.linalg.norm(places_m[:, None] - leg, axis=-1) for leg in legs)
    return np.asarray(tx + rx)


def _less(path: Floats, moved: Floats, legs: Legs) -> Floats:
    """Return the paths to the points minus the paths to the displaced points."""
    return np.asarray(path - _path(moved, legs))


def path_gradient(places_m: Floats, legs: Legs) -> Floats:
    """Return the gradients of the total paths, (point, pulse, 3)."""
    total = np.zeros_like(legs[0])
    for leg in legs:
        offset_m = places_m[:, None] - leg
        total += offset_m / np.linalg.norm(offset_m, axis=-1, keepdims=True)
    return total


def _overlap(
    places_m: Floats, axes: Floats, images: tuple[Legs, Legs], band_hz: tuple[float, float], window: Floats | None
) -> Floats:
    """Return the spectral overlap of both images, the product of the overlaps in range and in cross-range."""
    ground = [path_gradient(places_m, legs) @ axes[:2].T for legs in images]
    middle = [gradient.mean(axis=1) for gradient in ground]
    along = middle[0] + middle[1]
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-12)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    in_range = [np.sort(np.multiply.outer((mean * along).sum(-1), np.array(band_hz)), axis=-1) for mean in middle]
    cross_range = [np.einsum("pmi,pi->pm", gradient, across) for gradient in ground]
    in_angle = [np.stack([values.min(axis=1), values.max(axis=1)], axis=-1) for values in cross_range]
    along_range = _shared(in_range[0], in_range[1]) if window is None else _correlated(in_range[0], in_range[1], window)
    return np.asarray(along_range * _shared(*in_angle))


def _shared(one: Floats, other: Floats) -> Floats:
    """Return the common length of two intervals (point, 2) over the geometric mean of their lengths."""
    both = np.minimum(one[:, 1], other[:, 1]) - np.maximum(one[:, 0], other[:, 0])
    mean = np.sqrt((one[:, 1] - one[:, 0]) * (other[:, 1] - other[:, 0]))
    return np.asarray(np.clip(both / np.maximum(mean, 1e-12), 0, 1))


def _correlated(one: Floats, other: Floats, window: Floats) -> Floats:
    """Return ∫W₁W₂ / √(∫W₁² ∫W₂²) of the same window over two intervals (point, 2)."""
    count = len(window)
    correlation = np.correlate(window, window, mode="full")[count - 1 :] / (window**2).sum()
    width = np.sqrt((one[:, 1] - one[:, 0]) * (other[:, 1] - other[:, 0]))
    separation = np.abs(one.mean(axis=1) - other.mean(axis=1)) / np.maximum(width, 1e-12)
    return np.asarray(np.interp(separation * (count - 1), np.arange(count), correlation, right=0.0))


# ---- Track errors ---------------------------------------------------------------------------------------------------

_BINS = 128  # time bins, in each of which the error of a track is constant
_FINER = 8  # interpolated samples of the aperture per sampled pulse
_WITHIN = 33  # number of lags over which the correlation of two bins is averaged, odd
_NODES = 1024  # points processed at once
_REFERENCES = 256  # points whose mean phase represents the mean phase of all points


@dataclass(frozen=True, eq=False)
class FlownAntenna:
    """Antenna of one of the two images, with the accuracy of its positions.

    Attributes
    ----------
    platform
        Platform and flight; all antennas of a platform in a flight have the same error.
    sign
        1 for the first image, -1 for the second.
    position_m
        (point, pulse, 3) float64, positions at pulses spread over the aperture of each point, metres.
    time_s
        (point, pulse) float64, seconds of a clock common to all antennas.
    std_m
        (3,) float64, standard deviation of the positions east, north and up, metres.
    correlation_s
        As for `apertura.core.quality.path_errors.autocorrelation`.
    """

    platform: str
    sign: int
    position_m: Floats
    time_s: Floats
    std_m: Floats
    correlation_s: float


@dataclass(frozen=True, eq=False)
class TrackPhase:
    """Errors of the phase between two images due to track errors.

    Attributes
    ----------
    places_m
        (point, 3) float64, points on the terrain, metres.
    axes
        (3, 3) float64, unit vectors east, north and up.
    antennas
        Antennas of both images with a known position accuracy.
    wavenumber_rad_m
        Wavenumber at the band centre.

    Notes
    -----
    Source: docs/theory/interferometry.md, eq. 8a.
    """

    places_m: Floats
    axes: Floats
    antennas: Sequence[FlownAntenna]
    wavenumber_rad_m: float

    def std(self, reference: Sequence[int]) -> Floats:
        """Return the standard deviation of each point's phase relative to the mean of reference points, (point,) rad.

        Parameters
        ----------
        reference
            Indices of the reference points of the phase; empty: all points.

        Examples
        --------
        Two flights pass a scene 30 m away. The track of the second has a constant height error of 1 cm, across the line
        of sight to the first point: the phase error is zero there, and k (1 cm) sin 45° at a point 45° above.

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
        for platform in dict.fromkeys(antenna.platform for antenna in self.antennas):
            own = [antenna for antenna in self.antennas if antenna.platform == platform]
            first = min(float(antenna.time_s.min()) for antenna in own)
            width_s = max(max(float(antenna.time_s.max()) for antenna in own) - first, 1e-9) / _BINS
            between = _between_bins(width_s, own[0].correlation_s)
            mean = self._per_error(own, chosen, first, width_s).mean(axis=0)
            for start in range(0, count, _NODES):
                part = np.arange(start, min(start + _NODES, count))
                difference = self._per_error(own, part, first, width_s) - mean
                variance[part] += np.einsum("pab,pab->p", difference @ between, difference)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def _per_error(
        self, antennas: Sequence[FlownAntenna], places: np.ndarray, first_s: float, width_s: float
    ) -> Floats:
        """Return the phase of points per standard deviation of a platform's error along each axis in each time bin."""
        total = np.zeros(len(places) * 3 * _BINS)
        rows = np.arange(len(places))[:, None, None]
        for antenna in antennas:
            away = antenna.position_m[places] - self.places_m[places][:, None]
            along = away / np.linalg.norm(away, axis=-1, keepdims=True) @ self.axes.T * antenna.std_m
            pulses = along.shape[1]
            at = np.linspace(0, pulses - 1, _FINER * pulses)
            low = np.minimum(at.astype(np.int64), max(0, pulses - 2))
            high, share = np.minimum(low + 1, pulses - 1), at - low
            along = along[:, low] + (along[:, high] - along[:, low]) * share[:, None]
            time_s = antenna.time_s[places]
            time_s = time_s[:, low] + (time_s[:, high] - time_s[:, low]) * share
            bins = np.clip(((time_s - first_s) / width_s).astype(np.int64), 0, _BINS - 1)[:, :, None]
            index = (rows * 3 + np.arange(3)) * _BINS + bins
            phase = antenna.sign * self.wavenumber_rad_m / len(at) * along
            total += np.bincount(index.ravel(), phase.ravel(), minlength=total.size)
        return total.reshape(len(places), 3, _BINS)


def _between_bins(width_s: float, correlation_s: float) -> Floats:
    """Return the correlation of the mean errors of two time bins, (bin, bin)."""
    within = np.linspace(-1, 1, _WITHIN)
    weight = 1 - np.abs(within)
    lag = np.abs(np.arange(_BINS)[:, None] + within) * width_s
    row = (autocorrelation(lag, correlation_s) * weight).sum(axis=1) / weight.sum()
    return np.asarray(row[np.abs(np.subtract.outer(np.arange(_BINS), np.arange(_BINS)))])
