"""Tables of comma-separated values, checked column by column, and flight logs in them, by names of ours or mapped."""

import csv
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError, quoted
from apertura.common.leap_seconds import GPS_EPOCH, utc_from_gps
from apertura.formats.tracks.log_options import AS_IT_SAYS, LogOptions
from apertura.formats.tracks.track import FIXES, contradicted, make_track, start_time, unstated

# ---- Untrusted tables of comma-separated numbers, columns by name ---------------------------------------------------

LARGEST_LOG = 500_000_000
"""Bytes of a flight log or a table: a day at 50 Hz."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.ASCII | re.IGNORECASE)
_NOT_FINITE = re.compile(r"([+-]?)(?:nan\(\w*\)|(inf)inity|1\.#(inf)\d*|1\.#\w+)", re.ASCII | re.IGNORECASE)
"""NaN and infinity as printf of C libraries writes them: nan(ind), infinity, 1.#INF, -1.#IND, 1.#QNAN, and 1.#J, which
is either, rounded."""


def number(text: str) -> float:
    """Return the number in a cell, written in ASCII without underscores; ValueError if it is none.

    Examples
    --------
    >>> number("-1.5e3"), number("nan"), number("-1.#IND"), number("1.#INF00")
    (-1500.0, nan, nan, inf)
    """
    other = _NOT_FINITE.fullmatch(text)
    if other:
        return float(f"{other[1]}{other[2] or other[3] or 'nan'}")
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"{quoted(text, 40)} is no number")
    return float(text)


def cut_off(path: Path) -> bool:
    """Return whether a file ends within a line: of the last number digits may be lost.

    Parameters
    ----------
    path
        A text that ends each line; an empty one is not cut off.
    """
    with path.open("rb") as stream:
        if not stream.seek(0, 2):
            return False
        stream.seek(-1, 2)
        return stream.read() not in {b"\n", b"\r"}


def read_table(
    path: Path,
    required: Sequence[str],
    *,
    optional: Sequence[str] = (),
    texts: Sequence[str] = ("time_utc", "quality"),
) -> pd.DataFrame:
    """Return the table in a CSV file, whose columns stand under their names.

    Parameters
    ----------
    path
        UTF-8, with or without byte-order mark; the first line names the columns.
    required, optional
        Names of columns that must be there, or may, but once.
    texts
        Names of columns that are not read as numbers.

    Raises
    ------
    ValueError
        If it is no table, its cells stand between semicolons, it lacks a column or has one twice, or a line has more or
        fewer cells than the heading.
    """
    if path.stat().st_size > LARGEST_LOG:
        raise ValueError(f"{path.stat().st_size} bytes, at most {LARGEST_LOG} are read")
    _check_cells(path)
    with path.open("rb") as stream, warnings.catch_warnings():
        warnings.simplefilter("error", pd.errors.ParserWarning)  # cells beyond the heading would be dropped
        try:
            table = pd.read_csv(
                stream,
                encoding="utf-8-sig",
                skipinitialspace=True,
                index_col=False,
                dtype=dict.fromkeys(texts, str),
                low_memory=False,
            )
        except pd.errors.ParserWarning as error:
            raise ValueError("a line has more cells than the heading") from error
    missing = [name for name in required if name not in table.columns]
    if missing:
        raise ValueError(f"no column {missing[0]} among {quoted(list(table.columns), 300)}")
    doubled = [name for name in (*required, *optional) if f"{name}.1" in table.columns]
    if doubled:
        raise ValueError(f"column {doubled[0]} a second time")
    return table


def _check_cells(path: Path) -> None:
    """Raise ValueError where a line has fewer cells than the heading, a piece is gone, maybe of a number; or more."""
    with path.open(encoding="utf-8-sig", newline="") as stream:
        rows = csv.reader(stream, skipinitialspace=True)
        try:
            heading = next((row for row in rows if row), [])
            if len(heading) == 1 and ";" in heading[0]:
                raise ValueError(f"line {rows.line_num} has its cells between semicolons, not commas")
            # one cell that is empty is a comma that ends the line
            odd = next((row for row in rows if row and len(row) - (row[-1] == "") != len(heading) != len(row)), None)
        except csv.Error as error:
            raise ValueError(f"line {rows.line_num}: {error}") from error
    if odd is not None:
        raise ValueError(f"line {rows.line_num} has {len(odd)} cells, the heading {len(heading)}")


def numbers(columns: pd.DataFrame) -> NDArray[np.float64]:
    """Return columns as (row, column) float64, NaN where a cell is empty; ValueError names a cell that is no number."""
    for name in columns.columns:
        if columns[name].dtype.kind in "fiu":
            continue
        cells = columns[name].dropna().astype(str).str.strip()
        wrong = cells[~cells.map(lambda cell: bool(_NUMBER.fullmatch(cell) or _NOT_FINITE.fullmatch(cell)))]
        if len(wrong):
            raise ValueError(f"could not convert string to a number in column {name}: {quoted(wrong.iloc[0], 40)}")
        columns = columns.assign(**{str(name): cells.map(number).reindex(columns.index)})
    return columns.to_numpy(np.float64, na_value=np.nan)


# ---- Flight logs as CSV: time, position in one of three frames, attitude --------------------------------------------

_TIMES = ("time_utc", "time", "time_s")
_POSITIONS: dict[Literal["geodetic", "ecef", "local"], list[str]] = {
    "geodetic": ["latitude_deg", "longitude_deg", "height_m"],
    "ecef": ["x_m", "y_m", "z_m"],
    "local": ["east_m", "north_m", "up_m"],
}
_ATTITUDE = ["roll_deg", "pitch_deg", "yaw_deg"]
_STD = ["std_north_m", "std_east_m", "std_up_m"]
_OURS = (*_TIMES, *(name for names in _POSITIONS.values() for name in names), *_ATTITUDE, *_STD, "quality")
_ZONE = r"(?:Z|[+-]\d\d:?\d\d)$"
_LONGEST_S = 4e9


class _Log(NamedTuple):
    """Whose log is read, and how."""

    path: Path
    node: str
    options: LogOptions


def read_csv_track(path: Path, *, node: str, options: LogOptions = AS_IT_SAYS) -> xr.Dataset:
    """Return the `track` stage of a CSV log.

    Its columns, or those that options.columns maps onto them, are

    - one of time_utc (ISO 8601), time (the same, whose zone each cell or options.time_system states) and time_s
      (seconds since options.start_utc, or with time_system gpst since 1980-01-06, GPS time);
    - the first that is whole of latitude_deg, longitude_deg, height_m (WGS 84, ellipsoidal, after height_offset_m);
      x_m, y_m, z_m (ECEF); east_m, north_m, up_m (axes of the campaign's own);
    - where known roll_deg, pitch_deg, yaw_deg; std_north_m, std_east_m, std_up_m (standard deviations); quality (kind
      of solution: a name or number of `FIXES`). Empty cells of these are epochs without such a value.

    Raises
    ------
    CampaignError
        If a column is missing or a cell is not a number or a time, or the epoch of times is not stated.
    """
    log = _Log(path, node, options)
    try:
        table = _table(log)
        frame = _frame(table, log)
        position = numbers(table[_POSITIONS[frame]])
        attitude, std = (
            numbers(table[names]) if set(names) <= set(table.columns) else None for names in (_ATTITUDE, _STD)
        )
        fix = _fix(table["quality"]) if "quality" in table else None
        time = _time(table, log)
    except CampaignError:
        raise
    except (ValueError, ArithmeticError) as error:
        raise _error(str(error).partition("\n")[0], log, "Correct the log or export it again.") from error
    if frame == "geodetic":
        position = position + np.array([0.0, 0.0, options.height_offset_m or 0.0])
    last = slice(None, -1) if cut_off(path) else slice(None)
    return make_track(
        time[last],
        position[last],
        frame=frame,
        attitude_deg=None if attitude is None else attitude[last],
        position_std_m=None if std is None else std[last],
        fix=None if fix is None else fix[last],
        dropped={"line cut off": 1} if last.stop else None,
        node=node,
        where=path,
    )


def _table(log: _Log) -> pd.DataFrame:
    """Return the table under names of ours; ValueError where names are missing or ambiguous."""
    mapped = dict(log.options.columns)
    unknown = [name for name in mapped if name not in _OURS]
    if unknown:
        raise CampaignError(
            f"column {quoted(unknown[0])}",
            f"config.yaml: nodes.{log.node}.log.columns",
            f"one of {', '.join(_OURS)}",
            "Columns of ours stand left, those of the log right.",
        )
    theirs = [mapped.get(name, name) for name in _OURS]
    texts = [mapped.get(name, name) for name in ("time_utc", "time", "quality")]
    table = read_table(log.path, list(mapped.values()), optional=theirs, texts=texts)
    doubled = [name for name in mapped if name in table.columns and name not in mapped.values()]
    if doubled:
        raise ValueError(f"column {doubled[0]}, besides {quoted(mapped[doubled[0]])} that config.yaml maps to it")
    ours = {name: table[column] for name, column in zip(_OURS, theirs, strict=True) if column in table}
    found = pd.DataFrame(ours)
    found.attrs["heading"] = [str(column) for column in table.columns]
    return found


def _error(found: str, log: _Log, remedy: str) -> CampaignError:
    expected = (
        "columns time_utc (ISO 8601), or time or time_s, latitude_deg, longitude_deg, height_m, or x_m, y_m, z_m, or "
        f"east_m, north_m, up_m; optionally {', '.join(_ATTITUDE)}, {', '.join(_STD)}, quality ({', '.join(FIXES)}, "
        f"or their numbers 1 to 6); or their names in nodes.{log.node}.log.columns"
    )
    return CampaignError(found, log.path, expected, remedy)


def _lacking(name: str, table: pd.DataFrame, log: _Log) -> CampaignError:
    """Return the error of a log without a column: what columns it has, and how one of them is named in its stead."""
    key = f"nodes.{log.node}.log.columns"
    remedy = f"If it has another name, say which: {key}: {{{name}: NAME}}, or to try it --set columns.{name}=NAME."
    return _error(f"no column {name} among {quoted(table.attrs['heading'], 300)}", log, remedy)


def _frame(table: pd.DataFrame, log: _Log) -> Literal["geodetic", "ecef", "local"]:
    """Return the first frame whose columns are whole; CampaignError names what the nearest lacks."""
    lacks = {frame: [name for name in names if name not in table] for frame, names in _POSITIONS.items()}
    nearest = min(lacks, key=lambda frame: len(lacks[frame]))
    if lacks[nearest]:
        raise _lacking(lacks[nearest][0], table, log)
    return nearest


def _time(table: pd.DataFrame, log: _Log) -> NDArray[np.datetime64]:
    """Return UTC; a zone stated by the column's name is not overruled by the config."""
    stated = [name for name in _TIMES if name in table]
    if not stated:
        raise _lacking("time_utc", table, log)
    if len(stated) > 1 and stated[0] != "time_utc":
        raise ValueError("columns time and time_s")
    name, system = stated[0], log.options.time_system
    if name == "time_s":
        return _counted(numbers(table[["time_s"]])[:, 0], log)
    zoned = table[name].dropna().str.strip().str.contains(_ZONE)
    if name == "time" and not zoned.all():
        if system is None or zoned.any():
            found = "times in column time that do not say whether they are UTC or GPST"
            raise unstated("time_system", found, node=log.node, where=log.path)
        time = _iso(table[name])
        return utc_from_gps(time) if system == "gpst" else time
    if system == "gpst":
        raise contradicted("time_system", f"times in column {name} are UTC", node=log.node, where=log.path)
    return _iso(table[name])


def _iso(cells: "pd.Series[str]") -> NDArray[np.datetime64]:
    time = pd.to_datetime(cells, utc=True, format="ISO8601").dt.tz_localize(None).dt.as_unit("ns")
    return np.asarray(time.to_numpy())


def _counted(seconds: NDArray[np.float64], log: _Log) -> NDArray[np.datetime64]:
    """Return UTC of seconds since the config's time zero, or of GPS time."""
    if not (np.abs(seconds) <= _LONGEST_S).all():
        raise ValueError(f"a time of {seconds[~(np.abs(seconds) <= _LONGEST_S)][0]:g} s in column time_s")
    elapsed = np.round(seconds * 1e9).astype("timedelta64[ns]")
    if log.options.time_system == "gpst" and log.options.start_utc is None:
        return utc_from_gps(GPS_EPOCH + elapsed)
    found = "seconds in column time_s, and nobody says since when (1970-01-01 in Unix time)"
    return start_time(log.options, found, node=log.node, where=log.path) + elapsed


def _fix(quality: "pd.Series[str]") -> NDArray[np.int8]:
    """Return RTKLIB's numbers of kinds of solution that are named or numbered; 0 where a cell is empty."""
    numbers = {**FIXES, "": 0, **{str(number): number for number in (0, *FIXES.values())}}
    words = quality.map(lambda cell: "" if pd.isna(cell) else str(cell).strip().lower().removesuffix(".0"))
    unknown = words[~words.isin(numbers)]
    if len(unknown):
        raise ValueError(f"quality {quoted(unknown.iloc[0])}")
    return np.array([numbers[word] for word in words], np.int8)
