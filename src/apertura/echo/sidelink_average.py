"""The pulses of a sidelink averaged, each aligned to its direct path: what they have in common and what changes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from apertura.echo.line_of_sight import Complexes, Floats, LineOfSight, phasor


class SidelinkAverage(NamedTuple):
    """The locked pulses of a flight, aligned to a direct path of delay 0 and amplitude 1."""

    pulses: int
    noise: float  # mean power of the noise in a delay cell of one pulse
    power: Floats  # (cell,) mean power
    mean: NDArray[np.complex128]  # (cell,) mean
    spectrum: Floats  # (subcarrier,) mean power
    second_cell: int  # typical strongest arrival of a pulse beside the direct path
    second_power: float


def average_pulses(sidelink: Complexes, path: LineOfSight) -> SidelinkAverage:
    """Return the average of the locked pulses of a sidelink, (pulse, subcarrier) complex64; `path` is the direct."""
    locked, subcarriers = np.flatnonzero(path.locked), sidelink.shape[1]
    power, spectrum, mean = np.zeros(subcarriers), np.zeros(subcarriers), np.zeros(subcarriers, np.complex128)
    cells, levels = [], []
    for first in range(0, locked.size, 64):
        some = locked[first : first + 64]
        direct = path.select(some)
        aligned = sidelink[some] * phasor(direct, subcarriers).conj() / direct.amplitude[:, None]
        profile = fft.ifft(aligned, axis=1)
        profile_power = np.abs(profile) ** 2
        power += profile_power.sum(0)
        mean += profile.sum(0)
        spectrum += (np.abs(aligned) ** 2).sum(0)
        cells.append(profile_power[:, 2:-1].argmax(1) + 2)
        levels.append(profile_power[:, 2:-1].max(1))
    level = np.concatenate(levels)
    typical = int(np.argsort(level)[level.size // 2])
    noise = float(np.mean(path.noise_power[locked] / path.amplitude[locked] ** 2)) / subcarriers
    count = locked.size
    second_cell = int(np.concatenate(cells)[typical])
    return SidelinkAverage(
        count, noise, power / count, mean / count, spectrum / count, second_cell, float(level[typical])
    )
