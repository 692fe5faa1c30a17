"""`apertura init CAMPAIGN FILES`: a campaign folder from recordings and flight logs.

Formats are recognised as by `apertura inspect`, recordings and logs are assigned by times and names, and the waveform
follows from headers, from the transmitted signal and from the samples (docs/theory/recordings.md, eqs. 3 to 7). Values
that no file contains are asked, or written to the config as commented keys.
"""

import fcntl
import os
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from apertura.campaign.config import CLOCK_COLUMNS, Node, Settings, validated
from apertura.campaign.config.nodes import Log
from apertura.campaign.config.template import WAVEFORMS, commented_yaml
from apertura.check import print_findings
from apertura.check.facts import LogFacts, log_facts
from apertura.check.times import LOST_CAPTURE, Span, own_clock, recorded_span, time_facts
from apertura.common.arrays import Times
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError, number_of, quoted, shown
from apertura.common.provenance import hashes_of_file
from apertura.core.echo.structure import CaptureStructure, capture_structure
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import LOCAL, map_from_frame
from apertura.core.scene.auto_grid import GRAZING_LIMIT_DEG, auto_bounds, utm_crs
from apertura.formats.campaign_files import new_folder, write_flights, write_meta
from apertura.formats.names import PHASE_HISTORIES, TRACKS
from apertura.formats.npy import read_npy
from apertura.formats.phase_histories.fmcw import read_fields, sweep_of, times_of
from apertura.formats.phase_histories.fmcw_fields import read_beat_fields, read_wav
from apertura.formats.reading import open_recording, read_phase_history, read_track
from apertura.formats.recordings.recording import Recording
from apertura.formats.time_tags import read_time_tags
from apertura.views.inspect.files import first_samples
from apertura.views.inspect.path import look
from apertura.views.inspect.report import Report

MOST_FILES = 10_000
"""Largest number of files in the given folders."""

SIDES = ("left", "right", "both")
"""Sides of the track on which the scene may lie."""

_FIRST_CAPTURES = 64
_SAMPLE_TYPES = {".cf32": "float32", ".fc32": "float32", ".cfile": "float32", ".cs8": "int8", ".sc8": "int8"}
"""Suffix of samples without header → type of I and Q; other suffixes: int16."""

_SIGMF = (".sigmf-meta", ".sigmf-data")
_COMMON_WORDS = frozenset(
    "iq raw rec recording data samples radar rx tx adc beat sweeps log track gps gnss rtk pos nav ins nmea flight f "
    "times time tags tag f01 solution".split()
)
"""Words of file names that do not distinguish nodes."""

_COVERED = 0.5
"""Fraction of a recording that its log covers at least."""

_QUARTER_HOUR_S, _LARGEST_ZONE_S = 900, 14 * 3600


class Question(NamedTuple):
    """Question for a value that no file contains.

    Attributes
    ----------
    keys
        Keys of the config that the words of the answer set, or other names: side, transmitter, log.
    text
        Meaning and unit of each word.
    example
        Valid answer.
    """

    keys: tuple[str, ...]
    text: str
    example: str


Ask = Callable[[Question, str], str]
"""Function of a question and the problem of the previous answer (empty at first) → answer; empty: leave open."""


# ---- Recognised files -----------------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Recording:
    """Recording of a node in a flight; `kind` is sigmf, samples (without header), beat or history."""

    kind: str
    format: str
    files: tuple[Path, ...]
    times: Times | None = None
    span: Span | None = None
    frames: NDArray[np.int64] | None = None
    opened: Recording | None = None
    echo: Any = None
    channels: int = 1
    flight: str = ""
    node: str = ""
    log: "_Log | None" = None
    offset_s: float | None = None

    @property
    def path(self) -> Path:
        return self.files[0]

    @property
    def is_free_running(self) -> bool:
        """True if the times are not UTC."""
        return self.times is None or own_clock(self.times)


@dataclass(eq=False)
class _Log:
    path: Path
    format: str
    problem: CampaignError | None = None
    track: Any = None
    facts: LogFacts | None = None
    options: dict[str, Any] = field(default_factory=dict)

    def covers(self, span: Span | None, shift_s: float = 0.0) -> bool:
        """Return True if the log covers most of a time span that is shifted."""
        if self.facts is None or span is None:
            return False
        shift = np.timedelta64(round(shift_s * 1e9), "ns")
        first, last = (time.astype("datetime64[ns]") + shift for time in span)
        start, end = self.facts.times.span
        common = (min(last, end) - max(first, start)) / np.timedelta64(1, "s")
        return bool(common >= 0 and common >= _COVERED * ((last - first) / np.timedelta64(1, "s")))


@dataclass
class _Files:
    """Recognised files."""

    recordings: list[_Recording] = field(default_factory=list)
    logs: list[_Log] = field(default_factory=list)
    tags: list[Path] = field(default_factory=list)
    arrays: dict[Path, NDArray[Any]] = field(default_factory=dict)
    dems: list[Path] = field(default_factory=list)
    unknown: list[Path] = field(default_factory=list)
    unused: dict[Path, str] = field(default_factory=dict)


def _listed(files: Iterable[Path]) -> dict[Path, bool]:
    """Return the files, and those in folders, with True for files that were named themselves."""
    listed: dict[Path, bool] = {}
    for path in files:
        if not path.exists():
            raise CampaignError("no such file or folder", path, "recordings and flight logs", "Correct the path.")
        is_folder = path.is_dir() and not path.name.endswith(".zarr")
        inside = sorted(path.rglob("*")) if is_folder else [path]
        stores = {entry for entry in inside if entry.is_dir() and entry.name.endswith(".zarr")}
        for entry in inside:
            is_hidden = any(part.startswith(".") for part in entry.relative_to(path).parts)
            if (entry.is_file() and not is_hidden and not stores & set(entry.parents)) or entry in stores:
                listed.setdefault(entry, not is_folder)
        if len(listed) > MOST_FILES:
            found, expected = f"more than {MOST_FILES} files", f"at most {MOST_FILES} files"
            raise CampaignError(found, path, expected, "Name the folders of one campaign.")
    return listed


def _recognised(files: Iterable[Path]) -> _Files:
    """Sort files by their content; raise CampaignError for a named file, or a recording, that cannot be read."""
    found, listed = _Files(), _listed(files)
    for path, is_named in listed.items():
        if path.suffix == ".sigmf-data" and path.with_suffix(".sigmf-meta") in listed:
            continue
        if path.name.endswith(".time.npy") and path.with_name(path.name.removesuffix(".time.npy") + ".npy") in listed:
            continue
        report = look(path)
        if _is_taken(found, path, report):
            continue
        if report.kind == "unknown" and not _is_text(path):
            found.unknown.append(path)
        elif is_named or report.kind == "recording":
            raise report.problem or CampaignError(
                f"a file of kind {report.kind}", path, "recordings, flight logs, codes or a DEM", "Leave out the file."
            )
        else:
            found.unused[path] = report.problem.found if report.problem else report.title
    for path in found.unknown:
        found.recordings.append(_headerless(path, found))
    return found


def _is_taken(found: _Files, path: Path, report: Report) -> bool:
    """Add a recognised file to `found`; return False if the file is of no use, or must be read differently."""
    beat = _beat(path)
    if beat is not None:
        found.recordings.append(beat)
    elif report.kind == "flight log":
        log = _Log(path, report.format, report.problem)
        if report.problem is not None and not _asked_key(report.problem):
            return False
        found.logs.append(log)
    elif report.problem is not None:
        return False
    elif report.kind == "recording":
        opened = open_recording([path, _samples_beside(path)])
        times, frames = opened.captures.time, opened.captures.frame
        found.recordings.append(
            _Recording(
                *("sigmf", "sigmf", opened.files, times, recorded_span(opened), frames, opened),
                channels=len(opened.channels),
            )
        )
    elif report.kind == "phase history":
        _add_history(found, path, report)
    elif report.kind == "time tags":
        found.tags.append(path)
    elif report.kind in {"code symbols", "array"}:
        found.arrays[path] = np.load(path, mmap_mode="r", allow_pickle=False)
    elif report.kind == "elevation model":
        found.dems.append(path)
    else:
        return False
    return True


def _samples_beside(meta: Path) -> Path:
    from apertura.formats.names import recording_files

    return recording_files(meta.parent, meta.name.removesuffix(".sigmf-meta"))[1]


def _is_text(path: Path) -> bool:
    with path.open("rb") as stream:
        return b"\0" not in stream.read(4096)


def _beat(path: Path) -> _Recording | None:
    """Return a recording of beat signals, (sweep, sample), or None for other contents."""
    times_path = path.with_name(path.name.removesuffix(".npy") + ".time.npy")
    with suppress(CampaignError, ValueError, OSError):
        if path.suffix == ".npy":
            beat = np.load(path, mmap_mode="r", allow_pickle=False)
            if beat.ndim != 2 or beat.shape[1] < 8 or beat.dtype.kind not in "fiuc":
                return None
            if not times_path.is_file():
                return _Recording("beat", "beat_npy", (path,), echo=beat)
            times = times_of(np.load(times_path, allow_pickle=False), times_path)
            return _Recording("beat", "beat_npy", (path, times_path), times, (times[0], times[-1]), echo=beat)
        if path.suffix == ".wav":
            wave = next(iter(read_fields(read_wav, [path])))[1]
            return _Recording("beat", "beat_wav", (path,), echo=wave)
        if path.suffix == ".mat":
            fields = next(iter(read_fields(read_beat_fields, [path])))[1]
            times = times_of(fields["time"], path) if "time" in fields else None
            span = None if times is None else (times[0], times[-1])
            return _Recording("beat", "beat_mat", (path,), times, span, echo=fields["beat"])
    return None


def _add_history(found: _Files, path: Path, report: Report) -> None:
    """Add a phase history; files that contain their positions and have no clock are parts of one recording."""
    pair = "a-b" if report.facts.get("bistatic") else "a-a"
    files = tuple(PHASE_HISTORIES[report.format].files_of(path))
    described = {key: option.default for key, option in WAVEFORMS["phase_history"].model_fields.items()}
    echo = read_phase_history(report.format, files, pair=pair, described=described | {"format": report.format})
    times = echo.time.values
    for other in found.recordings:
        is_part = other.kind == "history" and other.format == report.format and other.path.parent == path.parent
        if is_part and "tx_position" in echo and own_clock(times) and path.is_file():
            other.files += (path,)
            return
    files = (path,) if path.is_dir() else files
    found.recordings.append(_Recording("history", report.format, files, times, (times[0], times[-1]), echo=echo))


def _headerless(path: Path, found: _Files) -> _Recording:
    """Return a recording of samples without header, with its time tags."""
    bytes_each = 2 * np.dtype(_SAMPLE_TYPES.get(path.suffix, "int16")).itemsize
    fitting = []
    for tags in found.tags:
        times, frames = read_time_tags(tags)
        if path.stat().st_size and path.stat().st_size % (bytes_each * len(times)) == 0:
            fitting.append((tags, times, frames))
    fitting = [row for row in fitting if _likeness(row[0], path) == max(_likeness(tags, path) for tags, *_ in fitting)]
    if len(fitting) != 1:
        which = " and ".join(tags.name for tags, *_ in fitting) or "none that divides its size"
        raise CampaignError(
            f"{path.stat().st_size} bytes without a header; files of time tags: {which}",
            path,
            "one file of time tags, one line per capture, with the name of the recording; or SigMF",
            f"Add <{path.stem}>_tags.txt with the UTC of each capture.",
        )
    _, times, frames = fitting[0]
    return _Recording("samples", "samples", (path,), times, (times[0], times[-1]), frames)


# ---- Names of flights and nodes; assignment of logs -----------------------------------------------------------------


def _words(path: Path) -> list[str]:
    return [word for word in re.split(r"[^A-Za-z0-9]+", path.name.partition(".")[0]) if word]


def _likeness(first: Path, second: Path) -> int:
    """Return the number of words that two file names have in common; names of common folders count as one."""
    common = {word.lower() for word in _words(first)} & {word.lower() for word in _words(second)}
    return len(common) + (first.parent == second.parent)


def _name(recordings: list[_Recording], assigned: Mapping[Path, str]) -> None:
    """Set flight and node of each recording: flights by overlapping times or folders, nodes by words of file names."""
    flights: list[list[_Recording]] = []
    first = np.datetime64(0, "ns")
    for recording in sorted(recordings, key=lambda one: (one.span or (first,))[0].astype("datetime64[ns]")):
        group = next((flight for flight in flights if any(_same_flight(recording, one) for one in flight)), None)
        if group is None:
            flights.append([recording])
        else:
            group.append(recording)
    spread: dict[str, int] = {}
    for flight in flights:
        for word in {word.lower() for recording in flight for word in _words(recording.path)}:
            spread[word] = spread.get(word, 0) + 1
    folders = [{recording.path.parent for recording in flight} for flight in flights]
    by_folder = len(flights) > 1 and all(len(folder) == 1 for folder in folders)
    names = [next(iter(folder)).name for folder in folders] if by_folder else []
    is_name = (
        by_folder and len(set(names)) == len(names) and all(re.fullmatch(r"[A-Za-z0-9_]+", name) for name in names)
    )
    for number, flight in enumerate(flights, 1):
        for recording, node in zip(flight, _nodes(flight, spread, len(flights)), strict=True):
            recording.flight, recording.node = (names[number - 1] if is_name else f"f{number:02d}"), node
    for recording in recordings:
        if recording.path in assigned:
            flight_name, _, recording.node = assigned[recording.path].rpartition("/")
            recording.flight = flight_name or recording.flight
    keys = [(recording.flight, recording.node) for recording in recordings]
    for recording, key in zip(recordings, keys, strict=True):
        if keys.count(key) > 1:
            others = [shown(one.path.name) for one, other in zip(recordings, keys, strict=True) if other == key]
            found = f"{' and '.join(others)} would all be the recording of {key[1]} in {key[0]}"
            raise CampaignError(found, recording.path, "one recording per flight and node", _ASSIGN)


_ASSIGN = "State flight and node: --assign FILE=FLIGHT/NODE."


def _same_flight(one: _Recording, other: _Recording) -> bool:
    if one.is_free_running or other.is_free_running or one.span is None or other.span is None:
        return one.is_free_running and other.is_free_running and one.path.parent == other.path.parent
    start, end = max(one.span[0], other.span[0]), min(one.span[1], other.span[1])
    shorter = min(one.span[1] - one.span[0], other.span[1] - other.span[0])
    return bool(end - start >= _COVERED * shorter)


def _nodes(flight: list[_Recording], spread: Mapping[str, int], flights: int) -> list[str]:
    """Return a name for the node of each recording of a flight."""
    words = [[word for word in _words(recording.path) if not word.isdigit()] for recording in flight]
    shared = set.intersection(*({word.lower() for word in one} for one in words)) if len(flight) > 1 else set[str]()
    names = []
    for own in words:
        tried = [
            [word for word in own if word.lower() not in shared and spread[word.lower()] == flights],
            [word for word in own if word.lower() not in shared],
            own,
        ]
        chosen = next(
            (some for some in tried if [word for word in some if word.lower() not in _COMMON_WORDS]), tried[1]
        )
        names.append("_".join([word for word in chosen if word.lower() not in _COMMON_WORDS] or chosen) or "uav1")
    if len(set(names)) < len(names):
        names = [re.sub(r"[^A-Za-z0-9]+", "_", recording.path.name.partition(".")[0]) for recording in flight]
    return names


def _is_of(log: _Log, recording: _Recording) -> bool:
    """Return True if the file name of a log contains the node's name, or all words of the recording's name."""
    words = {word.lower() for word in _words(log.path)}
    node = {word.lower() for word in recording.node.split("_")}
    return node <= words or any(word.startswith(recording.node.lower()) for word in words)


class _Assignment:
    """Assignment of logs to recordings, by times first and by names second."""

    def __init__(self, found: _Files, assigned: Mapping[Path, str], draft: "_Draft") -> None:
        self.found, self.assigned, self.draft = found, assigned, draft

    def assign(self) -> None:
        """Assign a log to each recording; raise CampaignError if several logs are equally suitable."""
        for log in self.found.logs:
            self._read(log)
        for flight in dict.fromkeys(recording.flight for recording in self.found.recordings):
            own = [one for one in self.found.recordings if one.flight == flight and not _has_positions(one)]
            options = {recording.node: self._options(recording) for recording in own}
            for recording in own:
                others = [one for one in own if one is not recording]
                logs = options[recording.node]
                named = [log for log in logs if _is_of(log, recording)]
                foreign = [log for log in logs if any(_is_of(log, other) for other in others)]
                options[recording.node] = named or [log for log in logs if log not in foreign]
            for recording in sorted(own, key=lambda one: len(options[one.node])):
                logs = [log for log in options[recording.node] if all(log is not other.log for other in own)]
                recording.log = self._chosen(recording, logs)
                recording.offset_s = self._zone(recording)

    def _read(self, log: _Log) -> None:
        """Read a log; values that it does not contain are asked with the key that the reader names."""
        node = self.assigned.get(log.path, "").rpartition("/")[2]
        named = [one.node for one in self.found.recordings if _is_of(log, one)]
        node = node or (named or [one.node for one in self.found.recordings] or ["uav1"])[0]
        log.options = dict(self.draft.given_below(f"nodes.{node}.log"))
        while True:
            options = replace(Log(**log.options).options, format=log.options.get("format", log.format))
            try:
                log.track = read_track(log.path, node=node, options=options)
                log.facts = log_facts(log.track)
                return
            except CampaignError as problem:
                key = _asked_key(problem)
                if not key or key in log.options:
                    raise
                text = (
                    f"{shown(log.path.name, 60)}: {problem.found}; {_field(f'nodes.{node}.log.{key}', '').description}"
                )
                answer = self.draft.answer(Question((f"nodes.{node}.log.{key}",), text, _LOG_EXAMPLES.get(key, "")))
                if answer is None:
                    remedy = f"Add --set nodes.{node}.log.{key}=VALUE, or run on a terminal."
                    raise CampaignError(problem.found, log.path, problem.expected, remedy) from problem
                log.options[key] = answer[0]

    def _options(self, recording: _Recording) -> list[_Log]:
        """Return the logs that may belong to a recording: assigned, covering its times, or covering no recording."""
        for path, target in self.assigned.items():
            flight, _, node = target.rpartition("/")
            if node == recording.node and flight in {"", recording.flight}:
                stated = [log for log in self.found.logs if log.path == path]
                if stated:
                    return stated
        free = [log for log in self.found.logs if log.path not in self.assigned]
        covering = [log for log in free if log.covers(recording.span)]
        if covering:
            return covering
        return [log for log in free if not any(log.covers(one.span) for one in self.found.recordings)]

    def _chosen(self, recording: _Recording, logs: Sequence[_Log]) -> _Log | None:
        if len(logs) < 2:
            return logs[0] if logs else None
        names = [log.path.name for log in logs]
        text = f"log of node {recording.node} in {recording.flight} ({shown(recording.path.name)}): {', '.join(names)}"
        answer = self.draft.answer(Question(("log",), text, names[0]), allowed=names)
        if answer is None:
            raise CampaignError(
                f"{' and '.join(names)} may both be the log of {recording.node} in {recording.flight}",
                recording.path,
                "one log for this recording, by its times or its name",
                f"Add --assign {names[0]}={recording.flight}/{recording.node}, or leave out the other log.",
            )
        return next(log for log in logs if log.path.name == answer[0])

    def _zone(self, recording: _Recording) -> float | None:
        """Return the only shift by a time zone after which the log covers a recording (eq. 6); None if not needed."""
        log = recording.log
        if log is None or log.covers(recording.span) or recording.is_free_running:
            return None
        steps = range(-_LARGEST_ZONE_S, _LARGEST_ZONE_S + 1, _QUARTER_HOUR_S)
        fitting = [step for step in steps if log.covers(recording.span, step)]
        return float(fitting[0]) if len(fitting) == 1 else None


_LOG_KEY = re.compile(r"\bnodes\.\S+?\.log\.(\w+)")
_LOG_EXAMPLES = {
    "height_offset_m": "47.2",
    "time_system": "utc",
    "start_utc": "2025-05-14T09:30:00",
    "quality": "gga",
    "base": "[48.1, 9.9, 620.0]",
}


def _asked_key(problem: CampaignError) -> str:
    """Return the key of `nodes.<n>.log` that a reader requires; empty for other problems."""
    keys = _LOG_KEY.findall(problem.expected)
    return next((key for key in keys if key in _LOG_EXAMPLES or key == "body"), "")


def _has_positions(recording: _Recording) -> bool:
    return recording.kind == "history" and "tx_position" in recording.echo


# ---- Draft of the config: known values with their origin, open keys with their reason ---------------------------------


def _field(key: str, kind: str) -> FieldInfo:
    """Return the field of a config key; raise CampaignError if there is no such key."""
    model: Any = Settings
    parts = key.split(".")
    for depth, part in enumerate(parts):
        if depth == 1 and parts[0] == "nodes":
            model = Node
            continue
        info = model.model_fields.get(part) if isinstance(model, type) and issubclass(model, BaseModel) else None
        if info is None:
            expected = (
                f"a key of config/config.yaml, such as {', '.join(list(getattr(model, 'model_fields', {}))[:12])}"
            )
            raise CampaignError(f"unknown key {quoted(key)}", "--set", expected, "Correct the key.")
        kinds = [kind for kind in (info.annotation, *get_args(info.annotation)) if isinstance(kind, type)]
        model = next((one for one in kinds if issubclass(one, BaseModel)), None)
        model = WAVEFORMS.get(kind, WAVEFORMS["ofdm"]) if key.startswith("waveform.") and depth == 0 else model
    return info


class _Draft:
    """Contents of config.yaml: values with their origin, and keys left open with the reason."""

    def __init__(self, given: Mapping[str, str], ask: Ask | None) -> None:
        self.given, self.ask, self.asked = dict(given), ask, list[Question]()
        self.values: dict[str, Any] = {}
        self.comments: dict[str, str] = {}
        self.open: dict[str, str] = {}
        self.kind = "ofdm"

    def given_below(self, section: str) -> dict[str, Any]:
        """Return the given values of a section, by the last part of the key."""
        start = f"{section}."
        return {
            key.removeprefix(start): self.value(key, text) for key, text in self.given.items() if key.startswith(start)
        }

    def value(self, key: str, text: str) -> Any:
        """Validate the text of a value against the schema of the config; return a plain value for YAML."""
        info = _field(key, self.kind)
        adapter: TypeAdapter[Any] = TypeAdapter(Annotated[info.annotation, info])
        try:
            value = adapter.validate_python(yaml.safe_load(text))
        except (ValidationError, yaml.YAMLError) as error:
            reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else "not readable as YAML"
            raise CampaignError(f"{quoted(text)}: {reason}", key, str(info.description), "Correct the value.") from None
        return adapter.dump_python(value, mode="json")

    def set(self, key: str, value: Any, origin: str) -> None:
        """Set a key to a value that was found in the files, unless the user has given another value."""
        if key in self.given:
            value, origin = self.value(key, self.given[key]), "given"
        self.values[key], self.comments[key] = value, origin

    def leave(self, key: str, reason: str) -> None:
        """Leave a key open, unless the user has given its value."""
        if key in self.given or any(other.startswith(f"{key}.") for other in self.given):
            return
        self.open[key] = reason

    def need(self, keys: Mapping[str, tuple[str, str]], reason: str) -> bool:
        """Set keys to given values or to the words of one answer; without an answer leave them open, with a reason.

        `keys` contains the meaning and an example of each key. True if all keys are set.
        """
        for key in keys.keys() & self.given.keys():
            self.set(key, None, "given")
        rest = {key: words for key, words in keys.items() if key not in self.given}
        if not rest:
            return True
        meanings, examples = zip(*rest.values(), strict=True)
        answers = self.answer(Question(tuple(rest), "; ".join(meanings), " ".join(examples)))
        for key, word in zip(rest, answers or (), strict=False):
            self.values[key], self.comments[key] = word, "answered"
        for key in rest if answers is None else ():
            self.leave(key, reason)
        return answers is not None

    def answer(self, question: Question, allowed: Sequence[str] = ()) -> list[Any] | None:
        """Ask a question until the answer is valid; None if it stays open."""
        if self.ask is None:
            return None
        self.asked.append(question)
        problem = ""
        while True:
            text = self.ask(question, problem).strip()
            if not text:
                return None
            if allowed:
                if text in allowed:
                    return [text]
                problem = f"{quoted(text)}; expected one of {', '.join(allowed)}"
                continue
            words = text.replace(",", " ").split() if len(question.keys) > 1 else [text]
            try:
                if not 1 <= len(words) <= len(question.keys) or (
                    len(words) < len(question.keys) and "side" not in question.keys
                ):
                    expected = f"{len(question.keys)} values: {', '.join(question.keys)}"
                    raise CampaignError(number_of(len(words), "value"), question.keys[0], expected, "Answer again.")
                return [
                    _side(word) if key == "side" else self.value(key, word)
                    for key, word in zip(question.keys, words, strict=False)
                ]
            except CampaignError as error:
                problem = str(error)

    def document(self) -> dict[str, Any]:
        """Return the values as nested sections."""
        for key, text in self.given.items():
            if key not in self.values:
                self.set(key, self.value(key, text), "given")
        nested: dict[str, Any] = {}
        for key, value in self.values.items():
            *sections, last = key.split(".")
            part = nested
            for section in sections:
                part = part.setdefault(section, {})
            part[last] = value
        return nested


def _side(word: str) -> str:
    if word not in SIDES:
        raise CampaignError(quoted(word), "side", ", ".join(SIDES), "Name a side of the track, in flight direction.")
    return word


# ---- Waveform ---------------------------------------------------------------------------------------------------------

_HEADER = "in the metadata of the recordings"
_NOT_IN_SAMPLES = "not contained in samples without header"


def _waveform(draft: _Draft, found: _Files, kind: str | None) -> dict[str, Path]:
    """Fill in the section `waveform`; return target in the campaign folder → file of the transmitted signal."""
    first = found.recordings[0]
    kinds = {_KINDS[recording.kind] for recording in found.recordings}
    if len(kinds) > 1:
        names = ", ".join(shown(recording.path.name) for recording in found.recordings)
        raise CampaignError(
            f"recordings of {' and '.join(sorted(kinds))}: {names}", "init", "one kind of radar", _ASSIGN
        )
    if first.kind in {"beat", "history"}:
        draft.kind = "fmcw" if first.kind == "beat" else "phase_history"
        draft.set("waveform.kind", draft.kind, f"format of {shown(first.path.name)}")
        draft.set("waveform.format", first.format, f"format of {shown(first.path.name)}")
        if first.kind == "beat":
            _sweep(draft, found)
        return {}
    return _sampled(draft, found, kind)


_KINDS = {"sigmf": "sampled pulses", "samples": "sampled pulses", "beat": "FMCW sweeps", "history": "phase histories"}


def _rate(recordings: Sequence[_Recording]) -> float | None:
    """Return the pulse repetition frequency, to the accuracy of the time tags (eq. 7)."""
    times = next((one.times for one in recordings if one.times is not None and len(one.times) > 1), None)
    rate = None if times is None else time_facts(times, longer=LOST_CAPTURE).rate_hz
    if rate is None or times is None:
        return None
    resolution = 1 / max(len(times) - 1, 1) * 1e-2
    return next(
        (short for digits in range(2, 10) if abs((short := float(f"{rate:.{digits}g}")) / rate - 1) < resolution), rate
    )


def _sampled(draft: _Draft, found: _Files, kind: str | None) -> dict[str, Path]:
    recordings = found.recordings
    sent = {path: _signal(array) for path, array in found.arrays.items()}
    best: tuple[Path, CaptureStructure] | None = None
    for path, signal in sent.items():
        for recording in recordings:
            structure = None if signal is None else _structure(recording, signal)
            if structure is not None and (best is None or structure.compression > best[1].compression):
                best = path, structure
    for recording in recordings:
        if recording.kind == "samples":
            structure = None if best is None else _structure(recording, sent[best[0]])
            recording.channels = 1 if structure is None else structure.channels
    draft.kind = kind or ("samples" if best is not None and best[1].dft_samples is None else "ofdm")
    is_ofdm = draft.kind == "ofdm"
    draft.set(
        "waveform.kind",
        draft.kind,
        "given" if kind else "the samples contain the transmitted signal" if best else "assumed",
    )
    headers = [recording.opened for recording in recordings if recording.opened is not None]
    carrier_hz = next((float(header.frequency_hz) for header in headers if header.frequency_hz), None)
    if headers:
        draft.set("waveform.sample_rate_hz", float(headers[0].sample_rate_hz), _HEADER)
    if carrier_hz is not None:
        draft.set("waveform.carrier_hz", carrier_hz, _HEADER)
    asked = {
        "waveform.sample_rate_hz": ("complex sample rate of the recordings, Hz", "50e6"),
        "waveform.carrier_hz": ("RF frequency of zero baseband frequency, Hz", "1.3e9"),
    }
    rest = {key: words for key, words in asked.items() if key not in draft.values}
    draft.need(rest, "not contained in the recordings; write the value, Hz")
    if "waveform.sample_rate_hz" not in draft.values:
        expected = "the sample rate, with which the samples get a SigMF header"
        remedy = "Add --set waveform.sample_rate_hz=HERTZ, or run on a terminal."
        raise CampaignError("samples without header", recordings[0].path, expected, remedy)
    rate_hz = _rate([one for one in recordings if one.opened is None or one.opened.framing is None])
    if rate_hz is None:
        draft.need(
            {"waveform.prf_hz": ("pulse repetition frequency, Hz", "100")},
            "no times of pulses; write pulses per second",
        )
    else:
        draft.set("waveform.prf_hz", rate_hz, "from the time tags")
    target = "raw/codes.npy" if is_ofdm else "raw/pulse.npy"
    if best is None:
        _leave_signal(draft, sent, target, is_ofdm=is_ofdm)
        return {target: next(iter(sent))} if len(sent) == 1 else {}
    path, structure = best
    if structure.iq != "complex":
        draft.set("waveform.iq", structure.iq, "the samples contain the conjugate of the transmitted signal")
    draft.set(
        f"waveform.{'codes' if is_ofdm else 'pulse'}",
        target,
        f"{shown(path.name)}, {structure.compression:.0%} of the energy at one delay",
    )
    _timing(draft, recordings, sent[path].size, structure)
    return {target: path}


def _leave_signal(draft: _Draft, sent: Mapping[Path, Any], target: str, *, is_ofdm: bool) -> None:
    reason = (
        "the recordings do not contain the signal of these files"
        if sent
        else f"no file of the transmitted signal; copy it to {target}"
    )
    keys = (
        {
            "subcarriers": "number of code symbols",
            "subcarrier_spacing_hz": "subcarrier spacing, Hz",
            "symbol_s": "duration of the symbol without prefix, s",
            "cyclic_prefix_s": "duration of the cyclic prefix, s",
        }
        if is_ofdm
        else {"pulse_s": "duration of the pulse, s", "listen_s": "longest delay of a complete echo, s"}
    )
    for key, what in keys.items():
        draft.leave(f"waveform.{key}", f"{reason}; write the {what}")


def _signal(array: NDArray[Any]) -> NDArray[np.complex128] | None:
    """Return code symbols or a pulse as complex numbers; None for other arrays."""
    if array.ndim == 2 and array.shape[1] == 2 and array.dtype.kind == "i":
        return np.asarray(array[:, 0] + 1j * array[:, 1].astype(np.float64))
    is_signal = array.ndim == 1 and array.dtype.kind == "c" and 1 < array.size <= 1 << 22
    return np.asarray(array, np.complex128) if is_signal else None


def _numbers(recording: _Recording) -> NDArray[np.complexfloating]:
    """Return the first captures in the order of the file, (capture, number) complex."""
    if recording.opened is not None:
        samples = first_samples(recording.opened)[:_FIRST_CAPTURES]
        return samples.reshape(len(samples), -1)
    captures = len(recording.times) if recording.times is not None else 1
    kind = np.dtype(_SAMPLE_TYPES.get(recording.path.suffix, "int16")).newbyteorder("<")
    stored = np.memmap(recording.path, kind, "r").reshape(captures, -1, 2)[:_FIRST_CAPTURES].astype(np.float32)
    return np.asarray(stored[..., 0] + 1j * stored[..., 1])


def _structure(recording: _Recording, sent: NDArray[np.complex128] | None) -> CaptureStructure | None:
    is_continuous = recording.opened is not None and recording.opened.framing is not None
    if sent is None or is_continuous:
        return None
    return capture_structure(_numbers(recording), sent, channels=recording.channels if recording.opened else None)


def _capture_samples(recording: _Recording) -> int:
    return _numbers(recording).shape[1] // recording.channels


def _timing(draft: _Draft, recordings: Sequence[_Recording], size: int, structure: CaptureStructure) -> None:
    """Fill in spacing and durations from the structure of the captures (eqs. 3 and 6)."""
    rate_hz, length = float(draft.values["waveform.sample_rate_hz"]), min(map(_capture_samples, recordings))
    period = structure.dft_samples
    if period is None:
        lead = "time from the start of a capture to the start of the pulse, s"
        draft.need({"waveform.lead_s": (lead, "0")}, f"not observable, 0 is assumed; write the {lead}")
        lead_s = float(draft.values.get("waveform.lead_s", 0.0))
        draft.set("waveform.pulse_s", size / rate_hz, "length of the file of the pulse")
        draft.set("waveform.listen_s", (length - size) / rate_hz - lead_s, "rest of a capture after lead and pulse")
        return
    draft.set("waveform.subcarriers", size, "number of code symbols")
    draft.set("waveform.subcarrier_spacing_hz", rate_hz / period, f"the samples repeat after {period} samples")
    draft.set("waveform.carrier_is", structure.carrier_is, "subcarriers in which the code was found")
    prefix = (
        f"duration of the cyclic prefix, s; {(length - period) / rate_hz:.9g} if a capture is prefix and one period"
    )
    missing = f"not observable, because the symbol is periodic; write the {prefix}"
    if draft.need({"waveform.cyclic_prefix_s": (prefix, f"{(length - period) / rate_hz:.9g}")}, missing):
        prefix_s = float(draft.values["waveform.cyclic_prefix_s"])
        draft.set("waveform.symbol_s", length / rate_hz - prefix_s, "length of a capture without the prefix")
    else:
        draft.leave("waveform.symbol_s", f"length of a capture, {length / rate_hz:.9g} s, minus the cyclic prefix")


def _sweep(draft: _Draft, found: _Files) -> None:
    recording = found.recordings[0]
    for one in found.recordings:
        _add_sweep_times(one, found)
    if recording.format == "beat_wav":
        draft.set("waveform.sample_rate_hz", float(recording.echo["rate"][0]), "in the header of the recording")
    missing = "beat signals do not contain it; write the value of the radar"
    sweep = {
        "waveform.start_hz": ("first frequency of the sweep, Hz", "2.2e9"),
        "waveform.bandwidth_hz": ("bandwidth, Hz, negative for a falling frequency", "400e6"),
        "waveform.sweep_s": ("duration of the sweep, s", "20e-6"),
    }
    draft.need(sweep, missing)
    if recording.format == "beat_wav":
        draft.leave(
            "waveform.start_utc", "not in sound files; write the UTC of the first sample, or run apertura align"
        )
        return
    draft.need({"waveform.sample_rate_hz": ("sample rate of the beat signal, Hz", "25e6")}, missing)
    is_real = recording.echo.dtype.kind != "c"
    why = "type of the array" + ("" if is_real else "; conjugate if beat frequencies have the opposite sign")
    draft.set("waveform.iq", "real" if is_real else "complex", why)
    if recording.times is None:
        missing = "no times of sweeps; write sweeps per second"
        draft.need({"waveform.prf_hz": ("sweep repetition frequency, Hz", "100")}, missing)
        draft.leave("waveform.start_utc", "no times of sweeps; write the UTC of the first sweep, or run apertura align")


def _add_sweep_times(recording: _Recording, found: _Files) -> None:
    """Add the times of sweeps from a file of time tags, or an array of times, with as many times as sweeps."""
    if recording.times is not None or recording.format != "beat_npy":
        return
    fitting = []
    for path in (*found.tags, *found.arrays):
        with suppress(CampaignError):
            times = read_time_tags(path)[0] if path in found.tags else times_of(np.asarray(found.arrays[path]), path)
            fitting += [(path, times)] if len(times) == len(recording.echo) else []
    best = max((_likeness(path, recording.path) for path, _ in fitting), default=0)
    fitting = [row for row in fitting if _likeness(row[0], recording.path) == best]
    if len(fitting) == 1:
        recording.times = fitting[0][1]
        recording.span = recording.times[0], recording.times[-1]


# ---- Nodes and scene --------------------------------------------------------------------------------------------------


def _describe_nodes(draft: _Draft, found: _Files) -> None:
    for node in dict.fromkeys(recording.node for recording in found.recordings):
        own = [recording for recording in found.recordings if recording.node == node]
        logs = [recording.log for recording in own if recording.log is not None and recording.log.facts is not None]
        has_attitude = bool(logs) and all(log.facts.attitude_share > 0.99 for log in logs if log.facts)
        why = (
            "the log contains roll, pitch and yaw"
            if has_attitude
            else "no attitude in the log; course: course over ground"
        )
        draft.set(f"nodes.{node}.attitude", "log" if has_attitude else "none", why)
        draft.leave(
            f"nodes.{node}.lever_arms_m",
            "not in any file, zero is assumed; write {radar_tx: [forward, right, down], radar_rx: […], sidelink: […]}"
            + ("" if has_attitude else ", which requires attitude log or course"),
        )
        draft.leave(
            f"nodes.{node}.path_offset_m",
            "not in any file, zero is assumed; write {radar: metres of cable and filter, sidelink: metres}, measured "
            "with apertura bench, align or a calibration flight",
        )
        if not logs or any(log.facts and log.facts.fixes is None and log.facts.stated_std_m is None for log in logs):
            draft.leave(f"nodes.{node}.position_std_m", "not in the log; write the standard deviation of positions, m")
        for log in logs:
            for key, value in log.options.items():
                draft.set(f"nodes.{node}.log.{key}", value, f"not in {shown(log.path.name)}")


def _scene(draft: _Draft, found: _Files, side: str | None) -> dict[str, Path]:
    """Fill in the section `scene`; return target in the campaign folder → DEM."""
    positions, frame = _positions(found)
    draft.set("scene.crs", LOCAL if frame == "local" else "auto", "frame of the positions" if frame else "no positions")
    placed: dict[str, Path] = {}
    if found.dems:
        name = f"raw/{found.dems[0].name}"
        draft.set("scene.dem", name, shown(found.dems[0].name))
        datum = "vertical datum of the DEM: ellipsoid, egm96, egm2008, or carried if its CRS states it"
        draft.need({"scene.dem_datum": (datum, "egm2008")}, f"not stated; write the {datum}")
        placed[name] = found.dems[0]
    else:
        keys = {"scene.height_m": ("ground height above the WGS 84 ellipsoid (local frame: z), m", "620")}
        if side is None and "scene.height_m" not in draft.given:
            keys["side"] = ("optionally the side of the track on which the scene lies: left, right or both", "right")
        draft.need(keys, "not in any file; write the ground height above the ellipsoid, m")
    side = draft.values.pop("side", side) or "both"
    draft.open.pop("side", None)
    why = "both sides of the track; for one side write [xmin, ymin, xmax, ymax] in crs, m"
    height_m = draft.values.get("scene.height_m")
    bounds = (
        None
        if side == "both" or height_m is None or positions is None
        else _swath(draft, positions, frame, side, height_m)
    )
    if bounds is None:
        draft.set("scene.bounds_m", "auto", why)
    else:
        crs, bounds_m = bounds
        draft.set("scene.crs", crs, "UTM zone of the tracks" if crs != LOCAL else "frame of the positions")
        draft.set("scene.bounds_m", bounds_m, f"{side} of the tracks, at elevation angles of 10° to 80°")
    return placed


def _positions(found: _Files) -> tuple[NDArray[np.float64] | None, str]:
    """Return the positions of all antennas of the first flight during the recordings, and their frame."""
    parts, frame = [], ""
    for recording in (one for one in found.recordings if one.flight == found.recordings[0].flight):
        if _has_positions(recording):
            frame = str(recording.echo.attrs["frame"])
            parts.append(recording.echo.tx_position.values)
        elif recording.log is not None and recording.log.track is not None:
            track, frame = recording.log.track, str(recording.log.track.attrs["frame"])
            time = track.time.values
            inside = np.ones(len(time), bool)
            if not recording.is_free_running and recording.span is not None:
                shift = np.timedelta64(round((recording.offset_s or 0.0) * 1e9), "ns")
                first, last = (end.astype("datetime64[ns]") + shift for end in recording.span)
                inside = (time >= first) & (time <= last)
            parts.append(track.position.values[inside if inside.sum() > 1 else np.ones(len(time), bool)])
    return (np.concatenate(parts) if parts else None), frame


def _path_limit_m(draft: _Draft) -> float:
    values = draft.values
    delay_s = values.get("waveform.cyclic_prefix_s", values.get("waveform.listen_s"))
    if delay_s is not None:
        return SPEED_OF_LIGHT_M_S * float(delay_s)
    if draft.kind == "fmcw" and {"waveform.start_hz", "waveform.sweep_s"} <= values.keys():
        described = {name: info.default for name, info in WAVEFORMS["fmcw"].model_fields.items()}
        described |= {key.removeprefix("waveform."): value for key, value in values.items()}
        return float(sweep_of(described).path_limit_m)
    return np.inf


def _swath(
    draft: _Draft, positions: NDArray[np.float64], frame: str, side: str, height_m: float
) -> tuple[str, list[float]] | None:
    """Return CRS and bounds of the strip on one side of a straight track (eq. 8); None for a track that turns."""
    crs = LOCAL if frame == "local" else utm_crs(np.median(positions, axis=0))
    flat = map_from_frame(crs, positions)
    legs = np.diff(flat[:, :2], axis=0)
    along = flat[-1, :2] - flat[0, :2]
    straight_m = float(np.linalg.norm(along))
    if straight_m < _STRAIGHT * float(np.linalg.norm(legs, axis=1).sum()):
        draft.comments["scene.crs"] += f"; the tracks turn, so that side {side} does not determine the bounds"
        return None
    square = auto_bounds(Aperture(positions, positions), crs=crs, height_m=height_m, path_limit_m=_path_limit_m(draft))
    reach_m = (square[2] - square[0]) / 2
    above_m = max(float(np.median(flat[:, 2])) - height_m, 1.0)
    near_m = min(above_m * np.tan(np.radians(GRAZING_LIMIT_DEG)), reach_m / 2)
    unit = along / straight_m
    right = np.array([unit[1], -unit[0]]) * (1 if side == "right" else -1)
    middle, ends = flat[:, :2].mean(axis=0), (flat[:, :2] - flat[:, :2].mean(axis=0)) @ unit
    corners = [middle + unit * end + right * far for end in (ends.min(), ends.max()) for far in (near_m, reach_m)]
    low, high = np.floor(np.min(corners, axis=0)), np.ceil(np.max(corners, axis=0))
    return crs, [float(low[0]), float(low[1]), float(high[0]), float(high[1])]


_STRAIGHT = 0.5
"""Smallest distance between the ends of a track, relative to its length, at which a side is defined."""


# ---- Command: questions on a terminal, summary, check ---------------------------------------------------------------


def print_initialised(folder: Path, files: Sequence[Path], name: Path, **options: Any) -> int:
    """Create a campaign as `campaign_from_files`, print the assignment and the result of `apertura check`.

    Return 2 if the check finds problems, otherwise 0. Questions are asked if the input is a terminal.
    """
    made = campaign_from_files(folder, files, **options, ask=_ask_on_terminal if sys.stdin.isatty() else None)
    print(*map(shown, made.lines, [300] * len(made.lines)), sep="\n")
    print(f"created {shown(name, 300)}; questions asked: {len(made.asked)}")
    if made.open_keys:
        print(f"keys left open in config/config.yaml, each with its reason: {', '.join(made.open_keys)}")
    count = print_findings(folder)
    for flight, node in made.free_running:
        print(
            f"the recorder of {node} has no UTC: first run apertura align {shlex.quote(str(name))} {flight} {node} --write"
        )
    return 2 if count else 0


def _ask_on_terminal(question: Question, problem: str) -> str:
    if problem:
        print(problem)
    example = f", such as {question.example}" if question.example else ""
    try:
        return input(f"{', '.join(question.keys)}: {question.text}{example} (Enter: leave open)\n> ")
    except EOFError:
        return ""


# ---- Campaign folder --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Initialised:
    """Created campaign folder.

    Attributes
    ----------
    folder
        Campaign folder.
    lines
        Assignment of the files, and files that were not used, one per line.
    asked
        Questions that were asked.
    open_keys
        Keys of the config that are left open.
    free_running
        flight → node of recordings whose clock is not related to that of the log.
    """

    folder: Path
    lines: tuple[str, ...]
    asked: tuple[Question, ...]
    open_keys: tuple[str, ...]
    free_running: tuple[tuple[str, str], ...]


def campaign_from_files(
    directory: str | Path,
    files: Sequence[str | Path],
    *,
    settings: Mapping[str, str] | None = None,
    assign: Mapping[str | Path, str] | None = None,
    transmitter: str | None = None,
    side: str | None = None,
    kind: str | None = None,
    copy: bool = False,
    ask: Ask | None = None,
) -> Initialised:
    """Create a campaign folder from recordings, flight logs, and the file of the transmitted signal.

    Parameters
    ----------
    directory
        Folder to create.
    files
        Files, and folders whose files are used.
    settings
        Key of the config, such as scene.height_m, → value as text.
    assign
        File → node, or flight/node, where names and times are ambiguous.
    transmitter
        Node that transmits, if several nodes have a radar.
    side
        Side of a straight track on which the scene lies, in flight direction: left, right or both.
    kind
        Kind of waveform of sampled recordings without a file of the transmitted signal: ofdm or samples.
    copy
        Copy all files. Otherwise files on the same file system are cloned or hard-linked, which takes no space.
    ask
        Function that asks the user; None: values that no file contains are left open.

    Raises
    ------
    CampaignError
        If the folder exists, a file cannot be read, files cannot be assigned, or a value is not valid. Nothing is
        written in these cases.

    Examples
    --------
    >>> campaign_from_files("new", ["nowhere.iq"])
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere.iq: no such file or folder; expected recordings and flight logs. ...
    """
    directory, draft = Path(directory), _Draft(settings or {}, ask)
    assigned = {Path(path): target for path, target in (assign or {}).items()}
    if side is not None:
        _side(side)
    with new_folder(directory) as root:
        found = _recognised(map(Path, files))
        _check_assigned(assigned, found)
        if not found.recordings:
            others = ", ".join(shown(path.name) for path in _listed(map(Path, files))) or "no files"
            raise CampaignError(f"no recording among {others}", directory, "at least one recording", "Name its files.")
        _name(found.recordings, assigned)
        found.recordings.sort(key=lambda recording: recording.flight)
        draft.set("campaign", re.sub(r'["<>&\\]', "_", directory.resolve().name), "name of the folder")
        placed = _waveform(draft, found, kind)
        _Assignment(found, assigned, draft).assign()
        flights = _flights(draft, found, transmitter)
        _describe_nodes(draft, found)
        placed |= _scene(draft, found, side)
        document = draft.document()
        if not any(_is_required(key, draft.kind) for key in draft.open):
            validated(document, where="config/config.yaml")
        text = commented_yaml(document, draft.comments, draft.open)
        (root / "config/config.yaml").write_text(text, encoding="utf-8")
        write_flights(root, flights)
        clocks = [(one.flight, one.node, one.offset_s) for one in found.recordings if one.offset_s is not None]
        if clocks:
            rows = [
                "\t".join(CLOCK_COLUMNS),
                *(f"{flight}\t{node}\t{offset_s:.0f}\t\t" for flight, node, offset_s in clocks),
            ]
            (root / "config/clocks.tsv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        place = partial(_place, copy=copy)
        for target, source in placed.items():
            place(source, root / target)
        _place_framing(found, root, place)
        for recording in found.recordings:
            _write_recording(recording, root / "raw" / recording.flight / recording.node, draft, place)
    aligned = [(one.flight, one.node) for one in found.recordings if one.is_free_running and not _has_positions(one)]
    return Initialised(directory, tuple(_lines(found, flights)), tuple(draft.asked), tuple(draft.open), tuple(aligned))


def _check_assigned(assigned: Mapping[Path, str], found: _Files) -> None:
    known = {*(recording.path for recording in found.recordings), *(log.path for log in found.logs)}
    for path, target in assigned.items():
        if path not in known or not re.fullmatch(r"([A-Za-z0-9_.]+/)?[A-Za-z0-9_.]+", target):
            expected = f"FILE=NODE or FILE=FLIGHT/NODE, with one of {', '.join(sorted(map(str, known)))}"
            raise CampaignError(f"{path}={target}", "--assign", expected, "Correct file and names.")


def _is_required(key: str, kind: str) -> bool:
    return key.startswith("waveform.") and _field(key, kind).is_required() or key == "scene.dem_datum"


def _flights(draft: _Draft, found: _Files, transmitter: str | None) -> list[tuple[str, str, str, list[str]]]:
    """Return the rows of flights.tsv: the transmitter is the node without sidelink, the given or the answered node."""
    rows = []
    for flight in dict.fromkeys(recording.flight for recording in found.recordings):
        own = [recording for recording in found.recordings if recording.flight == flight]
        nodes = [recording.node for recording in own]
        single = [recording.node for recording in own if recording.channels == 1]
        sender = transmitter if transmitter in nodes else None
        if sender is None and len(nodes) > 1 and (len(single) != 1 or own[0].kind in {"beat", "history"}):
            answer = draft.answer(
                Question(("transmitter",), f"node that transmits in {flight}: {', '.join(nodes)}", nodes[0]), nodes
            )
            if answer is None:
                found_, expected = f"nodes {', '.join(nodes)} in {flight}", "the transmitting node"
                raise CampaignError(found_, own[0].path, expected, f"Add --transmitter {nodes[0]}, or another node.")
            sender = answer[0]
        sender = sender or (single[0] if len(nodes) > 1 else nodes[0])
        rows.append((flight, "image", sender, [sender, *(node for node in nodes if node != sender)]))
    return rows


def _lines(found: _Files, flights: Sequence[tuple[str, str, str, list[str]]]) -> Iterable[str]:
    senders = {flight: sender for flight, _, sender, _ in flights}
    for one in found.recordings:
        role = "transmits" if senders[one.flight] == one.node else "receives"
        log = "positions in the file" if _has_positions(one) else f"log {one.log.path.name}" if one.log else "no log"
        count = "" if one.times is None else f", {number_of(len(one.times), 'pulse')}"
        yield f"{one.flight} {one.node} ({role}): {one.path.name}, {one.format}{count}; {log}"
        if one.offset_s is not None:
            hours = f"{one.offset_s / 3600:+g} h"
            yield f"note: the recorder of {one.node} in {one.flight} ran in another time zone: {hours} in config/clocks.tsv"
    used = {id(one.log) for one in found.recordings}
    unused = {log.path: "log of no recording" for log in found.logs if id(log) not in used} | found.unused
    for path, reason in unused.items():
        yield f"not used: {path.name}: {reason}"


def _write_recording(recording: _Recording, stem: Path, draft: _Draft, place: Callable[[Path, Path], None]) -> None:
    stem.parent.mkdir(parents=True, exist_ok=True)
    if recording.kind == "sigmf":
        for source, suffix in zip((recording.files[0], recording.files[-1]), _SIGMF, strict=True):
            place(source, stem.with_name(f"{stem.name}{suffix}"))
    elif recording.kind == "samples":
        data = stem.with_name(f"{stem.name}.sigmf-data")
        place(recording.path, data)
        _write_header(recording, stem, data, draft)
    else:
        suffix = PHASE_HISTORIES[recording.format].suffix
        parts = [file for file in recording.files if not file.name.endswith(".time.npy")]
        for source in parts:
            middle = "" if len(parts) == 1 else f".{re.sub(r'[^A-Za-z0-9_]', '_', source.name.removesuffix(suffix))}"
            place(source, stem.with_name(f"{stem.name}{middle}{suffix}"))
        if recording.format == "beat_npy" and recording.times is not None:
            np.save(stem.with_name(f"{stem.name}.time.npy"), recording.times)
    if recording.log is not None:
        place(recording.log.path, stem.with_name(f"{stem.name}.track{TRACKS[recording.log.format].suffixes[0]}"))


def _write_header(recording: _Recording, stem: Path, data: Path, draft: _Draft) -> None:
    times = recording.times if recording.times is not None else np.zeros(1, "datetime64[ns]")
    starts = (np.arange(len(times)) * _capture_samples(recording)).tolist()
    frames = [None] * len(times) if recording.frames is None else recording.frames.tolist()
    write_meta(
        stem,
        zip(starts, times, frames, strict=True),
        channels=("radar", "sidelink")[: recording.channels],
        dtype=_SAMPLE_TYPES.get(recording.path.suffix, "int16"),
        sha512=hashes_of_file(data, ["sha512"])["sha512"],
        sample_rate_hz=float(draft.values["waveform.sample_rate_hz"]),
        frequency_hz=draft.values.get("waveform.carrier_hz"),
        extra={},
    )


def _place_framing(found: _Files, root: Path, place: Callable[[Path, Path], None]) -> None:
    """Place the preambles that the metadata of continuous recordings name."""
    for recording in found.recordings:
        framing = recording.opened.framing if recording.opened is not None else None
        name = None if framing is None else Path(str(framing["preamble"]))
        source = name and next((path for path in found.arrays if path.name == name.name), None)
        if name is not None and source is not None and not name.is_absolute() and ".." not in name.parts:
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            if not (root / name).exists():
                place(source, root / name)


_FICLONE = 0x40049409  # of ioctl(2): a copy that shares its blocks with the original


def _place(source: Path, target: Path, *, copy: bool) -> None:
    """Put a file or folder into the campaign: as a clone, a hard link, or a copy."""
    if source.is_dir():
        for file in sorted(path for path in source.rglob("*") if path.is_file()):
            inside = target / file.relative_to(source)
            inside.parent.mkdir(parents=True, exist_ok=True)
            _place(file, inside, copy=copy)
        return
    if not copy:
        with suppress(OSError), source.open("rb") as original, target.open("xb") as clone:
            fcntl.ioctl(clone, _FICLONE, original.fileno())
            return
        target.unlink(missing_ok=True)
        with suppress(OSError):
            os.link(source, target, follow_symlinks=True)
            return
    shutil.copyfile(source, target)
