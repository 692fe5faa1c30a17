"""Tracks of a flight refined by the images of all its pairs together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.geometry.track_correction import TrackCorrection
from apertura.refinement.blocks import Blocks, Contribution
from apertura.refinement.evidence import Evidence, gains_db, range_shifts
from apertura.refinement.gauge import Gauge, find_gauge
from apertura.refinement.inputs import ReferencePoint, Sighting, TrackErrors
from apertura.refinement.objective import Seen
from apertura.refinement.outcome import Refinement
from apertura.refinement.patches import Patch, patch_at, spread_out
from apertura.refinement.prior import NodePrior, Prior
from apertura.refinement.prominent import prominent
from apertura.refinement.solve import Problem
from apertura.refinement.ties import tied
from apertura.refinement.uncertainty import remaining

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEAST_PATCHES = 4
LEAST_RATIO = 12.0
"""Peak power of a patch against its speckle: less is no point."""

_KNOTS_A_LASTING = 10  # to an error's correlation time
_LEAST_KNOTS = 64
_HELD_OUT = 4  # every so many-th patch is not fitted
_STARTS = ("log", "prominent points")


def refine(
    sightings: Sequence[Sighting],
    places_m: Floats,
    errors: Mapping[str, TrackErrors],
    *,
    axes: Floats,
    reference_points: Sequence[ReferencePoint] = (),
) -> Refinement:
    """Return the corrections of a flight's tracks that make its images sharpest, and whether they are to be believed.

    Parameters
    ----------
    sightings
        What every pair saw.
    places_m
        (place, 3) float64, metres in the frame of the phase centres: bright places of the images, brightest first.
    errors
        Node → what is known of its log's errors.
    axes
        (3, 3) float64, rows are the unit vectors east, north, up at the scene, in the frame.
    reference_points
        Points whose places are known, to which the image is tied.

    Notes
    -----
    Source: docs/theory/autofocus.md. A rejected refinement keeps what it found; images are formed without it.
    """
    search = _Search.begin(sightings, places_m, errors, axes)
    if len(search.problem.patches) < LEAST_PATCHES:
        return search.refused(errors, found=len(search.problem.patches))
    held_out = np.arange(len(search.problem.patches)) % _HELD_OUT == 2
    fitted, evidence = search.judged(held_out)
    if evidence.accepted:
        fitted = search.problem.solved(fitted, np.ones_like(held_out), stages=1)
    left = remaining(search.problem, fitted)
    fitted, ties = tied(search.problem, fitted, reference_points, axes)
    report = {**evidence.report, **left.report, **ties, "patches": len(search.problem.patches)}
    correction = search.problem.correction(fitted)
    return Refinement(correction, left.std_m, evidence.accepted, evidence.why, report, evidence.flags)


@dataclass(frozen=True, eq=False)
class _Search:
    """The problem, and what its patches show from the logs."""

    problem: Problem
    axes: Floats
    before: list[list[Seen]]
    wavelength_m: float

    @classmethod
    def begin(
        cls, sightings: Sequence[Sighting], places_m: Floats, errors: Mapping[str, TrackErrors], axes: Floats
    ) -> "_Search":
        knots_s = _knots(sightings, errors)
        prior = Prior({node: NodePrior.of(one, knots_s, axes) for node, one in sorted(errors.items())})
        pairs = [Blocks.of(sighting, knots_s) for sighting in sightings]
        problem = Problem(pairs, _patches(sightings, places_m, errors, axes), knots_s, prior, Gauge.none(prior.size))
        cached = problem.cached(np.zeros(prior.size))
        seen = _seen(cached)
        points = [number for number in range(len(problem.patches)) if max(p[number].ratio for p in seen) > LEAST_RATIO]
        cached, seen = ([[one[number] for number in points] for one in many] for many in (cached, seen))
        problem = replace(problem, patches=[problem.patches[number] for number in points])
        if len(points) >= LEAST_PATCHES:
            problem = replace(problem, gauge=find_gauge(pairs, cached, prior, knots_s, axes))
        wavelength_m = SPEED_OF_LIGHT_M_S / sightings[0].profiles.centre_frequency_hz
        return cls(problem, axes, seen, wavelength_m)

    def judged(self, held_out: Bools) -> tuple[Floats, Evidence]:
        """Return what the patches that are not held out ask for, and what the others say of it."""
        problem, nothing = self.problem, np.zeros(self.problem.prior.size)
        starts = [nothing, prominent(problem, nothing, ~held_out, self.axes)]
        best, found, values = problem.lowest(starts, ~held_out)
        cached = problem.cached(found)
        gains = gains_db(self.before, _seen(cached))
        sightings = [blocks.sighting for blocks in problem.pairs]
        shifts = [
            range_shifts(sightings, _brightest(problem.patches, one), self.problem.correction(tracks), self.axes)
            for one, tracks in ((problem.cached(nothing), nothing), (cached, found))
        ]
        sure = problem.gauge.sure @ found
        return found, Evidence(
            fitted_db=gains[:, ~held_out],
            held_out_db=gains[:, held_out],
            settled=sure,
            before=shifts[0],
            after=shifts[1],
            wavelength_m=self.wavelength_m,
            start=_STARTS[best],
            values=tuple(values),
        )

    def refused(self, errors: Mapping[str, TrackErrors], *, found: int) -> Refinement:
        """Return that too few points stand out."""
        line = (
            f"{found} places of the scene stand {10 * np.log10(LEAST_RATIO):.0f} dB out of what lies about them, "
            f"{LEAST_PATCHES} are needed"
        )
        knots_s = self.problem.knots_s
        nothing = {node: np.zeros((len(knots_s), 3)) for node in errors}
        std_m = {node: np.tile(np.abs(np.array(one.std_m) @ self.axes), (len(knots_s), 1)) for node, one in errors.items()}
        report: dict[str, Any] = {"patches": found}
        flags = {"refinement_too_few_patches": line}
        return Refinement(TrackCorrection(knots_s, nothing), std_m, False, line, report, flags)


def _seen(cached: Sequence[Sequence[Contribution]]) -> list[list[Seen]]:
    return [[Seen.of(patch.values.sum(axis=1)) for patch in patches] for patches in cached]


def _brightest(patches: Sequence[Patch], cached: Sequence[Sequence[Contribution]]) -> Floats:
    """Return (patch, 3) float64, the brightest pixel of each patch over all pairs."""
    power = [
        sum(np.abs(one[number].values.sum(axis=1)) ** 2 for one in cached) for number in range(len(patches))
    ]
    return np.stack([patch.pixels_m[int(np.argmax(one))] for patch, one in zip(patches, power, strict=True)])


def _knots(sightings: Sequence[Sighting], errors: Mapping[str, TrackErrors]) -> Floats:
    """Return equally spaced times: several to an error's correlation time, none closer than pulses."""
    first = min(float(one.time_s[0]) for one in sightings)
    last = max(float(one.time_s[-1]) for one in sightings)
    pulse_s = max(float(np.median(np.diff(one.time_s))) for one in sightings)
    lasting_s = min(one.correlation_s for one in errors.values())
    step_s = max(min(lasting_s / _KNOTS_A_LASTING, (last - first) / _LEAST_KNOTS), pulse_s)
    count = max(2, int(np.ceil((last - first) / step_s)))
    return first + (np.arange(count) + 0.5) * (last - first) / count


def _patches(
    sightings: Sequence[Sighting], places_m: Floats, errors: Mapping[str, TrackErrors], axes: Floats
) -> list[Patch]:
    lasting_s = min(one.correlation_s for one in errors.values())
    if not len(places_m):
        return []
    typical = patch_at(places_m[0], sightings, axes, correlation_s=lasting_s)
    apart_m = float(np.ptp((typical.pixels_m - typical.place_m) @ axes[:2].T, axis=0).max()) / 2
    chosen = spread_out(places_m, axes, apart_m=apart_m)
    return [patch_at(place, sightings, axes, correlation_s=lasting_s) for place in chosen]
