"""What a correction of the tracks does to points: loss of their peaks against the true tracks, and shift."""

from collections.abc import Sequence
from dataclasses import dataclass
from time import process_time

import numpy as np

from apertura.common.arrays import Floats
from apertura.core.focus.engines import native
from apertura.core.focus.engines.native_tables import Tables
from apertura.core.geometry.phase_centres import TrackCorrection
from apertura.methods.autofocus.inputs import PairRecord
from apertura_research.study.refinement.cases import PROBES_M, Case
from apertura_research.study.refinement.scenes import GRID

UNCORRECTED = TrackCorrection(np.zeros(1), {})
_LOOKS = ((33, 25), (9, 9), (9, 9))  # places east and north of an ever closer look for a peak


@dataclass(frozen=True, eq=False)
class Peaks:
    """Peaks of points in the images of all pairs.

    Attributes
    ----------
    height
        (pair, point) float64, magnitude.
    place_m
        (pair, point, 3) float64.
    """

    height: Floats
    place_m: Floats


def peaks(
    records: Sequence[PairRecord], correction: TrackCorrection, points_m: Floats, reach_m: tuple[float, float]
) -> Peaks:
    """Return the highest peaks within reach of points (point, 3) as imaged from corrected tracks."""
    found = []
    for one in records:
        tables = native.prepare(one.moved(correction))
        found.append([_peak(tables, point, reach_m) for point in points_m])
    height = np.array([[peak for peak, _ in row] for row in found]).reshape(len(records), len(points_m))
    place = np.array([[place for _, place in row] for row in found]).reshape(*height.shape, 3)
    return Peaks(height, place)


def _peak(tables: Tables, middle_m: Floats, reach_m: tuple[float, float]) -> tuple[float, Floats]:
    east, north = reach_m
    for columns, rows in _LOOKS:
        places = np.stack(np.meshgrid(np.linspace(-east, east, columns), np.linspace(-north, north, rows)), -1)
        places = middle_m + np.concatenate([places, np.zeros((rows, columns, 1))], axis=-1)
        image = np.abs(native.form(tables, places))
        best = np.unravel_index(image.argmax(), image.shape)
        middle_m, east, north = places[best], 2 * east / (columns - 1), 2 * north / (rows - 1)
    return float(image[best]), middle_m


@dataclass(frozen=True)
class Judgement:
    """What a correction does to a case; NaN of targets where the scene has none.

    Attributes
    ----------
    probe_loss_db, probe_worst_db, target_loss_db
        Mean and lowest peak of probes, mean of targets, over points and pairs, against the true tracks.
    probe_shift_cm, target_shift_cm
        Median distance of peaks from where the true tracks have them.
    """

    probe_loss_db: float
    probe_worst_db: float
    probe_shift_cm: float
    target_loss_db: float
    target_shift_cm: float


def judge(one: Case, correction: TrackCorrection = UNCORRECTED) -> Judgement:
    """Return what a correction does to a case; that of the logs themselves by default.

    The probes are the honest ones: a fit to noise can lift a target's peak, not theirs.
    """
    probe_loss, probe_shift = _against_truth(one, one.probes, PROBES_M, correction)
    target_loss, target_shift = _against_truth(one, one.records, one.targets_m, correction)
    return Judgement(
        _mean(probe_loss), float(probe_loss.min()), _median(probe_shift), _mean(target_loss), _median(target_shift)
    )


def _against_truth(
    one: Case, records: Sequence[PairRecord], points_m: Floats, correction: TrackCorrection
) -> tuple[Floats, Floats]:
    """Return loss (dB) and shift (cm) of points, (pair, point) float64 each."""
    true, now = (peaks(records, tracks, points_m, one.reach_m) for tracks in (one.truth, correction))
    loss = 20 * np.log10(now.height / true.height)
    return loss, 100 * np.linalg.norm(now.place_m - true.place_m, axis=-1)


def _mean(values: Floats) -> float:
    return float(values.mean()) if values.size else np.nan


def _median(values: Floats) -> float:
    return float(np.median(values)) if values.size else np.nan


def image_seconds(one: PairRecord, *, thinning: int = 5) -> float:
    """Return the processor time of an image of the whole scene of every fifth pulse, by the native engine."""
    begun = process_time()
    native.form(native.prepare(one.profiles[::thinning]), GRID.positions(0.0))
    return process_time() - begun
