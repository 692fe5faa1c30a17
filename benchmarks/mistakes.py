"""Mistakes made in right campaigns: which images become wrong, and which of those without a word.

`python benchmarks/mistakes.py WORKFOLDER [--base sample|curved|all] [--only name,name] [--out table.csv]`. An image is
wrong when a target is more than 0.15 m from where the right campaign shows it, or more than 1 dB weaker; silent when
it is wrong and neither an error nor a flag says so that the right campaign has not. What only moves points by less than
two deviations of their place, as `expected_shift_m` in image.json has it, is counted apart.
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
"""Cause of a mistake → kind of the hypothesis that names it, where the words differ."""

_OFFSETS = {"offset", "range", "prefix", "arm", "attitude", "time"}
"""Causes that may add a constant to the paths of a pair, so that a hypothesis of kind `offset` names them rightly: a
time does along a straight track, a wrong attitude or arm while the attitude stays."""


@dataclass(frozen=True)
class Row:
    """What a mistake did to one image, and what was said of it; losses in dB, shifts in metres, worst and median."""

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
    """Image of the right campaign → its targets, and its flags."""

    peaks: dict[str, Peaks]
    flags: dict[str, set[str]]


def main() -> None:
    """Make the mistakes asked for, one after the other; print and save what came of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="where campaigns are copied to and spoilt")
    parser.add_argument("--base", choices=(*BASES, "all"), default="all")
    parser.add_argument("--only", help="names of mistakes, comma separated", default="")
    parser.add_argument("--out", type=Path, help="CSV to write")
    asked = parser.parse_args()
    names = [name for name in asked.only.split(",") if name] or list(MISTAKES)
    console = Console(width=200)
    rows: list[Row] = []
    for base in BASES if asked.base == "all" else (asked.base,):
        for row in _rows(asked.folder, base, names):
            rows.append(row)
            if asked.out:
                _save(asked.out, rows)
            console.print(f"{row.base:7}{row.mistake:30}{row.pair:10}{_said(row)}", highlight=False, no_wrap=True)
    console.print(_table(rows))
    print(_totals(rows))


def _rows(folder: Path, base: str, names: list[str]) -> Iterator[Row]:
    right, spoilt = folder / f"{base}-right", folder / f"{base}-spoilt"
    if not right.exists():
        BASES[base](right)
    outcome, places = run_campaign(right), true_places(right)
    if outcome.grid is None:
        raise SystemExit(f"{base} itself fails: {outcome.error}")
    before = Right(
        {pair: find_targets(image, outcome.grid, places) for pair, image in outcome.images.items()},
        {pair: set(report["flags"]) for pair, report in outcome.reports.items()},
    )
    yield from _judged(base, _RIGHT, outcome, before, right)
    for name in names:
        copy_writable(right, spoilt)
        MISTAKES[name].spoil(Folder(spoilt))
        yield from _judged(base, name, run_campaign(spoilt), before, spoilt)


def _judged(base: str, name: str, outcome: Outcome, right: Right, root: Path) -> Iterator[Row]:
    """Yield a row per image, or one for a campaign that ended in an error."""
    known = MISTAKES.get(name)
    kind = (
        {"control": known.control, "alike": base in known.alike, "cause": known.cause} if known else {"control": True}
    )
    place_m = max(
        (report.get("focus", {}).get("expected_shift_m", 0.0) for report in outcome.reports.values()), default=0
    )
    if outcome.error:
        yield Row(base, name, "-", error=outcome.error, seconds=round(outcome.seconds, 2), **kind)
    for pair, report in outcome.reports.items():
        done = harm(find_targets(outcome.images[pair], outcome.grid, true_places(root)), right.peaks[pair])
        yield Row(
            base,
            name,
            pair,
            *(round(value, 3) for value in astuple(done)),
            coherence=round(report["brightest"].get("coherence_factor", math.nan), 4),
            wrong=done.wrong,
            silent=done.wrong and not set(report["flags"]) - right.flags[pair],
            within=done.loss_db <= 1.0 and done.shift_m <= 2 * place_m,
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


def _said(row: Row) -> str:
    if row.error:
        return f"error: {row.error}"
    word = ("within" if row.within else "SILENT") if row.silent else "wrong" if row.wrong else ""
    found = f"{row.loss_db:+7.2f} dB {row.shift_m:6.3f} m  Γ {row.coherence:6.4f}  {word:7}{row.flags or 'no flag'}"
    return "  ".join([found, *filter(None, (row.verdict, row.hypothesis))])


def _table(rows: list[Row]) -> Table:
    """Return the images that are wrong, and the right ones that are flagged."""
    table = Table(title="wrong images, and right ones with a flag", title_justify="left")
    for heading in ("base", "mistake", "image", "loss dB", "shift m", "Γ", "silent", "flags", "verdict", "hypothesis"):
        table.add_column(heading)
    for row in rows:
        if row.wrong or (row.flags and row.control):
            numbers = (f"{row.loss_db:+.1f}", f"{row.shift_m:.2f}", f"{row.coherence:.3f}")
            said = ("silent" if row.silent else "", row.flags, row.verdict, row.hypothesis)
            table.add_row(row.base, row.mistake, row.pair, *numbers, *said)
    return table


def _named_rightly(row: Row) -> bool:
    kind = json.loads(row.hypothesis)["kind"].replace("prefix", "range")
    return bool(row.cause) and (
        kind == _NAMES.get(row.cause, row.cause) or (kind == "offset" and row.cause in _OFFSETS)
    )


def _totals(rows: list[Row]) -> str:
    """Return how many mistakes there are of each kind, and the names of those that matter."""
    kinds = {
        "tried": list(rows),
        "ended in an error": [row for row in rows if row.error],
        "wrong in some image": [row for row in rows if row.wrong],
        "SILENT in some image": [row for row in rows if row.silent and not (row.alike or row.within)],
        "silent, all moved alike": [row for row in rows if row.silent and row.alike and not row.within],
        "silent, within what is said of places": [row for row in rows if row.silent and row.within],
        "controls with a flag or an error": [row for row in rows if row.control and (row.flags or row.error)],
        "controls that are wrong": [row for row in rows if row.control and row.wrong],
    }
    named = {(row.base, row.mistake): row for row in rows if row.hypothesis}
    kinds["hypotheses that name the cause"] = [row for row in named.values() if _named_rightly(row)]
    kinds["hypotheses that do not"] = [row for row in named.values() if not _named_rightly(row)]
    lines = []
    for kind, some in kinds.items():
        names = list(dict.fromkeys(f"{row.base}/{row.mistake}" for row in some))
        lines.append(f"{len(names):4} {kind}" + ("" if kind == "tried" else f": {', '.join(names)}"))
    return "\n".join(lines)


if __name__ == "__main__":
    main()
