"""Imaged pulses of a pair, their positions, and the refractivity along their paths."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import SEGMENTS, Node, PhaseHistoryWaveform
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError, number_of
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
    """Return (pulse,) bool, True for pulses within the configured segments of a pair.

    `times`: (pulse,) time tags of the transmitter.

    Raises
    ------
    CampaignError
        If no pulse is within a segment.
    """
    segments = campaign.segments_of(flight, pair)
    inside = np.full(len(times), not segments)
    for start, end in segments:
        inside |= (times >= np.datetime64(start)) & (times <= np.datetime64(end))
    if len(times) and not inside.any():
        raise CampaignError(
            f"no pulse of flight {flight}, pair {pair} within {' or '.join('…'.join(line) for line in segments)}",
            where=campaign.root / SEGMENTS,
            expected=f"segments between {times.min()} and {times.max()}, UTC",
            remedy="Correct start and end, or remove the lines to use the whole track.",
        )
    return inside


def keep_segments(campaign: Campaign, flight: str, pair: str, echo: xr.Dataset) -> xr.Dataset:
    """Return an echo without the pulses outside the segments of its pair; attribute `pulses` reports both numbers."""
    if not campaign.segments_of(flight, pair):
        return echo
    inside = inside_segments(campaign, flight, pair, echo.time.values)
    counts = {**echo.attrs.get("pulses", {}), "used": int(inside.sum()), "outside_segments": int((~inside).sum())}
    return echo.isel(pulse=inside).assign_attrs(pulses=counts)


# ---- Pulses with valid positions, and position accuracy --------------------------------------------------------------

_LOG_FAULTS = {
    "fix_quality_low": "position solution poorer than {poorest_fix}",
    "track_gap": "gap in the log",
    "track_outlier": "outliers or steps in the log",
    "track_frozen": "epochs that repeat the previous position",
}
"""Flag → fault of the log."""


@dataclass(frozen=True, eq=False)
class PulsePositions:
    """Validity of the positions of a pair's pulses.

    Attributes
    ----------
    good
        (pulse,) bool, True for pulses with a position of both nodes.
    reasons
        Cause → number of pulses excluded for this cause; each pulse is counted once.
    flags
        Flags with the measured values.
    report
        tx, rx → node, std_m, correlation_s, stated_by, interpolation_m; also smoothing_residual_m, source and remarks
        of the log, if they exist.
    """

    good: NDArray[np.bool_]
    reasons: dict[str, int]
    flags: Flags
    report: dict[str, dict[str, Any]]


def place(tx: NodeLog, rx: NodeLog, at: Times, *, hovers: bool = False) -> PulsePositions:
    """Select the pulses of a pair, at the transmitter's time tags `at`, for which both logs have valid positions.

    Pulses of a hover are excluded unless `hovers` is True, which is the case for pairs with configured segments.

    Raises
    ------
    CampaignError
        If no pulse remains.
    """
    good, reasons, flags = np.ones(len(at), bool), dict[str, int](), Flags()
    for node in {log.name: log for log in (tx, rx)}.values():
        excluded = node.checked.excluded(node.log_seconds(at))
        flags = Flags.merged(flags, _flags(node, at, excluded))
        for cause, pulses in excluded.items():
            reasons[cause] = reasons.get(cause, 0) + int((pulses & good).sum())
            good &= ~pulses
    if not good.any():
        raise CampaignError(
            f"no pulse has a valid position: {'; '.join(flags.values())}",
            where=" and ".join(dict.fromkeys((tx.log, rx.log))),
            expected="logs with valid epochs during the recording",
            remedy="Correct the log, or accept poorer solutions with nodes.<node>.worst_fix.",
        )
    stationary = np.zeros(len(at), bool)
    if not hovers:
        legs = tx.antenna("radar_tx", at[good]), rx.antenna("radar_rx", at[good])
        stationary[good] = hovering(tx.log_seconds(at[good]), legs)
    if stationary.any():
        reasons["hover"] = int(stationary.sum())
        time_s = tx.log_seconds(at)
        first, last = max(stretches(stationary), key=lambda edge: time_s[edge[1] - 1] - time_s[edge[0]])
        flags["hover"] = (
            f"{int(stationary.sum())} of {len(at)} pulses excluded: platform stationary, longest interval "
            f"{time_s[last - 1] - time_s[first]:.0f} s from {tx.log_time(float(time_s[first]))}"
        )
        good &= ~stationary
    report = {
        leg: position_error(node.track, node.settings, at[good])
        | {"node": node.name, "interpolation_m": node.checked.interpolation_m}
        | _log_report(node)
        for leg, node in (("tx", tx), ("rx", rx))
    }
    return PulsePositions(good, {cause: count for cause, count in reasons.items() if count}, flags, report)


def _log_report(node: NodeLog) -> dict[str, Any]:
    """Return smoothing residual, source and remarks of a log; values that do not exist are omitted."""
    values = {"smoothing_residual_m": node.smoothing_residual_m} | {
        name: node.track.attrs.get(name) for name in ("source", "remarks")
    }
    return {name: value for name, value in values.items() if value is not None}


def position_error(track: xr.Dataset, settings: Node, at: Times) -> dict[str, Any]:
    """Return the configured or logged position accuracy of a node at given pulses.

    Returns
    -------
    dict
        std_m: standard deviation [north, east, up], metres, from the config, else the median over the pulses from the
        log, else None; stated_by: log, config or none; correlation_s: correlation time of the error,
        seconds; drift_m: slow error over the flight; receiver: most frequent kind of solution, a key of
        `RECEIVER_STD_M`.
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
    """Return the most frequent kind of solution among RTKLIB's solution numbers.

    Examples
    --------
    >>> _kind_of_solution(np.array([1, 1, 5], np.int8)), _kind_of_solution(np.array([0], np.int8))
    ('fix', 'unknown')
    """
    number = int(np.bincount(np.maximum(fix, 0)).argmax()) if len(fix) else 0
    return next((name for name, own in FIXES.items() if own == number), "unknown")


def stated_error(settings: Node) -> dict[str, Any]:
    """Return the configured position accuracy of a node, in the form of `position_error`."""
    stated = settings.position_std_m
    std_m = None if stated is None else np.broadcast_to(stated, 3).tolist()
    stated_by = "none" if stated is None else "config"
    return {
        "std_m": std_m,
        "correlation_s": settings.position_correlation_s,
        "drift_m": settings.position_drift_m,
        "stated_by": stated_by,
    }


def _flags(node: NodeLog, at: Times, excluded: dict[str, NDArray[np.bool_]]) -> dict[str, str]:
    """Return the faults of a node's log that affect its pulses: flag → one line."""
    checked, lines = node.checked, {}
    begin, end = node.log_seconds(at[[0, -1]]) + np.array([-1.0, 1.0]) * 2 * node.interval_s
    for name, fault in _LOG_FAULTS.items():
        count = int(excluded[name].sum()) if name in excluded else 0
        faults = [(time_s, size_m) for time_s, size_m in checked.faults.get(name, ()) if begin <= time_s <= end]
        if not (count or faults):
            continue
        worst = ""
        if faults:
            time_s, size_m = faults[0]
            size = f"{size_m:.3f} m " if size_m else ""
            worst = f"; {number_of(len(faults), 'fault')}, the worst {size}at {node.log_time(time_s)}"
        longest = _longest_hole(node, checked, name) if count else ""
        reason = fault.format(poorest_fix=node.settings.poorest_fix)
        lines[name] = f"{node.name}: {count} of {len(at)} pulses excluded: {reason}{longest}{worst}"
    if node.track.attrs["dropped"]:
        counted = ", ".join(f"{count} {reason}" for reason, count in node.track.attrs["dropped"].items())
        lines["track_epochs_dropped"] = f"{node.name}: epochs of the log excluded: {counted}"
    if node.track.attrs.get("damage"):
        lines["track_log_damaged"] = f"{node.name}: {node.track.attrs['damage']}"
    if "track_times" in checked.faults:
        lines["track_times"] = (
            f"{node.name}: rounded times of the log cause position errors of "
            f"{checked.faults['track_times'][0][1]:.2f} m along the track"
        )
    if "track_positions" in checked.faults:
        lines["track_positions"] = (
            f"{node.name}: rounded coordinates of the log cause position errors of "
            f"{checked.faults['track_positions'][0][1]:.3f} m"
        )
    if node.yaw_fault is not None:
        lines["attitude_suspect"] = f"{node.name}: {node.yaw_fault.line}"
    return lines


def _longest_hole(node: NodeLog, checked: CheckedTrack, cause: str) -> str:
    holes = [hole for hole in checked.holes if hole.cause == cause and np.isfinite(hole.end_s - hole.start_s)]
    if not holes:
        return " at the start or end of the log"
    hole = max(holes, key=lambda gap: gap.end_s - gap.start_s)
    error = f", interpolation error up to {hole.size_m:.2f} m" if np.isfinite(hole.size_m) else ""
    return f", longest {hole.end_s - hole.start_s:.2f} s at {node.log_time(hole.start_s)}{error}"


GROUND_STEP_M = 10.0
"""Rounding of the terrain height for the refractivity, metres: 0.4 N units.

A small change of the configured height then does not require the echoes to be recomputed.
"""

_SIDE = 16  # pixels per side of the grid on which the mean height of a DEM is computed


def scene_air(campaign: Campaign, position_m: NDArray[np.float64]) -> SceneAir:
    """Return the atmosphere over the scene of a campaign.

    Parameters
    ----------
    campaign
        Campaign with `scene.atmosphere`.
    position_m
        (epoch, 3) float64, metres: antenna positions, from which an automatic CRS and scene centre are derived.

    Notes
    -----
    Source: docs/theory/atmosphere.md. The terrain height is the configured height or the mean of the DEM, rounded to a
    multiple of `GROUND_STEP_M`.
    """
    stated = campaign.settings.scene
    crs = utm_crs(np.median(position_m, axis=0)) if stated.crs == "auto" else stated.crs
    centre = np.median(map_from_frame(crs, position_m)[:, :2], axis=0)
    if stated.bounds_m != "auto":
        xmin, ymin, xmax, ymax = stated.bounds_m
        centre = np.array([xmin + xmax, ymin + ymax]) / 2
    air = stated.atmosphere
    ground_m = 0.0 if air == "vacuum" else _ground_m(campaign, crs, (float(centre[0]), float(centre[1])))
    middle = frame_from_map(crs, centre[0], centre[1], stated.height_m if air == "vacuum" else ground_m)
    if air == "vacuum":
        atmosphere = Atmosphere.vacuum()
    elif air == "auto":
        atmosphere = Atmosphere.standard(ground_m)
    elif air.refractivity_n is not None:
        atmosphere = Atmosphere.stated(air.refractivity_n, ground_m=ground_m)
    else:
        atmosphere = Atmosphere.of_weather(*air.weather, ground_m=ground_m)
    return SceneAir(atmosphere, middle, LOCAL if crs == LOCAL else "ecef")


def _ground_m(campaign: Campaign, crs: str, centre: tuple[float, float]) -> float:
    stated = campaign.settings.scene
    ground = ConfiguredGround.of(stated, campaign.height_files(), crs=crs)
    if ground.dem is None or stated.bounds_m == "auto":
        return GROUND_STEP_M * round(ground.height_at(*centre) / GROUND_STEP_M)
    xmin, ymin, xmax, ymax = stated.bounds_m
    heights = ground.dem.heights(SceneGrid(crs, xmin, ymax, max(xmax - xmin, ymax - ymin) / _SIDE, (_SIDE, _SIDE)))
    finite = heights[np.isfinite(heights)]
    height_m = float(finite.mean()) if finite.size else ground.height_at(*centre)
    return GROUND_STEP_M * round(height_m / GROUND_STEP_M)


def stated_air(air: FlightAir) -> dict[str, Any]:
    """Return the attributes of a stage that state wave speed and atmosphere."""
    return {"wave_speed_m_s": air.wave_speed_m_s, "atmosphere": air.report}


def in_air(campaign: Campaign, history: xr.Dataset) -> xr.Dataset:
    """Return a recorder's phase history with the atmosphere along its paths, according to `waveform.air`.

    If samples are referred to a point, the reference delay is set to the delay of that point in the atmosphere; the
    samples are unchanged.
    """
    waveform, reference = campaign.settings.waveform, history.attrs.get("reference", "delay")
    requested: str = waveform.air if isinstance(waveform, PhaseHistoryWaveform) else "auto"
    if requested == "auto":
        requested = "point" if reference == "point" else "measured"
    air = scene_air(campaign, history.tx_position.values)
    if requested == "corrected":
        source = "vacuum: the files are already corrected (waveform.air)"
        air = replace(air, atmosphere=replace(Atmosphere.stated(0.0, ground_m=0.0), source=source))
    air_on_track = air.over(aperture_of(history))
    if requested == "point":
        history = history.assign(reference_delay=history.reference_delay * (1 + 1e-6 * air_on_track.refractivity_n))
    return history.assign_attrs(stated_air(air_on_track))
