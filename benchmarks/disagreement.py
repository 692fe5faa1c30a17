"""Image errors and flags for errors of one node, from negligible to large.

`python benchmarks/disagreement.py WORKFOLDER [--only height,drift] [--out docs/assets/disagreement]`. Two nodes fly
past five points; one node has an error of its height, position, time, path or phase, from negligible to ten times the
smallest observable size. A flag that is raised for a small error must also be raised for a larger error. The last line
counts the wrong images (more than 0.15 m or 1 dB, as in mistakes.py) without a flag. Writes <out>.csv and <out>.png.
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
"""Metres east and north of the scene centre, which is 16 m from the track."""


@dataclass(frozen=True)
class Cause:
    """Error of one node.

    Attributes
    ----------
    words
        Description with the unit of the sizes.
    sizes
        Sizes of the error, increasing.
    apply
        Function that adds the error of a given size to a campaign folder.
    """

    words: str
    sizes: Sequence[float]
    apply: Callable[[Folder, float], None]


@dataclass(frozen=True)
class Row:
    """Effect of one size of one error on the image of a pair, and the flags raised."""

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
    """Specify two nodes at 10 m height, separated by 4.8 m, that fly 20 m at 1 m/s past five points at 16 m."""
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
    def rotate_phase(captures: Captures) -> np.ndarray:
        values = captures[:, :, 0, 0] + 1j * captures[:, :, 0, 1]
        values = values * np.exp(2j * np.pi * size * np.arange(len(values)) / len(values))[:, None]
        changed = captures.astype(np.float64)
        changed[:, :, 0] = np.stack([values.real, values.imag], axis=-1)
        return changed

    folder.edit_captures(RX, rotate_phase)


_LENGTHS_M = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.0, 1.2, 1.5, 2.0, 3.0, 5.0)
CAUSES = {
    "height": Cause("height of one log, m", _LENGTHS_M, partial(_moved, along=(0.0, 0.0, 1.0))),
    "along": Cause("position of one log along its track, m", _LENGTHS_M, partial(_moved, along=(1.0, 0.0, 0.0))),
    "across": Cause("position of one log across its track, m", _LENGTHS_M, partial(_moved, along=(0.0, 1.0, 0.0))),
    "time": Cause("time of one log, s", _LENGTHS_M, _later),
    "path": Cause("path of one radar channel, m", _LENGTHS_M, _longer),
    "drift": Cause("phase drift of one channel, cycles", (0.1, 0.2, 0.4, 0.7, 1, 1.5, 2, 3, 4, 6, 8, 10), _drifting),
}
"""Errors by name."""


def main() -> None:
    """Sweep the requested errors, print the rows, and save table and chart."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="work folder for simulated and modified campaigns")
    parser.add_argument("--only", default="", help="names of errors, comma separated")
    parser.add_argument("--out", type=Path, help="path of table and chart, without suffix")
    options = parser.parse_args()
    right = options.folder / "right"
    if not right.exists():
        ap.simulate(right, specification(), seed=5)
    rows: list[Row] = []
    outcome, places = run_campaign(right), true_places(right)
    peaks = {image: find_targets(values, outcome.grid, places) for image, values in outcome.images.items()}
    for cause in [name for name in options.only.split(",") if name] or CAUSES:
        for size in CAUSES[cause].sizes:
            modified = copy_writable(right, options.folder / "modified")
            CAUSES[cause].apply(Folder(modified), size)
            changed = run_campaign(modified)
            error = changed.error
            if error:
                rows.append(
                    Row(cause, size, "-", np.nan, np.nan, wrong=True, flagged=True, verdict="error", flags=error)
                )
                print(cause, size, error[:120], flush=True)
            for image, report in changed.reports.items():
                effect = harm(find_targets(changed.images[image], changed.grid, places), peaks[image])
                verdict, flags = verdict_of(report), sorted(set(report["flags"]) - set(outcome.reports[image]["flags"]))
                flagged = bool(flags) or verdict == "defocused"
                effects = effect.shift_m, effect.loss_db, effect.wrong
                rows.append(Row(cause, size, image, *effects, flagged, verdict, " ".join(flags)))
                unflagged = "UNFLAGGED" if effect.wrong and not flagged else ""
                print(
                    f"{cause:8}{size:6g} {image:10} {100 * effect.shift_m:6.1f} cm {effect.loss_db:6.2f} dB  "
                    f"{verdict:12}",
                    *flags,
                    unflagged,
                    flush=True,
                )
    unflagged_rows = [row for row in rows if row.wrong and not row.flagged]
    print(f"{len(rows)} images, {sum(row.wrong for row in rows)} wrong, {len(unflagged_rows)} of these without a flag")
    if options.out:
        with options.out.with_suffix(".csv").open("w", newline="") as stream:
            csv.writer(stream).writerows([[one.name for one in fields(Row)], *map(astuple, rows)])
        draw(rows, options.out.with_suffix(".png"))


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the largest displacement of a target against the size of each error, with flagged sizes filled."""
    causes = list(dict.fromkeys(row.cause for row in rows))
    figure, panels = plt.subplots(2, -(-len(causes) // 2), figsize=(11, 6), layout="constrained", squeeze=False)
    for cause, axes in zip(causes, panels.flat, strict=False):
        for image, colour in (("uav1-uav1", "tab:blue"), (f"uav1-{RX}", "tab:orange"), ("fused", "tab:green")):
            of_image = [row for row in rows if row.cause == cause and row.image == image]
            sizes, shifts = [row.size for row in of_image], [100 * max(row.shift_m, 1e-3) for row in of_image]
            axes.plot(sizes, shifts, color=colour, lw=1, label={"fused": "sum"}.get(image, image))
            for flagged, face in ((True, colour), (False, "white")):
                marked = [at for at, row in enumerate(of_image) if row.flagged is flagged]
                axes.plot(
                    [sizes[at] for at in marked], [shifts[at] for at in marked], "o", color=colour, mfc=face, ms=5
                )
        axes.axhline(15, color="0.6", lw=0.8, ls="--")
        axes.set(xscale="log", yscale="log", xlabel=CAUSES[cause].words, ylabel="largest target displacement, cm")
    panels.flat[0].legend(title="filled: flagged", fontsize=8)
    for axes in panels.flat[len(causes) :]:
        axes.axis("off")
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
