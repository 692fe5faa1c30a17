"""Steps of the gain during a recording, from the power of its pulses."""

import numpy as np
import pytest

from apertura.core.echo.gain_step import gain_step_flags

PULSES = 600
NUMBER = np.arange(PULSES)
TIME_S = 0.01 * NUMBER


def fluctuating(generator, std_db=0.05):
    return 10 ** (std_db / 10 * generator.standard_normal(PULSES))


@pytest.mark.parametrize(("step_db", "raised"), [(2.5, False), (3.5, True), (-2.5, False), (-3.5, True), (12.0, True)])
def test_step_of_the_gain_is_detected_beyond_its_limit(step_db, raised):
    power = fluctuating(np.random.default_rng(1)) * np.where(NUMBER < 250, 1, 10 ** (step_db / 10))
    flags = gain_step_flags(power, TIME_S)
    assert ("gain_step" in flags) == raised
    if raised:
        line = flags["gain_step"]
        assert line.startswith(f"power {step_db:+.1f} dB from pulse 251 of 600 on, 2.500 s after the first pulse")


def test_step_divided_over_two_pulses_is_detected():
    power = fluctuating(np.random.default_rng(2)) * np.where(NUMBER < 250, 1, 100)
    power[250] = 10
    assert gain_step_flags(power, TIME_S)["gain_step"].endswith("in 1 step")


def test_several_steps_are_counted():
    power = fluctuating(np.random.default_rng(3)) * np.where((NUMBER < 200) | (NUMBER >= 400), 1, 10)
    assert gain_step_flags(power, TIME_S)["gain_step"].endswith("in 2 steps")


def test_pulses_without_data_are_ignored():
    power = fluctuating(np.random.default_rng(4)) * np.where(NUMBER < 250, 1, 10)
    power[:100] = 0
    assert gain_step_flags(power, TIME_S)["gain_step"].startswith("power +10.0 dB from pulse 251 of 600")
    assert not gain_step_flags(np.zeros(PULSES), TIME_S)
    assert not gain_step_flags(np.ones(3), TIME_S[:3])


def powers(name):
    power, time_s = fluctuating(np.random.default_rng(5)), TIME_S
    match name:
        case "beam":
            power = power * np.exp(-(((NUMBER - 300) / 40) ** 2))
        case "target enters":
            power = power + 1000 / (1 + np.exp(-(NUMBER - 300) / 5))
        case "bad pulse":
            power[250] *= 1000
        case "bad pulses":
            power[250:262] *= 0.01
        case "gap":
            power, time_s = power * np.where(NUMBER < 250, 1, 10), TIME_S + np.where(NUMBER < 250, 0, 1.0)
        case "end":
            power[-5:] *= 10
    return power, time_s


@pytest.mark.parametrize("name", ["beam", "target enters", "bad pulse", "bad pulses", "gap", "end"])
def test_slow_changes_bad_pulses_and_gaps_are_not_steps_of_the_gain(name):
    assert not gain_step_flags(*powers(name))


@pytest.mark.parametrize("cells", [1, 4, 64])
@pytest.mark.parametrize("correlation", [1, 8, 32])
def test_speckle_is_not_a_step_of_the_gain(cells, correlation):
    generator = np.random.default_rng(6)
    for _ in range(20):
        noise = generator.standard_normal((2, PULSES + correlation, cells))
        total = np.cumsum(noise, axis=1)
        amplitude = total[:, correlation:] - total[:, :-correlation]
        assert not gain_step_flags((amplitude**2).sum(axis=0).mean(axis=-1), TIME_S)
