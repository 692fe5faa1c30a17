"""Filters of symbols of varying modulus: noise gain, data sidelobes and SNR loss equal their closed forms."""

import numpy as np
import pytest

from apertura.core.echo.constellation import constellation
from apertura.core.echo.frame_codes import Inverses
from apertura.core.echo.interference import PulsedInterference, limited
from apertura.core.echo.line_of_sight import LOCK_FALSE_ALARM, fit_line_of_sight
from apertura.core.echo.sidelink import METHODS
from apertura.core.echo.symbol_filter import FILTERS, SymbolFilter, choose_filter, data_sidelobes, echo_snr, filter_of

QAM = ("16qam", "64qam", "256qam")
SUBCARRIERS = 512


def decibels(ratio):
    return 10 * np.log10(ratio)


def powers(name):
    return np.abs(constellation(name).points.astype(complex)) ** 2


def drawn(rng, name, frames):
    points = constellation(name).points
    return points[rng.integers(0, len(points), (frames, SUBCARRIERS))]


def white(rng, frames):
    return ((rng.normal(size=(frames, SUBCARRIERS, 2)) @ [1, 1j]) / np.sqrt(2)).astype(np.complex64)


def filtered(received, codes, chosen):
    inverse = Inverses.of_codes(codes).at(np.arange(len(codes)))
    return chosen.applied((received * inverse).astype(np.complex64), inverse)


@pytest.mark.parametrize(
    ("name", "gain_db", "self_noise"),
    [("qpsk", 0.0, 0.0), ("16qam", 2.762, 0.32), ("64qam", 4.290, 0.38095), ("256qam", 5.362, 0.39529)],
)
def test_noise_gain_and_self_noise_of_constellations(name, gain_db, self_noise):
    """E|c|⁴ of square QAM is (7M − 13)/(5(M − 1)) for unit mean power."""
    power = powers(name)
    reciprocal, matched = (SymbolFilter.of(item, power, 1.0) for item in ("reciprocal", "matched"))
    assert decibels(reciprocal.noise_gain(power)) == pytest.approx(gain_db, abs=1e-3)
    assert reciprocal.self_noise(power) == pytest.approx(0, abs=1e-6)
    assert matched.noise_gain(power) == pytest.approx(1, abs=1e-6)
    points = len(power)
    assert matched.self_noise(power) == pytest.approx((7 * points - 13) / (5 * (points - 1)) - 1, abs=1e-6)
    assert matched.self_noise(power) == pytest.approx(self_noise, abs=1e-5)


@pytest.mark.parametrize("name", QAM)
def test_wiener_filter_has_the_smallest_loss_and_its_closed_form(name):
    power = powers(name)
    for snr in 10 ** np.arange(-3.0, 3.1, 0.5):
        wiener, *others = (SymbolFilter.of(item, power, snr) for item in ("wiener", "reciprocal", "matched"))
        q = np.mean(power / (power + 1 / snr))
        assert wiener.loss(power, snr) == pytest.approx(snr * (1 / q - 1), rel=1e-6)
        assert wiener.loss(power, snr) <= min(other.loss(power, snr) for other in others) * (1 + 1e-6)
        assert np.mean(wiener.weight(power)) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("window", [np.hanning(SUBCARRIERS), np.ones(SUBCARRIERS)], ids=["hann", "none"])
@pytest.mark.parametrize("item", FILTERS)
def test_window_weights_the_noise_gain_and_the_peak_of_a_fixed_code(window, item):
    """Subcarrier n has the share u²/Σu² of the noise of a profile, and the share u/Σu of the peak of a point."""
    rng = np.random.default_rng(6)
    edges = np.abs(np.linspace(-1, 1, SUBCARRIERS)) > 0.6
    codes = np.where(edges, 1.9, 0.7) * drawn(rng, "16qam", 1)  # weak symbols in mid-band
    power = np.abs(codes.astype(complex)) ** 2
    chosen = choose_filter(power, requested=item, snr=0.3, frames=1, tolerated_db=0.0, window=window).filter
    profile = np.fft.fft(window * filtered(white(rng, 2000), np.tile(codes, (2000, 1)), chosen), axis=1, norm="ortho")
    flat = power.mean() * np.mean(np.abs(profile) ** 2) / np.mean(window**2)
    assert decibels(flat) == pytest.approx(decibels(chosen.noise_gain(power, window)), abs=0.05)
    assert np.sum(window * chosen.weight(power)) / window.sum() == pytest.approx(1, abs=1e-6)
    sidelobes = np.abs(np.fft.fft(window * (chosen.weight(power[0]) - 1))) ** 2 / window.sum() ** 2
    expected = data_sidelobes(chosen.self_noise(power, window), window, 1)
    assert np.mean(sidelobes) == pytest.approx(expected, rel=1e-6, abs=1e-20)


@pytest.mark.parametrize("name", QAM)
@pytest.mark.parametrize("item", FILTERS)
def test_noise_of_a_profile_is_multiplied_by_the_noise_gain(name, item):
    rng = np.random.default_rng(1)
    codes, noise = drawn(rng, name, 800), white(rng, 800)
    power = np.abs(codes.astype(complex)) ** 2
    chosen = SymbolFilter.of(item, power, 0.5)
    profile = np.fft.fft(filtered(noise, codes, chosen), axis=1, norm="ortho")
    assert decibels(np.mean(np.abs(profile) ** 2)) == pytest.approx(decibels(chosen.noise_gain(powers(name))), abs=0.1)


@pytest.mark.parametrize("name", QAM)
@pytest.mark.parametrize(("item", "snr"), [("matched", 1.0), ("wiener", 1.0), ("wiener", 10.0)])
@pytest.mark.parametrize("frames", [1, 30])
def test_data_sidelobes_of_a_point_have_their_predicted_level(name, item, snr, frames):
    """Of a fixed code, sidelobes are the same in each pulse; of F frames, they average as 1/F."""
    rng, pulses = np.random.default_rng(2), 60
    window, level = np.hanning(SUBCARRIERS + 2)[1:-1], []
    for _ in range(200):
        table = drawn(rng, name, frames)
        codes = table[np.arange(pulses) % frames]
        power = np.abs(table.astype(complex)) ** 2
        chosen = SymbolFilter.of(item, power, snr)
        total = filtered(codes.astype(np.complex64), codes, chosen).sum(axis=0)
        profile = np.abs(np.fft.fft(total * window)) ** 2 / (pulses * window.sum()) ** 2
        level.append(profile[20:-20].mean())
    expected = data_sidelobes(SymbolFilter.of(item, powers(name), snr).self_noise(powers(name)), window, frames)
    assert decibels(np.mean(level)) == pytest.approx(decibels(expected), abs=0.1)


@pytest.mark.quick("*-0.0-64qam")
@pytest.mark.parametrize("name", QAM)
@pytest.mark.parametrize("snr_db", [-15.0, 0.0, 15.0])
@pytest.mark.parametrize("item", FILTERS)
def test_noise_floor_of_a_scene_equals_the_predicted_loss(name, snr_db, item):
    """Floor in empty delay cells with echoes of a scene, relative to a code of constant modulus, within 0.1 dB."""
    rng, frames, snr = np.random.default_rng(3), 1500, 10 ** (snr_db / 10)
    delays = np.arange(100)
    amplitudes = (rng.normal(size=(100, 2)) @ [1, 1j]) / np.sqrt(200)
    scene = np.exp(-2j * np.pi * np.outer(np.arange(SUBCARRIERS), delays) / SUBCARRIERS) @ amplitudes
    snr_of_scene = snr * np.mean(np.abs(scene) ** 2)
    floors = []
    for of in (name, "qpsk"):
        codes = drawn(rng, of, frames)
        power = np.abs(codes.astype(complex)) ** 2
        chosen = SymbolFilter.of(item if of == name else "reciprocal", power, snr_of_scene)
        received = codes * scene * np.sqrt(snr) + white(rng, frames)
        profile = np.fft.ifft(filtered(received, codes, chosen), axis=1, norm="ortho")
        floors.append(np.mean(np.abs(profile[:, 120:]) ** 2))
    predicted = SymbolFilter.of(item, powers(name), snr_of_scene).loss(powers(name), snr_of_scene)
    assert decibels(floors[0] / floors[1]) == pytest.approx(decibels(predicted), abs=0.1)


@pytest.mark.parametrize("name", ["qpsk", *QAM])
@pytest.mark.parametrize("snr_db", [-20.0, 0.0, 20.0])
def test_snr_of_echoes_is_measured_behind_the_division(name, snr_db):
    rng = np.random.default_rng(4)
    codes = drawn(rng, name, 1000)
    echo = np.exp(-2j * np.pi * np.arange(SUBCARRIERS) * 17.4 / SUBCARRIERS) * 10 ** (snr_db / 20)
    received = codes * echo + white(rng, 1000)
    power = np.abs(codes.astype(complex)) ** 2
    measured = echo_snr((received / codes).astype(np.complex64), power)
    assert measured == pytest.approx(10 ** (snr_db / 10), rel=0.1, abs=0.005 * SymbolFilter().noise_gain(power))


def test_choice_needs_tolerated_sidelobes_and_keeps_the_requested_filter():
    power = np.tile(powers("64qam"), (4, 8))
    settings = {"tolerated_db": -50.0, "window": np.hanning(SUBCARRIERS)}
    chosen = {
        (snr, frames): choose_filter(power, requested="auto", snr=snr, frames=frames, **settings).filter.name
        for snr in (0.01, np.inf)
        for frames in (1, 1000)
    }
    assert chosen == {
        (0.01, 1): "reciprocal",
        (0.01, 1000): "wiener",
        (np.inf, 1): "reciprocal",
        (np.inf, 1000): "reciprocal",
    }
    lossy = choose_filter(power, requested="reciprocal", snr=0.01, frames=1000, **settings)
    assert lossy.flags == {"symbols_noise": "SNR loss of the reciprocal filter 4.3 dB, smallest loss 0.0 dB"}
    loud = choose_filter(power, requested="matched", snr=0.01, frames=1, **settings)
    assert loud.flags["symbols_sidelobes"].startswith("data sidelobes of -29.5 dB after the matched filter, in 1 ")
    assert filter_of(loud.report) == loud.filter
    assert filter_of({}) is None


@pytest.mark.parametrize("name", QAM)
def test_weak_symbols_are_not_taken_for_pulsed_interference(name):
    """Noise alone, divided by the symbols; a burst of 45 dB is found with raised limits, too."""
    rng = np.random.default_rng(5)
    codes = drawn(rng, name, 400)
    transfer = (white(rng, 400) / codes).astype(np.complex64)
    peak, equal = SymbolFilter().noise_peak(powers(name)), np.full(SUBCARRIERS, 1 / SUBCARRIERS)
    frequency = 1.05e9 + 1e6 * np.arange(SUBCARRIERS)
    assert PulsedInterference.measured([transfer], frequency, equal) is not None
    assert PulsedInterference.measured([transfer], frequency, equal, noise_peak=peak) is None
    transfer[::10, 20:22] += 10 ** (45 / 20)
    found = PulsedInterference.measured([transfer], frequency, equal, noise_peak=peak)
    assert found.hits(transfer[::10])[:, 20:22].all()


# ---- Sidelink with symbols of varying modulus


def sidelink_of(rng, name, snr_db, frames=400):
    """Return codes, weights, and a sidelink with random delays and phases, divided by the codes."""
    number = np.arange(SUBCARRIERS) - (SUBCARRIERS - 1) / 2
    codes = drawn(rng, name, frames)
    delay, phase = rng.uniform(-9, 9, (frames, 1)), rng.uniform(-np.pi, np.pi, (frames, 1))
    common = np.exp(1j * phase - 2j * np.pi * number * delay / SUBCARRIERS)
    received = codes * common + white(rng, frames) * 10 ** (-snr_db / 20)
    power = np.abs(codes) ** 2
    weight = (power / power.mean(axis=1, keepdims=True)).astype(np.float32)
    return codes, weight, common, (received / codes).astype(np.complex64)


@pytest.mark.quick("*-64qam")
@pytest.mark.parametrize("name", QAM)
@pytest.mark.parametrize(("method", "cells"), [("two_parameter", 1), ("gated", 33)])
def test_weighted_sidelink_has_the_noise_of_a_constant_modulus(name, method, cells):
    """Residual noise is K/(Nρ) with weights |c|², and P·E[1/|c|²] times as large with equal weights."""
    rng, snr_db = np.random.default_rng(7), 15.0
    _, weight, common, sidelink = sidelink_of(rng, name, snr_db, frames=4000)
    noise = []
    for of in (weight, None):
        corrected = METHODS[method](common.astype(np.complex64), sidelink, None, of)
        noise.append(np.mean(np.abs(corrected - corrected.mean()) ** 2))
    expected, gain = cells / (SUBCARRIERS * 10 ** (snr_db / 10)), SymbolFilter().noise_gain(powers(name))
    matched = SymbolFilter.of("matched", powers(name), 1.0).self_noise(powers(name))
    left = (gain - 1) * matched * cells / SUBCARRIERS  # by one step towards the weighted least squares
    assert decibels(noise[0] / expected) == pytest.approx(decibels(1 + left), abs=0.25)
    assert decibels(noise[1] / expected) == pytest.approx(decibels(gain), abs=0.25)


def test_weights_lock_the_sidelink_at_the_snr_of_a_constant_modulus():
    """At Nρ = 14 dB, 64-QAM locks in as many pulses as QPSK, and no more often in noise alone."""
    rng, level_db = np.random.default_rng(8), 14 - decibels(SUBCARRIERS)
    rates = {}
    for name in ("qpsk", "64qam"):
        _, weight, _, sidelink = sidelink_of(rng, name, level_db, frames=1500)
        rates[name] = fit_line_of_sight(sidelink, weight).locked.mean()
    assert rates["64qam"] == pytest.approx(rates["qpsk"], abs=0.04)
    assert fit_line_of_sight(sidelink).locked.mean() < rates["qpsk"] - 0.3
    codes = drawn(rng, "64qam", 4000)
    power = np.abs(codes) ** 2
    noise = (white(rng, 4000) / codes).astype(np.complex64)
    locks = fit_line_of_sight(noise, (power / power.mean(axis=1, keepdims=True)).astype(np.float32)).locked.sum()
    assert locks <= 4000 * LOCK_FALSE_ALARM + 4 * np.sqrt(4000 * LOCK_FALSE_ALARM)


def test_weak_symbols_of_a_sidelink_are_not_taken_for_interference():
    """Noise of 0 dB divided by 64-QAM; a burst of 40 dB is limited with the weights, too."""
    _, weight, _, sidelink = sidelink_of(np.random.default_rng(9), "64qam", 0.0)
    assert limited(sidelink)[1].any(axis=1).mean() > 0.9
    assert limited(sidelink, weight)[1].mean() < 1e-5
    sidelink[:, 20] += 100 / np.sqrt(weight[:, 20])
    assert limited(sidelink, weight)[1][:, 20].all()


@pytest.mark.quick("12.0--5.0-*-64qam", "25.0-15.0-*-16qam")
@pytest.mark.parametrize("name", QAM)
@pytest.mark.parametrize("item", ["reciprocal", "wiener"])
@pytest.mark.parametrize("snr_db", [-5.0, 15.0])
@pytest.mark.parametrize("sidelink_db", [12.0, 25.0])
def test_loss_of_division_by_a_sidelink_equals_the_closed_form(name, item, snr_db, sidelink_db):
    """Floor of a profile relative to its peak, relative to the same floor with QPSK, within 0.1 dB (eqs. 10, 11)."""
    rng, frames = np.random.default_rng(10), 1500
    snr, divided_snr = 10 ** (snr_db / 10), 10 ** (sidelink_db / 10)
    floors = []
    for of in (name, "qpsk"):
        codes, weight, common, sidelink = sidelink_of(rng, of, sidelink_db, frames)
        chosen = SymbolFilter.of(item if of == name else "reciprocal", powers(of), 1 / (1 / snr + 1 / divided_snr))
        radar = filtered(codes * common + white(rng, frames) / np.sqrt(snr), codes, chosen)
        path = fit_line_of_sight(sidelink, weight)
        corrected = METHODS["divide"](radar.astype(np.complex64), sidelink, path)
        profile = np.abs(np.fft.fft(corrected, axis=1)) ** 2
        floors.append(profile[:, 1:].mean() / np.abs(corrected.mean()) ** 2)
    chosen = SymbolFilter.of(item, powers(name), 1 / (1 / snr + 1 / divided_snr))
    predicted = chosen.loss(powers(name), snr, None, divided_snr)
    assert decibels(floors[0] / floors[1]) == pytest.approx(decibels(predicted), abs=0.1)
