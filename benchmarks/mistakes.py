"""Effect of mistakes in error-free campaigns: wrong images, and wrong images without a flag.

`python benchmarks/mistakes.py WORKFOLDER [--base sample|curved|all] [--only name,name] [--out table.csv]`. An image is
wrong if a target is displaced by more than 0.15 m relative to the error-free campaign, or is weaker by more than 1 dB;
it is unflagged if it raises neither an error nor a flag that the error-free campaign does not raise. Displacements of
less than two standard deviations of the geolocation, `expected_shift_m` in image.json, are counted separately.
"""

import argparse
import csv
import json
import math
from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from judging.bases import BASES
from judging.peaks import Peaks, find_targets, harm, true_places
from judging.run import Outcome, copy_writable, hypothesis_of, run_campaign, verdict_of
from rich.console import Console
from rich.table import Table
from spoiling.folder import Folder
from spoiling.table import MISTAKES

_RIGHT = "right"

_NAMES = {"arm": "lever arm", "tracks": "tracks swapped", "prefix": "range", "attitude": "offset"}
"""Cause of a mistake → kind of its hypothesis, if the names differ."""

_OFFSETS = {"offset", "range", "prefix", "arm", "attitude", "time"}
"""Causes that may add a constant to the paths of a pair, so that the hypothesis `offset` is correct: a time error on a
straight track, or an error of attitude or lever arm at constant attitude."""


@dataclass(frozen=True)
class Row:
    """Effect of a mistake on one image, and its report; losses in dB and displacements in metres, worst and median.

    Attributes
    ----------
    wrong, silent
        `wrong`: True if the image is wrong; `silent`: True if, in addition, the image has only flags of the error-free
        campaign.
    control
        True for a change without effect on the image.
    alike
        True if the mistake displaces the whole scene.
    within
        True if the displacement is within the geolocation uncertainty.
    """

    base: str
    mistake: str
    pair: str
    loss_db: float = math.nan
    shift_m: float = math.nan
    median_loss_db: float = math.nan
    median_shift_m: float = math.nan
    coherence: float = math.nan
    wrong: bool = False
    silent: bool = False
    control: bool = False
    alike: bool = False
    within: bool = False
    cause: str = ""
    error: str = ""
    flags: str = ""
    verdict: str = ""
    hypothesis: str = ""
    seconds: float = math.nan


@dataclass(frozen=True)
class Right:
    """Targets and flags by image of the error-free campaign."""

    peaks: dict[str, Peaks]
    flags: dict[str, set[str]]


def main() -> None:
    """Introduce the requested mistakes one by one; print and save their effects."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="work folder for copied and modified campaigns")
    parser.add_argument("--base", choices=(*BASES, "all"), default="all")
    parser.add_argument("--only", help="names of mistakes, comma separated", default="")
    parser.add_argument("--out", type=Path, help="output CSV")
    options = parser.parse_args()
    names = [name for name in options.only.split(",") if name] or list(MISTAKES)
    console = Console(width=200)
    rows: list[Row] = []
    for base in BASES if options.base == "all" else (options.base,):
        for row in _rows(options.folder, base, names):
            rows.append(row)
            if options.out:
                _save(options.out, rows)
            console.print(f"{row.base:7}{row.mistake:30}{row.pair:10}{_line(row)}", highlight=False, no_wrap=True)
    console.print(_table(rows))
    print(_totals(rows))


def _rows(folder: Path, base: str, names: list[str]) -> Iterator[Row]:
    right, modified = folder / f"{base}-right", folder / f"{base}-modified"
    if not right.exists():
        BASES[base](right)
    outcome, places = run_campaign(right), true_places(right)
    if outcome.grid is None:
        raise SystemExit(f"the error-free campaign {base} fails: {outcome.error}")
    before = Right(
        {pair: find_targets(image, outcome.grid, places) for pair, image in outcome.images.items()},
        {pair: set(report["flags"]) for pair, report in outcome.reports.items()},
    )
    yield from _judged(base, _RIGHT, outcome, before, right)
    for name in names:
        copy_writable(right, modified)
        MISTAKES[name].apply(Folder(modified))
        yield from _judged(base, name, run_campaign(modified), before, modified)


def _judged(base: str, name: str, outcome: Outcome, right: Right, root: Path) -> Iterator[Row]:
    """Yield a row per image, or one row for a campaign that stopped with an error."""
    mistake = MISTAKES.get(name)
    kind = {"control": True}
    if mistake:
        kind = {"control": mistake.control, "alike": base in mistake.alike, "cause": mistake.cause}
    expected_shift_m = max(
        (report.get("focus", {}).get("expected_shift_m", 0.0) for report in outcome.reports.values()), default=0
    )
    if outcome.error:
        yield Row(base, name, "-", error=outcome.error, seconds=round(outcome.seconds, 2), **kind)
    for pair, report in outcome.reports.items():
        effect = harm(find_targets(outcome.images[pair], outcome.grid, true_places(root)), right.peaks[pair])
        yield Row(
            base,
            name,
            pair,
            *(round(value, 3) for value in astuple(effect)),
            coherence=round(report["brightest"].get("coherence_factor", math.nan), 4),
            wrong=effect.wrong,
            silent=effect.wrong and not set(report["flags"]) - right.flags[pair],
            within=effect.loss_db <= 1.0 and effect.shift_m <= 2 * expected_shift_m,
            flags=",".join(report["flags"]),
            verdict=verdict_of(report),
            hypothesis=hypothesis_of(report),
            seconds=round(outcome.seconds, 2),
            **kind,
        )


def _save(path: Path, rows: list[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(field.name for field in fields(Row))
        table.writerows(astuple(row) for row in rows)


def _line(row: Row) -> str:
    if row.error:
        return f"error: {row.error}"
    rating = ("within" if row.within else "UNFLAGGED") if row.silent else "wrong" if row.wrong else ""
    line = f"{row.loss_db:+7.2f} dB {row.shift_m:6.3f} m  Γ {row.coherence:6.4f}  {rating:10}{row.flags or 'no flag'}"
    return "  ".join([line, *filter(None, (row.verdict, row.hypothesis))])


def _table(rows: list[Row]) -> Table:
    """Return a table of the wrong images, and of the controls with a flag."""
    table = Table(title="Wrong images, and controls with a flag", title_justify="left")
    numeric = ("loss, dB", "displacement, m", "Γ")
    for heading in ("base", "mistake", "image", *numeric, "unflagged", "flags", "verdict", "hypothesis"):
        table.add_column(heading)
    for row in rows:
        if row.wrong or (row.flags and row.control):
            numbers = (f"{row.loss_db:+.1f}", f"{row.shift_m:.2f}", f"{row.coherence:.3f}")
            texts = ("unflagged" if row.silent else "", row.flags, row.verdict, row.hypothesis)
            table.add_row(row.base, row.mistake, row.pair, *numbers, *texts)
    return table


def _named_rightly(row: Row) -> bool:
    kind = json.loads(row.hypothesis)["kind"].replace("prefix", "range")
    return bool(row.cause) and (
        kind == _NAMES.get(row.cause, row.cause) or (kind == "offset" and row.cause in _OFFSETS)
    )


def _totals(rows: list[Row]) -> str:
    """Return the number of mistakes in each category, with their names."""
    kinds = {
        "mistakes": list(rows),
        "stopped with an error": [row for row in rows if row.error],
        "with a wrong image": [row for row in rows if row.wrong],
        "with an UNFLAGGED wrong image": [row for row in rows if row.silent and not (row.alike or row.within)],
        "unflagged, whole scene displaced": [row for row in rows if row.silent and row.alike and not row.within],
        "unflagged, within the geolocation uncertainty": [row for row in rows if row.silent and row.within],
        "controls with a flag or an error": [row for row in rows if row.control and (row.flags or row.error)],
        "controls with a wrong image": [row for row in rows if row.control and row.wrong],
    }
    named = {(row.base, row.mistake): row for row in rows if row.hypothesis}
    kinds["hypotheses with the correct cause"] = [row for row in named.values() if _named_rightly(row)]
    kinds["hypotheses with a wrong cause"] = [row for row in named.values() if not _named_rightly(row)]
    lines = []
    for kind, members in kinds.items():
        names = list(dict.fromkeys(f"{row.base}/{row.mistake}" for row in members))
        lines.append(f"{len(names):4} {kind}" + ("" if kind == "mistakes" else f": {', '.join(names)}"))
    return "\n".join(lines)


if __name__ == "__main__":
    main()
