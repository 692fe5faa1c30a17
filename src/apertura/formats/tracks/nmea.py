"""NMEA 0183 logs: positions from GGA, dates from RMC or ZDA, standard deviations from GST; checksums are verified."""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from pynmea2 import NMEASentence, ParseError

from apertura.common.errors import CampaignError, quoted
from apertura.formats.times import LEAP_SECOND, utc_times
from apertura.formats.tracks.csv_track import LARGEST_LOG, number
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions
from apertura.formats.tracks.track import (
    FIXES,
    GGA_KINDS,
    GGA_NOT_MEASURED,
    contradicted,
    make_track,
    remarked,
    start_time,
    unstated,
)

_BODY = re.compile(rb"([A-Z]{2}[A-Z0-9]{3},[^*]{1,250})(\*[0-9A-Fa-f]{0,2})?")
_SEALED = re.compile(rb"\$..(?:GGA|RMC|ZDA|GST),[^*$\r\n]{1,250}\*[0-9A-Fa-f]{2}")
_PLACES = ("GNS", "GLL")
"""Sentences with a position that are not read: GLL has no height, GNS no overall solution type."""

_COMMAS = {"GGA": 14, "RMC": 9, "ZDA": 4, "GST": 8}
"""Minimum number of commas in a complete sentence, up to the last field that is read."""
_STAMP = re.compile(rb"[\s\[(\"']*\d[-\d\s:.,;/TZ+\])\"']*")
_DATED = {"RMC", "ZDA"}
_WANTED = re.compile(r"[^P].(?:GGA|RMC|ZDA|GST),")
_TIME = re.compile(r"([01]\d|2[0-3])([0-5]\d)([0-5]\d|60)(?:\.(\d{1,9})\d*)?", re.ASCII)
_LATE_NS = 60_000_000_000
_DAY_NS, _SECOND_NS = 86_400_000_000_000, 1_000_000_000
_REMEDY = "Log the unmodified GGA and RMC or ZDA sentences of the receiver."


class _Fix(NamedTuple):
    """GGA sentence with a position."""

    talker: str
    geodetic: tuple[float, float, float]
    separation: float
    kind: int


@dataclass
class _Log:
    """Values collected from the sentences of a log; `sealed`: the log contains checksums."""

    path: Path
    node: str
    options: LogOptions
    data: bytes
    sealed: bool
    now_ns: int | None = None
    fixes: dict[int, _Fix] = field(default_factory=dict)
    order: list[int] = field(default_factory=list)
    std: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    dropped: Counter[str] = field(default_factory=Counter)
    stamped: int = 0
    unsealed: int = 0
    late_dates: int = 0
    others: Counter[str] = field(default_factory=Counter)


def read_nmea(path: Path, *, node: str, options: LogOptions = DEFAULT_OPTIONS) -> xr.Dataset:
    """Read an NMEA 0183 log of any talkers as `track` stage.

    Positions, solution types and geoid separation are read from GGA: ellipsoidal height is altitude plus separation.
    The date of a GGA is the date of the preceding valid RMC or ZDA, otherwise the date in options.start_utc; the date
    advances at midnight. Logged and configured dates must agree. Standard deviations are read from GST. If several
    talkers report an epoch, the GN sentence is used. A log without any checksum is read with a remark; in other logs,
    truncated sentences and sentences with a wrong or missing checksum are excluded and counted by reason.

    Raises
    ------
    CampaignError
        If a date or the geoid separation is neither logged nor configured, the configured date differs from the logged
        date, or times do not increase.

    Notes
    -----
    Source: NMEA 0183 4.10, GGA, GST, RMC, ZDA; quality 9 as in NovAtel's GPGGA. Text of a host before ``$`` is ignored.
    """
    if options.time_system == "gpst":
        raise contradicted("time_system", "times of NMEA are UTC", node=node, where=path)
    if path.stat().st_size > LARGEST_LOG // 2:
        raise CampaignError(f"{path.stat().st_size} bytes", path, f"at most {LARGEST_LOG // 2}", "Shorten the log.")
    data = path.read_bytes()
    sealed = _SEALED.search(data) is not None
    log = _Log(path, node, options, data, sealed)
    # first pass up to the first date, which also applies to the preceding epochs
    scanned = _sentences(_Log(path, node, options, data, sealed))
    dates = (_dated(sentence) for sentence in scanned if sentence.sentence_type in _DATED)
    log.now_ns = next((date for date in dates if date is not None), None)
    first_ns = log.now_ns
    for sentence in _sentences(log):
        _take(sentence, log)
    if first_ns is not None and options.start_utc is not None:
        _check_day(first_ns, log)
    return _track(log)


def _check_day(first_ns: int, log: _Log) -> None:
    """Raise CampaignError if the configured date is neither the first logged date nor that of the first epoch."""
    day = start_time(log.options, "", node=log.node, where=log.path).astype("datetime64[D]")
    days = [np.datetime64(time_ns, "ns").astype("datetime64[D]") for time_ns in (first_ns, *log.order[:1])]
    if day not in days:
        found = f"the date of the first epoch by RMC or ZDA is {days[-1]}"
        raise contradicted("start_utc", found, node=log.node, where=log.path)


def _sentences(log: _Log) -> Iterator[Any]:
    """Yield the complete sentences of the types to be read; count damaged sentences."""
    lines = log.data.splitlines()
    ended = not log.data or log.data[-1:] in b"\r\n"
    for row, line in enumerate(lines, 1):
        stamp, *pieces = line.split(b"$")
        for index, piece in enumerate(pieces):
            match = _BODY.match(piece)
            if match:
                log.stamped += index == 0 and bool(_STAMP.fullmatch(stamp))
                last = index + 1 == len(pieces) and (row < len(lines) or ended)
                yield from _complete(match[1].decode("latin-1"), match[2], log, ended=last)


def _complete(text: str, checksum: bytes | None, log: _Log, *, ended: bool) -> Iterator[Any]:
    """Yield a sentence if it is complete and of a type to be read; `ended`: a line end follows the sentence."""
    unsealed = checksum is None and ended and text.count(",") >= _COMMAS.get(text[2:5], 1)
    if unsealed and not log.sealed:
        checksum, text = b"", text.rstrip()
    elif unsealed:
        log.dropped["sentences without a checksum in a log with checksums"] += 1
        return
    elif checksum is None or len(checksum) < 3:
        log.dropped["truncated sentences"] += 1
        return
    elif int(checksum[1:], 16) != NMEASentence.checksum(text):
        log.dropped["sentences with a wrong checksum"] += 1
        return
    if not _WANTED.match(text):
        log.others[text[2:5]] += 1
    else:
        log.unsealed += not checksum
        try:
            yield NMEASentence.parse(f"${text}{checksum.decode()}", check=bool(checksum))
        except ParseError as error:
            raise _error(f"invalid sentence {quoted(text, 100)}", log.path) from error


def _time_of_day(text: str) -> int | None:
    """Parse a time of day to nanoseconds since midnight, None if it is empty; ValueError if it is invalid."""
    if not text:
        return None
    match = _TIME.fullmatch(text)
    if not match:
        raise ValueError(f"invalid time {quoted(text, 40)}")
    hour, minute, second = (int(match[part]) for part in (1, 2, 3))
    return (hour * 3600 + minute * 60 + second) * _SECOND_NS + int((match[4] or "").ljust(9, "0"))


def _dated(sentence: Any) -> int | None:
    """Return date and time of a sentence as nanoseconds since 1970; None if either is missing or invalid."""
    data = [*sentence.data, *[""] * 9]
    if sentence.sentence_type == "RMC":
        day, month, year = (data[8][start : start + 2] for start in (0, 2, 4))
        year = f"20{year}"
    else:
        day, month, year = data[1:4]
    try:
        of_day = _time_of_day(data[0])
        if of_day is None or (sentence.sentence_type == "RMC" and data[1] != "A"):
            return None
        return int(utc_times([f"{year}-{month.zfill(2)}-{day.zfill(2)}"])[0].astype(np.int64)) + of_day
    except ValueError:
        return None


def _take(sentence: Any, log: _Log) -> None:
    """Add the values of a sentence to the log."""
    kind = sentence.sentence_type
    if kind in _DATED:
        date = _dated(sentence)
        if date is not None and log.order and log.now_ns and abs(date + _DAY_NS - log.now_ns) < _LATE_NS:
            log.late_dates += 1  # some receivers log the previous date for a moment after midnight
            date += _DAY_NS
        log.now_ns = date or log.now_ns
        return
    try:
        of_day = _time_of_day(sentence.data[0])
        fix = _fix(sentence, log) if kind == "GGA" else None
        if of_day is None or (kind == "GGA" and fix is None):
            return
        if of_day >= _DAY_NS or sentence.data[0][4:6] == "60":
            log.dropped[LEAP_SECOND] += kind == "GGA"
            return
        log.now_ns = now = _nearest(of_day, log)
        if fix is not None:
            _keep(now, fix, log)
        elif all(sentence.data[5:8]):
            north, east, up = (number(cell) for cell in sentence.data[5:8])
            log.std[now] = north, east, up
    except (ValueError, IndexError) as error:
        if isinstance(error, CampaignError):
            raise
        raise _error(f"invalid sentence {quoted(str(sentence), 100)} ({error})", log.path) from error


def _nearest(of_day: int, log: _Log) -> int:
    """Return a time of day with the date that is nearest to the previous epoch; the config states the first date."""
    if log.now_ns is None:
        found = "times of day only, no RMC or ZDA with a date"
        start = start_time(log.options, found, node=log.node, where=log.path)
        return int(start.astype("datetime64[D]").astype("datetime64[ns]").astype(np.int64)) + of_day
    return round((log.now_ns - of_day) / _DAY_NS) * _DAY_NS + of_day


def _fix(sentence: Any, log: _Log) -> _Fix | None:
    """Parse the position of a GGA; if the position is not measured, count the sentence and return None."""
    data = sentence.data
    quality = data[5]
    reason = GGA_NOT_MEASURED.get(quality)
    if reason is None and not all((data[1], data[2], data[3], data[4], data[8])):
        reason = "without a position"
    if reason is not None:
        log.dropped[reason] += 1
        return None
    if quality not in GGA_KINDS or data[9] != "M" or data[2] not in "NS" or data[4] not in "EW":
        raise ValueError("invalid quality, unit or hemisphere")
    separation = number(data[10]) if data[10] and data[11] == "M" else np.nan
    geodetic = sentence.latitude, sentence.longitude, number(data[8])
    return _Fix(sentence.talker, geodetic, separation, FIXES[GGA_KINDS[quality]])


def _keep(now: int, fix: _Fix, log: _Log) -> None:
    """Add an epoch; prefer GN among several talkers with the same time, and drop repeated sentences."""
    other = log.fixes.get(now)
    if other is None:
        log.fixes[now] = fix
        log.order.append(now)
    elif other.talker != fix.talker:
        log.dropped["from another talker"] += 1
        log.fixes[now] = fix if fix.talker == "GN" else other
    elif other == fix:
        log.dropped["duplicate"] += 1
    else:
        raise CampaignError(
            f"two positions of talker {fix.talker} at {np.datetime64(now, 'ns')}",
            log.path,
            "sentences of a single receiver",
            "Separate the receivers.",
        )


def _track(log: _Log) -> xr.Dataset:
    fixes = [log.fixes[now] for now in log.order]
    elsewhere = [f"{log.others[kind]} {kind}" for kind in _PLACES if log.others[kind]]
    if not fixes and not log.dropped and elsewhere:
        raise _error(f"no GGA, but {' and '.join(elsewhere)}", log.path)
    geodetic = np.array([fix.geodetic for fix in fixes]).reshape(-1, 3)
    separation = np.array([fix.separation for fix in fixes])
    has_separation = np.isfinite(separation)
    if not separation[has_separation].any():  # a receiver without a geoid model logs 0 throughout
        if fixes and log.options.height_offset_m is None:
            found = "altitudes above mean sea level, without geoid separation"
            raise unstated("height_offset_m", found, node=log.node, where=log.path)
        has_separation = np.ones(len(fixes), bool)
        separation = np.full(len(fixes), log.options.height_offset_m or 0.0)
    elif log.options.height_offset_m is not None:
        raise contradicted("height_offset_m", "GGA contains the geoid separation", node=log.node, where=log.path)
    if not has_separation.all():
        log.dropped["without geoid separation"] += int((~has_separation).sum())
    geodetic[:, 2] += separation
    std = np.array([log.std.get(now, (np.nan,) * 3) for now in log.order]).reshape(-1, 3)
    track = make_track(
        np.array(log.order, "datetime64[ns]")[has_separation],
        geodetic[has_separation],
        position_std_m=std[has_separation] if log.std else None,
        fix=np.array([fix.kind for fix in fixes], np.int8)[has_separation],
        dropped=dict(log.dropped),
        node=log.node,
        where=log.path,
    )
    if log.stamped:
        track = remarked(track, f"{log.stamped} lines start with a time stamp of the host, which is ignored", log.path)
    if log.late_dates:
        remark = f"{log.late_dates} dates after midnight are those of the previous day; corrected by one day"
        track = remarked(track, remark, log.path)
    if log.unsealed:
        remark = f"none of {log.unsealed} sentences has a checksum: corrupted digits cannot be detected"
        track = remarked(track, remark, log.path)
    return track


def _error(found: str, path: Path) -> CampaignError:
    return CampaignError(found, path, "an NMEA 0183 log with GGA", _REMEDY)
