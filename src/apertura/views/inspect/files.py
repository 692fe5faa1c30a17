"""Reports of single files (flight log, recording, phase history, DEM, array), read with settings of the campaign."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config import CLOCKS, CONFIG, read_settings
from apertura.campaign.config.nodes import Log
from apertura.check.facts import (
    METRES,
    PRODUCT_TAG,
    DemFacts,
    HistoryFacts,
    LogFacts,
    RecordingFacts,
    dem_facts,
    history_facts,
    log_facts,
    log_faults,
    recording_facts,
)
from apertura.check.times import LOST_CAPTURE, TimeFacts, inside, own_clock, time_facts, utc
from apertura.common.documents import validated
from apertura.common.errors import CampaignError, number_of, shown
from apertura.core.scene.dem import open_dem
from apertura.formats.names import PHASE_HISTORIES, log_format, log_suffixes
from apertura.formats.npy import read_npy
from apertura.formats.reading import open_recording, read_phase_history, read_track
from apertura.formats.time_tags import read_time_tags
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions, QualityNumbers, TimeSystem
from apertura.views.inspect.report import Report

if TYPE_CHECKING:
    import xarray as xr

    from apertura.formats.recordings.recording import Recording


NODE = "<node>"
"""Placeholder for an unknown node name."""

_KEY = re.compile(r"\bnodes\.\S+?\.log\.(\w+)")
_OPTIONS = {option.name for option in fields(LogOptions)}
_TABLES = {"columns", "scales"}
_TYPED = {
    "columns": "columns.NAME='COLUMN OF THE LOG'",
    "scales": "scales.NAME=FACTOR",
    "quality": f"quality={'|'.join(get_args(QualityNumbers))}",
    "base": "base=LATITUDE,LONGITUDE,HEIGHT",
    "time_system": f"time_system={'|'.join(get_args(TimeSystem))}",
    "start_utc": "start_utc=YYYY-MM-DDTHH:MM:SS",
}
_EXPECTED = f"--set KEY=VALUE, a key of {', '.join(sorted(_OPTIONS))}"


@dataclass(frozen=True)
class Surroundings:
    """Settings for reading a file.

    Attributes
    ----------
    node
        Node name, derived from the file name.
    options
        Options for reading the node's flight log.
    waveform
        Section `waveform` of the campaign's config; empty outside a campaign.
    problem
        Error raised on reading the config; None if the config was read.
    typed
        Options of the log specified with --set.
    logged
        True if the folder contains a flight log of the node.
    aligned
        True if the campaign has a table of clock offsets between recordings and logs.
    """

    node: str
    options: LogOptions = DEFAULT_OPTIONS
    waveform: Mapping[str, Any] = field(default_factory=dict)
    problem: CampaignError | None = None
    typed: Mapping[str, Any] = field(default_factory=dict)
    logged: bool = False
    aligned: bool = False


def surroundings(path: Path, settings: Sequence[str]) -> Surroundings:
    """Return the settings for reading a file; options specified with --set override the config of the campaign.

    Parameters
    ----------
    path
        Absolute path of the file.
    settings
        Settings KEY=VALUE with keys of `LogOptions`: columns.NAME for a column, scales.NAME for the factor of a column.
        A base consists of three numbers separated by commas.

    Raises
    ------
    CampaignError
        If a setting is invalid.
    """
    name = path.name.partition(".track.")[0] if ".track." in path.name else path.name.partition(".")[0]
    typed = _parsed(settings)
    config = path.parents[2] / CONFIG if path.parent.parent.name == "raw" else None
    if config is None or not config.is_file():
        node = name if ".track." in path.name else NODE
        return Surroundings(node, _log(typed).options, typed=typed)
    try:
        stated = read_settings(config)
    except CampaignError as problem:
        return Surroundings(name, _log(typed).options, problem=problem, typed=typed)
    log = stated.nodes[name].log.model_dump() if name in stated.nodes else {}
    return Surroundings(
        name,
        _log(log | typed).options,
        stated.waveform.model_dump(),
        typed=typed,
        logged=any(other.name.startswith(f"{name}.track.") for other in path.parent.iterdir()),
        aligned=(path.parents[2] / CLOCKS).is_file(),
    )


def _log(values: Mapping[str, Any]) -> Log:
    return validated(Log, dict(values), where="--set", expected=_EXPECTED)


def _parsed(settings: Sequence[str]) -> dict[str, Any]:
    parsed: dict[str, Any] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        table, dot, column = key.partition(".")
        if not equals or table not in (_TABLES if dot else _OPTIONS):
            raise CampaignError(setting, "--set", _EXPECTED, "Correct the setting.")
        if dot:
            parsed.setdefault(table, {})[column] = value
        else:
            parsed[key] = value.split(",") if key == "base" else value
    return parsed


def retries(problem: CampaignError) -> list[str]:
    """Suggest options --set for a log that was refused because a key is not configured.

    Examples
    --------
    >>> retries(CampaignError("times of day only", "a.nmea", "key nodes.u.log.start_utc in config.yaml", "Add it."))
    ['set nodes.<node>.log.start_utc in the config; to try a value: --set start_utc=YYYY-MM-DDTHH:MM:SS']
    """
    sentence = f"{problem.found} {problem.expected} {problem.remedy}"
    keys = [key for key in dict.fromkeys(_KEY.findall(sentence)) if key in _OPTIONS]
    return [
        f"set nodes.{NODE}.log.{key} in the config; to try a value: --set {_TYPED.get(key, f'{key}=VALUE')}"
        for key in keys
    ]


ARRAY, DEM = (".npy",), (".tif", ".tiff")
"""File name suffixes."""

FIRST = 128
"""Number of captures, from the first, whose samples are read."""

LISTED = 10
"""Maximum number of gaps that are listed individually; the longest gaps are selected."""

PHASE_HISTORY = "phase_history"
"""`waveform.kind` of formats that contain a description of the transmitted waveform."""

_MOST_SAMPLES = 1 << 21
_MOST_NUMBERS = 1 << 28


def time_rows(times: TimeFacts) -> dict[str, Any]:
    """Return the report rows of time tags: span, rate and gaps."""
    utc_known = times.clock == "UTC"
    rows: dict[str, Any] = {"clock": "UTC" if utc_known else "its own"}
    if utc_known:
        rows |= {"first_utc": utc(times.span[0]), "last_utc": utc(times.span[1])}
    rows |= {"duration_s": times.duration_s, "rate_hz": times.rate_hz, "gaps": int(times.gap_at.size)}
    if times.gap_at.size:
        longest = np.sort(np.argsort(-times.gap_s, kind="stable")[:LISTED])
        rows["lost_in_gaps"] = times.lost
        rows["longest_gaps"] = [
            {"after_s": round(float(times.after_s[gap]), 6), "length_s": round(float(times.gap_s[gap]), 6)}
            for gap in longest
        ]
    return rows


def log_report(path: Path, context: Surroundings) -> Report:
    """Return the report of a flight log.

    Raises
    ------
    CampaignError
        If the file is not a flight log, or if it lacks information that is not given in `LogOptions` either.
    """
    track = read_track(path, node=context.node, options=context.options)
    facts = log_facts(track)
    lacks = _missing_of_log(path, facts, context)
    from apertura.stages.node_log import yaw_fault_of
    from apertura.views.inspect.pictures import draw_log

    if (fault := yaw_fault_of(track)) is not None:
        lacks.append(f"an attitude in degrees, yaw clockwise from north: {fault.line}")
    return Report(
        path,
        "flight log",
        log_format(path, context.options),
        _log_rows(facts, track),
        tuple(lacks),
        picture=lambda: draw_log(track, path.name),
    )


def _log_rows(log: LogFacts, track: "xr.Dataset") -> dict[str, Any]:
    checked = log_faults(track)
    rows: dict[str, Any] = {
        "epochs": log.times.count,
        "excluded": dict(log.dropped),
        **time_rows(log.times),
        "fix": log.fixes,
        "attitude_share": log.attitude_share,
        "frame": log.frame,
        "bounds": dict(log.bounds),
        "length_m": log.length_m,
        "speed_m_s": {"median_m_s": log.median_speed_m_s, "largest_m_s": log.largest_speed_m_s},
        "unusable_epochs": int((~checked.kept).sum()),
        "faults": {name: len(where) for name, where in checked.faults.items()},
        "error_between_epochs_m": checked.interpolation_m,
    }
    if log.stated_std_m is not None:
        rows["stated_std_m"] = list(log.stated_std_m)
    if log.remarks:
        rows["remarks"] = list(log.remarks)
    return rows


def _missing_of_log(path: Path, log: LogFacts, context: Surroundings) -> list[str]:
    lacks, suffixes = [], log_suffixes()
    if context.node == NODE:
        suffix = path.suffix[1:].lower()
        extension = suffix if suffix in suffixes else suffixes[0]
        lacks.append(f"name of the node: copy the log to raw/<flight>/{NODE}.track.{extension}")
    lacks += [
        f"configuration of the option specified with --set: add nodes.{NODE}.log.{key} to config/config.yaml"
        for key in context.typed
    ]
    if not log.has_attitude:
        lacks.append(f"attitude: set nodes.{NODE}.attitude to course, or set lever arms to zero and antennas to null")
    if log.times.gap_at.size:
        lacks.append(f"epochs in {number_of(log.times.gap_at.size, 'gap')}: pulses in gaps may be excluded")
    kinds = log.fixes or {}
    if kinds and not {"fix", "float"} & kinds.keys():
        lacks.append("a carrier-phase solution (RTK or PPK): position errors amount to many wavelengths")
    elif kinds.get("float") or any(name not in {"fix", "float", "not stated"} for name in kinds):
        lacks.append(f"a fixed solution at all epochs: pulses at other epochs are excluded, see nodes.{NODE}.worst_fix")
    if log.fixes is None and log.stated_std_m is None:
        lacks.append(f"position accuracy: the log does not contain it; set nodes.{NODE}.position_std_m")
    return lacks


def recording_report(files: Sequence[Path], context: Surroundings) -> Report:
    """Return the report of a recording.

    Parameters
    ----------
    files
        Files of the recording, in the order of a row of `apertura.formats.names.RECORDERS`.
    context
        Settings for reading the files.

    Raises
    ------
    CampaignError
        If the files are not a recording.
    """
    recording = open_recording(files)
    facts, samples = recording_facts(recording), first_samples(recording)
    parts = samples.view(np.float32)
    peaks = np.abs(parts.reshape(-1, len(recording.channels), 2)).max(axis=(0, 2))
    rms = np.sqrt(np.mean(np.abs(samples.astype(np.complex128)) ** 2, axis=(0, 1)))
    rows = _recording_rows(recording, facts) | {
        "first_captures": {
            name: {"rms": float(level), "largest": float(peak)}
            for name, level, peak in zip(recording.channels, rms, peaks, strict=True)
        }
    }
    from apertura.views.inspect.pictures import draw_recording

    node = files[0].name.removesuffix(files[0].suffix)
    logs = sorted(log for log in files[0].parent.glob("*.track.*") if log.name.startswith(f"{node}.track."))
    lacks = _missing_of_recording(recording, facts, context)
    if logs:
        covered, missing = _against_log(recording, node, logs[0], context)
        rows, lacks = rows | covered, lacks + missing
    else:
        lacks.append(f"antenna positions: the folder contains no flight log {node}.track.<{'|'.join(log_suffixes())}>")
    return Report(
        files[0],
        "recording",
        files[0].suffix.lstrip("."),
        rows,
        tuple(lacks),
        picture=lambda: draw_recording(recording, samples, files[0].name),
    )


def _recording_rows(recording: "Recording", facts: RecordingFacts) -> dict[str, Any]:
    rows: dict[str, Any] = {
        "files": [file.name for file in recording.files],
        "channels": list(facts.channels),
        "sample_rate_hz": facts.sample_rate_hz,
        "carrier_hz": facts.carrier_hz,
        "samples": facts.samples,
        "captures": facts.captures,
        "capture_samples": facts.capture_samples,
    }
    if facts.times is None:
        length_s = facts.samples / facts.sample_rate_hz
        return rows | {"runs_through": True, "first_utc": utc(facts.span[0]), "duration_s": length_s}
    return rows | time_rows(facts.times) | {"frame_numbers": facts.frames}


def first_samples(recording: "Recording") -> NDArray[np.complex64]:
    """Return the first captures (samples of a continuous recording), complex64 (capture, sample, channel)."""
    captures = recording.captures
    each = min(captures.length, _MOST_SAMPLES)
    count = max(1, min(FIRST, len(captures.start), _MOST_SAMPLES // max(each, 1)))
    iq = recording.samples.captures(captures.start[:count], each).astype(np.float32)
    return np.asarray(iq[..., 0] + 1j * iq[..., 1], np.complex64)


def _missing_of_recording(recording: "Recording", facts: RecordingFacts, context: Surroundings) -> list[str]:
    lacks = []
    if not context.waveform:
        prf_hz = facts.times and facts.times.rate_hz
        stated = {"sample_rate_hz": facts.sample_rate_hz, "carrier_hz": facts.carrier_hz, "prf_hz": prf_hz}
        settings = ", ".join(f"{key}: {value:.9g}" for key, value in stated.items() if value)
        suffixes = "|".join(file.suffix for file in recording.files)
        lacks.append(
            f"transmitted waveform: section waveform of config/config.yaml, with {settings}, as in the recording"
        )
        lacks.append(f"a campaign: copy the recording to raw/<flight>/{NODE}{suffixes} of a campaign folder")
    if not facts.carrier_hz:
        lacks.append("the carrier frequency: the recording does not contain it; the configured value is used")
    if facts.captures == 1 and not facts.runs_through:
        lacks.append(
            "pulses: the recording consists of a single capture; write one capture per trigger, or set "
            "apertura:framing if the recording is continuous"
        )
    if own_clock(recording.captures.time):
        lacks.append("UTC times: the recorder has a free-running clock; `apertura align` estimates its offset to UTC")
    return lacks


def _against_log(
    recording: "Recording", node: str, log: Path, context: Surroundings
) -> tuple[dict[str, Any], list[str]]:
    """Return the fraction of a recording covered by the flight log, and a message on captures outside the log."""
    if not log.is_file():  # reading a named pipe or a device would block
        return {}, [f"a readable flight log: {log.name} is not a regular file"]
    try:
        logged = read_track(log, node=node, options=context.options).time.values
    except CampaignError as problem:
        return {}, [f"a readable flight log: {problem}"]
    covered = float(np.mean(inside(recording.captures.time, (logged[0], logged[-1]))))
    rows = {"log_beside": log.name, "captures_inside_log_share": covered}
    if covered == 1.0:
        return rows, []
    first, last = utc(logged[0]), utc(logged[-1])
    clocks = "; `apertura align` estimates a clock offset" if covered == 0 else ""
    return rows, [f"positions for {1 - covered:.1%} of the captures: {log.name} covers {first} to {last}{clocks}"]


def history_report(path: Path, files: Sequence[Path], kind: str, context: Surroundings) -> Report:
    """Return the report of a phase history.

    Parameters
    ----------
    path
        Path of the file or folder.
    files
        The file and its companion file, or all files of the folder.
    kind
        A key of `apertura.formats.names.PHASE_HISTORIES`.
    context
        Settings for reading the files.

    Raises
    ------
    CampaignError
        If there are no files, if the files do not have the format `kind`, or if this format requires the waveform from
        the config of a campaign and there is no config.
    """
    if not files:
        raise CampaignError(f"no {kind} group in the folder", path, "a phase history", "Copy the folder again.")
    described = context.waveform if context.waveform.get("format") == kind else {}
    if PHASE_HISTORIES[kind].waveform != PHASE_HISTORY and not described:
        raise CampaignError(
            "samples without a description of the transmitted waveform",
            path,
            f"raw/<flight>/{path.name} of a campaign whose config sets waveform.format: {kind}",
            "Create a campaign folder with `apertura init` and copy the samples there.",
        )
    echo = _read_history(files, kind, context.node, described)
    facts = history_facts(echo)
    from apertura.views.inspect.pictures import draw_history

    return Report(
        path,
        "phase history",
        kind,
        _history_rows(facts),
        tuple(_missing_of_history(facts, kind, context)),
        picture=lambda: draw_history(echo, path.name),
    )


def _read_history(files: Sequence[Path], kind: str, node: str, described: Mapping[str, Any]) -> "xr.Dataset":
    """Return the `echo` stage of a phase history, read as monostatic or, if this fails, as bistatic."""
    try:
        return read_phase_history(kind, files, pair=f"{node}-{node}", described=described)
    except CampaignError as problem:
        try:
            return read_phase_history(kind, files, pair=f"tx-{node}", described=described)
        except CampaignError:
            raise problem from None


def _history_rows(facts: HistoryFacts) -> dict[str, Any]:
    rows: dict[str, Any] = {"pulses": facts.times.count, "frequencies": facts.frequencies, "band_hz": facts.band_hz}
    if facts.resolution_m is not None:
        rows |= {"resolution_of_path_m": facts.resolution_m, "unambiguous_path_m": facts.unambiguous_m}
    rows |= {"clock": "none, pulses are counted"} if facts.times.clock == "none" else time_rows(facts.times)
    if facts.frame is not None:
        rows |= {"frame": facts.frame, "bistatic": facts.bistatic}
        rows |= {f"{leg}_bounds": dict(bounds) for leg, bounds in facts.bounds.items()}
    rows |= {"excluded": dict(facts.dropped), "flags": dict(facts.flags)}
    return rows | ({"remarks": list(facts.remarks)} if facts.remarks else {})


def _missing_of_history(facts: HistoryFacts, kind: str, context: Surroundings) -> list[str]:
    lacks = []
    if facts.frame is None and not context.logged:
        suffixes = "|".join(log_suffixes())
        lacks.append(f"antenna positions: a flight log {NODE}.track.<{suffixes}> for each antenna in the same folder")
    if facts.frame is None and not context.aligned and facts.times.clock != "UTC":
        lacks.append("UTC times: the recorder has a free-running clock; `apertura align` estimates its offset to UTC")
    if not context.waveform:
        lacks.append(f"a campaign: a campaign folder whose config sets waveform.format: {kind}")
    return lacks


def dem_report(path: Path) -> Report:
    """Return the report of an elevation raster or of a product of apertura.

    Raises
    ------
    CampaignError
        If the file is not a GeoTIFF.
    """
    facts = dem_facts(path)
    left, bottom, right, top = facts.bounds
    is_product = PRODUCT_TAG in facts.tags
    rows: dict[str, Any] = _product_rows(facts) if is_product else {}
    rows |= {
        "pixels" if is_product else "posts": f"{facts.posts[0]} × {facts.posts[1]}",
        "crs": shown(facts.crs or "none", 200),
        "x": f"{left:.9g} to {right:.9g}",
        "y": f"{bottom:.9g} to {top:.9g}",
        "spacing": f"{facts.spacing[0]:.6g} × {facts.spacing[1]:.6g} {facts.unit}",
        "bands": facts.bands,
        "type": facts.dtype,
    }
    if is_product:
        return Report(path, "product of apertura", "", rows)
    heights = facts.heights
    if heights is not None:
        finite = heights[np.isfinite(heights)]
        ends = [float(finite.min()), float(finite.max())] if finite.size else None
        if facts.values_unit.lower() in METRES:
            rows["height_m"] = ends
        else:
            rows["height"] = None if ends is None else f"{ends[0]:.2f} to {ends[1]:.2f} {shown(facts.values_unit, 40)}"
        rows["posts_without_height_share"] = 1 - finite.size / max(heights.size, 1)
    try:
        open_dem(path, "a scene on Earth")
        lacks: tuple[str, ...] = ()
    except CampaignError as problem:
        lacks = (f"{problem.found}; expected {problem.expected}. If the datum is missing, set scene.dem_datum",)
    from apertura.views.inspect.pictures import draw_heights

    picture = (
        None
        if heights is None
        else (lambda: draw_heights(heights, facts.bounds, path.name, unit=facts.values_unit or "m"))
    )
    return Report(path, "elevation model", "", rows, lacks, picture=picture)


def _product_rows(facts: DemFacts) -> dict[str, Any]:
    """Return the report rows of a product of apertura, computed from its GeoTIFF tags."""
    tags = facts.tags
    rows = {
        "title": tags.get("TIFFTAG_IMAGEDESCRIPTION", ""),
        "values": f"{facts.description} ({facts.values_unit or 'no unit'})",
        "flags": ", ".join(_tag(tags, "APERTURA_FLAGS", dict)) or "none",
        "focus": str(_tag(tags, "APERTURA_FOCUS", dict).get("verdict", "")),
        "numerical_error": f"{tags['APERTURA_ERROR_DB']} dB" if "APERTURA_ERROR_DB" in tags else "",
        "version": tags[PRODUCT_TAG],
        "code": tags.get("APERTURA_CODE_SHA256", "")[:12],
    }
    return {name: shown(value, 200) for name, value in rows.items() if value}


def _tag(tags: Mapping[str, str], name: str, kind: type) -> Any:
    """Return the JSON value of a tag, or an empty value of type `kind` if the tag has another type."""
    try:
        value = json.loads(tags.get(name, "null"))
    except ValueError:
        value = None
    return value if isinstance(value, kind) else kind()


def time_tags_report(path: Path) -> Report:
    """Return the report of a file of time tags.

    Raises
    ------
    CampaignError
        If a line is not a time, or times do not increase.
    """
    times, frames = read_time_tags(path)
    rows = {
        "tags": len(times),
        **time_rows(time_facts(times, longer=LOST_CAPTURE)),
        "frame_numbers": frames is not None,
    }
    lacks = ("the samples: a recording without header and its time tags become a campaign with `apertura init`",)
    return Report(path, "time tags", "", rows, lacks)


def array_report(path: Path) -> Report:
    """Return the report of a .npy file; a complex vector is reported as code symbols.

    Raises
    ------
    CampaignError
        If the file is not a .npy file, or contains no numbers.
    """
    expected = f"a .npy file of at most {_MOST_NUMBERS} numbers"
    array = read_npy(path, kinds="biufc", most=_MOST_NUMBERS, expected=expected, remedy="Save the array again.")
    sizes = np.abs(array[np.isfinite(array)]) if array.size else np.zeros(0)
    rows = {
        "shape": [int(side) for side in array.shape],
        "type": str(array.dtype),
        "amplitude": [float(sizes.min()), float(sizes.max())] if sizes.size else None,
        "not_finite": int(array.size - sizes.size),
    }
    return Report(path, "code symbols" if array.ndim == 1 and array.dtype.kind == "c" else "array", "", rows)
