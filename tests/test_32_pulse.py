"""Single-pulse waveforms: captures are linear convolutions, which one DFT of the capture length inverts."""

import numpy as np
import pytest
import yaml

from apertura.campaign.config import PulseWaveform, validated
from apertura.campaign.folder import Campaign
from apertura.common.errors import CampaignError
from apertura.core.echo.captures import blocks_of
from apertura.core.echo.demodulate import Numerology, demodulate
from apertura.core.echo.frame_codes import Inverses
from apertura.core.echo.pulse_filter import occupied_band, pulse_filter, pulse_spectrum, truncation_flags
from apertura.core.echo.transfer import Demodulator, transfer_by_sidelink
from apertura.simulation.scatterers import Paths
from apertura.simulation.synthesis import Channel, samples
from apertura.simulation.waveform import TransmitPulse, pulse_samples
from apertura.stages.transmitted import read_pulse, transmitted

RATE = 256e6
SIZES = {"bandwidth_hz": 128e6, "pulse_s": 2e-6, "sample_rate_hz": RATE}
NAMES = ["chirp", "pn", "golay"]
HALF_BAND = 0.25  # of the sampled band: occupied by codes of two samples per chip and by a chirp over half the rate
LENGTH = 900


def numerology_of(numbers, longest):
    return Numerology(1.2e9, RATE, numbers, 0, LENGTH, longest)


def middle_band(length=LENGTH, share=HALF_BAND):
    half = int(share * length)
    return np.arange(-half, half + 1)


def delayed(pulse, delay_samples, lead=0.0, *, carrier_hz=1.2e9, length=LENGTH):
    """Return a capture of one echo by definition: a sum of band-limited interpolation functions."""
    time = np.arange(length)[:, None] - np.arange(len(pulse)) - delay_samples - lead
    return (np.sinc(time) @ pulse) * np.exp(-2j * np.pi * carrier_hz * delay_samples / RATE)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("lead", [0, 33.25])
def test_capture_spectrum_over_pulse_spectrum_gives_delays(name, lead):
    """H_k = Y_k/S_k: amplitude and phase of each path at f = carrier + k·f_s/L, for any start of the capture."""
    pulse = pulse_samples(name, **SIZES)
    numbers = middle_band()
    numerology = numerology_of(numbers, LENGTH - len(pulse) - 34)
    delays, levels = (12.0, 200.4), (1.0, 0.5j)
    capture = sum(level * delayed(pulse, delay, lead) for delay, level in zip(delays, levels, strict=True))
    spectrum = pulse_spectrum(pulse, lead=lead, length=LENGTH)[numbers % LENGTH]
    measured = demodulate(capture[None].astype(np.complex64), numerology)[0] / spectrum
    expected = sum(
        level * np.exp(-2j * np.pi * numerology.frequency_hz * delay / RATE)
        for delay, level in zip(delays, levels, strict=True)
    )
    strong = np.abs(spectrum) > 0.3 * np.sqrt(np.mean(np.abs(spectrum) ** 2))
    assert strong.mean() > 0.8
    assert np.abs(measured - expected)[strong].max() < 0.02


def test_truncated_echo_is_inexact():
    pulse = pulse_samples("chirp", **SIZES)
    numbers = middle_band()
    spectrum = pulse_spectrum(pulse, lead=0, length=LENGTH)[numbers % LENGTH]
    errors = []
    for delay in (LENGTH - len(pulse), LENGTH - len(pulse) + 100):
        capture = delayed(pulse, delay)[None].astype(np.complex64)
        measured = demodulate(capture, numerology_of(numbers, 0))[0] / spectrum
        expected = np.exp(-2j * np.pi * numerology_of(numbers, 0).frequency_hz * delay / RATE)
        errors.append(np.sqrt(np.mean(np.abs(measured - expected) ** 2)))
    assert errors[0] < 0.03
    assert errors[1] > 0.3


@pytest.mark.parametrize("name", NAMES)
def test_simulated_captures_are_delayed_pulses(name):
    pulse = pulse_samples(name, **SIZES)
    wave = TransmitPulse.of(
        pulse, carrier_hz=1.2e9, sample_rate_hz=RATE, prf_hz=1e3, lead_s=0.1e-6, listen_s=1e-6, band_hz=(-64e6, 64e6)
    )
    delays = np.array([[20.3, 150.0, 5000.0, -2000.0]])
    paths = Paths(delays / RATE, np.array([[1.0, 0.3j, 1.0, 1.0]]), np.zeros((1, 4)))
    channel = Channel(wave, paths, np.ones(len(wave.codes)), np.zeros(1), np.zeros(1))
    expected = sum(
        level * delayed(pulse, delay, 25.6, length=wave.capture_samples)
        # echoes after the capture or before it are not recorded
        for delay, level in (
            (20.3, 1.0),
            (150.0, 0.3j),
        )
    )
    assert np.abs(samples(channel, None)[0] - expected).max() < 0.01
    carried = samples(
        Channel(wave, paths.at(slice(None)), np.ones(len(wave.codes)), np.zeros(1), np.zeros(1), sfo_hz=1e-6), None
    )
    assert np.abs(carried[0] - expected).max() < 0.01  # simulated by the method for clock offsets


@pytest.mark.parametrize(("name", "widest"), [("chirp", 0.26), ("pn", 0.48), ("golay", 0.48)])
def test_default_band_is_that_of_the_pulse(name, widest):
    pulse = pulse_samples(name, **SIZES)
    first, last = occupied_band(np.abs(pulse_spectrum(pulse, lead=0, length=LENGTH)) ** 2)
    assert -widest * LENGTH < first < -0.23 * LENGTH
    assert 0.23 * LENGTH < last < widest * LENGTH


@pytest.mark.quick("inverse-chirp", "matched-golay")
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("requested", ["inverse", "matched"])
def test_snr_loss_of_the_filter_is_as_reported(name, requested):
    """SNR after the filter relative to N·SNR of the matched filter."""
    pulse = pulse_samples(name, **SIZES)
    spectrum = pulse_spectrum(pulse, lead=0, length=LENGTH)[middle_band() % LENGTH]
    chosen = pulse_filter(spectrum, requested=requested)
    rng = np.random.default_rng(1)
    noise = (rng.normal(size=(4000, spectrum.size, 2)) @ [1, 1j]) / np.sqrt(2)
    best = (np.abs(spectrum) ** 2).sum()
    reached = np.abs((spectrum * chosen.inverse).sum()) ** 2 / np.mean(np.abs((noise * chosen.inverse).sum(1)) ** 2)
    assert 10 * np.log10(best / reached) == pytest.approx(chosen.report["loss_db"], abs=0.15)


@pytest.mark.parametrize("name", NAMES)
def test_inverse_has_window_and_matched_has_pulse_sidelobes(name):
    numbers = middle_band()
    spectrum = pulse_spectrum(pulse_samples(name, **SIZES), lead=0, length=LENGTH)[numbers % LENGTH]
    window = np.hanning(spectrum.size)
    highest = {}
    for requested in ("inverse", "matched"):
        response = np.abs(
            np.fft.ifft(window * spectrum * pulse_filter(spectrum, requested=requested).inverse, 16 * len(window))
        )
        highest[requested] = 20 * np.log10(response[38:-38].max() / response[0])
    assert highest["inverse"] == pytest.approx(-31.5, abs=1.5)
    if name != "chirp":
        assert highest["matched"] > -24


def test_auto_filter_depends_on_the_pulse_spectrum():
    rng = np.random.default_rng(1)
    flat = np.exp(2j * np.pi * rng.random(500))
    uneven = flat * (1 + 0.3 * np.cos(np.arange(500) / 20))
    gaps = flat * np.where(np.arange(500) % 2, 1.0, 1e-3)
    assert [pulse_filter(spectrum, requested="auto").report["filter"] for spectrum in (flat, uneven, gaps)] == [
        "matched",
        "inverse",
        "matched",
    ]
    assert pulse_filter(flat, requested="auto").flags == pulse_filter(uneven, requested="auto").flags == {}
    assert "waveform_sidelobes" in pulse_filter(gaps, requested="auto").flags
    weak = flat * np.where(np.arange(500) % 2, 1.0, 0.14)
    assert pulse_filter(weak, requested="auto").report["filter"] == "matched"
    line = pulse_filter(weak, requested="inverse").flags["waveform_noise"]
    assert (
        line == "SNR loss of the inverse filter 11.2 dB: 50% of the band is more than 10 dB below the mean of the band"
    )
    with pytest.raises(ValueError, match="no energy"):
        pulse_filter(np.zeros(8), requested="auto")


@pytest.mark.parametrize("cfo_hz", [0.0, 3e4])
def test_division_needs_no_clock_for_a_single_pulse(cfo_hz):
    """A carrier offset displaces both spectra equally; their ratio retains only 2π·CFO·(delay difference)."""
    pulse = pulse_samples("pn", **SIZES)
    numbers = middle_band()
    rotation = np.exp(-2j * np.pi * cfo_hz / RATE * np.arange(LENGTH))
    delays = {"radar": 120.3, "sidelink": 10.0}
    iq = {}
    for name, delay in delays.items():
        capture = 2000 * delayed(pulse, delay) * rotation
        iq[name] = np.stack([capture.real, capture.imag], -1).round().astype(np.int16)[None].repeat(40, 0)
    spectrum = pulse_spectrum(pulse, lead=0, length=LENGTH)[numbers % LENGTH]
    numerology = numerology_of(numbers, LENGTH - len(pulse))
    measured = transfer_by_sidelink(
        lambda pulses: {name: samples[pulses] for name, samples in iq.items()},
        Demodulator(Inverses.fixed(pulse_filter(spectrum, requested="inverse").inverse).at, numerology, LENGTH),
        sidelink_m=np.full(40, 11.7),
        method="divide",
        accuracy_db=-60.0,
        where="here",
    )
    formed = np.concatenate([measured.form(pulses) for pulses in blocks_of(np.arange(40))])[0]
    after_s = (delays["radar"] - delays["sidelink"]) / RATE
    expected = np.exp(-2j * np.pi * (numerology.frequency_hz + cfo_hz) * after_s)
    coherent = np.abs(np.vdot(expected, formed)) / np.sqrt((np.abs(formed) ** 2).sum() * formed.size)
    assert coherent > 0.998
    assert abs(np.angle(np.vdot(expected, formed))) < 0.005
    assert "clock_unmeasured" not in measured.flags
    assert measured.report["clock"]["reason"].startswith("clock offset not measurable in pulses without repetition")


def test_captures_that_truncate_the_direct_pulse_are_counted():
    durations = {"lead_s": 0.2e-6, "pulse_s": 1e-6, "listen_s": 0.5e-6, "cell_s": 2.5e-9}
    assert truncation_flags(np.array([0.0, -0.2e-6, 0.5e-6, np.nan]), **durations) == {}
    assert "2 of 3 pulses" in truncation_flags(np.array([0.0, -0.25e-6, 0.75e-6]), **durations)["pulse_truncated"]


PULSE = {
    "kind": "samples",
    "carrier_hz": 1.2e9,
    "sample_rate_hz": 256e6,
    "prf_hz": 100.0,
    "pulse_s": 1e-6,
    "listen_s": 1e-6,
}


def settings(**more):
    document = {"campaign": "c", "waveform": PULSE | more, "nodes": {"uav1": {}}}
    return validated(document, where="config.yaml")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"band_hz": [-64e6, 129e6]}, "must be ascending and within"),
        ({"band_hz": [64e6, -64e6]}, "must be ascending"),
        ({"listen_s": 0.02}, "longer than 1/prf_hz"),
        ({"filter": "wiener"}, "waveform.filter"),
        ({"pulse_s": 0.0}, "waveform.pulse_s"),
    ],
)
def test_invalid_pulse_settings_are_rejected(changed, message):
    with pytest.raises(CampaignError, match=message):
        settings(**changed)


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        (None, "no such file"),
        (np.ones(255, np.complex64), r"complex64 of shape \(255,\)"),
        (np.ones(257, np.complex64), r"complex64 of shape \(257,\)"),
        (np.ones(256), "shape"),
        (np.ones((256, 3), np.int16), "int16 of shape"),
        (np.full(256, np.nan, np.complex64), "256 samples are not finite"),
        (np.full(256, 1.5e308 * (1 + 1j)), "256 samples are not finite"),
        (np.zeros((256, 2), np.int16), "all samples are zero"),
    ],
)
def test_invalid_pulse_file_is_rejected(tmp_path, stored, message):
    path = tmp_path / "pulse.npy"
    if stored is not None:
        np.save(path, stored)
    with pytest.raises(CampaignError, match=message):
        read_pulse(path, PulseWaveform(**PULSE))


def test_integer_pairs_are_read_as_complex_samples(tmp_path):
    pulse = np.exp(1j * np.arange(256) ** 2 / 100)
    np.save(tmp_path / "one.npy", pulse.astype(np.complex64))
    np.save(tmp_path / "two.npy", np.stack([pulse.real, pulse.imag], -1).__mul__(32000).round().astype(np.int16))
    one, two = (read_pulse(tmp_path / f"{name}.npy", PulseWaveform(**PULSE)) for name in ("one", "two"))
    assert np.abs(one - two).max() < 1e-4


def campaign_with(root, pulse, **waveform):
    (root / "config").mkdir()
    (root / "raw").mkdir()
    document = {"campaign": "c", "waveform": PULSE | waveform, "nodes": {"uav1": {}}}
    (root / "config" / "config.yaml").write_text(yaml.safe_dump(document))
    (root / "config" / "flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\tuav1\n")
    np.save(root / "raw" / "pulse.npy", pulse.astype(np.complex64))
    return Campaign.load(root)


def test_band_without_the_pulse_is_rejected(tmp_path):
    pulse = np.exp(1j * np.pi * 40e6 / 1e-6 * ((np.arange(256) - 128) / 256e6) ** 2)
    campaign = campaign_with(tmp_path, pulse, band_hz=[90e6, 120e6])
    with pytest.raises(CampaignError, match="of the pulse's energy in"):
        transmitted(campaign, campaign.settings.waveform)


def test_transmitted_pulse_has_its_band_and_capture_length(tmp_path):
    pulse = np.exp(1j * np.pi * 100e6 / 1e-6 * ((np.arange(256) - 128) / 256e6) ** 2)
    campaign = campaign_with(tmp_path, pulse, lead_s=0.25e-6)
    sent = transmitted(campaign, campaign.settings.waveform)
    assert sent.numerology.dft_samples == 64 + 256 + 256
    assert sent.numerology.longest_samples == 256
    assert sent.numerology.frequency_hz[[0, -1]] == pytest.approx([1.15e9, 1.25e9], abs=3e6)
    assert sent.report["filter"] == "inverse"
