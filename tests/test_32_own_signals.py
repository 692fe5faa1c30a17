"""Signals of the radar that are not interference: spectral lines of pulses and noise amplified by their filters."""

import numpy as np
import pytest

from apertura.campaign.config import PulseWaveform
from apertura.common.flags import Flags
from apertura.core.echo.captures import runs, sampled_pulses
from apertura.core.echo.interference import Interference, PulsedInterference, noise_peaks
from apertura.core.echo.transfer import Demodulator, noise_statistics, transfer_by_code, transfer_by_sidelink
from apertura.simulation.waveform import pulse_samples
from apertura.stages.transmitted import transmitted_pulse

RATE, CARRIER_HZ, PULSES = 256e6, 2.4e9, 400
TIMES = {"lead_s": 0.2e-6, "pulse_s": 1e-6, "listen_s": 0.6e-6}
LENGTH = round(1.8e-6 * RATE)


def pulse_of(name, seed):
    """Return the samples of a pulse of 1 µs."""
    if name == "code":
        return np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], 128), 2).astype(complex)
    bandwidth_hz = 200e6 if name == "chirp" else 128e6
    return pulse_samples(name, bandwidth_hz=bandwidth_hz, pulse_s=1e-6, sample_rate_hz=RATE)


def recorded(pulse, *, snr_db, seed, sidelink, coupling, tone_db=None):
    """Return I and Q of the channels: moving points, coupling and noise; a direct path; and a tone in the radar.

    Powers are relative to the noise of the samples: of the strongest echo, and of the tone.
    """
    rng = np.random.default_rng(seed)
    spectrum, frequency = np.fft.fft(pulse, 4 * LENGTH), np.fft.fftfreq(4 * LENGTH, 1 / RATE)
    delay_s = rng.uniform(0.2e-6, 0.4e-6, 5) + 1e-11 * np.arange(PULSES)[:, None] * rng.uniform(-1, 1, 5)
    trigger_s, turn = (rng.normal(0, 3e-9, (PULSES, 1)), rng.random((PULSES, 1))) if sidelink else np.zeros((2, 1, 1))
    common = spectrum * np.exp(-2j * np.pi * (frequency * (TIMES["lead_s"] + trigger_s) + turn))
    echo = coupling * np.exp(-2j * np.pi * frequency * 2e-8) + sum(
        level * np.exp(-2j * np.pi * (CARRIER_HZ + frequency) * delay_s[:, [point]])
        for point, level in enumerate((1.0, 0.9, 0.8, 0.7, 0.9))
    )
    channels = {"radar": np.fft.ifft(common * echo)[:, :LENGTH]}
    if sidelink:
        channels["sidelink"] = 3 * np.fft.ifft(common * np.exp(-2j * np.pi * frequency * 3e-8))[:, :LENGTH]
    if tone_db is not None:
        turns = 31.4e6 * np.arange(LENGTH) / RATE + rng.random((PULSES, 1))
        channels["radar"] += 10 ** ((tone_db - snr_db) / 20) * np.exp(2j * np.pi * turns)
    noise = 10 ** (-snr_db / 20) / np.sqrt(2)
    return {
        name: (np.stack([samples.real, samples.imag], -1) + rng.normal(0, noise, (PULSES, LENGTH, 2))).astype(
            np.float32
        )
        for name, samples in channels.items()
    }


def received(pulse, *, requested="auto", sidelink=False, snr_db=3.0, seed=1, coupling=0.0, tone_db=None):
    """Return flags of interference, and transfer functions before and after its removal."""
    settings = {"carrier_hz": CARRIER_HZ, "sample_rate_hz": RATE, "prf_hz": 200.0, "pulse": "pulse.npy", **TIMES}
    sent = transmitted_pulse(pulse, PulseWaveform(kind="samples", filter=requested, **settings), where="pulse")
    iq = recorded(pulse, snr_db=snr_db, seed=seed, sidelink=sidelink, coupling=coupling, tone_db=tone_db)

    def read(captures):
        return {name: samples[captures] for name, samples in iq.items()}

    inverse = sent.inverses.at(np.zeros(1, np.int64))
    demodulator = Demodulator(lambda _: inverse, sent.numerology, LENGTH, spectrum=sent.spectrum)
    every, frequency = np.arange(PULSES), sent.numerology.frequency_hz

    def transfer_of(demodulator):
        if sidelink:
            arguments = {"sidelink_m": np.zeros(PULSES), "method": "auto", "accuracy_db": -40.0, "where": "test"}
            return transfer_by_sidelink(read, demodulator, **arguments)
        return transfer_by_code(read, demodulator, time_s=every / 200.0)

    plain = transfer_of(demodulator)
    expected, peak = noise_statistics(read, demodulator, every, plain.correction)
    groups, weight = sampled_pulses(PULSES), np.full(len(frequency), 1 / len(frequency))

    def lines_in(transfer):
        joined = runs(groups, [transfer[group] for group in groups])
        return Interference.measured(joined, frequency, weight, expected=expected)

    before = plain.form(every)
    cleaning = demodulator.without_tones()
    for channel in cleaning.tones.values():
        channel.lines = tuple(lines_in(before).lines)
    measured = transfer_of(cleaning)
    after = measured.form(every)
    found = lines_in(after)
    if found.is_removed:
        after, weight = after * found.gain, weight * found.gain
    pulsed = PulsedInterference.measured([after], frequency, weight, noise_peak=peak)
    of_tones, of_pulses = cleaning.tones["radar"].flags("interference"), pulsed.flags if pulsed else {}
    flags = Flags.merged(measured.flags, of_tones, found.flags, of_pulses)
    after = pulsed.removed(after) if pulsed else after
    return {name for name in flags if name.startswith("interference")}, before, after


PULSE_NAMES = ["code", "chirp", "pn", "golay"]


@pytest.mark.quick("auto-False-code", "auto-True-code", "auto-True-chirp")
@pytest.mark.parametrize("name", PULSE_NAMES)
@pytest.mark.parametrize("sidelink", [False, True])
@pytest.mark.parametrize("requested", ["auto", "matched", "inverse"])
def test_pulses_of_the_radar_are_not_taken_for_interference(requested, sidelink, name):
    flags, before, after = received(pulse_of(name, 5), requested=requested, sidelink=sidelink)
    assert flags == set()
    np.testing.assert_array_equal(after, before)


@pytest.mark.parametrize("level_db", [-10, 10, 30])
@pytest.mark.parametrize("name", ["code", "chirp"])
def test_tone_is_found_beside_the_lines_of_a_pulse(name, level_db):
    """Relative to the noise of the samples, a tone of -10 dB is 17 dB above the noise in its frequency bin."""
    assert "interference" in received(pulse_of(name, 5), tone_db=level_db)[0]
    assert "interference" in received(pulse_of(name, 5), sidelink=True, tone_db=level_db)[0]


def test_noise_of_a_division_by_a_weak_sidelink_has_the_stated_peak():
    """Of noise divided by a sidelink of 10 dB, a share of 2⁻²⁰ or less exceeds the raised limit of 20 medians."""
    rng = np.random.default_rng(3)
    divisor, noise = ((rng.normal(size=(2, 4000, 200)).T @ [1, 1j]).T / np.sqrt(2) for _ in range(2))
    gain = np.abs(1 / np.maximum(np.abs(1 + divisor * np.sqrt(0.1)), 0.1)) ** 2
    power = np.abs(noise) ** 2 * gain
    relative = power / np.median(power, axis=0)
    assert (relative > 20).mean() > 1e-5
    assert (relative > 20 * noise_peaks(gain)).mean() < 5e-6
