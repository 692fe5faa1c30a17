"""What arrives beside the direct path of a sidelink: echoes, ripple, and what changes from pulse to pulse.

Source: docs/theory/echo_methods.md, "State of a sidelink".
"""

import numpy as np
from scipy.special import gammainccinv

from apertura.core.echo.line_of_sight import LOCK_FALSE_ALARM
from apertura.core.echo.sidelink_average import SidelinkAverage

GATE_CELLS = 16
"""Half width of the gate, in cells of 1/B around the direct path."""


def strongest_echo(average: SidelinkAverage) -> tuple[float, int]:
    """Return level (dB) and delay (cells, 0 if none) of the strongest arrival beside the direct path.

    Ripple makes echoes on both sides of the direct path, a reflection on one; only the excess of one side counts.
    """
    cells = np.arange(2, average.power.size - 1)
    excess = average.power - average.noise
    one_sided = np.where(excess[cells] > 4 * np.abs(excess[-cells]), excess[cells] - excess[-cells], 0.0)
    best = int(np.argmax(one_sided))
    level, cell = float(one_sided[best]), int(cells[best])
    # what the highest of N averages of exponential noise passes with the chance of a false lock
    highest = gammainccinv(average.pulses, LOCK_FALSE_ALARM / average.power.size) / average.pulses
    seen = average.noise * (float(highest) - 1)
    # what moves from pulse to pulse drowns in the average: another transmitter with a clock of its own
    highest_noise = average.noise * np.log(average.power.size / LOCK_FALSE_ALARM)
    if average.second_power > max(4 * average.power[average.second_cell], highest_noise, level):
        level, cell = average.second_power, average.second_cell
    if level <= seen:
        return decibels(seen), 0
    return decibels(level), cell if cell < average.power.size / 2 else cell - average.power.size


def ripple(average: SidelinkAverage, *, one_sided: bool) -> tuple[float, int, float]:
    """Return ripple (peak to peak, dB) inside the gate, its strongest cell, and ripple outside.

    It is told by echoes that all pulses have in common:

    cos of amplitude a makes two echoes of a/2, a reflection in the transmitter one of a. Outside the gate, and
    inside unless `one_sided`, an echo without a partner is taken for another path of the sidelink.
    """
    power = np.abs(average.mean / average.mean[0]) ** 2
    cells = np.arange(1, power.size // 2)
    noise = average.noise / average.pulses
    sides = np.stack([power[cells], power[-cells]]) - noise
    single = np.sqrt(np.where(sides > 9 * noise, sides, 0.0)).sum(0)
    paired = np.sqrt(np.where(sides.min(0) > 5 * noise, sides.min(0), 0.0)) * 2
    inside = cells <= GATE_CELLS
    amplitudes = (single if one_sided else paired)[inside], paired[~inside]
    coarse, fine = (min(float(np.sqrt((amplitude**2).sum())), 0.95) for amplitude in amplitudes)
    strongest = int(cells[inside][amplitudes[0].argmax()]) if coarse else 0
    return _peak_to_peak_db(coarse), strongest, _peak_to_peak_db(fine)


def changing_near(average: SidelinkAverage) -> float:
    """Return what changes from pulse to pulse within two cells of the direct path, dB; -300 where it is noise."""
    near = [1, 2, -1, -2]
    excess = average.power[near] - np.abs(average.mean[near]) ** 2 - average.noise
    seen = 5 * average.noise * np.sqrt(len(near) / average.pulses)
    total = float(excess.sum())
    return decibels(total) if total > seen and average.pulses > 1 else -300.0


def _peak_to_peak_db(amplitude: float) -> float:
    return float(20 * np.log10((1 + amplitude) / (1 - amplitude)))


def decibels(power: float) -> float:
    """Return 10 log10 of a power; -300 of none."""
    return float(10 * np.log10(max(power, 1e-30)))
