"""Path offsets per pulse of each pair, estimated from bright patches and validated on held-out patches."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Bools, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.units import decibels
from apertura.core.backprojection.contributions import block_contributions
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.quality.budget import NodePositions, position_lines
from apertura.core.quality.path_errors import Effect, PointPaths
from apertura.methods.autofocus.evidence import FOLDS, LEAST_GAIN_DB, MOST_RATIO, gains_db, mean_gain
from apertura.methods.autofocus.inputs import PairRecord, Refinement, TrackErrors
from apertura.methods.autofocus.objective import PatchImage
from apertura.methods.autofocus.one_phase import METHODS, Patches
from apertura.methods.autofocus.patches import Candidates, Patch, count_in_memory

_APART_CELLS = 2.0  # range cells c/B of total path within which patches share noise
_BLOCKS_PER_CORRELATION_TIME = 10  # minimum number of blocks within a correlation time
_BETWEEN_BLOCKS_RAD2 = 0.1  # largest growth of the phase-error variance between blocks
_LINEAR = 1 / 8  # residual fraction of this growth with linear interpolation of offsets between blocks
_PULSES = 4096  # pulses read at a time
_SHIFTS = 0.5  # variation of the path gradient in directions of image shifts, relative to the largest


def refine_one_phase(
    records: Sequence[PairRecord], candidates: Candidates, errors: Mapping[str, TrackErrors], *, method: str
) -> Refinement:
    """Estimate path offsets of the pairs by one-phase autofocus, accepted by the contrast gain of held-out patches.

    Parameters
    ----------
    records
        Records of all pairs.
    candidates
        Candidate points of the scene.
    errors
        Node → error statistics of its log.
    method
        Key of `METHODS`.

    Notes
    -----
    Source: docs/theory/autofocus.md, "One phase per pulse". Each quarter of the patches is validated with offsets that
    are fitted to the other patches, excluding patches that share a range with this quarter. Of these offsets and those
    fitted to all patches, the offsets with the sharpest images are returned. Tracks are not corrected; the position
    errors of a node are those of its log.
    """
    if not candidates.patches:
        return candidates.rejected(errors)
    fits = [_Pair.of(record, candidates.patches, errors).fitted(method) for record in records]
    gain_db = np.concatenate([fit.gain_db for fit in fits])
    gain = mean_gain(gain_db[None])
    reason = (
        f"{gain_db.size} held-out images of bright points gained {gain.mean_db:.2f} ± {gain.std_db:.2f} dB of contrast"
    )
    # Union of all knots, so that no offset is smoothed.
    knots_s = np.unique(np.concatenate([fit.time_s for fit in fits]))
    correction = TrackCorrection(
        knots_s,
        {node: np.zeros((len(knots_s), 3)) for node in errors},
        {fit.pair: np.interp(knots_s, fit.time_s, fit.extra_path_m) for fit in fits},
    )
    std_m = {node: np.tile(error.along(candidates.axes), (len(knots_s), 1)) for node, error in errors.items()}
    report = {
        "method": method,
        "patches": len(candidates.patches),
        "gain_held_out_db": round(gain.mean_db, 3),
        "gain_std_db": round(gain.std_db, 3),
        **_residuals(fits, [_log_effect(record, candidates, errors) for record in records]),
    }
    promising = not gain.certain and abs(gain.mean_db) > LEAST_GAIN_DB  # otherwise no improvement over the logs
    return Refinement(
        correction, std_m, gain.certain, reason, report, {"refinement_rejected": reason} if promising else {}
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """Path offsets of a pair's echoes relative to its logged tracks, in total path.

    Attributes
    ----------
    pair
        Name of the pair.
    time_s, extra_path_m
        (block,) float64, seconds of the flight's clock and metres; offsets are linear between blocks.
    gain_db
        (patch,) float64, contrast gain of each patch, held out of the fit.
    residual_rad2
        Expected variance of the residual phase.
    """

    pair: str
    time_s: Floats
    extra_path_m: Floats
    gain_db: Floats
    residual_rad2: float


@dataclass(frozen=True, eq=False)
class _Pair:
    """Block contributions of a pair to the patches."""

    name: str
    time_s: Floats
    growth_rad2: float
    cached: Patches
    path_m: Floats
    cell_m: float
    slope: Floats
    wavenumber: float

    @classmethod
    def of(cls, record: PairRecord, patches: Sequence[Patch], errors: Mapping[str, TrackErrors]) -> "_Pair":
        profiles = record.profiles
        correlation_s, phase_rad = record.extreme_errors(errors)
        share = min(1 / _BLOCKS_PER_CORRELATION_TIME, _BETWEEN_BLOCKS_RAD2 / max(2 * phase_rad**2, 1e-12))
        edges = _edges(record.time_s, correlation_s * share)
        middle = (edges[:-1] + edges[1:] - 1) // 2
        time_s = np.add.reduceat(record.time_s, edges[:-1]) / np.diff(edges)
        patches = patches[: count_in_memory([len(patch.pixels_m) * len(time_s) for patch in patches])]
        cached = _contributions(record, patches, edges)
        places = np.array([patch.place_m for patch in patches])
        path_m = profiles.aperture[middle].path(places).mean(axis=0)
        slope = profiles.aperture[middle].path_gradient(places.mean(axis=0))
        cell_m = SPEED_OF_LIGHT_M_S / profiles.bandwidth_hz
        growth_rad2 = 2 * phase_rad**2 * share
        return cls(record.pair, time_s, growth_rad2, cached, path_m, cell_m, slope, profiles.wavenumber_rad_m)

    def fitted(self, method: str) -> _Fit:
        """Return the fitted offsets, and the contrast gain of each patch with offsets fitted without this patch.

        The returned offsets are the fit to all patches or to a subset that gives the largest mean gain of all patches.
        """
        folds, before = np.arange(len(self.cached)) % FOLDS, self.statistics()
        subsets = [self.without(folds == fold) for fold in range(FOLDS)]
        phases = [self.phases(method, fitted) for fitted in (*subsets, np.ones_like(subsets[0]))]
        gain_db = np.array([gains_db([before], [self.statistics(phase)])[0] for phase in phases])
        phase = phases[int(gain_db.mean(axis=1).argmax())]
        information = 2 * sum(min(image.ratio, MOST_RATIO) for image in self.statistics(phase)) / len(phase)
        residual_rad2 = _LINEAR * self.growth_rad2 + 1 / information
        # The phase of an echo with the extra path Δ changes by -kΔ.
        held_out_db = gain_db[folds, np.arange(len(folds))]
        return _Fit(self.name, self.time_s, -phase / self.wavenumber, held_out_db, residual_rad2)

    def without(self, held_out: Bools) -> Bools:
        """Return (patch,) bool, True for patches that share no range, and thus no noise, with the held-out patches."""
        near = np.abs(self.path_m[:, None] - self.path_m[held_out]) < _APART_CELLS * self.cell_m
        return np.asarray(~near.any(axis=1))

    def phases(self, method: str, used: Bools) -> Floats:
        """Return (block,) float64, phases in radians that focus the used patches without a shift; 0 if none is used."""
        if not used.any():
            return np.zeros(len(self.time_s))
        phase = METHODS[method]([self.cached[int(number)] for number in np.flatnonzero(used)])
        directions, size, _ = np.linalg.svd(self.slope - self.slope.mean(axis=0), full_matrices=False)
        # Remove the constant and the directions of eq. 34, which shift the image.
        shifting = directions[:, size >= _SHIFTS * size[0]]
        centred = phase - phase.mean()
        return np.asarray(centred - shifting @ (shifting.T @ centred))

    def statistics(self, phase: Floats | None = None) -> list[PatchImage]:
        """Return the statistics of the patches after rotation of the blocks by `phase`; by default along the logs."""
        rotation = np.exp(1j * (np.zeros(len(self.time_s)) if phase is None else phase)).astype(np.complex64)
        return [PatchImage.of(patch @ rotation) for patch in self.cached]


def _edges(time_s: Floats, block_s: float) -> NDArray[np.int64]:
    """Return (block + 1,) int64, first pulse of each block of equal duration; empty blocks are omitted."""
    count = max(2, min(len(time_s), int(np.ceil((time_s[-1] - time_s[0]) / block_s))))
    ends = np.linspace(time_s[0], time_s[-1], count + 1)[:-1]
    return np.append(np.unique(np.searchsorted(time_s, ends)), len(time_s))


def _contributions(
    record: PairRecord, patches: Sequence[Patch], edges: NDArray[np.int64]
) -> list[NDArray[np.complex64]]:
    """Return (pixel, block) contributions to each patch; every pulse is read once."""
    blocks = len(edges) - 1
    cached = [np.empty((len(patch.pixels_m), blocks), np.complex64) for patch in patches]
    at_once = max(1, _PULSES * blocks // int(edges[-1]))
    for first in range(0, blocks, at_once):
        block_slice = slice(first, min(first + at_once, blocks))
        pulses = slice(int(edges[block_slice.start]), int(edges[block_slice.stop]))
        inside = edges[block_slice.start : block_slice.stop + 1] - pulses.start
        part = record.profiles[pulses]
        part = replace(part, samples=np.asarray(part.samples))
        beams = record.beams and record.beams[pulses].on_profiles
        for patch, target in zip(patches, cached, strict=True):
            weights = None if beams is None else beams.weight(part.aperture, patch.place_m[None])[:, 0]
            target[:, block_slice] = block_contributions(part, patch.pixels_m, edges=inside, weights=weights)
    return cached


def _log_effect(record: PairRecord, candidates: Candidates, errors: Mapping[str, TrackErrors]) -> Effect:
    """Return the effect of log errors on the image of a pair."""
    profiles = record.profiles
    paths = PointPaths.of(
        profiles.aperture,
        record.time_s,
        point_m=np.mean([patch.place_m for patch in candidates.patches], axis=0),
        axes=candidates.axes,
        wavelength_m=profiles.wavelength_m,
    )
    nodes = [NodePositions(errors[node].std_m, errors[node].correlation_s) for node in dict.fromkeys(record.nodes)]
    (line,) = position_lines(paths, nodes, sidelink=record.sidelink_m is not None)
    return line.effect


def _residuals(fits: Sequence[_Fit], log_effects: Sequence[Effect]) -> dict[str, float]:
    """Return the residual errors at the scene centre.

    Shift and mean phase are those due to log errors, because the path offsets contain neither.
    """
    residual_rad2 = float(np.mean([fit.residual_rad2 for fit in fits]))
    mean_rad2 = float(np.mean([effect.phase_rad**2 for effect in log_effects]))
    return {
        "left_rad": round(float(np.sqrt(residual_rad2 + mean_rad2)), 4),
        "left_db": round(decibels(np.exp(-residual_rad2)), 3),
        "gauge_shift_m": round(max(effect.shift_m for effect in log_effects), 4),
    }
