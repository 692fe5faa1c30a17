"""Error against processing time of the whole chain from raw samples to GeoTIFFs, for different settings."""

import contextlib
import io
import json
import os
import platform
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from apertura.campaign.config import SampledWaveform, is_monostatic
from apertura.campaign.folder import Campaign
from apertura.campaign.store import record_files
from apertura.common.atomic import remove
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError
from apertura.common.tables import write_table
from apertura.common.units import decibels
from apertura.core.quality.budget import is_counted
from apertura.run.process import process
from apertura.tools.chart.pareto import save_png
from apertura.workflow.lineage import result_of, with_inputs
from apertura.workflow.rules import STUDY

_FLOOR_DB = -110.0
_LONGEST_DB = 20.0
_MARKS = {
    "o": "certified numerical error; bar: range of times",
    "s": "power spread from the peaks, predicted by the error budget",
    "^": "power spread from the peaks, measured at bright points, ± σ",
}


@dataclass(frozen=True)
class Whole:
    """Time and error of one setting from raw samples to GeoTIFFs, for the pair with the larger error.

    Attributes
    ----------
    seconds, least_seconds, most_seconds
        Mean, minimum and maximum processor time of the repeats. Processor time depends less on other load of the
        machine than wall time.
    wall_seconds
        Mean wall time.
    repeats
        Number of repeats.
    load
        Mean load average of the machine.
    expected_loss_db
        Sum of the expected losses of the error budget including the numerical error, 0 or less.
    measured_loss_db, measured_std_db
        Peak loss at bright points and its standard deviation; NaN if no point is bright enough.
    numerical_error_db
        Certified numerical error.
    flags
        Flags of the pairs, separated by blanks.
    """

    setting: str
    seconds: float
    least_seconds: float
    most_seconds: float
    wall_seconds: float
    repeats: int
    load: float
    expected_loss_db: float
    measured_loss_db: float
    measured_std_db: float
    numerical_error_db: float
    flags: str


def spread_db(loss_db: float) -> float:
    """Convert a peak loss into the fraction of the peak power that is spread around the peak, dB.

    Examples
    --------
    >>> round(spread_db(-1.0), 1), spread_db(0.0)
    (-6.9, -110.0)
    """
    return decibels(max(1 - 10 ** (min(loss_db, 0.0) / 10), 10 ** (_FLOOR_DB / 10)))


def draw_whole(rows: Sequence[Whole], path: Path, *, title: str, refused: Collection[str]) -> None:
    """Plot the errors of each setting against its processing time as PNG; refused settings are listed."""
    figure = Figure(figsize=(13, 7), layout="constrained")
    axes, legend_axes = figure.subplots(1, 2, width_ratios=(3.2, 1))
    ordered = sorted(rows, key=lambda row: row.seconds)
    for number, row in enumerate(ordered):
        _draw_row(axes, row, f"C{number % 10}", str(number + 1))
    for marker, label in _MARKS.items():
        axes.plot([], [], marker, color="0.3", label=label)
    axes.set_xlabel("Processor time from raw samples to GeoTIFFs, s")
    axes.set_ylabel("Error, dB")
    axes.grid(alpha=0.25)
    axes.margins(y=0.1)
    figure.suptitle(title, fontsize=10)
    figure.legend(loc="outside lower center", ncols=len(_MARKS), fontsize=9)
    lines = [f"{number}  {row.setting}: {row.wall_seconds:.1f} s" for number, row in enumerate(ordered, 1)]
    lines += [f"–  {name}: refused" for name in refused]
    names = sorted({flag for row in rows for flag in row.flags.split()})
    text = "\n".join(["wall time", *lines, "", "flags", *(names or ["none"])])
    legend_axes.text(0, 1, text, va="top", fontsize=9)
    legend_axes.axis("off")
    save_png(figure, path)


def _draw_row(axes: Axes, row: Whole, colour: str, number: str) -> None:
    """Draw one setting: range of its times, and each kind of error."""
    losses_db = [row.measured_loss_db + sign * row.measured_std_db for sign in (0, 1, -1)]
    heights = dict(zip(_MARKS, map(float, (row.numerical_error_db, spread_db(row.expected_loss_db))), strict=False))
    axes.hlines(row.numerical_error_db, row.least_seconds, row.most_seconds, color=colour)
    if np.isfinite(row.measured_loss_db):
        heights["^"], low, high = map(spread_db, losses_db)
        axes.vlines(row.seconds, max(low, heights["^"] - _LONGEST_DB), high, color=colour)
    for marker, height in heights.items():
        axes.plot(row.seconds, height, marker, color=colour)
    axes.vlines(row.seconds, min(heights.values()), max(heights.values()), color=colour, linewidth=0.5, alpha=0.5)
    position = (row.seconds, row.numerical_error_db)
    axes.annotate(number, position, xytext=(0, -16), textcoords="offset points", ha="center", color=colour)


_SETTINGS: Mapping[str, dict[str, Any]] = {
    "as configured": {},
    "accuracy −30 dB": {"accuracy_db": -30.0},
    "accuracy −60 dB": {"accuracy_db": -60.0},
    "accuracy −90 dB": {"accuracy_db": -90.0},
    "presum 1": {"presum": 1},
    "presum 2": {"presum": 2},
    "level ground": {"terrain": "plane"},
    "DEM": {"terrain": "dem"},
    "sidelink divide": {"sidelink": "divide"},
    "sidelink gated": {"sidelink": "gated"},
    "sidelink two_parameter": {"sidelink": "two_parameter"},
}
"""Name of a setting → changed keys of `processing`."""


@dataclass(frozen=True)
class _Run:
    """Times, load and image reports of a run from raw samples to GeoTIFFs."""

    seconds: float
    wall_seconds: float
    load: float
    reports: list[dict[str, Any]]


def whole_chart(campaign: Campaign, *, repeats: int = 3) -> Sequence[Path]:
    """Write results/study/whole.csv and .png: error against processing time from raw samples to GeoTIFFs.

    Parameters
    ----------
    campaign
        Campaign whose recordings are reprocessed in a temporary folder.
    repeats
        Number of runs of every setting. Settings alternate, so that other load of the machine affects all of them
        equally. An additional first run, which loads libraries and files, is not counted.
    """
    lineage = result_of(campaign, "whole").begin(campaign.root)
    work = with_inputs(campaign, campaign.result(STUDY) / "whole", link=False)
    choices = {
        name: _chosen(campaign, work, changes) for name, changes in _SETTINGS.items() if _applies(campaign, name)
    }
    runs: dict[str, list[_Run]] = {name: [] for name in choices}
    refused: list[str] = []
    _processed(choices["as configured"])
    for _ in range(repeats):
        for name in [name for name in choices if name not in refused]:
            try:
                runs[name].append(_processed(choices[name]))
            except CampaignError:
                refused.append(name)
    remove(work)
    rows = [_whole(name, repeated) for name, repeated in runs.items() if name not in refused]
    paths = [campaign.result(STUDY) / f"whole.{suffix}" for suffix in ("csv", "png")]
    write_table(paths[0], rows, digits=6)
    load = f"load {min(row.load for row in rows):.1f} to {max(row.load for row in rows):.1f} on {os.cpu_count()} cores"
    flight = campaign.image_flights[0]
    draw_whole(
        rows,
        paths[1],
        title=(
            f"{campaign.settings.campaign}, {flight.name}, {', '.join(flight.pairs)}: from raw samples to GeoTIFFs\n"
            f"{_processor()}, {load}; mean, minimum and maximum of {repeats} runs, one thread"
        ),
        refused=refused,
    )
    record_files(campaign.root / lineage.result.manifest, paths, lineage)
    return paths


def _applies(campaign: Campaign, name: str) -> bool:
    """Return True if a setting has an effect: terrain settings require a DEM, sidelink settings a bistatic pair."""
    if "terrain" in _SETTINGS[name]:
        return campaign.settings.scene.dem is not None
    bistatic = not all(map(is_monostatic, campaign.image_flights[0].pairs))
    return "sidelink" not in _SETTINGS[name] or (bistatic and isinstance(campaign.settings.waveform, SampledWaveform))


def _chosen(campaign: Campaign, work: Path, changes: dict[str, Any]) -> Campaign:
    """Return the campaign with changed settings and another root folder."""
    processing = type(campaign.settings.processing)(**{**campaign.settings.processing.model_dump(), **changes})
    return replace(
        campaign, root=ConfinedPath.at(work), settings=campaign.settings.model_copy(update={"processing": processing})
    )


def _processed(campaign: Campaign) -> _Run:
    """Process the first image flight of a campaign, with the calibration flights, up to the GeoTIFFs."""
    campaign.results.remove()
    flight = campaign.image_flights[0]
    flights = tuple(one for one in campaign.flights if one.kind == "calibration" or one == flight)
    start_s = process_time(), perf_counter()
    with contextlib.redirect_stdout(io.StringIO()):
        process(replace(campaign, flights=flights), last="export")
    elapsed_s = process_time() - start_s[0], perf_counter() - start_s[1]
    files = [campaign.results / flight.name / pair / "image.json" for pair in flight.pairs]
    return _Run(*elapsed_s, os.getloadavg()[0], [json.loads(file.read_text(encoding="utf-8")) for file in files])


def _whole(name: str, runs: list[_Run]) -> Whole:
    """Return the row of a setting, with the errors of the worse pair; errors are identical in all runs."""
    reports, seconds = runs[0].reports, [run.seconds for run in runs]
    measured = [report["focus"] for report in reports if "loss_db" in report["focus"]]
    worst: dict[str, Any] = min(measured, key=lambda focus: focus["loss_db"], default={})
    return Whole(
        name,
        float(np.mean(seconds)),
        min(seconds),
        max(seconds),
        float(np.mean([run.wall_seconds for run in runs])),
        len(runs),
        float(np.mean([run.load for run in runs])),
        min(float(sum(line["loss_db"] for line in report["budget"] if is_counted(line))) for report in reports),
        worst.get("loss_db", float("nan")),
        worst.get("std_db", float("nan")),
        max(report["numerical_error_db"] for report in reports),
        " ".join(sorted({flag for report in reports for flag in report["flags"]})),
    )


def _processor() -> str:
    """Return the processor name of this machine."""
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return platform.processor() or platform.machine()
