"""Processing of one campaign by all steps within this process: reports and pixels of each image."""

import contextlib
import io
import json
import shutil
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config import FUSED, Flight
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.errors import CampaignError
from apertura.core.scene.grid import SceneGrid
from apertura.run.process import process
from apertura.stages.scene import settled_scene


@dataclass(frozen=True)
class Outcome:
    """Results of a campaign.

    Attributes
    ----------
    error
        First line of the error that stopped the processing; empty without an error.
    reports
        Image (a pair, or fused) → its image.json.
    images
        Image → (y, x) complex64.
    grid
        Grid of the images.
    seconds
        Wall-clock time of the processing.
    """

    error: str
    seconds: float
    reports: dict[str, dict[str, Any]] = field(default_factory=dict)
    images: dict[str, NDArray[np.complex64]] = field(default_factory=dict)
    grid: SceneGrid | None = None


def copy_writable(source: Path, target: Path) -> Path:
    """Copy a campaign, which may be read-only, without its results to a new folder; return the folder."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target, copy_function=shutil.copyfile, ignore=shutil.ignore_patterns("results"))
    for folder in (target, *(path for path in target.rglob("*") if path.is_dir())):
        folder.chmod(0o755)
    return target


def run_campaign(root: Path) -> Outcome:
    """Process a campaign folder with one image flight by all steps; errors are part of the outcome."""
    start_s = time.perf_counter()
    shutil.rmtree(root / "results", ignore_errors=True)
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            campaign = Campaign.load(root)
            flight = campaign.image_flights[0]
            process(campaign, last="export_fused")
    except CampaignError as error:
        return Outcome(str(error).splitlines()[0].replace(f"{root}/", ""), time.perf_counter() - start_s)
    except Exception as error:  # a crash is also a result; the other campaigns are still processed
        text = f"crash: {type(error).__name__}: {error}"
        return Outcome(text.splitlines()[0], time.perf_counter() - start_s)
    seconds = time.perf_counter() - start_s
    return Outcome("", seconds, _reports(campaign, flight), dict(_images(campaign, flight)), _grid(campaign))


def _grid(campaign: Campaign) -> SceneGrid:
    return settled_scene(campaign).grid


def _reports(campaign: Campaign, flight: Flight) -> dict[str, dict[str, Any]]:
    folders = {name: campaign.results / flight.name / name for name in flight.images}
    return {name: json.loads((folder / "image.json").read_text(encoding="utf-8")) for name, folder in folders.items()}


def _images(campaign: Campaign, flight: Flight) -> Iterator[tuple[str, NDArray[np.complex64]]]:
    for pair in flight.pairs:
        yield pair, open_stage(campaign.stage("image", flight.name, pair), "image").image.values
    if FUSED in flight.images:
        yield FUSED, open_stage(campaign.stage("cube"), "cube").coherent[0].values


def verdict_of(report: dict[str, Any]) -> str:
    """Return the focus verdict of an image.json in one line; empty without a verdict."""
    verdict = report.get("verdict") or report.get("focus", {}).get("verdict", "")
    return verdict if isinstance(verdict, str) else json.dumps(verdict)


def hypothesis_of(report: dict[str, Any]) -> str:
    """Return the first hypothesis of an image.json in one line; empty if there is none."""
    hypotheses = report.get("hypotheses") or []
    first = next(iter(hypotheses.items() if isinstance(hypotheses, dict) else hypotheses), "")
    return first if isinstance(first, str) else json.dumps(first)
