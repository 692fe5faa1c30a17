"""How much of each impairment each correction of the sidelink survives."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.echo.line_of_sight import fit_line_of_sight
from apertura.echo.sidelink import METHODS, choose, measure
from apertura.errors import CampaignError
from apertura.study.bench import Bench, Case, Complexes, receive_pair
from apertura.study.focus import (
    Floats,
    History,
    coherence_factors,
    decibels,
    divided_history,
    find_peaks,
    half_power_widths,
    mean_image,
    range_tables,
)
from apertura.study.stability.sweeps import SWEEPS, Sweep

REFUSED_DB = 40.0
"""Loss entered where nothing is imaged, and the largest that is told apart."""

_REACH_M = (0.16, 1.0)


@dataclass(frozen=True)
class Outcome:
    """What one impairment of one size did to the image under one correction: a row of the CSV.

    Attributes
    ----------
    impairment, unit, size, method
        What was tried.
    loss_db, loss_spread_db
        Loss of the five peaks against the undisturbed scene, and its standard deviation over the draws.
    coherence_factor
        Mean over the targets and draws.
    ground_width_m, cross_width_m
        −3 dB widths of the third target, median over the draws; NaN where it has no main lobe.
    floor_db
        RMS of what is wrong at random pixels of the scene, against the mean peak.
    pulses_used
        Mean share of the pulses that were imaged.
    chosen
        Method that was applied in most draws; `refused` where none locks.
    draws, seed
        How often, from which seed.
    """

    impairment: str
    unit: str
    size: float
    method: str
    loss_db: float
    loss_spread_db: float
    coherence_factor: float
    ground_width_m: float
    cross_width_m: float
    floor_db: float
    pulses_used: float
    chosen: str
    draws: int
    seed: int


@dataclass(frozen=True)
class _Draw:
    loss_db: float
    coherence: float
    widths_m: tuple[float, float]
    floor_db: float
    used: float
    chosen: str


def run_sweep(impairment: str, method: str, *, seed: int = 1) -> Iterator[Outcome]:
    """Yield the outcome at each size of one impairment under one correction.

    Parameters
    ----------
    impairment
        A key of `SWEEPS`.
    method
        One of `CHOICES`.
    seed
        Draws depend on it and on their number alone: every method and size meets the same dice.
    """
    sweep = SWEEPS[impairment]
    for size in sweep.sizes:
        ideal = _undisturbed(sweep.flown(0.0))
        found = [_draw(sweep, size, method, ideal, np.random.default_rng([seed, i])) for i in range(sweep.draws)]
        losses = np.array([one.loss_db for one in found])
        chosen = [one.chosen for one in found]
        ground, cross = np.median([one.widths_m for one in found], axis=0)
        yield Outcome(
            impairment=impairment,
            unit=sweep.unit,
            size=float(size),
            method=method,
            loss_db=_rounded(losses.mean()),
            loss_spread_db=_rounded(losses.std()),
            coherence_factor=_rounded(np.mean([one.coherence for one in found])),
            ground_width_m=_rounded(ground),
            cross_width_m=_rounded(cross),
            floor_db=_rounded(np.mean([one.floor_db for one in found])),
            pulses_used=_rounded(np.mean([one.used for one in found])),
            chosen=max(sorted(set(chosen)), key=chosen.count),
            draws=sweep.draws,
            seed=seed,
        )


def _rounded(value: float | np.floating) -> float:
    return round(float(value), 4) + 0.0


@dataclass(frozen=True)
class _Ideal:
    peaks: Floats
    pixels_m: Floats
    values: Complexes


def _undisturbed(bench: Bench) -> _Ideal:
    """Return the peaks, and the image at random pixels, of the scene with nothing wrong."""
    targets = bench.scatterers.position_m
    radar, _, _ = receive_pair(bench, Case(), np.random.default_rng(0))
    tables = range_tables(_alone(bench, radar, np.ones(len(radar), bool)), targets)
    dice = np.random.default_rng(0)
    pixels = np.column_stack([dice.uniform(-6, 6, 256), dice.uniform(5, 25, 256), np.zeros(256)])[None]
    return _Ideal(find_peaks(tables, targets, reach_m=_REACH_M)[1], pixels, mean_image(tables, pixels))


def _draw(sweep: Sweep, size: float, method: str, ideal: _Ideal, generator: np.random.Generator) -> _Draw:
    flown = sweep.flown(size)
    radar, sidelink, seen = receive_pair(flown, sweep.case(size), generator)
    logged = sweep.logged(flown, size, generator)
    kept, transfer, chosen = correct(method, radar, sidelink, seen.draw.kept)
    if not kept.any():
        return _Draw(REFUSED_DB, 0.0, (np.nan, np.nan), 0.0, 0.0, chosen)
    image = _alone if chosen == "none" else _divided
    return _measured(image(logged, transfer, kept), ideal, float(kept.mean()), chosen, flown.scatterers.position_m)


def _alone(bench: Bench, transfer: Complexes, kept: NDArray[np.bool_]) -> History:
    geometry = bench.geometry
    return History(transfer, bench.frequency_hz, geometry.radar_tx[kept], geometry.radar_rx[kept])


def _divided(bench: Bench, transfer: Complexes, kept: NDArray[np.bool_]) -> History:
    return divided_history(bench, transfer, pulses=kept)


def correct(
    method: str, radar: Complexes, sidelink: Complexes, recorded: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], Complexes, str]:
    """Return which pulses are kept, their corrected transfer functions, and the method applied.

    Pulses whose sidelink does not lock are dropped, as the pipeline drops them.

    Parameters
    ----------
    method
        One of `CHOICES`.
    radar, sidelink
        (pulse, subcarrier) complex64.
    recorded
        (pulse,) bool, which pulses the receiver recorded.
    """
    if method == "none":
        return recorded, radar[recorded], "none"
    kept = recorded.copy()
    chosen = method
    if method == "auto":
        try:
            state = measure(sidelink[recorded])
        except CampaignError:
            return np.zeros_like(kept), radar[:0], "refused"
        chosen, _ = choose(state)
        kept[recorded] = state.locked
    else:
        kept[recorded] = fit_line_of_sight(sidelink[recorded]).locked
    if not kept.any():
        return kept, radar[:0], "refused"
    return kept, METHODS[chosen](radar[kept], sidelink[kept]), chosen


def _measured(found: History, ideal: _Ideal, used: float, chosen: str, targets_m: Floats) -> _Draw:
    tables = range_tables(found, targets_m)
    places, peaks = find_peaks(tables, targets_m, reach_m=_REACH_M)
    loss = float(np.clip(-decibels(peaks / ideal.peaks), -REFUSED_DB, REFUSED_DB).mean())
    values = mean_image(tables, ideal.pixels_m)
    gain = np.vdot(ideal.values, values) / np.vdot(ideal.values, ideal.values).real
    floor = float(decibels(np.sqrt(np.mean(np.abs(values - gain * ideal.values) ** 2)) / peaks.mean()))
    widths = half_power_widths(tables, places[2])
    return _Draw(loss, float(coherence_factors(found, places).mean()), widths, floor, used, chosen)


def crossing(sizes: Floats, losses_db: Floats, level_db: float, *, logarithmic: bool) -> float:
    """Return the size at which the loss first passes a level, interpolated; NaN if it never does.

    Parameters
    ----------
    sizes
        (size,) float64 from harmless to ruinous, rising or falling.
    losses_db
        (size,) float64.
    level_db
        What is passed.
    logarithmic
        Interpolate in the logarithm of the size.

    Examples
    --------
    >>> crossing(np.array([1.0, 10.0, 100.0]), np.array([0.0, 0.5, 1.5]), 1.0, logarithmic=True)
    31.6...
    >>> crossing(np.array([30.0, 0.0]), np.array([0.1, 0.2]), 1.0, logarithmic=False)
    nan
    """
    above = np.flatnonzero(losses_db >= level_db)
    if not above.size:
        return float("nan")
    i = int(above[0])
    if i == 0:
        return float(sizes[0])
    scale: Callable[[Floats], Floats] = np.log if logarithmic else np.asarray
    place = np.interp(level_db, losses_db[i - 1 : i + 1], scale(sizes[i - 1 : i + 1]))
    return float(np.exp(place) if logarithmic else place)
