"""Whether a node's own pulses keep their phase from one to the next, as echoes of a scene that stands still do."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

LEAST_COHERENCE = 0.3
"""Of second differences of phase: below it they scatter by 1.55 rad rms or more; white phase noise of 0.63 rad does."""

STEADY = 0.93
"""Least agreement of magnitudes from pulse to pulse: independent speckle has π/4, noise 10 dB below an echo 0.95."""

ECHO_DB = 13.0
"""Cells are looked at whose mean power is this far above the noise."""

_FEWEST_TRIPLES = 20
_EVEN = 0.25  # of the usual interval: pulses further apart have others missing between them


@dataclass(frozen=True)
class PhaseStability:
    """How the phase of echoes goes on from pulse to pulse.

    Attributes
    ----------
    coherence
        |mean exp(jφ'')| of the second differences φ'' of phase, weighted by power; 1 of smooth motion.
    steadiness
        Agreement of magnitudes of neighbouring pulses, 1 where scatterers stay what they are.
    """

    coherence: float
    steadiness: float

    @property
    def rms_rad(self) -> float:
        """RMS of the second differences, rad, as of a normal distribution."""
        return float(np.sqrt(-2 * np.log(max(self.coherence, 1e-9))))

    @property
    def report(self) -> dict[str, float]:
        """As it stands in the attributes of a stage."""
        return {"second_difference_rad": round(self.rms_rad, 3), "steadiness": round(self.steadiness, 3)}

    @property
    def flags(self) -> dict[str, str]:
        """A flag if echoes that stay as strong as they are change their phase at random."""
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
    """Return how steady the phase of own echoes is, or None where no echo stands out of the noise.

    Parameters
    ----------
    transfer
        (pulse, subcarrier) complex64, the code removed; echoes lie in the first `prefix_cells` of 1/B.
    time_s
        (pulse,) float64, when each was sent, seconds; triples of pulses with others missing between them are left out.
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
    profile = fft.ifft(transfer, axis=1)
    power = (np.abs(profile) ** 2).mean(0)
    # the median of an exponential variable's mean over many pulses is its mean
    seen = np.flatnonzero(power[:prefix_cells] > 10 ** (ECHO_DB / 10) * np.median(power[prefix_cells:]))
    if not seen.size:
        return None
    cells = profile[:, seen].astype(np.complex128)
    before, here, after = cells[:-2][triples], cells[1:-1][triples], cells[2:][triples]
    products = after * here.conj() ** 2 * before
    both = (np.abs(here) ** 2 + np.abs(after) ** 2).sum() / 2
    return PhaseStability(
        round(float(np.abs(products.sum()) / np.abs(products).sum()), 6),
        round(float((np.abs(here) * np.abs(after)).sum() / both), 6),
    )
