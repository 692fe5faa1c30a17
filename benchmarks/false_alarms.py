"""False-alarm rates of flags on random error-free campaigns.

`python benchmarks/false_alarms.py WORKFOLDER [--count 100] [--seed 0] [--only 17,18] [--out table.csv]`. A campaign is
determined by seed and number; its intentional flaws are listed with the campaign, and a flag that reports one of these
flaws is correct.
"""

import argparse
import csv
import json
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from drawing.right import Drawn, draw_right
from judging.peaks import find_targets, true_places
from judging.run import Outcome, run_campaign, verdict_of

import apertura as ap

Row = dict[str, Any]


def main() -> None:
    """Simulate and process the campaigns, print and save their flags."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="work folder for the simulated campaigns")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="numbers of campaigns, comma separated; their folders are kept")
    parser.add_argument("--out", type=Path, help="output CSV")
    options = parser.parse_args()
    chosen = [int(number) for number in options.only.split(",") if number]
    rows: list[Row] = []
    for number in chosen or range(options.count):
        rows += _judged(options.folder, number, options.seed, keep=bool(chosen))
        if options.out:
            _save(options.out, rows)
    print(_rates(rows))


def _judged(folder: Path, number: int, seed: int, *, keep: bool) -> list[Row]:
    drawn, root = draw_right(number, seed=seed), folder / f"right-{seed}-{number}"
    shutil.rmtree(root, ignore_errors=True)
    ap.simulate(root, drawn.specification, seed=np.random.default_rng([seed, number]))
    outcome = run_campaign(root)
    rows = list(_rows(number, drawn, outcome, root))
    print(number, drawn.parameters, f"{outcome.seconds:.1f} s", flush=True)
    for row in rows:
        quality = f"Γ {row['coherence']}  displacement {row['shift_cells']} cells  {row['verdict']}{row['error']}"
        print(f"    {row['image']:10} {quality}")
        for flag, text in json.loads(row["texts"]).items():
            word = f"true: {drawn.true_flags[flag]}" if flag in drawn.true_flags else "FALSE"
            print(f"        {flag} ({word}): {text}", flush=True)
    if not keep:
        shutil.rmtree(root)
    return rows


def _rows(number: int, drawn: Drawn, outcome: Outcome, root: Path) -> Iterator[Row]:
    inputs = {"number": number, **drawn.parameters, "imperfect": json.dumps(drawn.true_flags)}
    results: Row = {"image": "-", "error": outcome.error, "coherence": "", "shift_cells": "", "flags": "", "false": ""}
    results |= {"verdict": "", "texts": "{}", "seconds": round(outcome.seconds, 1)}
    if outcome.error:
        yield inputs | results
    # The flag phase_unobservable is true for an image without a point.
    has_no_points = any(verdict_of(report) == "inconclusive" for report in outcome.reports.values())
    true_flags = {*drawn.true_flags, *(["phase_unobservable"] if has_no_points else [])}
    for image, report in outcome.reports.items():
        flags = report["flags"]
        yield (
            inputs
            | results
            | {
                "image": image,
                "coherence": round(report["brightest"].get("coherence_factor", float("nan")), 4),
                "shift_cells": _shift_cells(outcome, image, root, drawn.parameters["cell_m"]),
                "flags": ",".join(flags),
                "false": ",".join(flag for flag in flags if flag not in true_flags),
                "verdict": verdict_of(report),
                "texts": json.dumps(flags, ensure_ascii=False),
            }
        )


def _shift_cells(outcome: Outcome, image: str, root: Path, cell_m: float) -> float | str:
    """Return the displacement of the brightest target from its true position, in cells; empty without targets."""
    places = true_places(root)
    if not len(places):
        return ""
    found = find_targets(outcome.images[image], outcome.grid, places)
    return round(float(np.linalg.norm(found.place_m - places, axis=1)[np.nanargmax(found.level_db)]) / cell_m, 2)


def _save(path: Path, rows: list[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, rows[0].keys(), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def _rates(rows: list[Row]) -> str:
    """Summarise the number of campaigns that raise each flag, and the false alarms."""
    campaigns = len({row["number"] for row in rows})
    raised, untrue = (
        {(row["number"], flag) for row in rows for flag in row[key].split(",") if flag} for key in ("flags", "false")
    )
    lines = [f"{campaigns} campaigns; {len({number for number, _ in untrue})} with a false alarm"]
    for flag, count in Counter(flag for _, flag in raised).most_common():
        wrong = sorted(number for number, name in untrue if name == flag)
        lines.append(f"{count:4} {flag}, false in {len(wrong)}: {wrong}")
    lines += [f"error in {row['number']}: {row['error']}" for row in rows if row["error"]]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
