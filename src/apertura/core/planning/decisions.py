"""The simplest model that will do: accuracy, autofocus, ground and integration, each with its reason."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.focus.job import Integration, Job
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.sector import TAPER, Sector, response
from apertura.core.planning.plan import Decision, vertical
from apertura.core.quality.budget import (
    ARITHMETIC_BELOW_DB,
    LEAST_ACCURACY_DB,
    MOST_ACCURACY_DB,
    BudgetLine,
    accuracy_for,
)
from apertura.core.scene.terrain import FlatGround

# ---- How exact arithmetic must be: well below what else is known to spoil the image, and no better -----------------


def decide_accuracy(lines: Sequence[BudgetLine]) -> Decision:
    """Return the numerical error to ask for, and the line of the error budget that it follows from.

    Examples
    --------
    >>> from apertura.core.quality.path_errors import Effect
    >>> decide_accuracy([BudgetLine("positions", "1 cm", Effect(-0.0004, 0, 0))]).reason
    'auto: 10 dB below positions (1 cm)'
    """
    value, stated = accuracy_for(lines), [line for line in lines if line.stated is not None]
    largest = min(stated, key=lambda line: line.effect.loss_db, default=None)
    if largest is None or value == MOST_ACCURACY_DB:
        return Decision("accuracy_db", value, "auto: nothing known spoils the image more, and better shows nowhere")
    cause = f"{largest.cause} ({largest.stated})"
    if value == LEAST_ACCURACY_DB:
        return Decision("accuracy_db", value, f"auto: {cause} spoil the image more, and worse would show")
    return Decision("accuracy_db", value, f"auto: {ARITHMETIC_BELOW_DB:g} dB below {cause}")


# ---- Whether the tracks of a flight are refined by its images: only where errors of position cost more than is
# borne

BORNE_DB = 0.2
"""Loss of a peak by errors of position that is borne.

RTK at its best, half a centimetre in each log, costs 0.3 dB at L-band; less than this shows in no image, and is not
worth a job that reads all pairs of a flight together.
"""


def decide_autofocus(asked: str, loss_db: Mapping[str, float], silent: Collection[str]) -> Decision:
    """Return whether tracks are refined, on or off, and why.

    Parameters
    ----------
    asked
        auto, on or off.
    loss_db
        Pair → what errors of position that somebody stated are expected to cost, 0 or less.
    silent
        Nodes of whose errors nobody said anything.

    Examples
    --------
    >>> decide_autofocus("auto", {"a-a": -0.1, "a-b": -0.9}, []).reason
    'auto: errors of position that are stated cost 0.90 dB in a-b, more than the 0.2 dB borne'
    >>> decide_autofocus("auto", {"a-a": 0.0}, ["a"]).value
    'off'
    """
    if asked != "auto":
        return Decision("autofocus", asked, "asked for")
    if silent:
        missing = f"auto: nobody said how well positions of {' and '.join(silent)} are known"
        return Decision("autofocus", "off", f"{missing}; state nodes.<node>.position_std_m to have them refined")
    pair, worst_db = min(loss_db.items(), key=lambda one: one[1])
    value, than = ("on", "more") if worst_db < -BORNE_DB else ("off", "no more")
    cost = f"errors of position that are stated cost {-worst_db:.2f} dB in {pair}"
    return Decision("autofocus", value, f"auto: {cost}, {than} than the {BORNE_DB} dB borne")


# ---- The simplest model of the ground that keeps focus and place: a plane, a tilted plane, or the DEM --------------

FOCUS_RAD = 0.4
SHIFT_PIXELS = 0.5


def decide_terrain(job: Job, *, asked: str | None = None, where: str = "processing") -> Decision:
    """Decide whether a plane, a tilted plane or the DEM stands for the ground.

    Parameters
    ----------
    job
        What is to be imaged.
    asked
        What a person asks for; None: the rule decides.
    where
        Section of the config that asks, for messages.

    Raises
    ------
    CampaignError
        If a DEM's model is asked for and there is none.

    Notes
    -----
    Source: docs/theory/planner.md, "Terrain": a height that is wrong by δh turns the look angle by δh over the ground
    range and shifts the pixel by δh·H over it.
    """
    chosen = _by_rule(job)
    if asked is None or asked == chosen.value:
        return chosen
    if isinstance(job.terrain.full, FlatGround):
        raise CampaignError(
            f"terrain is {asked}",
            where=f"{where}.terrain",
            expected="plane or auto: the scene has no DEM",
            remedy="Name a DEM in scene.dem, or leave terrain to the planner.",
        )
    return Decision("terrain", asked, f"asked for; the rule says {chosen.value}: {chosen.reason}")


def _by_rule(job: Job) -> Decision:
    (limit_m, rule), ground = _tolerance(job), job.terrain
    if isinstance(ground.full, FlatGround):
        return Decision("terrain", "plane", f"no DEM; height may be wrong by {limit_m:.3g} m: {rule}")
    if ground.relief_m < limit_m:
        return Decision("terrain", "plane", f"relief {ground.relief_m:.3g} m; {rule}")
    off_plane = f"relief {ground.relief_m:.3g} m, {ground.off_plane_m:.3g} m off a tilted plane; {rule}"
    return Decision("terrain", "tilted_plane" if ground.off_plane_m < limit_m else "dem", off_plane)


def _tolerance(job: Job) -> tuple[float, str]:
    """Return how far heights may be wrong, metres, and why."""
    apart = job.aperture.middle_m[job.aperture.sample(64)][:, None] - job.points_m
    above = apart @ vertical(job.ground_m)
    ground = np.sqrt(np.maximum((apart**2).sum(-1) - above**2, 1e-6))
    nearest, steepest = float(ground.min()), float((np.abs(above) / ground).max())
    wobble_m = job.aperture.wobble_m
    focus_m = FOCUS_RAD * job.wavelength_m * nearest / (4 * np.pi * max(wobble_m, 1e-9))
    shift_m = SHIFT_PIXELS * job.spacing_m / max(steepest, 1e-9)
    return min(focus_m, shift_m), (
        f"wobble {wobble_m:.3f} m rms and ground range from {nearest:.1f} m bear {focus_m:.3g} m (0.4 rad), "
        f"half a pixel of shift {shift_m:.3g} m"
    )


# ---- How much of a flight a pixel is integrated over: what the resolution asked for needs, and no more than was
# flown

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
