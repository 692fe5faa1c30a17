"""Effect of each size of an impairment on the image under each correction of the sidelink."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.errors import CampaignError
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.constellation import CONSTELLATIONS
from apertura.core.echo.line_of_sight import fit_line_of_sight
from apertura.core.echo.sidelink import LEAST_NOISE, METHODS, choose, measure
from apertura.core.echo.unknown_symbols import SymbolDecider
from apertura_research import point_response
from apertura_research.paper_scene import receive_pair
from apertura_research.point_response import find_peaks, mean_image
from apertura_research.stability.sweeps import SWEEPS, UNKNOWN, ImpairmentSweep

REFUSED_DB = 40.0
"""Loss recorded if no pulse is imaged; larger losses are clipped to this value."""

_REACH_M = (0.16, 1.0)


@dataclass(frozen=True)
class StabilityRow:
    """Effect of one impairment of one size on the image under one correction: a row of the CSV.

    Attributes
    ----------
    loss_db, loss_spread_db
        Mean loss of the five peaks relative to the undisturbed scene, and its standard deviation over the draws.
    coherence_factor
        Mean over the targets and draws.
    ground_width_m, cross_width_m
        −3 dB widths of the third target, median over the draws; NaN if the target has no main lobe.
    floor_db
        RMS error at random pixels of the scene, relative to the mean peak.
    pulses_used
        Mean fraction of imaged pulses.
    chosen
        Method applied in most draws; `refused` if the sidelink locks in no pulse.
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


def sizes_of(part: str) -> tuple[float, ...]:
    """Return the simulated sizes of a part, `IMPAIRMENT.METHOD`."""
    return SWEEPS[part.partition(".")[0]].sizes


def run_size(part: str, size: float, *, seed: int = 1) -> list[StabilityRow]:
    """Simulate one size of an impairment of `SWEEPS` under a correction of `CHOICES`.

    Draws depend only on the seed and their number: the random numbers are the same for every method and size.
    """
    impairment, _, method = part.partition(".")
    sweep = SWEEPS[impairment]
    ideal = _undisturbed(sweep)
    draws = [_draw(sweep, size, method, ideal, np.random.default_rng([seed, i])) for i in range(sweep.draws)]
    measured = [one for one, _ in draws]
    mean, spread = (_rounded(statistic(measured, axis=0)) for statistic in (np.mean, np.std))
    width = _rounded(np.median(measured, axis=0))
    chosen = [one for _, one in draws]
    row = StabilityRow(
        impairment=impairment,
        unit=sweep.unit,
        size=float(size),
        method=method,
        loss_spread_db=spread.loss_db,
        **mean._replace(ground_width_m=width.ground_width_m, cross_width_m=width.cross_width_m)._asdict(),
        chosen=max(sorted(set(chosen)), key=chosen.count),
        draws=sweep.draws,
        seed=seed,
    )
    return [row]


class _Measured(NamedTuple):
    loss_db: float
    coherence_factor: float
    ground_width_m: float
    cross_width_m: float
    floor_db: float
    pulses_used: float


def _rounded(values: Floats) -> _Measured:
    return _Measured(*(round(float(value), 4) + 0.0 for value in values))


class _Ideal(NamedTuple):
    peaks: Floats
    pixels_m: Floats
    values: Complexes


def _undisturbed(sweep: ImpairmentSweep) -> _Ideal:
    """Return the peaks and the image at random pixels of the undisturbed scene."""
    scene = sweep.flown(0.0)
    tables = point_response.undisturbed_tables(scene)
    pixels = point_response.random_pixels(np.random.default_rng(0))
    peaks = find_peaks(tables, scene.scatterers.position_m, reach_m=_REACH_M)[1]
    return _Ideal(peaks, pixels, mean_image(tables, pixels))


def _draw(
    sweep: ImpairmentSweep, size: float, method: str, ideal: _Ideal, generator: np.random.Generator
) -> tuple[_Measured, str]:
    """Return the metrics of one draw and the applied method."""
    flown = sweep.flown(size)
    radar, sidelink, observation = receive_pair(flown, sweep.disturbance(size), generator)
    logged = sweep.logged(flown, size, generator)
    kept, transfer, chosen = correct(method, radar, sidelink, observation.draw.kept, generator)
    if not kept.any():
        return _Measured(REFUSED_DB, 0.0, np.nan, np.nan, 0.0, 0.0), chosen
    history = point_response.phase_history(logged, transfer, divided=chosen != "none", pulses=kept)
    return _measured(history, ideal, float(kept.mean()), flown.scatterers.position_m), chosen


def correct(
    method: str,
    radar: Complexes,
    sidelink: Complexes,
    recorded: NDArray[np.bool_],
    generator: np.random.Generator,
) -> tuple[NDArray[np.bool_], Complexes, str]:
    """Return the mask of used pulses, their corrected transfer functions, and the applied method.

    Pulses whose sidelink does not lock are excluded, as in the pipeline.

    Parameters
    ----------
    method
        One of `CHOICES`.
    radar, sidelink
        (pulse, subcarrier) complex64.
    recorded
        (pulse,) bool.
    generator
        Source of the transmitted symbols, if they are unknown.
    """
    if method == "none":
        return recorded, radar[recorded], "none"
    kept = recorded.copy()
    chosen = method
    try:
        if method == "auto":
            state = measure(sidelink[recorded])
            chosen, _ = choose(state)
            kept[recorded] = state.locked
        elif method == UNKNOWN:
            # symbols of constant modulus turn the noise, which is circular
            qpsk, pulses = CONSTELLATIONS["qpsk"], np.arange(int(recorded.sum()))
            sent = qpsk.points[generator.integers(0, len(qpsk.points), sidelink[recorded].shape)]
            received = sidelink[recorded] * sent
            decisions = SymbolDecider.measured([(pulses, received)], qpsk).decide(received, pulses)
            turned = sent / decisions.symbols
            divides = np.median(decisions.snr) < qpsk.least_snr
            chosen = "divide" if divides else choose(measure(received / decisions.symbols), LEAST_NOISE)[0]
            kept[recorded] = decisions.path.locked if divides else decisions.sure
            radar, sidelink = radar.copy(), sidelink.copy()
            radar[recorded] *= turned
            sidelink[recorded] *= turned
        else:
            kept[recorded] = fit_line_of_sight(sidelink[recorded]).locked
    except CampaignError:
        return np.zeros_like(kept), radar[:0], "refused"
    if not kept.any():
        return kept, radar[:0], "refused"
    return kept, METHODS[chosen](radar[kept], sidelink[kept]), chosen


def _measured(history: PhaseHistory, ideal: _Ideal, used: float, targets_m: Floats) -> _Measured:
    tables = point_response.range_tables(history, targets_m)
    positions, peaks = find_peaks(tables, targets_m, reach_m=_REACH_M)
    gain_db = point_response.amplitude_db(peaks / ideal.peaks)
    floor_db = point_response.error_floor_db(mean_image(tables, ideal.pixels_m), ideal.values, peaks)
    widths_m = point_response.half_power_widths(lambda pixels: mean_image(tables, pixels), positions[2])
    coherence = float(point_response.coherence_factors(history, positions).mean())
    loss_db = float(np.clip(-gain_db, -REFUSED_DB, REFUSED_DB).mean())
    return _Measured(loss_db, coherence, *widths_m, floor_db, used)
