"""The files of the stability study: parts, tables per impairment, and where each correction fails."""

import csv
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from apertura.study.paper.claims import write_rows
from apertura.study.stability.outcomes import Outcome, crossing
from apertura.study.stability.sweeps import CHOICES, SWEEPS

LEVELS_DB = (1.0, 3.0)

EXPECTED = {
    "divide": "SNR < 6 dB: gain −4 dB at 0 dB, −20 dB at −10 dB",
    "wiener": "floor 5 to 9 dB better than divide below 6 dB, biases the peak",
    "gated": "noise inside ±16 cells stays",
    "two_parameter": "works down to −20 dB",
    "auto": "within 0.2 dB of the best",
}
"""What an independent model found (DESIGN section 4)."""


@dataclass(frozen=True)
class Edge:
    """Where one correction of one impairment loses 1 and 3 dB: a row of summary.csv.

    Attributes
    ----------
    impairment, unit, method
        What was tried.
    size_at_1_db, size_at_3_db
        Interpolated; NaN where the peaks never get that wrong, too low or too high.
    first_size, last_size
        Between which sizes it was tried.
    draws, seed
        As `Outcome`.
    """

    impairment: str
    unit: str
    method: str
    size_at_1_db: float
    size_at_3_db: float
    first_size: float
    last_size: float
    draws: int
    seed: int


def part_path(folder: Path, impairment: str, method: str) -> Path:
    """Return where one job of the study writes."""
    return folder / "parts" / f"{impairment}.{method}.csv"


def write_outcomes(path: Path, outcomes: Iterable[Outcome]) -> None:
    """Write outcomes as CSV."""
    write_rows(path, [field.name for field in fields(Outcome)], [asdict(outcome) for outcome in outcomes])


def read_outcomes(path: Path) -> list[Outcome]:
    """Return the rows of a file of `write_outcomes`."""
    with path.open(encoding="utf-8", newline="") as lines:
        kinds = {field.name: {"str": str, "float": float, "int": int}[_name(field.type)] for field in fields(Outcome)}
        return [Outcome(**{name: kinds[name](text) for name, text in row.items()}) for row in csv.DictReader(lines)]


def _name(kind: object) -> str:
    return kind if isinstance(kind, str) else getattr(kind, "__name__", "")


def join_parts(folder: Path, impairment: str) -> list[Outcome]:
    """Write <impairment>.csv from the parts of every correction, and return its rows."""
    outcomes = [one for method in CHOICES for one in read_outcomes(part_path(folder, impairment, method))]
    write_outcomes(folder / f"{impairment}.csv", outcomes)
    return outcomes


def edge_of(outcomes: list[Outcome]) -> Edge:
    """Return where the loss of one impairment under one correction passes 1 and 3 dB, or a gain as wrong does."""
    first, last = outcomes[0], outcomes[-1]
    sizes, losses = (np.array([getattr(one, name) for one in outcomes]) for name in ("size", "loss_db"))
    logarithmic = SWEEPS[first.impairment].logarithmic
    at = [round(crossing(sizes, np.abs(losses), level, logarithmic=logarithmic), 6) for level in LEVELS_DB]
    return Edge(
        first.impairment, first.unit, first.method, at[0], at[1], first.size, last.size, first.draws, first.seed
    )


def write_summary(folder: Path) -> list[Edge]:
    """Write summary.csv from the tables of every impairment, and return its rows."""
    edges = []
    for impairment in SWEEPS:
        outcomes = read_outcomes(folder / f"{impairment}.csv")
        edges += [edge_of([one for one in outcomes if one.method == method]) for method in CHOICES]
    write_rows(folder / "summary.csv", [field.name for field in fields(Edge)], [asdict(edge) for edge in edges])
    return edges


def write_sidelink_table(folder: Path) -> Path:
    """Write sidelink.csv: each method at each SNR of the sidelink, the best, and how far `auto` is from it.

    Returns
    -------
    Path
        Of the table; beside it sidelink_methods.csv says at which SNR each method fails.
    """
    outcomes = read_outcomes(folder / "sidelink_noise.csv")
    methods = [method for method in CHOICES if method not in ("none", "auto")]
    loss = {(one.method, one.size): one.loss_db for one in outcomes}
    chosen = {one.size: one.chosen for one in outcomes if one.method == "auto"}
    rows: list[dict[str, object]] = []
    for snr_db in sorted(chosen):
        best = min(methods, key=lambda method: abs(loss[method, snr_db]))
        row = {f"{method}_loss_db": loss[method, snr_db] for method in methods}
        gap = round(abs(loss["auto", snr_db]) - abs(loss[best, snr_db]), 4)
        rows.append(
            {"sidelink_snr_db": snr_db, **row, "best": best, "auto": chosen[snr_db], "auto_behind_best_db": gap}
        )
    write_rows(folder / "sidelink.csv", list(rows[0]), rows)
    failing: list[dict[str, object]] = []
    for method in (*methods, "auto"):
        edge = edge_of([one for one in outcomes if one.method == method])
        floors = {one.size: one.floor_db for one in outcomes if one.method == method}
        failing.append(
            {
                "method": method,
                "snr_at_1_db_loss": edge.size_at_1_db,
                "snr_at_3_db_loss": edge.size_at_3_db,
                **{f"floor_db_at_{snr:g}_db": floors[snr] for snr in (10.0, 0.0, -10.0, -20.0)},
                "independent_model": EXPECTED[method],
            }
        )
    write_rows(folder / "sidelink_methods.csv", list(failing[0]), failing)
    return folder / "sidelink.csv"
