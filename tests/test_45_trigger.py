"""A recording that never stops becomes the captures a triggered recorder would have written."""

import json
from dataclasses import replace

import numpy as np
import pytest
from folders import complaint, copy_writable, edit_data, small_simulation

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.simulation import Framing, Impairments, simulate
from apertura.stages import ingest


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """The same flight recorded by a triggered and by a continuous recorder."""
    roots = {}
    for continuous in (False, True):
        plan = small_simulation(
            framing=Framing(),
            continuous=continuous,
            secondary=Impairments(sidelink_snr_db=10.0, radar_snr_db=20.0),
            pulses=12,
        )
        root = tmp_path_factory.mktemp("trigger") / str(continuous)
        roots[continuous] = Campaign.load(simulate(root, plan, seed=4))
        ingest.ingest(roots[continuous], "f01", "b")
    return roots


def raw_of(campaign):
    return open_stage(campaign.stage("raw", "f01", "b"), "raw")


def test_every_frame_of_a_continuous_recording_is_captured_with_its_number(flown):
    continuous, triggered = raw_of(flown[True]), raw_of(flown[False])
    np.testing.assert_array_equal(continuous.frame.values, triggered.frame.values)
    assert len(continuous.pulse) == 12


def test_captures_start_where_the_symbols_start(flown):
    campaign = flown[True]
    truth = json.loads((campaign.root / "truth.json").read_text())["flights"]["f01"]["nodes"]["b"]
    meta = json.loads((campaign.root / "raw/f01/b.sigmf-meta").read_text())
    begun = np.datetime64(meta["captures"][0]["core:datetime"].removesuffix("Z"), "ns")
    starts = (raw_of(campaign).time.values - begun) / np.timedelta64(1, "ns") * 32e6 / 1e9
    np.testing.assert_allclose(starts, truth["pulse_start_sample"], atol=2)


def test_duty_cycle_and_data_rate_are_reported(flown):
    report = raw_of(flown[True]).attrs["trigger"]
    assert report["captures"] == 12
    assert report["duty_cycle"] == pytest.approx(7e-6 * 500, rel=0.15)
    assert report["mean_rate_bit_s"] == pytest.approx(2 * 32e6 * 16 * report["duty_cycle"])


def test_a_recording_of_noise_alone_says_so(flown, tmp_path):
    root = copy_writable(flown[True].root, tmp_path / "noise")
    noise = np.random.default_rng(9)
    edit_data(root, "b", lambda samples: samples.__setitem__(slice(None), noise.normal(0, 300, samples.size)))
    message = complaint(lambda: ingest.ingest(Campaign.load(root), "f01", "b"))
    assert "no preamble detected in" in message
    assert "b.sigmf-data" in message


def test_a_lost_preamble_file_is_named(flown):
    campaign = flown[True]
    path = campaign.root / "raw" / "f01" / "preamble.npy"
    moved = path.rename(path.with_suffix(".away"))
    message = complaint(lambda: ingest.ingest(campaign, "f01", "b"))
    moved.rename(path)
    assert "preamble.npy: no such file" in message


def test_the_false_alarm_rate_is_a_setting(flown):
    campaign = flown[True]
    strict = replace(
        campaign,
        settings=campaign.settings.model_copy(
            update={"processing": campaign.settings.processing.model_copy(update={"false_alarms_per_s": 1e-9})}
        ),
    )
    ingest.ingest(strict, "f01", "b")
    assert raw_of(strict).attrs["trigger"]["false_alarms_per_s"] == 1e-9
