"""Comparison of autofocus with one phase per pulse and track refinement on near and far scenes: loss and cost.

`python -m benchmarks.one_phase [--cases forty/straight,far/mono,bi/2/10/0-2]`: cases as in `benchmarks.refinement`. The
planner's choice of the method is listed with the results. Run with OPENBLAS_NUM_THREADS=1 to measure times of one core.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from time import process_time

import numpy as np
from apertura_research.autofocus.cases import AREA_M, GRID, PROBES_M, AutofocusCase, case
from apertura_research.autofocus.outcomes import UNCORRECTED, PointPeaks, image_seconds, peaks
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.quality.path_errors import PointPaths
from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.inputs import Refinement
from apertura.methods.autofocus.one_phase import METHODS, SpaceVariance, space_variance
from apertura.methods.autofocus.patches import Candidates
from apertura.methods.autofocus.path_offsets import refine_one_phase
from apertura.methods.autofocus.refine import refine
from benchmarks.refinement.__main__ import Key, keys

MIDDLE_M = np.array([0.0, 15.0, 0.0])
CORNERS_M = np.array([(east, north, 0.0) for east in AREA_M[::2] for north in AREA_M[1::2]])
HEADINGS = (
    *("scene", "flight", "pair", "σ, cm", "SNR, dB", "rule", "method"),
    *("before", "after", "worst", "displacement", "held-out gain", "accepted", "cost, images"),
)
CASES = ("forty/straight,far/mono,bi/2/10/0-4",)


@dataclass(frozen=True)
class Outcome:
    """Peak levels of the probes, (pair, probe) dB, and median displacement of their peaks, relative to true tracks."""

    before_db: NDArray[np.float64]
    after_db: NDArray[np.float64]
    off_before_cm: float
    off_after_cm: float
    gain_db: float
    accepted: bool
    images: float


def main() -> None:
    """Run the cases and print a row for each scene, flight, pair, σ, SNR and method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=CASES)
    requested = [key for cases in parser.parse_args().cases for key in keys(cases)]
    table = Table()
    for heading in HEADINGS:
        table.add_column(heading, justify="right")
    rows: dict[tuple[str, ...], list[Outcome]] = {}
    for key in requested:
        one, rule = _case(key)
        for method, outcome in _outcomes(one):
            rows.setdefault((*key[:5], f"{rule.method} {rule.loss_db:.2f}", method), []).append(outcome)
    for labels, drawn in rows.items():
        table.add_row(*labels, *_cells(drawn))
    Console(width=170).print(table)


def _case(key: Key) -> tuple[AutofocusCase, SpaceVariance]:
    scene, flight, pair, size_cm, snr_db, seed = key
    one = case(scene, flight, pair, float(size_cm) / 100, float(snr_db), int(seed))
    record = one.records[0]
    wavelength_m = SPEED_OF_LIGHT_M_S / record.profiles.centre_frequency_hz
    paths = PointPaths.of(
        record.profiles.aperture, record.time_s, point_m=MIDDLE_M, axes=np.eye(3), wavelength_m=wavelength_m
    )
    return one, space_variance(paths, CORNERS_M, [one.errors[node] for node in dict.fromkeys(record.nodes)])


def _outcomes(one: AutofocusCase) -> Iterator[tuple[str, Outcome]]:
    image_s = image_seconds(one.records[0])
    true, before = (peaks(one.probes, tracks, PROBES_M, one.reach_m) for tracks in (one.truth, UNCORRECTED))
    for method in (*METHODS, "tracks"):
        start_s = process_time()
        result = _refined(one, method)
        seconds = process_time() - start_s
        after = peaks(one.probes, result.correction, PROBES_M, one.reach_m)
        yield method, _outcome(result, true, before, after, seconds / image_s)


def _refined(one: AutofocusCase, method: str) -> Refinement:
    """Refine a case by one method, including its search for bright points."""
    if method == "tracks":
        return refine(one.records, GRID, FlatGround(0.0), one.errors)
    candidates = Candidates.of(one.records, GRID, FlatGround(0.0), one.errors)
    return refine_one_phase(one.records, candidates, one.errors, method=method)


def _outcome(result: Refinement, true: PointPeaks, before: PointPeaks, after: PointPeaks, images: float) -> Outcome:
    before_db, after_db = (20 * np.log10(each.height / true.height) for each in (before, after))
    gain_db = float(result.report.get("gain_held_out_db", np.nan))
    return Outcome(before_db, after_db, _off_cm(true, before), _off_cm(true, after), gain_db, result.accepted, images)


def _off_cm(true: PointPeaks, now: PointPeaks) -> float:
    return 100 * float(np.median(np.linalg.norm(now.place_m - true.place_m, axis=-1)))


def _cells(drawn: Sequence[Outcome]) -> list[str]:
    accepted = [one for one in drawn if one.accepted]
    harmful = sum(one.after_db.mean() < one.before_db.mean() for one in accepted)
    return [
        f"{np.mean([one.before_db for one in drawn]):.2f}",
        f"{np.mean([one.after_db for one in drawn]):.2f}",
        f"{np.min([one.after_db for one in drawn]):.2f}",
        f"{median(one.off_before_cm for one in drawn):.1f} → {median(one.off_after_cm for one in drawn):.1f} cm",
        f"{np.mean([one.gain_db for one in drawn]):.2f}",
        f"{len(accepted)} of {len(drawn)}, {harmful} harmful",
        f"{median(one.images for one in drawn):.1f}",
    ]


if __name__ == "__main__":
    main()
