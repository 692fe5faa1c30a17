"""RTKLIB solutions (.pos): reading of all formats with times in GPST, UTC or JST; writing of the default format."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.documents import read_text
from apertura.common.errors import CampaignError, quoted
from apertura.common.leap_seconds import GPS_EPOCH, gps_from_utc, utc_from_gps
from apertura.core.geometry.geodesy import ecef_from_geodetic, ned_axes
from apertura.formats.times import LEAP_SECOND, coarsened, in_leap_second, utc_times
from apertura.formats.tracks.csv_track import LARGEST_LOG, number
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions
from apertura.formats.tracks.track import FIXES, contradicted, make_track, unstated

_POSITIONS = {
    "geodetic": ("latitude(deg)", "longitude(deg)", "height(m)"),
    "sexagesimal": ("latitude(d'\")", "longitude(d'\")", "height(m)"),
    "ecef": ("x-ecef(m)", "y-ecef(m)", "z-ecef(m)"),
    "baseline": ("e-baseline(m)", "n-baseline(m)", "u-baseline(m)"),
}
"""Position format → its columns; an angle in degrees, minutes and seconds occupies three cells."""

_STD = ("sdn(m)", "sde(m)", "sdu(m)")
_STD_ECEF = ("sdx(m)", "sdy(m)", "sdz(m)", "sdxy(m)", "sdyz(m)", "sdzx(m)")
_CELLS = re.compile(r"\s*[,;]\s*|\s+")
_LAST_WEEK, _WEEK_S = 11_000, 604_800
_JST_AHEAD = np.timedelta64(9, "h")
_SAME_BASE_M, _WORST_M = 0.01, 1e9
_DATUM = re.compile(
    r"(?:lat/lon/height|x/y/z-ecef|e/n/u-baseline|out-datum|datum)\s*[=:]\s*([^/,)\s]+)(?:/(\w+))?", re.I
)
"""Datum of positions and, after a slash, of heights, in a comment of the header."""

_GEOCENTRIC = re.compile(r"(?:WGS|ITRF|IGS|IGB)[-_ ]?\d*", re.I)
"""Datums that agree with WGS 84 within centimetres; in `out-datum`, 0 means WGS 84."""

_INTERVAL = re.compile(
    r"(?:obs|sol|inp) (?:start|end)\b.*?\b(GPST|UTC|JST)\b|out-timesys\s*[=:]\s*(gpst|utc|jst)\b", re.I
)
"""Time system in a comment of the header, in addition to the time system stated with the column names."""

_STATES = re.compile(rf"ref pos\s*:|{_DATUM.pattern}|{_INTERVAL.pattern}", re.I)
_EXPECTED = "an RTKLIB solution whose header contains column names and time system (GPST, UTC or JST)"
_REMEDY = "Export the solution with these output settings."


class _Header(NamedTuple):
    """Fields of a header, the comment lines before solutions."""

    system: str
    position: str
    cell_of: dict[str, int]
    cells: int
    geodetic_height: str
    base: list[str]


def read_rtklib_pos(path: Path, *, node: str, options: LogOptions = DEFAULT_OPTIONS) -> xr.Dataset:
    """Read an RTKLIB solution, or several in one file with separate headers, as `track` stage.

    A header states whether times are GPST, UTC or JST (as calendar dates or week and seconds), and whether positions
    are latitude, longitude (decimal degrees, or degrees, minutes and seconds) and height, ECEF, or a baseline to east,
    north and up from ``ref pos`` or options.base. Q and standard deviations are read if present; deviations in ECEF
    are rotated to north, east and up with their covariances. Lines with Q = 0 (no solution) and epochs within a leap
    second are excluded and counted.

    Raises
    ------
    CampaignError
        If a header lacks column names, states two time systems or a datum other than WGS 84, heights are above a geoid
        and options.height_offset_m is not configured, baselines have no base position, or a line cannot be read.

    Notes
    -----
    Source: RTKLIB manual 2.4.2, appendix B.1 "Positioning solution file".
    """
    text = read_text(path, expected=_EXPECTED, remedy=_REMEDY, largest=LARGEST_LOG // 2)
    lines = text.splitlines()
    cut = bool(lines) and text[-1] not in "\r\n" and lines[-1][:1] not in {"", "%"}
    parts = [
        _solutions(header, rows, options, node=node, where=path)
        for header, rows in _parts(lines[: len(lines) - cut], path)
    ]
    ecef = any(part.ecef for part in parts)
    dropped = Counter({"truncated line": int(cut)})
    for part in parts:
        dropped.update(part.dropped)
    return make_track(
        np.concatenate([part.time for part in parts]),
        np.concatenate(
            [ecef_from_geodetic(*part.position.T) if ecef and not part.ecef else part.position for part in parts]
        ),
        frame="ecef" if ecef else "geodetic",
        fix=_joined([part.fix for part in parts], np.zeros, parts),
        position_std_m=_joined([part.std for part in parts], lambda count: np.full((count, 3), np.nan), parts),
        dropped={reason: count for reason, count in dropped.items() if count},
        node=node,
        where=path,
    )


class _Solutions(NamedTuple):
    """Solutions with a common header."""

    time: NDArray[np.datetime64]
    position: NDArray[np.float64]
    ecef: bool
    fix: NDArray[np.int8] | None
    std: NDArray[np.float64] | None
    dropped: dict[str, int]


def _joined(values: list[Any], unknown: Callable[[int], NDArray[Any]], parts: Sequence[_Solutions]) -> Any:
    """Concatenate an optional column of all solutions, `unknown` where missing; None if no header contains it."""
    if all(value is None for value in values):
        return None
    dtype = next(value.dtype for value in values if value is not None)
    return np.concatenate(
        [
            unknown(len(part.time)).astype(dtype) if value is None else value
            for value, part in zip(values, parts, strict=True)
        ]
    )


def _parts(lines: list[str], path: Path) -> Iterator[tuple[_Header, list[tuple[int, str]]]]:
    """Yield each header of a file with its numbered solution lines; RTKLIB writes a new header after every restart.

    Comments without header fields do not start a new part.
    """
    comments, rows, header, first = list[str](), list[tuple[int, str]](), None, 1
    for line, text in [*enumerate(lines, 1), (len(lines) + 1, "")]:
        if text.startswith("%"):
            first = first if comments else line
            comments.append(text)
        elif text.strip() or line > len(lines):
            if comments and (header is None or any(_STATES.search(comment) or _kind(comment) for comment in comments)):
                if header is not None:
                    yield header, rows
                header, rows = _header(comments, path, first), []
            comments = []
            rows += [(line, text)] if text.strip() else []
    yield header or _header([], path, 1), rows


def _solutions(
    header: _Header, rows: list[tuple[int, str]], options: LogOptions, *, node: str, where: Path
) -> _Solutions:
    _check_stated(header, options, node=node, where=where)
    times, values, quality_and_std = _rows(rows, header, where)
    quality = quality_and_std[:, 0] if "Q" in header.cell_of else np.full(len(times), np.nan)
    time = _utc(_times(times, where), header.system, where)
    solved, leap = quality != 0, np.isnat(time)
    kept = solved & ~leap
    position, ecef = _position(values[kept], header, options, node=node, where=where)
    return _Solutions(
        time[kept],
        position,
        ecef,
        _fix(quality[kept], where) if "Q" in header.cell_of else None,
        _std(quality_and_std[kept, 1:], position),
        {"Q = 0": int((~solved).sum()), LEAP_SECOND: int((leap & solved).sum())},
    )


def _kind(line: str) -> str:
    """Return the key of `_POSITIONS` whose columns a comment line lists; empty if it does not list column names."""
    names = set(_CELLS.split(line.strip("% \t")))
    return next((kind for kind, columns in _POSITIONS.items() if set(columns) <= names), "")


def _header(lines: list[str], path: Path, first: int) -> _Header:
    """Parse the comment lines of a header; `first`: line number of the first comment line in the file."""
    heading = next((line for line in lines if _kind(line)), "")
    if not heading:
        position = f" after line {first - 1}" if first > 1 else ""
        columns = f"{', '.join(_POSITIONS['geodetic'])}, x-ecef(m) … or e-baseline(m) …"
        raise _error(f"no header line{position} with {columns}", path)
    kind, names = _kind(heading), _CELLS.split(heading.strip("% \t"))
    if names[0] not in {"GPST", "UTC", "JST"}:
        raise _error(f"unknown time system {quoted(names[0])}", path)
    doubled = [name for name in names if names.count(name) > 1]
    if doubled:
        raise _error(f"repeated column {quoted(doubled[0], 40)}", path)
    height_datum = _height_datum(lines, names[0], path, first)
    widths = [2, *(3 if name.endswith("(d'\")") else 1 for name in names[1:])]
    ends = list(accumulate(widths))
    base = next((line.partition(":")[2] for line in lines if re.match(r"%\s*ref pos\s*:", line)), "")
    cell_of = {name: end - width for name, end, width in zip(names, ends, widths, strict=True)}
    return _Header(names[0], kind, cell_of, ends[-1], height_datum, _CELLS.split(base.strip()) if base.strip() else [])


def _height_datum(lines: list[str], system: str, path: Path, first: int) -> str:
    """Return the height datum in the comments of a header; CampaignError for another time system or datum."""
    height_datum = ""
    for line, text in enumerate(lines, first):
        interval, datum = _INTERVAL.search(text), _DATUM.search(text)
        other = (interval[1] or interval[2]).upper() if interval else system
        if other != system:
            raise CampaignError(
                f"times are {system} according to the column header and {other} according to line {line}, "
                f"{quoted(text.strip(), 80)}",
                path,
                "a single time system",
                f"Export the solution again. If the column header is correct, remove line {line}.",
            )
        if datum and datum[1] != "0" and not _GEOCENTRIC.fullmatch(datum[1]):
            raise CampaignError(
                f"line {line}: positions in datum {quoted(datum[1], 40)}",
                path,
                "WGS84, or an ITRF realisation",
                "Export the solution with out-datum=wgs84, or transform it.",
            )
        if datum and (datum[2] or "").lower() in {"geodetic", "ellipsoidal"}:
            height_datum = datum[2].lower()
    return height_datum


def _check_stated(header: _Header, options: LogOptions, *, node: str, where: Path) -> None:
    """Raise CampaignError if log and config contradict each other, or a required height offset is not configured."""
    if options.time_system is not None and options.time_system.upper() != header.system:
        raise contradicted("time_system", f"times are {header.system}", node=node, where=where)
    if header.position not in {"geodetic", "sexagesimal"}:
        return
    if header.geodetic_height == "geodetic" and options.height_offset_m is None:
        raise unstated(
            "height_offset_m",
            "heights are orthometric (above a geoid; 'geodetic' in RTKLIB)",
            node=node,
            where=where,
            remedy=", or export ellipsoidal heights",
        )
    if header.geodetic_height == "ellipsoidal" and options.height_offset_m:
        raise contradicted("height_offset_m", "heights are ellipsoidal", node=node, where=where)


def _rows(
    lines: list[tuple[int, str]], header: _Header, path: Path
) -> tuple[list[str | np.datetime64], NDArray[np.float64], NDArray[np.float64]]:
    """Return time (dates as text), logged position, Q and standard deviations (NaN if missing) of each solution."""
    sexagesimal = header.position == "sexagesimal"
    angles = [header.cell_of[name] for name in _POSITIONS[header.position]]
    std_names = _STD_ECEF if header.position == "ecef" else _STD
    std_cells = [header.cell_of[name] for name in std_names] if set(std_names) <= set(header.cell_of) else []
    quality_and_std_cells = [header.cell_of.get("Q"), *std_cells]
    times, positions, quality_and_std = [], [], []
    for line, text in lines:
        cells = _CELLS.split(text.strip())
        if len(cells) != header.cells:
            raise _error(f"line {line} has {len(cells)} columns, the header {header.cells}", path)
        try:
            times.append(_time(cells[0], cells[1]))
            positions.append(
                [
                    _angle(cells[at : at + 3]) if sexagesimal and axis < 2 else number(cells[at])
                    for axis, at in enumerate(angles)
                ]
            )
            quality_and_std.append([np.nan if at is None else number(cells[at]) for at in quality_and_std_cells])
        except ValueError as error:
            raise _error(f"line {line} is {quoted(' '.join(cells), 60)} ({error})", path) from error
    columns = len(quality_and_std_cells)
    return times, np.array(positions).reshape(-1, 3), np.array(quality_and_std).reshape(-1, columns)


def _angle(cells: list[str]) -> float:
    """Convert degrees, minutes and seconds to degrees; the sign precedes the degrees, also for -0."""
    degrees, minutes, seconds = (number(cell) for cell in cells)
    if not (0 <= minutes < 60 and 0 <= seconds < 60 + 1e-9):
        raise ValueError(f"invalid degrees, minutes and seconds: {quoted(' '.join(cells), 40)}")
    return (-1 if cells[0].startswith("-") else 1) * (abs(degrees) + minutes / 60 + seconds / 3600)


def _time(first: str, second: str) -> str | np.datetime64:
    """Convert GPS week and seconds to a time; return a calendar date as text, because parsing in bulk is faster."""
    if "/" in first:
        return f"{first.replace('/', '-')}T{second}"
    week, seconds = number(first), number(second)
    if not (0 <= week <= _LAST_WEEK and 0 <= seconds < _WEEK_S and week.is_integer()):
        raise ValueError(f"invalid week {first} or second {second}")
    return GPS_EPOCH + np.timedelta64(7 * int(week), "D") + np.timedelta64(round(seconds * 1e9), "ns")


def _times(logged: list[str | np.datetime64], path: Path) -> NDArray[np.datetime64]:
    """Return times in the time system of the log; NaT within a leap second."""
    dates = np.array([isinstance(time, str) for time in logged], bool)
    dates[dates] = ~in_leap_second([time for time in logged if isinstance(time, str)])
    times = np.array(
        [np.datetime64("NaT", "ns") if isinstance(time, str) else time for time in logged], "datetime64[ns]"
    )
    try:
        times[dates] = utc_times([str(logged[index]) for index in np.flatnonzero(dates)])
    except ValueError as error:
        raise _error(str(error), path) from error
    return times


def _utc(time: NDArray[np.datetime64], system: str, path: Path) -> NDArray[np.datetime64]:
    if system != "GPST":
        return time - _JST_AHEAD if system == "JST" else time
    if np.isnat(time).any():
        raise _error("a second 60 in GPS time, which has no leap seconds", path)
    try:
        return utc_from_gps(time)
    except ValueError as error:
        raise _error(str(error), path) from error


def _position(
    values: NDArray[np.float64], header: _Header, options: LogOptions, *, node: str, where: Path
) -> tuple[NDArray[np.float64], bool]:
    """Return positions, and True for ECEF positions, False for latitude, longitude and ellipsoidal height."""
    if header.position == "ecef":
        return values, True
    if header.position == "baseline":
        base = _base(header, options, node=node, where=where)
        axes = ned_axes(base)
        return base + values @ np.stack([axes[:, 1], axes[:, 0], -axes[:, 2]]), True
    values[:, 2] += options.height_offset_m or 0.0
    return values, False


def _base(header: _Header, options: LogOptions, *, node: str, where: Path) -> NDArray[np.float64]:
    """Return the ECEF position of the base of the baselines."""
    cells = header.base
    try:
        whole = [number(cell) for cell in cells]
        angles = whole if len(cells) == 3 else [_angle(cells[:3]), _angle(cells[3:6]), *whole[6:]] if whole else []
    except ValueError as error:
        raise _error(f"invalid ref pos {quoted(' '.join(cells), 60)}", where) from error
    geodetic = angles or options.base
    if not geodetic:
        found = "baselines without the position of their base (ref pos)"
        raise unstated("base", found, node=node, where=where)
    if len(geodetic) != 3 or not (abs(geodetic[0]) <= 90 and abs(geodetic[1]) <= 360 and abs(geodetic[2]) < 1e5):
        raise _error(f"invalid ref pos {quoted(' '.join(cells), 60)}", where)
    base = ecef_from_geodetic(*np.array(geodetic, np.float64))
    if options.base and np.linalg.norm(base - ecef_from_geodetic(*np.array(options.base))) > _SAME_BASE_M:
        raise contradicted("base", f"ref pos {' '.join(cells)}", node=node, where=where)
    return base


def _std(logged: NDArray[np.float64], ecef: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return standard deviations to north, east and up; those in ECEF are rotated, with the logged covariances."""
    if not logged.shape[1]:
        return None
    if logged.shape[1] == len(_STD):
        return logged
    known = np.where(np.isinf(logged), np.nan, logged)
    clipped = known.clip(-_WORST_M, _WORST_M)  # avoids overflow of squares; make_track rejects values this large
    xx, yy, zz, xy, yz, zx = (np.sign(clipped) * clipped**2).T
    covariance = np.stack([xx, xy, zx, xy, yy, yz, zx, yz, zz], -1).reshape(-1, 3, 3)
    axes = ned_axes(ecef)
    return np.asarray(np.sqrt(np.einsum("nia,nij,nja->na", axes, covariance, axes).clip(0)))


def _fix(quality: NDArray[np.float64], path: Path) -> NDArray[np.int8]:
    """Return solution types, 0 where not logged."""
    kinds = np.nan_to_num(quality, nan=0.0)
    wrong = np.flatnonzero(~np.isin(kinds, range(10)))
    if wrong.size:
        raise _error(f"invalid Q {kinds[wrong[0]]:g} in solution {int(wrong[0])}", path)
    return np.asarray(kinds, np.int8)


def _error(found: str, path: Path) -> CampaignError:
    return CampaignError(found, where=path, expected=_EXPECTED, remedy=_REMEDY)


# ---- Writing of RTKLIB's default format -----------------------------------------------------------------------------

_COLUMNS = """\
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
{remarks}%  {system:<22}latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  \
sdun(m) age(s)  ratio
"""
_LEAST_STD_M = 1e-4
"""Resolution of a written standard deviation, m; smaller values would be written as 0, which means unknown."""


def write_rtklib_pos(
    path: Path,
    time_utc: NDArray[np.datetime64],
    geodetic: NDArray[np.float64],
    *,
    fix: NDArray[np.integer],
    std_m: NDArray[np.float64],
    satellites: int = 0,
    ratio: float = 0.0,
    system: Literal["GPST", "UTC"] = "GPST",
    header: Sequence[str] = (),
    remarks: Sequence[str] = (),
) -> None:
    """Write latitude, longitude and ellipsoidal height as an RTKLIB solution, .pos.

    RTKLIB identifies columns by position: all columns are written, with RTKLIB's placeholders for unknown values.

    Parameters
    ----------
    path
        ``….pos``.
    time_utc
        (epoch,) datetime64, UTC; written in `system` with milliseconds, or with more digits if needed.
    geodetic
        (epoch, 3) float64: latitude and longitude (degrees), metres above the ellipsoid; written with a resolution of
        1 µm in arc length and 10 µm in height.
    fix
        (epoch,), values of `FIXES`; 0 (unknown) is written as 5 (single), because RTKLIB's 0 means no solution.
    std_m
        (epoch, 3) float64, m: standard deviations to north, east and up; NaN (unknown) is written as 0. Covariances are
        written as 0.
    satellites, ratio
        Values for all epochs; 0: unknown.
    header, remarks
        Comment lines without %: at the start of the file, and before the column names. They must not contain column
        names or time systems.

    Notes
    -----
    Source: RTKLIB manual 2.4.2, appendix B.1 "Positioning solution file".
    """
    written_time = coarsened(gps_from_utc(time_utc) if system == "GPST" else time_utc)
    known = np.where(std_m > 0, std_m.clip(_LEAST_STD_M), 0.0)  # NaN becomes 0
    kinds = np.where(fix == 0, FIXES["single"], fix)
    rest = f"{0:9.4f}{0:9.4f}{0:9.4f}{0:7.2f}{ratio:7.1f}"
    lines = [f"% {line}".rstrip() for line in header]
    remark_lines = "".join(f"% {line}\n" for line in remarks)
    lines.append(_COLUMNS.format(remarks=remark_lines, system=system).rstrip("\n"))
    texts = (text.replace("-", "/").replace("T", " ") for text in np.datetime_as_string(written_time))
    for text, position, kind, std in zip(texts, geodetic, kinds, known, strict=True):
        latitude, longitude, height = position
        deviations = "".join(f"{value:9.4f}" for value in std)
        lines.append(
            f"{text}   {latitude:14.11f} {longitude:15.11f} {height:11.5f} {kind:3d} {satellites:3d}{deviations}{rest}"
        )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
