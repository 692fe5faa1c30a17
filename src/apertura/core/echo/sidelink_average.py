"""The pulses of a sidelink averaged, each aligned to its direct path: what they have in common and what changes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.core.echo.line_of_sight import Complexes, Floats, LineOfSight


class SidelinkAverage(NamedTuple):
    """The locked pulses of a flight, aligned to a direct path of delay 0 and amplitude 1."""

    pulses: int
    noise: float  # mean power of the noise in a delay cell of one pulse
    power: Floats  # (cell,) mean power
    mean: NDArray[np.complex128]  # (cell,) mean
    spectrum: Floats  # (subcarrier,) mean power
    second_cell: int  # typical strongest arrival of a pulse beside the direct path
    second_power: float


class Averaging:
    """Sums over the locked pulses, block by block.

    Parameters
    ----------
    subcarriers
        Of the sidelink, and cells of its profile.
    """

    def __init__(self, subcarriers: int) -> None:
        self._power, self._spectrum = np.zeros(subcarriers), np.zeros(subcarriers)
        self._mean = np.zeros(subcarriers, np.complex128)
        self._noise: list[Floats] = []
        self._cells: list[NDArray[np.intp]] = []
        self._levels: list[NDArray[np.float32]] = []

    def add(self, sidelink: Complexes, path: LineOfSight, profile: Complexes) -> None:
        """Add some pulses, (pulse, subcarrier), their direct path, and their aligned profile, (pulse, cell)."""
        locked = path.locked
        if not locked.any():
            return
        direct = path.select(locked)
        size = 1 / direct.amplitude
        turned = (size * np.exp(-1j * direct.phase_rad)).astype(np.complex64)
        unit = profile[locked] * turned[:, None]
        power = np.square(unit.real) + np.square(unit.imag)
        self._power += power.sum(0)
        self._mean += unit.sum(0)
        self._spectrum += (np.square(np.abs(sidelink[locked])) * np.square(size)[:, None]).sum(0)
        self._noise.append(direct.noise_power * np.square(size))
        self._cells.append(power[:, 2:-1].argmax(1) + 2)
        self._levels.append(power[:, 2:-1].max(1))

    def result(self) -> SidelinkAverage:
        """Return the average of what was added, at least one pulse."""
        level, noise = np.concatenate(self._levels), np.concatenate(self._noise)
        typical, count = int(np.argsort(level, kind="stable")[level.size // 2]), level.size
        return SidelinkAverage(
            count,
            float(np.mean(noise)) / self._power.size,
            self._power / count,
            self._mean / count,
            self._spectrum / count,
            int(np.concatenate(self._cells)[typical]),
            float(level[typical]),
        )
