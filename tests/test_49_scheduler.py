"""Tiles formed by the workers of a dask scheduler: the same bytes, nothing stale, one message if it cannot be used."""

import time

import pytest
from folders import complaint, contents, copy_writable, edit_config

from apertura.campaign.folder import Campaign
from apertura.core.backprojection.tiles import NAMED_BY
from apertura.stages.image import image
from apertura.workflow.lineage import result_of
from apertura.workflow.stale import stale_results

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster():
    """Two processes that talk over TCP."""
    with distributed.LocalCluster(
        2, threads_per_worker=1, processes=True, protocol="tcp", host="127.0.0.1", dashboard_address=None
    ) as running:
        yield running


@pytest.fixture
def asking(finished_tiny, tmp_path, monkeypatch):
    """A finished campaign whose tiles are many and asked of a scheduler, which the environment names, too."""

    def ask(address, named=None):
        root = copy_writable(finished_tiny.root, tmp_path / "asking")
        edit_config(root, lambda document: document.setdefault("processing", {}).update(scheduler=address))
        monkeypatch.setenv(NAMED_BY, named or address)
        return Campaign.load(root)

    return ask


@pytest.mark.slow
def test_workers_of_a_scheduler_form_the_same_bytes(asking, cluster):
    campaign = asking(cluster.scheduler_address)
    folder = campaign.stage("image", "f01", "uav1-uav2")
    before = contents(folder)
    for path in (folder / "image" / "c").rglob("*"):
        if path.is_file():
            path.unlink()
    ran = cluster.scheduler.transition_counter
    assert contents(image(campaign, "f01", "uav1-uav2")) == before
    assert cluster.scheduler.transition_counter > ran


def test_where_tiles_are_formed_makes_nothing_stale_but_the_crate_that_names_the_config(asking):
    campaign = asking("tcp://127.0.0.1:9")
    assert set(stale_results(campaign)) == {"results/ro_crate.manifest.json"}
    assert "scheduler" not in result_of(campaign, "whole").settings["processing"]


@pytest.mark.quick("tcp://127.0.0.1:9-tcp*")
@pytest.mark.parametrize(
    ("address", "named", "expected"),
    [
        ("tcp://127.0.0.1:9", None, r"tcp://127.0.0.1:9: no scheduler is reachable there; expected a dask scheduler"),
        ("tcp://nowhere.invalid:8786", None, r"tcp://nowhere.invalid:8786: no scheduler is reachable there"),
        ("tcp://127.0.0.1:9", "tcp://127.0.0.1:8786", r"tcp://127.0.0.1:9, but DASK_SCHEDULER_ADDRESS is tcp://127"),
    ],
)
def test_a_scheduler_that_cannot_be_used_is_told_within_seconds(asking, address, named, expected):
    campaign = asking(address, named)
    (campaign.stage("image", "f01", "uav1-uav1") / "image" / "c" / "0" / "0").unlink()
    asked = time.monotonic()
    message = complaint(lambda: image(campaign, "f01", "uav1-uav1"))
    assert message.startswith(f"processing.scheduler: {expected}")
    assert time.monotonic() - asked < 15


@pytest.mark.slow
def test_a_scheduler_without_workers_is_told(asking):
    address = {"host": "127.0.0.1", "port": 0, "dashboard_address": None}
    with distributed.SpecCluster(scheduler={"cls": distributed.Scheduler, "options": address}) as empty:
        campaign = asking(empty.scheduler_address)
        (campaign.stage("image", "f01", "uav1-uav1") / "image" / "c" / "0" / "0").unlink()
        assert "the scheduler has no workers" in complaint(lambda: image(campaign, "f01", "uav1-uav1"))
