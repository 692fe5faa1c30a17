"""Campaign folders for tests: copied, edited, and run through every step in the test process."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import yaml
from rasterio.transform import from_origin

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.check.examination import Examination
from apertura.check.files import check_files
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import projected_from_ecef
from apertura.core.planning.plan import Plan
from apertura.simulation import (
    CampaignSpecification,
    Framing,
    ImageGrid,
    Impairments,
    Origin,
    PointTarget,
    SimulatedFlight,
    SimulatedNode,
    Straight,
    WaveformSpecification,
)
from apertura.simulation.observation import Observation, fly
from apertura.simulation.presets import DEMO_ORIGIN
from apertura.simulation.specification import DrawnCampaign, draw_campaign
from apertura.simulation.targets import scatterers
from apertura.stages import (
    scene,
)
from apertura.stages.pair import open_pair
from apertura.stages.planning import gated, plan_pair
from apertura.views.plan import first_flight

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared" / "data"
SLOPE = np.tan(np.radians(20.0))
ALONG = np.array([np.sin(np.radians(40.0)), np.cos(np.radians(40.0))])
UPHILL = np.array([ALONG[1], -ALONG[0]]) * 0.8 + ALONG * 0.6  # away from the track and along it


def copy_writable(source: Path, target: Path) -> Path:
    """Copy a folder and make the copy writable; return it."""
    shutil.copytree(str(source), str(target), copy_function=shutil.copyfile)
    for folder in [target, *(path for path in target.rglob("*") if path.is_dir())]:
        folder.chmod(0o755)
    return target


def require_files(campaign: Campaign) -> None:
    """Raise the first problem with the files that config and flights require."""
    for problem in check_files(Examination(campaign)):
        raise problem


def expected_plan(campaign: Campaign, flight: str, pair: str) -> Plan:
    """Plan the image of a pair from its echo, or from the flight logs before the echo step has run."""
    ground = scene.expected_scene(campaign, lambda: first_flight(campaign))
    return plan_pair(campaign, gated(campaign, open_pair(campaign, flight, pair), ground), ground)


STAND_ON_ALL = frozenset({"mosaic", "map", "stac", "ro_crate"})
"""Results that depend on all images of a campaign."""


def quality_of(campaign: Campaign, pair: str) -> dict[str, Any]:
    """Return the quality measures in the image of a pair of flight f01, before the flight is assessed."""
    quality: dict[str, Any] = open_stage(campaign.stage("image", "f01", pair), "image").attrs["quality"]
    return quality


def image_of(campaign: Campaign, pair: str) -> np.ndarray:
    """Return the pixels of a pair of flight f01."""
    pixels: np.ndarray = open_stage(campaign.stage("image", "f01", pair), "image").image.values
    return pixels


def edit_config(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a campaign's config in place."""
    path = root / "config" / "config.yaml"
    document = yaml.safe_load(path.read_text())
    change(document)
    path.write_text(yaml.safe_dump(document))


def state(root: Path, section: str, **keys: object) -> Campaign:
    """Set keys of a section of a campaign's config; return the campaign."""
    edit_config(root, lambda document: document.setdefault(section, {}).update(keys))
    return Campaign.load(root)


def edit_meta(root: Path, node: str, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the SigMF metadata of a node's recording."""
    path = root / "raw" / "f01" / f"{node}.sigmf-meta"
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def edit_data(root: Path, node: str, change: Callable[[np.ndarray], object]) -> None:
    """Rewrite the samples and their hash, so that the damage is observable only in the content."""
    path = root / "raw" / "f01" / f"{node}.sigmf-data"
    samples = np.fromfile(path, "<i2")
    change(samples)
    samples.tofile(path)
    digest = hashlib.sha512(path.read_bytes()).hexdigest()
    edit_meta(root, node, lambda meta: meta["global"].update({"core:sha512": digest}))


def edit_track(root: Path, node: str, change: Callable[[list[str]], list[str]]) -> None:
    """Change the lines of a node's log."""
    path = next((root / "raw" / "f01").glob(f"{node}.track.*"))
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


def complaint(work: Callable[[], object]) -> str:
    """Return the message of the `CampaignError` that a call must raise."""
    with pytest.raises(CampaignError) as caught:
        work()
    return str(caught.value)


def small_simulation(
    *,
    framing: Framing | None = None,
    continuous: bool = False,
    secondary: Impairments | None = None,
    pulses: int = 6,
    **flight: Any,
) -> CampaignSpecification:
    """Return a specification of two nodes: a low sampling rate and pulses every 2 ms keep recordings small."""
    waveform = WaveformSpecification(64, 1.2e9 + 4567e3, 250e3, 5e-6, 2e-6, 32e6, 500.0)
    tracks = {"a": Straight((-2.0, -11.0, 5.0), (5.0, 0.0, 0.0)), "b": Straight((2.7, -11.0, 5.0), (5.0, 0.0, 0.0))}
    targets = (PointTarget((0.0, 0.0, 0.0)), PointTarget((1.0, 2.0, 0.5), 0.5))
    nodes = {
        "a": SimulatedNode({"radar_rx": (0.3, 0.0, 0.0)}),
        "b": SimulatedNode(impairments=secondary or Impairments()),
    }
    plan = SimulatedFlight("f01", "a", tracks, pulses, framing=framing, continuous=continuous, **flight)
    grid = ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.05)
    return CampaignSpecification("small", Origin(48.0, 9.0, 500.0), waveform, targets, nodes, (plan,), grid)


def recordings_of(specification: CampaignSpecification) -> tuple[dict[str, Observation], DrawnCampaign]:
    """Return the recordings of each node of the first flight, and the drawn campaign."""
    campaign = draw_campaign(specification, np.random.default_rng(1))
    standing = scatterers(specification.origin, specification.targets, np.random.default_rng(0))
    return fly(campaign, specification.flights[0], standing, np.random.default_rng(0)), campaign


def contents(root: Path) -> dict[str, bytes]:
    """Return the contents of every file below a folder."""
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def write_plane(
    root: Path,
    *,
    slope: float = SLOPE,
    height_m: float = 620.0,
    name: str = "dem.tif",
    void: float | None = None,
    keep: Any = slice(None),
) -> Path:
    """Write a DEM of the plane through the demo origin: 1 m posts, 20 m around; `keep` selects rows and columns."""
    east, north, _ = projected_from_ecef("EPSG:32632", DEMO_ORIGIN.ecef(np.zeros(3)))
    west, top = np.floor(east) - 20, np.ceil(north) + 20
    x, y = np.meshgrid(west + 0.5 + np.arange(40), top - 0.5 - np.arange(40))
    heights = height_m + slope * ((x - east) * UPHILL[0] + (y - north) * UPHILL[1])
    if void is not None:
        heights[20, 20] = void
    down, right = keep if isinstance(keep, tuple) else (keep, keep)
    heights, corner = heights[down, right], (west + (right.start or 0), top - (down.start or 0))
    with rasterio.open(
        root / name, "w", "GTiff", width=heights.shape[1], height=heights.shape[0], count=1, dtype="float64",
        crs="EPSG:32632", transform=from_origin(*corner, 1, 1),
    ) as raster:  # fmt: skip
        raster.write(heights, 1)
    return root / name


def snakemake(campaign: Path, *options: str, **popen: Any) -> subprocess.Popen[str]:
    """Start Snakemake itself on a campaign, without `apertura run`."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    command = [sys.executable, "-m", "snakemake", "--directory", str(campaign), "--cores", "2", *options]
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **popen
    )


def finished(process: subprocess.Popen[str], timeout: float = 600) -> tuple[int, str]:
    """Wait for a process; return its exit status and its output."""
    output, _ = process.communicate(timeout=timeout)
    return process.returncode, output


def apertura(*words: object, **popen: Any) -> subprocess.Popen[str]:
    """Start the command line in a separate process."""
    command = [str(Path(sys.executable).parent / "apertura"), *map(str, words)]
    return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **popen)
