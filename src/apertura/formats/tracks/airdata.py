"""Flight logs of DJI drones exported by AirData (CSV), with UTC in whole seconds and a clock in milliseconds."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError, quoted
from apertura.common.units import seconds_since
from apertura.formats.times import utc_times
from apertura.formats.tracks.csv_track import cut_off, numbers, read_table
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions
from apertura.formats.tracks.track import contradicted, make_track, remarked, unstated

_CLOCK, _UTC = "time(millisecond)", "datetime(utc)"
_PLACE = ["latitude", "longitude"]
_ATTITUDE = ["roll(degrees)", "pitch(degrees)", "compass_heading(degrees)"]
_HEIGHTS = {"altitude_above_seaLevel(meters)": 1.0, "altitude_above_seaLevel(feet)": 0.3048}
_SATELLITES = "satellites"
_FEWEST = 4  # with fewer satellites, positions are obtained by dead reckoning

_APART = 1.5
"""Difference between the increments of UTC and of the clock above which the clock is considered stopped, in units of
UTC; truncation of UTC causes a difference of at most 1."""

_TOLERANCE_S = 0.1
"""Required accuracy of a segment's clock offset, and tolerated distance of an epoch from its second, s; both equal
AirData's sampling interval."""

_ROUNDING_S = 1e-6

_DATE = re.compile(
    r"(?P<first>\d{1,4})(?P<mark>[-/.])(?P<second>\d{1,2})(?P=mark)(?P<third>\d{1,4})[ T]+"
    r"(?P<hour>\d{1,2}):(?P<minute>\d\d)(?::(?P<seconds>\d\d))?(?: ?(?P<half>[AaPp][Mm]))?",
    re.ASCII,
)
"""Date formats of an AirData account: year first or last, month and day in either order."""

_SETTING = "Set the date format of the AirData account to YYYY-MM-DD and 24 hours, and export the flight again."
_EXPECTED = f"AirData's CSV: {_CLOCK}, {_UTC}, {', '.join(_PLACE)}, altitude_above_seaLevel, {', '.join(_ATTITUDE)}"


def read_airdata(path: Path, *, node: str, options: LogOptions = DEFAULT_OPTIONS) -> xr.Dataset:
    """Read a DJI flight exported by AirData, at 10 Hz, as `track` stage.

    Column datetime(utc) is truncated to whole seconds, or to whole minutes if a spreadsheet saved the export. UTC is
    therefore computed as time(millisecond) plus the offset for which every epoch lies within its second or minute.
    Dates may have any format of an AirData account, provided that the rows determine which number is the day. The clock
    stops while the motors are off, so each segment between stops has its own offset; segments too short to determine
    the offset are excluded. Misfits are reported in the remarks. Heights are above mean sea level, so that
    options.height_offset_m is required. The log does not contain the solution type (RTK or not).

    Raises
    ------
    CampaignError
        If a column is missing, a cell is not a number, the height offset is not configured, or the two clocks disagree.

    Notes
    -----
    Source: equations in docs/theory/logs.md, "Two clocks".
    """
    if options.time_system == "gpst":
        raise contradicted("time_system", f"{_UTC} is UTC", node=node, where=path)
    if options.height_offset_m is None:
        raise unstated("height_offset_m", "heights above mean sea level", node=node, where=path)
    try:
        table = read_table(path, (_CLOCK, _UTC, *_PLACE), optional=(*_ATTITUDE, *_HEIGHTS, _SATELLITES), texts=(_UTC,))
        height = next((name for name in _HEIGHTS if name in table), None)
        if height is None:
            raise ValueError("no column altitude_above_seaLevel, in metres or feet")
        cut = cut_off(path)
        table, dropped = _measured(table.iloc[: len(table) - cut])
        time, unit = _dates(table[_UTC].fillna("").str.strip().tolist())
        utc, resolved, misfit_s, parts = _utc(numbers(table[[_CLOCK]])[:, 0] / 1000, time, unit)
        logged = numbers(table[[*_PLACE, height]])
        attitude = numbers(table[_ATTITUDE])[resolved] if set(_ATTITUDE) <= set(table) else None
    except _DateError as error:
        raise CampaignError(f"column {_UTC}: {error}", path, "dates such as 2025-05-14 09:29:58", _SETTING) from error
    except (ValueError, ArithmeticError) as error:
        found = str(error).partition("\n")[0]
        raise CampaignError(found, path, _EXPECTED, "Export the flight from AirData again.") from error
    position = logged * [1.0, 1.0, _HEIGHTS[height]] + [0.0, 0.0, options.height_offset_m]
    dropped |= {"truncated line": int(cut), "in a segment too short to determine its time": int((~resolved).sum())}
    track = make_track(
        utc[resolved],
        position[resolved],
        attitude_deg=attitude,
        dropped={reason: count for reason, count in dropped.items() if count},
        node=node,
        where=path,
    )
    remark = (
        f"{_UTC} contains whole {unit}s; misfit to the millisecond clock {misfit_s:.2f} s, continuous clock segments: "
        f"{parts}"
    )
    return remarked(track, remark, path)


def _measured(table: pd.DataFrame) -> tuple[pd.DataFrame, dict[str, int]]:
    """Return the rows with a measured position, without repetitions, and the number of excluded rows by reason."""
    doubled = table.duplicated([_CLOCK, _UTC, *_PLACE]).to_numpy()
    blind = np.zeros(len(table), bool)
    if _SATELLITES in table:
        blind = numbers(table[[_SATELLITES]])[:, 0] < _FEWEST
    counts = {"duplicate": doubled, f"fewer than {_FEWEST} satellites": blind & ~doubled}
    return table[~(doubled | blind)], {reason: int(rows.sum()) for reason, rows in counts.items()}


class _DateError(ValueError):
    """Error for invalid or ambiguous dates."""


def _dates(texts: Sequence[str]) -> tuple[NDArray[np.datetime64], str]:
    """Parse UTC times; return them with the unit to which they are truncated, second or minute."""
    unique = list(dict.fromkeys(texts))
    matches = [_DATE.fullmatch(text) for text in unique]
    wrong = next((text for text, match in zip(unique, matches, strict=True) if match is None), None)
    if wrong is not None:
        raise _DateError(f"{quoted(wrong, 40)} is not a date and time")
    dates = [match for match in matches if match]
    order = _order([match.group("first", "mark", "second", "third") for match in dates], unique)
    times = {}
    for text, match in zip(unique, dates, strict=True):
        year, month, day = (int(match[part]) for part in order)
        hour = int(match["hour"])
        if match["half"]:
            if not 1 <= hour <= 12:
                raise _DateError(f"{quoted(text, 40)} is not a date and time")
            hour = hour % 12 + 12 * (match["half"].lower() == "pm")
        try:
            iso = f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{match['minute']}:{match['seconds'] or '00'}"
            times[text] = utc_times([iso])[0]
        except ValueError as error:
            raise _DateError(f"{quoted(text, 40)} is not a date and time") from error
    unit = "second" if any(match["seconds"] for match in dates) else "minute"
    return np.array([times[text] for text in texts], "datetime64[ns]"), unit


def _order(dates: Sequence[tuple[str, ...]], texts: Sequence[str]) -> tuple[str, str, str]:
    """Determine the order of year, month and day in dates."""
    if not dates or all(len(first) == 4 for first, *_ in dates):
        return "first", "second", "third"
    month_first, day_first = ("third", "first", "second"), ("third", "second", "first")
    numbers_of = [(int(first), int(second)) for first, _, second, _ in dates]
    firsts, seconds = (set(column) for column in zip(*numbers_of, strict=True))
    if max(seconds) > 12 or (len(seconds) > 1 and len(firsts) == 1):  # only days exceed 12 or change within a flight
        return month_first
    if max(firsts) > 12 or (len(firsts) > 1 and len(seconds) == 1) or dates[0][1] == ".":
        return day_first
    if firsts == seconds and len(firsts) == 1:
        return month_first
    raise _DateError(f"{quoted(texts[0], 40)} is ambiguous: month/day or day/month")


def _utc(
    clock_s: NDArray[np.float64], second: NDArray[np.datetime64], unit: str
) -> tuple[NDArray[np.datetime64], NDArray[np.bool_], float, int]:
    """Estimate UTC of epochs from a clock and truncated UTC; ValueError if they disagree.

    Also returned are a mask of the epochs in segments long enough to determine the clock offset, the largest misfit in
    seconds, and the number of segments.
    """
    unit_s = {"second": 1.0, "minute": 60.0}[unit]
    if not np.isfinite(clock_s).all() or not (np.diff(clock_s) > 0).all():
        raise ValueError(f"column {_CLOCK} does not increase")
    if not len(clock_s):
        raise ValueError("no epochs")
    zero = second[0]
    second_s = seconds_since(second, zero)
    breaks = np.abs(np.diff(second_s) - np.diff(clock_s)) > _APART * unit_s
    part = np.concatenate([[0], np.cumsum(breaks)])
    offset, resolved, misfit = np.zeros(len(second_s)), np.zeros(len(second_s), bool), 0.0
    for number in range(part[-1] + 1):
        rows = part == number
        low, high = (second_s - clock_s)[rows].max(), (second_s - clock_s)[rows].min() + unit_s
        offset[rows] = (low + high) / 2
        resolved[rows] = high - low <= 2 * _TOLERANCE_S + _ROUNDING_S
        misfit = max(misfit, (low - high) / 2 if resolved[rows].any() else 0.0)
    if misfit > _TOLERANCE_S or not resolved.any():
        found = (
            f"a difference of {misfit:.2f} s"
            if misfit > _TOLERANCE_S
            else f"the epochs are too sparse to determine when the {unit} changes"
        )
        raise ValueError(f"columns {_CLOCK} and {_UTC}: {found}")
    elapsed = np.round((clock_s + offset) * 1e9).astype("timedelta64[ns]")
    return zero + elapsed, resolved, misfit, int(part[-1]) + 1
