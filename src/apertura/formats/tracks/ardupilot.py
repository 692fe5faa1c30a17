"""ArduPilot flight logs (DataFlash .bin, or .log as text): epochs of the receiver in GPS weeks, and attitude."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.errors import CampaignError, quoted
from apertura.common.leap_seconds import gps_from_weeks, utc_from_gps
from apertura.formats.isolated import UnreadableError, read_isolated
from apertura.formats.tracks import dataflash_fields
from apertura.formats.tracks.autopilot import Attitude, Epochs, autopilot_track
from apertura.formats.tracks.damage import damage_of
from apertura.formats.tracks.dataflash_fields import COLUMNS, DAMAGE, NEEDED
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions
from apertura.formats.tracks.track import FIXES, damaged, receivers_remark, remarked

Fields = Mapping[str, NDArray[Any]]

_KINDS = {3: FIXES["single"], 4: FIXES["dgps"], 5: FIXES["float"], 6: FIXES["fix"]}
"""GPS.Status → solution type; values below 3 have no height."""

_DELAYS = (("GPS_DELAY_MS", "GPS1_DELAY_MS"), ("GPS_DELAY_MS2", "GPS2_DELAY_MS"))
_TYPES = (("GPS_TYPE", "GPS1_TYPE"), ("GPS_TYPE2", "GPS2_TYPE"))
_DELAY_S = 0.12
_NOVATEL = 15  # GPS1_TYPE of NovAtel receivers: the driver reverses the sign of the undulation, so AEl is wrong
_LAST_WEEK, _WEEK_MS = 11_000, 604_800_000
_LOWEST_M = -1e6  # an unknown AEl is logged as the lowest integer, which is below this height
_EXPECTED = f"an ArduPilot DataFlash log whose GPS messages contain {', '.join(NEEDED)}"


def read_ardupilot(path: Path, *, node: str, options: LogOptions = DEFAULT_OPTIONS) -> xr.Dataset:
    """Read a DataFlash log as `track` stage; its attribute `source` states the receiver used and all receivers.

    Receiver 0 is used, or the receiver with the number ``options.body``. GPS week and milliseconds are converted to UTC
    by the table of leap seconds. Heights above the ellipsoid are read from GPA.AEl; logs without this field contain
    only GPS.Alt, above sea level, and require ``options.height_offset_m``. GPA.Und of some versions is not used,
    because its sign depends on the driver.

    Parameters
    ----------
    path
        The log.
    node
        Node of the log.
    options
        start_utc: UTC at the start of the autopilot, if its receiver provides no GPS week.

    Raises
    ------
    CampaignError
        If the file is not a DataFlash log, or contains no positions, no ellipsoidal heights or no GPS time.

    Notes
    -----
    Source: ArduPilot, AP_GPS/LogStructure.h and AP_AHRS/LogStructure.h (messages GPS, GPA, ATT), and parameters
    GPS1_DELAY_MS, GPS1_TYPE.
    """
    try:
        fields = read_isolated(dataflash_fields.read_fields, [path])[0]
    except UnreadableError as error:
        raise _error(f"not readable ({error})", path) from error
    return track_of(fields, node=node, options=options, where=path)


def track_of(fields: Fields, *, node: str, options: LogOptions, where: Path) -> xr.Dataset:
    """Build the `track` stage from the fields of a DataFlash log.

    Parameters
    ----------
    fields
        Result of `apertura.formats.tracks.dataflash_fields.read_fields`.
    node, options, where
        See `read_ardupilot`.

    Raises
    ------
    CampaignError
        See `read_ardupilot`.
    """
    chosen, known = _receiver(fields, options, node, where)
    rows = {name: fields[f"GPS/{name}"][fields["GPS/I"] == chosen] for name in COLUMNS["GPS"]}
    accuracy = _accuracy(fields, chosen, rows["TimeUS"])
    height = _height(fields, rows["Alt"], accuracy["AEl"], chosen, options)
    if height is None:
        raise CampaignError(
            "heights are above sea level (GPS.Alt), without reliable heights above the ellipsoid",
            where,
            "GPA.AEl of a receiver other than a NovAtel",
            f"Set nodes.{node}.log.height_offset_m to the geoid undulation, to convert GPS.Alt.",
        )
    try:
        time_utc = _utc(rows["GWk"], rows["GMS"])
    except ValueError as error:
        raise _error(str(error), where) from error
    fix = _fix(rows["Status"])
    epochs = Epochs(
        boot_s=rows["TimeUS"] * 1e-6,
        time_utc=time_utc,
        geodetic=np.stack([rows["Lat"], rows["Lng"], height], -1),
        fixed=fix > 0,
        fix=fix,
        std_m=np.stack([accuracy["HAcc"], accuracy["HAcc"], accuracy["VAcc"]], -1),
        velocity=_velocity(rows, accuracy["VV"]),
    )
    delay_s = _parameter(fields, _DELAYS, chosen, 0.0) / 1e3
    delay_s = delay_s if 0 < delay_s < 1 else _DELAY_S
    track = autopilot_track(epochs, _attitude(fields), delay_s=delay_s, options=options, node=node, where=where)
    track.attrs["source"] = f"GPS {chosen} of {', '.join(map(str, known))}"
    for unit, name in DAMAGE.items():
        if name in fields:
            track = damaged(track, damage_of(fields[name], unit), where)
    if len(known) > 1 and options.body is None:
        kinds = {str(number): _fix(fields["GPS/Status"][fields["GPS/I"] == number]) for number in known}
        track = remarked(track, receivers_remark(kinds, str(chosen), node), where)
    return track


def _fix(status: Floats) -> NDArray[np.int8]:
    return np.array([_KINDS.get(int(kind) if np.isfinite(kind) else 0, 0) for kind in status], np.int8)


def _receiver(fields: Fields, options: LogOptions, node: str, where: Path) -> tuple[int, list[int]]:
    """Return the number of the selected receiver, and the numbers of all receivers."""
    numbers = fields["GPS/I"]
    known = sorted({int(number) for number in numbers[np.isfinite(numbers)]})
    if not known:
        raise _error("no GPS message", where)
    if options.body is not None and options.body not in map(str, known):
        raise CampaignError(
            f"no receiver {quoted(options.body)}",
            where,
            f"one of {', '.join(map(str, known))}",
            f"Correct nodes.{node}.log.body, or omit it.",
        )
    return known[0] if options.body is None else int(options.body), known


def _accuracy(fields: Fields, receiver: int, time_us: Floats) -> dict[str, Floats]:
    """Return HAcc, VAcc, AEl (m) and VV (VZ is valid) from the GPA message of each epoch; NaN without a message."""
    own = fields["GPA/I"] == receiver
    times, order = np.unique(fields["GPA/TimeUS"][own], return_index=True)
    index = np.searchsorted(times, time_us)
    has_message = index < times.size
    has_message[has_message] = times[index[has_message]] == time_us[has_message]
    accuracy = {name: np.full(time_us.size, np.nan) for name in ("HAcc", "VAcc", "VV", "AEl")}
    for name, values in accuracy.items():
        values[has_message] = fields[f"GPA/{name}"][own][order][index[has_message]]
    return accuracy


def _height(
    fields: Fields, sea_level: Floats, ellipsoidal: Floats, receiver: int, options: LogOptions
) -> Floats | None:
    """Return heights above the ellipsoid, NaN where unknown; None if they are neither logged nor convertible."""
    known = ellipsoidal > _LOWEST_M
    if known.any() and _parameter(fields, _TYPES, receiver, 0) != _NOVATEL:
        return np.where(known, ellipsoidal, np.nan)
    return None if options.height_offset_m is None else sea_level + options.height_offset_m


def _parameter(fields: Fields, names: tuple[tuple[str, ...], ...], receiver: int, default: float) -> float:
    """Return a parameter of a receiver; the name of the parameter depends on the version of ArduPilot."""
    candidates = names[min(receiver, len(names) - 1)]
    return next((float(fields[f"PARM/{name}"][0]) for name in candidates if f"PARM/{name}" in fields), default)


def _utc(week: Floats, milliseconds: Floats) -> NDArray[np.datetime64]:
    """Convert GPS weeks and milliseconds to UTC; NaT where week or milliseconds are not yet valid."""
    known = (week > 0) & (week <= _LAST_WEEK) & (milliseconds >= 0) & (milliseconds < _WEEK_MS)
    utc = np.full(week.size, np.datetime64("NaT", "ns"), "datetime64[ns]")
    utc[known] = utc_from_gps(gps_from_weeks(week[known].astype(np.int64), milliseconds[known].astype(np.int64)))
    return utc


def _velocity(rows: Fields, vertical: Floats) -> Floats:
    """Return velocities to north, east and down."""
    course = np.radians(rows["GCrs"])
    down = np.where(vertical == 1, rows["VZ"], np.nan)
    return np.stack([rows["Spd"] * np.cos(course), rows["Spd"] * np.sin(course), down], -1)


def _attitude(fields: Fields) -> Attitude | None:
    from scipy.spatial.transform import Rotation

    angles = np.stack([fields[f"ATT/{name}"] for name in ("Yaw", "Pitch", "Roll")], -1)
    good = np.isfinite(angles).all(axis=1) & (np.abs(angles) <= 360).all(axis=1)
    if not good.any():
        return None
    rotations = Rotation.from_euler("ZYX", angles[good], degrees=True)
    return Attitude(fields["ATT/TimeUS"][good] * 1e-6, rotations.as_quat())


def _error(found: str, path: Path) -> CampaignError:
    return CampaignError(found, path, _EXPECTED, "Copy the log again, or log GPS messages.")
