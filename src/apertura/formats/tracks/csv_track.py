"""Reading of CSV tables with checks of each column, and of CSV flight logs with standard or mapped column names."""

import csv
import io
import re
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, TextIO

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError, quoted
from apertura.common.leap_seconds import GPS_EPOCH, utc_from_gps
from apertura.formats.times import LEAP_SECOND, in_leap_second
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions
from apertura.formats.tracks.track import (
    FIXES,
    GGA_KINDS,
    GGA_NOT_MEASURED,
    contradicted,
    make_track,
    start_time,
    unstated,
)

# ---- Untrusted CSV tables with named columns ------------------------------------------------------------------------

LARGEST_LOG = 500_000_000
"""Maximum size of a flight log or table, bytes: a day at 50 Hz."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.ASCII | re.IGNORECASE)
_NOT_FINITE = re.compile(r"([+-]?)(?:nan\(\w*\)|(inf)inity|1\.#(inf)\d*|1\.#\w+)", re.ASCII | re.IGNORECASE)
"""NaN and infinity as printed by C libraries: nan(ind), infinity, 1.#INF, -1.#IND, 1.#QNAN, and 1.#J (NaN or infinity,
rounded)."""


def number(text: str) -> float:
    """Parse the number in a cell, in ASCII without underscores; ValueError if it is not a number.

    Examples
    --------
    >>> number("-1.5e3"), number("nan"), number("-1.#IND"), number("1.#INF00")
    (-1500.0, nan, nan, inf)
    """
    other = _NOT_FINITE.fullmatch(text)
    if other:
        return float(f"{other[1]}{other[2] or other[3] or 'nan'}")
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"{quoted(text, 40)} is not a number")
    return float(text)


def cut_off(path: Path) -> bool:
    """Return True if a file ends within a line, so that the last number may have lost digits.

    Parameters
    ----------
    path
        Text file whose lines all end with a newline; an empty file is not truncated.
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
    """Read a CSV table with named columns.

    Parameters
    ----------
    path
        UTF-8, with or without byte-order mark; the first line contains the column names, case-insensitive. Lines that
        start with # are comments; the last comment before the first row may be the header. A repeated header, as in
        concatenated files, is skipped.
    required, optional
        Names of required and optional columns; each may occur only once.
    texts
        Names of columns that are read as text.

    Raises
    ------
    ValueError
        If the file is not a table, its cells are separated by semicolons or tabs, a column is missing or repeated, it
        contains a second, different header, or a line has more or fewer cells than the header.
    """
    if path.stat().st_size > LARGEST_LOG:
        raise ValueError(f"{path.stat().st_size} bytes, at most {LARGEST_LOG} are supported")
    known = list(dict.fromkeys([*required, *optional, *texts]))
    try:
        heading, others = _checked_cells(path, known)
    except UnicodeDecodeError as error:
        raise ValueError(_not_utf8(path)) from error
    names = _named(heading, known)
    with path.open(encoding="utf-8-sig", newline="") as stream, warnings.catch_warnings():
        warnings.simplefilter("error", pd.errors.ParserWarning)  # otherwise pandas drops cells beyond the header
        plain = len(others) == 1
        try:
            table = pd.read_csv(
                stream if plain else _without(stream, others),
                header=0 if plain else None,
                names=names,
                skipinitialspace=True,
                index_col=False,
                dtype=dict.fromkeys([name for name in texts if name in names], str),
                low_memory=False,
            )
        except pd.errors.ParserWarning as error:
            raise ValueError("a line has more cells than the header") from error
    missing = [name for name in required if name not in table.columns]
    if missing:
        raise ValueError(f"no column {missing[0]} among {quoted(list(table.columns), 300)}")
    return table


def _named(heading: Sequence[str], known: Sequence[str]) -> list[str]:
    """Return unique column names; known names are matched case-insensitively and returned in their standard form."""
    plain = [cell.strip().casefold() for cell in heading]
    names = [cell.strip() for cell in heading]
    for name in known:
        columns = [column for column, cell in enumerate(names) if cell == name]
        columns = columns or [column for column, cell in enumerate(plain) if cell == name.casefold()]
        if len(columns) > 1:
            raise ValueError(f"repeated column {name}")
        if columns:
            names[columns[0]] = name
    return [f"{name}.{column}" if name in names[:column] else name for column, name in enumerate(names)]


def _not_utf8(path: Path) -> str:
    """Describe the first byte of a file that is not UTF-8 text."""
    with path.open("rb") as stream:
        if stream.read(2) in {b"\xff\xfe", b"\xfe\xff"}:
            return 'text in UTF-16, such as "Unicode text" of Excel; save the file as UTF-8'
        stream.seek(0)
        for line, data in enumerate(stream, 1):
            try:
                data.decode("utf-8-sig")
            except UnicodeDecodeError as error:
                return f"byte {data[error.start]:#04x} in line {line} is not UTF-8; save the file as UTF-8"
    return "not UTF-8; save the file as UTF-8"


def _checked_cells(path: Path, known: Sequence[str]) -> tuple[list[str], set[int]]:
    """Return the header and the indices of rows without data: comments and repeated header rows.

    Raises
    ------
    ValueError
        If a line has more cells than the header, or fewer, so that part of a number may be lost.
    """
    with path.open(encoding="utf-8-sig", newline="") as stream:
        rows = csv.reader(stream, skipinitialspace=True)
        heading, others, commented = list[str](), set[int](), list[str]()
        names = {name.casefold() for name in known}
        try:
            for index, row in enumerate(rows):
                if row and row[0].startswith("#"):
                    others.add(index)
                    commented = [row[0].lstrip("# "), *row[1:]]
                elif row and not heading:
                    is_comment = bool(names & {cell.strip().casefold() for cell in commented})
                    heading = commented if is_comment else row
                    others |= set() if is_comment else {index}
                    for mark, name in ((";", "semicolons"), ("\t", "tabs")):
                        if len(heading) == 1 and mark in heading[0]:
                            raise ValueError(f"cells of line {rows.line_num} are separated by {name}, not commas")
                    titles = {cell.strip().casefold() for cell in heading} & names
                elif row == heading:
                    others.add(index)
                elif row and row[0].strip().casefold() in titles:
                    raise ValueError(f"line {rows.line_num} is a second, different header: concatenated files")
                elif row and len(row) - (row[-1] == "") != len(heading) != len(row):  # a comma may end the line
                    raise ValueError(f"line {rows.line_num} has {len(row)} cells, the header {len(heading)}")
        except csv.Error as error:
            raise ValueError(f"line {rows.line_num}: {error}") from error
    return heading, others


def _without(stream: TextIO, others: set[int]) -> TextIO:
    """Remove the rows with indices `others` from a table."""
    kept = io.StringIO(newline="")
    csv.writer(kept).writerows(
        row for number, row in enumerate(csv.reader(stream, skipinitialspace=True)) if number not in others
    )
    kept.seek(0)
    return kept


def numbers(columns: pd.DataFrame) -> NDArray[np.float64]:
    """Convert columns to (row, column) float64, NaN for empty cells; ValueError if a cell is not a number."""
    for name in columns.columns:
        if columns[name].dtype.kind in "fiu":
            continue
        cells = columns[name].dropna().astype(str).str.strip()
        wrong = cells[~cells.map(lambda cell: bool(_NUMBER.fullmatch(cell) or _NOT_FINITE.fullmatch(cell)))]
        if len(wrong):
            raise ValueError(f"column {name}: {quoted(wrong.iloc[0], 40)} is not a number")
        columns = columns.assign(**{str(name): cells.map(number).reindex(columns.index)})
    return columns.to_numpy(np.float64, na_value=np.nan)


# ---- CSV flight logs: time, position in one of three frames, attitude -----------------------------------------------

_TIMES = ("time_utc", "time", "time_s")
_POSITIONS: dict[Literal["geodetic", "ecef", "local"], list[str]] = {
    "geodetic": ["latitude_deg", "longitude_deg", "height_m"],
    "ecef": ["x_m", "y_m", "z_m"],
    "local": ["east_m", "north_m", "up_m"],
}
_ATTITUDE = ["roll_deg", "pitch_deg", "yaw_deg"]
_STD = ["std_north_m", "std_east_m", "std_up_m"]
_QUALITY = "quality"
_STANDARD = (*_TIMES, *(name for names in _POSITIONS.values() for name in names), *_ATTITUDE, *_STD, _QUALITY)
_ZONE = r":[^:]*(?:Z|[+-]\d\d(?::?\d\d)?)$"
_LONGEST_S = 4e9


class _Log(NamedTuple):
    """File, node and options of a log."""

    path: Path
    node: str
    options: LogOptions


def read_csv_track(path: Path, *, node: str, options: LogOptions = DEFAULT_OPTIONS) -> xr.Dataset:
    """Read a CSV flight log as `track` stage.

    The columns, under these names or under those configured in options.columns, are

    - one of time_utc (ISO 8601), time (ISO 8601 with a zone in each cell or in options.time_system) and time_s
      (seconds since options.start_utc, or with time_system gpst since 1980-01-06, GPS time);
    - the first complete set of latitude_deg, longitude_deg, height_m (WGS 84, ellipsoidal, after height_offset_m);
      x_m, y_m, z_m (ECEF); east_m, north_m, up_m (local frame of the campaign);
    - optionally roll_deg, pitch_deg, yaw_deg; std_north_m, std_east_m, std_up_m (standard deviations); quality
      (solution type: a name of `FIXES`, or a number as defined by options.quality). Cells of these columns may be
      empty.

    Numbers are multiplied by options.scales. Epochs within a leap second, and epochs whose GGA quality marks a position
    that is not measured, are excluded and counted.

    Raises
    ------
    CampaignError
        If a column is missing, a cell is not a number or a time, or time zero is not stated.
    """
    log = _Log(path, node, options)
    dropped = Counter[str]()
    try:
        table = _table(log)
        if cut_off(path):
            table, dropped["truncated line"] = table.iloc[:-1], 1
        for reason, wrong in _exclusions(table, log).items():
            dropped[reason] += int(wrong.sum())
            table = table[~wrong.reindex(table.index)]
        frame = _frame(table, log)
        position = _scaled(table, _POSITIONS[frame], log)
        attitude, std = (
            _scaled(table, names, log) if set(names) <= set(table.columns) else None for names in (_ATTITUDE, _STD)
        )
        fix = _fix(table[_QUALITY], log) if _QUALITY in table else None
        time = _time(table, log)
        kept = ~np.isnat(time) if options.time_system == "gpst" else np.ones(len(time), bool)
        dropped[LEAP_SECOND] += int((~kept).sum())
    except CampaignError:
        raise
    except (ValueError, ArithmeticError) as error:
        raise _error(str(error).partition("\n")[0], log, "Correct the log or export it again.") from error
    if frame == "geodetic":
        position = position + np.array([0.0, 0.0, options.height_offset_m or 0.0])
    attitude, std = (None if values is None else values[kept] for values in (attitude, std))
    fix = None if fix is None else fix[kept]
    return make_track(
        time[kept],
        position[kept],
        frame=frame,
        attitude_deg=attitude,
        position_std_m=std,
        fix=fix,
        dropped={reason: count for reason, count in dropped.items() if count},
        node=node,
        where=path,
    )


def _exclusions(table: pd.DataFrame, log: _Log) -> dict[str, "pd.Series[bool]"]:
    """Return reason → mask of the rows to be excluded."""
    reasons = {}
    if _QUALITY in table and log.options.quality == "gga":
        quality = _words(table[_QUALITY])
        for number, reason in GGA_NOT_MEASURED.items():
            if number:
                reasons[f"{reason} (quality {number})"] = quality == number
    for name in ("time_utc", "time"):
        if name in table:
            texts = table[name].fillna("").astype(str)
            reasons[LEAP_SECOND] = pd.Series(in_leap_second(texts.tolist()), table.index)
    return reasons


def _scaled(table: pd.DataFrame, names: list[str], log: _Log) -> NDArray[np.float64]:
    """Convert columns to (row, column) float64, multiplied by the factors of the config."""
    return numbers(table[names]) * [log.options.scales.get(name, 1.0) for name in names]


def _table(log: _Log) -> pd.DataFrame:
    """Read the table with standard column names; ValueError if names are missing or ambiguous."""
    mapped = dict(log.options.columns)
    for key, mapping in (("columns", mapped), ("scales", log.options.scales)):
        unknown = [name for name in mapping if name not in _STANDARD]
        if unknown:
            raise CampaignError(
                f"column {quoted(unknown[0])}",
                f"config.yaml: nodes.{log.node}.log.{key}",
                f"one of {', '.join(_STANDARD)}",
                "Use column names of apertura as keys, and column names of the log as values."
                if key == "columns"
                else "Use column names of apertura as keys, and factors as values.",
            )
    log_columns = [mapped.get(name, name) for name in _STANDARD]
    texts = [mapped.get(name, name) for name in ("time_utc", "time", "quality")]
    table = read_table(log.path, list(mapped.values()), optional=log_columns, texts=texts)
    doubled = [name for name in mapped if name in table.columns and name not in mapped.values()]
    if doubled:
        raise ValueError(
            f"column {doubled[0]} in addition to {quoted(mapped[doubled[0]])}, which config.yaml maps to {doubled[0]}"
        )
    standard = {name: table[column] for name, column in zip(_STANDARD, log_columns, strict=True) if column in table}
    renamed = pd.DataFrame(standard)
    renamed.attrs["heading"] = [str(column) for column in table.columns]
    return renamed


def _error(found: str, log: _Log, remedy: str) -> CampaignError:
    expected = (
        "columns time_utc (ISO 8601), or time or time_s, latitude_deg, longitude_deg, height_m, or x_m, y_m, z_m, or "
        f"east_m, north_m, up_m; optionally {', '.join(_ATTITUDE)}, {', '.join(_STD)}, quality ({', '.join(FIXES)}, "
        f"or numbers as defined by nodes.{log.node}.log.quality); other names as mapped by nodes.{log.node}.log.columns"
    )
    return CampaignError(found, log.path, expected, remedy)


def _missing_column(name: str, table: pd.DataFrame, log: _Log) -> CampaignError:
    """Return the error for a missing column, with the columns of the log and the setting that maps a column name."""
    key = f"nodes.{log.node}.log.columns"
    remedy = (
        f"If the column has another name, set {key}: {{{name}: NAME}}; to try a name, use --set columns.{name}=NAME."
    )
    return _error(f"no column {name} among {quoted(table.attrs['heading'], 300)}", log, remedy)


def _frame(table: pd.DataFrame, log: _Log) -> Literal["geodetic", "ecef", "local"]:
    """Return the first frame with all its columns; the message contains a missing column of the most complete frame."""
    missing = {frame: [name for name in names if name not in table] for frame, names in _POSITIONS.items()}
    nearest = min(missing, key=lambda frame: len(missing[frame]))
    if missing[nearest]:
        raise _missing_column(missing[nearest][0], table, log)
    return nearest


def _time(table: pd.DataFrame, log: _Log) -> NDArray[np.datetime64]:
    """Return UTC; the config does not override a time system given in the name of the column."""
    columns = [name for name in _TIMES if name in table]
    if not columns:
        raise _missing_column("time_utc", table, log)
    if len(columns) > 1 and columns[0] != "time_utc":
        raise ValueError("both columns time and time_s")
    name, system = columns[0], log.options.time_system
    if name == "time_s":
        return _counted(_scaled(table, ["time_s"], log)[:, 0], log)
    zoned = table[name].dropna().str.strip().str.contains(_ZONE)
    if name == "time" and not zoned.all():
        if system is None or zoned.any():
            found = "times in column time without a time system (UTC or GPST)"
            raise unstated("time_system", found, node=log.node, where=log.path)
        time = _iso(table[name])
        return utc_from_gps(time) if system == "gpst" else time
    if system == "gpst":
        raise contradicted("time_system", f"times in column {name} are UTC", node=log.node, where=log.path)
    return _iso(table[name])


def _iso(cells: "pd.Series[str]") -> NDArray[np.datetime64]:
    """Parse times in ISO 8601, with decimal point or comma; ValueError if a cell is not a time."""
    texts = cells.str.strip().str.replace(",", ".", regex=False)
    time = pd.to_datetime(texts, utc=True, format="ISO8601", errors="coerce")
    wrong = cells[time.isna() & cells.notna()]
    if len(wrong):
        raise ValueError(
            f"column {cells.name}: {quoted(wrong.iloc[0], 40)} is not an ISO 8601 time such as 2025-05-14T09:30:00.5Z"
        )
    return np.asarray(time.dt.tz_localize(None).dt.as_unit("ns").to_numpy())


def _counted(seconds: NDArray[np.float64], log: _Log) -> NDArray[np.datetime64]:
    """Convert seconds since the configured time zero, or since the GPS epoch, to UTC."""
    if not (np.abs(seconds) <= _LONGEST_S).all():
        wrong_s = seconds[~(np.abs(seconds) <= _LONGEST_S)][0]
        raise ValueError(f"a time of {wrong_s:g} s in column time_s, beyond ±{_LONGEST_S:g} s")
    elapsed = np.round(seconds * 1e9).astype("timedelta64[ns]")
    if log.options.time_system == "gpst" and log.options.start_utc is None:
        return utc_from_gps(GPS_EPOCH + elapsed)
    found = "seconds in column time_s without a time zero (1970-01-01 for Unix time)"
    return start_time(log.options, found, node=log.node, where=log.path) + elapsed


def _fix(quality: "pd.Series[str]", log: _Log) -> NDArray[np.int8]:
    """Convert names or numbers of solution types to RTKLIB's numbers; 0 for an empty cell."""
    words = _words(quality)
    kinds = {**FIXES, "": 0}
    if log.options.quality == "gga":
        kinds |= {number: FIXES[kind] for number, kind in GGA_KINDS.items()}
    else:
        kinds |= {str(number): number for number in (0, *FIXES.values())}
    counted = sorted({word for word in words if word.isdigit() and word != "0"})
    if counted and log.options.quality is None:
        column = log.options.columns.get(_QUALITY, _QUALITY)
        found = f"solution types {', '.join(counted)} in column {quoted(column)} without a definition"
        numbering = ": rtklib (1 fix, 2 float, 5 single) or gga (4 fix, 5 float, 1 single)"
        raise unstated("quality", found, node=log.node, where=log.path, remedy=numbering)
    unknown = words[~words.isin(kinds)]
    if len(unknown):
        raise ValueError(f"quality {quoted(unknown.iloc[0])}")
    return np.array([kinds[word] for word in words], np.int8)


def _words(quality: "pd.Series[str]") -> "pd.Series[str]":
    return quality.map(lambda cell: "" if pd.isna(cell) else str(cell).strip().lower().removesuffix(".0"))
