"""Cases run one after another into a table that is taken up where it ended.

`python -m benchmarks.refinement --cases five,forty/straight/joint/1,2,3/10/0-9 --out table.csv`: scenes, geometries,
pairs, sigma in cm, SNR in dB and seeds; every combination is a row. Run with OPENBLAS_NUM_THREADS=1: seconds are then
those of one core.
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
    """Return what the product makes of a case."""
    return refine(one.records, GRID, FlatGround(0.0), one.errors)


def by_speckle(one: AutofocusCase) -> Refinement:
    """Return what ground without points tells."""
    correlation_s = min(errors.correlation_s for errors in one.errors.values())
    time_s = one.records[0].time_s
    knots_s = np.arange(time_s[0] + correlation_s / 20, time_s[-1], correlation_s / 10)
    prior = Prior({node: NodePrior.of(errors, knots_s, np.eye(3)) for node, errors in one.errors.items()})
    pairs = [Blocks.of(record, knots_s) for record in one.records]
    found = tiles(one.records, GRID, FlatGround(0.0), correlation_s=correlation_s)
    return refined_by_speckle(SpeckleTiles.of(pairs, found), prior, knots_s)


def left(_: AutofocusCase) -> Refinement:
    """Return the logs as they are."""
    return Refinement(UNCORRECTED, {}, accepted=False, reason="left as it is")


def told(one: AutofocusCase) -> Refinement:
    """Return the true tracks."""
    return Refinement(one.truth, {}, accepted=True, reason="the truth")


ATTEMPTS: Mapping[str, Callable[[AutofocusCase], Refinement]] = {
    "refine": refined,
    "speckle": by_speckle,
    "none": left,
    "truth": told,
}


def keys(asked: str) -> Iterator[Key]:
    """Yield every combination of a request such as five,forty/straight/joint/1,2/10/0-9."""
    *parts, seeds = asked.split("/")
    if len(parts) != len(NAMED) - 1:
        raise ValueError(f"{asked!r}: must be {'/'.join(NAMED)}")
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
    """Return one row of the table: loss and shift before and after, accepted or not, and what it cost."""
    scene, geometry, pairs, sigma_cm, snr_db, seed = key
    sigma_m = float(sigma_cm) / 100
    how = {"drift_m": drift_m, "kind": kind, "stated_m": stated_m, "correlation_s": correlation_s}
    one = case(scene, geometry, pairs, sigma_m, float(snr_db), int(seed), **how)
    begun = process_time()
    found = attempt(one)
    seconds = process_time() - begun
    before, after = judge(one), judge(one, found.correction)
    measures = {
        f"{name}_{when}": round(value, 3)
        for when, judged in (("before", before), ("after", after))
        for name, value in asdict(judged).items()
    }
    image_s = image_seconds(one.records[0])
    cost = {"cpu_s": round(seconds, 2), "image_s": round(image_s, 4), "images": round(seconds / image_s, 1)}
    told = {"flags": " ".join(found.flags), "reason": found.reason, "report": json.dumps(dict(found.report))}
    return {**dict(zip(NAMED, key, strict=True)), **measures, "accepted": found.accepted, **cost, **told}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="+", required=True, help="/".join(NAMED) + ", with commas; seeds as 0-9")
    parser.add_argument(
        "--out", type=Path, required=True, help="table, one row per case; rows it has are not run again"
    )
    parser.add_argument("--attempt", choices=ATTEMPTS, default="refine")
    parser.add_argument("--drift-cm", type=float, default=0.0, help="of the logs, over the whole flight")
    parser.add_argument("--errors", choices=ERRORS, default="smooth", help="what the errors of the logs are like")
    parser.add_argument("--stated-cm", type=float, help="what the logs state, where it is not what they err by")
    parser.add_argument("--correlation-s", type=float, default=1.0, help="how long an error lasts")
    asked = parser.parse_args()
    done = set()
    if asked.out.exists():
        with asked.out.open(newline="", encoding="utf-8") as table:
            done = {tuple(one[name] for name in NAMED) for one in csv.DictReader(table)}
    for key in (key for request in asked.cases for key in keys(request) if key not in done):
        stated_m = None if asked.stated_cm is None else asked.stated_cm / 100
        drift_m = asked.drift_cm / 100
        values = row(
            key,
            ATTEMPTS[asked.attempt],
            drift_m=drift_m,
            kind=asked.errors,
            stated_m=stated_m,
            correlation_s=asked.correlation_s,
        )
        with asked.out.open("a", newline="", encoding="utf-8") as table:
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
