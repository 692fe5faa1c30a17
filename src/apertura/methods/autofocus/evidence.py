"""Acceptance of refined tracks without ground truth, and residual track errors after a refinement."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.quality.budget import noise_loss
from apertura.core.quality.focus import LEAST_BLOCKS, MOST_INTERFERENCE, log_amplitude_variance
from apertura.methods.autofocus.objective import Blocks, PatchEcho, PatchImage, Tracks
from apertura.methods.autofocus.patches import Patch
from apertura.methods.autofocus.solve import Problem, State

# ---- Residual errors after a refinement -----------------------------------------------------------------------------


MOST_RATIO = 1e3
"""Peak-to-background power ratio above which the phase accuracy of a point is limited by neighbouring points instead of
noise.
"""

FOLDS = 4
"""Number of folds of the cross-validation: each fit excludes a quarter of the patches, which then validate the fit."""


@dataclass(frozen=True, eq=False)
class Remaining:
    """Expected residual errors.

    Attributes
    ----------
    std_m
        Node → (knot, 3) float64, standard deviation of positions in metres, along the axes of the frame.
    phase_rad
        Residual phase at the patches, rms.
    shift_m
        Uncertainty of the image position, which is determined only by logs and reference points, rms over patches.
    """

    std_m: Mapping[str, Floats]
    phase_rad: float
    shift_m: float

    @property
    def report(self) -> dict[str, Any]:
        """Residual errors as JSON values."""
        return {
            "left_rad": round(self.phase_rad, 4),
            "left_db": round(noise_loss(self.phase_rad**2).loss_db, 3),
            "gauge_shift_m": round(self.shift_m, 4),
        }


def remaining(problem: Problem, state: State) -> Remaining:
    """Estimate the residual errors per knot from the logs' prior and from all phases within the correlation time.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 18. The uncertainty of the gauge is added to the standard deviations.
    """
    nodes, knots = problem.prior.nodes, len(problem.knots_s)
    columns_of = {node: slice(3 * number, 3 * number + 3) for number, node in enumerate(nodes)}
    # Information on the errors of all nodes at each knot, from the logs and from all phases within a correlation time.
    information = np.zeros((knots, 3 * len(nodes), 3 * len(nodes)))
    for node, prior in nodes.items():
        information[:, columns_of[node], columns_of[node]] += prior.axes.T @ np.diag(1 / prior.std_m**2) @ prior.axes
    rows: list[tuple[slice, Floats]] = []
    smooth = max(prior.smooth for prior in nodes.values())
    for patches, statistics in zip(state.cached, state.statistics, strict=True):
        for patch, image in zip(patches, statistics, strict=True):
            ratio = min(image.ratio, MOST_RATIO)
            row = np.zeros((patch.blocks.stop - patch.blocks.start, 3 * len(nodes)))
            for node, slope in patch.slopes.items():
                row[:, columns_of[node]] = patch.wavenumber * slope
            if len(row):
                information[patch.blocks] += 2 * ratio / len(row) * smooth * row[:, :, None] * row[:, None, :]
                rows.append((patch.blocks, row))
    # Residual covariance, phase variances at the patches, and standard deviations including those of the gauge.
    covariance = np.linalg.inv(information)
    phase_variances = [np.einsum("bi,bij,bj->b", row, covariance[blocks], row).mean() for blocks, row in rows]
    gauge_tracks = problem.prior.tracks(problem.gauge.modes)
    std_m = {
        node: np.sqrt(
            np.diagonal(covariance[:, columns, columns], axis1=1, axis2=2) + (gauge_tracks[node] ** 2).sum(axis=0)
        )
        for node, columns in columns_of.items()
    }
    return Remaining(
        std_m, float(np.sqrt(np.mean(phase_variances))) if phase_variances else float("nan"), problem.gauge.std_m
    )


# ---- Acceptance of refined tracks -----------------------------------------------------------------------------------

LEAST_GAIN_DB = 0.1
"""Minimum contrast gain of held-out patches, net of its uncertainty, dB; a smaller gain is not visible in an image."""

DOUBT = 2.0
"""Standard deviations subtracted from the mean gain."""

_SCATTER, _SCATTER_DB, _DEGREES = 0.5, 0.5, 2
"""Prior standard deviation of the gains: half of their mean and 0.5 dB, added in quadrature; the prior has the weight
of two patches. The prior dominates with few patches, the measured scatter with many.
"""

LEAST_FITTED_DB = 0.3
"""Minimum contrast gain of fitted patches with confirmed points, dB; a fit to noise alone gains 0.1 dB at an SNR of 10
dB per pulse.
"""

MOST_APART_SIGMA = 4.0
"""Largest disagreement of point positions between pairs, in standard deviations; larger values indicate cycle slips."""

PARTS = 8
"""Number of subapertures whose images of a point are compared in range to detect cycle slips."""

_BY_CHANCE = 1e-3  # false alarm rate of the test of the configured log errors
_SLACK = 1.5  # factor on the variance, because the image does not fully determine these modes
_REACH_CELLS, _STEPS = 3.0, 37  # search line for a point in range: range cells on either side; number of samples
_SLIP_SIGMA = 4.0  # minimum shift in range of a cycle slip, standard deviations
_NEARER, _NEARER_OF_FEW = 0.6, 0.75
"""Minimum shift of a cycle slip, wavelengths, for many and for few points: half a wavelength plus a noise margin."""
_NOTHING = 1e-9  # floor of the contrast ratio, for a patch without echoes
_SCATTERING_POINTS, _POINT_STD_CELLS = 3, 0.055
"""Minimum number of points whose scatter gives the standard deviation of a shift; and, for fewer points, the standard
deviation assumed per point, cells c/B of path, which is that of a point 20 dB above the noise of the subaperture.
"""
_DOMINATES = 4.0  # minimum peak power of a point in a subaperture image over the median of the search line
_LEAST_SLOPE = 0.05  # minimum gradient of the path over ground: a point viewed from all sides has no range direction


@dataclass(frozen=True, eq=False)
class Evidence:
    """Quality measures of refined tracks.

    Attributes
    ----------
    fitted_db, held_out_db
        (pair, patch) float64, contrast gain of the fitted patches and of the held-out patches.
    settled
        (mode,) float64, unknowns that the image alone determines; their variance is 1 if the errors of the logs are
        configured correctly.
    before, after
        Shifts of points in range between subapertures.
    wavelength_m
        Wavelength at the band centre.
    steady
        Variance of the log-amplitude along the aperture: maximum over patches of the minimum over pairs. It equals the
        noise variance for a point that dominates its cell, and 0.4 for speckle; it is infinite if there are too few
        blocks.
    apart_sigma
        Rms disagreement of point positions between pairs, in standard deviations, that remains for all tracks within
        the errors of the logs.
    """

    fitted_db: Floats
    held_out_db: Floats
    settled: Floats
    before: "RangeShifts"
    after: "RangeShifts"
    wavelength_m: float
    steady: float
    apart_sigma: float

    @property
    def gain(self) -> "MeanGain":
        """Contrast gain of the held-out patches."""
        return mean_gain(self.held_out_db)

    @property
    def believed(self) -> bool:
        """True if the tracks significantly increase the contrast of held-out patches, or of fitted confirmed points."""
        points = self.steady <= MOST_INTERFERENCE and float(self.fitted_db.mean()) > LEAST_FITTED_DB
        return self.gain.certain or points

    @property
    def accepted(self) -> bool:
        """True if the tracks are used."""
        return self.believed and not self.slip

    @property
    def promising(self) -> bool:
        """True if fitted patches gained contrast or a cycle slip was found; otherwise the logs are equally good."""
        return bool(self.slip) or float(self.fitted_db.mean()) > LEAST_GAIN_DB

    @property
    def reason(self) -> str:
        """Reason of acceptance or rejection, one line."""
        count = self.fitted_db.shape[1]
        line = f"{count} bright {'point' if count == 1 else 'points'} gained {self.fitted_db.mean():.2f} dB of contrast"
        if self.held_out_db.size:
            line += f" when fitted, {self.gain.mean_db:.2f} ± {self.gain.std_db:.2f} dB when held out of the fit"
        if np.isfinite(self.steady):
            line += f"; variance of the log-amplitude along the aperture {self.steady:.2f}"
        if self.accepted:
            return line
        if self.slip:
            return f"{line}; {self.slip}"
        if not self.promising:
            return f"{line}: no improvement over the logs"
        return (
            f"{line}; acceptance requires {LEAST_GAIN_DB:g} dB plus {DOUBT:g} standard deviations when held out, or "
            f"{LEAST_FITTED_DB:g} dB when fitted at a variance of {MOST_INTERFERENCE:g} at most"
        )

    @cached_property
    def slip(self) -> str:
        """Description of cycle slips: points shifted between pairs or subapertures; empty if there are none."""
        if self.apart_sigma > MOST_APART_SIGMA:
            return (
                f"point positions differ between pairs by {self.apart_sigma:.1f} standard deviations: the tracks are "
                "wrong by more than the configured errors of the logs"
            )
        slipped = self.after.slipped(self.wavelength_m)
        if not slipped.any():
            return ""
        shift_m = float(np.abs(self.after.shift_m[slipped]).max())
        return (
            f"{int(slipped.sum())} of {slipped.size} subapertures show the points displaced by up to {shift_m:.2f} m "
            f"of path relative to most subapertures; the wavelength is {self.wavelength_m:.2f} m"
        )

    @cached_property
    def inconsistent(self) -> str:
        """Contradiction between configured and estimated errors of the logs; empty if they are consistent."""
        from scipy.stats import chi2  # slow to import

        count = len(self.settled)
        if not count:
            return ""
        power = self._motion_power
        low, high = chi2.ppf([_BY_CHANCE, 1 - _BY_CHANCE], count) / count
        if low / _SLACK < power < high * _SLACK:
            return ""
        verdict = "too large" if power < 1 else "too small, or there is another error"
        return (
            f"the {count} motion modes that the image determines are {np.sqrt(power):.2f} times the configured errors "
            f"of the logs: the configured errors are {verdict}"
        )

    @property
    def _motion_power(self) -> float:
        """Mean square of the motion modes that the image determines, relative to the configured variance."""
        return float((self.settled**2).mean())

    @property
    def flags(self) -> dict[str, str]:
        """Flag → measured values for exceeded limits."""
        flags = {} if self.accepted or not self.promising else {"refinement_rejected": self.reason}
        if self.inconsistent:
            flags["position_error_overstated" if self._motion_power < 1 else "position_error_understated"] = (
                self.inconsistent
            )
        if self.slip:
            flags["cycle_slip_suspected"] = self.slip
        return flags

    @property
    def report(self) -> dict[str, Any]:
        """Quality measures as JSON values."""
        return {
            "gain_fitted_db": round(float(self.fitted_db.mean()), 3),
            **(
                {"gain_held_out_db": round(self.gain.mean_db, 3), "gain_std_db": round(self.gain.std_db, 3)}
                if self.held_out_db.size
                else {"steady": round(self.steady, 4) if np.isfinite(self.steady) else None}
            ),
            "settled": {"modes": len(self.settled), "power": round(float((self.settled**2).mean()), 3)}
            if len(self.settled)
            else None,
            "apart_sigma": self.apart_sigma,
            "range_shift_m": {"before": self.before.rms_m, "after": self.after.rms_m},
        }


@dataclass(frozen=True)
class MeanGain:
    """Mean contrast gain of held-out patches and its standard deviation, dB; NaN without held-out patches."""

    mean_db: float
    std_db: float

    @property
    def certain(self) -> bool:
        """True if the gain exceeds `LEAST_GAIN_DB` by `DOUBT` standard deviations."""
        return self.mean_db - DOUBT * self.std_db > LEAST_GAIN_DB


def mean_gain(held_out_db: Floats) -> MeanGain:
    """Return the mean of (pair, patch) gains and its standard deviation.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 16a. The images of a patch from several pairs count as one sample, because
    they contain the same neighbours of the point.

    Examples
    --------
    >>> mean_gain(np.array([[4.0, 5.0, 4.4]])).certain, mean_gain(np.array([[0.6, 0.7]])).certain
    (True, False)
    """
    if not held_out_db.size:
        return MeanGain(float("nan"), float("nan"))
    by_patch = held_out_db.mean(axis=0)
    mean, count = float(by_patch.mean()), by_patch.size
    expected = _SCATTER_DB**2 + (_SCATTER * mean) ** 2
    squares = float(((by_patch - mean) ** 2).sum()) + _DEGREES * expected
    return MeanGain(mean, float(np.sqrt(squares / (count - 1 + _DEGREES) / count)))


def unsteady(initial: State, state: State) -> float:
    """Return the log-amplitude variance along the aperture at patch peaks: minimum over pairs, maximum over patches.

    Parameters
    ----------
    initial, state
        State along the logs, and the solved state.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 1. Blocks are averaged along the logged tracks, as `point_focus` averages pulses:
    with fitted phases, averages of speckle would be steady as well, although no fit changes the amplitudes.
    """
    worst = []
    for number in range(len(state.images[0])):
        by_pair = []
        for logged, images in zip(initial.cached, state.images, strict=True):
            contributions = logged[number].values[int(np.abs(images[number]).argmax())].astype(np.complex128)
            by_pair.append(steadiness(contributions))
        worst.append(min(by_pair))
    return max(worst)


def steadiness(along: NDArray[np.complex128]) -> float:
    """Return the log-amplitude variance of contributions (block,): the minimum over averages of 1, 2, 4, … blocks."""
    least = float("inf")
    while len(along) >= LEAST_BLOCKS:
        amplitude = np.abs(along)
        if amplitude.min() > 0:
            least = min(least, log_amplitude_variance(np.log(amplitude)))
        along = along[: len(along) // 2 * 2].reshape(-1, 2).mean(axis=1)
    return least


def gains_db(before: Sequence[Sequence[PatchImage]], after: Sequence[Sequence[PatchImage]]) -> Floats:
    """Return (pair, patch) float64, the increase of the contrast Σ|I|⁴/(Σ|I|²)² in dB.

    Examples
    --------
    >>> gains_db([[PatchImage(1.0, 0.1, 9.0)]], [[PatchImage(1.0, 0.2, 9.0)]]).round(2)
    array([[3.01]])
    """
    ratio = [
        [b.contrast / max(a.contrast, 1e-150) for a, b in zip(*both, strict=True)]
        for both in zip(before, after, strict=True)
    ]
    return np.asarray(10 * np.log10(np.maximum(np.array(ratio), _NOTHING)), np.float64)


@dataclass(frozen=True, eq=False)
class RangeShifts:
    """Range shifts of points in subaperture images, relative to their range in most subapertures.

    Attributes
    ----------
    by_point_m
        (pair, patch, part) float64, metres of total path; NaN where the point is not visible in the subaperture.
    cell_m
        Range cell of the pairs, c/B of total path.
    """

    by_point_m: Floats
    cell_m: float

    @cached_property
    def points(self) -> NDArray[np.int64]:
        """(pair, part) int64, number of measured points."""
        return np.asarray(np.isfinite(self.by_point_m).sum(axis=1), np.int64)

    @cached_property
    def shift_m(self) -> Floats:
        """(pair, part) float64, metres of total path: median over points; NaN where no point was measured."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a subaperture without a measured point is NaN
            return np.asarray(np.nanmedian(self.by_point_m, axis=1), np.float64)

    @cached_property
    def std_m(self) -> Floats:
        """(pair, part) float64, standard deviation of the shift: from the points' scatter; assumed for few points."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            spread = 1.4826 * np.nanmedian(np.abs(self.by_point_m - self.shift_m[:, None]), axis=1)
        few = self.points < _SCATTERING_POINTS
        return np.where(few, _POINT_STD_CELLS * self.cell_m, spread) / np.sqrt(np.maximum(self.points, 1))

    @property
    def rms_m(self) -> float | None:
        """RMS of the shifts, metres; None where no point was measured."""
        known = self.shift_m[np.isfinite(self.shift_m)]
        return round(float(np.sqrt((known**2).mean())), 5) if known.size else None

    def slipped(self, wavelength_m: float) -> NDArray[np.bool_]:
        """Return (pair, part) bool, True where the shift is significantly closer to a wavelength than to 0."""
        size_m = np.abs(self.shift_m)
        least = np.where(self.points < _SCATTERING_POINTS, _NEARER_OF_FEW, _NEARER)
        consistent = (self.points > 0) & (self.std_m < wavelength_m / 2 / np.sqrt(np.maximum(self.points, 1)))
        return np.asarray(consistent & (size_m > least * wavelength_m) & (size_m > _SLIP_SIGMA * self.std_m))


def range_shifts(problem: Problem, state: State, axes: Floats, *, parts: int = PARTS) -> RangeShifts:
    """Measure the range shifts of the brightest point of every patch between subapertures.

    Parameters
    ----------
    problem, state
        Solved problem and its state.
    axes
        (3, 3) float64, rows are east, north, up.
    parts
        Number of subapertures.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 16. A path error of one wavelength over a subaperture leaves the phase
    unchanged, but not the delay.
    """
    pairs = zip(problem.pairs, problem.echoes, state.images, strict=True)
    by_part = [
        [_by_part(blocks, echo, image, state.tracks, axes, parts) for echo, image in zip(echoes, images, strict=True)]
        for blocks, echoes, images in pairs
    ]
    cell_m = max(SPEED_OF_LIGHT_M_S / blocks.record.profiles.bandwidth_hz for blocks in problem.pairs)
    wavelength_m = SPEED_OF_LIGHT_M_S / problem.pairs[0].record.profiles.centre_frequency_hz
    shifts_m = np.array(by_part).reshape(len(problem.pairs), -1, parts)
    return RangeShifts(shifts_m - _of_most(shifts_m, wavelength_m / 4), cell_m)


def _of_most(shifts_m: Floats, within_m: float) -> Floats:
    """Return (pair, patch, 1), the mean shift of the largest set of subapertures that agree within `within_m`.

    This mean is the delay offset relative to the brightest pixel; it is common to all subapertures.
    """
    near = np.abs(shifts_m[..., None] - shifts_m[..., None, :]) < within_m
    most = np.take_along_axis(near, near.sum(axis=-1).argmax(axis=-1)[..., None, None], axis=-2)[..., 0, :]
    total = np.where(most, shifts_m, 0.0).sum(axis=-1, keepdims=True)
    return np.asarray(total / np.maximum(most.sum(axis=-1, keepdims=True), 1), np.float64)


def _by_part(
    blocks: Blocks, echo: PatchEcho, image: NDArray[np.complex64], tracks: Tracks, axes: Floats, parts: int
) -> Floats:
    """Return (part,) float64, range shift of a point in each subaperture image, metres of total path.

    The shift is NaN where the point is not visible.
    """
    nothing = np.full(parts, np.nan)
    point_m = echo.patch.pixels_m[int(np.abs(image).argmax())]
    # Horizontal line through the point along which its path grows fastest.
    slope = blocks.aperture.path_gradient(point_m).mean(axis=0)
    level = axes[:2].T @ (axes[:2] @ slope)
    gradient = float(level @ slope)
    if gradient < _LEAST_SLOPE or len(echo.profiles) < parts:
        return nothing
    extra_path_m = np.linspace(-_REACH_CELLS, _REACH_CELLS, _STEPS) * SPEED_OF_LIGHT_M_S / echo.profiles.bandwidth_hz
    line = Patch(echo.patch.place_m, point_m + extra_path_m[:, None] / gradient * level)
    # Power along the line in each subaperture image, and its maximum by a parabola.
    values = blocks.contribution(replace(echo, patch=line), blocks.moves(tracks)).values
    ends = np.linspace(0, values.shape[1], parts + 1).astype(np.int64)[:-1]
    power = np.abs(np.add.reduceat(values, ends, axis=1)).astype(np.float64) ** 2
    peak = np.clip(power.argmax(axis=0), 1, _STEPS - 2)
    left, middle, right = (np.take_along_axis(power, (peak + step)[None], 0)[0] for step in (-1, 0, 1))
    curve = np.minimum(left - 2 * middle + right, -1e-300)
    shift = extra_path_m[peak] + 0.5 * (left - right) / curve * (extra_path_m[1] - extra_path_m[0])
    inside = (power.argmax(axis=0) == peak) & (middle > _DOMINATES * np.median(power, axis=0))
    return np.where(inside, shift, nothing)
