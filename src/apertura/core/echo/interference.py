"""Narrow-band interference: exclusion of subcarriers whose noise exceeds that of their neighbours, by weights.

docs/theory/interference.md: detection (eq. 1), weights (eq. 2), cost (eq. 3).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.errors import number_of
from apertura.common.flags import Flags
from apertura.common.units import decibels

_NEIGHBOURS = 32  # inverse share of the band in half the window of the noise median
_FEWEST_NEIGHBOURS = 8

EXCESS_DB = 6.0
"""Excess of the noise over that of the neighbours, dB, above which a subcarrier is excluded."""

LEAST_GAIN_DB = 0.1
"""Least gain in SNR by the exclusion, dB; a smaller gain does not justify its sidelobes."""

SERVICES: tuple[tuple[float, float, str], ...] = (
    (420e6, 450e6, "radar, amateur radio"),
    (694e6, 862e6, "mobile network or television"),
    (880e6, 960e6, "mobile network"),
    (960e6, 1164e6, "DME, TACAN, secondary radar"),
    (1164e6, 1215e6, "DME, GNSS L5/E5"),
    (1215e6, 1300e6, "GNSS L2/E6, air surveillance radar"),
    (1300e6, 1400e6, "air surveillance radar"),
    (1427e6, 1518e6, "mobile network"),
    (1525e6, 1559e6, "satellite downlink (Inmarsat)"),
    (1559e6, 1610e6, "GNSS L1/E1"),
    (1610e6, 1626.5e6, "Iridium, Globalstar"),
    (1710e6, 2170e6, "mobile network"),
    (2300e6, 2400e6, "mobile network"),
    (2400e6, 2500e6, "wireless LAN, UAV links"),
    (2500e6, 2690e6, "mobile network"),
    (2700e6, 2900e6, "airport surveillance radar"),
    (2900e6, 3300e6, "marine radar"),
    (3300e6, 4200e6, "mobile network"),
    (4200e6, 4400e6, "radar altimeter"),
    (5150e6, 5895e6, "wireless LAN, UAV links"),
    (8500e6, 10500e6, "marine and weather radar"),
)
"""Frequency bands (Hz) and their usual transmitters (ITU Radio Regulations, Article 5, abridged)."""


@dataclass(frozen=True, eq=False)
class Interference:
    """Subcarriers with interference.

    Attributes
    ----------
    frequency_hz
        (subcarrier,) float64, of the band.
    noise
        (subcarrier,) float64, noise power (eq. 1).
    excess
        (subcarrier,) float64, noise power relative to that of the neighbours.
    weight
        (subcarrier,) float64, of range compression; sums to 1.
    """

    frequency_hz: Floats
    noise: Floats
    excess: Floats
    weight: Floats

    @classmethod
    def measured(cls, groups: Sequence[Complexes], frequency_hz: Floats, weight: Floats) -> "Interference":
        """Measure the noise of each subcarrier on groups of consecutive pulses.

        Parameters
        ----------
        groups
            (pulse, subcarrier) transfer functions of the pulses of `apertura.core.echo.captures.sampled_pulses`.
        frequency_hz, weight
            Of the subcarriers.

        Notes
        -----
        Source: docs/theory/interference.md, eq. 1.

        Examples
        --------
        >>> rng = np.random.default_rng(1)
        >>> received = (rng.normal(size=(400, 64, 2)) @ [1, 1j]).astype(np.complex64)
        >>> received[:, 20] += 20 * np.exp(2j * np.pi * rng.random(400))
        >>> frequency = 1.2e9 + 1e6 * np.arange(64)
        >>> found = Interference.measured(np.split(received, 50), frequency, np.full(64, 1 / 64))
        >>> np.flatnonzero(found.excluded).tolist(), found.is_removed
        ([20], True)
        >>> found.flags["interference"]
        '1 subcarrier at 1220.00 MHz (GNSS L2/E6, air surveillance radar): noise 22.6 dB above the neighbours; excluded'
        """
        total, differences = np.zeros(len(frequency_hz)), 0
        for group in groups:
            change = np.abs(np.diff(group, axis=0)) ** 2 / 2
            total += change.sum(axis=0, dtype=np.float64)
            differences += len(change)
        noise = total / max(differences, 1)
        size = 2 * max(_FEWEST_NEIGHBOURS, len(noise) // _NEIGHBOURS) + 1
        usual = scipy.ndimage.median_filter(noise, size=min(size, len(noise)), mode="nearest")
        excess = np.divide(noise, usual, out=np.ones_like(noise), where=usual > 0)
        return cls(frequency_hz, noise, excess, weight)

    @property
    def excluded(self) -> NDArray[np.bool_]:
        """(subcarrier,) bool, True for subcarriers with interference."""
        return self.excess >= 10 ** (EXCESS_DB / 10)

    @property
    def lost_share(self) -> float:
        """Share of the weights of the excluded subcarriers."""
        return float(self.weight[self.excluded].sum())

    @property
    def gain_db(self) -> float:
        """SNR gained in the image by the exclusion, dB (eq. 3)."""
        kept = ~self.excluded
        noise = [(self.weight[some] ** 2 * self.noise[some]).sum() for some in (slice(None), kept)]
        if noise[1] <= 0:
            return 0.0
        return decibels(float(noise[0] / noise[1])) + 20 * math.log10(max(1 - self.lost_share, 1e-15))

    @property
    def sidelobe_db(self) -> float:
        """Upper bound of the range sidelobes that the exclusion causes, dB (eq. 3)."""
        return 20 * math.log10(max(self.lost_share, 1e-15) / max(1 - self.lost_share, 1e-15))

    @property
    def is_removed(self) -> bool:
        """True if subcarriers are excluded: the exclusion gains SNR."""
        return bool(self.excluded.any()) and self.gain_db >= LEAST_GAIN_DB

    @property
    def gain(self) -> NDArray[np.float32]:
        """(subcarrier,) float32, factors of eq. 2: 0 for excluded subcarriers; the rest preserves echo amplitudes."""
        return np.where(self.excluded, 0.0, 1 / (1 - self.lost_share)).astype(np.float32)

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values."""
        if not self.excluded.any():
            return {"subcarriers": 0}
        return {
            "subcarriers": int(self.excluded.sum()),
            "frequencies_hz": self.frequency_hz[self.excluded][:_LISTED].tolist(),
            "excess_db": round(decibels(float(self.excess.max())), 1),
            "excluded": self.is_removed,
            "gain_db": round(self.gain_db, 2),
            "sidelobe_db": round(self.sidelobe_db, 1),
        }

    @property
    def flags(self) -> Flags:
        """Flag `interference` if any subcarrier has interference."""
        if not self.excluded.any():
            return Flags()
        excess, strongest = decibels(float(self.excess.max())), float(self.frequency_hz[self.excess.argmax()])
        service = next((name for low, high, name in SERVICES if low <= strongest < high), "no usual service")
        done = "excluded" if self.is_removed else "not excluded, as that gains nothing"
        number = number_of(int(self.excluded.sum()), "subcarrier")
        where = (
            f"{number} at {1e-6 * strongest:.2f} MHz"
            if self.excluded.sum() == 1
            else (f"{number}, the strongest at {1e-6 * strongest:.2f} MHz")
        )
        return Flags({"interference": f"{where} ({service}): noise {excess:.1f} dB above the neighbours; {done}"})


_LISTED = 32  # largest number of frequencies in a report
