"""Shared campaigns: the real ones beside the repository, and small simulated ones made once a session."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from apertura.campaign import Campaign
from apertura.simulation import ImageGrid, preset, simulate
from apertura.steps import cube, echo, export, image, ingest, layers, profile, scene, terrain

SHARED = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared():
    """../shared/data, where it exists."""
    if not SHARED.is_dir():
        pytest.skip("real recordings are not here: no ../shared/data beside the repository")
    return SHARED


def copy_writable(source: Path, target: Path) -> Path:
    shutil.copytree(source, target, copy_function=shutil.copyfile)
    for folder in [target, *(path for path in target.rglob("*") if path.is_dir())]:
        folder.chmod(0o755)
    return target


@pytest.fixture(scope="session")
def _tiny(tmp_path_factory):
    plan = replace(preset("demo", pulses=40), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    return simulate(tmp_path_factory.mktemp("tiny") / "campaign", plan, seed=7)


@pytest.fixture
def tiny(_tiny, tmp_path):
    """A campaign folder of 40 pulses and 60 × 60 pixels, to be spoilt at will."""
    return copy_writable(_tiny, tmp_path / "campaign")


def ground(campaign: Campaign) -> None:
    scene.scene(campaign)
    if campaign.settings.scene.dem:
        terrain.terrain(campaign)


def run_steps(root: Path, *, exports: bool = True) -> Campaign:
    """Run every step of a campaign in this process, as the workflow would."""
    campaign = Campaign.load(root)
    for flight in campaign.image_flights:
        if campaign.settings.waveform.kind == "ofdm":
            for node in flight.nodes:
                ingest.ingest(campaign, flight.name, node)
        for pair in flight.pairs:
            echo.echo(campaign, flight.name, pair)
    ground(campaign)
    for flight in campaign.image_flights:
        for pair in flight.pairs:
            profile.profile(campaign, flight.name, pair)
            image.image(campaign, flight.name, pair, threads=2)
            if exports:
                export.export(campaign, flight.name, pair)
    cube.cube(campaign)
    if exports:
        layers.layers(campaign, threads=2)
        for flight in campaign.image_flights:
            export.export_fused(campaign, flight.name)
    return campaign


@pytest.fixture(scope="session")
def finished_tiny(_tiny, tmp_path_factory):
    """The tiny campaign with all its results; read only."""
    return run_steps(copy_writable(_tiny, tmp_path_factory.mktemp("finished") / "campaign"))


@pytest.fixture(scope="session")
def finished_sample(shared, tmp_path_factory):
    """The independently made campaign-sample with all its results; read only."""
    return run_steps(copy_writable(shared / "campaign-sample", tmp_path_factory.mktemp("sample") / "campaign"))
