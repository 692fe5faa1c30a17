"""Whether the code that is taken out of a node's own echoes is the one that it sent: by where their energy gathers."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.special import gammainccinv

FALSE_ALARM = 1e-5
"""Chance that a wrong code passes for the right one."""

_RUNS = 8, 32, 128  # pulses added coherently, at each Doppler
_GUARD_CELLS = 8  # on both sides of the prefix, where sidelobes of what lies inside reach
_FEWEST_CELLS = 32
_NOISE_SIGMAS = 6.0  # beyond, cells outside the prefix may scatter as no noise does
_SPREAD_SIGMAS = 10.0  # beyond, they do


@dataclass(frozen=True)
class CodeEvidence:
    """What was found about a code.

    Attributes
    ----------
    carried
        Whether the recording carries it; None where that cannot be told.
    evidence
        One line with the numbers.
    """

    carried: bool | None
    evidence: str

    @property
    def report(self) -> dict[str, Any]:
        """As it stands in the attributes of a stage."""
        return asdict(self)

    @property
    def flags(self) -> dict[str, str]:
        """A flag, if the code is not carried."""
        return {"code_unconfirmed": self.evidence} if self.carried is False else {}


def own_code(transfer: NDArray[np.complex64], *, prefix_cells: int) -> CodeEvidence:
    """Return whether own echoes, the code removed, gather inside the prefix as those of the right code do.

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
    profile = fft.ifft(transfer, 2 * cells, axis=1)  # half cells, so that no echo falls between two
    scattered, beyond = -np.inf, slice(2 * outside.start, -2 * _GUARD_CELLS, 2)
    for run in [run for run in _RUNS if run <= pulses] or [pulses]:
        level, needed, scatter = _strongest(profile, run, 2 * prefix_cells, beyond)
        scattered = max(scattered, scatter)
        line = f"the strongest echo held whole, {run} pulses added, is {_db(level):.1f} dB above what lies beyond"
        if level >= needed:
            return CodeEvidence(True, line)
    if scattered > _SPREAD_SIGMAS:
        return CodeEvidence(
            False,
            f"{line}; what repeats in all pulses is spread over all delays: the code is wrong, or another transmits",
        )
    return CodeEvidence(
        None, f"{line}, {_db(needed):.1f} dB needed: no echo rises above the noise, or the code is wrong"
    )


def _strongest(profile: NDArray[np.complex64], run: int, inside: int, beyond: slice) -> tuple[float, float, float]:
    """Return the strongest cell inside the prefix, what is needed of it, and by how many σ the others are not noise.

    Levels are ratios to the mean beyond the prefix at the same Doppler.
    """
    blocks = len(profile) // run
    power = np.zeros((2 * run, profile.shape[1]), np.float32)
    for first in range(0, blocks * run, run):
        power += np.abs(fft.fft(profile[first : first + run], 2 * run, axis=0)) ** 2
    others = power[:, beyond].astype(np.float64)
    mean = np.maximum(others.mean(1), 1e-30)
    scatter = others.std(1) / mean
    chance = FALSE_ALARM / (inside * len(power))
    sigmas = (blocks * scatter**2 - 1) / np.sqrt((2 + 6 / blocks) / others.shape[1])
    # a wrong code's floor is the same in all pulses, no noise: exponential from cell to cell, however many are added
    noise = sigmas.max() < _NOISE_SIGMAS
    needed = gammainccinv(blocks, chance) / blocks if noise else 1 - scatter * (1 + np.log(chance))
    level = power[:, :inside].max(1) / mean
    best = int((level / needed).argmax())
    return float(level[best]), float(np.broadcast_to(needed, level.shape)[best]), float(sigmas.max())


def _db(ratio: float) -> float:
    return 10 * float(np.log10(ratio))
