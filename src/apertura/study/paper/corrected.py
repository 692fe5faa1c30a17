"""What is left of phases, timing and clocks after correction."""

import numpy as np

from apertura.echo.clock import estimate_clock
from apertura.echo.demodulate import Numerology
from apertura.echo.resampling import correct_clock
from apertura.echo.sidelink import METHODS, divide
from apertura.simulation.impairments import Clock, Impairments, Timing, UniformPhase
from apertura.simulation.synthesis import samples
from apertura.study.bench import Bench, Case, Complexes, paper_bench, receive_pair
from apertura.study.focus import Floats, decibels, divided_history, find_peaks, mean_image, range_tables
from apertura.study.paper.claims import Claim
from apertura.study.window import demodulated

CLOCK_PPM = 8.0
LEAST_GAIN_DB = 20.0


def corrected_claims(*, seed: int = 1) -> list[Claim]:
    """Return what carrier phase and timing cost after each sidelink correction, as large as the prefix allows."""
    bench = paper_bench(pulses=150, subcarriers=4096, rx_ahead_m=4.7, qpsk=True)
    targets = bench.scatterers.position_m
    unknown = Impairments(carrier_phase=UniformPhase(), timing=Timing(half_width_s=2e-6))
    clean, direct, _ = receive_pair(bench, Case(transmitter=Impairments()), np.random.default_rng(seed))
    radar, sidelink, _ = receive_pair(bench, Case(unknown, Impairments(), sampled=True), np.random.default_rng(seed))
    _, ideal = find_peaks(range_tables(divided_history(bench, divide(clean, direct)), targets), targets)
    rows = []
    for name, correct in METHODS.items():
        found = divided_history(bench, correct(radar, sidelink))
        _, peaks = find_peaks(range_tables(found, targets), targets)
        worst = float(np.abs(decibels(peaks / ideal)).max())
        verdict = "agrees: below 0.01 dB" if worst < 0.01 else f"differs: {worst:.3f} dB"
        title = f"loss after {name}: carrier phase ±π and timing ±2 µs per pulse, inside the prefix"
        rows.append(Claim(title, "0", f"{worst:.4f}", "dB", f"{verdict}; worst of five targets, from samples"))
    return rows


def clock_claims(*, pulses: int = 150, ppm: float = CLOCK_PPM, seed: int = 1) -> list[Claim]:
    """Return the floor that one clock leaves in the divided image, without and with correction in the samples.

    Parameters
    ----------
    pulses
        Over the aperture.
    ppm
        By which the receiver's clock is fast.
    seed
        Of the random pixels.
    """
    bench = paper_bench(pulses=pulses, subcarriers=4096, rx_ahead_m=4.7, qpsk=True)
    wave = bench.waveform
    clock = Clock.of_ppm(ppm, carrier_hz=wave.carrier_hz, sample_rate_hz=wave.sample_rate_hz)
    captures = _captures(bench, Impairments(clock=clock))
    symbol = Numerology(
        wave.carrier_hz,
        wave.sample_rate_hz,
        np.arange(len(wave.codes)),
        prefix_samples=wave.prefix_samples,
        dft_samples=wave.dft_samples,
    )
    offset = estimate_clock(captures[1], symbol)
    cfo_hz = offset.cfo_of_pulses_hz(pulses)
    mended = [correct_clock(capture, symbol, cfo_hz=cfo_hz, sfo_ppm=offset.sfo_ppm) for capture in captures]
    ideal = _image(bench, _captures(bench, Impairments()), seed)
    before, after = (_floor_db(_image(bench, pair, seed), ideal) for pair in (captures, mended))
    gain = before - after
    verdict = "agrees" if gain >= LEAST_GAIN_DB else "differs"
    note = f"floor {before:.1f} dB without, {after:.1f} dB with, measured as {offset.sfo_ppm:.3f} ppm"
    title = f"{ppm:g} ppm clock: floor lower by correction in the samples"
    return [Claim(title, f"at least {LEAST_GAIN_DB:g}", f"{gain:.1f}", "dB", f"{verdict}; {note}")]


def _captures(bench: Bench, receiver: Impairments) -> list[Complexes]:
    _, _, seen = receive_pair(bench, Case(receiver, Impairments()), np.random.default_rng(0))
    return [samples(seen.channels[name], None).astype(np.complex64) for name in ("radar", "sidelink")]


def _image(bench: Bench, captures: list[Complexes], seed: int) -> tuple[Complexes, Floats]:
    """Return the divided image at random pixels, and the peaks of the targets."""
    window = slice(bench.waveform.prefix_samples, bench.waveform.prefix_samples + bench.waveform.dft_samples)
    radar, sidelink = (demodulated(capture[:, window], bench.waveform) for capture in captures)
    targets = bench.scatterers.position_m
    tables = range_tables(divided_history(bench, divide(radar, sidelink)), targets)
    dice = np.random.default_rng(seed)
    pixels = np.column_stack([dice.uniform(-6, 6, 256), dice.uniform(5, 25, 256), np.zeros(256)])
    return mean_image(tables, pixels[None]), find_peaks(tables, targets)[1]


def _floor_db(found: tuple[Complexes, Floats], ideal: tuple[Complexes, Floats]) -> float:
    """Return the RMS of the difference after one complex gain, against the mean peak."""
    values, reference = found[0].ravel(), ideal[0].ravel()
    gain = np.vdot(reference, values) / np.vdot(reference, reference).real
    wrong = np.abs(values - gain * reference)
    return float(decibels(np.sqrt(np.mean(wrong**2)) / found[1].mean()))
