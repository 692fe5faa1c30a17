"""Block processing of a flight: results do not depend on the blocks, and memory does not grow with the length."""

import tracemalloc

import numpy as np
import pytest

from apertura.core.echo import transfer
from apertura.core.echo.association import baseline_residual, detect_wrong_association
from apertura.core.echo.captures import Saturation, blocks_of, spread
from apertura.core.echo.clock import clock_of, estimate_clock
from apertura.core.echo.demodulate import Numerology, remove_path
from apertura.core.echo.frame_codes import Inverses
from apertura.core.echo.line_of_sight import fit_line_of_sight
from apertura.core.echo.sidelink_state import measure, measure_blocks
from apertura.core.echo.transfer import Demodulator, transfer_by_code, transfer_by_sidelink

NUMEROLOGY = Numerology(1.2e9, 32e6, np.arange(200), prefix_samples=64, dft_samples=256)
CODES = np.exp(2j * np.pi * np.random.default_rng(1).random(200)).astype(np.complex64)
SYMBOL = 64 + 256 + 40


def recorded(pulses, *, first=0, ppm=0.0):
    """Return captures per channel, (pulse, sample, 2) int16, of a sidelink and one echo."""
    time, frequency = np.arange(SYMBOL) / 32e6, 1.2e9 + np.arange(200) * 125e3
    waves = np.exp(2j * np.pi * np.arange(200)[:, None] * 125e3 * (time - 2e-6))
    iq = {"radar": [], "sidelink": []}
    for pulse in range(first, first + pulses):
        rng = np.random.default_rng(pulse)
        phase, late_s = rng.uniform(-np.pi, np.pi), rng.uniform(0.1e-6, 0.3e-6)
        for name, delay_s, level in (("radar", 0.5e-6 + 1e-11 * pulse, 120.0), ("sidelink", 0.05e-6, 300.0)):
            spectrum = CODES * np.exp(-2j * np.pi * frequency * (delay_s + late_s) + 1j * phase)
            signal = level / 14 * (spectrum @ waves) * np.exp(-2j * np.pi * 1.2e9 * ppm * 1e-6 * time)
            signal = signal + rng.normal(size=SYMBOL) + 1j * rng.normal(size=SYMBOL)
            iq[name].append(np.stack([signal.real, signal.imag], -1))
    return {name: np.round(blocks).astype(np.int16) for name, blocks in iq.items()}


def formed(iq, **more):
    pulses = len(iq["radar"])
    measured = transfer_by_sidelink(
        lambda pulses: {name: samples[pulses] for name, samples in iq.items()},
        Demodulator(Inverses.fixed(1 / CODES).at, NUMEROLOGY, SYMBOL),
        sidelink_m=np.full(pulses, 15.0),
        accuracy_db=-60.0,
        where="here",
        **({"method": "auto"} | more),
    )
    return measured, np.concatenate([measured.form(pulses) for pulses in blocks_of(np.flatnonzero(measured.kept))])


@pytest.mark.parametrize("method", ["divide", "wiener", "gated", "two_parameter"])
def test_transfer_functions_do_not_depend_on_block_size(method):
    iq = recorded(70)
    measured, whole = formed(iq, method=method)
    odd = np.concatenate([measured.form(pulses) for pulses in blocks_of(np.arange(70), 23)])
    np.testing.assert_array_equal(odd, whole)


def test_random_phase_and_start_of_captures_are_removed():
    """After division, the echo is delayed by 0.45 µs relative to the sidelink, increasing by 10 ps per pulse."""
    _, whole = formed(recorded(40))
    delay_s = 0.45e-6 + 1e-11 * np.arange(40)
    straight = remove_path(whole, NUMEROLOGY.frequency_hz, delay_s=delay_s)
    together = np.abs(straight.sum()) / np.abs(straight).sum()
    assert together > 0.995


def test_sidelink_state_does_not_depend_on_block_size():
    rng = np.random.default_rng(3)
    sidelink = (8 + rng.normal(size=(150, 128)) + 1j * rng.normal(size=(150, 128))).astype(np.complex64)
    in_one, in_many = (
        measure(sidelink),
        measure_blocks(lambda: ((sidelink[pulses], None) for pulses in blocks_of(np.arange(150), 31))),
    )
    np.testing.assert_array_equal(in_many.locked, in_one.locked)
    np.testing.assert_allclose(in_many.delay_cells, in_one.delay_cells, atol=1e-6)
    for name in ("snr_db", "echo_db", "ripple_db", "near_db"):
        assert getattr(in_many, name) == pytest.approx(getattr(in_one, name), abs=1e-3), name


def test_wrong_code_is_detected_across_blocks():
    """Neighbouring pulses agree, also across block boundaries."""
    rng = np.random.default_rng(4)
    wrong_code = np.exp(2j * np.pi * rng.random(128))
    sidelink = (20 * wrong_code + rng.normal(size=(9, 128)) + 1j * rng.normal(size=(9, 128))).astype(np.complex64)
    state = measure_blocks(lambda: ((sidelink[pulses], None) for pulses in blocks_of(np.arange(9), 1)))
    assert "wrong_code" in state.flags
    assert state.locked.all()


def test_direct_path_delay_maximises_the_likelihood():
    """The power |Σ S_n exp(j2πn·delay/N)|² decreases on both sides of the delay, with noise, ripple and an echo."""
    rng = np.random.default_rng(5)
    number = np.arange(300) - 149.5
    delay = rng.uniform(-140, 140, 50)
    sidelink = (1 + 0.1 * np.cos(number / 9)) * np.exp(-2j * np.pi * np.outer(delay, number) / 300)
    sidelink = sidelink + 0.1 * np.exp(-2j * np.pi * np.outer(delay + 7.3, number) / 300)
    sidelink = (sidelink + 0.2 * (rng.normal(size=(50, 300)) + 1j * rng.normal(size=(50, 300)))).astype(np.complex64)
    found = fit_line_of_sight(sidelink).delay_cells
    np.testing.assert_allclose(found, delay, atol=0.05)

    def power(cells):
        return np.abs((sidelink * np.exp(2j * np.pi * np.outer(cells, number) / 300)).sum(1)) ** 2

    for step in (-2e-3, 2e-3):
        assert (power(found + step) < power(found)).all()


def test_clock_is_measured_on_groups_of_a_long_flight():
    """From 16 groups of 8 of 640 pulses, 8 ppm are estimated consistently with all pulses and with the truth."""
    iq = recorded(640, ppm=8.0)["sidelink"]
    samples = transfer.as_complex(iq)
    groups = spread(640, groups=16, each=8)
    assert sum(map(len, groups)) == 128
    part = clock_of((samples[pulses] for pulses in groups), NUMEROLOGY, pulses=640)
    whole = estimate_clock(samples, NUMEROLOGY)
    assert part.cfo_hz == pytest.approx(whole.cfo_hz, abs=4 * part.cfo_std_hz)
    assert part.cfo_hz == pytest.approx(9600, abs=20)
    assert part.cfo_std_hz < 5


@pytest.mark.slow
@pytest.mark.parametrize("displacement_m", [0.0, 9.0])
def test_jitter_of_a_long_flight_is_no_wrong_association(displacement_m):
    """The largest of 300 000 medians exceeds the largest of a thousand; larger displacements are still detected."""
    rng = np.random.default_rng(3)
    delay_m = 12 + rng.uniform(-12, 12, 300_000)
    delay_m[100_000:100_300] += displacement_m
    found = detect_wrong_association(baseline_residual(delay_m, np.full(300_000, 12.0)))
    assert (found is not None) == (displacement_m > 0)


def test_saturation_counts_all_blocks():
    """Extreme values in a later block replace the extreme values of earlier blocks."""
    saturation = Saturation()
    for values in ([1, 5, 5, -3], [7, 7, 7, -3], [7, 0, 0, -9]):
        saturation.count({"radar": np.array(values, np.int16).reshape(1, 2, 2)})
    assert saturation.shares["radar"] == pytest.approx((4 + 1 - 2) / 12)


@pytest.mark.parametrize(
    ("interfered", "line"), [(4, "in 4 of 200 captures, whose power is +"), (200, "in 200 of 200")]
)
def test_saturated_captures_are_counted_with_their_power(interfered, line):
    """Interference saturates single captures of high power; echoes of a wrong gain saturate all captures."""
    generator, saturation = np.random.default_rng(3), Saturation()
    iq = symbols(generator, 200)
    iq[:interfered] *= 20.0
    saturation.count({"radar": iq.clip(-16383, 16383).astype(np.int16)})
    text = saturation.flags["saturated_radar"]
    assert line in text
    if interfered < 200:
        assert float(text.split("power is ")[1].split(" dB")[0]) > 10


def symbols(generator, captures):
    """Return noise with the envelope of OFDM symbols, crest factor 12 dB, as (capture, sample, 2) counts."""
    return generator.normal(0, 1500, (captures, 2048, 2))


def limited(iq, share):
    """Limit each component to a fraction of its maximum."""
    return iq.clip(-share * np.abs(iq).max(), share * np.abs(iq).max())


@pytest.mark.parametrize(
    ("share", "every", "flagged"), [(1 / 8, 5, True), (1 / 4, 5, True), (1 / 2, 5, False), (1 / 8, 100, False)]
)
def test_limited_captures_are_counted(share, every, flagged):
    """Limiting at half the peak (2.6 standard deviations), or limiting 1 % of the captures, costs less than 0.1 dB."""
    generator, saturation = np.random.default_rng(1), Saturation()
    iq = symbols(generator, 200)
    iq[::every] = limited(iq[::every], share)
    for block in np.split(iq.astype(np.int16), 10):
        saturation.count({"radar": block})
    line = saturation.flags.get("captures_limited", "")
    assert line.startswith("40 of 200 captures of channel radar: crest factor") if flagged else line == ""


def test_weak_captures_and_tones_are_not_counted_as_limited():
    """Fading lowers only the peak; a strong tone lowers only the crest factor; lost pulses leave noise."""
    generator, saturation = np.random.default_rng(2), Saturation()
    faded = symbols(generator, 200) * np.geomspace(1, 0.01, 200)[:, None, None]
    phase_rad = 0.3 * np.arange(2048)
    tone = symbols(generator, 20) + 20000 * np.stack([np.cos(phase_rad), np.sin(phase_rad)], -1)
    pulse = symbols(generator, 40) * 0.01
    pulse[:30, 100:140] += 9000
    for name, iq in (("faded", faded), ("tone", np.concatenate([faded, tone])), ("pulses", pulse)):
        saturation.count({name: iq.astype(np.float32)})
    assert "captures_limited" not in saturation.flags


def test_memory_does_not_grow_with_the_length_of_a_flight(monkeypatch):
    """With ten times the pulses, peak memory grows by a few numbers per pulse; captures are generated on reading."""
    monkeypatch.setattr(transfer, "_STRETCH", 8)
    captures = recorded(64)["radar"]
    peaks = []
    for pulses in (500, 5000):
        tracemalloc.start()
        measured = transfer_by_code(
            lambda pulses: {"radar": captures[pulses % 64]},
            Demodulator(Inverses.fixed(1 / CODES).at, NUMEROLOGY, SYMBOL),
            time_s=np.arange(pulses) / 20,
        )
        for block in blocks_of(np.arange(pulses)):
            assert measured.form(block).shape == (len(block), 200)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 5000 * 200
