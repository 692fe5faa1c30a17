"""Recognition of recordings, logs and other files for `apertura init`, by the readers of `apertura inspect`."""

import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config.template import WAVEFORMS
from apertura.check.facts import LogFacts
from apertura.check.times import Span, own_clock
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.formats.names import PHASE_HISTORIES, recording_files
from apertura.formats.phase_histories.fmcw import read_fields, times_of
from apertura.formats.phase_histories.fmcw_fields import read_beat_fields, read_wav
from apertura.formats.reading import open_recording, read_phase_history
from apertura.formats.recordings.recording import Recording
from apertura.formats.time_tags import read_time_tags
from apertura.views.inspect.files import first_samples
from apertura.views.inspect.path import look

MOST_FILES = 10_000
"""Largest number of files in the given folders."""

MOST_CAPTURES = 32
"""Number of captures, from the first, from which the structure of a recording is estimated."""

TYPES = {".cf32": "float32", ".fc32": "float32", ".cfile": "float32", ".cs8": "int8", ".sc8": "int8"}
"""Suffix of samples without header → type of I and Q; other suffixes: int16."""

_COVERED = 0.5  # smallest fraction of a recording that its log, or another recording of the flight, covers


@dataclass(eq=False)
class FoundLog:
    """Flight log; `track` and `facts` are None until it is read with `options`, values of `nodes.<n>.log`."""

    path: Path
    format: str
    track: Any = None
    facts: LogFacts | None = None
    options: dict[str, Any] = field(default_factory=dict)

    def covers(self, span: Span | None, shift_s: float = 0.0) -> bool:
        """Return True if the log covers most of a shifted time span."""
        if self.facts is None or span is None:
            return False
        shift = np.timedelta64(round(shift_s * 1e9), "ns")
        return overlap((span[0] + shift, span[1] + shift), self.facts.times.span)


def overlap(span: Span, other: Span) -> bool:
    """Return True if most of a time span is inside another time span.

    Examples
    --------
    >>> hours = np.datetime64("2025-05-14T09", "ns") + np.arange(4) * np.timedelta64(1, "h")
    >>> overlap((hours[1], hours[3]), (hours[0], hours[2])), overlap((hours[2], hours[3]), (hours[0], hours[1]))
    (True, False)
    """
    common = min(span[1], other[1]) - max(span[0], other[0])
    return bool(common >= np.timedelta64(0, "ns") and common >= _COVERED * (span[1] - span[0]))


@dataclass(eq=False)
class FoundRecording:
    """Recording of a node in a flight.

    Attributes
    ----------
    kind
        sigmf, samples (without header), beat (FMCW) or history.
    format
        waveform.format of beat signals and phase histories.
    files
        Main file first.
    times, frames
        Time and frame number of each pulse, if known.
    content
        `Recording`, samples in an array (capture, sample, channel, 2), array of beat signals, contents of a sound
        file, or `echo` stage.
    channels
        Number of channels; 0 for samples without header before the number is estimated.
    flight, node, log, zone_s
        Results of the assignment; `zone_s` is the difference between the time zones of log and recorder.
    """

    kind: str
    format: str
    files: tuple[Path, ...]
    times: Times | None = None
    frames: NDArray[np.int64] | None = None
    content: Any = None
    channels: int = 1
    flight: str = ""
    node: str = ""
    log: FoundLog | None = None
    zone_s: float | None = None

    @property
    def path(self) -> Path:
        """Main file."""
        return self.files[0]

    @property
    def span(self) -> Span | None:
        """First and last time in UTC; None without UTC."""
        if self.times is None or own_clock(self.times):
            return None
        end = self.times[-1]
        if isinstance(self.content, Recording) and self.content.framing is not None:
            end += np.timedelta64(round(len(self.content.samples) / self.content.sample_rate_hz * 1e9), "ns")
        return self.times[0], end

    @property
    def has_positions(self) -> bool:
        """True for a phase history with antenna positions."""
        return self.kind == "history" and "tx_position" in self.content

    @property
    def is_triggered(self) -> bool:
        """True for sampled pulses with one capture each."""
        return self.kind == "samples" or (self.kind == "sigmf" and self.content.framing is None)

    def numbers(self) -> NDArray[np.complexfloating]:
        """Return the first captures in the order of the file, (capture, number) complex."""
        if isinstance(self.content, Recording):
            samples = first_samples(self.content)[:MOST_CAPTURES]
            return samples.reshape(len(samples), -1)
        stored = self.content
        if stored is None:
            kind, captures = (
                np.dtype(TYPES.get(self.path.suffix, "int16")).newbyteorder("<"),
                0 if self.times is None else len(self.times),
            )
            stored = np.memmap(self.path, kind, "r").reshape(captures, -1, 2)
        stored = stored[:MOST_CAPTURES].astype(np.float32).reshape(min(len(stored), MOST_CAPTURES), -1, 2)
        return np.asarray(stored[..., 0] + 1j * stored[..., 1])

    def sent(self, signal: NDArray[np.complexfloating]) -> NDArray[np.complexfloating]:
        """Return the signal of the first captures: of a table of codes, the rows of their frames."""
        if signal.ndim == 1:
            return signal
        count = len(self.numbers())
        known = self.frames is not None and len(self.frames) >= count and (self.frames[:count] >= 0).all()
        frames = self.frames[:count] if known and self.frames is not None else np.arange(count)
        return np.asarray(signal[frames % len(signal)], np.complex128)


@dataclass
class Found:
    """Recognised files; `unused` contains the reason for each file that is not used."""

    recordings: list[FoundRecording] = field(default_factory=list)
    logs: list[FoundLog] = field(default_factory=list)
    tags: list[Path] = field(default_factory=list)
    arrays: dict[Path, NDArray[Any]] = field(default_factory=dict)
    dems: list[Path] = field(default_factory=list)
    unused: dict[Path, str] = field(default_factory=dict)


def words(path: Path) -> list[str]:
    """Return the words of a file name in lower case.

    Examples
    --------
    >>> words(Path("day1/Alpha_GNSS-2.nmea"))
    ['alpha', 'gnss', '2']
    """
    return [word for word in re.split(r"[^a-z0-9]+", path.name.partition(".")[0].lower()) if word]


def likest(path: Path, others: Iterable[Path]) -> list[Path]:
    """Return the files whose names have the most words in common with the name of a file; ties give several."""
    common = {other: len({*words(other)} & {*words(path)}) + (other.parent == path.parent) for other in others}
    return [other for other, count in common.items() if count == max(common.values())]


def recognised(files: Iterable[Path]) -> Found:
    """Sort files by their content.

    Parameters
    ----------
    files
        Files and folders.

    Raises
    ------
    CampaignError
        If a file does not exist, or a file that is named itself, or a recording, cannot be read.
    """
    found, listed, headerless = Found(), _listed(files), list[Path]()
    for path, is_named in listed.items():
        main = {path.with_suffix(".sigmf-meta"), path.with_name(path.name.removesuffix(".time.npy") + ".npy")}
        if path.name.endswith((".sigmf-data", ".time.npy")) and main & listed.keys():
            continue  # second file of a recording
        problem = _add(found, path)
        if problem is not None and _is_binary(path):
            headerless.append(path)
        elif problem is not None and (is_named or path.suffix == ".sigmf-meta"):
            raise problem
        elif problem is not None:
            found.unused[path] = problem.found
    if any(array.ndim == 1 and array.dtype.kind == "c" for array in found.arrays.values()):  # a transmitted signal
        complex_beats = [one for one in found.recordings if one.kind == "beat" and one.path.suffix == ".npy"]
        complex_beats = [one for one in complex_beats if one.times is None and one.content.dtype == np.complex64]
        found.recordings = [one for one in found.recordings if one not in complex_beats]
        found.arrays |= {one.path: one.content for one in complex_beats}
    headerless += [
        path for path, array in found.arrays.items() if path.name != _CODES and _samples_of(array) is not None
    ]
    for path in headerless:
        try:
            found.recordings.append(_headerless(path, found.arrays.pop(path, None), found.tags))
        except CampaignError as problem:
            if listed[path]:
                raise
            found.unused[path] = problem.found
    return found


_CODES = "codes.npy"


def _samples_of(array: NDArray[Any]) -> NDArray[Any] | None:
    """Return recorded samples as (capture, sample, channel, 2), a view of an array; None for other arrays."""
    if array.dtype == np.complex64 and array.ndim in {2, 3} and array.flags.c_contiguous:
        array = array.view(np.float32).reshape(*array.shape, 2)
    if array.dtype.str not in {"|i1", "<i2", "<i4", "<f4"} or array.shape[-1:] != (2,) or not array.flags.c_contiguous:
        return None
    return array[:, :, None] if array.ndim == 3 else array if array.ndim == 4 and array.shape[2] <= 2 else None


def _listed(files: Iterable[Path]) -> dict[Path, bool]:
    """Return the files, and those in folders, with True for files that are named themselves."""
    listed: dict[Path, bool] = {}
    for path in files:
        if not path.exists():
            raise CampaignError("no such file or folder", path, "recordings and flight logs", "Correct the path.")
        is_folder = path.is_dir() and path.suffix != ".zarr"
        for entry in sorted(path.rglob("*")) if is_folder else [path]:
            parts = entry.relative_to(path).parts
            is_part = any(Path(part).suffix == ".zarr" for part in parts[:-1]) or any(part[0] == "." for part in parts)
            if not is_part and (entry.is_file() or entry.suffix == ".zarr"):
                listed.setdefault(entry, not is_folder)
        if len(listed) > MOST_FILES:
            found, expected = f"more than {MOST_FILES} files", f"at most {MOST_FILES} files"
            raise CampaignError(found, path, expected, "Name the folders of one campaign.")
    return listed


def _add(found: Found, path: Path) -> CampaignError | None:
    """Add a file to `found`; return the problem of a file that cannot be used."""
    array = _mapped(path) if path.suffix == ".npy" else None
    is_table = path.name == _CODES and array is not None and array.ndim == 2  # code symbols of many frames
    beat = None if is_table else _beat(path, array)
    if beat is not None:
        found.recordings.append(beat)
        return None
    if array is not None and (is_table or (array.ndim > 2 and _samples_of(array) is not None)):
        found.arrays[path] = array  # of any size, as it is not read
        return None
    report = look(path)
    if report.kind == "flight log" and (report.problem is None or log_key(report.problem)):
        found.logs.append(FoundLog(path, report.format))
    elif report.problem is not None:
        return report.problem
    elif report.kind == "recording":
        opened = open_recording(recording_files(path.parent, path.name.removesuffix(path.suffix)))
        captures, channels = opened.captures, len(opened.channels)
        frames = captures.frame if opened.framing is None else None
        found.recordings.append(FoundRecording("sigmf", "SigMF", opened.files, captures.time, frames, opened, channels))
    elif report.kind == "phase history":
        _add_history(found, path, report.format, is_bistatic=bool(report.facts.get("bistatic")))
    elif report.kind == "time tags":
        found.tags.append(path)
    elif report.kind in {"code symbols", "array"}:
        found.arrays |= {} if array is None else {path: array}
    elif report.kind == "elevation model":
        found.dems.append(path)
    else:
        expected = "recordings, flight logs, time tags, the transmitted signal or a DEM"
        return CampaignError(f"a file of kind {report.title}", path, expected, "Leave out this file.")
    return None


def _is_binary(path: Path) -> bool:
    with path.open("rb") as stream:
        return path.suffix not in {".sigmf-meta", ".npy", ".pdf"} and b"\0" in stream.read(1 << 16)


_LOG_KEY = re.compile(r"\bkey nodes\.\S+?\.log\.(\w+)")


def log_key(problem: CampaignError) -> str:
    """Return the key of `nodes.<n>.log` that a reader requires; empty for other problems.

    Examples
    --------
    >>> log_key(CampaignError("times of day only", "a.nmea", "key nodes.u.log.start_utc in config.yaml", "Add it."))
    'start_utc'
    """
    match = _LOG_KEY.search(problem.expected)
    return match[1] if match else ""


def _mapped(path: Path) -> NDArray[Any] | None:
    with suppress(Exception):  # numpy evaluates the header of an array, and a malformed header may raise any exception
        array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
        return array
    return None


def _beat(path: Path, array: NDArray[Any] | None) -> FoundRecording | None:
    """Return a recording of beat signals, (sweep, sample); None for other contents."""
    beside = path.with_name(path.name.removesuffix(".npy") + ".time.npy")
    if array is not None and array.ndim == 2 and array.shape[1] >= 8 and array.dtype.kind in "fiuc":
        stored = _mapped(beside)
        times = None if stored is None else times_of(np.asarray(stored), beside)
        return FoundRecording("beat", "beat_npy", (path,), times, content=array)
    with suppress(CampaignError):
        if path.suffix == ".wav":
            return FoundRecording("beat", "beat_wav", (path,), content=next(iter(read_fields(read_wav, [path])))[1])
        if path.suffix == ".mat":
            fields = next(iter(read_fields(read_beat_fields, [path])))[1]
            times = times_of(fields["time"], path) if "time" in fields else None
            return FoundRecording("beat", "beat_mat", (path,), times, content=fields["beat"])
    return None


def _add_history(found: Found, path: Path, name: str, *, is_bistatic: bool) -> None:
    """Add a phase history; files with positions but without a clock are parts of one recording."""
    files = [path] if path.is_dir() else PHASE_HISTORIES[name].files_of(path)
    described = {key: option.default for key, option in WAVEFORMS["phase_history"].model_fields.items()}
    pair = "a-b" if is_bistatic else "a-a"
    echo = read_phase_history(name, PHASE_HISTORIES[name].files_of(path), pair=pair, described=described)
    recording = FoundRecording("history", name, tuple(files), echo.time.values, content=echo)
    if recording.has_positions and recording.span is None:
        for other in found.recordings:
            if other.format == name and other.span is None and other.path.parent == path.parent:
                other.files += recording.files
                return
    found.recordings.append(recording)


def _headerless(path: Path, array: NDArray[Any] | None, tags: Iterable[Path]) -> FoundRecording:
    """Return a recording of samples without header or in an array, with the only suitable file of time tags."""
    size, samples = path.stat().st_size, None if array is None else _samples_of(array)
    each = 2 * np.dtype(TYPES.get(path.suffix, "int16")).itemsize
    read = {tag: read_time_tags(tag) for tag in tags}
    fits = {
        tag: size % (each * len(times)) == 0 if samples is None else len(times) == len(samples)
        for tag, (times, _) in read.items()
    }
    fitting = likest(path, [tag for tag in read if fits[tag]])
    if len(fitting) != 1:
        which = " and ".join(tag.name for tag in fitting) or "none whose number of tags divides the size"
        raise CampaignError(
            f"{size} bytes without a header; files of time tags: {which}",
            path,
            "one file of time tags with the name of the recording and a line per capture; or SigMF",
            f"Add {path.stem}_tags.txt with the UTC of each capture.",
        )
    channels = 0 if samples is None else samples.shape[2]
    return FoundRecording("samples", "samples without header", (path,), *read[fitting[0]], samples, channels)
