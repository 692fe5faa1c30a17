"""Acceptance of refined tracks, measured without truth, and the errors that remain."""

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

# ---- Errors that remain after a refinement --------------------------------------------------------------------------


MOST_RATIO = 1e3
"""Peak to surroundings, power: above, a point's neighbours and not its noise bound the accuracy of its phase."""

FOLDS = 4
"""Of cross-validation: a quarter of the patches is left out of a fit, and decides on what was fitted to the others."""


@dataclass(frozen=True, eq=False)
class Remaining:
    """Errors that are expected to be left.

    Attributes
    ----------
    std_m
        Node → (knot, 3) float64, metres, along the axes of the frame.
    phase_rad
        RMS of what is left of the phase at the patches.
    shift_m
        By which the log alone, or reference points, leave the image to be moved, rms over patches.
    """

    std_m: Mapping[str, Floats]
    phase_rad: float
    shift_m: float

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "left_rad": round(self.phase_rad, 4),
            "left_db": round(noise_loss(self.phase_rad**2).loss_db, 3),
            "gauge_shift_m": round(self.shift_m, 4),
        }


def remaining(problem: Problem, state: State) -> Remaining:
    """Return the errors that remain: per knot, the log's prior combined with all phases measured while errors last.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 18. What the gauge leaves is added to the standard deviations.
    """
    nodes, knots = problem.prior.nodes, len(problem.knots_s)
    column = {node: slice(3 * number, 3 * number + 3) for number, node in enumerate(nodes)}
    # Information on the errors of all nodes at each knot: of the logs, and of all phases measured while an error lasts.
    information = np.zeros((knots, 3 * len(nodes), 3 * len(nodes)))
    for node, prior in nodes.items():
        information[:, column[node], column[node]] += prior.axes.T @ np.diag(1 / prior.std_m**2) @ prior.axes
    rows: list[tuple[slice, Floats]] = []
    smooth = max(prior.smooth for prior in nodes.values())
    for patches, statistics in zip(state.cached, state.statistics, strict=True):
        for patch, now in zip(patches, statistics, strict=True):
            ratio = min(now.ratio, MOST_RATIO)
            row = np.zeros((patch.blocks.stop - patch.blocks.start, 3 * len(nodes)))
            for node, slope in patch.slopes.items():
                row[:, column[node]] = patch.wavenumber * slope
            if len(row):
                information[patch.blocks] += 2 * ratio / len(row) * smooth * row[:, :, None] * row[:, None, :]
                rows.append((patch.blocks, row))
    # Covariance that is left; the phases that it makes at the patches, and the deviations, with the gauge's own.
    covariance = np.linalg.inv(information)
    phases = [np.einsum("bi,bij,bj->b", row, covariance[blocks], row).mean() for blocks, row in rows]
    moved = problem.prior.tracks(problem.gauge.modes)
    std_m = {
        node: np.sqrt(np.diagonal(covariance[:, part, part], axis1=1, axis2=2) + (moved[node] ** 2).sum(axis=0))
        for node, part in column.items()
    }
    return Remaining(std_m, float(np.sqrt(np.mean(phases))) if phases else float("nan"), problem.gauge.std_m)


# ---- Acceptance of refined tracks -----------------------------------------------------------------------------------

LEAST_GAIN_DB = 0.1
"""Contrast that places which were not fitted must have gained beyond doubt, dB: less shows in no image."""

DOUBT = 2.0
"""Standard deviations of the mean gain that are taken off it."""

_SCATTER, _SCATTER_DB, _DEGREES = 0.5, 0.5, 2
"""Scatter of the gains before it is measured: half of their mean and half a dB, as certain as two places make it. Few
places are judged by it, many by their own."""

LEAST_FITTED_DB = 0.3
"""Contrast that places which are points by themselves must gain, dB: a fit to noise at 10 dB a pulse gains 0.1."""

MOST_APART_SIGMA = 4.0
"""Standard deviations of their places by which pairs may disagree on points: more means slipped tracks."""

PARTS = 8
"""Of the aperture, whose images of a point are compared in range, to detect cycle slips."""

_BY_CHANCE = 1e-3  # false alarm rate of the test against the log's stated errors
_SLACK = 1.5  # factor on the variance: the image determines its modes not wholly
_REACH_CELLS, _STEPS = 3.0, 37  # of the line in range on which a point is searched: cells on either side, samples
_SLIP_SIGMA = 4.0  # standard deviations from which a shift in range is a slip
_NEARER, _NEARER_OF_FEW = 0.6, 0.75
"""Wavelengths: from here a shift is nearer to a whole turn than to none; noise is allowed for, more of few points."""
_NOTHING = 1e-9  # contrast over contrast, of a patch out of what the pulses hold
_SCATTERING_POINTS, _POINT_STD_CELLS = 3, 0.055
"""Points from which their scatter says how well a shift is known; and that of one of fewer, in cells c/B of path: a
point some 20 dB out of the noise of a part."""
_DOMINATES = 4.0  # peak power of a part's image of a point against the median of a line through it
_LEAST_SLOPE = 0.05  # of the path over ground: a point illuminated from all sides has no direction of range


@dataclass(frozen=True, eq=False)
class Evidence:
    """Measures of refined tracks.

    Attributes
    ----------
    fitted_db, held_out_db
        (pair, patch) float64, contrast gained by the patches that were fitted and by those that were not.
    settled
        (mode,) float64, unknowns that the image alone determines: of unit variance if the log states its errors
        rightly.
    before, after
        Shifts of points in range between parts of the aperture.
    wavelength_m
        Of the band's middle.
    steady
        Variance of the log-amplitude along the aperture, in the pair where it is least, of the place where it is most:
        noise of a point that dominates its cell; speckle has 0.4. Infinite where blocks are too few to tell.
    apart_sigma
        How far pairs show points apart that tracks within the log's errors do not bring together, rms, in standard
        deviations of their places.
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
        """Contrast gained by the patches that were not fitted."""
        return mean_gain(self.held_out_db)

    @property
    def believed(self) -> bool:
        """True if places that were not fitted, or a place that nothing else explains, show that tracks are better."""
        points = self.steady <= MOST_INTERFERENCE and float(self.fitted_db.mean()) > LEAST_FITTED_DB
        return self.gain.certain or points

    @property
    def accepted(self) -> bool:
        """True if the tracks are used."""
        return self.believed and not self.slip

    @property
    def promising(self) -> bool:
        """True if there was anything to gain: where even fitted places gained nothing, the logs are as good."""
        return bool(self.slip) or float(self.fitted_db.mean()) > LEAST_GAIN_DB

    @property
    def why(self) -> str:
        """In one line."""
        places = self.fitted_db.shape[1]
        line = (
            f"{places} bright {'place' if places == 1 else 'places'} gained {self.fitted_db.mean():.2f} dB of contrast"
        )
        if self.held_out_db.size:
            line += f", {self.gain.mean_db:.2f} ± {self.gain.std_db:.2f} dB while they were not fitted"
        if np.isfinite(self.steady):
            line += f"; log-amplitudes along the aperture vary by {self.steady:.2f}"
        if self.accepted:
            return line
        if self.slip:
            return f"{line}; {self.slip}"
        if not self.promising:
            return f"{line}: the logs are as good"
        return (
            f"{line}; required are {LEAST_GAIN_DB:g} dB beyond {DOUBT:g} standard deviations, or places that are "
            f"points, {MOST_INTERFERENCE:g} at most, and gained {LEAST_FITTED_DB:g} dB"
        )

    @cached_property
    def slip(self) -> str:
        """Line on parts of the aperture whose images are shifted by a wavelength of path; empty if none is."""
        if self.apart_sigma > MOST_APART_SIGMA:
            return (
                f"pairs show the same points {self.apart_sigma:.1f} standard deviations of their places apart: tracks "
                "are wrong by more than their logs' errors"
            )
        slipped = self.after.slipped(self.wavelength_m)
        if not slipped.any():
            return ""
        off_m = float(np.abs(self.after.shift_m[slipped]).max())
        return (
            f"{int(slipped.sum())} of {slipped.size} parts of the apertures see the points up to {off_m:.2f} m of path "
            f"from where most have them; the wavelength is {self.wavelength_m:.2f} m"
        )

    @cached_property
    def inconsistent(self) -> str:
        """Contradiction between the errors that the logs state and those found; empty where they fit."""
        from scipy.stats import chi2  # slow to import

        count = len(self.settled)
        if not count:
            return ""
        power = self._motion_power
        low, high = chi2.ppf([_BY_CHANCE, 1 - _BY_CHANCE], count) / count
        if low / _SLACK < power < high * _SLACK:
            return ""
        verdict = "is stated too large" if power < 1 else "is stated too small, or something else is wrong"
        return (
            f"the {count} motions that the image settles are {np.sqrt(power):.2f} times as large as the logs' errors "
            f"allow: what they err by {verdict}"
        )

    @property
    def _motion_power(self) -> float:
        """Mean square of the motions that the image determines, in variances that the log states."""
        return float((self.settled**2).mean())

    @property
    def flags(self) -> dict[str, str]:
        """Edges crossed."""
        flags = {} if self.accepted or not self.promising else {"refinement_rejected": self.why}
        if self.inconsistent:
            flags["position_error_overstated" if self._motion_power < 1 else "position_error_understated"] = (
                self.inconsistent
            )
        if self.slip:
            flags["cycle_slip_suspected"] = self.slip
        return flags

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values."""
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
    """Mean gain of contrast of patches that were not fitted, and its standard deviation, dB; NaN without any."""

    mean_db: float
    std_db: float

    @property
    def certain(self) -> bool:
        """True if it exceeds `LEAST_GAIN_DB` by `DOUBT` standard deviations."""
        return self.mean_db - DOUBT * self.std_db > LEAST_GAIN_DB


def mean_gain(held_out_db: Floats) -> MeanGain:
    """Return the mean of (pair, patch) gains.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 16a. Pairs of a patch share its neighbours and are one sample.

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
    """Return the variance of the log-amplitude along the aperture at patches' peaks: least of pairs, most of patches.

    Parameters
    ----------
    initial, state
        Along the logs, and as solved.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 1. Blocks are averaged as the logs have them, as `point_focus` averages pulses:
    phases that are fitted would make averages of speckle steady, whose amplitudes no fit changes.
    """
    worst = []
    for number in range(len(state.images[0])):
        by_pair = []
        for logged, images in zip(initial.cached, state.images, strict=True):
            along = logged[number].values[int(np.abs(images[number]).argmax())].astype(np.complex128)
            by_pair.append(steadiness(along))
        worst.append(min(by_pair))
    return max(worst)


def steadiness(along: NDArray[np.complex128]) -> float:
    """Return the least variance of the log-amplitude of contributions (block,), over averages of 1, 2, 4 … blocks."""
    least = float("inf")
    while len(along) >= LEAST_BLOCKS:
        amplitude = np.abs(along)
        if amplitude.min() > 0:
            least = min(least, log_amplitude_variance(np.log(amplitude)))
        along = along[: len(along) // 2 * 2].reshape(-1, 2).mean(axis=1)
    return least


def gains_db(before: Sequence[Sequence[PatchImage]], after: Sequence[Sequence[PatchImage]]) -> Floats:
    """Return (pair, patch) float64, dB by which the contrast Σ|I|⁴/(Σ|I|²)² has grown.

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
    """Shifts of points in range between images of parts of the aperture, from where most parts have them.

    Attributes
    ----------
    by_point_m
        (pair, patch, part) float64, metres of total path; NaN where the part does not show the point.
    cell_m
        Range cell of the pairs, c/B of total path.
    """

    by_point_m: Floats
    cell_m: float

    @cached_property
    def points(self) -> NDArray[np.int64]:
        """(pair, part) int64, how many were measured."""
        return np.asarray(np.isfinite(self.by_point_m).sum(axis=1), np.int64)

    @cached_property
    def shift_m(self) -> Floats:
        """(pair, part) float64, metres of total path: median over points; NaN where no point was measured."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a part without a measured point is NaN
            return np.asarray(np.nanmedian(self.by_point_m, axis=1), np.float64)

    @cached_property
    def std_m(self) -> Floats:
        """(pair, part) float64, its standard deviation, by the scatter of points; of one or two as stated."""
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
        """Return (pair, part) bool: parts whose shift is significantly nearer to a whole turn than to none."""
        off = np.abs(self.shift_m)
        nearer = np.where(self.points < _SCATTERING_POINTS, _NEARER_OF_FEW, _NEARER)
        agreed = (self.points > 0) & (self.std_m < wavelength_m / 2 / np.sqrt(np.maximum(self.points, 1)))
        return np.asarray(agreed & (off > nearer * wavelength_m) & (off > _SLIP_SIGMA * self.std_m))


def range_shifts(problem: Problem, state: State, axes: Floats, *, parts: int = PARTS) -> RangeShifts:
    """Return shifts in range of the brightest point of every patch, by part of the aperture.

    Parameters
    ----------
    problem, state
        As solved.
    axes
        (3, 3) float64, rows are east, north, up.
    parts
        Of the aperture.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 16. A path that is wrong by a wavelength over a part of the aperture keeps its
    phase, but not its delay.
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
    """Return (pair, patch, 1), the mean of the most parts that agree; a pixel, and the phase, lie off the delay."""
    near = np.abs(shifts_m[..., None] - shifts_m[..., None, :]) < within_m
    most = np.take_along_axis(near, near.sum(axis=-1).argmax(axis=-1)[..., None, None], axis=-2)[..., 0, :]
    total = np.where(most, shifts_m, 0.0).sum(axis=-1, keepdims=True)
    return np.asarray(total / np.maximum(most.sum(axis=-1, keepdims=True), 1), np.float64)


def _by_part(
    blocks: Blocks, echo: PatchEcho, image: NDArray[np.complex64], tracks: Tracks, axes: Floats, parts: int
) -> Floats:
    """Return (part,) float64, metres of total path by which each part's image shows a point farther; NaN if not."""
    nothing = np.full(parts, np.nan)
    place = echo.patch.pixels_m[int(np.abs(image).argmax())]
    # The line through the point over level ground along which its path grows fastest.
    slope = blocks.aperture.path_gradient(place).mean(axis=0)
    level = axes[:2].T @ (axes[:2] @ slope)
    steep = float(level @ slope)
    if steep < _LEAST_SLOPE or len(echo.profiles) < parts:
        return nothing
    extra_path_m = np.linspace(-_REACH_CELLS, _REACH_CELLS, _STEPS) * SPEED_OF_LIGHT_M_S / echo.profiles.bandwidth_hz
    line = Patch(echo.patch.place_m, place + extra_path_m[:, None] / steep * level)
    # Power along it in the image of each part, and its maximum by a parabola.
    values = blocks.contribution(replace(echo, patch=line), blocks.moves(tracks)).values
    ends = np.linspace(0, values.shape[1], parts + 1).astype(np.int64)[:-1]
    power = np.abs(np.add.reduceat(values, ends, axis=1)).astype(np.float64) ** 2
    peak = np.clip(power.argmax(axis=0), 1, _STEPS - 2)
    left, middle, right = (np.take_along_axis(power, (peak + step)[None], 0)[0] for step in (-1, 0, 1))
    curve = np.minimum(left - 2 * middle + right, -1e-300)
    shift = extra_path_m[peak] + 0.5 * (left - right) / curve * (extra_path_m[1] - extra_path_m[0])
    inside = (power.argmax(axis=0) == peak) & (middle > _DOMINATES * np.median(power, axis=0))
    return np.where(inside, shift, nothing)
