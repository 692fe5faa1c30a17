"""How the compiled engine will take the weights of antennas over a scene, and what their polynomials err by."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.focus.engines.native_constants import KERNEL
from apertura.core.geometry.aperture import Aperture


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
    edge
        Part at the smooth edge of the sector, of what is not outside of it.
    """

    smooth: float = 1.0
    pixelwise: float = 0.0
    dark: float = 0.0
    error: float = 0.0
    antennas: int = 0
    edge: float = 0.0


NO_BEAMS = PatchWeights()


def patch_weights(
    beams: Beams,
    aperture: Aperture,
    steps_m: NDArray[np.float64],
    place_m: NDArray[np.float64],
) -> PatchWeights:
    """Return how the weights of patches about places of the scene will be taken.

    Parameters
    ----------
    beams
        One set of axes for each of the pulses given.
    aperture
        The pulses.
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
    weight = None if beams.sector is None else beams.sector.weight(aperture, place_m)
    lit = np.array([]) if weight is None else weight > 0
    edge = float((weight[lit] < 1).mean()) if weight is not None and lit.any() else 0.0
    if beams.antennas is None:
        return PatchWeights(edge=edge)
    gain = beams.antennas.weight(aperture, nodes.reshape(-1, 3)).reshape(len(aperture), 3, 3, len(place_m))
    curvature = [np.abs(np.diff(gain, 2, axis=axis)).max(axis=(1, 2)) for axis in (1, 2)]
    change = [np.abs(np.diff(gain.take([0, 2], axis), axis=axis)).max(axis=(1, 2)) for axis in (1, 2)]
    dark, everywhere = (gain == 0).all(axis=(1, 2)), (gain != 0).all(axis=(1, 2))
    smooth = everywhere & (np.maximum(*change) <= KERNEL.weight_change)
    smooth &= np.maximum(*curvature) <= KERNEL.weight_curvature
    beta = np.where(smooth, np.hypot(*curvature), 0.0)
    if lit.any():
        gain, beta, smooth, dark = np.moveaxis(gain, -1, 1)[lit], beta[lit], smooth[lit], dark[lit]
    error = np.hypot((3 / 16) ** 2 / 2 * beta, 1.4 / (9 * np.sqrt(3)) * beta**1.5)  # inside a block, between nodes
    strength = float((gain**2).mean())
    return PatchWeights(
        float(smooth.mean()),
        float((~smooth & ~dark).mean()),
        float(dark.mean()),
        float(np.sqrt((error**2).mean() / strength)) if strength else 0.0,
        sum(beam is not None for beam in (beams.transmit, beams.receive)),
        edge,
    )
