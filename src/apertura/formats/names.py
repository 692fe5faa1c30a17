"""Tables of recorders, flight logs and phase histories: recognition of the format of a file, and its reader.

Rows refer to readers lazily: looking up a file name does not import a reader, and the code hash of a result
(`apertura.workflow.lineage`) covers only the readers used by its campaign. A new format requires one module with its
reader and one row in this module.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from apertura.common.atomic import naming
from apertura.common.errors import CampaignError, quoted
from apertura.common.lazy import Lazy
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions

_RECORDINGS = Lazy("apertura.formats.recordings")
_TRACKS = Lazy("apertura.formats.tracks")
_HISTORIES = Lazy("apertura.formats.phase_histories")

RECORDERS: Mapping[tuple[str, ...], Callable[..., Any]] = {(".sigmf-meta", ".sigmf-data"): _RECORDINGS.sigmf.open_sigmf}
"""Suffixes of the files of a recording, <node><suffix>, metadata first, samples last → opener(*files) → `Recording`."""

FINDERS: Mapping[tuple[str, ...], Callable[..., Any]] = {
    (".sigmf-meta", ".sigmf-data"): _RECORDINGS.sigmf.find_sigmf,
}
"""Row of `RECORDERS` → finder(folder, node) → files, for formats whose metadata may contain file names that differ from
<node><suffix>."""

GROWING: Mapping[tuple[str, ...], Callable[..., Any]] = {
    (".sigmf-meta", ".sigmf-data"): _RECORDINGS.sigmf.GrowingSigmf,
}
"""Row of `RECORDERS` that is readable while it is written → class(*files) whose read() returns complete captures."""


class LogFormat(NamedTuple):
    """Recognition and reader of a flight log."""

    suffixes: tuple[str, ...]
    """Suffixes of <node>.track.*"""
    reader: Callable[..., Any]
    """reader(path, node=, options=) → `track`."""
    heading: str = ""
    """Text in the first 8 KiB that distinguishes the format from others with the same suffix; empty: any text."""
    by_lines: bool = False
    """True if epochs are lines of text, so that a log that is being written is valid up to its last complete line."""


TRACKS: Mapping[str, LogFormat] = {
    "airdata": LogFormat((".csv",), _TRACKS.airdata.read_airdata, "time(millisecond),datetime(utc)", True),
    "optitrack": LogFormat((".csv",), _TRACKS.optitrack.read_optitrack, "Format Version,1.", True),
    "csv": LogFormat((".csv",), _TRACKS.csv_track.read_csv_track, by_lines=True),
    "nmea": LogFormat((".nmea", ".txt"), _TRACKS.nmea.read_nmea, "$", True),
    "px4": LogFormat((".ulg",), _TRACKS.px4_ulog.read_px4_ulog),
    "ardupilot": LogFormat((".bin", ".log"), _TRACKS.ardupilot.read_ardupilot, heading="FMT"),
    "rtklib": LogFormat((".pos",), _TRACKS.rtklib.read_rtklib_pos, by_lines=True),
}
"""Name of a format → its recognition and reader; the first format that matches a file is used."""

_HEADING_BYTES = 8192


class HistoryFormat(NamedTuple):
    """Reader of a phase history."""

    suffix: str
    """Suffix of <node>.*, or of the folder <node>."""
    reader: Callable[..., Any]
    """reader(paths, pair=) → `echo`, without tx_position and rx_position if these come from flight logs.

    For a folder, `paths` are all its files.
    """
    described: bool = False
    """True if the reader also has the parameter described=, the section `waveform` of the config."""
    frame: str = ""
    """Frame of the positions, local or ecef; empty: given in the files or a flight log."""
    waveform: str = "phase_history"
    """waveform.kind of the format."""
    beside: str = ""
    """Ending of a second file <stem><beside> next to <stem><suffix>; empty: none."""

    def files_of(self, path: Path) -> list[Path]:
        """List the files of the phase history to which a file or folder belongs, main file first."""
        if path.is_dir():
            return sorted(file for file in path.rglob("*") if file.is_file())
        if not self.beside:
            return [path]
        stem = path.name.removesuffix(self.beside if path.name.endswith(self.beside) else self.suffix)
        return [file for file in (path.with_name(stem + end) for end in (self.suffix, self.beside)) if file.is_file()]


PHASE_HISTORIES: Mapping[str, HistoryFormat] = {
    "afrl_mat": HistoryFormat(".mat", _HISTORIES.afrl.read_afrl_mat, described=True, frame="local"),
    "pulson": HistoryFormat(".out", _HISTORIES.pulson.read_pulson),
    "cphd": HistoryFormat(".cphd", _HISTORIES.cphd.read_cphd, described=True),
    "hdf5": HistoryFormat(".h5", _HISTORIES.hdf5_history.read_hdf5_history),
    "zarr": HistoryFormat(".zarr", _HISTORIES.zarr_history.read_zarr_history),
    "beat_npy": HistoryFormat(
        ".npy",
        _HISTORIES.fmcw.read_beat_npy,
        described=True,
        waveform="fmcw",
        beside=".time.npy",
    ),
    "beat_mat": HistoryFormat(".mat", _HISTORIES.fmcw.read_beat_mat, described=True, waveform="fmcw"),
    "beat_wav": HistoryFormat(".wav", _HISTORIES.fmcw.read_beat_wav, described=True, waveform="fmcw"),
}
"""waveform.format → its reader."""


def recording_files(folder: Path, node: str) -> tuple[Path, ...]:
    """Return the files of a node's recording, in the format present in the folder (default: the first format).

    Raises
    ------
    CampaignError
        If file names are stated in metadata that cannot be read.
    """
    present = (row for row in RECORDERS if any((folder / f"{node}{suffix}").is_file() for suffix in row))
    row = next(present, next(iter(RECORDERS)))
    if row in FINDERS:
        files: tuple[Path, ...] = FINDERS[row](folder, node)
        return files
    return tuple(folder / f"{node}{suffix}" for suffix in row)


def log_format(path: Path, options: LogOptions = DEFAULT_OPTIONS) -> str:
    """Determine the format of a log, a key of `TRACKS`: as configured, otherwise by suffix and first bytes.

    Raises
    ------
    CampaignError
        If no format matches.
    """
    if options.format in TRACKS:
        return str(options.format)
    suffix = path.suffix.lower()
    known = {name: row for name, row in TRACKS.items() if suffix in row.suffixes}
    if any(row.heading for row in known.values()):
        with naming(path), path.open("rb") as stream:
            first_text = stream.read(_HEADING_BYTES).decode("utf-8", errors="replace")
        known = {name: row for name, row in known.items() if row.heading in first_text}
    if options.format is None and known:
        return next(iter(known))
    headings = [repr(row.heading) for row in TRACKS.values() if suffix in row.suffixes]
    found = f"a flight log with suffix {path.suffix!r}"
    if headings:
        found += f" without {' or '.join(headings)} in its first {_HEADING_BYTES} bytes"
    raise CampaignError(
        found if options.format is None else f"format {quoted(options.format)}",
        where=path,
        expected=f"<node>.track.<{'|'.join(log_suffixes())}>; formats {', '.join(TRACKS)}",
        remedy="Convert the log, or write a reader for it.",
    )


def log_suffixes() -> list[str]:
    """Return the possible endings of <node>.track.*, without the dot.

    Examples
    --------
    >>> "csv" in log_suffixes()
    True
    """
    return sorted({suffix[1:] for row in TRACKS.values() for suffix in row.suffixes})
