"""One path offset per pulse of each pair, as bright patches ask for it, and whether it is to be believed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.focus.contributions import block_contributions
from apertura.refinement.evidence import LEAST_BETTER, LEAST_GAIN_DB, gains_db
from apertura.refinement.inputs import Sighting, TrackErrors
from apertura.refinement.objective import Seen
from apertura.refinement.one_phase import METHODS, Patches
from apertura.refinement.patches import Patch

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEAST_PATCHES = 4
_FOLDS = 4  # each of so many parts of the patches is held out once
_APART_CELLS = 2.0  # of range, c/B of total path
_BLOCKS_A_LASTING = 10  # at least, to an error's correlation time
_BETWEEN_BLOCKS_RAD2 = 0.1  # by which an error grows from block to block: linear between them, an eighth is left
_SHIFTS = 0.5  # of the largest variation of the path's slope: a move in such a direction is a phase alone


@dataclass(frozen=True, eq=False)
class PathOffsets:
    """By how much the echoes of a pair lie further, in total path, than its logs say.

    Attributes
    ----------
    time_s
        (block,) float64, seconds of the flight's clock; between blocks offsets are linear, beyond them constant.
    further_m
        (block,) float64, metres to be added to the measured paths.

    Examples
    --------
    >>> PathOffsets(np.array([0.0, 2.0]), np.array([0.0, 0.1])).at(np.array([1.0, 5.0]))
    array([0.05, 0.1 ])
    """

    time_s: Floats
    further_m: Floats

    def at(self, time_s: Floats) -> Floats:
        """Return the offsets at some times, (pulse,) float64, metres."""
        return np.interp(time_s, self.time_s, self.further_m)

    def moved(self, sighting: Sighting) -> Sighting:
        """Return what the pair saw over paths as corrected, from where its logs have it."""
        profiles = sighting.profiles
        return replace(sighting, profiles=profiles.moved(profiles.aperture, self.at(sighting.time_s)))


@dataclass(frozen=True, eq=False)
class OnePhase:
    """Path offsets of a flight's pairs.

    Attributes
    ----------
    offsets
        Pair → its own, accepted or not; none where nothing was tried.
    accepted
        Whether images are formed with them: all or none.
    why
        One line.
    report
        As JSON values: what was measured.
    flags
        Edge crossed → what was found, in one line.
    """

    offsets: Mapping[str, PathOffsets]
    accepted: bool
    why: str
    report: Mapping[str, Any] = field(default_factory=dict)
    flags: Mapping[str, str] = field(default_factory=dict)


def refine_one_phase(
    sightings: Sequence[Sighting], patches: Sequence[Patch], errors: Mapping[str, TrackErrors], *, method: str
) -> OnePhase:
    """Return path offsets that make the patches sharp, and whether patches that were not fitted believe them.

    Parameters
    ----------
    sightings
        What every pair saw.
    patches
        About places that stand out, brightest first.
    errors
        Node → what is known of its log's errors.
    method
        A row of `METHODS`.

    Notes
    -----
    Source: docs/theory/autofocus.md, "One phase per pulse". Each quarter of the patches is judged by offsets fitted to
    those of the others that share no range with it. Of these offsets and those fitted to all the sharpest are returned.
    """
    if len(patches) < LEAST_PATCHES:
        line = f"{len(patches)} patches, {LEAST_PATCHES} are needed"
        return OnePhase({}, False, line, {"patches": len(patches)}, {"refinement_too_few_patches": line})
    pairs = [_Pair.of(sighting, patches, errors) for sighting in sightings]
    found = [pair.sharpest(method) for pair in pairs]
    gain_db = np.array([gain_db for _, gain_db in found])
    better = float((gain_db > 0).mean())
    accepted = bool(gain_db.mean() >= LEAST_GAIN_DB and better >= LEAST_BETTER)
    why = (
        f"{gain_db.size} images of patches, each while it was not fitted, gained {gain_db.mean():.2f} dB of contrast, "
        f"{better:.0%} of them gained"
    )
    offsets = {pair.name: pair.offsets(phase) for pair, (phase, _) in zip(pairs, found, strict=True)}
    report = {
        "method": method,
        "patches": len(patches),
        "gain_held_out_db": round(float(gain_db.mean()), 3),
        "held_out_better": round(better, 3),
        "offset_rms_m": {name: round(float(one.further_m.std()), 5) for name, one in offsets.items()},
    }
    return OnePhase(offsets, accepted, why, report, {} if accepted else {"refinement_rejected": why})


@dataclass(frozen=True, eq=False)
class _Pair:
    """What blocks of a pair add to the patches."""

    name: str
    time_s: Floats
    cached: Patches
    path_m: Floats
    cell_m: float
    slope: Floats
    wavenumber: float

    @classmethod
    def of(cls, sighting: Sighting, patches: Sequence[Patch], errors: Mapping[str, TrackErrors]) -> "_Pair":
        profiles = sighting.profiles
        wavenumber = 2 * np.pi * profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S
        of_nodes = [errors[node] for node in sighting.nodes]
        lasting_s = min(error.correlation_s for error in of_nodes)
        turned = 2 * wavenumber * max(max(error.std_m) for error in of_nodes)
        block_s = lasting_s * min(1 / _BLOCKS_A_LASTING, _BETWEEN_BLOCKS_RAD2 / max(2 * turned**2, 1e-12))
        edges = _edges(sighting.time_s, block_s)
        middle = (edges[:-1] + edges[1:] - 1) // 2
        time_s = np.add.reduceat(sighting.time_s, edges[:-1]) / np.diff(edges)
        cached = [_contributions(sighting, patch, edges) for patch in patches]
        places = np.array([patch.place_m for patch in patches]).reshape(-1, 3)
        path_m = profiles.aperture[middle].path(places).mean(axis=0)
        slope = profiles.aperture[middle].path_gradient(places.mean(axis=0))
        return cls(sighting.pair, time_s, cached, path_m, profiles.step_m * profiles.oversampling, slope, wavenumber)

    def sharpest(self, method: str) -> tuple[Floats, Floats]:
        """Return phases (block,), rad, and what each patch gains by phases that it has no part in, (patch,) dB.

        Of phases fitted to all patches and to parts of them those are taken that all patches gain most by.
        """
        folds, before = np.arange(len(self.cached)) % _FOLDS, self.seen()
        parts = [self.apart(folds == fold) for fold in range(_FOLDS)]
        phases = [self.phases(method, fitted) for fitted in (*parts, np.ones_like(parts[0]))]
        gain_db = np.array([gains_db([before], [self.seen(phase)])[0] for phase in phases])
        return phases[int(gain_db.mean(axis=1).argmax())], gain_db[folds, np.arange(len(folds))]

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
        moves = left[:, size >= _SHIFTS * size[0]]
        centred = phase - phase.mean()
        return np.asarray(centred - moves @ (moves.T @ centred))

    def seen(self, phase: Floats | None = None) -> list[Seen]:
        """Return what the patches show with blocks turned; as the logs have them by default."""
        turn = np.exp(1j * (np.zeros(len(self.time_s)) if phase is None else phase)).astype(np.complex64)
        return [Seen.of(patch @ turn) for patch in self.cached]

    def offsets(self, phase: Floats) -> PathOffsets:
        """Return the paths by which echoes lie further where blocks are turned: an echo over ∆ turns by -k∆."""
        return PathOffsets(self.time_s, -phase / self.wavenumber)


def _edges(time_s: Floats, block_s: float) -> NDArray[np.int64]:
    """Return (block + 1,) int64 first pulses of blocks of equal time; blocks without pulses are left out."""
    count = max(2, min(len(time_s), int(np.ceil((time_s[-1] - time_s[0]) / block_s))))
    ends = np.linspace(time_s[0], time_s[-1], count + 1)[:-1]
    return np.append(np.unique(np.searchsorted(time_s, ends)), len(time_s))


def _contributions(sighting: Sighting, patch: Patch, edges: NDArray[np.int64]) -> NDArray[np.complex64]:
    """Return (pixel, block), what blocks add to a patch."""
    aperture, weights = sighting.profiles.aperture, None
    if sighting.beams is not None:
        weights = sighting.beams.weight(aperture, patch.place_m[None])[:, 0]
    return block_contributions(sighting.profiles, patch.pixels_m, edges=edges, weights=weights)
