"""What is left of phases, timing and clocks after correction."""

from dataclasses import replace

import numpy as np

from apertura.common.arrays import Complexes, Floats
from apertura.core.echo.captures import correct_clock
from apertura.core.echo.clock import estimate_clock
from apertura.core.echo.demodulate import Numerology
from apertura.core.echo.sidelink import METHODS, divide
from apertura.simulation.impairments import Clock, Impairments, Timing, UniformPhase
from apertura.simulation.synthesis import samples
from apertura_research.study.dft_window import demodulated
from apertura_research.study.paper.claims import Claim, require
from apertura_research.study.paper_scene import (
    RX_AHEAD_M,
    UNDISTURBED,
    Disturbance,
    PaperScene,
    receive_pair,
    reduced_scene,
)
from apertura_research.study.point_response import (
    amplitude_db,
    error_floor_db,
    find_peaks,
    mean_image,
    phase_history,
    random_pixels,
    range_tables,
)
from apertura_research.study.stability.sweeps import ORDINARY

CLOCK_PPM = 8.0
LARGEST_EXCESS_DB = 1.0
LARGEST_LOSS_DB = 0.01


def corrected_claims(*, seed: int = 1) -> list[Claim]:
    """Return what carrier phase and timing cost after each sidelink correction, as large as the prefix allows."""
    scene = reduced_scene(pulses=150, subcarriers=4096, rx_ahead_m=RX_AHEAD_M, qpsk=True)
    clocks = Impairments(carrier_phase=UniformPhase(), timing=Timing(half_width_s=2e-6))
    disturbed = Disturbance(clocks, sampled=True)
    clean, direct, _ = receive_pair(scene, UNDISTURBED, np.random.default_rng(seed))
    radar, sidelink, _ = receive_pair(scene, disturbed, np.random.default_rng(seed))
    ideal = _peaks(scene, divide(clean, direct))
    rows = []
    for name, correct in METHODS.items():
        worst_db = float(np.abs(amplitude_db(_peaks(scene, correct(radar, sidelink)) / ideal)).max())
        title = f"loss after {name}: carrier phase ±π and timing ±2 µs per pulse, inside the prefix"
        limit, met = f"below {LARGEST_LOSS_DB:g} dB", worst_db < LARGEST_LOSS_DB
        note = "worst of five targets, from samples"
        rows.append(require(title, worst_db, "dB", limit=limit, met=met, style=".4f", note=note))
    return rows


def _peaks(scene: PaperScene, corrected: Complexes) -> Floats:
    targets = scene.scatterers.position_m
    return find_peaks(range_tables(phase_history(scene, corrected, divided=True), targets), targets)[1]


def clock_claims(*, pulses: int = 150) -> list[Claim]:
    """Return the floor that a fast clock leaves in the divided image, without and with correction in the samples.

    Samples are noisy, 20 dB in the radar and 30 dB in the sidelink per subcarrier, so that the model which made them is
    not simply taken back: a perfect clock with the same noise is what the correction is held against.
    """
    scene = reduced_scene(pulses=pulses, subcarriers=4096, rx_ahead_m=RX_AHEAD_M, qpsk=True)
    wave = scene.waveform
    clock = Clock.of_ppm(CLOCK_PPM, carrier_hz=wave.carrier_hz, sample_rate_hz=wave.sample_rate_hz)
    captures = _captures(scene, replace(ORDINARY, clock=clock))
    symbol = Numerology(
        wave.carrier_hz,
        wave.sample_rate_hz,
        np.arange(len(wave.codes)),
        prefix_samples=wave.prefix_samples,
        dft_samples=wave.dft_samples,
    )
    offset = estimate_clock(captures[1], symbol)
    cfo_hz = offset.cfo_of_pulses_hz(pulses)
    corrected = [correct_clock(capture, symbol, cfo_hz=cfo_hz, sfo_ppm=offset.sfo_ppm) for capture in captures]
    ideal, _ = _image(scene, _captures(scene, Impairments()))
    images = (_image(scene, pair) for pair in (_captures(scene, ORDINARY), captures, corrected))
    perfect_db, before_db, after_db = (error_floor_db(values, ideal, peaks) for values, peaks in images)
    return [
        require(
            f"{CLOCK_PPM:g} ppm clock corrected in the samples: floor above that of a perfect clock, same noise",
            after_db - perfect_db,
            "dB",
            limit=f"at most {LARGEST_EXCESS_DB:g} dB",
            met=after_db - perfect_db <= LARGEST_EXCESS_DB,
            style=".2f",
            note=f"floor {before_db:.1f} dB without, {after_db:.1f} dB with, {perfect_db:.1f} dB with a perfect clock; "
            f"measured as {offset.sfo_ppm:.4f} ppm",
        )
    ]


def _captures(scene: PaperScene, receiver: Impairments) -> list[Complexes]:
    _, _, seen = receive_pair(scene, Disturbance(receiver), np.random.default_rng(0))
    names = ("radar", "sidelink")
    noise = dict(zip(names, (np.random.default_rng(number) for number in (1, 2)), strict=True))
    return [samples(seen.channels[name], noise[name]).astype(np.complex64) for name in names]


def _image(scene: PaperScene, captures: list[Complexes]) -> tuple[Complexes, Floats]:
    """Return the divided image at random pixels, and the peaks of the targets."""
    window = slice(scene.waveform.prefix_samples, scene.waveform.prefix_samples + scene.waveform.dft_samples)
    radar, sidelink = (demodulated(capture[:, window], scene.waveform) for capture in captures)
    targets = scene.scatterers.position_m
    tables = range_tables(phase_history(scene, divide(radar, sidelink), divided=True), targets)
    return mean_image(tables, random_pixels(np.random.default_rng(1))), find_peaks(tables, targets)[1]
