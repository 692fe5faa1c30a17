"""Stage `track`, the common form of all flight logs: times in UTC, positions in ECEF, attitude in radians."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError, number_of, print_remark, quoted
from apertura.common.leap_seconds import KNOWN_UNTIL
from apertura.core.geometry.geodesy import ecef_from_geodetic
from apertura.formats.times import outside, utc_times
from apertura.formats.tracks.log_options import LogOptions

FIXES = {"fix": 1, "float": 2, "sbas": 3, "dgps": 4, "single": 5, "ppp": 6}
"""Solution type → RTKLIB's number, Q."""

GGA_KINDS = {"1": "single", "2": "dgps", "3": "single", "4": "fix", "5": "float", "9": "sbas"}
"""Quality indicator of NMEA GGA → solution type, a key of `FIXES`; 9 as defined by NovAtel."""

GGA_NOT_MEASURED = {"": "no fix", "0": "no fix", "6": "dead reckoning", "7": "manual input", "8": "simulated"}
"""Quality indicator of NMEA GGA → reason why the position is not measured."""

LOWEST_M, HIGHEST_M = -1000.0, 100_000.0
"""Accepted heights above the ellipsoid, m, of aircraft and balloons."""

FARTHEST_M = 1e5
"""Largest accepted local coordinate, m."""

_ROLLOVER = np.timedelta64(1024 * 7, "D")
"""Period of the GPS week number as broadcast by the satellites."""

_EARTH_M = 6.37e6
_NOWHERE_DEG = 1e-7  # a receiver without a fix logs 0, 0; no flight passes within a centimetre of that point
_WIDEST_DEG = 1080.0
_WORST_STD_M = 1e7


def make_track(
    time_utc: NDArray[np.datetime64],
    position: NDArray[np.float64],
    *,
    frame: Literal["geodetic", "ecef", "local"] = "geodetic",
    attitude_deg: NDArray[np.float64] | None = None,
    position_std_m: NDArray[np.float64] | None = None,
    fix: NDArray[np.int8] | None = None,
    dropped: Mapping[str, int] | None = None,
    node: str,
    where: Path,
) -> xr.Dataset:
    """Build the `track` stage of a node from the epochs of its log.

    Parameters
    ----------
    time_utc
        (epoch,) datetime64[ns], UTC, strictly increasing. If times are strictly decreasing, as from a backward filter,
        the epochs are reversed, with a remark.
    position
        (epoch, 3) float64 in `frame`.
    frame
        geodetic: WGS 84 latitude (deg), longitude (deg), ellipsoidal height (m); epochs at latitude 0, longitude 0 have
        no fix and are excluded. ecef: metres. local: metres to east, north and up in the campaign's local frame.
    attitude_deg
        (epoch, 3) float64: roll, pitch, yaw in degrees, yaw clockwise from north; NaN or None: not logged.
    position_std_m
        (epoch, 3) float64: standard deviations to north, east and up, m; NaN or infinite: unknown; None: not logged.
    fix
        (epoch,) int8: solution type, a value of `FIXES`; 0 or None: not logged.
    dropped
        Reason → number of epochs excluded by the reader.
    node
        Node name.
    where
        The log, for messages.

    Raises
    ------
    CampaignError
        If times do not increase, or a value is not finite or outside the range of a flight on Earth.

    Examples
    --------
    >>> times = np.array(["2025-05-14T09:30", "2025-05-14T09:31"], "datetime64[ns]")
    >>> track = make_track(times, np.array([[0, 90, 0], [0, 90, 1.0]]), node="uav1", where=Path("x.csv"))
    >>> track.position.values[1].round(6)
    array([      0., 6378138.,       0.])
    """
    has_fix = (np.abs(position[:, :2]) >= _NOWHERE_DEG).any(axis=1) | (frame != "geodetic")
    excluded = {**(dropped or {}), **({"no fix": int((~has_fix).sum())} if not has_fix.all() else {})}
    time_utc, position = time_utc[has_fix], position[has_fix]
    attitude_deg, position_std_m = (
        None if values is None else values[has_fix] for values in (attitude_deg, position_std_m)
    )
    fix = None if fix is None else fix[has_fix]
    if len(time_utc) < 2:
        without = (
            f" ({', '.join(f'{count} excluded: {reason}' for reason, count in excluded.items())})" if excluded else ""
        )
        raise CampaignError(f"{len(time_utc)} epochs{without}", where, "at least two", "Export the whole log.")
    remarks = []
    if len(time_utc) > 2 and (np.diff(time_utc) < np.timedelta64(0, "ns")).all():
        remarks.append("times decrease, as from a backward filter: the epochs are read in reverse order")
        time_utc, position = time_utc[::-1], position[::-1]
        attitude_deg, position_std_m = (
            None if values is None else values[::-1] for values in (attitude_deg, position_std_m)
        )
        fix = None if fix is None else fix[::-1]
    _check_times(time_utc, where)
    remarks += _rolled_over(time_utc)
    _check_positions(position, frame, where)
    if position_std_m is not None:
        position_std_m = np.where(np.isinf(position_std_m), np.nan, position_std_m)
    _check_stated(attitude_deg, position_std_m, fix, where)
    attitude = np.full_like(position, np.nan) if attitude_deg is None else np.radians(attitude_deg)
    quality = {
        name: (dims, values)
        for name, dims, values in (("position_std", ("epoch", "axis"), position_std_m), ("fix", ("epoch",), fix))
        if values is not None
    }
    variables = {
        **quality,
        "time": (("epoch",), time_utc.astype("datetime64[ns]")),
        "position": (("epoch", "axis"), ecef_from_geodetic(*position.T) if frame == "geodetic" else position),
        "attitude": (("epoch", "axis"), attitude),
    }
    # fastpath: otherwise xarray imports dask and scipy to check the array types
    track = xr.Dataset(
        {name: xr.Variable(dims, values, fastpath=True) for name, (dims, values) in variables.items()},
        attrs={"node": node, "frame": "local" if frame == "local" else "ecef", "dropped": excluded},
    )
    for remark in remarks:
        track = remarked(track, remark, where)
    return track


def remarked(track: xr.Dataset, remark: str, where: Path) -> xr.Dataset:
    """Add a remark on the reading of a log to the attribute `remarks` of its track, and print it.

    Parameters
    ----------
    track
        Result of `make_track`.
    remark
        One line.
    where
        The log.
    """
    print_remark(str(where), remark)
    return track.assign_attrs(remarks=[*track.attrs.get("remarks", ()), remark])


def damaged(track: xr.Dataset, found: str, where: Path) -> xr.Dataset:
    """Add a remark on damage of a log to its track, and set the attribute `damage`, which raises a flag of the images.

    Parameters
    ----------
    track
        Result of `make_track`.
    found
        Description of the damage in one line; empty if there is none.
    where
        The log.
    """
    return remarked(track, found, where).assign_attrs(damage=found) if found else track


def receivers_remark(kinds: Mapping[str, NDArray[np.int8]], selected: str, node: str) -> str:
    """Format the remark on a log with several receivers if the config does not select one of them.

    Parameters
    ----------
    kinds
        Receiver → (epoch,) solution types, values of `FIXES` or 0.
    selected
        Receiver that is read.
    node
        Node of the log.

    Examples
    --------
    >>> receivers_remark({"0": np.array([5, 5]), "1": np.array([1, 0])}, "0", "uav1")
    'the log contains receivers 0 (single 2) and 1 (fix 1, no fix 1); 0 is used; select with nodes.uav1.log.body'
    """
    names = {number: name for name, number in FIXES.items()} | {0: "no fix"}
    listed = []
    for receiver, fix in kinds.items():
        counted = {name: int((fix == number).sum()) for number, name in names.items()}
        solutions = ", ".join(f"{name} {count}" for name, count in counted.items() if count)
        listed.append(f"{receiver} ({solutions or 'no epochs'})")
    return f"the log contains receivers {' and '.join(listed)}; {selected} is used; select with nodes.{node}.log.body"


def _rolled_over(time_utc: NDArray[np.datetime64]) -> list[str]:
    """Return a remark if times are so early that the receiver may count GPS weeks modulo 1024 (week rollover)."""
    periods = (KNOWN_UNTIL - time_utc[-1]) // _ROLLOVER
    if periods < 1:
        return []
    meant = (time_utc[0] + periods * _ROLLOVER).astype("datetime64[D]")
    return [
        f"the log starts on {time_utc[0].astype('datetime64[D]')}; if its receiver counts GPS weeks modulo 1024, the "
        f"flight was {periods * 1024} weeks later, on {meant}: correct the times of the log"
    ]


def _check_positions(position: NDArray[np.float64], frame: str, where: Path) -> None:
    """Raise CampaignError if a position is not finite or outside the range of a flight."""
    if frame == "geodetic":
        latitude, longitude, height = position.T
        good = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 360) & (height >= LOWEST_M) & (height <= HIGHEST_M)
        expected = "finite latitude, longitude and ellipsoidal height, the height between "
        expected += f"{LOWEST_M:g} and {HIGHEST_M:g} m"
    elif frame == "ecef":
        above_m = np.linalg.norm(position, axis=1) - _EARTH_M
        good, expected = np.abs(above_m) <= HIGHEST_M, "finite ECEF coordinates in metres, near the Earth's surface"
    else:
        good = (np.abs(position) <= FARTHEST_M).all(axis=1)
        expected = f"finite local coordinates within {FARTHEST_M:g} m"
    if not good.all():
        first = int(np.flatnonzero(~good)[0])
        epochs = number_of(int((~good).sum()), "epoch")
        raise CampaignError(
            f"{epochs} without a valid position, first epoch {first}: {position[first].tolist()}",
            where,
            expected,
            "Remove those lines, or export the log again.",
        )


def _check_stated(
    attitude_deg: NDArray[np.float64] | None,
    position_std_m: NDArray[np.float64] | None,
    fix: NDArray[np.int8] | None,
    where: Path,
) -> None:
    """Raise CampaignError if a logged value is outside its range; NaN is ignored."""
    std, kinds = "a standard deviation", sorted(FIXES.values())
    for name, values, low, high in (
        ("an attitude angle", attitude_deg, -_WIDEST_DEG, _WIDEST_DEG),
        (std, position_std_m, 0.0, _WORST_STD_M),
        ("a solution type", fix, 0, kinds[-1]),
    ):
        wrong = None if values is None else np.argwhere((values < low) | (values > high))
        if values is not None and wrong is not None and wrong.size:
            raise CampaignError(
                f"{name} of {values[tuple(wrong[0])]:g} in epoch {int(wrong[0][0])}",
                where,
                f"{low:g} to {high:g}",
                "Remove those lines, or export the log again.",
            )


def _check_times(time_utc: NDArray[np.datetime64], where: Path) -> None:
    beyond = outside(time_utc)
    if beyond.size:
        epoch = int(beyond[0])
        raise CampaignError(
            f"epoch {epoch} is at {time_utc[epoch]}", where, "times between 1980 and 2199", "Correct the log."
        )
    steps = np.diff(time_utc)
    wrong = np.flatnonzero(steps <= np.timedelta64(0, "ns"))
    if wrong.size:
        epoch = int(wrong[0]) + 1
        relation = "equal to" if steps[wrong[0]] == np.timedelta64(0, "ns") else "before"
        raise CampaignError(
            f"the time of epoch {epoch} ({time_utc[epoch]}) is {relation} that of the previous epoch "
            f"({time_utc[epoch - 1]})",
            where,
            "strictly increasing times",
            "Remove repeated lines from the log, or sort it.",
        )


# ---- Values from the config, and contradictions between log and config ----------------------------------------------

_UNIX = re.compile(r"1970-01-01(?:[T ]00:00(?::00(?:\.0+)?)?)?", re.ASCII)


def unstated(key: str, found: str, *, node: str, where: Path, remedy: str = "") -> CampaignError:
    """Return the error for a log without a value that must then be configured.

    Parameters
    ----------
    key
        Field of `LogOptions`.
    found
        Description of the log without the value.
    node, where
        Node and file of the log.
    remedy
        Alternative remedy, or details.

    Examples
    --------
    >>> print(unstated("start_utc", "times of day only", node="uav1", where=Path("a.nmea")))
    a.nmea: times of day only; expected key nodes.uav1.log.start_utc in config.yaml. Add it.
    """
    return CampaignError(found, where, f"key nodes.{node}.log.{key} in config.yaml", f"Add it{remedy}.")


def contradicted(key: str, found: str, *, node: str, where: Path) -> CampaignError:
    """Return the error for a log that contradicts the config; for the parameters see `unstated`.

    Examples
    --------
    >>> print(contradicted("base", "ref pos 48 9 600", node="uav1", where=Path("a.pos")))
    a.pos: ref pos 48 9 600; expected nodes.uav1.log.base of config.yaml. Remove the key if the log is correct.
    """
    expected = f"nodes.{node}.log.{key} of config.yaml"
    return CampaignError(found, where, expected, "Remove the key if the log is correct.")


def start_time(options: LogOptions, found: str, *, node: str, where: Path) -> np.datetime64:
    """Return the configured time zero or date of a log: datetime64[ns], UTC.

    Parameters
    ----------
    options
        Options with or without start_utc.
    found, node, where
        See `unstated`.

    Raises
    ------
    CampaignError
        If start_utc is missing or is not a time.

    Examples
    --------
    >>> str(start_time(LogOptions(start_utc="2025-05-14T09:30Z"), "", node="uav1", where=Path("a.csv")))
    '2025-05-14T09:30:00.000000000'
    """
    if options.start_utc is None:
        raise unstated("start_utc", found, node=node, where=where)
    text = options.start_utc.strip().removesuffix("Z").removesuffix("+00:00")
    if _UNIX.fullmatch(text):  # older than any recording, but valid as the epoch of Unix time
        return np.datetime64(0, "ns")
    try:
        return np.datetime64(utc_times([text])[0])
    except ValueError as error:
        raise CampaignError(
            quoted(options.start_utc),
            f"config.yaml: nodes.{node}.log.start_utc",
            "a time in UTC such as 2025-05-14T09:30:00",
            "Correct the key.",
        ) from error
