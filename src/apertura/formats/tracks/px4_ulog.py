"""PX4 flight logs (.ulg): GNSS epochs of the receiver, or positions fused with inertial data, and attitude."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError, quoted
from apertura.formats.isolated import UnreadableError, read_isolated
from apertura.formats.tracks import ulog_fields
from apertura.formats.tracks.autopilot import Attitude, Epochs, autopilot_track, clock_of
from apertura.formats.tracks.damage import damage_of
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions
from apertura.formats.tracks.track import FIXES, damaged, receivers_remark, remarked
from apertura.formats.tracks.ulog_fields import ATTITUDE, CORRUPT, DAMAGE, DELAY, DROPOUTS, FUSED, RECEIVERS

Fields = Mapping[str, NDArray[Any]]

_KINDS = {3: FIXES["single"], 4: FIXES["dgps"], 5: FIXES["float"], 6: FIXES["fix"]}
"""fix_type → solution type; values below 3 have no height, and 8 means extrapolated."""

_STATES = {"dead_reckoning": 0, "lat_lon_valid": 1, "alt_valid": 1}
"""State flag of fused positions → its value while GNSS is used; each version of PX4 logs some of the flags."""

_ALWAYS = ("fix_type", "vel_n_m_s", "vel_e_m_s", "vel_d_m_s")
"""Receiver fields that every version of PX4 logs; a missing field indicates a damaged log."""

_DELAY_MS = 110.0
_FIRST_US, _LAST_US = 3.2e14, 7.2e15  # UTC from 1980 to 2198; 0 means unknown
_LATITUDE, _LONGITUDE = ("latitude_deg", "lat"), ("longitude_deg", "lon")
_ELLIPSOIDAL, _SEA_LEVEL = ("altitude_ellipsoid_m", "alt_ellipsoid"), ("altitude_msl_m", "alt")
_SCALES = {"lat": 1e-7, "lon": 1e-7, "alt": 1e-3, "alt_ellipsoid": 1e-3}
"""Factors of integer fields; other fields are in degrees and metres."""

_EXPECTED = f"a PX4 ULog with positions in {', '.join((*RECEIVERS, FUSED))}"


def read_px4_ulog(path: Path, *, node: str, options: LogOptions = DEFAULT_OPTIONS) -> xr.Dataset:
    """Read a PX4 ULog as `track` stage; its attribute `source` states the topic and instance used.

    The topic is vehicle_gps_position if logged, otherwise sensor_gps; both contain the receiver's solution for its
    antenna, with UTC. If neither is logged, vehicle_global_position is used; its height follows a barometer, and its
    time is derived from the receiver's UTC. ``options.body`` selects a topic, or one of several receivers as
    ``sensor_gps:1``. Attitude is read from vehicle_attitude. Heights are ellipsoidal. If the driver logs no ellipsoidal
    heights, or copies of the heights above sea level in their place, heights above sea level are converted with
    ``options.height_offset_m``.

    Parameters
    ----------
    path
        The log.
    node
        Node of the log.
    options
        start_utc: UTC at the start of the autopilot, if its receiver provides no UTC.

    Raises
    ------
    CampaignError
        If the file is not a ULog, or contains no positions, no ellipsoidal heights or no UTC.

    Notes
    -----
    Source: PX4 user guide, "ULog file format"; messages SensorGps, VehicleGlobalPosition and VehicleAttitude of PX4.
    """
    try:
        fields = read_isolated(ulog_fields.read_fields, [path])[0]
    except UnreadableError as error:
        raise _error(f"not readable ({error})", path) from error
    return track_of(fields, node=node, options=options, where=path)


def track_of(fields: Fields, *, node: str, options: LogOptions, where: Path) -> xr.Dataset:
    """Build the `track` stage from the fields of a ULog.

    Parameters
    ----------
    fields
        Result of `apertura.formats.tracks.ulog_fields.read_fields`.
    node, options, where
        See `read_px4_ulog`.

    Raises
    ------
    CampaignError
        See `read_px4_ulog`.
    """
    source = _source(fields, options, node, where)
    delay_s = float(fields.get(DELAY, [_DELAY_MS])[0]) / 1e3
    delay_s = delay_s if 0 <= delay_s < 1 else _DELAY_MS / 1e3
    epochs = _epochs(fields, source, options, node, where)
    if source.startswith(FUSED):
        receiver = next((name for name in _sources(fields) if not name.startswith(FUSED)), None)
        receiver_time = None if receiver is None else _of_receiver(fields, receiver)
        if receiver_time is not None and receiver_time[0].size:
            clock = clock_of(*receiver_time, delay_s=delay_s, where=where)[0]
            epochs = replace(epochs, time_utc=clock.utc(epochs.boot_s))
        delay_s = 0.0  # fused positions are valid at their time stamps
    track = autopilot_track(epochs, _attitude(fields), delay_s=delay_s, options=options, node=node, where=where)
    track.attrs["source"] = source
    return _with_remarks(track, fields, source, options, node, where)


def _with_remarks(
    track: xr.Dataset, fields: Fields, source: str, options: LogOptions, node: str, where: Path
) -> xr.Dataset:
    """Add remarks on damage, dropouts of the logger and other receivers to the track of a log."""
    damage = damage_of(fields[DAMAGE]) if DAMAGE in fields else ""
    if not damage and CORRUPT in fields and fields[CORRUPT].any():
        damage = "some messages do not match the message formats defined in the log; epochs may be lost"
    track = damaged(track, damage, where)
    dropouts = fields.get(DROPOUTS, np.zeros(0, np.int64))
    if dropouts.size:
        duration_s = dropouts.sum() / 1e3
        remark = f"{dropouts.size} dropouts of the logger, total {duration_s:.1f} s: messages during dropouts are lost"
        track = remarked(track, remark, where)
    receivers = [name for name in _sources(fields) if not name.startswith(FUSED)]
    several = len({name for name in receivers if name.startswith(source.partition(":")[0])}) > 1
    if several and options.body is None:
        kinds = {name: _fix(fields, name) for name in receivers}
        track = remarked(track, receivers_remark(kinds, source, node), where)
    return track


def _fix(fields: Fields, source: str) -> NDArray[np.int8]:
    """Return the solution type of each message of a receiver; 0 without a 3D fix."""
    kinds = fields.get(f"{source}/fix_type", np.zeros(0, np.uint8))
    return np.array([_KINDS.get(int(kind), 0) for kind in kinds], np.int8)


def _sources(fields: Fields) -> list[str]:
    """List topic:instance of the logged positions, best first."""
    instances = {name.partition("/")[0] for name in fields}
    return [name for topic in (*RECEIVERS, FUSED) for name in sorted(instances) if name.startswith(f"{topic}:")]


def _source(fields: Fields, options: LogOptions, node: str, where: Path) -> str:
    known = _sources(fields)
    matching = [name for name in known if options.body in (None, name, name.partition(":")[0])]
    if not known:
        raise _error("no position messages", where)
    if not matching:
        raise CampaignError(
            f"no positions of {quoted(options.body)}",
            where,
            f"one of {', '.join(known)}",
            f"Correct nodes.{node}.log.body, or omit it.",
        )
    return matching[0]


def _epochs(fields: Fields, source: str, options: LogOptions, node: str, where: Path) -> Epochs:
    """Return the epochs of a topic; those of fused positions have no UTC yet."""
    latitude, longitude = (_first(fields, source, names) for names in (_LATITUDE, _LONGITUDE))
    if latitude is None or longitude is None:
        raise _error(f"no latitude and longitude in {source}", where)
    quality = {name: fields.get(f"{source}/{name}") for name in ("fix_type", "eph", "epv")}
    fix = None if quality["fix_type"] is None else _fix(fields, source)
    missing = [name for name in _ALWAYS if f"{source}/{name}" not in fields and not source.startswith(FUSED)]
    if missing:
        raise _error(f"no {', '.join(missing)} in {source}", where)
    has_fix = np.ones(latitude.size, bool) if fix is None else fix > 0
    for name, good in _STATES.items():
        has_fix &= np.asarray(fields.get(f"{source}/{name}", good)) == good
    boot_s = fields[f"{source}/timestamp"] * 1e-6
    utc = np.full(boot_s.size, np.datetime64("NaT", "ns"), "datetime64[ns]")
    if not source.startswith(FUSED):
        boot_s, utc = _arrived(fields, source), _utc(fields, source)
    unknown = np.full(latitude.size, np.nan)
    horizontal, up = (unknown if values is None else _numbers(values) for values in (quality["eph"], quality["epv"]))
    height = _height(fields, source, has_fix, options.height_offset_m)
    if height is None:
        raise CampaignError(
            f"{source} contains no heights above the ellipsoid",
            where,
            "altitude_ellipsoid_m or alt_ellipsoid that differs from the height above sea level",
            f"Set nodes.{node}.log.height_offset_m to the geoid undulation, to convert heights above sea level.",
        )
    return Epochs(
        boot_s,
        utc,
        np.stack([latitude, longitude, height], -1),
        has_fix,
        fix,
        np.stack([horizontal, horizontal, up], -1),
        _velocity(fields, source),
    )


def _height(
    fields: Fields, source: str, has_fix: NDArray[np.bool_], offset_m: float | None
) -> NDArray[np.float64] | None:
    ellipsoidal, sea_level = (_first(fields, source, names) for names in (_ELLIPSOIDAL, _SEA_LEVEL))
    copied = ellipsoidal is None or not has_fix.any()
    if ellipsoidal is not None and has_fix.any():
        # a driver without geoid undulation logs 0, or the same height twice; an actual undulation is never below 1 mm
        copied = not ellipsoidal[has_fix].any()
        copied |= sea_level is not None and bool(np.abs((ellipsoidal - sea_level)[has_fix]).max() < 1e-3)
    if not copied:
        return ellipsoidal
    return sea_level + offset_m if sea_level is not None and offset_m is not None else None


def _velocity(fields: Fields, source: str) -> NDArray[np.float64]:
    unknown = np.full(fields[f"{source}/timestamp"].size, np.nan)
    axes = [_first(fields, source, (f"vel_{axis}_m_s", f"vel_{axis}")) for axis in "ned"]
    valid = np.asarray(fields.get(f"{source}/vel_ned_valid", 1)) == 1
    velocity = np.stack([unknown if axis is None else axis for axis in axes], -1)
    return np.where(valid[..., None], velocity, np.nan)


def _first(fields: Fields, source: str, names: tuple[str, ...]) -> NDArray[np.float64] | None:
    """Return the first of several fields that is logged, in degrees or metres."""
    for name in names:
        values = fields.get(f"{source}/{name}")
        if values is not None:
            return _numbers(values * _SCALES[name] if values.dtype.kind in "iu" else values)
    return None


def _numbers(values: NDArray[Any]) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore"):  # a signalling NaN stays NaN and is rejected later
        return np.asarray(values, np.float64)


def _arrived(fields: Fields, source: str) -> NDArray[np.float64]:
    """Return the time of the autopilot's clock at the UTC of each message."""
    offset_us = fields.get(f"{source}/timestamp_time_relative", np.zeros(1))
    return np.asarray((fields[f"{source}/timestamp"].astype(np.float64) + offset_us) * 1e-6)


def _utc(fields: Fields, source: str) -> NDArray[np.datetime64]:
    receiver_time = fields.get(f"{source}/time_utc_usec")
    size = fields[f"{source}/timestamp"].size
    receiver_time = np.zeros(size, np.uint64) if receiver_time is None else receiver_time
    known = (receiver_time > _FIRST_US) & (receiver_time < _LAST_US)
    utc = np.full(size, np.datetime64("NaT", "ns"), "datetime64[ns]")
    utc[known] = receiver_time[known].astype("datetime64[us]")
    return utc


def _of_receiver(fields: Fields, source: str) -> tuple[NDArray[np.float64], NDArray[np.datetime64]]:
    """Return times of the autopilot's clock and the corresponding UTC of a receiver."""
    utc = _utc(fields, source)
    known = ~np.isnat(utc)
    return _arrived(fields, source)[known], utc[known]


def _attitude(fields: Fields) -> Attitude | None:
    topic = f"{ATTITUDE}:0"
    parts = [fields.get(f"{topic}/q[{n}]") for n in (1, 2, 3, 0)]  # logged as w, x, y, z
    if any(part is None for part in parts):
        return None
    return Attitude(fields[f"{topic}/timestamp"] * 1e-6, np.stack([np.asarray(p, np.float64) for p in parts], -1))


def _error(found: str, path: Path) -> CampaignError:
    return CampaignError(found, path, _EXPECTED, "Copy the log again, or log these topics.")
