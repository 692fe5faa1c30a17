"""How the scene is seen: ranges, slopes and phase rates over it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.focus.engines.native_prediction import NO_BEAMS, PatchWeights, patch_weights


@dataclass(frozen=True)
class View:
    """How the scene is seen: a net of places in it from some of the pulses.

    Attributes
    ----------
    range_m
        (leg, pulse, place) float64, from transmitter and receiver, metres.
    slope
        (2, pulse, place) float64, change of total path per pixel along columns and rows, metres.
    spacing_m
        Pixel spacing.
    weights
        Of the antennas' beams.
    """

    range_m: NDArray[np.float64]
    slope: NDArray[np.float64]
    spacing_m: float
    weights: PatchWeights = NO_BEAMS


def look(
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    net_m: NDArray[np.float64],
    spacing_m: float,
    beams: Beams | None = None,
) -> View:
    """Return the view of a net of places, (row, column, 3), from phase centres (pulse, 3), metres, and their beams."""
    place = net_m.reshape(-1, 3)
    right, down = (_steps(net_m, axis, spacing_m).reshape(-1, 3) for axis in (1, 0))
    apart = np.stack([place - antenna[:, None] for antenna in (tx_m, rx_m)])
    distance = np.linalg.norm(apart, axis=-1)
    direction = (apart / distance[..., None]).sum(axis=0)
    slope = np.stack([(direction * step).sum(-1) for step in (right, down)])
    seen = NO_BEAMS if beams is None else patch_weights(beams, tx_m, rx_m, np.stack([right, down]), place)
    return View(distance, slope, spacing_m, seen)


def _steps(net_m: NDArray[np.float64], axis: int, spacing_m: float) -> NDArray[np.float64]:
    if net_m.shape[axis] < 2:
        return np.zeros_like(net_m)
    along = np.gradient(net_m, axis=axis)
    return np.asarray(spacing_m * along / np.linalg.norm(along, axis=-1, keepdims=True))


def phase_rates(
    tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], place_m: NDArray[np.float64], *, wavelength_m: float
) -> tuple[float, float]:
    """Return the widest spread of phase rates over the scene, and the largest against its middle, cycles per pulse.

    Parameters
    ----------
    tx_m, rx_m
        (pulse, 3) float64, metres; consecutive pulses.
    place_m
        (place, 3) float64, metres: a net over the scene, its middle at the middle of the array.
    wavelength_m
        Of the highest frequency.

    Notes
    -----
    Source: docs/theory/planner.md, "Pulses". A spread above 1 makes azimuth ambiguities.

    Examples
    --------
    >>> track = np.stack([0.05 * np.arange(50.0), np.zeros(50), np.full(50, 10.0)], -1)
    >>> places = np.array([[-5.0, 10, 0], [1.25, 10, 0], [7.5, 10, 0]])
    >>> spread, widest = phase_rates(track, track, places, wavelength_m=0.25)
    >>> 0.3 < spread < 0.4, widest < spread
    (True, True)
    """
    spread = widest = 0.0
    for first in range(0, len(tx_m) - 1, 256):
        part = slice(first, first + 257)
        path = sum(np.linalg.norm(place_m - antenna[part, None], axis=-1) for antenna in (tx_m, rx_m))
        rate = np.diff(path, axis=0)
        spread = max(spread, float(np.ptp(rate, axis=1).max()))
        widest = max(widest, float(np.abs(rate - rate[:, [len(place_m) // 2]]).max()))
    return spread / wavelength_m, widest / wavelength_m


def upward(net_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit normal of a net of places (row, column, 3) whose rows go south and columns east.

    Examples
    --------
    >>> east, south = np.meshgrid(np.arange(3.0), np.arange(2.0))
    >>> upward(np.stack([east, -south, 0 * east], -1))
    array([0., 0., 1.])
    """
    if min(net_m.shape[:2]) < 2:
        first = net_m[0, 0]
        return np.asarray(first / np.linalg.norm(first)) if np.linalg.norm(first) > 6e6 else np.array([0.0, 0.0, 1.0])
    normal = np.cross(net_m[0, -1] - net_m[0, 0], net_m[0, 0] - net_m[-1, 0])
    return np.asarray(normal / np.linalg.norm(normal))
