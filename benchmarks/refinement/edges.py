"""Where the refinement of a first flight's tracks ends: share of draws it mends, over what makes it fail.

`python -m benchmarks.refinement.edges --out FOLDER`: 150 pulses in 7.5 s past a few points, mono- and bistatic pair
together and alone; one of error, correlation time, points and SNR is varied at a time. Writes edges.csv, taken up where
it ended, and edges.png. A draw is mended where targets lose a decibel at most and nothing was refused.
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
PAIRS = {"joint": "two pairs together", "mono": "monostatic alone", "bi": "bistatic alone"}
MENDED_DB = -1.0
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
    """Yield each value of a panel with the setting that it stands in."""
    place, values = OVER[label]
    for value in values:
        at = list(AT if place == 0 else (4.0, *AT[1:]))
        at[place] = value
        yield value, (float(at[0]), float(at[1]), int(at[2]), float(at[3]))


def row(at: Setting, pairs: str, seed: int) -> dict[str, object]:
    """Return one draw."""
    sigma_cm, correlation_s, points, snr_db = at
    one = case(f"points-{points}", "short", pairs, sigma_cm / 100, snr_db, seed, correlation_s=correlation_s)
    found = refine(one.records, GRID, FlatGround(0.0), one.errors)
    before, after = judge(one), judge(one, found.correction)
    measured = (found.accepted, before.target_loss_db, after.target_loss_db, after.target_shift_cm)
    return dict(zip(FIELDS, (*at, pairs, seed, measured[0], *(round(value, 3) for value in measured[1:])), strict=True))


def draw(rows: Sequence[dict[str, str]], path: Path, *, draws: int) -> None:
    """Draw the share of draws that are mended, and that are accepted and are not, a panel for each thing varied."""
    figure = Figure(figsize=(13, 3.9), layout="constrained")
    for axes, label in zip(figure.subplots(1, len(OVER), sharey=True), OVER, strict=True):
        for number, (pairs, words) in enumerate(PAIRS.items()):
            mended, wrong, values = [], [], []
            for value, at in settings(label):
                some = [one for one in rows if one["pairs"] == pairs and _setting(one) == at]
                if some:
                    accepted = np.array([one["accepted"] == "True" for one in some])
                    good = np.array([float(one["after_db"]) >= MENDED_DB for one in some])
                    values.append(value)
                    mended.append((accepted & good).mean())
                    wrong.append((accepted & ~good).mean())
            axes.plot(values, mended, "o-", color=f"C{number}", label=words)
            axes.plot(values, wrong, "x:", color=f"C{number}")
        axes.set_xlabel(label)
        axes.grid(alpha=0.25)
        if OVER[label][0] < 2:
            axes.set_xscale("log")
            axes.set_xticks(OVER[label][1], [f"{value:g}" for value in OVER[label][1]])
            axes.minorticks_off()
        axes.set_ylim(-0.04, 1.04)
    figure.axes[0].set_ylabel(f"share of {draws} draws")
    figure.axes[0].plot([], [], "x:", color="0.3", label="accepted, and more than 1 dB is left")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.suptitle(
        f"Refined and left with 1 dB of loss at most: 150 pulses past {AT[2]} points, {AT[1]:g} s, {AT[3]:g} dB a "
        "pulse, where not varied",
        fontsize=10,
    )
    save_png(figure, path)


def _setting(one: dict[str, str]) -> Setting:
    return float(one["sigma_cm"]), float(one["correlation_s"]), int(one["points"]), float(one["snr_db"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of edges.csv and edges.png")
    parser.add_argument("--draws", type=int, default=8)
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    table = asked.out / "edges.csv"
    rows = list(csv.DictReader(table.open(encoding="utf-8", newline=""))) if table.exists() else []
    done = {(*_setting(one), one["pairs"], int(one["seed"])) for one in rows}
    with table.open("a", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        if not file.tell():
            writer.writeheader()
        for seed in range(600, 600 + asked.draws):
            for label in OVER:
                for _, at in settings(label):
                    for pairs in PAIRS:
                        if (*at, pairs, seed) not in done:
                            done.add((*at, pairs, seed))
                            writer.writerow(row(at, pairs, seed))
                            file.flush()
    draw(list(csv.DictReader(table.open(encoding="utf-8", newline=""))), asked.out / "edges.png", draws=asked.draws)


if __name__ == "__main__":
    main()
