"""Checks of a node's own pulses: their code, and the stability of their phase."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.units import decibels

# ---- Code of a node's own pulses

FALSE_ALARM = 1e-5
"""Probability that a wrong code is accepted as the right one."""

_COHERENT_PULSES = 8, 32, 128  # pulses added coherently, at each Doppler
_GUARD_CELLS = 8  # on both sides of the prefix, within reach of sidelobes of echoes inside
_FEWEST_CELLS = 32  # outside the prefix, to estimate the floor from
_NOISE_SIGMAS = 6.0  # above it, cells outside the prefix may scatter more than noise
_SPREAD_SIGMAS = 10.0  # above it, they do


@dataclass(frozen=True)
class CodeEvidence:
    """Evidence on a code.

    Attributes
    ----------
    carried
        Whether the recording contains it; None without evidence.
    evidence
        One line with the numbers.
    """

    carried: bool | None
    evidence: str

    @property
    def report(self) -> dict[str, Any]:
        """Values for the attributes of a stage."""
        return asdict(self)

    @property
    def flags(self) -> dict[str, str]:
        """A flag, if the code is not carried."""
        return {"code_unconfirmed": self.evidence} if self.carried is False else {}


def own_code(transfer: NDArray[np.complex64], *, prefix_cells: int) -> CodeEvidence:
    """Return whether own echoes, the code removed, are compressed inside the prefix as with the right code.

    Parameters
    ----------
    transfer
        (pulse, subcarrier) complex64, the code removed; echoes lie in the first `prefix_cells` of 1/B.
    prefix_cells
        Cells of 1/B inside the cyclic prefix, or inside the longest delay of a pulse sent once.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Own code".

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> noise = (rng.normal(size=(64, 256)) + 1j * rng.normal(size=(64, 256))).astype(np.complex64)
    >>> [own_code(one, prefix_cells=64).carried for one in (noise, noise + 1)]
    [None, True]
    """
    pulses, cells = transfer.shape
    outside = slice(prefix_cells + _GUARD_CELLS, cells - _GUARD_CELLS)
    if not prefix_cells or outside.stop - outside.start < _FEWEST_CELLS:
        return CodeEvidence(None, f"{prefix_cells} of {cells} delay cells may hold echoes: nothing to compare with")
    profile = scipy.fft.ifft(transfer, 2 * cells, axis=1)  # half cells, so that no echo falls between two
    scattered, beyond = -np.inf, slice(2 * outside.start, -2 * _GUARD_CELLS, 2)
    for run in [run for run in _COHERENT_PULSES if run <= pulses] or [pulses]:
        level, needed, scatter = _strongest(profile, run, 2 * prefix_cells, beyond)
        scattered = max(scattered, scatter)
        line = f"the strongest complete echo, {run} pulses added, is {decibels(level):.1f} dB above what lies beyond"
        if level >= needed:
            return CodeEvidence(True, line)
    if scattered > _SPREAD_SIGMAS:
        return CodeEvidence(
            False,
            f"{line}; what repeats in all pulses is spread over all delays: the code is wrong, or another transmits",
        )
    return CodeEvidence(
        None, f"{line}, {decibels(needed):.1f} dB needed: no echo rises above the noise, or the code is wrong"
    )


def _strongest(profile: NDArray[np.complex64], run: int, inside: int, beyond: slice) -> tuple[float, float, float]:
    """Return the strongest cell inside the prefix, its threshold, and the excess scatter of cells outside, in σ.

    Levels are ratios to the mean beyond the prefix at the same Doppler.
    """
    blocks = len(profile) // run
    power = np.zeros((2 * run, profile.shape[1]), np.float32)
    for first in range(0, blocks * run, run):
        power += np.abs(scipy.fft.fft(profile[first : first + run], 2 * run, axis=0)) ** 2
    floor = power[:, beyond].astype(np.float64)
    mean = np.maximum(floor.mean(1), 1e-30)
    scatter = floor.std(1) / mean
    chance = FALSE_ALARM / (inside * len(power))
    sigmas = (blocks * scatter**2 - 1) / np.sqrt((2 + 6 / blocks) / floor.shape[1])
    # a wrong code's floor repeats in all pulses, unlike noise: exponential from cell to cell, however many are added
    noise = sigmas.max() < _NOISE_SIGMAS
    needed = scipy.special.gammainccinv(blocks, chance) / blocks if noise else 1 - scatter * (1 + np.log(chance))
    level = power[:, :inside].max(1) / mean
    best = int((level / needed).argmax())
    return float(level[best]), float(np.broadcast_to(needed, level.shape)[best]), float(sigmas.max())


# ---- Phase stability of a node's own pulses

LEAST_COHERENCE = 0.3
"""Coherence of second differences of phase, at which they scatter by 1.55 rad rms, white phase noise by 0.63 rad."""

STEADY = 0.93
"""Agreement of magnitudes from pulse to pulse at least: independent speckle has π/4, noise 10 dB below an echo 0.95."""

ECHO_DB = 13.0
"""dB of mean power above the noise of the cells that are evaluated: phases of weaker ones scatter by noise."""

_FEWEST_TRIPLES = 20  # of consecutive pulses, to estimate a coherence from
_EVEN = 0.25  # of the usual interval: tolerated deviation; larger ones mean missing pulses


@dataclass(frozen=True)
class PhaseStability:
    """Stability of the phase of echoes from pulse to pulse.

    Attributes
    ----------
    coherence
        |mean exp(jφ'')| of the second differences φ'' of phase, weighted by power; 1 of smooth motion.
    steadiness
        Agreement of magnitudes of neighbouring pulses, 1 where scatterers do not change.
    """

    coherence: float
    steadiness: float

    @property
    def rms_rad(self) -> float:
        """RMS of the second differences, rad, as of a normal distribution."""
        return float(np.sqrt(-2 * np.log(max(self.coherence, 1e-9))))

    @property
    def report(self) -> dict[str, float]:
        """Values for the attributes of a stage."""
        return {"second_difference_rad": round(self.rms_rad, 3), "steadiness": round(self.steadiness, 3)}

    @property
    def flags(self) -> dict[str, str]:
        """A flag if echoes of steady magnitude change their phase at random."""
        if self.steadiness < STEADY or self.coherence >= LEAST_COHERENCE:
            return {}
        line = (
            f"own echoes keep their magnitude from pulse to pulse ({self.steadiness:.2f}) and not their phase: second "
            f"differences of {self.rms_rad:.1f} rad rms; a moving antenna makes less than 0.1: the image is speckle"
        )
        return {"phase_unstable": line}


def phase_stability(
    transfer: NDArray[np.complex64], time_s: NDArray[np.float64], *, prefix_cells: int
) -> PhaseStability | None:
    """Return the phase stability of own echoes, or None where no echo is above the noise.

    Parameters
    ----------
    transfer
        (pulse, subcarrier) complex64, the code removed; echoes lie in the first `prefix_cells` of 1/B.
    time_s
        (pulse,) float64, when each was sent, seconds; triples with missing pulses between them are left out.
    prefix_cells
        Cells of 1/B inside the cyclic prefix, or inside the longest delay of a pulse sent once.

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
    # the median of an exponential variable's mean over many pulses is its mean
    strong = np.flatnonzero(power[:prefix_cells] > 10 ** (ECHO_DB / 10) * np.median(power[prefix_cells:]))
    if not strong.size:
        return None
    cells = profile[:, strong].astype(np.complex128)
    before, here, after = cells[:-2][triples], cells[1:-1][triples], cells[2:][triples]
    products = after * here.conj() ** 2 * before
    both = (np.abs(here) ** 2 + np.abs(after) ** 2).sum() / 2
    return PhaseStability(
        round(float(np.abs(products.sum()) / np.abs(products).sum()), 6),
        round(float((np.abs(here) * np.abs(after)).sum() / both), 6),
    )
