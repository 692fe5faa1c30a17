"""Transfer functions computed on reading are equal to those stored in a stage, for any reader and any order."""

from dataclasses import replace

import numpy as np
import pytest
from folders import complaint, contents, copy_writable, state

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.demodulate import remove_path
from apertura.core.echo.transfer import Demodulator, transfer_by_sidelink
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.range_profiles import CompressionError, range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.run.process import process
from apertura.simulation import ImageGrid, preset, simulate
from apertura.simulation.impairments import Clock
from apertura.stages import echo, transfer
from apertura.stages.acquisition import open_acquisition
from apertura.stages.transfer import PairEcho
from apertura.stages.transmitted import transmitted

PAIRS = "uav1-uav1", "uav1-uav2"


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    """A flight with a clock offset of the receiver that is corrected in its samples."""
    plan = replace(preset("demo", pulses=90), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    changed = {"uav2": replace(plan.nodes["uav2"].impairments, clock=Clock(cfo_hz=12e3, sfo_hz=1e3))}
    root = simulate(tmp_path_factory.mktemp("drifting") / "campaign", plan, impairments=changed, seed=5)
    process(Campaign.load(root), last="ingest")
    return root


def formed(root, tmp_path, name, **processing):
    campaign = state(copy_writable(root, tmp_path / name), "processing", autofocus=False, **processing)
    for pair in PAIRS:
        echo.echo(campaign, "f01", pair)
    return campaign


@pytest.mark.slow
@pytest.mark.parametrize("method", ["divide", "wiener", "gated", "two_parameter"])
def test_formed_and_stored_transfer_functions_are_bitwise_equal(drifting, tmp_path, method):
    campaign = formed(drifting, tmp_path, "a", sidelink=method)
    for pair in PAIRS:
        transfer.transfer(campaign, "f01", pair)
        stage, kept = PairEcho.opened(campaign, "f01", pair).stage, open_stage(kept_of(campaign, pair), "transfer")
        assert "transfer" not in open_stage(campaign.stage("echo", "f01", pair), "echo")
        np.testing.assert_array_equal(stage.transfer.values, kept.transfer.values)
        np.testing.assert_array_equal(stage.time.values, kept.time.values)
    assert stage.attrs["clock"]["corrected"], stage.attrs["clock"]
    assert stage.clock_offset.values == pytest.approx(12e3, rel=0.1)


def kept_of(campaign, pair):
    return campaign.stage("transfer", "f01", pair)


@pytest.mark.quick("divide")
@pytest.mark.parametrize("method", ["divide", "two_parameter"])
def test_stored_pulse_parameters_give_the_measured_transfer(drifting, tmp_path, method):
    """Clock, direct path and removed path are stored in the stage and read back."""
    campaign = formed(drifting, tmp_path, "a", sidelink=method)
    stage, sent = PairEcho.opened(campaign, "f01", "uav1-uav2").stage, transmitted(campaign, campaign.settings.waveform)
    rx, captures = open_acquisition(campaign, "f01", "uav2", sent), stage.capture.values
    measured = transfer_by_sidelink(
        rx.reader(["radar", "sidelink"], captures),
        Demodulator(
            lambda pulses: sent.inverses.at(stage.frame.values[pulses]), rx.numerology, sent.waveform.capture_samples
        ),
        sidelink_m=np.linalg.norm(stage.sidelink_vector.values, axis=1),
        method=method,
        accuracy_db=-60.0,
        where="here",
    )
    pulses = np.arange(64)
    delay_s = stage.path_removed.values[pulses] / SPEED_OF_LIGHT_M_S
    wanted = remove_path(measured.form(pulses), stage.frequency.values, delay_s=delay_s)
    assert measured.report["clock"]["corrected"]
    np.testing.assert_allclose(stage.transfer[pulses].values, wanted, rtol=1e-5, atol=1e-3)


@pytest.mark.slow
def test_images_from_stored_transfer_equal_those_of_recordings(drifting, tmp_path):
    """The window differs from that of the first run, and the recordings are not available."""
    results = []
    for lost in (False, True):
        campaign = formed(drifting, tmp_path, f"lost {lost}", window="none")
        for pair in PAIRS:
            transfer.transfer(campaign, "f01", pair)
        if lost:
            for path in (campaign.root / "raw/f01").glob("*.sigmf-data"):
                path.unlink()
        process(campaign, first="scene", last="terrain")
        process(campaign, first="profile", last="image")
        results.append({name: data for name, data in contents(campaign.results).items() if not name.startswith(".")})
    assert results[0] == results[1]


@pytest.mark.slow
def test_stored_transfer_of_another_echo_is_not_read(drifting, tmp_path):
    campaign = formed(drifting, tmp_path, "a")
    transfer.transfer(campaign, "f01", "uav1-uav2")
    campaign = state(campaign.root, "processing", sidelink="gated")
    echo.echo(campaign, "f01", "uav1-uav2")
    (campaign.root / "raw/f01/uav2.sigmf-data").unlink()
    stage = PairEcho.opened(campaign, "f01", "uav1-uav2").stage
    assert "uav2.sigmf-data: no such file" in complaint(lambda: stage.transfer[0].values)


@pytest.mark.slow
def test_pulses_are_returned_in_the_requested_order(drifting, tmp_path):
    transfer = PairEcho.opened(formed(drifting, tmp_path, "a"), "f01", "uav1-uav2").stage.transfer
    whole = transfer.values
    pulses = np.array([7, 3, 3, 40])
    for key in (pulses, slice(None, None, 9), slice(60, 10, -7), 5, (pulses, slice(2, 9)), (slice(3), 4)):
        # rounding of the DFT at amplitudes of 100
        np.testing.assert_allclose(transfer[key].values, whole[key], rtol=2e-6, atol=1e-4)
    assert transfer[:0].values.shape == (0, whole.shape[1])


@pytest.mark.quick("False")
@pytest.mark.parametrize("lost", [True, False])
def test_missing_or_changed_recording_is_reported_on_reading(drifting, tmp_path, lost):
    campaign = formed(drifting, tmp_path, "a")
    samples = campaign.root / "raw/f01/uav2.sigmf-data"
    stage = PairEcho.opened(campaign, "f01", "uav1-uav2").stage
    if lost:
        samples.unlink()
    else:
        samples.write_bytes(samples.read_bytes()[::-1])
    assert len(stage.time) == stage.sizes["pulse"]
    message = complaint(lambda: stage.transfer[0].values)
    assert message.startswith("raw/f01/uav2.sigmf-data") or "uav2.sigmf-data" in message
    assert ("no such file" in message) is lost
    assert ("changed since it was ingested" in message) is not lost


@pytest.mark.parametrize(("wrong_m", "least_db", "most_db"), [(0.0, -300, -120), (0.5, -30, 0)])
def test_compression_error_reveals_wrong_paths(wrong_m, least_db, most_db):
    """A path error of half a metre is a fifth of a resolution cell c/B."""
    rng = np.random.default_rng(2)
    frequency = 1.2e9 + 1e6 * np.arange(128)
    track = np.stack([np.linspace(-1, 1, 64), np.full(64, -20.0), np.full(64, 10.0)], -1)
    transfer = (rng.standard_normal((64, 128)) + 1j * rng.standard_normal((64, 128))).astype(np.complex64)
    history = PhaseHistory(transfer, frequency, np.hanning(128), np.zeros(64), Aperture(track, track))
    grid = SceneGrid("local", -5.0, 5.0, 0.5, (20, 20))
    profiles = range_compress(history, grid, FlatGround(0.0))
    error = CompressionError(np.random.default_rng(3))
    error.add(history, replace(profiles, start_m=profiles.start_m + wrong_m))
    assert least_db <= error.decibels <= most_db
