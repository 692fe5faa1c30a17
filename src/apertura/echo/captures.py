"""What captured samples tell before anything is computed from them: saturation."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

SATURATED_SHARE = 1e-4
"""Share of the samples at the converter's end stops; a symbol 12 dB below them reaches its extremes once or twice."""


def saturated_share(iq: NDArray[np.int16]) -> float:
    """Return the share of (pulse, sample, 2) int16 I and Q that repeat the largest or the smallest value that occurs.

    Notes
    -----
    A converter that clips piles samples up at its end stops, whatever its number of bits; without clipping the
    extreme values occur once or twice.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> waves = rng.normal(0, 3000, (4, 5000, 2))
    >>> [round(saturated_share(w.astype(np.int16)), 4) for w in (waves, waves.clip(-8191, 8191))]
    [0.0, 0.0054]
    """
    top, bottom = int(iq.max()), int(iq.min())
    at_stops = np.count_nonzero(iq == top) + np.count_nonzero(iq == bottom) - 2  # each extreme occurs once anyway
    return float(at_stops / iq.size)


def saturation_flags(iq: Mapping[str, NDArray[np.int16]]) -> dict[str, str]:
    """Return a flag for each channel, name → (pulse, sample, 2) int16, whose converter clipped."""
    shares = {name: saturated_share(samples) for name, samples in iq.items()}
    return {
        f"saturated_{name}": f"{100 * share:.2f} % of the samples of channel {name} sit at the converter's end stops"
        for name, share in shares.items()
        if share > SATURATED_SHARE
    }
