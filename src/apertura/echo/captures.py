"""What captured samples tell before anything is computed from them: saturation, and whether the code fits."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from apertura.echo.demodulate import Numerology

SATURATED_SHARE = 1e-4
"""Share of the samples at the converter's end stops; a symbol 12 dB below them reaches its extremes once or twice."""

CODE_SIGMA = 4.0
"""How far the energy inside the prefix must stand out of what a wrong code leaves there."""


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


def code_contrast_sigma(transfer: NDArray[np.complex64], *, prefix_cells: int) -> float:
    """Return by how many standard deviations the energy inside the prefix exceeds a wrong code's.

    Echoes of (pulse, subcarrier) complex64 `transfer`, the code removed, must lie in the first `prefix_cells` of 1/B.

    Notes
    -----
    A wrong code spreads every echo evenly over the period 1/Δf: of P pulses of N cells with exponentially distributed
    power the share inside K cells is K/N ± √(K/N·(1 − K/N)/(P·N)). The right code, and any echo above the noise,
    raises it.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> noise = (rng.normal(size=(50, 256)) + 1j * rng.normal(size=(50, 256))).astype(np.complex64)
    >>> abs(code_contrast_sigma(noise, prefix_cells=64)) < 4, code_contrast_sigma(noise + 0.3, prefix_cells=64) > 4
    (True, True)
    """
    pulses, cells = transfer.shape
    inside = min(prefix_cells, cells - 1)
    power = np.abs(fft.ifft(transfer, axis=1)) ** 2
    expected = inside / cells
    spread = np.sqrt(expected * (1 - expected) / (pulses * cells))
    return float((power[:, :inside].sum() / power.sum() - expected) / spread)


def saturation_flags(iq: Mapping[str, NDArray[np.int16]]) -> dict[str, str]:
    """Return a flag for each channel, name → (pulse, sample, 2) int16, whose converter clipped."""
    shares = {name: saturated_share(samples) for name, samples in iq.items()}
    return {
        f"saturated_{name}": f"{100 * share:.2f} % of the samples of channel {name} sit at the converter's end stops"
        for name, share in shares.items()
        if share > SATURATED_SHARE
    }


def code_flags(transfer: NDArray[np.complex64], numerology: Numerology) -> dict[str, str]:
    """Return a flag if the code does not gather the energy of (pulse, subcarrier) `transfer` inside the prefix."""
    if numerology.prefix_cells == 0:  # every echo lies beyond
        return {}
    sigma = code_contrast_sigma(transfer, prefix_cells=numerology.prefix_cells)
    if sigma >= CODE_SIGMA:
        return {}
    line = f"energy inside the prefix stands {sigma:.1f} σ out of an even spread, {CODE_SIGMA} σ expected: "
    return {"code_unconfirmed": line + "the codes file is wrong, or no echo rises above the noise"}
