"""Limits of the track refinement on a short flight: fraction of successful draws against error, points and SNR.

`python -m benchmarks.refinement.edges --out FOLDER`: 150 pulses in 7.5 s past a few points, mono- and bistatic pair
together and separately; one quantity (error, correlation time, number of points or SNR) is varied at a time. Writes
edges.csv, which is continued if it exists, and edges.png. A draw succeeds if the refinement is accepted and the targets
lose at most 1 dB.
"""

import argparse
import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from apertura_research.autofocus.cases import GRID, case
from apertura_research.autofocus.outcomes import judge
from matplotlib.figure import Figure

from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.refine import refine
from apertura.tools.chart.pareto import save_png

Setting = tuple[float, float, int, float]
"""σ (cm), correlation time (s), points, SNR per pulse (dB)."""

AT: Setting = (2.0, 1.0, 5, 10.0)
OVER: dict[str, tuple[int, Sequence[float]]] = {
    "σ of each log per axis, cm": (0, (1, 2, 3, 4, 6, 8, 12)),
    "correlation time at 4 cm, s": (1, (0.2, 0.3, 0.5, 1, 2, 4)),
    "points at 4 cm": (2, (1, 2, 3, 4, 5, 8)),
    "SNR per pulse at 4 cm, dB": (3, (-20, -15, -10, -5, 0, 10)),
}
PAIRS = {"joint": "both pairs together", "mono": "monostatic only", "bi": "bistatic only"}
LARGEST_LOSS_DB = -1.0
FIELDS = (
    "sigma_cm",
    "correlation_s",
    "points",
    "snr_db",
    "pairs",
    "seed",
    "accepted",
    "before_db",
    "after_db",
    "moved_cm",
)


def settings(label: str) -> Iterator[tuple[float, Setting]]:
    """Yield each value of a panel with its complete setting."""
    index, values = OVER[label]
    for value in values:
        at = list(AT if index == 0 else (4.0, *AT[1:]))
        at[index] = value
        yield value, (float(at[0]), float(at[1]), int(at[2]), float(at[3]))


def row(at: Setting, pairs: str, seed: int) -> dict[str, object]:
    """Run one draw; return its table row."""
    sigma_cm, correlation_s, points, snr_db = at
    one = case(f"points-{points}", "short", pairs, sigma_cm / 100, snr_db, seed, correlation_s=correlation_s)
    result = refine(one.records, GRID, FlatGround(0.0), one.errors)
    before, after = judge(one), judge(one, result.correction)
    measured = (result.accepted, before.target_loss_db, after.target_loss_db, after.target_shift_cm)
    return dict(zip(FIELDS, (*at, pairs, seed, measured[0], *(round(value, 3) for value in measured[1:])), strict=True))


def draw(rows: Sequence[dict[str, str]], path: Path, *, draws: int) -> None:
    """Draw the fractions of successful and of accepted but unsuccessful draws, in a panel per varied quantity."""
    figure = Figure(figsize=(13, 3.9), layout="constrained")
    for axes, label in zip(figure.subplots(1, len(OVER), sharey=True), OVER, strict=True):
        for number, (pairs, pairs_label) in enumerate(PAIRS.items()):
            successful, wrong, values = [], [], []
            for value, at in settings(label):
                of_setting = [one for one in rows if one["pairs"] == pairs and _setting(one) == at]
                if of_setting:
                    accepted = np.array([one["accepted"] == "True" for one in of_setting])
                    focused = np.array([float(one["after_db"]) >= LARGEST_LOSS_DB for one in of_setting])
                    values.append(value)
                    successful.append((accepted & focused).mean())
                    wrong.append((accepted & ~focused).mean())
            axes.plot(values, successful, "o-", color=f"C{number}", label=pairs_label)
            axes.plot(values, wrong, "x:", color=f"C{number}")
        axes.set_xlabel(label)
        axes.grid(alpha=0.25)
        if OVER[label][0] < 2:
            axes.set_xscale("log")
            axes.set_xticks(OVER[label][1], [f"{value:g}" for value in OVER[label][1]])
            axes.minorticks_off()
        axes.set_ylim(-0.04, 1.04)
    figure.axes[0].set_ylabel(f"fraction of {draws} draws")
    figure.axes[0].plot([], [], "x:", color="0.3", label="accepted, but residual loss above 1 dB")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.suptitle(
        f"Refinement with a residual loss of at most 1 dB; unless varied: 150 pulses, {AT[2]} points, correlation time "
        f"{AT[1]:g} s, SNR {AT[3]:g} dB per pulse",
        fontsize=10,
    )
    save_png(figure, path)


def _setting(one: dict[str, str]) -> Setting:
    return float(one["sigma_cm"]), float(one["correlation_s"]), int(one["points"]), float(one["snr_db"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of edges.csv and edges.png")
    parser.add_argument("--draws", type=int, default=8)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    table = options.out / "edges.csv"
    rows = list(csv.DictReader(table.open(encoding="utf-8", newline=""))) if table.exists() else []
    done = {(*_setting(one), one["pairs"], int(one["seed"])) for one in rows}
    with table.open("a", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        if not file.tell():
            writer.writeheader()
        for seed in range(600, 600 + options.draws):
            for label in OVER:
                for _, at in settings(label):
                    for pairs in PAIRS:
                        if (*at, pairs, seed) not in done:
                            done.add((*at, pairs, seed))
                            writer.writerow(row(at, pairs, seed))
                            file.flush()
    rows = list(csv.DictReader(table.open(encoding="utf-8", newline="")))
    draw(rows, options.out / "edges.png", draws=options.draws)


if __name__ == "__main__":
    main()
