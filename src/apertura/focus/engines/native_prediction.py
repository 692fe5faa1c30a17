"""How the compiled engine will take the patches of a scene: path variants, antenna weights, and what they err by."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.focus.engines.native_binding import available, instruction_set
from apertura.focus.engines.native_constants import KERNEL

_BLOCK_REACH = np.sqrt(2) * (KERNEL.patch_side - KERNEL.block_side) / 2
"""D of a flat patch, in pixels: from its middle to the centre of the block in its corner."""
_PIXEL_REACH = np.sqrt(2) * (KERNEL.block_side - 1) / 2
"""δ, in pixels: from the centre of a block to the pixel in its corner."""


def path_variants(
    range_m: NDArray[np.float64],
    slope_m: NDArray[np.float64],
    *,
    spacing_m: float,
    cell_m: float,
    wavenumber_rad_m: float,
    tolerance_rad: float,
) -> tuple[tuple[float, float, float], float]:
    """Return which parts of pulses × patches take which path variant, and the phase error of their paths.

    Parameters
    ----------
    range_m
        (leg, pulse, place) float64, from transmitter and receiver, metres.
    slope_m
        (2, pulse, place) float64, change of total path per pixel along columns and rows, metres.
    spacing_m
        Of the pixels.
    cell_m
        Total path across one cell of the table.
    wavenumber_rad_m
        2πf_mid/c.
    tolerance_rad
        Largest phase error that the path series may make.

    Returns
    -------
    shares : tuple of float
        Of shared curvature in narrow windows, of wide windows (shared or own curvature), of exact paths.
    error_rad : float
        RMS over patches and pulses of the largest error in a patch.

    Notes
    -----
    Source: docs/theory/engine.md, "Paths" and "Look-ups", for flat patches.

    Examples
    --------
    >>> near, far = (np.full((2, 1, 1), range_m) for range_m in (1.0, 100.0))
    >>> scene = {"spacing_m": 0.05, "cell_m": 0.06, "wavenumber_rad_m": 25.0, "tolerance_rad": 1e-3}
    >>> [path_variants(range_m, np.full((2, 1, 1), 0.05), **scene)[0] for range_m in (near, far)]
    [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)]
    """
    reach, inner = _BLOCK_REACH * spacing_m, _PIXEL_REACH * spacing_m
    inverse = (1 / range_m) ** 2
    base = inverse * (KERNEL.third_order * inner**3 + inverse * reach**4 * (KERNEL.fifth_order * reach + inner))
    shared = base + KERNEL.shared_curvature_error * reach * inner**2 * inverse
    own = base + KERNEL.own_curvature_error * reach**2 * inner**2 * inverse**1.5
    shared_rad, own_rad = (wavenumber_rad_m * path_m.sum(axis=0) for path_m in (shared, own))
    step = np.abs(slope_m).sum(axis=0)
    curvature = KERNEL.curvature_span * spacing_m**2 * (1 / range_m).sum(axis=0)
    block_cells = ((KERNEL.block_side - 1) * step + 2 * curvature) / cell_m + 1
    one_block = (
        available() and instruction_set() == "avx2"
    )  # has a narrow window of 8 cells; else it serves 2 × 2 blocks
    narrow_cells = KERNEL.window / 2 if one_block else KERNEL.window
    served_cells = block_cells if one_block else block_cells + KERNEL.block_side * step / cell_m
    fits = block_cells <= KERNEL.window - KERNEL.window_margin
    shares_curvature = fits & (shared_rad <= tolerance_rad)
    has_own = fits & (shared_rad > tolerance_rad) & (own_rad <= tolerance_rad)
    narrow = shares_curvature & (served_cells <= narrow_cells - KERNEL.window_margin)
    parts = (float(narrow.mean()), float((shares_curvature & ~narrow).mean() + has_own.mean()))
    error = np.where(shares_curvature, shared_rad, np.where(has_own, own_rad, 0.0))
    return (*parts, float(1 - sum(parts))), float(np.sqrt((error**2).mean()))


@dataclass(frozen=True)
class PatchWeights:
    """How the weights of antennas over patches × pulses are taken.

    Attributes
    ----------
    smooth, pixelwise, dark
        Parts that are weighted by a polynomial, pixel by pixel, and not at all; they sum to 1.
    error
        RMS error of the polynomials, relative to the RMS of the weights.
    antennas
        How many beams there are.
    """

    smooth: float = 1.0
    pixelwise: float = 0.0
    dark: float = 0.0
    error: float = 0.0
    antennas: int = 0


NO_BEAMS = PatchWeights()


def patch_weights(
    beams: Beams,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    steps_m: NDArray[np.float64],
    place_m: NDArray[np.float64],
) -> PatchWeights:
    """Return how the weights of patches about places of the scene will be taken.

    Parameters
    ----------
    beams
        One set of axes for each of the pulses given.
    tx_m, rx_m
        (pulse, 3) float64, metres.
    steps_m
        (2, place, 3) float64, metres: from pixel to pixel along columns and rows.
    place_m
        (place, 3) float64, metres.

    Notes
    -----
    Source: docs/theory/engine.md, "Antennas", (7) and the errors below it.
    """
    half_patch = (KERNEL.patch_side - 1) / 2  # pixels
    across = half_patch * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), -1).reshape(9, 2)
    nodes = place_m + np.einsum("ns,spc->npc", across, steps_m)
    gain = beams.weight(tx_m, rx_m, nodes.reshape(-1, 3)).reshape(len(tx_m), 3, 3, len(place_m))
    curvature = [np.abs(np.diff(gain, 2, axis=axis)).max(axis=(1, 2)) for axis in (1, 2)]
    change = [np.abs(np.diff(gain.take([0, 2], axis), axis=axis)).max(axis=(1, 2)) for axis in (1, 2)]
    dark, everywhere = (gain == 0).all(axis=(1, 2)), (gain != 0).all(axis=(1, 2))
    smooth = everywhere & (np.maximum(*change) <= KERNEL.weight_change)
    smooth &= np.maximum(*curvature) <= KERNEL.weight_curvature
    beta = np.where(smooth, np.hypot(*curvature), 0.0)
    error = np.hypot((3 / 16) ** 2 / 2 * beta, 1.4 / (9 * np.sqrt(3)) * beta**1.5)  # inside a block, between nodes
    strength = float((gain**2).mean())
    return PatchWeights(
        float(smooth.mean()),
        float((~smooth & ~dark).mean()),
        float(dark.mean()),
        float(np.sqrt((error**2).mean() / strength)) if strength else 0.0,
        sum(beam is not None for beam in (beams.transmit, beams.receive)),
    )
