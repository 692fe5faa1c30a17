"""Cost of track errors with and without autofocus: loss and displacement of peaks relative to the true tracks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from time import process_time

import numpy as np

from apertura.common.arrays import Floats
from apertura.core.backprojection.engines import native
from apertura.core.backprojection.engines.range_interpolation import Tables
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.inputs import PairRecord, Refinement, TrackErrors
from apertura.methods.autofocus.refine import refine
from apertura_research.autofocus.cases import GRID, PROBES_M, AutofocusCase, case

UNCORRECTED = TrackCorrection(np.zeros(1), {})
_SEARCHES = ((33, 25), (9, 9), (9, 9))
"""Points east and north of successively finer searches for a peak."""


@dataclass(frozen=True, eq=False)
class PointPeaks:
    """Peaks of points in the images of all pairs.

    Attributes
    ----------
    height
        (pair, point) float64, magnitude.
    place_m
        (pair, point, 3) float64, position of the peak.
    """

    height: Floats
    place_m: Floats


def peaks(
    records: Sequence[PairRecord], correction: TrackCorrection, points_m: Floats, reach_m: tuple[float, float]
) -> PointPeaks:
    """Return the highest peaks within reach of points (point, 3), imaged from corrected tracks."""
    by_pair = []
    for one in records:
        tables = native.prepare(one.moved(correction))
        by_pair.append([_peak(tables, point, reach_m) for point in points_m])
    height = np.array([[peak for peak, _ in row] for row in by_pair]).reshape(len(records), len(points_m))
    place = np.array([[place for _, place in row] for row in by_pair]).reshape(*height.shape, 3)
    return PointPeaks(height, place)


def _peak(tables: Tables, middle_m: Floats, reach_m: tuple[float, float]) -> tuple[float, Floats]:
    east, north = reach_m
    for columns, rows in _SEARCHES:
        places = np.stack(np.meshgrid(np.linspace(-east, east, columns), np.linspace(-north, north, rows)), -1)
        places = middle_m + np.concatenate([places, np.zeros((rows, columns, 1))], axis=-1)
        image = np.abs(native.form(tables, places))
        best = np.unravel_index(image.argmax(), image.shape)
        middle_m, east, north = places[best], 2 * east / (columns - 1), 2 * north / (rows - 1)
    return float(image[best]), middle_m


@dataclass(frozen=True)
class CorrectionEffect:
    """Effect of a correction on a case; target values are NaN if the scene has no targets.

    Attributes
    ----------
    probe_loss_db, probe_worst_db, target_loss_db
        Mean and lowest peak of probes, mean of targets, over points and pairs, relative to the true tracks.
    probe_shift_cm, target_shift_cm
        Median distance of peaks from their positions with the true tracks.
    """

    probe_loss_db: float
    probe_worst_db: float
    probe_shift_cm: float
    target_loss_db: float
    target_shift_cm: float


def judge(one: AutofocusCase, correction: TrackCorrection = UNCORRECTED) -> CorrectionEffect:
    """Measure the effect of a correction on a case; by default, of the uncorrected logs.

    The probes are independent of the estimate: a fit to noise can raise the peak of a target, but not of a probe.
    """
    probe_loss, probe_shift = _against_truth(one, one.probes, PROBES_M, correction)
    target_loss, target_shift = _against_truth(one, one.records, one.targets_m, correction)
    return CorrectionEffect(
        _mean(probe_loss), float(probe_loss.min()), _median(probe_shift), _mean(target_loss), _median(target_shift)
    )


def _against_truth(
    one: AutofocusCase, records: Sequence[PairRecord], points_m: Floats, correction: TrackCorrection
) -> tuple[Floats, Floats]:
    """Return peak levels relative to the true tracks (dB) and displacements (cm), (pair, point) float64 each."""
    true, now = (peaks(records, tracks, points_m, one.reach_m) for tracks in (one.truth, correction))
    loss = 20 * np.log10(now.height / true.height)
    return loss, 100 * np.linalg.norm(now.place_m - true.place_m, axis=-1)


def _mean(values: Floats) -> float:
    return float(values.mean()) if values.size else np.nan


def _median(values: Floats) -> float:
    return float(np.median(values)) if values.size else np.nan


def image_seconds(one: PairRecord, *, thinning: int = 5) -> float:
    """Measure the processor time of an image of the whole scene from every fifth pulse, by the native engine."""
    start_s = process_time()
    native.form(native.prepare(one.profiles[::thinning]), GRID.positions(0.0))
    return process_time() - start_s


KINDS: Mapping[str, str] = {
    "five": "the paper's five points",
    "forty": "forty points",
    "texture": "texture",
    "dense": "fully developed speckle",
}
"""Scenes of the study, names in `SCENES` → labels in charts."""

SIGMAS_CM = (0.0, 0.5, 1.0, 2.0, 3.0, 5.0)
SEEDS = (1, 2, 3)
SNR_DB = 10.0

LEAST_STATED_M = 0.005
"""Smallest stated standard deviation: for smaller values, no refinement is requested."""

ACCEPTED, FLAGGED, REFUSED, TOO_FEW = "accepted", "accepted with a flag", "refused", "refused: no bright point"
VERDICTS = (ACCEPTED, FLAGGED, REFUSED, TOO_FEW)


@dataclass(frozen=True)
class AutofocusRow:
    """Effect of errors of one standard deviation on one case, both pairs together: a row of the CSV.

    Attributes
    ----------
    loss_db, product_loss_db, estimate_loss_db
        Mean peak loss of the probes, which no refinement uses, relative to the true tracks; positive if peaks are too
        low. The losses are those with the logged tracks, with the tracks used by the product, and with the estimated
        tracks, accepted or not.
    verdict
        One of `VERDICTS`.
    flags, why
        Flags and reason reported by the product.
    """

    scene: str
    sigma_cm: float
    seed: int
    loss_db: float
    product_loss_db: float
    estimate_loss_db: float
    verdict: str
    flags: str
    reason: str


def cases_of(scene: str) -> list[tuple[float, int]]:  # noqa: ARG001
    """Return sigma (cm) and seed of every case of a scene of `KINDS`."""
    return [(sigma_cm, seed) for sigma_cm in SIGMAS_CM for seed in SEEDS]


def run_case(scene: str, size_and_seed: tuple[float, int]) -> list[AutofocusRow]:
    """Run one sigma and seed on one scene of `KINDS` with both pairs together.

    A seed gives the same track errors in every scene; only their scale depends on sigma.
    """
    one = case_of(scene, *size_and_seed)
    return [outcome_of(one, refine_case(one))]


def case_of(scene: str, sigma_cm: float, seed: int) -> AutofocusCase:
    """Return one case of the sweep."""
    return case(scene, "straight", "joint", sigma_cm / 100, SNR_DB, seed)


def refine_case(one: AutofocusCase) -> Refinement:
    """Refine a case with the true standard deviations stated."""
    return refine(one.records, GRID, FlatGround(0.0), {node: _stated(known) for node, known in one.errors.items()})


def _stated(known: TrackErrors) -> TrackErrors:
    east, north, up = (max(std_m, LEAST_STATED_M) for std_m in known.std_m)
    return replace(known, std_m=(east, north, up))


def outcome_of(one: AutofocusCase, result: Refinement) -> AutofocusRow:
    """Measure the residual loss of a case after a refinement, and its verdict."""
    before, after = (0.0 - judge(one, tracks).probe_loss_db for tracks in (UNCORRECTED, result.correction))
    return AutofocusRow(
        scene=one.name[0],
        sigma_cm=round(100 * one.name[3], 6),
        seed=one.name[5],
        loss_db=round(before, 4),
        product_loss_db=round(after if result.accepted else before, 4),
        estimate_loss_db=round(after, 4),
        verdict=verdict_of(result),
        flags=" ".join(result.flags),
        reason=result.reason,
    )


def verdict_of(result: Refinement) -> str:
    """Return the product's verdict on a refinement, one of `VERDICTS`.

    Examples
    --------
    >>> import numpy as np
    >>> from apertura.core.geometry.lever_arms import TrackCorrection
    >>> nothing = TrackCorrection(np.zeros(1), {})
    >>> verdict_of(Refinement(nothing, {}, True, "", flags={"position_error_understated": "twice as large"}))
    'accepted with a flag'
    """
    if result.accepted:
        return FLAGGED if result.flags else ACCEPTED
    return TOO_FEW if "refinement_no_bright_point" in result.flags else REFUSED
