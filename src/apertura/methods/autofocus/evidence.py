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
from apertura.methods.autofocus.objective import Blocks, PatchEcho, PatchImage, Tracks
from apertura.methods.autofocus.patches import Patch, bandwidth_hz
from apertura.methods.autofocus.solve import Problem, State

# ---- Errors that remain after a refinement --------------------------------------------------------------------------


MOST_RATIO = 1e3
"""Peak to surroundings, power: above, a point's neighbours and not its noise bound the accuracy of its phase."""


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
    known = np.zeros((knots, 3 * len(nodes), 3 * len(nodes)))
    for node, prior in nodes.items():
        known[:, column[node], column[node]] += prior.axes.T @ np.diag(1 / prior.std_m**2) @ prior.axes
    rows: list[tuple[slice, Floats]] = []
    smooth = max(prior.smooth for prior in nodes.values())
    for patches, statistics in zip(state.cached, state.statistics, strict=True):
        for patch, now in zip(patches, statistics, strict=True):
            ratio = min(now.ratio, MOST_RATIO)
            row = np.zeros((patch.blocks.stop - patch.blocks.start, 3 * len(nodes)))
            for node, slope in patch.slopes.items():
                row[:, column[node]] = patch.wavenumber * slope
            if len(row):
                known[patch.blocks] += 2 * ratio / len(row) * smooth * row[:, :, None] * row[:, None, :]
                rows.append((patch.blocks, row))
    covariance = np.linalg.inv(known)
    phases = [np.einsum("bi,bij,bj->b", row, covariance[blocks], row).mean() for blocks, row in rows]
    moved = problem.prior.tracks(problem.gauge.modes)
    std_m = {
        node: np.sqrt(np.diagonal(covariance[:, part, part], axis1=1, axis2=2) + (moved[node] ** 2).sum(axis=0))
        for node, part in column.items()
    }
    return Remaining(std_m, float(np.sqrt(np.mean(phases))) if phases else float("nan"), problem.gauge.std_m)


# ---- Acceptance of refined tracks -----------------------------------------------------------------------------------

LEAST_GAIN_DB, LEAST_BETTER = 0.3, 0.75
"""Least contrast (dB) gained by patches that were not fitted, and least share of them that gains, to be accepted."""

MOST_APART_SIGMA = 4.0
"""Standard deviations of their places by which pairs may disagree on points: more means slipped tracks."""

PARTS = 8
"""Of the aperture, whose images of a point are compared in range, to detect cycle slips."""

_BY_CHANCE = 1e-3  # false alarm rate of the test against the log's stated errors
_SLACK = 1.5  # factor on the variance: the image determines its modes not wholly
_REACH_CELLS, _STEPS = 3.0, 37  # of the line in range on which a point is searched: cells on either side, samples
_SLIP_SIGMA = 4.0  # standard deviations from which a shift in range is a slip
_LEAST_POINTS = 3  # that must agree on the shift of a part of the aperture
_DOMINATES = 4.0  # peak power of a part's image of a point against the median of a line through it
_LEAST_SLOPE = 0.05  # of the path over ground: a point illuminated from all sides has no direction of range


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was measured of refined tracks.

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
    apart_sigma: float

    @property
    def gain_db(self) -> float:
        """Contrast gained by the patches that were not fitted, mean, dB."""
        return float(self.held_out_db.mean())

    @property
    def better(self) -> float:
        """Share of their images that gained."""
        return float((self.held_out_db > 0).mean())

    @property
    def accepted(self) -> bool:
        """Whether the tracks are used."""
        return self.gain_db >= LEAST_GAIN_DB and self.better >= LEAST_BETTER and not self.slip

    @property
    def why(self) -> str:
        """In one line."""
        line = (
            f"{self.held_out_db.size} images of patches that were not fitted gained {self.gain_db:.2f} dB of contrast, "
            f"{self.better:.0%} of them gained"
        )
        if self.accepted:
            return line
        return f"{line}; {LEAST_GAIN_DB:g} dB and {LEAST_BETTER:.0%} are required" + (
            ", and no slip" if self.slip else ""
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
            f"from where the whole has them; the wavelength is {self.wavelength_m:.2f} m"
        )

    @cached_property
    def inconsistent(self) -> str:
        """What is wrong with the errors that the logs state; nothing where they fit what was found."""
        from scipy.stats import chi2  # slow to import

        count = len(self.settled)
        if not count:
            return ""
        power = float((self.settled**2).mean())
        low, high = chi2.ppf([_BY_CHANCE, 1 - _BY_CHANCE], count) / count
        if low / _SLACK < power < high * _SLACK:
            return ""
        return (
            f"the {count} motions that the image settles are {np.sqrt(power):.2f} times as large as the logs' errors "
            "allow"
        )

    @property
    def flags(self) -> dict[str, str]:
        """Edges crossed."""
        flags = {} if self.accepted else {"refinement_rejected": self.why}
        if self.inconsistent:
            flags["prior_inconsistent"] = self.inconsistent
        if self.slip:
            flags["cycle_slip_suspected"] = self.slip
        return flags

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "gain_fitted_db": round(float(self.fitted_db.mean()), 3),
            "gain_held_out_db": round(self.gain_db, 3),
            "held_out_better": round(self.better, 3),
            "settled": {"modes": len(self.settled), "power": round(float((self.settled**2).mean()), 3)}
            if len(self.settled)
            else None,
            "apart_sigma": self.apart_sigma,
            "range_shift_m": {"before": self.before.rms_m, "after": self.after.rms_m},
        }


def gains_db(before: Sequence[Sequence[PatchImage]], after: Sequence[Sequence[PatchImage]]) -> Floats:
    """Return (pair, patch) float64, dB by which the contrast Σ|I|⁴/(Σ|I|²)² has grown.

    Examples
    --------
    >>> gains_db([[PatchImage(1.0, 0.1, 9.0)]], [[PatchImage(1.0, 0.2, 9.0)]]).round(2)
    array([[3.01]])
    """
    ratio = [[b.contrast / a.contrast for a, b in zip(*both, strict=True)] for both in zip(before, after, strict=True)]
    return np.asarray(10 * np.log10(np.array(ratio)), np.float64)


@dataclass(frozen=True, eq=False)
class RangeShifts:
    """Shifts of points in range between images of parts of the aperture and of the whole.

    Attributes
    ----------
    shift_m, std_m
        (pair, part) float64, metres of total path: median over points and its standard deviation; NaN where no
        point was measured.
    points
        (pair, part) int64, how many were measured.
    """

    shift_m: Floats
    std_m: Floats
    points: NDArray[np.int64]

    @property
    def rms_m(self) -> float | None:
        """RMS of the shifts, metres; None where no point was measured."""
        known = self.shift_m[np.isfinite(self.shift_m)]
        return round(float(np.sqrt((known**2).mean())), 5) if known.size else None

    def slipped(self, wavelength_m: float) -> NDArray[np.bool_]:
        """Return (pair, part) bool: parts whose shift is significantly nearer to a whole turn than to none."""
        off = np.abs(self.shift_m)
        agreed = (self.points >= _LEAST_POINTS) & (self.std_m < wavelength_m / 3 / np.sqrt(np.maximum(self.points, 1)))
        return np.asarray(agreed & (off > 0.6 * wavelength_m) & (off > _SLIP_SIGMA * self.std_m))


def range_shifts(problem: Problem, state: State, axes: Floats) -> RangeShifts:
    """Return shifts in range of the brightest point of every patch, by part of the aperture.

    Parameters
    ----------
    problem, state
        As solved.
    axes
        (3, 3) float64, rows are east, north, up.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 16. A path that is wrong by a wavelength over a part of the aperture keeps its
    phase, but not its delay.
    """
    pairs = zip(problem.pairs, problem.echoes, state.images, strict=True)
    by_part = [
        [_by_part(blocks, echo, image, state.tracks, axes) for echo, image in zip(echoes, images, strict=True)]
        for blocks, echoes, images in pairs
    ]
    shifts = np.array(by_part).reshape(len(problem.pairs), -1, PARTS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a part without a measured point is NaN
        middle = np.nanmedian(shifts, axis=1)
        spread = 1.4826 * np.nanmedian(np.abs(shifts - middle[:, None]), axis=1)
    count = np.isfinite(shifts).sum(axis=1)
    return RangeShifts(middle, np.where(count > 2, spread / np.sqrt(np.maximum(count, 1)), np.inf), count)


def _by_part(blocks: Blocks, echo: PatchEcho, image: NDArray[np.complex64], tracks: Tracks, axes: Floats) -> Floats:
    """Return (part,) float64, metres of total path by which each part's image shows a point farther; NaN if not."""
    nothing = np.full(PARTS, np.nan)
    place = echo.patch.pixels_m[int(np.abs(image).argmax())]
    slope = blocks.aperture.path_gradient(place).mean(axis=0)
    level = axes[:2].T @ (axes[:2] @ slope)
    steep = float(level @ slope)
    if steep < _LEAST_SLOPE or len(echo.profiles) < PARTS:
        return nothing
    further = np.linspace(-_REACH_CELLS, _REACH_CELLS, _STEPS) * SPEED_OF_LIGHT_M_S / bandwidth_hz(echo.profiles)
    line = Patch(echo.patch.place_m, place + further[:, None] / steep * level)
    values = blocks.contribution(replace(echo, patch=line), blocks.moves(tracks)).values
    ends = np.linspace(0, values.shape[1], PARTS + 1).astype(np.int64)[:-1]
    power = np.abs(np.add.reduceat(values, ends, axis=1)).astype(np.float64) ** 2
    peak = np.clip(power.argmax(axis=0), 1, _STEPS - 2)
    left, middle, right = (np.take_along_axis(power, (peak + step)[None], 0)[0] for step in (-1, 0, 1))
    curve = np.minimum(left - 2 * middle + right, -1e-300)
    shift = further[peak] + 0.5 * (left - right) / curve * (further[1] - further[0])
    inside = (power.argmax(axis=0) == peak) & (middle > _DOMINATES * np.median(power, axis=0))
    return np.where(inside, shift, nothing)
