"""Runs of refinement cases into a table; an interrupted table is continued.

`python -m benchmarks.refinement --cases five,forty/straight/joint/1,2,3/10/0-9 --out table.csv`: scenes, geometries,
pairs, sigma in cm, SNR in dB and seeds; every combination is a row. Run with OPENBLAS_NUM_THREADS=1 to measure times of
one core.
"""

import argparse
import csv
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from apertura_research.autofocus.cases import ERRORS, GRID, AutofocusCase, case
from apertura_research.autofocus.outcomes import UNCORRECTED, image_seconds, judge

from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.ground_coherence import SpeckleTiles, refined_by_speckle, tiles
from apertura.methods.autofocus.inputs import NodePrior, Prior, Refinement
from apertura.methods.autofocus.objective import Blocks
from apertura.methods.autofocus.refine import refine

Key = tuple[str, str, str, str, str, str]
NAMED = ("scene", "geometry", "pairs", "sigma_cm", "snr_db", "seed")


def refined(one: AutofocusCase) -> Refinement:
    """Refine a case in the same way as the product."""
    return refine(one.records, GRID, FlatGround(0.0), one.errors)


def by_speckle(one: AutofocusCase) -> Refinement:
    """Refine a case by speckle only, without bright points."""
    correlation_s = min(errors.correlation_s for errors in one.errors.values())
    time_s = one.records[0].time_s
    knots_s = np.arange(time_s[0] + correlation_s / 20, time_s[-1], correlation_s / 10)
    prior = Prior({node: NodePrior.of(errors, knots_s, np.eye(3)) for node, errors in one.errors.items()})
    pairs = [Blocks.of(record, knots_s) for record in one.records]
    speckle_tiles = tiles(one.records, GRID, FlatGround(0.0), correlation_s=correlation_s)
    return refined_by_speckle(SpeckleTiles.of(pairs, speckle_tiles), prior, knots_s)


def uncorrected(_: AutofocusCase) -> Refinement:
    """Return no correction: the logged tracks."""
    return Refinement(UNCORRECTED, {}, accepted=False, reason="uncorrected")


def true_tracks(one: AutofocusCase) -> Refinement:
    """Return the correction to the true tracks."""
    return Refinement(one.truth, {}, accepted=True, reason="true tracks")


ATTEMPTS: Mapping[str, Callable[[AutofocusCase], Refinement]] = {
    "refine": refined,
    "speckle": by_speckle,
    "none": uncorrected,
    "truth": true_tracks,
}


def keys(request: str) -> Iterator[Key]:
    """Yield every combination of a request such as five,forty/straight/joint/1,2/10/0-9."""
    *parts, seeds = request.split("/")
    if len(parts) != len(NAMED) - 1:
        raise ValueError(f"{request!r}: expected {'/'.join(NAMED)}")
    first, _, last = seeds.partition("-")
    drawn = [str(seed) for seed in range(int(first), int(last or first) + 1)]
    yield from product(*(part.split(",") for part in parts), drawn)


def row(
    key: Key,
    attempt: Callable[[AutofocusCase], Refinement],
    *,
    drift_m: float,
    kind: str,
    stated_m: float | None,
    correlation_s: float,
) -> dict[str, Any]:
    """Run one case; return its table row: loss and displacement before and after, acceptance and cost."""
    scene, geometry, pairs, sigma_cm, snr_db, seed = key
    sigma_m = float(sigma_cm) / 100
    options = {"drift_m": drift_m, "kind": kind, "stated_m": stated_m, "correlation_s": correlation_s}
    one = case(scene, geometry, pairs, sigma_m, float(snr_db), int(seed), **options)
    start_s = process_time()
    result = attempt(one)
    seconds = process_time() - start_s
    before, after = judge(one), judge(one, result.correction)
    measures = {
        f"{name}_{when}": round(value, 3)
        for when, judged in (("before", before), ("after", after))
        for name, value in asdict(judged).items()
    }
    image_s = image_seconds(one.records[0])
    cost = {"cpu_s": round(seconds, 2), "image_s": round(image_s, 4), "images": round(seconds / image_s, 1)}
    texts = {"flags": " ".join(result.flags), "reason": result.reason, "report": json.dumps(dict(result.report))}
    return {**dict(zip(NAMED, key, strict=True)), **measures, "accepted": result.accepted, **cost, **texts}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="+", required=True, help="/".join(NAMED) + ", lists with commas, seeds as 0-9")
    parser.add_argument(
        "--out", type=Path, required=True, help="output table, one row per case; existing rows are not recomputed"
    )
    parser.add_argument("--attempt", choices=ATTEMPTS, default="refine", help="method of refinement")
    parser.add_argument("--drift-cm", type=float, default=0.0, help="drift of the logs over the whole flight")
    parser.add_argument("--errors", choices=ERRORS, default="smooth", help="model of the logs' errors")
    parser.add_argument("--stated-cm", type=float, help="stated standard deviation, if it differs from the true one")
    parser.add_argument("--correlation-s", type=float, default=1.0, help="correlation time of the errors")
    options = parser.parse_args()
    done = set()
    if options.out.exists():
        with options.out.open(newline="", encoding="utf-8") as table:
            done = {tuple(one[name] for name in NAMED) for one in csv.DictReader(table)}
    for key in (key for request in options.cases for key in keys(request) if key not in done):
        stated_m = None if options.stated_cm is None else options.stated_cm / 100
        drift_m = options.drift_cm / 100
        values = row(
            key,
            ATTEMPTS[options.attempt],
            drift_m=drift_m,
            kind=options.errors,
            stated_m=stated_m,
            correlation_s=options.correlation_s,
        )
        with options.out.open("a", newline="", encoding="utf-8") as table:
            writer = csv.DictWriter(table, list(values))
            if not table.tell():
                writer.writeheader()
            writer.writerow(values)
        print(_line(values), flush=True)


def _line(row: Mapping[str, Any]) -> str:
    changes = " ".join(
        f"{name[:-7]} {row[name]:.2f} → {row[name[:-7] + '_after']:.2f}" for name in row if name.endswith("_before")
    )
    cost = f"{row['cpu_s']} s, {row['images']} images of {1000 * row['image_s']:.0f} ms"
    return (
        f"{'/'.join(row[name] for name in NAMED)}: {changes}; {'accepted' if row['accepted'] else 'rejected'}; {cost}"
    )


if __name__ == "__main__":
    main()
