"""Tiles formed by workers of a dask scheduler: bytes are identical, results stay up to date, errors are one message."""

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
    """Start two workers that communicate over TCP."""
    with distributed.LocalCluster(
        2, threads_per_worker=1, processes=True, protocol="tcp", host="127.0.0.1", dashboard_address=None
    ) as running:
        yield running


@pytest.fixture
def with_scheduler(finished_tiny, tmp_path, monkeypatch):
    """Return a function that configures a scheduler address in a finished campaign and in the environment."""

    def configure(address, named=None):
        root = copy_writable(finished_tiny.root, tmp_path / "with_scheduler")
        edit_config(root, lambda document: document.setdefault("processing", {}).update(scheduler=address))
        monkeypatch.setenv(NAMED_BY, named or address)
        return Campaign.load(root)

    return configure


@pytest.mark.slow
def test_workers_of_a_scheduler_form_the_same_bytes(with_scheduler, cluster):
    campaign = with_scheduler(cluster.scheduler_address)
    folder = campaign.stage("image", "f01", "uav1-uav2")
    before = contents(folder)
    for path in (folder / "image" / "c").rglob("*"):
        if path.is_file():
            path.unlink()
    transitions = cluster.scheduler.transition_counter
    assert contents(image(campaign, "f01", "uav1-uav2")) == before
    assert cluster.scheduler.transition_counter > transitions


def test_scheduler_outdates_only_the_crate(with_scheduler):
    campaign = with_scheduler("tcp://127.0.0.1:9")
    assert set(stale_results(campaign)) == {"results/ro_crate.manifest.json"}
    assert "scheduler" not in result_of(campaign, "whole").settings["processing"]


@pytest.mark.quick("tcp://127.0.0.1:9-tcp*")
@pytest.mark.parametrize(
    ("address", "named", "expected"),
    [
        (
            "tcp://127.0.0.1:9",
            None,
            r"tcp://127.0.0.1:9: no scheduler is reachable at this address; expected a dask scheduler",
        ),
        ("tcp://nowhere.invalid:8786", None, r"tcp://nowhere.invalid:8786: no scheduler is reachable at this address"),
        ("tcp://127.0.0.1:9", "tcp://127.0.0.1:8786", r"tcp://127.0.0.1:9, but DASK_SCHEDULER_ADDRESS is tcp://127"),
    ],
)
def test_unusable_scheduler_is_reported_within_seconds(with_scheduler, address, named, expected):
    campaign = with_scheduler(address, named)
    (campaign.stage("image", "f01", "uav1-uav1") / "image" / "c" / "0" / "0").unlink()
    start_s = time.monotonic()
    message = complaint(lambda: image(campaign, "f01", "uav1-uav1"))
    assert message.startswith(f"processing.scheduler: {expected}")
    assert time.monotonic() - start_s < 15


@pytest.mark.slow
def test_scheduler_without_workers_is_reported(with_scheduler):
    address = {"host": "127.0.0.1", "port": 0, "dashboard_address": None}
    with distributed.SpecCluster(scheduler={"cls": distributed.Scheduler, "options": address}) as empty:
        campaign = with_scheduler(empty.scheduler_address)
        (campaign.stage("image", "f01", "uav1-uav1") / "image" / "c" / "0" / "0").unlink()
        assert "the scheduler has no workers" in complaint(lambda: image(campaign, "f01", "uav1-uav1"))
