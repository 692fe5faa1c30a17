"""Edges of imaging: what a campaign may not do, and what it may but should be told about."""

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.errors import CampaignError
from apertura.planning.view import phase_rates, vertical


def crossed_edges(
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    net_m: NDArray[np.float64],
    *,
    spacing_m: float,
    band_hz: tuple[float, float],
    path_limit_m: float = np.inf,
) -> dict[str, str]:
    """Return flags: name → what was found, in one line.

    Parameters
    ----------
    tx_m, rx_m
        (pulse, 3) float64, phase centres, metres.
    net_m
        (row, column, 3) float64, metres: places evenly spread over the scene; rows go south, columns east.
    spacing_m
        Of the pixels.
    band_hz
        Lowest and highest frequency.
    path_limit_m
        Longest total path inside the cyclic prefix.

    Raises
    ------
    CampaignError
        If there is no pulse, a position is not finite, or no echo of the scene arrives inside the prefix.
    """
    _check_finite(tx_m, rx_m)
    place_m, up = net_m.reshape(-1, 3), vertical(net_m)
    flags = {}
    inside = [_over(position, net_m, up, spacing_m) for position in (tx_m, rx_m)]
    over = int((inside[0] | inside[1]).sum())
    if over:
        flags["platform_inside_scene"] = (
            f"{over} of {len(tx_m)} pulses are sent or received above the scene: echoes from both sides mix"
        )
    cell_m = finest_cell_m(tx_m, rx_m, net_m, band_hz=band_hz)
    if spacing_m > cell_m:
        flags["spacing_coarse"] = (
            f"spacing {spacing_m:g} m, finest resolution cell {cell_m:.3g} m: targets fall between"
        )
    spread, _ = phase_rates(tx_m, rx_m, place_m, wavelength_m=SPEED_OF_LIGHT_M_S / band_hz[1])
    if spread > 1:
        flags["pulses_sparse"] = f"phase rates over the scene spread {spread:.2f} cycles per pulse, 1 is unambiguous"
    unseen = _unseen(tx_m, rx_m, place_m, path_limit_m)
    if unseen:
        flags["places_unseen"] = f"{100 * unseen:.0f} % of the scene is seen by no pulse inside the cyclic prefix"
    return flags


def _check_finite(tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> None:
    if len(tx_m) == 0:
        raise CampaignError(
            "zero pulses", where="echo", expected="at least one", remedy="Check the triggers and the sidelink."
        )
    lost = np.asarray(~np.isfinite(np.hstack([tx_m, rx_m])).all(axis=1))
    if lost.any():
        raise CampaignError(
            f"{int(lost.sum())} of {len(lost)} phase centres are not finite, first at pulse {int(lost.argmax())}",
            where="track",
            expected="a position for every pulse",
            remedy="Mend the flight log.",
        )


def _over(
    position_m: NDArray[np.float64], net_m: NDArray[np.float64], up: NDArray[np.float64], spacing_m: float
) -> NDArray[np.bool_]:
    """Return which pulses are above the scene."""
    corner, over = net_m[0, 0], np.ones(len(position_m), bool)
    right, down = net_m[0, -1] - corner, net_m[-1, 0] - corner
    lengths = [float(np.linalg.norm(side)) for side in (right, down)]
    if not lengths[1]:  # one row or column is as wide as a pixel
        down = np.cross(right if lengths[0] else np.eye(3)[np.abs(up).argmin()], up)
    if not lengths[0]:
        right = np.cross(down, up)
    for side, length in zip((right, down), lengths, strict=True):
        along = (position_m - corner) @ side / np.linalg.norm(side)
        over &= np.abs(along - length / 2) <= (length + spacing_m) / 2
    return over


def finest_cell_m(
    tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], net_m: NDArray[np.float64], *, band_hz: tuple[float, float]
) -> float:
    """Return the finest resolution cell of the scene along rows or columns, metres.

    Notes
    -----
    Source: docs/theory.md, eq. 8: the inverse of the widest spatial spectrum of a place.
    """
    place_m = net_m.reshape(-1, 3)
    thin = slice(None, None, max(1, len(tx_m) // 64))
    gradient = np.zeros((len(tx_m[thin]), len(place_m), 3))
    for antenna in (tx_m, rx_m):
        apart = place_m - antenna[thin, None]
        gradient += apart / np.linalg.norm(apart, axis=-1, keepdims=True)
    widest = 1e-9
    for side in (net_m[0, -1] - net_m[0, 0], net_m[-1, 0] - net_m[0, 0]):
        slope = gradient @ side / max(float(np.linalg.norm(side)), 1e-9)
        cycles = np.concatenate([slope * frequency / SPEED_OF_LIGHT_M_S for frequency in band_hz])
        widest = max(widest, float(np.ptp(cycles, axis=0).max()))
    return 1 / widest


def _unseen(
    tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], place_m: NDArray[np.float64], path_limit_m: float
) -> float:
    if not np.isfinite(path_limit_m):
        return 0.0
    thin = slice(None, None, max(1, len(tx_m) // 256))
    legs = [np.linalg.norm(place_m - antenna[thin, None], axis=-1) for antenna in (tx_m, rx_m)]
    shortest = np.asarray(legs[0] + legs[1]).min(axis=0)
    beyond = shortest > path_limit_m
    if beyond.all():
        raise CampaignError(
            f"zero pulses see the scene: the shortest total path is {shortest.min():.1f} m",
            where="config/config.yaml: scene.bounds_m",
            expected=f"at most {path_limit_m:.1f} m, the cyclic prefix",
            remedy="Correct scene.bounds_m (easting before northing), scene.crs, or the height of the ground: "
            "scene.height_m, or unit and datum of scene.dem.",
        )
    return float(beyond.mean())
