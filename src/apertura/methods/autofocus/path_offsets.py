"""One path offset per pulse of each pair, estimated from bright patches, and whether it is accepted."""

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

_APART_CELLS = 2.0  # of range, c/B of total path: patches nearer than that share noise
_BLOCKS_PER_CORRELATION_TIME = 10  # at least
_BETWEEN_BLOCKS_RAD2 = 0.1  # by which an error grows from block to block: linear between them, an eighth is left
_LINEAR = 1 / 8  # of that growth is left by offsets that are linear between blocks
_PULSES = 4096  # read at a time
_SHIFTS = 0.5  # of the largest variation of the path's slope: a move in such a direction is a phase alone


def refine_one_phase(
    records: Sequence[PairRecord], found: Candidates, errors: Mapping[str, TrackErrors], *, method: str
) -> Refinement:
    """Return path offsets of pairs that make patches sharp, accepted by the gain of patches that were not fitted.

    Parameters
    ----------
    records
        Of every pair.
    found
        Places of the scene to refine by.
    errors
        Node → error statistics of its log.
    method
        A row of `METHODS`.

    Notes
    -----
    Source: docs/theory/autofocus.md, "One phase per pulse". Each quarter of the patches is validated with offsets
    fitted to those of the others that share no range with it. Of these offsets and those fitted to all, the sharpest
    are returned.
    No node is moved: its position errors remain those of its log.
    """
    if not found.patches:
        return found.rejected(errors)
    fits = [_Pair.of(record, found.patches, errors).fitted(method) for record in records]
    gain_db = np.concatenate([fit.gain_db for fit in fits])
    gain = mean_gain(gain_db[None])
    why = (
        f"{gain_db.size} images of patches, each while it was not fitted, gained {gain.mean_db:.2f} ± "
        f"{gain.std_db:.2f} dB of contrast"
    )
    knots_s = np.unique(np.concatenate([fit.time_s for fit in fits]))  # each pair's own: nothing is smoothed
    correction = TrackCorrection(
        knots_s,
        {node: np.zeros((len(knots_s), 3)) for node in errors},
        {fit.pair: np.interp(knots_s, fit.time_s, fit.extra_path_m) for fit in fits},
    )
    std_m = {node: np.tile(one.along(found.axes), (len(knots_s), 1)) for node, one in errors.items()}
    report = {
        "method": method,
        "patches": len(found.patches),
        "gain_held_out_db": round(gain.mean_db, 3),
        "gain_std_db": round(gain.std_db, 3),
        **_left(fits, [_of_logs(record, found, errors) for record in records]),
    }
    promising = not gain.certain and abs(gain.mean_db) > LEAST_GAIN_DB  # else the logs are as good
    return Refinement(correction, std_m, gain.certain, why, report, {"refinement_rejected": why} if promising else {})


@dataclass(frozen=True, eq=False)
class _Fit:
    """Path offsets of a pair's echoes against its logs, in total path.

    Attributes
    ----------
    pair
        Its name.
    time_s, extra_path_m
        (block,) float64, seconds of the flight's clock and metres; between blocks offsets are linear.
    gain_db
        (patch,) float64, of contrast, while the patch was not fitted.
    left_rad2
        Variance of the phase that is expected to be left.
    """

    pair: str
    time_s: Floats
    extra_path_m: Floats
    gain_db: Floats
    left_rad2: float


@dataclass(frozen=True, eq=False)
class _Pair:
    """Contributions of a pair's blocks to the patches."""

    name: str
    time_s: Floats
    grows_rad2: float
    cached: Patches
    path_m: Floats
    cell_m: float
    slope: Floats
    wavenumber: float

    @classmethod
    def of(cls, record: PairRecord, patches: Sequence[Patch], errors: Mapping[str, TrackErrors]) -> "_Pair":
        profiles = record.profiles
        correlation_s, turned = record.turned(errors)
        lasts = min(1 / _BLOCKS_PER_CORRELATION_TIME, _BETWEEN_BLOCKS_RAD2 / max(2 * turned**2, 1e-12))
        edges = _edges(record.time_s, correlation_s * lasts)
        middle = (edges[:-1] + edges[1:] - 1) // 2
        time_s = np.add.reduceat(record.time_s, edges[:-1]) / np.diff(edges)
        patches = patches[: count_in_memory([len(patch.pixels_m) * len(time_s) for patch in patches])]
        cached = _contributions(record, patches, edges)
        places = np.array([patch.place_m for patch in patches])
        path_m = profiles.aperture[middle].path(places).mean(axis=0)
        slope = profiles.aperture[middle].path_gradient(places.mean(axis=0))
        cell_m = SPEED_OF_LIGHT_M_S / profiles.bandwidth_hz
        return cls(record.pair, time_s, 2 * turned**2 * lasts, cached, path_m, cell_m, slope, profiles.wavenumber_rad_m)

    def fitted(self, method: str) -> _Fit:
        """Return the offsets, and what each patch gains by offsets that were not fitted to it.

        Of offsets fitted to all patches and to parts of them those are taken that all patches gain most by.
        """
        folds, before = np.arange(len(self.cached)) % FOLDS, self.statistics()
        parts = [self.apart(folds == fold) for fold in range(FOLDS)]
        phases = [self.phases(method, fitted) for fitted in (*parts, np.ones_like(parts[0]))]
        gain_db = np.array([gains_db([before], [self.statistics(phase)])[0] for phase in phases])
        phase = phases[int(gain_db.mean(axis=1).argmax())]
        information = 2 * sum(min(image.ratio, MOST_RATIO) for image in self.statistics(phase)) / len(phase)
        left_rad2 = _LINEAR * self.grows_rad2 + 1 / information
        # An echo over ∆ turns by -k∆.
        return _Fit(self.name, self.time_s, -phase / self.wavenumber, gain_db[folds, np.arange(len(folds))], left_rad2)

    def apart(self, held_out: Bools) -> Bools:
        """Return (patch,) bool, those that share no range with others: echoes of one range share their noise."""
        near = np.abs(self.path_m[:, None] - self.path_m[held_out]) < _APART_CELLS * self.cell_m
        return np.asarray(~near.any(axis=1))

    def phases(self, method: str, used: Bools) -> Floats:
        """Return (block,) float64 radians that make the patches used sharp and move nothing; 0 if none is used."""
        if not used.any():
            return np.zeros(len(self.time_s))
        phase = METHODS[method]([self.cached[int(number)] for number in np.flatnonzero(used)])
        left, size, _ = np.linalg.svd(self.slope - self.slope.mean(axis=0), full_matrices=False)
        # Projected off a constant and off the directions of eq. 34, which move the image.
        shifting = left[:, size >= _SHIFTS * size[0]]
        centred = phase - phase.mean()
        return np.asarray(centred - shifting @ (shifting.T @ centred))

    def statistics(self, phase: Floats | None = None) -> list[PatchImage]:
        """Return the statistics of the patches with blocks turned by `phase`; by default along the logs."""
        turn = np.exp(1j * (np.zeros(len(self.time_s)) if phase is None else phase)).astype(np.complex64)
        return [PatchImage.of(patch @ turn) for patch in self.cached]


def _edges(time_s: Floats, block_s: float) -> NDArray[np.int64]:
    """Return (block + 1,) int64, first pulse of each block of equal time; empty blocks are left out."""
    count = max(2, min(len(time_s), int(np.ceil((time_s[-1] - time_s[0]) / block_s))))
    ends = np.linspace(time_s[0], time_s[-1], count + 1)[:-1]
    return np.append(np.unique(np.searchsorted(time_s, ends)), len(time_s))


def _contributions(
    record: PairRecord, patches: Sequence[Patch], edges: NDArray[np.int64]
) -> list[NDArray[np.complex64]]:
    """Return (pixel, block), what blocks add to each patch; every pulse is read once."""
    blocks = len(edges) - 1
    cached = [np.empty((len(patch.pixels_m), blocks), np.complex64) for patch in patches]
    at_once = max(1, _PULSES * blocks // int(edges[-1]))
    for first in range(0, blocks, at_once):
        some = slice(first, min(first + at_once, blocks))
        pulses = slice(int(edges[some.start]), int(edges[some.stop]))
        inside = edges[some.start : some.stop + 1] - pulses.start
        part = record.profiles[pulses]
        part = replace(part, samples=np.asarray(part.samples))
        beams = None if record.beams is None else record.beams[pulses]
        for patch, target in zip(patches, cached, strict=True):
            weights = None if beams is None else beams.weight(part.aperture, patch.place_m[None])[:, 0]
            target[:, some] = block_contributions(part, patch.pixels_m, edges=inside, weights=weights)
    return cached


def _of_logs(record: PairRecord, found: Candidates, errors: Mapping[str, TrackErrors]) -> Effect:
    """Return the effect of the logs' errors on a pair's image."""
    profiles = record.profiles
    paths = PointPaths.of(
        profiles.aperture,
        record.time_s,
        point_m=np.mean([patch.place_m for patch in found.patches], axis=0),
        axes=found.axes,
        wavelength_m=profiles.wavelength_m,
    )
    nodes = [NodePositions(errors[node].std_m, errors[node].correlation_s) for node in dict.fromkeys(record.nodes)]
    (line,) = position_lines(paths, nodes, sidelink=record.sidelink_m is not None)
    return line.effect


def _left(fits: Sequence[_Fit], of_logs: Sequence[Effect]) -> dict[str, float]:
    """Return the errors left at the scene's middle: shifts and mean phases are the logs', as offsets hold neither."""
    left_rad2 = float(np.mean([fit.left_rad2 for fit in fits]))
    mean_rad2 = float(np.mean([effect.phase_rad**2 for effect in of_logs]))
    return {
        "left_rad": round(float(np.sqrt(left_rad2 + mean_rad2)), 4),
        "left_db": round(decibels(np.exp(-left_rad2)), 3),
        "gauge_shift_m": round(max(effect.shift_m for effect in of_logs), 4),
    }
