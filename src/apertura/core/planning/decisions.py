"""Decisions on numerical accuracy, autofocus, terrain model and integration, each with its reason."""

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
    """Decide the numerical error to request from the largest term of the error budget.

    Examples
    --------
    >>> from apertura.core.quality.path_errors import Effect
    >>> decide_accuracy([BudgetLine("positions", "1 cm", Effect(-0.0004, 0, 0))]).reason
    'auto: 10 dB below positions (1 cm)'
    """
    value, stated = accuracy_for(lines), [line for line in lines if line.stated is not None]
    largest = min(stated, key=lambda line: line.effect.loss_db, default=None)
    if largest is None or value == MOST_ACCURACY_DB:
        reason = "auto: the numerical error is already the smallest term of the error budget"
        return Decision("accuracy_db", value, reason)
    cause = f"{largest.cause} ({largest.stated})"
    if value == LEAST_ACCURACY_DB:
        reason = f"auto: the largest numerical error that is not visible, more than 10 dB below {cause}"
        return Decision("accuracy_db", value, reason)
    return Decision("accuracy_db", value, f"auto: {ARITHMETIC_BELOW_DB:g} dB below {cause}")


# ---- Autofocus

TOLERATED_LOSS_DB = 0.2
"""Peak loss from position errors that is tolerated without autofocus, dB.

With the best RTK accuracy, half a centimetre in each log, the loss at L-band is 0.3 dB. A smaller loss is not visible
in an image and does not justify a step that reads all pairs of a flight together.
"""


def decide_autofocus(requested: str, loss_db: Mapping[str, float], unstated: Collection[str]) -> Decision:
    """Decide on autofocus: refinement of the tracks on or off.

    Parameters
    ----------
    requested
        auto, on or off.
    loss_db
        Pair → expected loss from configured position errors, dB, 0 or less.
    unstated
        Nodes without configured position accuracy.

    Examples
    --------
    >>> decide_autofocus("auto", {"a-a": -0.1, "a-b": -0.9}, []).reason
    'auto: configured position errors cost 0.90 dB in a-b, more than the tolerated 0.2 dB'
    >>> decide_autofocus("auto", {"a-a": 0.0}, ["a"]).value
    'off'
    """
    if requested != "auto":
        return Decision("autofocus", requested, "requested")
    if unstated:
        missing = f"auto: position accuracy of {' and '.join(unstated)} is not configured"
        return Decision("autofocus", "off", f"{missing}; set nodes.<node>.position_std_m to have the tracks refined")
    pair, worst_db = min(loss_db.items(), key=lambda item: item[1])
    value, than = ("on", "more") if worst_db < -TOLERATED_LOSS_DB else ("off", "no more")
    cost = f"configured position errors cost {-worst_db:.2f} dB in {pair}"
    return Decision("autofocus", value, f"auto: {cost}, {than} than the tolerated {TOLERATED_LOSS_DB} dB")


# ---- Terrain model

FOCUS_RAD = 0.4
"""Tolerated RMS phase error of a simpler terrain model, radians: peak loss 0.7 dB (docs/theory/planner.md, "Terrain").
"""

SHIFT_PIXELS = 0.5
"""Tolerated displacement caused by a simpler terrain model, pixels: a point remains within its pixel."""


def decide_terrain(job: Job, *, requested: str | None = None, where: str = "processing") -> Decision:
    """Decide the terrain model: a plane, a tilted plane or the DEM.

    Parameters
    ----------
    job
        Imaging job.
    requested
        Requested model; None: automatic.
    where
        Section of the configuration with the request, for messages.

    Raises
    ------
    CampaignError
        If a model other than a plane is requested without a DEM.

    Notes
    -----
    Source: docs/theory/planner.md, "Terrain". At ground range d and platform height H, a height error δh changes the
    look angle by δh/d and displaces the pixel by δh·H/d.
    """
    chosen = _automatic_terrain(job)
    if requested is None or requested == chosen.value:
        return chosen
    if isinstance(job.terrain.full, FlatGround):
        raise CampaignError(
            f"terrain model {requested}, but the scene has no DEM",
            where=f"{where}.terrain",
            expected="plane or auto without a DEM",
            remedy="Configure a DEM in scene.dem, or set terrain to auto.",
        )
    return Decision("terrain", requested, f"requested; automatic choice {chosen.value}: {chosen.reason}")


def _automatic_terrain(job: Job) -> Decision:
    (limit_m, limits), ground = _height_tolerance(job), job.terrain
    if isinstance(ground.full, FlatGround):
        return Decision("terrain", "plane", f"no DEM; tolerated height error {limit_m:.3g} m: {limits}")
    if ground.relief_m < limit_m:
        return Decision("terrain", "plane", f"relief {ground.relief_m:.3g} m; {limits}")
    off_plane = f"relief {ground.relief_m:.3g} m, {ground.off_plane_m:.3g} m from a tilted plane; {limits}"
    return Decision("terrain", "tilted_plane" if ground.off_plane_m < limit_m else "dem", off_plane)


def _height_tolerance(job: Job) -> tuple[float, str]:
    """Return the tolerated height error, metres, and its derivation."""
    offset_m = job.aperture.middle_m[job.aperture.sample(64)][:, None] - job.points_m
    above = offset_m @ vertical(job.ground_m)
    ground = np.sqrt(np.maximum((offset_m**2).sum(-1) - above**2, 1e-6))
    nearest, steepest = float(ground.min()), float((np.abs(above) / ground).max())
    wobble_m = job.aperture.wobble_m
    focus_m = FOCUS_RAD * job.wavelength_m * nearest / (4 * np.pi * max(wobble_m, 1e-9))
    shift_m = SHIFT_PIXELS * job.spacing_m / max(steepest, 1e-9)
    return min(focus_m, shift_m), (
        f"limits {focus_m:.3g} m for focus (0.4 rad at a track deviation of {wobble_m:.3f} m rms and a ground range of "
        f"{nearest:.1f} m) and {shift_m:.3g} m for displacement (half a pixel)"
    )


# ---- Integration

CHORD = 0.1
"""Chord over which the direction of flight is computed, in units of the range: long relative to position errors."""

MOST_ASPECT = 1.5
"""Ratio of the aspect angle of a point to the integration angle, above which the flag `track_turns` is raised."""

_PULSES = 256  # pulses sampled for the geometry
FEWEST = 3
"""Minimum number of pulses required at any one pixel: focus cannot be assessed from two pulses."""

_COUNTED = 16384  # pulses sampled to count the pulses per pixel


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
    """Decide the integration of the pixels of a scene: the sector of the flight that contributes to each pixel.

    Parameters
    ----------
    aperture
        All pulses, in the frame of the points.
    points_m
        (row, column, 3) float64, metres, distributed over the scene and including its corners; rows go south.
    spacing_m, wavelength_m
        Pixel spacing, and wavelength at band centre.
    antennas
        Antenna beams, if any.
    requested
        'auto', 'all', or a mapping with `degrees` or `resolution_m`.
    where
        Section of the configuration with the request, for messages.

    Raises
    ------
    CampaignError
        If fewer than three pulses inside the sector illuminate any point of the scene.

    Notes
    -----
    Source: docs/theory/integration.md.
    """
    if requested == "all" or len(aperture) < 2:
        return Integration(None, len(aperture), "all", "requested: all pulses contribute to every pixel")
    points = points_m.reshape(-1, 3)
    pulses = aperture[aperture.sample(_PULSES)]
    nearest_m = np.linalg.norm(pulses.middle_m[:, None] - points, axis=-1).min(axis=1)
    whole = Sector.of(aperture, chord_m=CHORD * float(np.median(nearest_m)), centre=0.0, half=2.0)
    sampled = whole[aperture.sample(_PULSES)]
    position, squint = sampled.place(pulses, points), _squint(whole, antennas)
    per_path = _gradient_per_path(pulses, sampled, points)
    half, reason = sector_half(requested, wavelength_m, spacing_m, per_path=per_path, squint=squint), "requested"
    if requested == "auto":
        reason = f"finest resolution that pixels of {spacing_m:g} m can represent"
        span = float(np.ptp(position, axis=0).max())
        if span <= 2 * half * (1 + TAPER):
            cell_m = wavelength_m / (per_path * span) if span else np.inf
            resolution = f"the resolution of the flight, {cell_m:.3g} m"
            reason = f"all pulses contribute: pixels of {spacing_m:g} m suffice for {resolution}"
            return Integration(None, len(aperture), "all", reason)
    sector = Sector(whole.tx_axis, whole.rx_axis, squint, half).following(aperture, points)
    return _integration_of(sector, aperture, points_m, wavelength_m / (2 * per_path * half), reason, where)


def sector_half(
    requested: Any, wavelength_m: float, spacing_m: float, *, per_path: float = 2.0, squint: float = 0.0
) -> float:
    """Return the half width of the requested sector in units of s.

    Parameters
    ----------
    requested
        'auto', or a mapping with `degrees` or `resolution_m`.
    wavelength_m, spacing_m
        Wavelength at band centre, and pixel spacing.
    per_path
        Change of the path gradient along the flight per change of s: 2 for antennas on parallel tracks.
    squint
        Value of s at the centre of the sector.

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
    """Return the value of s along the boresights, median over the pulses; 0 without beams."""
    if antennas is None:
        return 0.0
    boresights = [beam.axes[:, 0] for beam in (antennas.transmit, antennas.receive) if beam is not None]
    tx, rx = boresights[0], boresights[-1]
    return float(np.median((whole.tx_axis * tx).sum(axis=1) + (whole.rx_axis * rx).sum(axis=1)))


def _gradient_per_path(aperture: Aperture, sector: Sector, points: NDArray[np.float64]) -> float:
    """Return the change of the path gradient along the flight per change of s: 2 for antennas on parallel tracks."""
    heading = sector.tx_axis + sector.rx_axis
    ahead = heading / np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-9)
    along = np.einsum("pnx,px->pn", aperture.path_gradient(points), ahead)
    change_s, change = (np.abs(np.diff(each, axis=0)).sum(axis=0) for each in (sector.place(aperture, points), along))
    return float(np.median(change / np.where(change_s > 0, change_s, np.inf))) or 2.0


def _integration_of(
    sector: Sector, aperture: Aperture, points_m: NDArray[np.float64], resolution_m: float, reason: str, where: str
) -> Integration:
    """Return the integration over a sector, with its pulses per pixel, resolution and flags."""
    points = points_m.reshape(-1, 3)
    total, counts = _pulses_per_place(sector, aperture, points)
    if counts.max() < FEWEST:
        pulses = "no pulses" if not counts.any() else f"at most {counts.max():.0f} pulses"
        raise CampaignError(
            f"{pulses} illuminate a pixel inside the integration angle (s = {sector.centre:.3g} ± {sector.half:.3g})",
            where=f"{where}.integration",
            expected=f"at least {FEWEST} pulses: a flight past the scene, and antennas directed at it",
            remedy="Set processing.integration to all or to a larger angle, or correct scene.bounds_m.",
        )
    # Report: angle, response with tapered edges, squint over the scene, and pulses per pixel.
    degrees = float(np.degrees(2 * np.arcsin(min(1.0, sector.half))))
    least, median, most = (round(float(np.quantile(counts, part))) for part in (0, 0.5, 1))
    counted = f"{least} to {most} of {len(aperture)} pulses per pixel (median {median})"
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
        flags["outside_swath"] = f"{outside} has no pulse inside the integration angle of {degrees:.3g}°"
    aspect_deg = _aspect_deg(sector, aperture, points[counts > 0], vertical(points_m))
    if aspect_deg > MOST_ASPECT * degrees * (1 + TAPER):
        flags["track_turns"] = (
            f"total aspect angle of a point {aspect_deg:.0f}°, integration angle of a straight pass {degrees:.3g}°: "
            "the track turns, or passes the scene more than once"
        )
    value, count = f"{degrees:.3g}°, {resolution_m:.3g} m", max(1, round(float(total.max())))
    share = float(counts.mean()) / len(aperture)
    return Integration(sector, count, value, f"{reason}; {counted}", share, report, flags)


def _pulses_per_place(
    sector: Sector, aperture: Aperture, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Estimate the sum of weights and the number of weighted pulses at each point from a subset of the pulses."""
    every = slice(None, None, -(-len(aperture) // _COUNTED))
    pulses, sampled = aperture[every], sector[every]
    total, counts = np.zeros((2, len(points)))
    for first in range(0, len(pulses), _PULSES):
        weight = sampled[first : first + _PULSES].weight(pulses[first : first + _PULSES], points)
        total, counts = total + weight.sum(axis=0), counts + (weight > 0).sum(axis=0)
    scale = len(aperture) / len(pulses)
    return scale * total, scale * counts


def _aspect_deg(sector: Sector, aperture: Aperture, points: NDArray[np.float64], up: NDArray[np.float64]) -> float:
    """Return the range of aspect angles over the pulses inside the sector, median over the points, degrees."""
    sampled = aperture.sample(4 * _PULSES)
    pulses, inside = aperture[sampled], sector[sampled]
    summed, gradient = inside.weight(pulses, points) >= 0.5, pulses.path_gradient(points)
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    azimuth = np.degrees(np.arctan2(gradient @ np.cross(up, east), gradient @ east))
    spans = []
    for column, within in zip(azimuth.T, summed.T, strict=True):
        angles = np.sort(column[within])
        if len(angles) > 1:
            spans.append(360 - float(np.diff(angles, append=angles[0] + 360).max()))
    return float(np.median(spans)) if spans else 0.0
