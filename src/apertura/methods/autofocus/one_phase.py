"""One phase per pulse block for the whole scene: space-variance test, phase gradient and minimum entropy autofocus."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.core.quality.path_errors import PointPaths
from apertura.methods.autofocus.inputs import NodePrior, TrackErrors

# ---- Space variance: path errors at the scene edges relative to the scene centre ------------------------------------


MOST_LOSS_DB = 0.1
"""Largest peak loss at the scene edges for which one phase per pulse suffices, dB."""


@dataclass(frozen=True)
class SpaceVariance:
    """Residual path errors at points of a scene after correction by the path errors at the scene centre.

    Attributes
    ----------
    residual_rad
        Residual phase in radians, rms over pulses and points.
    loss_db
        Peak loss, mean over the points, 0 or less; errors that only shift a point are excluded.
    """

    residual_rad: float
    loss_db: float

    @property
    def method(self) -> Literal["one_phase", "tracks"]:
        """Simplest sufficient method of autofocus."""
        return "one_phase" if self.loss_db >= -MOST_LOSS_DB else "tracks"

    @property
    def reason(self) -> str:
        """Reason of the choice, one line."""
        return (
            f"one phase per pulse leaves {self.residual_rad:.2g} rad rms and a loss of {-self.loss_db:.2g} dB at the "
            f"scene edges; {MOST_LOSS_DB:g} dB is tolerated"
        )


def space_variance(middle: PointPaths, points_m: Floats, errors: Sequence[TrackErrors]) -> SpaceVariance:
    """Estimate the residual errors at points after correction by one phase per pulse, the phase at the scene centre.

    Parameters
    ----------
    middle
        Paths of a pair to the scene centre.
    points_m
        (point, 3) float64, corners of the scene, metres in the frame of the phase centres.
    errors
        Error statistics of the logs: of a single log for a monostatic pair, otherwise of transmitter and receiver.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 30. A sidelink changes the phase of all points equally.

    Examples
    --------
    >>> from apertura.core.geometry.aperture import Aperture
    >>> along = np.linspace(-100, 100, 200)
    >>> track = np.stack([along, np.full(200, -2000.0), np.full(200, 500.0)], -1)
    >>> paths = PointPaths(Aperture(track, track), along / 20, np.zeros(3), np.eye(3), 0.2)
    >>> corners = np.array([[-20.0, -20, 0], [20, -20, 0], [-20, 20, 0], [20, 20, 0]])
    >>> far = space_variance(paths, corners, [TrackErrors((0.02, 0.02, 0.02))])
    >>> far.method, round(far.residual_rad, 3)
    ('one_phase', 0.013)
    """
    effects = [_at(middle, point, errors) for point in points_m]
    residual_rad = float(np.sqrt(np.mean([power for power, _ in effects])))
    return SpaceVariance(residual_rad, float(np.mean([loss_db for _, loss_db in effects])))


def _at(middle: PointPaths, point_m: Floats, errors: Sequence[TrackErrors]) -> tuple[float, float]:
    """Return the mean square residual phase at a point, rad², and the loss that this phase causes, dB."""
    point = replace(middle, point_m=point_m)
    gradients = (paths.by_node(same=len(errors) == 1, sidelink=False) for paths in (point, middle))
    residuals: list[tuple[Floats, float]] = []
    for at_point, at_middle, error in zip(*gradients, errors, strict=True):
        slow = NodePrior.of(error, middle.time_s, middle.axes).slow
        for std_m, difference in zip(error.std_m, (at_point - at_middle).T, strict=True):
            residuals.append((std_m * difference, error.correlation_s))
            residuals += [(mode * difference, float("inf")) for mode in slow.T]
    power = sum(float((std_m**2).mean()) for std_m, _ in residuals)
    return power * (2 * np.pi / middle.wavelength_m) ** 2, point.of_noise(*residuals).loss_db


# ---- Estimators of one phase per block: phase gradient and minimum entropy ------------------------------------------

Patches = Sequence[NDArray[np.complex64]]
"""Block contributions to the pixels, (pixel, block), one array for each patch."""

_SHRINK = 0.7  # ratio of the window widths of consecutive passes
_EDGE_DB, _WIDER = 10.0, 1.5  # minimum window: extent of blurred points at this level, times a factor
_LEAST_VARIANCE = 0.02  # floor of a line's amplitude variance relative to its squared mean
_SETTLED_RAD = 0.05  # rms phase change below which the passes stop
_MOST_PASSES = 30  # maximum passes of phase gradient
_CHOICES = 2  # selections of the brightest pixels: one in the initial image, one in the sharpened image
_MOST_STEPS = 100  # maximum steps of L-BFGS-B in minimum entropy


def phase_gradient(patches: Patches) -> Floats:
    """Estimate the correction phases of the blocks by phase gradient autofocus on the brightest pixels.

    Parameters
    ----------
    patches
        Block contributions, (pixel, block) complex64 each.

    Returns
    -------
    ndarray
        (block,) float64, radians, continuous, without mean and slope.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 32; D. E. Wahl, P. H. Eichel, D. C. Ghiglia and C. V. Jakowatz, "Phase
    gradient autofocus", IEEE Trans. Aerospace and Electronic Systems 30(3), 1994.

    Examples
    --------
    >>> blurred = np.exp(2j * np.sin(np.arange(64) / 5))
    >>> corrected = blurred * np.exp(1j * phase_gradient([blurred[None].astype(np.complex64)]))
    >>> [round(float(np.abs(np.fft.fft(line, 1024)).max()) / 64, 1) for line in (blurred, corrected)]
    [0.6, 1.0]
    """
    count = patches[0].shape[1]
    cycles = np.abs(np.fft.fftfreq(2 * count, 1 / count))
    phase, window = np.zeros(count), float(count)
    for _ in range(_MOST_PASSES):
        # Window about the point of each line: 0.7 of the previous width, but no narrower than the blurred point.
        spectrum = np.fft.fft(_lines(patches, phase), 2 * count, axis=1)
        least = _spread(spectrum, cycles)
        is_narrow = window <= least
        window = min(window, least) if is_narrow else max(window * _SHRINK, least)
        windowed = np.fft.ifft(np.where(cycles <= window / 2, spectrum, 0), axis=1)[:, :count]
        # Eq. 32, summed over m, without mean and slope.
        steps = (windowed[:, 1:] * windowed[:, :-1].conj() / _amplitude_variance(windowed)).sum(axis=0)
        error = _level(np.append(0.0, np.cumsum(np.angle(steps))))
        phase = phase - error
        if is_narrow and error.std() < _SETTLED_RAD:
            break
    return phase


def minimum_entropy(patches: Patches) -> Floats:
    """Estimate the correction phases of the blocks by minimum entropy of the lines through the brightest pixels.

    The parameters and the result are those of `phase_gradient`.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 33.

    Examples
    --------
    >>> blurred = np.exp(2j * np.sin(np.arange(64) / 5))
    >>> corrected = blurred * np.exp(1j * minimum_entropy([blurred[None].astype(np.complex64)]))
    >>> [round(float(np.abs(np.fft.fft(line, 1024)).max()) / 64, 1) for line in (blurred, corrected)]
    [0.6, 1.0]
    """
    from scipy.optimize import minimize  # slow to import

    phase = np.zeros(patches[0].shape[1])
    options = {"maxiter": _MOST_STEPS, "maxcor": 20}
    for _ in range(_CHOICES):
        lines = _lines(patches, phase)
        result = minimize(partial(entropy, lines), np.zeros_like(phase), jac=True, method="L-BFGS-B", options=options)
        phase = _level(phase + np.unwrap(result.x))
    return phase


def entropy(lines: NDArray[np.complex128], phase: Floats) -> tuple[float, Floats]:
    """Return the entropy of image lines and its derivative with respect to the phase of each block.

    Parameters
    ----------
    lines
        (line, block) complex128, block contributions to a pixel of each line.
    phase
        (block,) float64, phases applied to the blocks, radians.

    Returns
    -------
    tuple
        Entropy in nats; (block,) float64, derivative in nats per radian.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 33. The blocks are zero-padded to twice their number, so that neither a peak
    between two samples nor a peak at the end of a line is blurred; the energy does not depend on the phases.

    Examples
    --------
    >>> lines, step = np.exp(1j * np.arange(8.0) ** 2)[None], 1e-6 * np.eye(8)[3]
    >>> slope = (entropy(lines, step)[0] - entropy(lines, -step)[0]) / 2e-6
    >>> round(slope, 6), round(float(entropy(lines, 0 * step)[1][3]), 6)
    (0.114494, 0.114494)
    """
    # I_i and q of eq. 33, then H and ∂H/∂θ.
    rotated = lines * np.exp(1j * phase)
    blocks = rotated.shape[1]
    image = np.fft.fft(rotated, 2 * blocks, axis=1, norm="ortho")
    power = np.abs(image) ** 2
    total = max(float(power.sum()), 1e-300)
    share = power / total
    logarithm = np.log(np.maximum(share, 1e-300))
    by_image = -(logarithm + 1) * image / total
    by_rotated = np.fft.ifft(by_image, axis=1, norm="ortho")[:, :blocks]
    return -float((share * logarithm).sum()), -2 * (rotated * by_rotated.conj()).imag.sum(axis=0)


def _lines(patches: Patches, phase: Floats) -> NDArray[np.complex128]:
    """Return (patch, block), phase-corrected block contributions to the brightest pixel of each patch."""
    rotation = np.exp(1j * phase)
    brightest = (int(np.abs(patch @ rotation.astype(np.complex64)).argmax()) for patch in patches)
    return np.stack([patch[pixel] * rotation for patch, pixel in zip(patches, brightest, strict=True)])


def _spread(spectrum: NDArray[np.complex128], cycles: Floats) -> float:
    """Return the width of a window that contains the blurred points, cycles over the aperture."""
    power = (np.abs(spectrum) ** 2).sum(axis=0)
    return 2 * _WIDER * max(float(cycles[power > power.max() * 10 ** (-_EDGE_DB / 10)].max(initial=0.0)), 1.0)


def _amplitude_variance(windowed: NDArray[np.complex128]) -> Floats:
    """Return (line, 1), the amplitude variance of each line that clutter and noise cause in addition to the point."""
    level = np.abs(windowed)
    return np.asarray(level.var(axis=1) + _LEAST_VARIANCE * level.mean(axis=1) ** 2)[:, None] + 1e-300


def _level(phase: Floats) -> Floats:
    """Return phases without mean and slope, which only rotate and shift a line."""
    at = np.linspace(-1, 1, len(phase))
    return np.asarray(phase - phase.mean() - at * (at @ phase) / (at @ at))


METHODS: Mapping[str, Callable[[Patches], Floats]] = {
    "phase_gradient": phase_gradient,
    "minimum_entropy": minimum_entropy,
}
"""Value of `processing.autofocus_method` → estimator of one phase per pulse."""
