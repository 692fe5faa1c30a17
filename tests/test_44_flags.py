"""Flags of signal impairments: each is raised only beyond its threshold; each recording has one impairment."""

import json
from dataclasses import replace

import numpy as np
import pytest
from folders import complaint, copy_writable, edit_config, edit_data, quality_of

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.run.process import process
from apertura.simulation import ImageGrid, preset, simulate
from apertura.simulation.impairments import (
    Adc,
    Blockage,
    Clock,
    PhaseWalk,
    Reflection,
    Ripple,
    Spikes,
    TimeTag,
    UniformPhase,
)
from apertura.stages import echo, image, profile, refine, scene
from apertura.stages.transfer import PairEcho


def simulated(folder, node="uav2", *, pulses=40, **impairments):
    """Return an ingested tandem flight with additional impairments of one node."""
    plan = replace(preset("demo", pulses=pulses), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    changed = {node: replace(plan.nodes[node].impairments, **impairments)}
    root = simulate(folder / "campaign", plan, impairments=changed, seed=11)
    edit_config(
        root, lambda document: document.update(processing={"autofocus": False})
    )  # autofocus needs both pairs, and only one is imaged
    campaign = Campaign.load(root)
    process(campaign, last="ingest")
    return campaign


def echo_of(campaign, pair="uav1-uav2"):
    echo.echo(campaign, "f01", pair)
    return PairEcho.opened(campaign, "f01", pair).stage


@pytest.fixture(scope="module")
def _undisturbed(tmp_path_factory):
    campaign = simulated(tmp_path_factory.mktemp("undisturbed"))
    for pair in ("uav1-uav1", "uav1-uav2"):
        echo.echo(campaign, "f01", pair)
    return campaign


@pytest.fixture
def undisturbed(_undisturbed, tmp_path):
    """Return a writable copy of a flight without additional impairments, with its echo stages."""
    return Campaign.load(copy_writable(_undisturbed.root, tmp_path / "campaign"))


def test_undisturbed_flight_raises_no_flag(undisturbed):
    for pair in ("uav1-uav1", "uav1-uav2"):
        dataset = PairEcho.opened(undisturbed, "f01", pair).stage
        assert dataset.attrs["flags"] == {}
    assert dataset.attrs["sidelink"]["method"] == "divide"
    assert dataset.attrs["sidelink"]["lock_rate"] == 1.0
    assert dataset.attrs["clock"]["corrected"] is False


def test_echo_stage_reports_sidelink_clock_and_code(undisturbed):
    own, secondary = (PairEcho.opened(undisturbed, "f01", pair).stage for pair in ("uav1-uav1", "uav1-uav2"))
    assert set(secondary.attrs["sidelink"]) >= {"method", "snr_db", "echo_db", "ripple_db", "lock_rate"}
    assert secondary.attrs["sidelink"]["snr_db"] == pytest.approx(30, abs=0.5)
    assert secondary.attrs["sidelink"]["delay_residual_m"] < 5 * secondary.attrs["sidelink"]["delay_noise_m"]
    assert abs(secondary.attrs["clock"]["ppm"]) < 5 * secondary.attrs["clock"]["std_ppm"]
    assert own.attrs["code"]["carried"] is secondary.attrs["code"]["carried"] is True
    assert own.attrs["own_phase"]["second_difference_rad"] < 0.5
    assert "sidelink_delay" not in own
    assert secondary.sidelink_delay.attrs["units"] == "m"
    # trigger times scatter by 40 ns, which is 12 m of path
    assert 5 < float(secondary.sidelink_delay.std()) < 9


@pytest.mark.slow
def test_random_transmit_phase_is_flagged_in_the_monostatic_image(tmp_path):
    flags = echo_of(simulated(tmp_path, "uav1", carrier_phase=UniformPhase()), "uav1-uav1").attrs["flags"]
    assert set(flags) == {"phase_unstable"}


@pytest.mark.slow
@pytest.mark.parametrize(("peak_to_peak_db", "flagged"), [(1.5, False), (2.5, True)])
def test_ripple_that_may_be_an_echo_is_flagged_beyond_2_db(tmp_path, peak_to_peak_db, flagged):
    flags = echo_of(simulated(tmp_path, "uav1", transmit_ripple=Ripple(peak_to_peak_db, 5e-9))).attrs["flags"]
    assert ("sidelink_ripple_or_echo" in flags) is flagged


@pytest.mark.quick("4.0-True")
@pytest.mark.parametrize(("backoff_db", "flagged"), [(4.0, True), (14.0, False)])
def test_saturated_converter_is_flagged(tmp_path, backoff_db, flagged):
    campaign = simulated(tmp_path, adc=Adc(backoff_db=backoff_db))
    echo.echo(campaign, "f01", "uav1-uav2")
    opened = PairEcho.opened(campaign, "f01", "uav1-uav2")
    opened.stage.transfer.load()
    flags = opened.flags
    assert ("saturated_radar" in flags) is flagged
    assert ("saturated_sidelink" in flags) is flagged


@pytest.mark.slow
@pytest.mark.parametrize(
    ("snr_db", "method"),
    [(30.0, "divide"), (8.0, "wiener"), (-5.0, "two_parameter"), (-14.0, "two_parameter")],
)
def test_auto_chooses_the_cheapest_adequate_correction(tmp_path, snr_db, method):
    attrs = echo_of(simulated(tmp_path, sidelink_snr_db=snr_db)).attrs
    assert attrs["sidelink"]["method"] == method
    assert float(attrs["sidelink"]["reason"].split()[1]) == pytest.approx(snr_db, abs=0.5)
    assert "sidelink_noisy" not in attrs["flags"]


@pytest.mark.slow
@pytest.mark.parametrize(("snr_db", "flagged"), [(8.0, True), (12.0, False)])
def test_configured_correction_below_its_snr_limit_is_flagged(tmp_path, snr_db, flagged):
    campaign = simulated(tmp_path, sidelink_snr_db=snr_db)
    edit_config(campaign.root, lambda document: document.update(processing={"sidelink": "divide"}))
    attrs = echo_of(Campaign.load(campaign.root)).attrs
    assert attrs["sidelink"]["method"] == "divide"
    assert ("sidelink_noisy" in attrs["flags"]) is flagged


@pytest.mark.slow
@pytest.mark.parametrize(("amplitude", "flagged"), [(0.3, True), (0.03, False)])
def test_echo_in_the_sidelink_is_flagged_with_configured_division(tmp_path, amplitude, flagged):
    campaign = simulated(tmp_path, sidelink_multipath=(Reflection(excess_m=9.0, amplitude=amplitude),))
    edit_config(campaign.root, lambda document: document.update(processing={"sidelink": "divide"}))
    assert ("sidelink_echo" in echo_of(Campaign.load(campaign.root)).attrs["flags"]) is flagged


@pytest.mark.slow
def test_auto_avoids_ghosts_of_an_echo_in_the_sidelink(tmp_path):
    attrs = echo_of(simulated(tmp_path, sidelink_multipath=(Reflection(excess_m=9.0, amplitude=0.3),))).attrs
    assert attrs["sidelink"]["method"] == "two_parameter"


@pytest.mark.slow
def test_transmitter_ripple_does_not_prevent_division(tmp_path):
    attrs = echo_of(simulated(tmp_path, "uav1", transmit_ripple=Ripple(1.0, 5e-9))).attrs
    assert attrs["sidelink"]["method"] == "divide"
    assert attrs["flags"] == {}


@pytest.mark.slow
def test_pulses_without_sidelink_are_dropped_counted_and_flagged(tmp_path):
    dataset = echo_of(simulated(tmp_path, sidelink_blockage=Blockage(0.3, mean_pulses=5)))
    flag = dataset.attrs["flags"]["sidelink_lost"]
    rate = dataset.attrs["sidelink"]["lock_rate"]
    assert 0.4 < rate < 0.95
    assert int(flag.split()[0]) == round((1 - rate) * int(flag.split()[2]))
    assert len(dataset.pulse) == dataset.attrs["pulses"]["used"]
    assert len(dataset.pulse) < 38


def test_pulses_with_a_disturbed_sidelink_are_dropped_counted_and_flagged(tmp_path):
    steady = {"carrier_phase": PhaseWalk(0.5), "missed_fraction": 0.0}
    campaign = simulated(tmp_path, pulses=100, sidelink_spikes=Spikes(0.08, phase_rad=2.0), **steady)
    dataset = echo_of(campaign)
    truth = json.loads((campaign.root / "truth.json").read_text())
    struck = truth["flights"]["f01"]["nodes"]["uav2"]["sidelink_spikes"]
    assert dataset.attrs["pulses"]["reasons"] == {"sidelink_spikes": len(struck)}
    line = dataset.attrs["flags"]["sidelink_spikes"]
    assert line.startswith(f"{len(struck)} of {len(dataset.pulse) + len(struck)} pulses")
    assert f"; {len(struck)} above 1.05 rad excluded, loss by the others 0.00 dB" in line
    assert not set(dataset.capture.values) & set(struck)


@pytest.mark.slow
def test_sidelink_without_lock_is_refused(tmp_path):
    campaign = simulated(tmp_path, sidelink_snr_db=-60.0)
    message = complaint(lambda: echo.echo(campaign, "f01", "uav1-uav2"))
    assert "uav2: sidelink" in message


@pytest.mark.slow
@pytest.mark.parametrize(("ppm", "corrected"), [(8.0, True), (0.5, False)])
def test_clock_is_corrected_in_samples_only_if_significant(tmp_path, ppm, corrected):
    clock = Clock(cfo_hz=ppm * 1200.0, sfo_hz=ppm * 1024.0)
    attrs = echo_of(simulated(tmp_path, clock=clock)).attrs
    assert attrs["clock"]["corrected"] is corrected
    assert float(attrs["clock"]["reason"].split()[1]) == pytest.approx(ppm, abs=0.1)


@pytest.mark.slow
def test_wrong_code_is_flagged_in_a_monostatic_image(undisturbed):
    campaign = undisturbed
    codes = np.load(str(campaign.root / "raw" / "codes.npy"))
    assert "code_unconfirmed" not in PairEcho.opened(campaign, "f01", "uav1-uav1").stage.attrs["flags"]
    np.save(str(campaign.root / "raw" / "codes.npy"), np.random.default_rng(3).permutation(codes))
    own, secondary = (echo_of(campaign, pair).attrs for pair in ("uav1-uav1", "uav1-uav2"))
    assert "code_unconfirmed" in own["flags"]
    assert own["code"]["carried"] is secondary["code"]["carried"] is False
    assert "so this image is right" in secondary["flags"]["wrong_code"]


def swap(samples):
    pairs = samples.reshape(-1, 2)
    pairs[:] = pairs[:, ::-1].copy()


def conjugate(samples):
    np.negative(samples[1::2], out=samples[1::2])


@pytest.mark.slow
@pytest.mark.parametrize(("change", "order"), [(swap, "swapped"), (conjugate, "conjugate")])
def test_other_i_q_order_is_reported_and_configurable(undisturbed, change, order):
    campaign, pairs = undisturbed, ("uav1-uav1", "uav1-uav2")
    expected = {pair: PairEcho.opened(campaign, "f01", pair).stage.transfer.values for pair in pairs}
    for node in ("uav1", "uav2"):
        edit_data(campaign.root.real(), node, change)
    process(campaign, last="ingest")
    flags = echo_of(campaign, "uav1-uav1").attrs["flags"]
    assert "set waveform.iq to swapped if I and Q are swapped" in flags["spectrum_inverted"]
    lines = [line for text in flags.values() for line in text.split("; ")]
    assert len(set(lines)) == len(lines)
    message = complaint(lambda: echo_of(campaign, "uav1-uav2"))
    assert "the conjugate samples contain the code" in message
    edit_config(campaign.root.real(), lambda document: document["waveform"].update(iq=order))
    campaign = Campaign.load(campaign.root)
    process(campaign, last="ingest")
    for pair, transfer in expected.items():
        stage = echo_of(campaign, pair)
        assert stage.attrs["flags"] == {}
        np.testing.assert_array_equal(stage.transfer.values, transfer)


@pytest.mark.slow
@pytest.mark.parametrize(("change", "order"), [(swap, "swapped"), (conjugate, "conjugate")])
def test_i_q_order_is_configurable_per_node(undisturbed, change, order):
    campaign, pair = undisturbed, "uav1-uav2"
    expected = PairEcho.opened(campaign, "f01", pair).stage.transfer.values
    edit_data(campaign.root.real(), "uav2", change)
    process(campaign, last="ingest")
    assert "nodes.<n>.iq" in complaint(lambda: echo_of(campaign, pair))
    edit_config(campaign.root.real(), lambda document: document["nodes"]["uav2"].update(iq=order))
    campaign = Campaign.load(campaign.root)
    process(campaign, last="ingest")
    stage = echo_of(campaign, pair)
    assert stage.attrs["flags"] == {}
    np.testing.assert_array_equal(stage.transfer.values, expected)
    assert campaign.settings.iq_of("uav1") == "complex"


@pytest.mark.slow
@pytest.mark.parametrize(("offset_s", "flagged"), [(22e-3, True), (4e-3, False)])
def test_tag_offset_near_half_an_interval_is_flagged(tmp_path, offset_s, flagged):
    flags = echo_of(simulated(tmp_path, time_tag=TimeTag(offset_s=offset_s))).attrs["flags"]
    assert ("association_ambiguous" in flags) is flagged


@pytest.mark.slow
def test_flags_reach_image_json(tmp_path):
    campaign = simulated(tmp_path, adc=Adc(backoff_db=4.0))
    echo_of(campaign)
    scene.scene(campaign)
    profile.profile(campaign, "f01", "uav1-uav2")
    flags = open_stage(campaign.stage("profile", "f01", "uav1-uav2"), "profile").attrs["flags"]
    refine.refine(campaign, "f01")
    image.image(campaign, "f01", "uav1-uav2")
    report = quality_of(campaign, "uav1-uav2")
    assert report["flags"] == flags
    assert {"saturated_radar", "saturated_sidelink"} <= flags.keys()
    assert report["sidelink"]["lock_rate"] == 1.0
    assert report["clock"]["corrected"] is False


@pytest.mark.slow
def test_double_sum_meets_the_highest_configurable_accuracy(tmp_path):
    campaign = simulated(tmp_path)
    edit_config(
        campaign.root,
        lambda document: document.update(processing={"engine": "reference", "accuracy_db": -120, "autofocus": "off"}),
    )
    campaign = Campaign.load(campaign.root)
    echo.echo(campaign, "f01", "uav1-uav1")
    scene.scene(campaign)
    profile.profile(campaign, "f01", "uav1-uav1")
    refine.refine(campaign, "f01")
    image.image(campaign, "f01", "uav1-uav1", threads=2)
    report = quality_of(campaign, "uav1-uav1")
    assert report["numerical_error_db"] < -120
    assert "accuracy_not_met" not in report["flags"]
