"""Imaged pulses of a pair, their positions, and the air on their paths."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import SEGMENTS, Node, PhaseHistoryWaveform
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.core.geometry.atmosphere import Atmosphere, FlightAir, SceneAir
from apertura.core.geometry.geodesy import LOCAL, frame_from_map, map_from_frame
from apertura.core.geometry.track_checks import CheckedTrack, hovering, stretches
from apertura.core.imaging.range_profiles import aperture_of
from apertura.core.scene.auto_grid import utm_crs
from apertura.core.scene.grid import SceneGrid
from apertura.formats.tracks.track import FIXES
from apertura.stages.node_log import NodeLog
from apertura.stages.scene import ConfiguredGround

# ---- Pulses inside the segments of a pair ---------------------------------------------------------------------------


def inside_segments(campaign: Campaign, flight: str, pair: str, times: NDArray[np.datetime64]) -> NDArray[np.bool_]:
    """Return (pulse,) bool: which pulses, by the transmitter's time tags (pulse,), image a pair.

    Raises
    ------
    CampaignError
        If none does.
    """
    segments = campaign.segments_of(flight, pair)
    inside = np.full(len(times), not segments)
    for start, end in segments:
        inside |= (times >= np.datetime64(start)) & (times <= np.datetime64(end))
    if len(times) and not inside.any():
        raise CampaignError(
            f"no pulse of flight {flight}, pair {pair} inside {' or '.join('…'.join(line) for line in segments)}",
            where=campaign.root / SEGMENTS,
            expected=f"times between {times.min()} and {times.max()}, UTC",
            remedy="Correct start and end, or take the lines out to image with the whole track.",
        )
    return inside


def keep_segments(campaign: Campaign, flight: str, pair: str, echo: xr.Dataset) -> xr.Dataset:
    """Return an echo without the pulses outside the segments of its pair, and with their number in `pulses`."""
    if not campaign.segments_of(flight, pair):
        return echo
    inside = inside_segments(campaign, flight, pair, echo.time.values)
    counts = {**echo.attrs.get("pulses", {}), "used": int(inside.sum()), "outside_segments": int((~inside).sum())}
    return echo.isel(pulse=inside).assign_attrs(pulses=counts)


# ---- Pulses of valid positions, and the errors of these -------------------------------------------------------------

_LINES = {
    "fix_quality_low": "the log's solution is poorer than {poorest_fix}",
    "track_gap": "no epochs",
    "track_outlier": "outliers or steps of the log",
    "track_frozen": "epochs that repeat the position before them",
}
"""Flag → what is wrong with the log there."""


@dataclass(frozen=True, eq=False)
class PulsePositions:
    """Validity of the positions of a pair's pulses.

    Attributes
    ----------
    good
        (pulse,) bool, pulses that both nodes have a position for.
    reasons
        Cause → number of pulses left out by it, each counted once.
    flags
        Edge crossed → what was measured, in one line.
    report
        tx, rx → node, std_m, correlation_s, stated_by, interpolation_m; smoothing_residual_m, source and remarks of the
        log where there are any.
    """

    good: NDArray[np.bool_]
    reasons: dict[str, int]
    flags: Flags
    report: dict[str, dict[str, Any]]


def place(tx: NodeLog, rx: NodeLog, at: Times, *, hovers: bool = False) -> PulsePositions:
    """Place a pair at the transmitter's tags `at`, and select the pulses for which both logs give positions.

    Pulses of a hover are left out unless `hovers`: segments of the pair say what images it.

    Raises
    ------
    CampaignError
        If none is left.
    """
    good, reasons, flags = np.ones(len(at), bool), dict[str, int](), Flags()
    for node in {one.name: one for one in (tx, rx)}.values():
        barred = node.checked.excluded(node.log_seconds(at))
        flags = Flags.merged(flags, _flags(node, at, barred))
        for cause, out in barred.items():
            reasons[cause] = reasons.get(cause, 0) + int((out & good).sum())
            good &= ~out
    if not good.any():
        raise CampaignError(
            f"no pulse has a position: {'; '.join(flags.values())}",
            where=" and ".join(dict.fromkeys((tx.log, rx.log))),
            expected="logs whose epochs are sound while there are pulses",
            remedy="Correct the log, or allow poorer solutions by nodes.<node>.worst_fix.",
        )
    standing = np.zeros(len(at), bool)
    if not hovers:
        legs = tx.antenna("radar_tx", at[good]), rx.antenna("radar_rx", at[good])
        standing[good] = hovering(tx.log_seconds(at[good]), legs)
    if standing.any():
        reasons["hover"] = int(standing.sum())
        time_s = tx.log_seconds(at)
        first, last = max(stretches(standing), key=lambda edge: time_s[edge[1] - 1] - time_s[edge[0]])
        flags["hover"] = (
            f"{int(standing.sum())} of {len(at)} pulses left out: the antennas stood, longest "
            f"{time_s[last - 1] - time_s[first]:.0f} s from {tx.log_time(float(time_s[first]))}"
        )
        good &= ~standing
    report = {
        leg: position_error(node.track, node.settings, at[good])
        | {"node": node.name, "interpolation_m": node.checked.interpolation_m}
        | _log_report(node)
        for leg, node in (("tx", tx), ("rx", rx))
    }
    return PulsePositions(good, {cause: count for cause, count in reasons.items() if count}, flags, report)


def _log_report(node: NodeLog) -> dict[str, Any]:
    """Return the report on reading and smoothing of a log; empty without remarks."""
    values = {"smoothing_residual_m": node.smoothing_residual_m} | {
        name: node.track.attrs.get(name) for name in ("source", "remarks")
    }
    return {name: value for name, value in values.items() if value is not None}


def position_error(track: xr.Dataset, settings: Node, at: Times) -> dict[str, Any]:
    """Return the known position error of a node at some pulses.

    Returns
    -------
    dict
        std_m: [north, east, up], metres, of the config, else the median over the pulses of what the log states, else
        None; stated_by: log, config or nobody; correlation_s: how long an error lasts, seconds; drift_m: of
        a slow error; receiver: the kind of solution that most of these epochs have, a key of `RECEIVER_STD_M`.
    """
    epochs = np.searchsorted(track.time.values, at).clip(0, track.sizes["epoch"] - 1)
    receiver = {"receiver": _kind_of_solution(track.fix.values[epochs]) if "fix" in track else "unknown"}
    if settings.position_std_m is None and "position_std" in track:
        stated = track.position_std.values[epochs]
        stated = stated[(stated > 0).all(axis=1)]
        if len(stated):
            return stated_error(settings) | receiver | {"std_m": np.median(stated, axis=0).tolist(), "stated_by": "log"}
    return stated_error(settings) | receiver


def _kind_of_solution(fix: NDArray[np.int8]) -> str:
    """Return the commonest kind of solution among RTKLIB's numbers.

    Examples
    --------
    >>> _kind_of_solution(np.array([1, 1, 5], np.int8)), _kind_of_solution(np.array([0], np.int8))
    ('fix', 'unknown')
    """
    number = int(np.bincount(np.maximum(fix, 0)).argmax()) if len(fix) else 0
    return next((name for name, own in FIXES.items() if own == number), "unknown")


def stated_error(settings: Node) -> dict[str, Any]:
    """Return the error of a node's positions stated in the config, as `position_error`."""
    stated = settings.position_std_m
    std_m = None if stated is None else np.broadcast_to(stated, 3).tolist()
    stated_by = "nobody" if stated is None else "config"
    return {
        "std_m": std_m,
        "correlation_s": settings.position_correlation_s,
        "drift_m": settings.position_drift_m,
        "stated_by": stated_by,
    }


def _flags(node: NodeLog, at: Times, barred: dict[str, NDArray[np.bool_]]) -> dict[str, str]:
    """Return the faults of a node's log that affect its pulses: flag → one line."""
    checked, lines = node.checked, {}
    begin, end = node.log_seconds(at[[0, -1]]) + np.array([-1.0, 1.0]) * 2 * node.interval_s
    for name, what in _LINES.items():
        out = int(barred[name].sum()) if name in barred else 0
        faults = [fault for fault in checked.faults.get(name, ()) if begin <= fault[0] <= end]
        if not (out or faults):
            continue
        worst = ""
        if faults:
            time_s, size_m = faults[0]
            size = f"{size_m:.3f} m " if size_m else ""
            worst = f"; {len(faults)} found, worst {size}at {node.log_time(time_s)}"
        longest = _longest_hole(node, checked, name) if out else ""
        reason = what.format(poorest_fix=node.settings.poorest_fix)
        lines[name] = f"{node.name}: {out} of {len(at)} pulses left out: {reason}{longest}{worst}"
    if node.track.attrs["dropped"]:
        counted = ", ".join(f"{count} {why}" for why, count in node.track.attrs["dropped"].items())
        lines["track_epochs_dropped"] = f"{node.name}: epochs of the log left out: {counted}"
    if node.track.attrs.get("damage"):
        lines["track_log_damaged"] = f"{node.name}: {node.track.attrs['damage']}"
    if "track_times" in checked.faults:
        lines["track_times"] = (
            f"{node.name}: times of the log are written so coarsely that positions err by "
            f"{checked.faults['track_times'][0][1]:.2f} m along the flight"
        )
    if "track_positions" in checked.faults:
        lines["track_positions"] = (
            f"{node.name}: positions of the log are written so coarsely that they err by "
            f"{checked.faults['track_positions'][0][1]:.3f} m"
        )
    if node.yaw_fault is not None:
        lines["attitude_suspect"] = f"{node.name}: {node.yaw_fault.line}"
    return lines


def _longest_hole(node: NodeLog, checked: CheckedTrack, cause: str) -> str:
    holes = [hole for hole in checked.holes if hole.cause == cause and np.isfinite(hole.end_s - hole.start_s)]
    if not holes:
        return " at an end of the log"
    hole = max(holes, key=lambda one: one.end_s - one.start_s)
    error = f", where a spline may err by {hole.size_m:.2f} m" if np.isfinite(hole.size_m) else ""
    return f", longest {hole.end_s - hole.start_s:.2f} s at {node.log_time(hole.start_s)}{error}"


GROUND_STEP_M = 10.0
"""Rounding of the ground's height for air: 0.4 N units, so that a height of focus does not form echoes anew."""

_SIDE = 16  # of a grid on which the mean height of a DEM is taken


def scene_air(campaign: Campaign, position_m: NDArray[np.float64]) -> SceneAir:
    """Return the air of a campaign.

    Parameters
    ----------
    campaign
        With `scene.atmosphere`.
    position_m
        (epoch, 3) float64, metres: where an antenna flew, which says where the scene is that the config leaves open.

    Notes
    -----
    Source: docs/theory/atmosphere.md. The ground is flat at the height of the config, or at the mean of the DEM,
    rounded to `GROUND_STEP_M`.
    """
    stated = campaign.settings.scene
    crs = utm_crs(np.median(position_m, axis=0)) if stated.crs == "auto" else stated.crs
    place = np.median(map_from_frame(crs, position_m)[:, :2], axis=0)
    if stated.bounds_m != "auto":
        xmin, ymin, xmax, ymax = stated.bounds_m
        place = np.array([xmin + xmax, ymin + ymax]) / 2
    air = stated.atmosphere
    ground_m = 0.0 if air == "vacuum" else _ground_m(campaign, crs, (float(place[0]), float(place[1])))
    middle = frame_from_map(crs, place[0], place[1], stated.height_m if air == "vacuum" else ground_m)
    if air == "vacuum":
        atmosphere = Atmosphere.vacuum()
    elif air == "auto":
        atmosphere = Atmosphere.standard(ground_m)
    elif air.refractivity_n is not None:
        atmosphere = Atmosphere.stated(air.refractivity_n, ground_m=ground_m)
    else:
        atmosphere = Atmosphere.of_weather(*air.weather, ground_m=ground_m)
    return SceneAir(atmosphere, middle, LOCAL if crs == LOCAL else "ecef")


def _ground_m(campaign: Campaign, crs: str, place: tuple[float, float]) -> float:
    stated = campaign.settings.scene
    ground = ConfiguredGround.of(stated, campaign.height_files(), crs=crs)
    if ground.dem is None or stated.bounds_m == "auto":
        return GROUND_STEP_M * round(ground.height_at(*place) / GROUND_STEP_M)
    xmin, ymin, xmax, ymax = stated.bounds_m
    heights = ground.dem.heights(SceneGrid(crs, xmin, ymax, max(xmax - xmin, ymax - ymin) / _SIDE, (_SIDE, _SIDE)))
    known = heights[np.isfinite(heights)]
    height_m = float(known.mean()) if known.size else ground.height_at(*place)
    return GROUND_STEP_M * round(height_m / GROUND_STEP_M)


def stated_air(air: FlightAir) -> dict[str, Any]:
    """Return the attributes by which a stage states the air that it is of."""
    return {"wave_speed_m_s": air.wave_speed_m_s, "atmosphere": air.report}


def in_air(campaign: Campaign, history: xr.Dataset) -> xr.Dataset:
    """Return a recorder's phase history with the air that its paths are of, by the config's `waveform.air`.

    Where samples are referred to a point, its delay is that of its distance in the air: none of the samples changes.
    """
    waveform, given = campaign.settings.waveform, history.attrs.get("reference", "delay")
    requested: str = waveform.air if isinstance(waveform, PhaseHistoryWaveform) else "auto"
    if requested == "auto":
        requested = "point" if given == "point" else "measured"
    air = scene_air(campaign, history.tx_position.values)
    if requested == "corrected":
        corrected = replace(Atmosphere.stated(0.0, ground_m=0.0), source="none: taken out of the files, as stated")
        air = replace(air, atmosphere=corrected)
    flown = air.over(aperture_of(history))
    if requested == "point":
        history = history.assign(reference_delay=history.reference_delay * (1 + 1e-6 * flown.refractivity_n))
    return history.assign_attrs(stated_air(flown))
