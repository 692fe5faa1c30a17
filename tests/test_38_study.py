"""Studies: claims of the paper compared with computed values, losses, reduced scenes, resumable jobs."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from apertura_research import commands, sweep
from apertura_research.paper import parameters
from apertura_research.paper.claims import (
    AGREES,
    DISAGREES,
    EXPLAINED,
    MODEL,
    OWN,
    PAPER,
    UNTESTABLE,
    Claim,
    compare,
    require,
)
from apertura_research.paper.corrections import (
    clock_claims,
    corrected_claims,
    largest_range_error_cm,
    position_claims,
    swarm_claims,
    trigger_claims,
    worst_bistatic_growth,
)
from apertura_research.paper.losses import DESTROYED_DB, ERRORS, effect_claims, loss_claims
from apertura_research.paper.parameters import parameter_claims
from apertura_research.paper.resolution import simulated_table, uav_table
from apertura_research.paper_scene import (
    UNDISTURBED,
    Disturbance,
    demodulated,
    receive_pair,
    receive_undisturbed,
    reduced_scene,
    window_samples,
)
from apertura_research.point_response import (
    amplitude_db,
    coherence_factors,
    find_peaks,
    half_power_widths,
    mean_image,
    phase_history,
    range_tables,
)
from apertura_research.stability.outcomes import StabilityRow, correct
from apertura_research.stability.summary import STUDY, tolerance_of
from apertura_research.stability.sweeps import CHOICES, SWEEPS
from apertura_research.sweep import Study, crossing, part_path
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from apertura.common.errors import CampaignError
from apertura.common.tables import read_table, write_table
from apertura.core.geometry.aperture import Aperture
from apertura.simulation.impairments import Clock, Impairments, Localization, Timing, UniformPhase
from apertura.simulation.observation import observe
from apertura.simulation.synthesis import samples

pytestmark = pytest.mark.slow  # research code


def by_claim(claims):
    return {claim.claim: claim for claim in claims}


def outcome(size, loss_db, *, impairment="timing", method="none"):
    return StabilityRow(impairment, "ns", size, method, loss_db, 0.0, 0.9, 0.3, 0.07, -40.0, 1.0, method, 1, 1)


def test_derived_parameters_match_the_paper():
    rows = by_claim(parameter_claims())
    assert rows["bandwidth N·Δf"].computed == "409.6"
    assert rows["mean data rate at 100 Hz"].computed == "44.8"
    sfo = rows["SFO limit f_s(1 − 1/(1 + 1/BT))"]
    assert (sfo.paper, sfo.computed) == ("200", "199.96")
    assert rows["timing of the samples 2δR/c, δR = 2 cm"].computed == "133.4"
    differ = {"OFDM symbol T against 1/Δf", "effective chirp bandwidth B(T − Δt_max)/T, Δt_max = T_cp"}
    differ |= {"CFO of a clock error of 10 ppb", "SFO of a clock error of 10 ppb"}
    differ.add("clock error of each node at the SFO limit, ±")
    assert {name for name, row in rows.items() if row.verdict != AGREES} == differ
    assert rows["effective chirp bandwidth B(T − Δt_max)/T, Δt_max = T_cp"].verdict == UNTESTABLE


def test_printed_values_are_quoted_digit_by_digit():
    rows = by_claim([*parameter_claims(), *uav_table(pulses=60)])
    printed = {name: (row.paper, row.computed, row.verdict) for name, row in rows.items()}
    assert printed["duty cycle at 100 Hz"] == ("0.156", "0.15625", AGREES)
    assert printed["duty cycle at 20 Hz"] == ("0.031", "0.03125", AGREES)
    assert printed["mean data rate at 20 Hz"] == ("9.0", "8.96", AGREES)
    assert printed["UAV flight: ground-range width, Hann, mono"][::2] == ("58", AGREES)
    assert printed["clock error of each node at the SFO limit, ±"] == (
        "100",
        "97.64",
        EXPLAINED,  # two clocks with opposite offsets, rounded
    )
    assert printed["CFO of a clock error of 10 ppb"] == ("41", "12", EXPLAINED)
    assert printed["SFO of a clock error of 10 ppb"] == ("12", "40.96", EXPLAINED)
    assert not any("8.3" in row.paper for row in rows.values())


def test_converter_samples_the_band_without_aliasing():
    row = by_claim(parameter_claims())["upper edge of the band, sampled at 4.096 GS/s"]
    assert (row.computed, row.about, row.verdict) == ("1.609", PAPER, AGREES)  # below 2.048 GHz


def test_contradictions_of_the_paper_are_noted():
    rows = by_claim([*parameter_claims(), *uav_table(pulses=60)])
    for name in ("CFO of a clock error of 10 ppb", "UAV flight: cross-range width as printed"):
        assert "contradicts itself" in rows[name].note
        assert rows[name].verdict == EXPLAINED


def test_frequency_offset_limits_follow_from_orthogonality():
    # At the limit, the sampling clock slips by one cycle of the last subcarrier over the symbol.
    limit_hz = parameters.sfo_limit_hz(1.024e9, 409.6e6, 12.5e-6)
    slip_s = 12.5e-6 * limit_hz / (1.024e9 - limit_hz)
    assert slip_s * 409.6e6 == pytest.approx(1, rel=1e-9)
    assert 20 * np.log10(np.sinc(parameters.cfo_limit_hz(100e3) / 100e3)) == pytest.approx(-0.143, abs=1e-3)


def test_coherence_and_snr_convert_both_ways():
    for coherence in (0.3, 0.986, 0.9999):
        snr = parameters.snr_of_coherence_factor(coherence, 200)
        assert parameters.coherence_of_snr(snr, 200) == pytest.approx(coherence, rel=1e-12)
    assert parameters.coherence_of_snr(0.0, 200) == 1 / 200  # without an echo


def test_widths_of_five_targets_match_the_independent_model():
    printed, modelled = [], []
    for claim in simulated_table(pulses=150):
        (printed if claim.paper else modelled).append(claim)
    assert len(modelled) == 10
    assert [claim.claim for claim in modelled if claim.verdict != AGREES] == []
    assert [(claim.paper, claim.verdict) for claim in printed] == [("35", AGREES), ("73", AGREES), ("9", EXPLAINED)]


def test_uav_flight_widths_match_the_paper():
    rows = by_claim(uav_table(pulses=60))
    for name, width_cm in (("cross-range", 11), ("ground-range", 49)):
        row = rows[f"UAV flight: {name} width, fused, fitted segments"]
        assert float(row.computed) == pytest.approx(width_cm, rel=0.05)
        assert row.verdict == EXPLAINED  # no confirmation, because three values were fitted
        assert "by construction" in row.note
    assert rows["UAV flight: ground-range width, Hann, mono"].verdict == AGREES


def test_timing_error_shifts_a_profile_and_carrier_phase_does_not():
    shift, phase, small, magnitude = effect_claims()
    assert float(shift.computed) == pytest.approx(0.4096, rel=0.01)
    assert float(phase.computed) == pytest.approx(0.2, abs=0.005)  # 1.2 cycles
    assert float(small.computed) < 0.25
    assert float(magnitude.computed) < -90
    assert {claim.verdict for claim in (shift, phase, small, magnitude)} == {AGREES}


def test_errors_along_the_sidelink_cancel_only_if_common_to_both_nodes():
    claim = position_claims(draws=1)[-1]
    assert (claim.about, claim.verdict) == (PAPER, AGREES)
    alone_cm = 1 - 2.35 / np.hypot(2.35, np.hypot(15, 10))  # the sidelink path increases by 1 cm, the echo path by less
    assert f"of a single node, which the paper does not discuss, leaves {alone_cm:.2f} cm" in claim.note


def test_worst_bistatic_path_error_is_root_2_times_the_monostatic_one():
    assert worst_bistatic_growth() == pytest.approx(2 * np.sqrt(2), abs=1e-3)
    far = np.array([[0.0, 1e6, 0.0]])
    ends = np.array([[-1.0, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    worst = [ends[0] + 1e-3 * np.array([1, -1, 0]) / np.sqrt(2), ends[1] + 1e-3 * np.array([-1, -1, 0]) / np.sqrt(2)]

    def corrected_m(tx, rx):
        return float(Aperture(tx, rx).path(far)[0, 0] - np.linalg.norm(tx - rx))

    assert corrected_m(*worst) - corrected_m(*ends) == pytest.approx(2e-3 * np.sqrt(2), rel=1e-3)


def test_largest_range_error_is_that_of_a_single_pulse_and_target():
    small_cm, large_cm = (largest_range_error_cm(sigma, np.random.default_rng(1)) for sigma in (0.5, 1.0))
    assert large_cm == pytest.approx(2 * small_cm, rel=1e-3)  # one draw, scaled
    assert 2.5 < large_cm < 5.0  # maximum of about 30 independent times and five directions, in standard deviations


def test_range_error_of_a_tenth_of_a_wavelength_is_tolerable():
    tenth, bounded, equal, worst, _ = position_claims()
    assert (tenth.paper, tenth.verdict, bounded.verdict, equal.verdict) == ("2", AGREES, AGREES, EXPLAINED)
    assert -1 < float(bounded.computed) < -0.3
    assert float(worst.computed) == pytest.approx(1 / np.sqrt(2), abs=2e-3)  # 2e against at most 2√2·e
    assert worst.verdict == EXPLAINED


def test_swarm_receivers_sum_in_phase_with_gain_10_lg_n():
    efficiency, gain, *_ = swarm_claims()
    assert float(efficiency.computed) > 0.99
    assert float(gain.computed) == pytest.approx(6.02, abs=0.5)


def test_trigger_finds_every_pulse_at_its_position():
    detected, error = trigger_claims(pulses=4)
    assert (detected.computed, detected.verdict, error.verdict) == ("1", AGREES, AGREES)


@pytest.mark.parametrize(
    ("name", "size", "case"),
    [
        ("carrier_phase", 0.5, Disturbance(Impairments(carrier_phase=UniformPhase(np.pi / 2)))),
        ("timing", 0.2, Disturbance(Impairments(timing=Timing(half_width_s=0.2e-9)))),
        ("cfo", 50, Disturbance(Impairments(clock=Clock(cfo_hz=50e3)), sampled=True)),
        ("sfo", 200, ERRORS["sfo"].disturbance(200)),
    ],
)
def test_loss_of_each_error_matches_the_independent_model(name, size, case):
    error = ERRORS[name]
    scene = error.scene(600 if name in ("carrier_phase", "timing") else 150)
    targets = scene.scatterers.position_m
    peaks = [
        find_peaks(range_tables(phase_history(scene, radar), targets), targets, reach_m=error.reach_m)[1]
        for radar in (
            receive_pair(scene, disturbance, np.random.default_rng(5))[0] for disturbance in (UNDISTURBED, case)
        )
    ]
    assert amplitude_db(peaks[1] / peaks[0]).mean() == pytest.approx(error.independent_model_db[size], abs=0.5)


def test_loss_of_localization_errors_matches_the_independent_model(monkeypatch):
    error = ERRORS["localization"]
    monkeypatch.setitem(ERRORS, "localization", replace(error, independent_model_db={1: -1.24}, pulses=300))
    (claim,) = loss_claims("localization", draws=6)
    assert (claim.paper, claim.independent_model) == ("", "-1.24")
    assert claim.verdict == AGREES
    assert "tolerance ±1 dB; mean of 6 draws, spread" in claim.note


@pytest.mark.parametrize("name", ERRORS)
def test_every_row_of_the_loss_table_is_met(name):
    ignored = [claim for claim in loss_claims(name) if claim.about == PAPER]
    assert [(claim.verdict, "safely ignored" in claim.note) for claim in ignored] == [(DISAGREES, True)] * (
        name == "sfo"
    )
    claims = [claim for claim in loss_claims(name) if claim.about == MODEL]
    assert len(claims) == len(ERRORS[name].independent_model_db)
    assert [(c.claim, c.verdict) for c in claims if c.verdict != AGREES] == []
    deep = [claim for claim in claims if float(claim.independent_model) < DESTROYED_DB]
    assert all("destroyed" in claim.note for claim in deep)


def test_phase_and_timing_errors_cause_no_loss_after_correction():
    claims = corrected_claims()
    assert len(claims) == 4
    assert all(float(claim.computed) < 0.01 for claim in claims)
    assert all(claim.verdict == AGREES for claim in claims)


def test_corrected_8_ppm_clock_has_the_noise_floor_of_a_perfect_one():
    (claim,) = clock_claims(pulses=20)
    assert float(claim.computed) < 0.5
    assert "8.000 ppm" in claim.note or "7.99" in claim.note or "8.00" in claim.note


def test_loss_does_not_depend_on_the_number_of_pulses_and_subcarriers():
    # One phase error along the track, sampled by four times as many pulses or subcarriers.
    losses = []
    for pulses, subcarriers in ((150, 128), (600, 128), (150, 512)):
        scene = reduced_scene(pulses=pulses, subcarriers=subcarriers)
        targets = scene.scatterers.position_m
        radar = receive_undisturbed(scene)
        along = scene.geometry.radar_tx[:, :1] / 15
        disturbed = (radar * np.exp(1.5j * np.cos(7 * along) + 1j * along**2)).astype(np.complex64)
        histories = (phase_history(scene, transfer) for transfer in (radar, disturbed))
        clean, degraded = (find_peaks(range_tables(history, targets), targets)[1] for history in histories)
        losses.append(amplitude_db(degraded / clean))
    assert losses[0].mean() < -1.5
    assert_allclose(losses[1], losses[0], atol=0.05)
    assert_allclose(losses[2], losses[0], atol=0.05)


@pytest.mark.parametrize(
    "impairments",
    [
        Impairments(clock=Clock(2e4, 3e4), timing=Timing(offset_s=3e-9)),
        Impairments(carrier_phase=UniformPhase(), timing=Timing(offset_s=-1e-6)),
        Impairments(doppler=True, clock=Clock(cfo_hz=5e3)),
    ],
)
def test_window_samples_equal_those_of_simulated_captures(impairments):
    scene = reduced_scene(pulses=3, subcarriers=4096, rx_ahead_m=4.7, qpsk=True)
    fast = np.tile([100.0, 0.0, 0.0], (3, 1))
    geometry = replace(scene.geometry, tx_velocity=fast, rx_velocity=-fast)
    observation = observe(scene.waveform, scene.scatterers, geometry, np.random.default_rng(1), receiver=impairments)
    channel = observation.channels["radar"]
    expected = samples(channel, None)[:, 3200:13440]
    assert_allclose(window_samples(channel, None), expected, atol=1e-8 * np.abs(expected).max())


def test_demodulated_window_samples_equal_the_transfer_functions():
    scene = reduced_scene(pulses=3, subcarriers=512)
    exact, _, observation = receive_pair(scene, UNDISTURBED, np.random.default_rng(0))
    demodulated_transfer = demodulated(window_samples(observation.channels["radar"], None), scene.waveform)
    assert_allclose(demodulated_transfer, exact, atol=1e-6 * np.abs(exact).max())


def test_quantised_channel_keeps_its_scale_with_the_predicted_error():
    scene = reduced_scene(pulses=3, subcarriers=512)
    exact = receive_undisturbed(scene)
    coarse, _, _ = receive_pair(scene, Disturbance(sampled=True, quantised=True), np.random.default_rng(0))
    error = np.sqrt(np.mean(np.abs(coarse - exact) ** 2) / np.mean(np.abs(exact) ** 2))
    steps = 0.41 / (2**13 * 10 ** (-14 / 20)) * np.sqrt(512 / 1280)  # rounding error of I and Q in the band
    assert error == pytest.approx(steps, rel=0.5)


def test_peaks_widths_and_coherence_agree_with_their_definitions():
    scene = reduced_scene(pulses=150, subcarriers=128)
    targets = scene.scatterers.position_m
    single = replace(scene, scatterers=replace(scene.scatterers, position_m=targets[2:3], amplitude=np.ones(1)))
    history = phase_history(single, receive_undisturbed(single))
    tables = range_tables(history, targets[2:3])
    positions, levels = find_peaks(tables, targets[2:3] + [0.013, -0.04, 0])
    amplitude = 1 / np.linalg.norm(single.geometry.radar_tx - targets[2], axis=1) ** 2
    assert_allclose(positions[0], targets[2], atol=2e-3)
    assert levels[0] == pytest.approx(amplitude.mean(), rel=1e-3)
    expected = amplitude.sum() ** 2 / (amplitude.size * (amplitude**2).sum())
    assert coherence_factors(history, positions)[0] == pytest.approx(expected, abs=1e-3)
    ground, cross = half_power_widths(lambda pixels: mean_image(tables, pixels), positions[0])
    assert (ground, cross) == (pytest.approx(0.32, rel=0.05), pytest.approx(0.0712, rel=0.05))


def test_loss_row_is_marked_destroyed_only_if_both_values_are(monkeypatch):
    row = compare("x", -5.0, "dB", independent_model=-20.0, within=0.5, relative=False)
    assert (row.verdict, row.note) == (DISAGREES, "differs by +15 dB")
    error = ERRORS["carrier_phase"]
    expected_db = {1.0: -30.0, 0.9: 0.0}
    monkeypatch.setitem(ERRORS, "carrier_phase", replace(error, independent_model_db=expected_db, pulses=300))
    claim, other = loss_claims("carrier_phase", draws=1)
    assert (claim.verdict, other.verdict) == (AGREES, DISAGREES)
    assert claim.note.startswith("destroyed")
    assert other.note.startswith("differs")


def test_claim_states_its_reference_and_every_difference():
    own = require("x", 0.02, "dB", limit="below 0.01 dB", met=False, note="n")
    assert own == Claim("x", "", "", "0.02", "dB", OWN, DISAGREES, "required: below 0.01 dB; n")
    from_paper = require("x", 0.02, "dB", limit="below 0.01 dB", met=False, words="none", note="n")
    assert (from_paper.about, from_paper.note) == (PAPER, "the paper: none; interpreted as: below 0.01 dB; n")
    both = compare("x", 1.0, "1", paper="2.0", independent_model=1.0, within=0.1)
    assert (both.paper, both.independent_model, both.about, both.verdict) == ("2.0", "1", PAPER, DISAGREES)
    assert both.note == "differs by -50.0 %"
    known = compare("x", 1.0, "1", paper="2.0", within=0.1, reason="swapped", note="n")
    assert (known.verdict, known.note) == (EXPLAINED, "differs by -50.0 %; swapped; n")
    assert (
        compare("x", 2.0, "1", paper="2.0", within=0.1, reason="swapped").note == "differs by +0.0 %, tolerance ±10 %"
    )
    # Only values that round to the printed digits agree.
    assert [compare("x", value, "1", paper="2.0").verdict for value in (2.049, 2.06)] == [AGREES, DISAGREES]
    assert compare("x", 1.0, "1", independent_model=1.0).about == MODEL
    with pytest.raises(ValueError, match="no value of the paper or of a model"):
        compare("x", 1.0, "1", within=0.1)


def test_claims_read_back_unchanged(tmp_path):
    rows = [
        Claim("a, b", "1.0", "", "2", "dB", PAPER, DISAGREES, 'says "so"'),
        Claim("c", "", "", "3", "1", OWN, AGREES, ""),
    ]
    path = tmp_path / "deep" / "claims.csv"
    write_table(path, rows)
    assert read_table(path, Claim) == rows
    assert path.read_text().splitlines()[0] == "claim,paper,independent_model,computed,unit,about,verdict,note"
    assert list(path.parent.iterdir()) == [path]


def test_crossing_is_interpolated_between_sizes():
    sizes, losses = np.array([1.0, 2.0, 4.0, 8.0]), np.array([0.0, 0.5, 2.5, 9.0])
    assert crossing(sizes, losses, 1.0, logarithmic=False) == pytest.approx(2.5)
    assert crossing(sizes, losses, 1.0, logarithmic=True) == pytest.approx(2 * 2**0.25)
    assert crossing(sizes[::-1], losses, 1.0, logarithmic=False) == pytest.approx(3.5)
    assert crossing(sizes, losses + 5, 1.0, logarithmic=False) == 1.0
    assert np.isnan(crossing(sizes, losses, 10.0, logarithmic=True))


def test_every_impairment_of_the_simulator_is_swept():
    swept = set()
    for one_sweep in SWEEPS.values():
        receiver, perfect = one_sweep.receiver(one_sweep.sizes[-1]), Impairments()
        swept |= set(receiver)
        transmitter = one_sweep.transmitter(one_sweep.sizes[-1])
        swept |= {name for name in vars(perfect) if getattr(transmitter, name) != getattr(perfect, name)}
        swept |= {"time_tag"} if one_sweep.tagged else set()
    elsewhere = {"interference", "sidelink_spikes", "sidelink_rotor"}  # swept by benchmarks of these names
    assert swept | elsewhere == set(vars(Impairments()))


@pytest.mark.parametrize("name", SWEEPS)
def test_sizes_of_a_sweep_are_monotonic(name):
    steps = np.diff(SWEEPS[name].sizes)
    assert (steps > 0).all() or (steps < 0).all()
    assert not SWEEPS[name].logarithmic or min(SWEEPS[name].sizes) > 0


def short(monkeypatch, name, *sizes):
    monkeypatch.setitem(SWEEPS, name, replace(SWEEPS[name], sizes=sizes, draws=1, subcarriers=512))


def test_every_correction_restores_an_image_of_random_phases(monkeypatch):
    short(monkeypatch, "carrier_phase", 1.0)
    losses = {method: next(STUDY.rows(f"carrier_phase.{method}")).loss_db for method in CHOICES}
    assert losses.pop("none") > 12
    assert max(map(abs, losses.values())) < 0.05


def test_motion_during_the_pulse_has_no_effect_below_10_m_s(monkeypatch):
    monkeypatch.setitem(SWEEPS, "doppler", replace(SWEEPS["doppler"], sizes=(10.0, 3000.0), subcarriers=512))
    slow, fast = STUDY.rows("doppler.none")
    assert abs(slow.loss_db) < 0.01
    assert fast.floor_db > slow.floor_db + 8


def test_time_tag_errors_displace_the_receiver(monkeypatch):
    short(monkeypatch, "time_tag", 1.0, 100.0)
    small, large = STUDY.rows("time_tag.divide")
    assert abs(small.loss_db) < 0.1
    assert large.loss_db > 3


def test_sidelink_without_lock_is_refused(monkeypatch):
    short(monkeypatch, "sidelink_gain", -70.0)
    for method in ("divide", "auto"):
        (row,) = STUDY.rows(f"sidelink_gain.{method}")
        assert (row.chosen, row.pulses_used, row.loss_db) == ("refused", 0.0, 40.0)


def test_blocked_pulses_are_dropped_by_every_method():
    scene = reduced_scene(pulses=60, subcarriers=512, rx_ahead_m=4.7)
    sweep = SWEEPS["sidelink_blockage"]
    radar, sidelink, observation = receive_pair(scene, sweep.disturbance(0.4), np.random.default_rng(3))
    all_pulses = np.ones(60, bool)
    for method in CHOICES[1:]:
        kept, transfer, _ = correct(method, radar, sidelink, all_pulses, np.random.default_rng(4))
        assert (kept == ~observation.draw.blocked).all()
        assert len(transfer) == kept.sum() < 60
    assert correct("none", radar, sidelink, all_pulses, np.random.default_rng(4))[0].all()


def test_automatic_correction_is_within_0_2_db_of_the_best(monkeypatch):
    monkeypatch.setitem(
        SWEEPS, "sidelink_noise", replace(SWEEPS["sidelink_noise"], sizes=(30, 10, 5, 0, -10, -20), draws=1)
    )
    loss = {
        method: [abs(outcome_row.loss_db) for outcome_row in STUDY.rows(f"sidelink_noise.{method}")]
        for method in CHOICES[1:]
    }
    best = np.min([loss[method] for method in CHOICES[1:-1]], axis=0)
    assert (np.array(loss["auto"]) - best).max() < 0.2


def test_unknown_symbols_are_decided_above_the_least_snr_and_divided_below(monkeypatch):
    monkeypatch.setitem(SWEEPS, "sidelink_noise", replace(SWEEPS["sidelink_noise"], sizes=(10, 5, -20), draws=1))
    decided, divided, refused = STUDY.rows("sidelink_noise.unknown_qpsk")
    assert (decided.chosen, divided.chosen) == ("two_parameter", "divide")
    assert decided.loss_db < 0.05
    assert decided.floor_db < divided.floor_db - 10
    assert refused.pulses_used < 0.02


def test_outcomes_read_back_and_give_a_tolerance(tmp_path):
    rows = [outcome(0.1, 0.0), outcome(1.0, float("nan")), outcome(10.0, 4.0)]
    write_table(tmp_path / "a.csv", rows)
    again = read_table(tmp_path / "a.csv", StabilityRow)
    assert again[0] == rows[0]
    assert np.isnan(again[1].loss_db)
    tolerance = tolerance_of([outcome(0.1, 0.0), outcome(1.0, 0.5), outcome(10.0, 1.5)])
    assert tolerance.size_at_1_db == pytest.approx(10**0.5, rel=1e-5)
    assert np.isnan(tolerance.size_at_3_db)
    gained = tolerance_of([outcome(0.1, 0.0), outcome(1.0, -0.5), outcome(10.0, -1.5)])
    assert gained.size_at_1_db == tolerance.size_at_1_db


def test_chart_is_reproducible(tmp_path):
    for method in CHOICES:
        write_table(part_path(tmp_path, f"timing.{method}"), [outcome(s, s, method=method) for s in (0.1, 1.0, 10.0)])
    for name in ("a.png", "b.png"):
        STUDY.chart("timing", tmp_path).rename(tmp_path / name)
    assert len(read_table(tmp_path / "timing.csv", StabilityRow)) == 3 * len(CHOICES)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_claim_parts_cover_the_errors_of_the_table():
    parts = [part.removeprefix("loss_") for part in commands.PAPER_PARTS if part.startswith("loss_")]
    assert parts == list(ERRORS)


def test_study_job_is_one_command(tmp_path, monkeypatch):
    short(monkeypatch, "missed_triggers", 0.1, 0.5)
    run = CliRunner().invoke(commands.app, ["sweep", "stability", "missed_triggers.divide", "--folder", str(tmp_path)])
    assert run.exit_code == 0, run.output
    rows = read_table(part_path(tmp_path, "missed_triggers.divide"), StabilityRow)
    assert [row.size for row in rows] == [0.1, 0.5]
    assert rows[1].pulses_used < 0.7 < rows[0].pulses_used
    CliRunner().invoke(commands.app, ["paper-part", "parameters", "--folder", str(tmp_path)])
    assert len(read_table(tmp_path / "parts" / "parameters.csv", Claim)) > 10


@pytest.mark.parametrize(
    ("arguments", "listed"),
    [
        (("paper-part", "loss_x"), "loss_timing"),
        (("paper-figure", "x"), "uav_cuts"),
        (("sweep", "x", "timing.divide"), "error_atlas"),
        (("sweep", "stability", "x.divide"), "missed_triggers"),
        (("sweep", "stability", "timing.x"), "two_parameter"),
        (("chart", "stability", "x"), "missed_triggers"),
        (("summary", "autofocus"), "stability"),
    ],
)
def test_unknown_study_job_is_refused_with_the_list_of_jobs(arguments, listed):
    error = CliRunner().invoke(commands.app, arguments).exception
    assert isinstance(error, CampaignError)
    assert listed in str(error)


def test_localization_error_displaces_antennas_and_not_the_logs():
    impairments = Impairments(localization=Localization(0.02))
    scene = reduced_scene(pulses=150, subcarriers=128, rx_ahead_m=4.7)
    _, _, observation = receive_pair(scene, Disturbance(impairments, impairments), np.random.default_rng(0))
    assert np.std(observation.truth.radar_rx - scene.geometry.radar_rx) == pytest.approx(0.02, rel=0.3)


@dataclass(frozen=True)
class Square:
    size: float
    square: float


def squares(run):
    """Return a study of one part and one chart."""
    return Study(Square, {"all": ("numbers",)}, lambda _: (1.5, np.nan, 1 / 3), run, draw=lambda *_: None)


def test_killed_job_resumes_after_its_last_finished_case(tmp_path):
    tried = []

    def run(part, size):
        tried.append(size)
        if size == 1 / 3 and len(tried) == 3:
            raise KeyboardInterrupt
        return [Square(size, size**2)]

    study = squares(run)
    with pytest.raises(KeyboardInterrupt):
        study.compute("numbers", tmp_path)
    assert not part_path(tmp_path, "numbers").exists()
    path = study.compute("numbers", tmp_path)
    assert (len(tried), tried[2:]) == (4, [1 / 3, 1 / 3])
    assert repr(read_table(path, Square)) == repr(list(squares(run).rows("numbers")))
    assert [entry.name for entry in path.parent.iterdir()] == ["numbers.csv"]


def test_cases_finished_by_other_code_are_recomputed(tmp_path, monkeypatch):
    calls = []

    def run(part, size):
        calls.append(size)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return [Square(size, size)]

    study = squares(run)
    with pytest.raises(KeyboardInterrupt):
        study.compute("numbers", tmp_path)
    monkeypatch.setattr(sweep, "code_sha256", lambda _: "0" * 64)
    study.compute("numbers", tmp_path)
    assert calls.count(1.5) == 2
