"""Errors of one node that grow: how wrong images become, and what is flagged at each size.

`python benchmarks/disagreement.py WORKFOLDER [--only height,drift] [--out docs/assets/disagreement]`. Two nodes fly
past five points; one of them is given an error of its height, place, time, path or phase, from nothing to ten times
what first shows. A flag that is raised for a small error must not be lost for a larger one: the last line counts the
images that are wrong (more than 0.15 m or 1 dB, as in mistakes.py) without a flag. Writes <out>.csv and <out>.png.
"""

import argparse
import csv
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields, replace
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from judging.peaks import find_targets, harm, true_places
from judging.run import copy_writable, run_campaign, verdict_of
from spoiling.folder import RX, Captures, Folder

import apertura as ap
from apertura.simulation import CampaignSpecification, ImageGrid, SimulatedFlight, Straight, preset
from apertura.simulation.targets import PointTarget

_TARGETS = ((0.0, 0.0), (-3.85, -2.8), (4.2, 3.15), (2.1, -4.34), (-4.2, 4.2))
"""Metres east and north of the scene's middle, 16 m beside the track."""


@dataclass(frozen=True)
class Cause:
    """An error of one node.

    Attributes
    ----------
    sizes
        Of the error, growing; its unit is in `words`.
    spoil
        Changes a campaign folder by an error of a size.
    """

    words: str
    sizes: Sequence[float]
    spoil: Callable[[Folder, float], None]


@dataclass(frozen=True)
class Row:
    """One size of one error: what it does to the image of a pair, and what is flagged."""

    cause: str
    size: float
    image: str
    shift_m: float
    loss_db: float
    wrong: bool
    flagged: bool
    verdict: str
    flags: str


def specification() -> CampaignSpecification:
    """Return two nodes 10 m up and 4.8 m apart that fly 20 m at 1 m/s past five points, 16 m aside."""
    demo = preset("demo")
    tracks = {
        node: Straight((-10.0 + middle, -16.0, 10.0), (1.0, 0.0, 0.0)) for node, middle in (("uav1", 0.0), (RX, 4.8))
    }
    waveform = replace(
        demo.waveform, subcarriers=512, subcarrier_spacing_hz=0.8e6, symbol_s=1.25e-6, cyclic_prefix_s=0.6e-6
    )
    return replace(
        demo,
        campaign="disagreement",
        waveform=replace(waveform, sample_rate_hz=512e6),
        scene=ImageGrid("EPSG:32632", 6.4, spacing_m=0.04),
        targets=tuple(PointTarget((east, north, 0.0)) for east, north in _TARGETS),
        flights=(SimulatedFlight("f01", "uav1", tracks, 400),),
    )


def _moved(folder: Folder, size: float, *, along: tuple[float, float, float]) -> None:
    folder.edit_log(RX, lambda log: log.moved(tuple(size * part for part in along)))


def _later(folder: Folder, size: float) -> None:
    folder.edit_log(RX, lambda log: replace(log, time_s=log.time_s + size))


def _longer(folder: Folder, size: float) -> None:
    def change(document: dict) -> None:
        document["nodes"][RX]["path_offset_m"]["radar"] += size

    folder.edit_config(change)


def _drifting(folder: Folder, size: float) -> None:
    def turned(captures: Captures) -> np.ndarray:
        values = captures[:, :, 0, 0] + 1j * captures[:, :, 0, 1]
        values = values * np.exp(2j * np.pi * size * np.arange(len(values)) / len(values))[:, None]
        changed = captures.astype(np.float64)
        changed[:, :, 0] = np.stack([values.real, values.imag], axis=-1)
        return changed

    folder.edit_captures(RX, turned)


_LENGTHS_M = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.0, 1.2, 1.5, 2.0, 3.0, 5.0)
CAUSES = {
    "height": Cause("height of one log, m", _LENGTHS_M, partial(_moved, along=(0.0, 0.0, 1.0))),
    "along": Cause("place of one log along its track, m", _LENGTHS_M, partial(_moved, along=(1.0, 0.0, 0.0))),
    "across": Cause("place of one log across its track, m", _LENGTHS_M, partial(_moved, along=(0.0, 1.0, 0.0))),
    "time": Cause("time of one log, s", _LENGTHS_M, _later),
    "path": Cause("path of one radar channel, m", _LENGTHS_M, _longer),
    "drift": Cause(
        "phase of one radar channel over the flight, turns", (0.1, 0.2, 0.4, 0.7, 1, 1.5, 2, 3, 4, 6, 8, 10), _drifting
    ),
}
"""Name → error; the unit is in the words."""


def main() -> None:
    """Sweep the errors that are asked for, print and save rows and chart."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="where campaigns are made and spoilt")
    parser.add_argument("--only", default="", help="names of errors, comma separated")
    parser.add_argument("--out", type=Path, help="table and chart, without suffix")
    given = parser.parse_args()
    right = given.folder / "right"
    if not right.exists():
        ap.simulate(right, specification(), seed=5)
    rows: list[Row] = []
    outcome, places = run_campaign(right), true_places(right)
    peaks = {image: find_targets(values, outcome.grid, places) for image, values in outcome.images.items()}
    for cause in [name for name in given.only.split(",") if name] or CAUSES:
        for size in CAUSES[cause].sizes:
            spoilt = copy_writable(right, given.folder / "spoilt")
            CAUSES[cause].spoil(Folder(spoilt), size)
            found = run_campaign(spoilt)
            if found.error:
                rows.append(
                    Row(cause, size, "-", np.nan, np.nan, wrong=True, flagged=True, verdict="error", flags=found.error)
                )
                print(cause, size, found.error[:120], flush=True)
            for image, report in found.reports.items():
                done = harm(find_targets(found.images[image], found.grid, places), peaks[image])
                verdict, flags = verdict_of(report), sorted(set(report["flags"]) - set(outcome.reports[image]["flags"]))
                flagged = bool(flags) or verdict == "defocused"
                rows.append(
                    Row(cause, size, image, done.shift_m, done.loss_db, done.wrong, flagged, verdict, " ".join(flags))
                )
                silent = "SILENT" if done.wrong and not flagged else ""
                print(
                    f"{cause:8}{size:6g} {image:10} {100 * done.shift_m:6.1f} cm {done.loss_db:6.2f} dB  {verdict:12}",
                    *flags,
                    silent,
                    flush=True,
                )
    silent = [row for row in rows if row.wrong and not row.flagged]
    print(f"{len(rows)} images, {sum(row.wrong for row in rows)} wrong, {len(silent)} of these without a flag")
    if given.out:
        with given.out.with_suffix(".csv").open("w", newline="") as stream:
            csv.writer(stream).writerows([[one.name for one in fields(Row)], *map(astuple, rows)])
        draw(rows, given.out.with_suffix(".png"))


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the largest shift of a target against the size of each error, and whether it is flagged."""
    causes = list(dict.fromkeys(row.cause for row in rows))
    figure, panels = plt.subplots(2, -(-len(causes) // 2), figsize=(11, 6), layout="constrained", squeeze=False)
    for cause, axes in zip(causes, panels.flat, strict=False):
        for image, colour in (("uav1-uav1", "tab:blue"), (f"uav1-{RX}", "tab:orange"), ("fused", "tab:green")):
            some = [row for row in rows if row.cause == cause and row.image == image]
            sizes, shifts = [row.size for row in some], [100 * max(row.shift_m, 1e-3) for row in some]
            axes.plot(sizes, shifts, color=colour, lw=1, label={"fused": "sum"}.get(image, image))
            for flagged, face in ((True, colour), (False, "white")):
                those = [at for at, row in enumerate(some) if row.flagged is flagged]
                axes.plot([sizes[at] for at in those], [shifts[at] for at in those], "o", color=colour, mfc=face, ms=5)
        axes.axhline(15, color="0.6", lw=0.8, ls="--")
        axes.set(xscale="log", yscale="log", xlabel=CAUSES[cause].words, ylabel="largest shift of a target, cm")
    panels.flat[0].legend(title="filled: flagged", fontsize=8)
    for axes in panels.flat[len(causes) :]:
        axes.axis("off")
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
