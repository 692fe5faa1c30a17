"""The uncorrected-loss table: what each error costs the peaks of the five targets, beside an independent model."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from apertura.echo.sidelink import divide
from apertura.simulation.impairments import Clock, Impairments, Localization, Timing, UniformPhase
from apertura.simulation.presets import paper_waveform
from apertura.study.bench import Bench, Case, Complexes, paper_bench, receive_pair
from apertura.study.focus import REACH_M, Floats, History, decibels, divided_history, find_peaks, history, range_tables
from apertura.study.paper.claims import Claim

DESTROYED_DB = -12.0
"""Beyond it there is no peak to measure: the largest speckle near the target is reported."""


@dataclass(frozen=True, eq=False)
class Error:
    """One error of the table.

    Attributes
    ----------
    title, unit
        For rows and figures.
    claimed_db
        Size, in `unit` → mean peak loss of an independent model, dB.
    case
        Size → what goes wrong.
    bench
        Number of pulses → the scene.
    pulses
        That settle the losses: 150 agree with 300 to 0.03 dB where nothing is random.
    draws
        Over which the loss is averaged; 1 where nothing is random.
    within_db
        Largest difference that agrees.
    divided
        Whether the sidelink is divided out (and its length is as wrong as the positions).
    reach_m
        How far peaks are looked for.
    note
        Appended to each verdict.
    """

    title: str
    unit: str
    claimed_db: Mapping[float, float]
    case: Callable[[float], Case]
    bench: Callable[[int], Bench]
    pulses: int
    draws: int = 1
    within_db: float = 0.5
    divided: bool = False
    reach_m: tuple[float, float] = REACH_M
    note: str = ""


def _few_subcarriers(pulses: int) -> Bench:
    return paper_bench(pulses=pulses, subcarriers=128)


def _all_subcarriers(pulses: int) -> Bench:
    return paper_bench(pulses=pulses, subcarriers=4096, qpsk=True)


def _sfo(khz: float) -> Case:
    """Return a sampling rate off by so much, the time error counted from the start of the DFT window."""
    wave, off_hz = paper_waveform(), 1e3 * khz
    start_s = wave.cyclic_prefix_s * off_hz / (wave.sample_rate_hz + off_hz)
    return Case(Impairments(clock=Clock(sfo_hz=off_hz), timing=Timing(offset_s=start_s)), sampled=True)


def _localization(centimetres: float) -> Case:
    wrong = Impairments(localization=Localization(centimetres / 100))
    return Case(wrong, wrong)


ERRORS: Mapping[str, Error] = {
    "carrier_phase": Error(
        "Carrier phase per pulse, uniform ±",
        "π rad",
        {0.125: -0.23, 0.25: -0.92, 0.5: -3.96, 0.75: -10.5, 1.0: -30.0},
        lambda size: Case(Impairments(carrier_phase=UniformPhase(size * np.pi))),
        _few_subcarriers,
        3000,
        draws=4,
    ),
    "timing": Error(
        "Timing offset per pulse, uniform ±",
        "ns",
        {0.05: -0.29, 0.1: -1.18, 0.2: -5.2, 0.5: -14.6, 1.0: -23.0},
        lambda size: Case(Impairments(timing=Timing(half_width_s=1e-9 * size))),
        _few_subcarriers,
        3000,
        draws=4,
    ),
    "cfo": Error(
        "Carrier frequency offset",
        "kHz",
        {10: -0.15, 30: -1.39, 50: -4.1, 100: -31.5},
        lambda size: Case(Impairments(clock=Clock(cfo_hz=1e3 * size)), sampled=True),
        _all_subcarriers,
        150,
        note="random QPSK code; a quadratic-phase code loses half as much, in dB, and shifts the targets",
    ),
    "sfo": Error(
        "Sampling frequency offset",
        "kHz",
        {100: -1.05, 200: -4.0, 400: -9.3, 1000: -15.0},
        _sfo,
        _all_subcarriers,
        150,
        reach_m=(0.16, 1.5),
        note="time error counted from the DFT window; counted from the prefix a third more is lost, by defocusing",
    ),
    "localization": Error(
        "Localization error, σ per axis after 1 s, bistatic",
        "cm",
        {0.5: -0.31, 1: -1.24, 2: -5.0, 3: -10.5},
        _localization,
        lambda pulses: paper_bench(pulses=pulses, subcarriers=128, rx_ahead_m=4.7),
        600,
        draws=40,
        within_db=1.0,
        divided=True,
    ),
}


def loss_claims(name: str, *, draws: int | None = None, seed: int = 1) -> list[Claim]:
    """Return a row for each size of one error: mean peak loss over five targets and all draws.

    Parameters
    ----------
    name
        A key of `ERRORS`.
    draws
        Instead of the error's own.
    seed
        Of everything random.
    """
    error = ERRORS[name]
    count = draws or error.draws
    rows = []
    for size, claimed_db in error.claimed_db.items():
        found = [peak_losses_db(error, size, np.random.default_rng([seed, draw])).mean() for draw in range(count)]
        rows.append(_row(error, size, claimed_db, np.array(found)))
    return rows


def peak_losses_db(error: Error, size: float, generator: np.random.Generator) -> Floats:
    """Return (target,) loss of the peaks against the undisturbed scene, dB, negative."""
    bench = _bench(error)
    targets = bench.scatterers.position_m
    radar, sidelink, _ = receive_pair(bench, error.case(size), generator)
    found = observed(bench, radar, sidelink, divided=error.divided)
    _, peaks = find_peaks(range_tables(found, targets), targets, reach_m=error.reach_m)
    return decibels(peaks / _undisturbed(error))


def observed(bench: Bench, radar: Complexes, sidelink: Complexes, *, divided: bool) -> History:
    """Return what is focused: the radar alone, or divided by the sidelink."""
    return divided_history(bench, divide(radar, sidelink)) if divided else history(bench, radar)


@lru_cache(maxsize=2)
def _bench(error: Error) -> Bench:
    return error.bench(error.pulses)


@lru_cache(maxsize=2)
def _undisturbed(error: Error) -> Floats:
    bench = _bench(error)
    targets = bench.scatterers.position_m
    radar, _, _ = receive_pair(bench, Case(), np.random.default_rng(0))
    return find_peaks(range_tables(history(bench, radar), targets), targets)[1]


def _row(error: Error, size: float, claimed_db: float, found: Floats) -> Claim:
    mean, spread = float(found.mean()), float(found.std())
    both = claimed_db < DESTROYED_DB and mean < DESTROYED_DB
    if both:
        verdict = "agrees: destroyed"
    elif abs(mean - claimed_db) <= error.within_db:
        verdict = f"agrees within {error.within_db:g} dB"
    else:
        verdict = f"differs by {mean - claimed_db:+.2f} dB"
    over = f"mean of {found.size} draws, spread {spread:.2f} dB" if found.size > 1 else "nothing random"
    words = "; ".join(part for part in (verdict, over, error.note) if part)
    return Claim(
        f"uncorrected loss: {error.title} {size:g} {error.unit}", f"{claimed_db:g}", f"{mean:.2f}", "dB", words
    )
