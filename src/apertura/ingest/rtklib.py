"""RTKLIB solutions (.pos): latitude, longitude, height against GPS time or UTC."""

from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.constants import GPS_UTC_LEAP_S
from apertura.documents import read_text
from apertura.errors import CampaignError, quoted
from apertura.ingest.log_options import AS_IT_SAYS, LogOptions
from apertura.ingest.tables import LARGEST_LOG, number
from apertura.ingest.times import utc_times
from apertura.ingest.track import make_track

_GPS_EPOCH = np.datetime64("1980-01-06T00:00:00", "ns")
_QUALITY = ("Q", "sdn(m)", "sde(m)", "sdu(m)")
_LAST_WEEK, _WEEK_S = 11_000, 604_800
_EXPECTED = "an RTKLIB solution in lat/lon/ellipsoidal height whose header says GPST or UTC"
_REMEDY = "Export the solution with these output settings."
_LEAP_SINCE = np.datetime64("2017-01-01", "ns")


def read_rtklib_pos(path: Path, *, node: str, options: LogOptions = AS_IT_SAYS) -> xr.Dataset:
    """Return the `track` stage of an RTKLIB solution.

    It holds latitude, longitude (decimal degrees) and ellipsoidal height; its header says whether times are GPST
    (ahead of UTC by 18 s since 2017) or UTC, as calendar dates or week and seconds. Where it names columns Q and
    sdn(m), sde(m), sdu(m), these are the kind of solution and its standard deviations to north, east and up.

    Raises
    ------
    CampaignError
        If the header does not say what the columns are, or a line cannot be read.

    Notes
    -----
    Source: RTKLIB manual 2.4.2, appendix B.1 "Positioning solution file".
    """
    lines = read_text(path, expected=_EXPECTED, remedy=_REMEDY, largest=LARGEST_LOG // 2).splitlines()
    columns = _columns([line for line in lines if line.startswith("%")], path)
    gpst = columns[0] == "GPST"
    quality = [columns.index(name) + 1 for name in _QUALITY if name in columns]  # a time is two cells
    quality = quality if len(quality) == len(_QUALITY) else quality[:1]
    rows = ((line, text.split()) for line, text in enumerate(lines, 1) if text.strip() and text[0] != "%")
    times, geodetic, stated = [], [], []
    for line, cells in rows:
        try:
            times.append(_time(cells[0], cells[1]))
            geodetic.append([number(cell) for cell in cells[2:5]])
            stated.append([number(cells[column]) if column < len(cells) else np.nan for column in quality])
        except (ValueError, IndexError) as error:
            raise _error(f"line {line} is {quoted(' '.join(cells), 60)}", path) from error
        if len(geodetic[-1]) != 3:
            raise _error(f"line {line} has {len(cells)} columns", path)
    time = _times(times, path)
    return make_track(
        _utc(time, path) if gpst else time,
        np.array(geodetic).reshape(-1, 3),
        fix=_fix(np.array(stated)[:, 0], path) if quality and times else None,
        position_std_m=np.array(stated)[:, 1:] if len(quality) > 1 and times else None,
        node=node,
        where=path,
    )


def _columns(header: list[str], path: Path) -> list[str]:
    """Return the names of the columns; the first is the time system."""
    columns = next((line for line in header if "latitude(deg)" in line), None)
    if columns is None:
        raise _error("no header line with latitude(deg), longitude(deg), height(m)", path)
    if any("/geodetic" in line for line in header):
        raise _error("heights are geodetic (above a geoid)", path)
    names = columns.lstrip("% ").split()
    if names[0] not in {"GPST", "UTC"}:
        raise _error(f"time system {quoted(names[0])}", path)
    return names


def _time(first: str, second: str) -> str | np.datetime64:
    """Return a calendar date as text, which costs less to read all at once, or what week and seconds say."""
    if "/" in first:
        return f"{first.replace('/', '-')}T{second}"
    week, seconds = number(first), number(second)
    if not (0 <= week <= _LAST_WEEK and 0 <= seconds < _WEEK_S and week.is_integer()):
        raise ValueError(f"week {first} and second {second}")
    return _GPS_EPOCH + np.timedelta64(7 * int(week), "D") + np.timedelta64(round(seconds * 1e9), "ns")


def _times(stated: list[str | np.datetime64], path: Path) -> NDArray[np.datetime64]:
    dates = [place for place, time in enumerate(stated) if isinstance(time, str)]
    times = np.array(
        [np.datetime64("NaT", "ns") if isinstance(time, str) else time for time in stated], "datetime64[ns]"
    )
    try:
        times[dates] = utc_times([time for time in stated if isinstance(time, str)])
    except ValueError as error:
        raise _error(str(error), path) from error
    return times


def _fix(quality: NDArray[np.float64], path: Path) -> NDArray[np.int8]:
    """Return kinds of solution, 0 where the log says none."""
    stated = np.nan_to_num(quality, nan=0.0)
    wrong = np.flatnonzero(~np.isin(stated, range(10)))
    if wrong.size:
        raise _error(f"Q {stated[wrong[0]]:g} in solution {int(wrong[0])}", path)
    return np.asarray(stated, np.int8)


def _utc(time: NDArray[np.datetime64], path: Path) -> NDArray[np.datetime64]:
    if time.size and time.min() < _LEAP_SINCE:
        raise _error(f"GPS times from {time.min()}, before the leap second of 2017", path)
    return np.asarray(time - np.timedelta64(GPS_UTC_LEAP_S, "s"))


def _error(found: str, path: Path) -> CampaignError:
    return CampaignError(
        found,
        where=path,
        expected=_EXPECTED,
        remedy=_REMEDY,
    )
