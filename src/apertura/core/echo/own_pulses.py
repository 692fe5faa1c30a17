"""Checks of the monostatic echoes of a node: transmitted code, and phase stability from pulse to pulse."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.units import decibels

# ---- Code of the pulses of a monostatic node

FALSE_ALARM = 1e-5
"""Probability that a wrong code is confirmed."""

_COHERENT_PULSES = 8, 32, 128  # numbers of pulses that are added coherently at each Doppler frequency
_GUARD_CELLS = 8  # cells excluded on both sides of the prefix because of sidelobes of echoes inside the prefix
_FEWEST_CELLS = 32  # minimum number of cells outside the prefix to estimate the floor
_NOISE_SIGMAS = 6.0  # excess scatter above which cells outside the prefix may contain signals in addition to noise
_SPREAD_SIGMAS = 10.0  # excess scatter above which these cells certainly contain signals in addition to noise


@dataclass(frozen=True)
class CodeEvidence:
    """Evidence for the code of a recording.

    Attributes
    ----------
    carried
        True if the recording contains the code, False if it does not; None without evidence.
    evidence
        Measured values, one line.
    """

    carried: bool | None
    evidence: str

    @property
    def report(self) -> dict[str, Any]:
        """Values for the attributes of a stage."""
        return asdict(self)

    @property
    def flags(self) -> dict[str, str]:
        """Flag that is raised if the recording does not contain the code."""
        return {"code_unconfirmed": self.evidence} if self.carried is False else {}


def own_code(transfer: NDArray[np.complex64], *, prefix_cells: int) -> CodeEvidence:
    """Test the code of monostatic echoes: the correct code compresses echoes inside the prefix.

    Parameters
    ----------
    transfer
        (pulse, subcarrier) complex64, with the code removed; echoes are in the first `prefix_cells` cells of 1/B.
    prefix_cells
        Number of cells of 1/B in the cyclic prefix, or in the longest complete delay of a pulse without repetition.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Own code".

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> noise = (rng.normal(size=(64, 256)) + 1j * rng.normal(size=(64, 256))).astype(np.complex64)
    >>> [own_code(transfer, prefix_cells=64).carried for transfer in (noise, noise + 1)]
    [None, True]
    """
    pulses, cells = transfer.shape
    outside = slice(prefix_cells + _GUARD_CELLS, cells - _GUARD_CELLS)
    if not prefix_cells or outside.stop - outside.start < _FEWEST_CELLS:
        return CodeEvidence(
            None, f"{prefix_cells} of {cells} delay cells may contain echoes: too few cells remain to measure the floor"
        )
    profile = scipy.fft.ifft(transfer, 2 * cells, axis=1)  # half cells, so that no echo falls between two cells
    largest_scatter, beyond = -np.inf, slice(2 * outside.start, -2 * _GUARD_CELLS, 2)
    for run in [run for run in _COHERENT_PULSES if run <= pulses] or [pulses]:
        level, needed, scatter = _strongest(profile, run, 2 * prefix_cells, beyond)
        largest_scatter = max(largest_scatter, scatter)
        line = (
            f"in the sum of {run} pulses, the strongest complete echo is {decibels(level):.1f} dB above the mean "
            "beyond the longest delay"
        )
        if level >= needed:
            return CodeEvidence(True, line)
    if largest_scatter > _SPREAD_SIGMAS:
        return CodeEvidence(
            False,
            f"{line}; a signal common to all pulses is spread over all delays: the code is wrong, or another node "
            "transmits",
        )
    return CodeEvidence(
        None, f"{line}; {decibels(needed):.1f} dB are required: no echo exceeds the noise, or the code is wrong"
    )


def _strongest(profile: NDArray[np.complex64], run: int, inside: int, beyond: slice) -> tuple[float, float, float]:
    """Return the level of the strongest cell inside the prefix, its threshold, and the excess scatter outside, in σ.

    Levels are relative to the mean over the cells outside the prefix at the same Doppler frequency.
    """
    blocks = len(profile) // run
    power = np.zeros((2 * run, profile.shape[1]), np.float32)
    for first in range(0, blocks * run, run):
        power += np.abs(scipy.fft.fft(profile[first : first + run], 2 * run, axis=0)) ** 2
    floor = power[:, beyond].astype(np.float64)
    mean = np.maximum(floor.mean(1), 1e-30)
    scatter = floor.std(1) / mean
    false_alarm = FALSE_ALARM / (inside * len(power))  # per cell
    sigmas = (blocks * scatter**2 - 1) / np.sqrt((2 + 6 / blocks) / floor.shape[1])
    # The floor caused by a wrong code is the same in all pulses. Unlike noise, it is exponentially distributed over the
    # cells for any number of added pulses.
    is_noise = sigmas.max() < _NOISE_SIGMAS
    needed = (
        scipy.special.gammainccinv(blocks, false_alarm) / blocks
        if is_noise
        else 1 - scatter * (1 + np.log(false_alarm))
    )
    level = power[:, :inside].max(1) / mean
    best = int((level / needed).argmax())
    return float(level[best]), float(np.broadcast_to(needed, level.shape)[best]), float(sigmas.max())


# ---- Phase stability of monostatic echoes

LEAST_COHERENCE = 0.3
"""Minimum coherence of the second differences of phase; it corresponds to 1.55 rad rms, or white phase noise of
0.63 rad."""

STEADY = 0.93
"""Minimum agreement of magnitudes from pulse to pulse. The agreement is π/4 for independent speckle, and 0.95 for an
SNR of 10 dB."""

ECHO_DB = 13.0
"""Minimum mean power of evaluated cells relative to the noise, dB; in weaker cells, noise dominates the phase."""

_FEWEST_TRIPLES = 20  # minimum number of triples of consecutive pulses to estimate a coherence
_EVEN = 0.25  # tolerated relative deviation from the median interval; a larger deviation indicates missing pulses


@dataclass(frozen=True)
class PhaseStability:
    """Phase stability of echoes from pulse to pulse.

    Attributes
    ----------
    coherence
        |mean exp(jφ'')| of the second differences φ'' of phase, weighted by power; 1 for smooth motion.
    steadiness
        Agreement of the magnitudes of consecutive pulses; 1 for constant scatterers.
    """

    coherence: float
    steadiness: float

    @property
    def rms_rad(self) -> float:
        """RMS of the second differences, rad, assuming a normal distribution."""
        return float(np.sqrt(-2 * np.log(max(self.coherence, 1e-9))))

    @property
    def report(self) -> dict[str, float]:
        """Values for the attributes of a stage."""
        return {"second_difference_rad": round(self.rms_rad, 3), "steadiness": round(self.steadiness, 3)}

    @property
    def flags(self) -> dict[str, str]:
        """Flag that is raised if echoes of constant magnitude have a random phase from pulse to pulse."""
        if self.steadiness < STEADY or self.coherence >= LEAST_COHERENCE:
            return {}
        line = (
            f"monostatic echoes have a constant magnitude from pulse to pulse (agreement {self.steadiness:.2f}) but an "
            f"unstable phase: its second differences are {self.rms_rad:.1f} rad rms, whereas antenna motion causes "
            "less than 0.1 rad; the image is speckle"
        )
        return {"phase_unstable": line}


def phase_stability(
    transfer: NDArray[np.complex64], time_s: NDArray[np.float64], *, prefix_cells: int
) -> PhaseStability | None:
    """Measure the phase stability of monostatic echoes; None if no echo exceeds the noise.

    Parameters
    ----------
    transfer
        (pulse, subcarrier) complex64, with the code removed; echoes are in the first `prefix_cells` cells of 1/B.
    time_s
        (pulse,) float64, times of transmission, seconds; triples with missing pulses are excluded.
    prefix_cells
        Number of cells of 1/B in the cyclic prefix, or in the longest complete delay of a pulse without repetition.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Own phase".

    Examples
    --------
    >>> echo = np.exp(2j * np.pi * (0.3 * np.arange(64)[:, None] - np.arange(128) * 5 / 128)).astype(np.complex64)
    >>> phase_stability(echo, np.arange(64.0), prefix_cells=32).coherence
    1.0
    """
    interval = np.diff(time_s)
    even = np.abs(interval - np.median(interval)) < _EVEN * np.median(interval) if interval.size else interval > 0
    triples = even[1:] & even[:-1]
    if triples.sum() < _FEWEST_TRIPLES or not 0 < prefix_cells < transfer.shape[1]:
        return None
    profile = scipy.fft.ifft(transfer, axis=1)
    power = (np.abs(profile) ** 2).mean(0)
    # averaged over the pulses, the noise power is nearly equal in all cells, so that its median approximates its mean
    strong = np.flatnonzero(power[:prefix_cells] > 10 ** (ECHO_DB / 10) * np.median(power[prefix_cells:]))
    if not strong.size:
        return None
    cells = profile[:, strong].astype(np.complex128)
    first, second, third = cells[:-2][triples], cells[1:-1][triples], cells[2:][triples]
    products = third * second.conj() ** 2 * first  # phase φ'' of each triple
    mean_power = (np.abs(second) ** 2 + np.abs(third) ** 2).sum() / 2
    return PhaseStability(
        round(float(np.abs(products.sum()) / np.abs(products).sum()), 6),
        round(float((np.abs(second) * np.abs(third)).sum() / mean_power), 6),
    )
