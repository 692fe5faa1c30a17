"""Simulated samples, compared with independent formulations of the signal model."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apertura.simulation.continuous import Framing
from apertura.simulation.impairments import (
    Adc,
    Blockage,
    Clock,
    Impairments,
    Interferer,
    Leakage,
    Localization,
    PhaseWalk,
    Reflection,
    Ripple,
    Rotor,
    Spikes,
    Timing,
    UniformPhase,
    draw_impairments,
)
from apertura.simulation.observation import observe
from apertura.simulation.presets import paper_scene, paper_waveform
from apertura.simulation.scatterers import Paths
from apertura.simulation.synthesis import (
    Channel,
    Geometry,
    digitize,
    full_scale,
    periodic_samples,
    samples,
    transfer_functions,
)
from apertura.simulation.targets import Scatterers
from apertura.simulation.waveform import TransmitWaveform, qpsk_codes

C = 299_792_458.0


def small_waveform(carrier_is="band_start", subcarriers=200):
    codes = qpsk_codes(subcarriers, np.random.default_rng(7))
    return TransmitWaveform(codes, 1.2e9, carrier_is, 1e6, 1.25e-6, 0.25e-6, 256e6, 100.0)


def two_uavs(pulses=6):
    """Return two targets and the geometry of a transmitter and a receiver 4.7 m ahead, metres in the local frame."""
    along = np.linspace(-1.0, 1.0, pulses)
    sender = np.column_stack([along, np.zeros(pulses), np.full(pulses, 5.0)])
    receiver = sender + np.array([4.7, 0.3, 0.1])
    scatterers = Scatterers(np.array([[0.0, 11.0, 0.0], [1.5, 14.0, 0.4]]), np.array([1.0, 0.7 + 0.2j]))
    return scatterers, Geometry(sender, receiver, sender + np.array([0, 0, 0.5]), receiver)


def recovered(waveform, captures):
    """Return the transfer functions of captures from a DFT and the code."""
    window = captures[:, waveform.prefix_samples : waveform.prefix_samples + waveform.dft_samples]
    spectrum = np.fft.fft(window, axis=1) / waveform.dft_samples
    bins = np.rint(waveform.baseband_hz / waveform.subcarrier_spacing_hz).astype(int)
    return spectrum[:, bins] / waveform.codes


def by_definition(channel, pulse, count):
    """Return samples of the delayed symbol on the clock of the receiver, summed path by path."""
    waveform = channel.waveform
    rate = waveform.sample_rate_hz + channel.sfo_hz
    index = np.arange(count)
    since_start = channel.start_s[pulse] + index / rate
    total = np.zeros(count, complex)
    paths = channel.paths
    for delay, amplitude, drift in zip(
        paths.delay_s[pulse], paths.amplitude[pulse], paths.delay_rate[pulse], strict=True
    ):
        path_delay = delay + drift * since_start
        symbol_time = since_start - waveform.cyclic_prefix_s
        cycles = np.outer(symbol_time, waveform.baseband_hz) - np.outer(path_delay, waveform.frequency_hz)
        is_received = (since_start >= delay - 1e-14) & (since_start < delay + waveform.duration_s - 1e-14)
        total += amplitude * is_received * (np.exp(2j * np.pi * cycles) @ (waveform.codes * channel.response))
    oscillator = waveform.carrier_hz * channel.start_s[pulse] - channel.cfo_hz * index / rate
    return total * np.exp(1j * (2 * np.pi * oscillator + channel.phase_rad[pulse]))


@pytest.mark.quick("0-0-0-0-band_start", "50000.0--10000.0-2e-07--3e-07-band_centre")
@pytest.mark.parametrize("carrier_is", ["band_start", "band_centre"])
@pytest.mark.parametrize(
    ("sfo_hz", "cfo_hz", "drift", "start_s"),
    [(0, 0, 0, 0), (0, 0, 1e-7, 0), (5e4, 1e4, 0, 3e-9), (5e4, -1e4, 2e-7, -3e-7), (0, 0, 0, 1.1e-6)],
)
def test_samples_equal_the_definition_summed_path_by_path(carrier_is, sfo_hz, cfo_hz, drift, start_s):
    rng = np.random.default_rng(1)
    delays = rng.uniform(5e-9, 400e-9, (2, 30))
    paths = Paths(delays, rng.standard_normal((2, 30)) + 1j, drift * rng.standard_normal((2, 30)))
    channel = Channel(
        small_waveform(carrier_is),
        paths,
        np.exp(1j * rng.random(200)),
        rng.random(2),
        np.full(2, start_s),
        cfo_hz=cfo_hz,
        sfo_hz=sfo_hz,
    )
    expected = np.stack([by_definition(channel, pulse, 450) for pulse in range(2)])
    assert_allclose(samples(channel, None, count=450), expected, atol=1e-9 * abs(expected).max())


def test_recovered_phase_is_that_of_the_path_length():
    waveform = small_waveform()
    scatterers, geometry = two_uavs()
    target = Scatterers(scatterers.position_m[:1], scatterers.amplitude[:1])
    observation = observe(waveform, target, geometry, np.random.default_rng(0), receiver=Impairments())
    transfer = recovered(waveform, samples(observation.channels["radar"], None))
    path_m = np.linalg.norm(geometry.radar_tx - target.position_m, axis=1)
    path_m += np.linalg.norm(geometry.radar_rx - target.position_m, axis=1)
    expected = np.exp(-2j * np.pi * waveform.frequency_hz * path_m[:, None] / C)
    assert abs(np.angle(transfer / expected)).max() < 1e-6


def test_fast_transfer_functions_equal_the_dft_of_samples():
    waveform = small_waveform("band_centre")
    impairments = Impairments(
        carrier_phase=UniformPhase(), timing=Timing(half_width_s=20e-9), radar_ripple=Ripple(1.0, 3e-8)
    )
    observation = observe(waveform, *two_uavs(), np.random.default_rng(0), receiver=impairments)
    assert observation.channels.keys() == {"radar", "sidelink"}
    for channel in observation.channels.values():
        fast = transfer_functions(channel, None)
        assert_allclose(recovered(waveform, samples(channel, None)), fast, atol=1e-11 * abs(fast).max())


@pytest.mark.parametrize("carrier_is", ["band_start", "band_centre"])
def test_periodic_samples_are_exact_where_all_echoes_overlap(carrier_is):
    """Samples are exact from the last arrival to the first end; echoes not entirely inside the window are omitted."""
    waveform = small_waveform(carrier_is)
    impairments = Impairments(
        carrier_phase=UniformPhase(), timing=Timing(half_width_s=20e-9), clock=Clock(cfo_hz=3e4), doppler=False
    )
    observation = observe(waveform, *two_uavs(), np.random.default_rng(0), receiver=impairments)
    for channel in observation.channels.values():
        arrival = (channel.paths.delay_s - channel.start_s[:, None]) * waveform.sample_rate_hz
        first, last = int(arrival.max()) + 1, int(arrival.min() + waveform.duration_s * waveform.sample_rate_hz) - 1
        exact, fast = samples(channel, None), periodic_samples(channel, None, np.arange(6))
        assert_allclose(fast[:, first:last], exact[:, first:last], atol=3e-6 * abs(exact).max())
        late = replace(
            channel, paths=channel.paths.and_also(replace(channel.paths, delay_s=channel.paths.delay_s + 1e-6))
        )
        assert_allclose(periodic_samples(late, None, np.arange(6)), fast)


def test_periodic_synthesis_is_refused_for_a_non_periodic_symbol():
    paths = Paths(np.full((2, 1), 1e-7), np.ones((2, 1), complex), np.zeros((2, 1)))
    channel = Channel(small_waveform(), paths, np.ones(200, complex), np.zeros(2), np.zeros(2))
    for non_periodic in (
        replace(channel, sfo_hz=10.0),
        replace(channel, paths=replace(paths, delay_rate=paths.delay_s)),
    ):
        with pytest.raises(ValueError, match="requires exact synthesis"):
            periodic_samples(non_periodic, None, np.arange(2))


def test_noise_of_periodic_samples_has_the_requested_variance():
    paths = Paths(np.full((40, 1), 1e-7), np.zeros((40, 1), complex), np.zeros((40, 1)))
    channel = Channel(small_waveform(), paths, np.ones(200), np.zeros(40), np.zeros(40), noise_variance=9.0)
    noise = periodic_samples(channel, np.random.default_rng(1), np.arange(40))
    assert np.mean(np.abs(noise) ** 2) == pytest.approx(9.0, rel=0.03)


INTERFERERS = {
    "tone": Interferer(1.25e9, 10.0),
    "pulses": Interferer(1.25e9, 10.0, duration_s=1e-6, rate_hz=2e5),
    "hann pulses": Interferer(1.25e9, 10.0, duration_s=1e-6, rate_hz=2e5, envelope="hann"),
    "noise": Interferer(1.25e9, 10.0, bandwidth_hz=20e6),
}


@pytest.mark.parametrize("name", INTERFERERS)
@pytest.mark.parametrize("synthesis", [samples, periodic_samples])
def test_interference_has_the_specified_power_and_frequency(name, synthesis):
    source, count = INTERFERERS[name], 400
    paths = Paths(np.full((count, 1), 1e-7), np.zeros((count, 1), complex), np.zeros((count, 1)))
    channel = Channel(small_waveform(), paths, np.ones(200), np.zeros(count), np.zeros(count), noise_variance=1.0)
    disturbed = replace(channel, interference=((source, 50.0),))
    pulses = np.arange(count)
    added = synthesis(disturbed, np.random.default_rng(3), pulses) - synthesis(
        channel, np.random.default_rng(3), pulses
    )
    # pulses overlap a sample at a rate·duration on average; a Hann envelope has 3/8 of the power
    share = (source.rate_hz * source.duration_s if source.duration_s else 1) * (
        3 / 8 if source.envelope == "hann" else 1
    )
    assert np.mean(np.abs(added) ** 2) == pytest.approx(50.0 * share, rel=0.2)
    rate = channel.waveform.sample_rate_hz
    power = (np.abs(np.fft.fft(added, axis=1)) ** 2).sum(axis=0)
    offset_hz = np.fft.fftfreq(added.shape[1], 1 / rate) - (source.frequency_hz - channel.waveform.carrier_hz)
    near = np.abs(offset_hz) <= (source.bandwidth_hz / 2 or 3e6)
    assert power[near].sum() > 0.85 * power.sum()


def test_interference_does_not_change_the_noise():
    paths = Paths(np.full((4, 1), 1e-7), np.zeros((4, 1), complex), np.zeros((4, 1)))
    channel = Channel(small_waveform(), paths, np.ones(200), np.zeros(4), np.zeros(4), noise_variance=9.0)
    weak = replace(channel, interference=((Interferer(1.25e9, 0.0), 1e-20),))
    first, second = (samples(either, np.random.default_rng(1)) for either in (channel, weak))
    assert_allclose(first, second, atol=1e-9)


def test_sidelink_division_removes_phase_start_and_transmit_ripple_exactly():
    waveform = small_waveform()
    receiver_errors = Impairments(carrier_phase=UniformPhase(), timing=Timing(offset_s=30e-9, half_width_s=20e-9))
    transmitter_errors = Impairments(transmit_ripple=Ripple(2.0, 3e-8))

    def ratio(receiver, transmitter):
        observation = observe(
            waveform, *two_uavs(), np.random.default_rng(0), receiver=receiver, transmitter=transmitter
        )
        radar, sidelink = (
            recovered(waveform, samples(observation.channels[name], None)) for name in ("radar", "sidelink")
        )
        return radar, radar / sidelink

    clean, clean_ratio = ratio(Impairments(), Impairments())
    impaired, impaired_ratio = ratio(receiver_errors, transmitter_errors)
    assert abs(impaired / clean - 1).max() > 1
    assert_allclose(impaired_ratio, clean_ratio, rtol=1e-9)
    _, rippled = ratio(replace(receiver_errors, radar_ripple=Ripple(2.0, 3e-8)), transmitter_errors)
    assert abs(rippled / clean_ratio - 1).max() > 0.1


def test_samples_before_the_first_and_after_the_last_echo_are_zero():
    waveform = small_waveform()
    paths = Paths(np.array([[100e-9, 300e-9]]), np.ones((1, 2), complex), np.zeros((1, 2)))
    channel = Channel(waveform, paths, np.ones(200), np.zeros(1), np.zeros(1))
    captured = abs(samples(channel, None, count=600)[0])
    first, end = int(np.ceil(100e-9 * 256e6)), int(np.ceil((300e-9 + 1.5e-6) * 256e6))
    assert captured[:first].max() == 0 == captured[end:].max()
    assert captured[first] > 0 < captured[end - 1]


def test_cfo_loss_follows_the_sinc():
    waveform = small_waveform()
    _, geometry = two_uavs()
    point = Scatterers(np.array([[0.0, 11.0, 0.0]]), np.ones(1, complex))

    def matched(clock):
        observation = observe(waveform, point, geometry, np.random.default_rng(0), receiver=Impairments(clock=clock))
        channel = observation.channels["radar"]
        ideal = transfer_functions(channel, None)
        return abs((recovered(waveform, samples(channel, None)) * ideal.conj()).mean() / (abs(ideal) ** 2).mean())

    for share in (0.1, 0.3, 0.5):
        loss = 20 * np.log10(matched(Clock(cfo_hz=share * 1e6)))
        assert loss == pytest.approx(20 * np.log10(np.sinc(share)), abs=0.1)


def test_sampling_clock_offset_delays_the_symbol_in_proportion_to_time():
    waveform = small_waveform()
    channel = Channel(
        waveform,
        Paths(np.array([[50e-9]]), np.ones((1, 1), complex), np.zeros((1, 1))),
        np.ones(200),
        np.zeros(1),
        np.zeros(1),
        sfo_hz=256e6 * 20e-6,
    )
    transfer = recovered(waveform, samples(channel, None))[0]
    ideal = transfer_functions(channel, None)[0]
    slope = np.polyfit(waveform.baseband_hz, np.unwrap(np.angle(transfer / ideal)), 1)[0]
    middle_s = waveform.cyclic_prefix_s + 0.5e-6
    assert slope == pytest.approx(-2 * np.pi * 20e-6 * middle_s, rel=0.02)


@pytest.mark.parametrize("name", ["radar", "sidelink"])
def test_subcarrier_noise_matches_the_snr(name):
    waveform = small_waveform()
    noisy = Impairments(radar_snr_db=10.0, sidelink_snr_db=10.0, sidelink_gain_db=0.0)
    observation = observe(waveform, *two_uavs(200), np.random.default_rng(0), receiver=noisy)
    channel = observation.channels[name]
    clean = recovered(waveform, samples(channel, None))
    error = recovered(waveform, samples(channel, observation.noise[name])) - clean
    snr_db = 10 * np.log10((abs(clean) ** 2).mean() / (abs(error) ** 2).mean())
    assert snr_db == pytest.approx(10.0, abs=0.1)


def test_quantisation_noise_falls_by_6_02_db_per_bit():
    waveform = small_waveform()
    observation = observe(waveform, *two_uavs(20), np.random.default_rng(0), receiver=Impairments())
    clean = samples(observation.channels["radar"], None)[:, 30:]
    levels_db = []
    for bits in (8, 10, 12):
        adc = Adc(bits, backoff_db=14.0)
        scale = full_scale(observation.channels["radar"], adc)
        counts = digitize(clean, adc, scale).astype(float)
        error = (counts[..., 0] + 1j * counts[..., 1]) * scale / 2 ** (bits - 1) - clean
        levels_db.append(10 * np.log10((abs(error) ** 2).mean() / scale**2))
    uniform_db = 10 * np.log10(2 / 12) - 20 * np.log10(2.0) * (np.array([8, 10, 12]) - 1)
    assert_allclose(levels_db, uniform_db, atol=0.1)
    assert_allclose(np.diff(levels_db), -2 * 6.02, atol=0.1)


def test_too_little_backoff_clips_at_full_scale():
    waveform = small_waveform()
    observation = observe(waveform, *two_uavs(20), np.random.default_rng(0), receiver=Impairments())
    clean = samples(observation.channels["radar"], None)
    for backoff_db, clips in ((14.0, False), (3.0, True)):
        adc = Adc(14, backoff_db)
        counts = digitize(clean, adc, full_scale(observation.channels["radar"], adc))
        assert ((counts == 8191) | (counts == -8192)).any() == clips
        assert counts.max() <= 8191
        assert counts.min() >= -8192


def test_rms_is_below_full_scale_by_the_backoff():
    waveform = small_waveform()
    noisy = Impairments(radar_snr_db=3.0, leakage=Leakage(10.0))
    observation = observe(waveform, *two_uavs(50), np.random.default_rng(0), receiver=noisy)
    adc = Adc(14, 14.0)
    clean = samples(observation.channels["radar"], observation.noise["radar"])[:, 64:320]
    counts = digitize(clean, adc, full_scale(observation.channels["radar"], adc)).astype(float)
    assert 20 * np.log10(counts.std() / 8192) == pytest.approx(-14.0, abs=0.1)


def profile_db(transfer):
    power = abs(np.fft.ifft(transfer[0], 4096)) ** 2
    return 10 * np.log10(power / power.max())


def test_sidelink_reflection_and_leakage_have_the_set_path_and_level():
    waveform = small_waveform()
    impairments = Impairments(sidelink_multipath=(Reflection(12.0, 0.1),), leakage=Leakage(20.0, 9.0))
    observation = observe(waveform, *two_uavs(1), np.random.default_rng(0), receiver=impairments)
    cell_m = C / 1e6 / 4096
    sidelink = profile_db(transfer_functions(observation.channels["sidelink"], None))
    assert sidelink[int(np.argmax(sidelink)) + round(12.0 / cell_m)] == pytest.approx(-20.0, abs=1.0)
    radar = profile_db(transfer_functions(observation.channels["radar"], None))
    leak_m = np.linalg.norm([4.7, 0.3, 0.1]) + 9.0
    assert np.argmax(radar) * cell_m == pytest.approx(leak_m, abs=0.3)


def test_drawn_impairments_have_the_requested_statistics():
    time_s = np.arange(20000) / 100
    impairments = Impairments(
        carrier_phase=PhaseWalk(0.5),
        timing=Timing(1e-9, 3e-9, 2.0),
        missed_fraction=0.1,
        sidelink_blockage=Blockage(0.2, mean_pulses=8.0),
        localization=Localization(0.02, window_s=1.0),
    )
    drawn = draw_impairments(impairments, time_s, 1e9, np.random.default_rng(0))
    assert 1 - drawn.kept.mean() == pytest.approx(0.1, abs=0.01)
    assert np.diff(drawn.phase_rad).std() == pytest.approx(0.5 / np.sqrt(100), rel=0.03)
    assert drawn.start_s.mean() == pytest.approx(1e-9, abs=0.1e-9)
    assert drawn.start_s.std() == pytest.approx(np.hypot(3e-9 / np.sqrt(3), 2e-9 * np.hypot(1, 0.144)), rel=0.03)
    bursts = np.count_nonzero(np.diff(drawn.blocked.astype(int)) == 1)
    assert drawn.blocked.mean() == pytest.approx(0.2, abs=0.03)
    assert drawn.blocked.sum() / bursts == pytest.approx(8.0, rel=0.15)
    assert drawn.position_error_m.std(axis=0) == pytest.approx(np.full(3, 0.02), rel=0.1)
    neighbours = np.corrcoef(drawn.position_error_m[:-50, 0], drawn.position_error_m[50:, 0])[0, 1]
    assert neighbours == pytest.approx(0.5, abs=0.1)  # half of the averaging window is shared


def test_enabling_one_impairment_leaves_the_others_unchanged():
    time_s = np.arange(100) / 10
    few = Impairments(missed_fraction=0.3, timing=Timing(half_width_s=1e-9))
    more = replace(few, carrier_phase=UniformPhase(), localization=Localization(0.1), sidelink_blockage=Blockage(0.3))
    more = replace(more, sidelink_spikes=Spikes(0.5, phase_rad=1.0, level_db=-10.0), sidelink_rotor=Rotor(30.0, -10.0))
    first, second = (
        draw_impairments(impairments, time_s, 1e9, np.random.default_rng(3)) for impairments in (few, more)
    )
    assert (first.kept == second.kept).all()
    assert (first.start_s == second.start_s).all()
    assert second.phase_rad.std() > 1
    assert not first.sidelink_error_rad.any()
    assert second.sidelink_error_rad.std() > 0.3


def test_localization_error_displaces_only_the_listed_antennas():
    impairments = Impairments(localization=Localization(0.05, points=("radar_rx",)))
    scatterers, logged = two_uavs()
    observation = observe(
        small_waveform(), scatterers, logged, np.random.default_rng(0), receiver=impairments, transmitter=Impairments()
    )
    assert_allclose(logged.radar_rx - observation.truth.radar_rx, observation.draw.position_error_m, atol=1e-12)
    assert (observation.truth.sidelink_rx == logged.sidelink_rx).all()
    assert (observation.truth.radar_tx == logged.radar_tx).all()


def test_doppler_rotates_the_phase_within_the_pulse():
    waveform = small_waveform()
    scatterers, geometry = two_uavs()
    target = Scatterers(scatterers.position_m[:1], scatterers.amplitude[:1])
    fast = replace(geometry, tx_velocity=np.tile([0, 200.0, 0], (6, 1)), rx_velocity=np.tile([0, 200.0, 0], (6, 1)))
    still, moving = (
        samples(
            observe(waveform, target, fast, np.random.default_rng(0), receiver=Impairments(doppler=on)).channels[
                "radar"
            ],
            None,
        )[0, 60:380]
        for on in (False, True)
    )
    phase = np.unwrap(np.angle(moving / still))
    rate_rad_s = np.polyfit(np.arange(320) / 256e6, phase, 1, w=abs(still))[0]
    sight = [(geometry.radar_tx - target.position_m)[0], (geometry.radar_rx - target.position_m)[0]]
    closing = sum(200.0 * line[1] / np.linalg.norm(line) for line in sight)
    middle_hz = 1.2e9 + 100e6
    assert rate_rad_s == pytest.approx(-2 * np.pi * middle_hz * closing / C, rel=0.02)


@pytest.mark.parametrize(
    ("impairments", "loss_db"),
    [
        (Impairments(carrier_phase=UniformPhase(np.pi / 4)), -0.92),
        (Impairments(carrier_phase=UniformPhase(np.pi / 2)), -3.96),
        (Impairments(timing=Timing(half_width_s=0.1e-9)), -1.18),
        (Impairments(timing=Timing(half_width_s=0.2e-9)), -5.2),
    ],
)
def test_uncorrected_loss_equals_that_of_an_independent_model(impairments, loss_db):
    scatterers, geometry = paper_scene(pulses=600)
    waveform = replace(
        paper_waveform(), codes=paper_waveform().codes[::64], subcarrier_spacing_hz=6.4e6, sample_rate_hz=1.024e9
    )
    clean, impaired = (
        transfer_functions(
            observe(
                waveform, scatterers, geometry, np.random.default_rng(2), receiver=receiver, sidelink=False
            ).channels["radar"],
            None,
        )
        for receiver in (Impairments(), impairments)
    )
    losses = []
    for point in scatterers.position_m:
        path_m = 2 * np.linalg.norm(geometry.radar_tx - point, axis=1)
        steering = np.exp(2j * np.pi * waveform.frequency_hz * path_m[:, None] / C)
        losses.append(20 * np.log10(abs((impaired * steering).sum()) / abs((clean * steering).sum())))
    assert np.mean(losses) == pytest.approx(loss_db, abs=0.5)


def test_frame_counter_wraps_and_its_complement_follows():
    framing = Framing(register_bits=5, counter_bits=4, bit_chips=3)
    assert (framing.payload(17) == framing.payload(1)).all()
    first, second = framing.payload(5)[::3].reshape(2, 4)
    assert (first == [-1, 1, -1, 1]).all()
    assert (second == -first).all()


def test_preamble_autocorrelation_has_one_peak():
    chips = Framing(register_bits=7).preamble().astype(float)
    circular = np.fft.ifft(abs(np.fft.fft(chips)) ** 2).real
    assert circular[0] == pytest.approx(127)
    assert_allclose(circular[1:], -1, atol=1e-9)
