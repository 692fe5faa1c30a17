"""The tables of the stability study: parts, one per impairment, and where each correction fails."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.tables import read_table, write_table
from apertura_research.study.stability.outcomes import Outcome
from apertura_research.study.stability.sweeps import CHOICES, SWEEPS

LEVELS_DB = (1.0, 3.0)

EXPECTED = {
    "divide": "SNR < 6 dB: gain −4 dB at 0 dB, −20 dB at −10 dB",
    "wiener": "floor 5 to 9 dB better than divide below 6 dB, biases the peak",
    "gated": "noise inside ±16 cells stays",
    "two_parameter": "works down to −20 dB",
    "auto": "within 0.2 dB of the best",
}
"""What an independent model says of each method."""


@dataclass(frozen=True)
class Tolerance:
    """How much of one impairment one correction tolerates: a row of summary.csv.

    Attributes
    ----------
    size_at_1_db, size_at_3_db
        Interpolated; NaN where the peaks never get that wrong, too low or too high.
    first_size, last_size
        Between which sizes it was tried.
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


def join_parts(folder: Path, impairment: str) -> list[Outcome]:
    """Write <impairment>.csv from the parts of every correction, and return its rows."""
    outcomes = [row for method in CHOICES for row in read_table(part_path(folder, impairment, method), Outcome)]
    write_table(folder / f"{impairment}.csv", outcomes)
    return outcomes


def tolerance_of(outcomes: Sequence[Outcome]) -> Tolerance:
    """Return where the loss of one impairment under one correction passes 1 and 3 dB, or a gain as wrong does."""
    first, last = outcomes[0], outcomes[-1]
    sizes, losses = (np.array([getattr(one, name) for one in outcomes]) for name in ("size", "loss_db"))
    logarithmic = SWEEPS[first.impairment].logarithmic
    at = [round(crossing(sizes, np.abs(losses), level, logarithmic=logarithmic), 6) for level in LEVELS_DB]
    return Tolerance(
        first.impairment, first.unit, first.method, at[0], at[1], first.size, last.size, first.draws, first.seed
    )


def write_summary(folder: Path) -> list[Tolerance]:
    """Write summary.csv from the tables of every impairment, and return its rows."""
    tolerances = []
    for impairment in SWEEPS:
        outcomes = read_table(folder / f"{impairment}.csv", Outcome)
        tolerances += [tolerance_of(_of_method(outcomes, method)) for method in CHOICES]
    write_table(folder / "summary.csv", tolerances)
    return tolerances


def _of_method(outcomes: Sequence[Outcome], method: str) -> list[Outcome]:
    return [outcome for outcome in outcomes if outcome.method == method]


def write_sidelink_tables(folder: Path) -> Path:
    """Write sidelink.csv: each method at each SNR of the sidelink, the best, and how far `auto` is from it.

    Beside it sidelink_methods.csv says at which SNR each method fails.
    """
    outcomes = read_table(folder / "sidelink_noise.csv", Outcome)
    methods = [method for method in CHOICES if method not in ("none", "auto")]
    write_table(folder / "sidelink.csv", _snr_rows(outcomes, methods))
    write_table(
        folder / "sidelink_methods.csv", [_method_row(_of_method(outcomes, method)) for method in (*methods, "auto")]
    )
    return folder / "sidelink.csv"


def _snr_rows(outcomes: Sequence[Outcome], methods: Sequence[str]) -> list[dict[str, object]]:
    loss = {(one.method, one.size): one.loss_db for one in outcomes}
    rows: list[dict[str, object]] = []
    for snr_db, chosen in sorted((one.size, one.chosen) for one in _of_method(outcomes, "auto")):
        best = min(methods, key=lambda method: abs(loss[method, snr_db]))
        row: dict[str, object] = {"sidelink_snr_db": snr_db}
        row |= {f"{method}_loss_db": loss[method, snr_db] for method in methods}
        gap = round(abs(loss["auto", snr_db]) - abs(loss[best, snr_db]), 4)
        rows.append(row | {"best": best, "auto": chosen, "auto_behind_best_db": gap})
    return rows


def _method_row(outcomes: Sequence[Outcome]) -> dict[str, object]:
    tolerance = tolerance_of(outcomes)
    floors = {one.size: one.floor_db for one in outcomes}
    return {
        "method": tolerance.method,
        "snr_at_1_db_loss": tolerance.size_at_1_db,
        "snr_at_3_db_loss": tolerance.size_at_3_db,
        **{f"floor_db_at_{snr:g}_db": floors[snr] for snr in (10.0, 0.0, -10.0, -20.0)},
        "independent_model": EXPECTED[tolerance.method],
    }


def crossing(sizes: Floats, losses_db: Floats, level_db: float, *, logarithmic: bool) -> float:
    """Return the size at which the loss first passes a level, interpolated; NaN if it never does.

    Parameters
    ----------
    sizes, losses_db
        (size,) float64, from negligible to destructive; sizes rise or fall.
    level_db
        What is passed.
    logarithmic
        Interpolate in the logarithm of the size.

    Examples
    --------
    >>> crossing(np.array([1.0, 10.0, 100.0]), np.array([0.0, 0.5, 1.5]), 1.0, logarithmic=True)
    31.6...
    >>> crossing(np.array([30.0, 0.0]), np.array([0.1, 0.2]), 1.0, logarithmic=False)
    nan
    """
    above = np.flatnonzero(losses_db >= level_db)
    if not above.size:
        return float("nan")
    i = int(above[0])
    if i == 0:
        return float(sizes[0])
    between = np.log(sizes[i - 1 : i + 1]) if logarithmic else sizes[i - 1 : i + 1]
    at = np.interp(level_db, losses_db[i - 1 : i + 1], between)
    return float(np.exp(at) if logarithmic else at)
