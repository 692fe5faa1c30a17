"""How much of a flight a pixel is integrated over: what the resolution asked for needs, and no more than was flown."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.focus.job import Integration
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.sector import TAPER, Sector, response
from apertura.core.planning.checks import vertical

CHORD = 0.1
"""Of the range to the scene: the way over which directions of flight are taken."""

TURNED = 1.5
"""Pixels seen under so many times the angle that a straight flight would give are flagged."""

_PULSES = 256  # that tell the geometry
_COUNTED = 16384  # that tell how many pulses a pixel takes


def integrate(
    aperture: Aperture,
    points_m: NDArray[np.float64],
    *,
    spacing_m: float,
    wavelength_m: float,
    antennas: Beams | None = None,
    asked: Any = "auto",
    where: str = "processing",
) -> Integration:
    """Return over how much of a flight the pixels of a scene are integrated.

    Parameters
    ----------
    aperture
        Every pulse, in the frame of the points.
    points_m
        (row, column, 3) float64, metres: spread over the scene, corners included; rows go south.
    spacing_m, wavelength_m
        Of the pixels, and of the band's middle.
    antennas
        Their beams, where they have any.
    asked
        'auto', 'all', or a mapping with `degrees` or `resolution_m`.
    where
        Section of the config that asks, for messages.

    Raises
    ------
    CampaignError
        If no pulse sees any of the scene inside the sector.

    Notes
    -----
    Source: docs/theory/integration.md.
    """
    if asked == "all" or len(aperture) < 2:
        return Integration(None, len(aperture), "all", "asked for: every pulse counts for every pixel")
    points = points_m.reshape(-1, 3)
    some = aperture[aperture.sample(_PULSES)]
    nearest_m = np.linalg.norm(some.middle_m[:, None] - points, axis=-1).min(axis=1)
    whole = Sector.of(aperture, chord_m=CHORD * float(np.median(nearest_m)), centre=0.0, half=2.0)
    straight = whole[aperture.sample(_PULSES)]
    place, squint = straight.place(some, points), _squint(whole, antennas)
    per_path = _gradient_per_path(some, straight, points)
    if asked == "auto":
        half, why = wavelength_m / (2 * per_path * spacing_m) / (1 + TAPER), f"pixels of {spacing_m:g} m carry no more"
        flown = float(np.ptp(place, axis=0).max())
        if flown <= 2 * half * (1 + TAPER):
            cell_m = wavelength_m / (per_path * flown) if flown else np.inf
            carried = f"every pulse counts: pixels of {spacing_m:g} m carry the {cell_m:.3g} m that was flown"
            return Integration(None, len(aperture), "all", carried)
    else:
        why, half = "asked for", float(np.sin(np.radians(asked.get("degrees", 0)) / 2) * np.sqrt(1 - squint**2))
        half = wavelength_m / (2 * per_path * asked["resolution_m"]) if "resolution_m" in asked else half
    centre = _nearest_flown(squint, half * (1 + TAPER), place)
    sector = Sector(whole.tx_axis, whole.rx_axis, centre, half)
    return _described(sector, aperture, points_m, wavelength_m / (2 * per_path * half), why, where)


def _nearest_flown(squint: float, outer: float, place: NDArray[np.float64]) -> float:
    """Return the centre nearest to `squint` about which most of the scene (pulse, place) was passed."""
    first, last = place.min(axis=0), place.max(axis=0)
    middle = (first + last) / 2
    reach = np.maximum(last - middle - outer, 0)
    centre = float(np.median(np.clip(squint, middle - reach, middle + reach)))
    return centre if abs(centre - squint) > 1e-3 * outer else squint


def _squint(whole: Sector, antennas: Beams | None) -> float:
    """Return s along the boresights, median over the pulses; 0 without beams."""
    if antennas is None:
        return 0.0
    stated = [beam.axes[:, 0] for beam in (antennas.transmit, antennas.receive) if beam is not None]
    tx, rx = stated[0], stated[-1]
    return float(np.median((whole.tx_axis * tx).sum(axis=1) + (whole.rx_axis * rx).sum(axis=1)))


def _gradient_per_path(aperture: Aperture, whole: Sector, points: NDArray[np.float64]) -> float:
    """Return how much the path's gradient along the flight changes per change of s: 2 where both antennas fly alike."""
    flown = whole.tx_axis + whole.rx_axis
    ahead = flown / np.maximum(np.linalg.norm(flown, axis=1, keepdims=True), 1e-9)
    along = np.einsum("pnx,px->pn", aperture.path_gradient(points), ahead)
    moved, turned = (np.abs(np.diff(each, axis=0)).sum(axis=0) for each in (whole.place(aperture, points), along))
    return float(np.median(turned / np.where(moved > 0, moved, np.inf))) or 2.0


def _described(
    sector: Sector, aperture: Aperture, points_m: NDArray[np.float64], resolution_m: float, why: str, where: str
) -> Integration:
    """Return the integration by a sector, with what it makes of the scene."""
    points = points_m.reshape(-1, 3)
    total, seen = _counted(sector, aperture, points)
    if not seen.any():
        raise CampaignError(
            f"zero pulses see the scene inside the integration angle (s = {sector.centre:.3g} ± {sector.half:.3g})",
            where=f"{where}.integration",
            expected="a scene that the flight passes, or antennas that look at it",
            remedy="Set processing.integration to all, or correct scene.bounds_m.",
        )
    degrees = float(np.degrees(2 * np.arcsin(min(1.0, sector.half))))
    least, median, most = (round(float(np.quantile(seen, part))) for part in (0, 0.5, 1))
    counted = f"of {len(aperture)} pulses a place takes {least} to {most} (median {median})"
    width, sidelobe_db = response()
    report = {
        "degrees": round(degrees, 3),
        "resolution_m": float(f"{resolution_m:.4g}"),
        "width_m": float(f"{width * resolution_m:.4g}"),
        "sidelobe_db": round(sidelobe_db, 2),
        "taper": TAPER,
        "squint_deg": round(float(np.degrees(np.arcsin(np.clip(sector.centre, -1, 1)))), 3),
        "pulses_per_pixel": {"least": least, "median": median, "most": most, "of": len(aperture)},
    }
    flags = {}
    if not seen.all():
        share = f"{100 * float((seen == 0).mean()):.1f} % of the scene"
        flags["outside_swath"] = f"{share} is passed by no pulse inside the integration angle of {degrees:.3g}°"
    under = _seen_under(sector, aperture, points[seen > 0], vertical(points_m))
    if under > TURNED * degrees * (1 + TAPER):
        flags["integration_turns"] = (
            f"places are seen under {under:.0f}° in all, {degrees:.3g}° are integrated of a straight pass: the track "
            "turns, or passes them more than once"
        )
    value, count = f"{degrees:.3g}°, {resolution_m:.3g} m", max(1, round(float(total.max())))
    summed = float(seen.mean()) / len(aperture)
    return Integration(sector, count, value, f"{why}; {counted}", summed, report, flags)


def _counted(
    sector: Sector, aperture: Aperture, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sum of the weights at each point, and how many pulses have one; of many, spread ones stand in."""
    every = slice(None, None, -(-len(aperture) // _COUNTED))
    few, some = aperture[every], sector[every]
    total, seen = np.zeros((2, len(points)))
    for first in range(0, len(few), _PULSES):
        weight = some[first : first + _PULSES].weight(few[first : first + _PULSES], points)
        total, seen = total + weight.sum(axis=0), seen + (weight > 0).sum(axis=0)
    scale = len(aperture) / len(few)
    return scale * total, scale * seen


def _seen_under(sector: Sector, aperture: Aperture, points: NDArray[np.float64], up: NDArray[np.float64]) -> float:
    """Return the angle on the ground under which pulses inside the sector see a place, median over places, degrees."""
    some = aperture.sample(4 * _PULSES)
    few, inside = aperture[some], sector[some]
    lit, seen = inside.weight(few, points) >= 0.5, few.path_gradient(points)
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    turn = np.degrees(np.arctan2(seen @ np.cross(up, east), seen @ east))
    spans = []
    for column, within in zip(turn.T, lit.T, strict=True):
        angles = np.sort(column[within])
        if len(angles) > 1:
            spans.append(360 - float(np.diff(angles, append=angles[0] + 360).max()))
    return float(np.median(spans)) if spans else 0.0
