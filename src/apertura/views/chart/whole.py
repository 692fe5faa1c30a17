"""Error against seconds of the whole way from raw samples to GeoTIFFs, for settings that trade one for the other."""

import contextlib
import io
import json
import os
import platform
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np

from apertura.common.errors import CampaignError
from apertura.common.tables import write_table
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import Flight, SampledWaveform
from apertura.pipeline.lineage import result_of, with_inputs
from apertura.pipeline.rules import STUDY
from apertura.pipeline.steps import (
    assess,
    calibration,
    cube,
    echo,
    export,
    image,
    ingest,
    profile,
    refine,
    scene,
    terrain,
)
from apertura.pipeline.store import record_files
from apertura.views.chart.whole_picture import Whole, draw_whole

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
"""Name → keys of `processing` that are changed, one at a time."""


@dataclass(frozen=True)
class _Run:
    """One way from raw samples to GeoTIFFs."""

    seconds: float
    wall_seconds: float
    load: float
    reports: list[dict[str, Any]]


def whole_chart(campaign: Campaign, *, repeats: int = 3) -> list[Path]:
    """Write results/study/whole.csv and .png: total error against seconds from raw samples to GeoTIFFs.

    Parameters
    ----------
    campaign
        Whose recordings are carried through every step again, into a folder that is removed afterwards.
    repeats
        Of every setting, taken in turn, so that what else the machine does touches all alike; one before them, which
        is not counted, opens libraries and files.
    """
    lineage = result_of(campaign, "whole").begin(campaign.root)
    work = with_inputs(campaign, campaign.result(STUDY) / "whole", link=False)
    choices = {
        name: _chosen(campaign, work, changes) for name, changes in _SETTINGS.items() if _applies(campaign, name)
    }
    runs: dict[str, list[_Run]] = {name: [] for name in choices}
    refused: list[str] = []
    _carried(choices["as configured"])
    for _ in range(repeats):
        for name in [name for name in choices if name not in refused]:
            try:
                runs[name].append(_carried(choices[name]))
            except CampaignError:
                refused.append(name)
    shutil.rmtree(work)
    rows = [_whole(name, some) for name, some in runs.items() if name not in refused]
    paths = [campaign.result(STUDY) / f"whole.{suffix}" for suffix in ("csv", "png")]
    write_table(paths[0], rows, digits=6)
    draw_whole(rows, paths[1], title=_title(campaign, rows, repeats), refused=refused)
    record_files(campaign.root / lineage.result.manifest, paths, lineage)
    return paths


def _applies(campaign: Campaign, name: str) -> bool:
    """Return whether a setting makes a difference to ask for: terrain where there is a DEM, a sidelink where one is."""
    if "terrain" in _SETTINGS[name]:
        return campaign.settings.scene.dem is not None
    receivers = any(len(set(pair.split("-"))) > 1 for pair in campaign.image_flights[0].pairs)
    return "sidelink" not in _SETTINGS[name] or (receivers and isinstance(campaign.settings.waveform, SampledWaveform))


def _chosen(campaign: Campaign, work: Path, changes: dict[str, Any]) -> Campaign:
    """Return the campaign with changed settings, in another folder."""
    processing = type(campaign.settings.processing)(**{**campaign.settings.processing.model_dump(), **changes})
    return replace(campaign, root=work, settings=campaign.settings.model_copy(update={"processing": processing}))


def _carried(campaign: Campaign) -> _Run:
    """Carry a campaign through every step, in the order of the workflow's rules."""
    shutil.rmtree(campaign.results, ignore_errors=True)
    flight, begin = campaign.image_flights[0], (process_time(), perf_counter())
    with contextlib.redirect_stdout(io.StringIO()):
        for other in campaign.flights:
            if other.kind == "calibration":
                _echoes(campaign, other)
                calibration.calibrate(campaign, other.name)
        _echoes(campaign, flight)
        scene.scene(campaign)
        if campaign.settings.scene.dem:
            terrain.terrain(campaign)
        for pair in flight.pairs:
            profile.profile(campaign, flight.name, pair)
        refine.refine(campaign, flight.name)
        for pair in flight.pairs:
            image.image(campaign, flight.name, pair)
        assess.assess(campaign, flight.name)
        cube.cube(replace(campaign, flights=(flight,)))
        for pair in flight.pairs:
            export.export(campaign, flight.name, pair)
    taken = process_time() - begin[0], perf_counter() - begin[1]
    files = [campaign.results / flight.name / pair / "image.json" for pair in flight.pairs]
    return _Run(*taken, os.getloadavg()[0], [json.loads(file.read_text(encoding="utf-8")) for file in files])


def _echoes(campaign: Campaign, flight: Flight) -> None:
    if isinstance(campaign.settings.waveform, SampledWaveform):
        for node in flight.nodes:
            ingest.ingest(campaign, flight.name, node)
    for pair in flight.pairs:
        echo.echo(campaign, flight.name, pair)


def _whole(name: str, runs: list[_Run]) -> Whole:
    """Return one setting's point: of the pair that is worse; errors are the same in every run."""
    reports, seconds = runs[0].reports, [run.seconds for run in runs]
    focus = [report["focus"] for report in reports]
    told: dict[str, Any] = min((one for one in focus if "loss_db" in one), key=lambda one: one["loss_db"], default={})
    return Whole(
        name,
        float(np.mean(seconds)),
        min(seconds),
        max(seconds),
        float(np.mean([run.wall_seconds for run in runs])),
        len(runs),
        float(np.mean([run.load for run in runs])),
        min(_expected_db(report) for report in reports),
        told.get("loss_db", float("nan")),
        told.get("std_db", float("nan")),
        max(report["numerical_error_db"] for report in reports),
        " ".join(sorted({flag for report in reports for flag in report["flags"]})),
    )


def _expected_db(report: Mapping[str, Any]) -> float:
    """Return the loss of all causes that somebody stated, unrounded."""
    return float(sum(line["loss_db"] for line in report["budget"] if not line["stated"].startswith("not stated")))


def _title(campaign: Campaign, rows: list[Whole], repeats: int) -> str:
    load = f"load {min(row.load for row in rows):.1f} to {max(row.load for row in rows):.1f} on {os.cpu_count()} cores"
    flight = campaign.image_flights[0]
    return (
        f"{campaign.settings.campaign}, {flight.name}, {', '.join(flight.pairs)}: from raw samples to GeoTIFFs\n"
        f"{_processor()}, {load}; mean, least and most of {repeats} runs, one thread"
    )


def _processor() -> str:
    """Return the name of this machine's processor."""
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return platform.processor() or platform.machine()
