"""Decisions on accuracy, autofocus, model of the ground and integration, each with its reason."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.job import Integration, Job
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

# ---- Numerical accuracy


def decide_accuracy(lines: Sequence[BudgetLine]) -> Decision:
    """Return the numerical error to request, and the line of the error budget that it follows from.

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


# ---- Autofocus

TOLERATED_LOSS_DB = 0.2
"""dB, loss of a peak by errors of position that is tolerated without autofocus.

RTK at its best, half a centimetre in each log, costs 0.3 dB at L-band; less than this is not visible in any image, and
not worth a job that reads all pairs of a flight together.
"""


def decide_autofocus(requested: str, loss_db: Mapping[str, float], unstated: Collection[str]) -> Decision:
    """Decide whether tracks are refined, on or off.

    Parameters
    ----------
    requested
        auto, on or off.
    loss_db
        Pair → expected loss by stated errors of position, dB, 0 or less.
    unstated
        Nodes without stated errors of position.

    Examples
    --------
    >>> decide_autofocus("auto", {"a-a": -0.1, "a-b": -0.9}, []).reason
    'auto: configured position errors cost 0.90 dB in a-b, more than the tolerated 0.2 dB'
    >>> decide_autofocus("auto", {"a-a": 0.0}, ["a"]).value
    'off'
    """
    if requested != "auto":
        return Decision("autofocus", requested, "asked for")
    if unstated:
        missing = f"auto: position accuracy of {' and '.join(unstated)} is not configured"
        return Decision("autofocus", "off", f"{missing}; state nodes.<node>.position_std_m to have them refined")
    pair, worst_db = min(loss_db.items(), key=lambda one: one[1])
    value, than = ("on", "more") if worst_db < -TOLERATED_LOSS_DB else ("off", "no more")
    cost = f"configured position errors cost {-worst_db:.2f} dB in {pair}"
    return Decision("autofocus", value, f"auto: {cost}, {than} than the tolerated {TOLERATED_LOSS_DB} dB")


# ---- Model of the ground

FOCUS_RAD = 0.4
"""Phase error, radians rms, that a cheaper ground may add: 0.7 dB of a peak (docs/theory/planner.md, "Terrain")."""

SHIFT_PIXELS = 0.5
"""Shift of a pixel, in pixels, that a cheaper ground may add: a place stays in its own pixel."""


def decide_terrain(job: Job, *, requested: str | None = None, where: str = "processing") -> Decision:
    """Decide whether the ground is modelled by a plane, a tilted plane or the DEM.

    Parameters
    ----------
    job
        What is to be imaged.
    requested
        Requested model; None: the rule decides.
    where
        Section of the config with the request, for messages.

    Raises
    ------
    CampaignError
        If a model other than a plane is requested without a DEM.

    Notes
    -----
    Source: docs/theory/planner.md, "Terrain": a height that is wrong by δh turns the look angle by δh over the ground
    range and shifts the pixel by δh·H over it.
    """
    chosen = _by_rule(job)
    if requested is None or requested == chosen.value:
        return chosen
    if isinstance(job.terrain.full, FlatGround):
        raise CampaignError(
            f"terrain is {requested}",
            where=f"{where}.terrain",
            expected="plane or auto: the scene has no DEM",
            remedy="Name a DEM in scene.dem, or leave terrain to the planner.",
        )
    return Decision("terrain", requested, f"asked for; the rule says {chosen.value}: {chosen.reason}")


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
    offset_m = job.aperture.middle_m[job.aperture.sample(64)][:, None] - job.points_m
    above = offset_m @ vertical(job.ground_m)
    ground = np.sqrt(np.maximum((offset_m**2).sum(-1) - above**2, 1e-6))
    nearest, steepest = float(ground.min()), float((np.abs(above) / ground).max())
    wobble_m = job.aperture.wobble_m
    focus_m = FOCUS_RAD * job.wavelength_m * nearest / (4 * np.pi * max(wobble_m, 1e-9))
    shift_m = SHIFT_PIXELS * job.spacing_m / max(steepest, 1e-9)
    return min(focus_m, shift_m), (
        f"wobble {wobble_m:.3f} m rms and ground range from {nearest:.1f} m bear {focus_m:.3g} m (0.4 rad), "
        f"half a pixel of shift {shift_m:.3g} m"
    )


# ---- Integration

CHORD = 0.1
"""Share of the range to the scene over which directions of flight are taken: longer than position errors."""

MOST_ASPECT = 1.5
"""Aspect angle of a place over the integration angle above which `track_turns` is raised: the track turns."""

_PULSES = 256  # sampled for the geometry
_FEWEST = 3  # pulses of the place that takes most: of two there is no focus to be judged
_COUNTED = 16384  # pulses sampled to count those of a pixel


def integrate(
    aperture: Aperture,
    points_m: NDArray[np.float64],
    *,
    spacing_m: float,
    wavelength_m: float,
    antennas: Beams | None = None,
    requested: Any = "auto",
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
        Beams of the antennas, if any.
    requested
        'auto', 'all', or a mapping with `degrees` or `resolution_m`.
    where
        Section of the config with the request, for messages.

    Raises
    ------
    CampaignError
        If no pulse illuminates any of the scene inside the sector.

    Notes
    -----
    Source: docs/theory/integration.md.
    """
    if requested == "all" or len(aperture) < 2:
        return Integration(None, len(aperture), "all", "asked for: every pulse counts for every pixel")
    points = points_m.reshape(-1, 3)
    some = aperture[aperture.sample(_PULSES)]
    nearest_m = np.linalg.norm(some.middle_m[:, None] - points, axis=-1).min(axis=1)
    whole = Sector.of(aperture, chord_m=CHORD * float(np.median(nearest_m)), centre=0.0, half=2.0)
    sampled = whole[aperture.sample(_PULSES)]
    place, squint = sampled.place(some, points), _squint(whole, antennas)
    per_path = _gradient_per_path(some, sampled, points)
    half, why = sector_half(requested, wavelength_m, spacing_m, per_path=per_path, squint=squint), "asked for"
    if requested == "auto":
        why = f"pixels of {spacing_m:g} m carry no more"
        flown = float(np.ptp(place, axis=0).max())
        if flown <= 2 * half * (1 + TAPER):
            cell_m = wavelength_m / (per_path * flown) if flown else np.inf
            reason = f"every pulse counts: pixels of {spacing_m:g} m carry the {cell_m:.3g} m that was flown"
            return Integration(None, len(aperture), "all", reason)
    sector = Sector(whole.tx_axis, whole.rx_axis, squint, half).following(aperture, points)
    return _integration_of(sector, aperture, points_m, wavelength_m / (2 * per_path * half), why, where)


def sector_half(
    requested: Any, wavelength_m: float, spacing_m: float, *, per_path: float = 2.0, squint: float = 0.0
) -> float:
    """Return the half width in s of the sector that is asked for.

    Parameters
    ----------
    requested
        'auto', or a mapping with `degrees` or `resolution_m`.
    wavelength_m, spacing_m
        Of the band's middle, and of the pixels.
    per_path
        Change of the path's gradient along the flight per change of s: 2 for antennas flying in parallel.
    squint
        s of the sector's middle.

    Notes
    -----
    Source: docs/theory/integration.md.

    Examples
    --------
    >>> round(sector_half({"resolution_m": 0.5}, 0.2, 0.1), 3), round(sector_half({"degrees": 60}, 0.2, 0.1), 3)
    (0.1, 0.5)
    """
    if requested == "auto":
        return wavelength_m / (2 * per_path * spacing_m) / (1 + TAPER)
    if "resolution_m" in requested:
        return float(wavelength_m / (2 * per_path * requested["resolution_m"]))
    return float(np.sin(np.radians(requested["degrees"]) / 2) * np.sqrt(1 - squint**2))


def _squint(whole: Sector, antennas: Beams | None) -> float:
    """Return s along the boresights, median over the pulses; 0 without beams."""
    if antennas is None:
        return 0.0
    stated = [beam.axes[:, 0] for beam in (antennas.transmit, antennas.receive) if beam is not None]
    tx, rx = stated[0], stated[-1]
    return float(np.median((whole.tx_axis * tx).sum(axis=1) + (whole.rx_axis * rx).sum(axis=1)))


def _gradient_per_path(aperture: Aperture, sector: Sector, points: NDArray[np.float64]) -> float:
    """Return the change of the path's gradient along the flight per change of s: 2 for antennas flying in parallel."""
    flown = sector.tx_axis + sector.rx_axis
    ahead = flown / np.maximum(np.linalg.norm(flown, axis=1, keepdims=True), 1e-9)
    along = np.einsum("pnx,px->pn", aperture.path_gradient(points), ahead)
    change_s, change = (np.abs(np.diff(each, axis=0)).sum(axis=0) for each in (sector.place(aperture, points), along))
    return float(np.median(change / np.where(change_s > 0, change_s, np.inf))) or 2.0


def _integration_of(
    sector: Sector, aperture: Aperture, points_m: NDArray[np.float64], resolution_m: float, why: str, where: str
) -> Integration:
    """Return the integration by a sector, with its pulses per place, resolution and flags."""
    points = points_m.reshape(-1, 3)
    total, counts = _pulses_per_place(sector, aperture, points)
    if counts.max() < _FEWEST:
        seen = "zero" if not counts.any() else f"no more than {counts.max():.0f}"
        raise CampaignError(
            f"{seen} pulses see the scene inside the integration angle (s = {sector.centre:.3g} ± {sector.half:.3g})",
            where=f"{where}.integration",
            expected="a scene that the flight passes, or antennas that look at it, and an angle that spans an aperture",
            remedy="Set processing.integration to all or to more, or correct scene.bounds_m.",
        )
    # Report: angle, response of the smooth edges, squint of the places, pulses of a place.
    degrees = float(np.degrees(2 * np.arcsin(min(1.0, sector.half))))
    least, median, most = (round(float(np.quantile(counts, part))) for part in (0, 0.5, 1))
    counted = f"of {len(aperture)} pulses a place takes {least} to {most} (median {median})"
    width, sidelobe_db = response()
    squint_deg = np.degrees(np.arcsin(np.quantile(sector.centre_at(points).clip(-1, 1), (0, 0.5, 1)))).round(3)
    report = {
        "degrees": round(degrees, 3),
        "resolution_m": float(f"{resolution_m:.4g}"),
        "width_m": float(f"{width * resolution_m:.4g}"),
        "sidelobe_db": round(sidelobe_db, 2),
        "taper": TAPER,
        "squint_deg": dict(zip(("least", "median", "most"), squint_deg.tolist(), strict=True)),
        "pulses_per_pixel": {"least": least, "median": median, "most": most, "of": len(aperture)},
    }
    flags = {}
    if not counts.all():
        outside = f"{100 * float((counts == 0).mean()):.1f} % of the scene"
        flags["outside_swath"] = f"{outside} is passed by no pulse inside the integration angle of {degrees:.3g}°"
    aspect_deg = _aspect_deg(sector, aperture, points[counts > 0], vertical(points_m))
    if aspect_deg > MOST_ASPECT * degrees * (1 + TAPER):
        flags["track_turns"] = (
            f"places are seen under {aspect_deg:.0f}° in all, {degrees:.3g}° are integrated of a straight pass: the "
            "track turns, or passes them more than once"
        )
    value, count = f"{degrees:.3g}°, {resolution_m:.3g} m", max(1, round(float(total.max())))
    share = float(counts.mean()) / len(aperture)
    return Integration(sector, count, value, f"{why}; {counted}", share, report, flags)


def _pulses_per_place(
    sector: Sector, aperture: Aperture, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sum of the weights and the number of pulses with weight at each point, from a sample if many."""
    every = slice(None, None, -(-len(aperture) // _COUNTED))
    few, some = aperture[every], sector[every]
    total, counts = np.zeros((2, len(points)))
    for first in range(0, len(few), _PULSES):
        weight = some[first : first + _PULSES].weight(few[first : first + _PULSES], points)
        total, counts = total + weight.sum(axis=0), counts + (weight > 0).sum(axis=0)
    scale = len(aperture) / len(few)
    return scale * total, scale * counts


def _aspect_deg(sector: Sector, aperture: Aperture, points: NDArray[np.float64], up: NDArray[np.float64]) -> float:
    """Return the aspect angle of a place over the pulses inside the sector, median over places, degrees."""
    some = aperture.sample(4 * _PULSES)
    few, inside = aperture[some], sector[some]
    summed, gradient = inside.weight(few, points) >= 0.5, few.path_gradient(points)
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    turn = np.degrees(np.arctan2(gradient @ np.cross(up, east), gradient @ east))
    spans = []
    for column, within in zip(turn.T, summed.T, strict=True):
        angles = np.sort(column[within])
        if len(angles) > 1:
            spans.append(360 - float(np.diff(angles, append=angles[0] + 360).max()))
    return float(np.median(spans)) if spans else 0.0
