"""Sidelink corrections: resulting image quality, failure of each method, and selection by `auto`."""

import re

import numpy as np
import pytest

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.common.errors import CampaignError
from apertura.core.echo.line_of_sight import LOCK_FALSE_ALARM, fit_line_of_sight
from apertura.core.echo.sidelink import METHODS, choose, divide, edges, measure

TARGETS = np.array([(0, 5, 0), (-2, 8, 0), (0, 11, 0), (2, 14, 0), (0, 18, 0)], float)


class Tandem:
    """Two UAVs in line past five points, 409.6 MHz around 1.4 GHz; all methods use the same random draws."""

    def __init__(self, subcarriers=512, pulses=48):
        self.shape = pulses, subcarriers
        self.frequency = 1.2e9 + np.arange(subcarriers) * 409.6e6 / subcarriers
        along = np.linspace(-3, 3, pulses)
        self.tx = np.stack([along, 0 * along, 0 * along + 5], -1)
        self.rx = np.stack([along + 4.7, 0 * along, 5 + 0.1 * np.sin(along)], -1)
        self.between = np.linalg.norm(self.tx - self.rx, axis=1)
        self.delays = self.delay(TARGETS)
        self.steering = np.exp(2j * np.pi * self.delays[:, :, None] * self.frequency)
        self.ideal = sum(self.path(self.delays[:, k]) for k in range(5))

    def delay(self, points):
        legs = [np.linalg.norm(side[:, None] - points, axis=2) for side in (self.tx, self.rx)]
        return (legs[0] + legs[1] - self.between[:, None]) / C

    def path(self, delay):
        return np.exp(-2j * np.pi * delay[:, None] * self.frequency)

    def focus(self, transfer):
        """Return the image at the targets."""
        return np.einsum("pkn,pn->k", self.steering, transfer) / np.prod(self.shape)

    def record(
        self, rng, snr_db, *, ripple_db=0.0, ripple_cells=5, reflection=0.0, echo=0.0, echo_cells=40, trigger_s=5e-9
    ):
        """Return radar and sidelink of one flight with a random phase and trigger delay per pulse, common to both."""
        number = np.arange(self.shape[1])
        trigger = rng.uniform(-trigger_s, trigger_s, self.shape[0])
        common = self.path(trigger + self.between / C) * np.exp(2j * np.pi * rng.random((self.shape[0], 1)))
        swing = 10 ** (ripple_db / 20)
        common *= 1 + (swing - 1) / (swing + 1) * np.cos(2 * np.pi * number * ripple_cells / self.shape[1])
        common *= 1 + reflection * np.exp(-2j * np.pi * number * ripple_cells / self.shape[1])
        sidelink = common * (1 + echo * np.exp(-2j * np.pi * number * echo_cells / self.shape[1]))
        sidelink = sidelink + complex_noise(rng, self.shape) * 10 ** (-snr_db / 20)
        return (common * self.ideal).astype(np.complex64), sidelink.astype(np.complex64)

    def loss_db(self, corrected):
        """Return the mean level of the five targets against a recording without errors."""
        return 20 * np.log10(np.mean(np.abs(self.focus(corrected)) / np.abs(self.focus(self.ideal))))


def complex_noise(rng, shape):
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


SCENE = Tandem()
LONG_PULSES = Tandem(2048, 16)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("trigger_s", [0.0, 1e-9, 100e-9])
def test_phase_and_trigger_errors_cost_less_than_0_01_db(method, trigger_s):
    radar, sidelink = SCENE.record(np.random.default_rng(1), 60, trigger_s=trigger_s)
    assert abs(SCENE.loss_db(METHODS[method](radar, sidelink))) < 0.01
    assert SCENE.loss_db(radar) < -6  # without correction the random phase defocuses


@pytest.mark.parametrize("method", METHODS)
def test_corrected_targets_have_the_phase_of_their_paths(method):
    radar, sidelink = SCENE.record(np.random.default_rng(2), 60)
    image = SCENE.focus(METHODS[method](radar, sidelink))
    assert np.angle(image / SCENE.focus(SCENE.ideal)) == pytest.approx(0, abs=2e-3)


@pytest.mark.parametrize("snr_db", [10, 6, 3, 0, -5, -10])
def test_division_loss_matches_theory(snr_db):
    """The expected amplitude is E[1/(1+n)] = 1 - exp(-SNR): -4 dB at 0 dB SNR, -20 dB at -10 dB."""
    losses = [SCENE.loss_db(divide(*SCENE.record(np.random.default_rng(seed), snr_db))) for seed in range(4)]
    expected = 20 * np.log10(1 - np.exp(-(10 ** (snr_db / 10))))
    assert np.mean(losses) == pytest.approx(expected, abs=0.6 if snr_db < -5 else 0.2)


def test_wiener_adds_5_db_less_noise_than_division_at_low_snr():
    radar, sidelink = SCENE.record(np.random.default_rng(3), 4)
    noise = {}
    for method in ("divide", "wiener"):
        corrected = METHODS[method](radar, sidelink)
        scale = np.vdot(SCENE.ideal, corrected) / np.vdot(SCENE.ideal, SCENE.ideal)
        noise[method] = np.mean(np.abs(corrected / scale - SCENE.ideal) ** 2)
    assert 4.5 < 10 * np.log10(noise["divide"] / noise["wiener"]) < 9


@pytest.mark.parametrize("snr_db", [-20, -15, -11, -6, -2, 2, 5, 7, 9, 12, 20, 30])
@pytest.mark.parametrize("flaw", [{}, {"ripple_db": 1.0}, {"reflection": 0.0575}, {"echo": 0.3}])
def test_auto_is_within_0_2_db_of_the_best_method(snr_db, flaw):
    scene = LONG_PULSES
    radar, sidelink = scene.record(np.random.default_rng(100 + snr_db), snr_db, **flaw)
    state = measure(sidelink)
    kept = state.locked[:, None] / state.locked.mean()
    levels = {method: scene.loss_db(correct(radar, sidelink) * kept) for method, correct in METHODS.items()}
    # a gain is an error, too
    errors = {method: abs(level) for method, level in levels.items()}
    assert errors[choose(state)[0]] <= min(errors.values()) + 0.2


@pytest.mark.parametrize(
    ("flaw", "snr_db", "method"),
    [
        ({}, 12, "divide"), ({}, 8, "wiener"), ({}, 3, "two_parameter"),
        ({"ripple_db": 1.0}, 12, "divide"), ({"ripple_db": 1.0}, 3, "gated"), ({"ripple_db": 0.3}, 3, "two_parameter"),
        ({"reflection": 0.0575}, 12, "divide"), ({"reflection": 0.0575}, 3, "gated"),
        ({"echo": 0.09}, 12, "divide"), ({"echo": 0.11}, 12, "two_parameter"),
        ({"echo": 0.11, "ripple_db": 1}, 12, "gated"),
        ({"ripple_db": 1.0, "ripple_cells": 60}, 12, "divide"),
    ],
)  # fmt: skip
def test_auto_selects_the_cheapest_adequate_method(flaw, snr_db, method):
    _, sidelink = SCENE.record(np.random.default_rng(4), snr_db, **flaw)
    name, reason = choose(measure(sidelink))
    assert name == method
    assert f"SNR {measure(sidelink).snr_db:.1f} dB" in reason


def test_auto_reports_the_residual_if_no_method_is_adequate():
    _, sidelink = SCENE.record(np.random.default_rng(5), 3, ripple_db=2.0, ripple_cells=60)
    name, reason = choose(measure(sidelink))
    assert name == "two_parameter"
    assert "no method is adequate" in reason
    assert re.search(r"ripple of (1\.[89]|2\.[01]) dB", reason)


@pytest.mark.parametrize("snr_db", [-10, 0, 10, 30])
@pytest.mark.parametrize(("echo", "cells"), [(0.3, 40), (0.2, 7), (0.3, -20)])
def test_snr_echo_and_ripple_are_measured(snr_db, echo, cells):
    _, sidelink = SCENE.record(np.random.default_rng(6), snr_db, ripple_db=1.5, echo=echo, echo_cells=cells)
    state = measure(sidelink)
    assert state.snr_db == pytest.approx(snr_db, abs=1.0)
    assert state.echo_cells == cells
    assert state.echo_db == pytest.approx(20 * np.log10(echo), abs=1.5)
    if snr_db >= 0:  # below 0 dB it is not observable with 48 pulses
        assert state.ripple_db == pytest.approx(1.5, abs=0.4)
    assert state.fine_ripple_db < 0.1


@pytest.mark.parametrize(("snr_db", "cells"), [(0, 5), (20, 5), (20, 3.6)])
def test_reflection_in_the_transmitter_is_measured_as_ripple(snr_db, cells):
    rng = np.random.default_rng(6)
    _, sidelink = SCENE.record(rng, snr_db, reflection=0.0575, ripple_cells=cells)  # -24.8 dB
    assert measure(sidelink).ripple_db == pytest.approx(1.0, abs=0.25)


def test_sidelink_delay_is_measured_pulse_by_pulse():
    number = np.arange(512)
    delay = np.random.default_rng(7).uniform(-30, 200, 40)
    sidelink = np.exp(-2j * np.pi * np.outer(delay, number) / 512).astype(np.complex64)
    assert measure(sidelink).delay_cells == pytest.approx(delay, abs=1e-4)


@pytest.mark.parametrize(
    ("method", "below", "above"),
    [("divide", 9.5, 10.5), ("wiener", 5.5, 6.5), ("gated", -2.4, -1.4), ("two_parameter", -15.2, -13.0)],
)  # fmt: skip
def test_noise_limit_of_each_method_is_flagged(method, below, above):
    for snr_db, flagged in ((below, True), (above, False)):
        _, sidelink = SCENE.record(np.random.default_rng(8), snr_db)
        assert ("sidelink_noisy" in edges(method, measure(sidelink))) == flagged


@pytest.mark.parametrize(("echo", "flagged"), [(0.09, False), (0.11, True)])
def test_echo_limit_is_flagged_for_methods_that_keep_the_echo(echo, flagged):
    near, far = (measure(SCENE.record(np.random.default_rng(9), 25, echo=echo, echo_cells=c)[1]) for c in (12, 40))
    assert [("sidelink_echo" in edges(method, near)) for method in METHODS] == [flagged, flagged, False, flagged]
    assert [("sidelink_echo" in edges(method, far)) for method in METHODS] == [flagged, flagged, False, False]


@pytest.mark.parametrize(("ripple_db", "flagged"), [(0.45, False), (0.55, True)])
def test_ripple_limit_is_flagged_for_methods_that_keep_it(ripple_db, flagged):
    coarse, fine = (
        measure(SCENE.record(np.random.default_rng(10), 25, ripple_db=ripple_db, ripple_cells=c)[1]) for c in (8, 40)
    )
    assert [("sidelink_ripple" in edges(method, coarse)) for method in METHODS] == [False, False, flagged, False]
    assert [("sidelink_ripple" in edges(method, fine)) for method in METHODS] == [False, False, flagged, flagged]


def test_blocked_pulses_do_not_lock_and_are_counted():
    _, sidelink = SCENE.record(np.random.default_rng(11), 10)
    sidelink[20:27] = 0.3 * complex_noise(np.random.default_rng(12), (7, 512))
    state = measure(sidelink)
    assert np.flatnonzero(~state.locked).tolist() == list(range(20, 27))
    assert state.flags["sidelink_lost"].startswith("7 of 48 pulses")
    whole = measure(SCENE.record(np.random.default_rng(11), 10)[1])
    assert "sidelink_lost" not in whole.flags
    assert state.snr_db == pytest.approx(whole.snr_db, abs=0.3)


@pytest.mark.slow
def test_noise_locks_at_the_specified_false_alarm_rate():
    noise = complex_noise(np.random.default_rng(13), (6000, 512)).astype(np.complex64)
    locks = fit_line_of_sight(noise).locked.sum()
    assert 0 < locks <= 6000 * LOCK_FALSE_ALARM * 2


def test_sidelink_without_lock_is_rejected():
    noise = complex_noise(np.random.default_rng(14), (30, 512)).astype(np.complex64)
    with pytest.raises(CampaignError, match="locks in none of 30 pulses"):
        measure(noise)


def test_wrong_code_is_flagged_and_division_still_works():
    rng = np.random.default_rng(15)
    radar, sidelink = SCENE.record(rng, 15)
    wrong_code = np.exp(2j * np.pi * rng.random(512)).astype(np.complex64)
    state = measure(sidelink * wrong_code)
    assert "wrong_code" in state.flags
    assert state.snr_db == pytest.approx(15, abs=1)
    assert choose(state)[0] == "divide"
    assert abs(SCENE.loss_db(divide(radar * wrong_code, sidelink * wrong_code))) < 0.3
    assert "wrong_code" not in measure(sidelink).flags
    for method, needs_code in (("divide", False), ("wiener", False), ("gated", True), ("two_parameter", True)):
        assert ("sidelink_code" in edges(method, state)) == needs_code
        assert "sidelink_code" not in edges(method, measure(sidelink))


@pytest.mark.parametrize(("second", "flagged"), [(0.45, False), (0.65, True)])  # -6.9 and -3.7 dB
@pytest.mark.parametrize("moving", [False, True])
def test_second_transmitter_is_flagged(second, flagged, moving):
    rng = np.random.default_rng(16)
    _, sidelink = SCENE.record(rng, 25)
    delay = rng.uniform(60, 200, 48) if moving else np.full(48, 77.0)
    sidelink += second * np.exp(-2j * np.pi * (np.outer(delay, np.arange(512)) / 512 + rng.random((48, 1))))
    assert ("second_arrival" in measure(sidelink).flags) == flagged


def test_spectral_null_is_attenuated():
    radar, sidelink = SCENE.record(np.random.default_rng(17), 40)
    depth = np.ones(512, np.float32)
    depth[200:210] = 1e-4
    radar = radar * depth + 0.01 * complex_noise(np.random.default_rng(18), radar.shape).astype(np.complex64)
    for method in ("divide", "wiener", "gated"):
        corrected = METHODS[method](radar, sidelink * depth)
        assert np.abs(corrected[:, 200:210]).max() < np.abs(SCENE.ideal).max() / 3
        assert abs(SCENE.loss_db(corrected)) < 0.4  # 2 % of the band is missing, also from the reference amplitude
    assert measure(sidelink * depth).flags["sidelink_nulls"].startswith("2.0 %")
    assert "sidelink_nulls" not in measure(sidelink * np.maximum(depth, 0.2)).flags


@pytest.mark.parametrize("method", METHODS)
def test_fading_sidelink_does_not_amplify_its_pulse(method):
    radar, sidelink = SCENE.record(np.random.default_rng(19), 60)
    fade = np.geomspace(1, 0.05, 48)[:, None].astype(np.float32)
    plain, faded = (METHODS[method](radar, sidelink * gain) for gain in (1, fade))
    assert np.abs(faded - plain).max() < 1e-2 * np.abs(plain).max()
