"""config/segments.tsv: the part of the track used for the image of a pair, in the echo and the plan."""

from dataclasses import replace

import numpy as np
import pytest

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.run.process import process
from apertura.simulation import preset, simulate
from apertura.stages import echo
from apertura.stages.pair import open_pair
from apertura.workflow.lineage import result_of

FIRST = np.datetime64("2025-05-14T09:30:00")
HEADING = "flight\tpair\tstart\tend\n"
# The first half second, and the last three pulses of 40 at 20 Hz; times without a zone are UTC.
LINES = (
    "f01\tuav1-uav1\t2025-05-14T09:29:00\t2025-05-14T09:30:00.51\n"
    "f01\tuav1-uav1\t2025-05-14T11:30:01.84+02:00\t2025-05-14T09:31:00\n"
)


@pytest.fixture
def cut(tiny) -> Campaign:
    (tiny / "config" / "segments.tsv").write_text(HEADING + LINES)
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    return campaign


def test_echo_contains_the_pulses_inside_the_segments_of_its_pair(cut):
    stage = open_stage(echo.echo(cut, "f01", "uav1-uav1"), "echo")
    since_s = (stage.time.values - FIRST) / np.timedelta64(1, "s")
    recorded = open_stage(cut.stage("raw", "f01", "uav1"), "raw").time.values
    expected = (recorded - FIRST) / np.timedelta64(1, "s")
    expected = expected[(expected < 0.51) | (expected > 1.84)]
    np.testing.assert_allclose(since_s, expected)
    assert 10 < len(expected) < 15
    assert stage.attrs["pulses"]["used"] == len(expected)
    assert stage.attrs["pulses"]["outside_segments"] == len(recorded) - len(expected)


def test_pair_without_segment_is_imaged_from_the_whole_track(cut):
    other = open_stage(echo.echo(cut, "f01", "uav1-uav2"), "echo")
    assert other.sizes["pulse"] > 30
    assert "outside_segments" not in other.attrs["pulses"]


def test_plan_before_the_echo_counts_the_pulses_inside(cut):
    planned = open_pair(cut, "f01", "uav1-uav1").aperture
    echo.echo(cut, "f01", "uav1-uav1")
    formed = open_pair(cut, "f01", "uav1-uav1").aperture
    np.testing.assert_allclose(planned.tx_m, formed.tx_m, atol=1e-6)


def test_echo_of_a_pair_depends_only_on_its_own_segments(cut, tiny):
    own, other = (result_of(cut, "echo", "f01", pair).settings for pair in ("uav1-uav1", "uav1-uav2"))
    assert own["segments"][0] == ["2025-05-14T09:29:00", "2025-05-14T09:30:00.510000"]
    assert own["segments"][1][0] == "2025-05-14T09:30:01.840000"
    assert "segments" not in other
    (tiny / "config" / "segments.tsv").unlink()
    whole = Campaign.load(tiny)
    assert result_of(whole, "echo", "f01", "uav1-uav2").settings == other
    assert result_of(whole, "echo", "f01", "uav1-uav1").settings != own


def test_simulation_writes_the_segments_of_its_specification(tmp_path):
    plan = preset("demo", pulses=2)
    flight = replace(plan.flights[0], segments={"uav1-uav2": ((0.0, 0.05),)})
    root = simulate(tmp_path / "simulated", replace(plan, flights=(flight,)))
    (segment,) = Campaign.load(root).segments
    assert (segment.flight, segment.pair) == ("f01", "uav1-uav2")
    assert (segment.start, segment.end) == ("2025-05-14T09:30:00", "2025-05-14T09:30:00.050000")
