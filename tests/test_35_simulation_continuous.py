"""Simulated continuous recordings: frames at the true samples, noise between them."""

import json
from dataclasses import replace

import numpy as np
import pytest
import sigmf
from folders import recordings_of, small_simulation
from numpy.testing import assert_allclose

from apertura.common.errors import CampaignError
from apertura.simulation import simulate
from apertura.simulation.continuous import Framing, continuous_blocks, pulse_samples
from apertura.simulation.impairments import Adc, Clock, Impairments, TimeTag, Timing
from apertura.simulation.synthesis import full_scale, samples


def stream_of(simulation, name, **settings):
    """Return the continuous recording of a node, complex per channel, with channels, pulse times and blocks."""
    flight = simulation.flights[0]
    channels = recordings_of(simulation)[0][name].channels
    time_s = np.arange(flight.pulses) / simulation.waveform.prf_hz
    frames = {"framing": flight.framing, "first_frame": flight.first_frame}
    blocks = list(continuous_blocks(channels, time_s, Adc(16, 20.0), np.random.default_rng(0), **frames, **settings))
    counts = np.concatenate(blocks).astype(float)
    return counts[..., 0] + 1j * counts[..., 1], channels, time_s, blocks


FRAMING = Framing(register_bits=7, chip_samples=4, counter_bits=3, bit_chips=5, guard_samples=16)


def test_continuous_recording_cut_at_its_pulses_equals_the_triggered_one():
    simulation = small_simulation(framing=FRAMING, continuous=True)
    stream, channels, time_s, _ = stream_of(simulation, "a")
    triggered = samples(channels["radar"], None)
    starts = pulse_samples(channels["radar"], time_s)
    assert_allclose(starts, np.rint(starts), atol=1e-6)  # pulses of the transmitter coincide with its samples
    cut = np.stack([stream[start : start + 224, 0] for start in np.rint(starts).astype(int)])
    gain = (cut * triggered.conj()).sum() / (abs(triggered) ** 2).sum()
    assert abs(np.angle(gain)) < 1e-4
    assert_allclose(cut / gain, triggered, atol=1e-3 * abs(triggered).max())


def test_preamble_starts_at_the_true_sample_and_payload_counts_frames():
    impairments = Impairments(
        clock=Clock.of_ppm(1.0, carrier_hz=1.2e9 + 4567e3, sample_rate_hz=32e6), timing=Timing(offset_s=7e-6)
    )
    simulation = small_simulation(framing=FRAMING, continuous=True, secondary=impairments, first_frame=5)
    stream, channels, time_s, _ = stream_of(simulation, "b")
    chips = np.repeat(FRAMING.preamble().astype(float), 4)
    mixed = stream[:, 1] * np.exp(-2j * np.pi * 32 * 250e3 / 32e6 * np.arange(len(stream)))
    match = abs(np.correlate(mixed, chips))
    delay = channels["sidelink"].paths.delay_s[:, 0]
    expected = (pulse_samples(channels["sidelink"], time_s) + delay * 32e6) - FRAMING.lead_samples
    for pulse, start in enumerate(expected):
        near = slice(int(start) - 2000, int(start) + 2000)
        at = near.start + int(np.argmax(match[near]))
        assert abs(at - start) < 1
        reference = (mixed[at : at + len(chips)] * chips).sum()
        body = mixed[at + len(chips) : at + len(chips) + 6 * 20].reshape(6, 20).sum(axis=1) / reference
        bits = (body.real > 0).astype(int)
        assert (bits[:3] == 1 - bits[3:]).all()
        assert int("".join(map(str, bits[:3])), 2) == (5 + pulse) % 8


def test_continuous_recording_equals_the_definition_on_the_node_clock():
    """Oscillator and sampling clock run continuously; frames arrive at arbitrary sample phases."""
    impairments = Impairments(clock=Clock(cfo_hz=1234.0, sfo_hz=345.0), timing=Timing(offset_s=7.3e-6))
    simulation = small_simulation(framing=FRAMING, continuous=True, secondary=impairments, first_frame=5)
    stream, channels, time_s, _ = stream_of(simulation, "b")
    waveform, paths = channels["radar"].waveform, channels["radar"].paths
    rate = 32e6 + 345.0
    index = np.arange(len(stream))
    start_s = -1e-3 + 7.3e-6
    for pulse in (0, 5):
        middle = round((time_s[pulse] - start_s) * rate)
        indices = index[middle - 1800 : middle + 260]
        since_pulse_s = start_s + indices / rate - time_s[pulse]
        expected = np.zeros(len(indices), complex)
        for delay, amplitude in zip(paths.delay_s[pulse], paths.amplitude[pulse], strict=True):
            since_arrival_s = since_pulse_s - delay
            cycles = np.outer(since_arrival_s - 2e-6, waveform.baseband_hz)
            symbol = ((since_arrival_s >= 0) & (since_arrival_s < 7e-6)) * (
                np.exp(2j * np.pi * cycles) @ waveform.codes
            )
            frame = symbol + FRAMING.signal(waveform, 5 + pulse, since_arrival_s)
            expected += amplitude * np.exp(-2j * np.pi * waveform.carrier_hz * delay) * frame
        expected *= np.exp(-2j * np.pi * 1234.0 * indices / rate)
        scale = full_scale(channels["radar"], Adc(16, 20.0)) / 2**15
        assert_allclose(stream[indices, 0] * scale, expected, atol=1e-3 * abs(expected).max())


def test_block_size_does_not_change_the_samples():
    noisy = Impairments(radar_snr_db=20.0, sidelink_snr_db=20.0)
    simulation = small_simulation(framing=FRAMING, continuous=True, secondary=noisy)
    whole, _, _, blocks = stream_of(simulation, "b")
    blockwise, _, _, small_blocks = stream_of(simulation, "b", block_samples=3000)
    assert (blockwise == whole).all()
    assert max(map(len, small_blocks)) <= 3000 < max(map(len, blocks))


def test_continuous_recorder_misses_no_pulse():
    lossy = Impairments(missed_fraction=0.5)
    for continuous in (False, True):
        simulation = small_simulation(continuous=continuous, secondary=lossy, pulses=50)
        kept = recordings_of(simulation)[0]["b"].draw.kept
        assert kept.all() == continuous


def test_samples_between_frames_are_noise():
    noisy = Impairments(radar_snr_db=20.0, sidelink_snr_db=20.0)
    simulation = small_simulation(framing=FRAMING, continuous=True, secondary=noisy)
    stream, channels, _, _ = stream_of(simulation, "b")
    quiet = stream[:30000, 0]  # half an interval before the first pulse
    frame_power = (abs(stream[32000:32224, 0]) ** 2).mean()
    variance = channels["radar"].noise_variance
    echo_power = (abs(samples(channels["radar"], None)[0]) ** 2).mean()
    assert (abs(quiet) ** 2).mean() / frame_power == pytest.approx(variance / (echo_power + variance), rel=0.2)
    assert len(stream) == 6 * 64000


def test_continuous_recording_is_one_segment_with_framing_metadata(tmp_path):
    simulation = small_simulation(framing=FRAMING, continuous=True, secondary=Impairments(time_tag=TimeTag(2e-3)))
    root = simulate(tmp_path / "c", simulation, seed=0)
    recording = sigmf.fromfile(str(root / "raw/f01/b.sigmf-meta"))
    recording.validate()
    (segment,) = recording.get_captures()
    assert segment["core:datetime"] == "2025-05-14T09:30:00.001000Z"  # start: 1 ms early; tags: 2 ms late
    framing = recording.get_global_field("apertura:framing")
    chips = np.load(root / framing["preamble"])
    assert set(chips.tolist()) == {-1, 1}
    assert framing["chip_samples"] == 4
    truth = json.loads((root / "truth.json").read_text())["flights"]["f01"]["nodes"]["b"]
    assert len(truth["pulse_start_sample"]) == 6


def test_overlapping_frames_are_refused(tmp_path):
    simulation = small_simulation(framing=replace(FRAMING, register_bits=14), continuous=True)
    with pytest.raises(CampaignError, match="shorter than half a repetition interval"):
        simulate(tmp_path / "c", simulation, seed=0)
    assert not list(tmp_path.iterdir())


def test_triggered_captures_carry_the_frame_number(tmp_path):
    root = simulate(tmp_path / "c", small_simulation(framing=FRAMING, first_frame=6), seed=0)
    meta = json.loads((root / "raw/f01/b.sigmf-meta").read_text())
    assert [capture["apertura:frame"] for capture in meta["captures"]] == [6, 7, 0, 1, 2, 3]
