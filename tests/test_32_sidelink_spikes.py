"""Disturbed sidelink pulses: detection against oscillator noise, exclusion, modulation, and their effect on a point."""

import re

import numpy as np
import pytest

from apertura.core.echo.line_of_sight import LineOfSight, fit_line_of_sight
from apertura.core.echo.sidelink import METHODS
from apertura.core.echo.sidelink_spikes import EXCLUDED_RAD, find_spikes
from apertura.simulation.impairments import Clock, Impairments, PhaseWalk, Rotor, Spikes, Timing, UniformPhase
from apertura.simulation.observation import observe
from apertura.simulation.synthesis import straight_pair, transfer_functions
from apertura.simulation.targets import Scatterers
from apertura.simulation.waveform import TransmitWaveform, qpsk_codes

PULSES, PRF_HZ, C = 3000, 100.0, 299_792_458.0
CYCLES_PER_CELL = 3.0


def found(phase_rad, *, delay_cells=0.0, amplitude=1.0, number=None, seed=1, cycles_per_cell=CYCLES_PER_CELL):
    """Return the disturbances of a sidelink of constant length with given phases, at 56 dB of N times SNR."""
    pulses = len(phase_rad)
    ones, number = np.ones(pulses), np.arange(pulses) if number is None else number
    delay = delay_cells + 6e-4 * np.random.default_rng(seed).normal(size=pulses)
    path = LineOfSight(delay, phase_rad, amplitude * ones, 0.01 * ones, ones > 0)
    return find_spikes(path, 0 * ones, number / PRF_HZ, cycles_per_cell=cycles_per_cell, wave_m=0.2)


def hit(share, rng, pulses=PULSES):
    return (rng.random(pulses) < share) * rng.choice([-1.0, 1.0], pulses)


OSCILLATORS = {
    "white 0.05": lambda rng: 0.05 * rng.normal(size=PULSES),
    "white 0.4": lambda rng: 0.4 * rng.normal(size=PULSES),
    "walk": lambda rng: np.cumsum(0.1 * rng.normal(size=PULSES)) + 0.02 * rng.normal(size=PULSES),
    "fast walk": lambda rng: np.cumsum(0.6 * rng.normal(size=PULSES)),
    "uniform, 1 rad": lambda rng: rng.uniform(-1, 1, PULSES),
    "random": lambda rng: rng.uniform(-np.pi, np.pi, PULSES),
    "drifting offset": lambda rng: 0.05 * rng.normal(size=PULSES) + np.polyval([2e-4, 2.3, 0], np.arange(PULSES)),
    "slow multipath": lambda rng: (
        np.angle(1 + 0.7 * np.exp(0.06j * np.arange(PULSES))) + 0.02 * rng.normal(size=PULSES)
    ),
    "steps of a clock": lambda rng: 2.0 * (np.arange(PULSES) // 500) + 0.05 * rng.normal(size=PULSES),
}


@pytest.mark.parametrize("oscillator", OSCILLATORS)
def test_oscillators_and_slow_multipath_are_not_spikes(oscillator):
    for seed in range(5):
        spikes = found(OSCILLATORS[oscillator](np.random.default_rng(seed)), seed=seed)
        assert not spikes.excluded.any()
        assert spikes.flags == {}


@pytest.mark.slow
def test_false_alarm_rate_is_below_1e_5_for_white_noise():
    rng = np.random.default_rng(0)
    count = sum(np.count_nonzero(found(0.1 * rng.normal(size=100_000)).error_rad) for _ in range(5))
    assert count == 0


@pytest.mark.parametrize("oscillator", ["white 0.05", "walk", "drifting offset"])
@pytest.mark.parametrize("share", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("size_rad", [1.5, 2.0, np.pi])
def test_spikes_are_excluded_and_other_pulses_kept(oscillator, share, size_rad):
    rng = np.random.default_rng(3)
    disturbed = hit(share, rng)
    spikes = found(OSCILLATORS[oscillator](rng) + size_rad * disturbed)
    assert spikes.excluded[disturbed != 0].mean() > 0.96
    assert spikes.excluded[disturbed == 0].mean() <= 0.04 * share
    assert spikes.flags["sidelink_spikes"].startswith(f"{np.count_nonzero(spikes.error_rad)} of {PULSES} pulses")


def test_spikes_are_found_although_half_of_the_pulses_are_missing():
    rng = np.random.default_rng(4)
    number = np.flatnonzero(rng.random(2 * PULSES) < 0.5)
    number = number[(number < 2000) | (number > 2300)]
    disturbed = hit(0.01, rng, number.size)
    # the oscillator turns by 0.37 cycles from pulse to pulse; a missing pulse adds another 0.37
    phase = 2 * np.pi * 0.37 * number + 0.05 * rng.normal(size=number.size)
    assert not found(phase, number=number).excluded.any()
    assert (found(phase + 2 * disturbed, number=number).excluded == (disturbed != 0)).mean() > 0.999


def test_trigger_slips_are_not_spikes_and_random_triggers_do_not_hide_them():
    rng = np.random.default_rng(5)
    noise, disturbed = 0.05 * rng.normal(size=PULSES), hit(0.01, rng)
    slip = 0.4 * hit(0.05, rng)
    spikes = found(noise - 2 * np.pi * CYCLES_PER_CELL * slip, delay_cells=slip)
    assert not spikes.excluded.any()
    assert spikes.flags == {}
    shift = rng.uniform(-10, 10, PULSES)
    spikes = found(noise - 2 * np.pi * CYCLES_PER_CELL * shift + 2 * disturbed, delay_cells=shift)
    assert (spikes.excluded == (disturbed != 0)).all()


@pytest.mark.parametrize("size_rad", [0.95, 1.15])
def test_pulse_is_excluded_if_its_error_exceeds_that_of_its_absence(size_rad):
    assert (np.abs(np.exp(1j * size_rad) - 1) > 1) == (size_rad > EXCLUDED_RAD)
    rng = np.random.default_rng(6)
    disturbed = hit(0.01, rng)
    spikes = found(0.01 * rng.normal(size=PULSES) + size_rad * disturbed)
    assert (spikes.error_rad[disturbed != 0] != 0).all()
    assert spikes.excluded.sum() == (np.count_nonzero(disturbed) if size_rad > EXCLUDED_RAD else 0)


@pytest.mark.parametrize(("share", "flagged"), [(0.02, False), (0.12, True)])
def test_small_spikes_are_flagged_if_their_loss_matters(share, flagged):
    rng = np.random.default_rng(7)
    spikes = found(0.01 * rng.normal(size=PULSES) + 0.9 * hit(share, rng))
    assert not spikes.excluded.any()
    assert ("sidelink_spikes" in spikes.flags) is flagged


@pytest.mark.parametrize(("pulses", "excluded"), [(63, 0), (64, 1)])
def test_short_flights_are_not_searched(pulses, excluded):
    phase = 0.05 * np.random.default_rng(8).normal(size=pulses)
    phase[30] += 2
    assert found(phase).excluded.sum() == excluded


def test_bursts_of_up_to_four_pulses_are_spikes_and_longer_ones_are_not():
    for length, expected in ((4, 4), (9, 0)):
        phase = 0.02 * np.random.default_rng(9).normal(size=PULSES)
        phase[1000 : 1000 + length] += 2
        assert found(phase).excluded.sum() == expected


# ---- Periodic modulation


@pytest.mark.parametrize(
    ("frequency_hz", "alias_hz"), [(8.0, 8.0), (23.0, 23.0), (45.0, 45.0), (77.0, 23.0), (183, 17.0)]
)
def test_modulation_is_measured_at_its_frequency_or_alias(frequency_hz, alias_hz):
    rng, time_s = np.random.default_rng(1), np.arange(PULSES) / PRF_HZ
    swing = np.cos(2 * np.pi * frequency_hz * time_s)
    spikes = found(0.4 * swing + np.cumsum(0.02 * rng.normal(size=PULSES)), amplitude=1 + 0.1 * swing)
    line = spikes.flags["sidelink_modulation"]
    measured = [float(value) for value in re.findall(r"at ([\d.]+) Hz|±([\d.]+)", line)[0][:1]]
    depth_rad, depth_db = (float(value) for value in re.findall(r"±([\d.]+)", line))
    assert measured[0] == pytest.approx(alias_hz, abs=PRF_HZ / 256)
    assert depth_rad == pytest.approx(0.4, rel=0.1)
    assert depth_db == pytest.approx(0.87, rel=0.15)
    assert not spikes.excluded.any()


def test_modulation_of_a_short_flight_has_its_frequency():
    time_s = np.arange(75) / PRF_HZ
    phase = 0.4 * np.cos(2 * np.pi * 40 * time_s) + 0.02 * np.random.default_rng(1).normal(size=time_s.size)
    line = found(phase).flags["sidelink_modulation"]
    assert float(re.search(r"at ([\d.]+) Hz", line).group(1)) == pytest.approx(40, abs=0.3)


@pytest.mark.parametrize(("depth_rad", "flagged"), [(0.15, False), (0.25, True)])
def test_modulation_is_flagged_if_its_ghosts_exceed_minus_20_db(depth_rad, flagged):
    rng, time_s = np.random.default_rng(2), np.arange(PULSES) / PRF_HZ
    phase = depth_rad * np.cos(2 * np.pi * 23 * time_s) + 0.02 * rng.normal(size=PULSES)
    assert ("sidelink_modulation" in found(phase).flags) is flagged


def test_slow_motion_and_amplitude_modulation_are_not_flagged():
    rng, time_s = np.random.default_rng(2), np.arange(PULSES) / PRF_HZ
    noise = 0.02 * rng.normal(size=PULSES)
    assert found(2 * np.sin(2 * np.pi * 1.5 * time_s) + noise).flags == {}
    assert found(noise, amplitude=1 + 0.5 * np.cos(2 * np.pi * 23 * time_s)).flags == {}


def test_noise_has_no_lines():
    rng = np.random.default_rng(3)
    for _ in range(200):
        assert found(1.2 * rng.normal(size=600)).flags == {}


# ---- Recordings of two simulated nodes

WAVEFORM = TransmitWaveform(
    qpsk_codes(32, np.random.default_rng(0)), 1.2e9, "band_start", 12.5e6, 8e-8, 2e-7, 5e8, PRF_HZ
)
TARGET = np.array([[0.0, 12.0, 0.0]])


class Flight:
    """Two nodes past a point target: corrected transfer functions, fitted sidelink and disturbances."""

    def __init__(self, method="divide", pulses=1000, **impairments):
        geometry = straight_pair(np.linspace(-5, 5, pulses), 10.0, rx_ahead_m=4.7)
        receiver = Impairments(**{"sidelink_snr_db": 25.0, "carrier_phase": PhaseWalk(0.5), **impairments})
        seen = observe(
            WAVEFORM, Scatterers(TARGET, np.ones(1, complex)), geometry, np.random.default_rng(1),
            receiver=receiver, transmitter=Impairments(),
        )  # fmt: skip
        radar, sidelink = (
            transfer_functions(seen.channels[name], seen.noise[name]).astype(np.complex64)
            for name in ("radar", "sidelink")
        )
        self.draw, self.path = seen.draw, fit_line_of_sight(sidelink)
        length_m = np.linalg.norm(geometry.sidelink_tx - geometry.sidelink_rx, axis=1)
        cell_m, wave_m = C / 400e6, C / WAVEFORM.frequency_hz.mean()
        self.spikes = find_spikes(
            self.path, length_m / cell_m, np.arange(pulses) / PRF_HZ, cycles_per_cell=cell_m / wave_m, wave_m=wave_m
        )
        legs = [np.linalg.norm(side - TARGET, axis=1) for side in (geometry.radar_tx, geometry.radar_rx)]
        steering = np.exp(2j * np.pi * np.outer((sum(legs) - length_m) / C, WAVEFORM.frequency_hz))
        self.echo = (METHODS[method](radar, sidelink, self.path) * steering).mean(axis=1)
        self.ideal = 1 / (legs[0] * legs[1])

    def loss_db(self, used):
        return -20 * np.log10(abs(self.echo[used].sum()) / self.ideal[used].sum())


@pytest.mark.parametrize("method", METHODS)
def test_exclusion_restores_the_peak_with_every_method(method):
    flight = Flight(method, sidelink_spikes=Spikes(0.1, phase_rad=2.5))
    assert flight.loss_db(flight.path.locked) > 1.3
    assert abs(flight.loss_db(~flight.spikes.excluded)) < 0.05


def test_reflections_change_the_sidelink_as_recorded_in_the_truth():
    flight = Flight(sidelink_spikes=Spikes(0.05, level_db=-3.0, excess_m=0.02), sidelink_snr_db=50.0)
    struck = flight.draw.spike_echo != 0
    assert struck.mean() == pytest.approx(0.05, abs=0.02)
    # the correction imprints the error of the sidelink on the echo
    np.testing.assert_allclose(np.angle(flight.echo), -flight.draw.sidelink_error_rad, atol=0.1)
    assert np.abs(flight.draw.sidelink_error_rad[struck]).max() > 0.7


def test_undisturbed_recordings_are_unchanged():
    timing, clock = Timing(half_width_s=40e-9, jitter_samples=1.0), Clock(cfo_hz=1234.5, continuous_phase=True)
    for impairments in ({}, {"carrier_phase": UniformPhase()}, {"timing": timing}, {"clock": clock}):
        flight = Flight(**impairments)
        assert not flight.spikes.error_rad.any()
        assert flight.spikes.flags == {}
        assert abs(flight.loss_db(flight.path.locked)) < 0.05


def test_spikes_of_a_receiver_with_random_phases_are_not_observable():
    flight = Flight(carrier_phase=UniformPhase(), sidelink_spikes=Spikes(0.1, phase_rad=2.5))
    assert flight.loss_db(flight.path.locked) > 1.3
    assert not flight.spikes.excluded.any()


def test_reflection_from_blades_is_flagged_as_modulation():
    flight = Flight(pulses=2000, sidelink_rotor=Rotor(frequency_hz=187.0, level_db=-10.0, excess_m=0.05))
    line = flight.spikes.flags["sidelink_modulation"]
    frequency_hz = float(re.search(r"at ([\d.]+) Hz", line).group(1))
    assert frequency_hz == pytest.approx(13.0, abs=0.5)
    assert float(re.search(r"±([\d.]+) rad", line).group(1)) == pytest.approx(10 ** (-10 / 20), rel=0.15)
    assert Flight(pulses=2000, sidelink_rotor=Rotor(187.0, -25.0)).spikes.flags == {}
