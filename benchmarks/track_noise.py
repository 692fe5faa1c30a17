"""Peak loss due to track noise: predicted by the budget, measured against the truth, and estimated from the image.

`python benchmarks/track_noise.py WORKFOLDER [--base sample|curved] [--draws 20]`. White noise after a moving average of
one second, σ per axis, is added to both logs, and σ is configured as the position accuracy.
"""

import argparse
import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from judging.bases import BASES
from judging.peaks import Peaks, find_targets, true_places
from judging.run import copy_writable
from rich.console import Console
from rich.table import Table
from spoiling.folder import RX, TX, Folder
from spoiling.logs import Log
from spoiling.of_logs import logs, noisy

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.run.process import process
from apertura.stages.scene import settled_scene

SIZES_CM = (0.0, 0.5, 1.0, 2.0, 4.0)


@dataclass(frozen=True)
class Draw:
    """Losses of one image in dB, negative, and the verdict on its focus."""

    pair: str
    predicted_db: float
    true_db: float
    estimated_db: float
    verdict: str


def main() -> None:
    """Image random draws, and print a row for each σ and pair."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--base", choices=sorted(BASES), default="sample")
    parser.add_argument("--draws", type=int, default=20)
    options = parser.parse_args()
    right = BASES[options.base](options.folder / f"{options.base}-right")
    peaks = {pair: pair_peaks for pair, _, _, pair_peaks in _imaged(right)}
    table = Table(title=f"{options.base}: mean of {options.draws} draws")
    for heading in ("σ", "pair", "predicted", "measured", "spread", "estimated from the image", "defocused"):
        table.add_column(heading, justify="right")
    for size_cm in SIZES_CM:
        draws = [one for seed in range(options.draws) for one in _drawn(options.folder, right, size_cm, seed, peaks)]
        for pair in peaks:
            table.add_row(f"{size_cm:g} cm", pair, *_row([one for one in draws if one.pair == pair]))
    Console(width=140).print(table)


def _row(draws: list[Draw]) -> list[str]:
    true, estimated = np.array([one.true_db for one in draws]), np.array([one.estimated_db for one in draws])
    predicted = float(np.mean([one.predicted_db for one in draws]))
    defocused = sum(one.verdict == "defocused" for one in draws)
    values = (predicted, true.mean(), true.std(), np.nanmean(estimated))
    return [*(f"{value:.2f} dB" for value in values), f"{defocused} of {len(draws)}"]


def _drawn(folder: Path, right: Path, size_cm: float, seed: int, peaks: dict[str, Peaks]) -> list[Draw]:
    modified = copy_writable(right, folder / "modified")
    if size_cm:
        logs(noisy(size_cm / 100, seed=seed), TX, RX)(Folder(modified))
    logs(declare_std(max(size_cm, 1e-2) / 100), RX)(Folder(modified))
    Folder(modified).edit_config(
        lambda document: [
            document.setdefault("processing", {}).update(autofocus="off"),
            *(node.update(position_std_m=max(size_cm, 1e-3) / 100) for node in document["nodes"].values()),
        ]
    )
    draws = []
    for pair, quality, predicted_db, pair_peaks in _imaged(modified):
        loss_db = float(np.nanmean(pair_peaks.level_db - peaks[pair].level_db))
        focus = quality["focus"]
        draws.append(Draw(pair, predicted_db, loss_db, focus.get("loss_db", np.nan), focus["verdict"]))
    return draws


def declare_std(sigma_m: float) -> Callable[[Log], Log]:
    """Return a change that sets the standard deviations in an RTKLIB log."""

    def change(log: Log) -> Log:
        rows = [line.split() for line in log.quality]
        size = f"{sigma_m:.4f}"
        return replace(log, quality=tuple("  ".join([*row[:2], size, size, size, *row[5:]]) for row in rows))

    return change


def _imaged(root: Path) -> list[tuple[str, dict, float, Peaks]]:
    """Process a campaign up to its images; return the quality report, predicted loss and target peaks of each pair."""
    campaign, places = Campaign.load(root), true_places(root)
    flight, images = campaign.image_flights[0], []
    with contextlib.redirect_stdout(io.StringIO()):
        process(campaign, last="image")
    for pair in flight.pairs:
        stage = open_stage(campaign.stage("image", flight.name, pair), "image")
        quality = stage.attrs["quality"]
        predicted_db = next(line["loss_db"] for line in quality["budget"] if line["cause"] == "positions")
        peaks = find_targets(stage.image.values, settled_scene(campaign).grid, places)
        images.append((pair, quality, predicted_db, peaks))
    return images


if __name__ == "__main__":
    main()
