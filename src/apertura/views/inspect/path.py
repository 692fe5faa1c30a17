"""`apertura inspect`: identify a file by the first reader that matches its name or first bytes, and reads the file."""

import json
import logging
import stat
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apertura.campaign.folder import Campaign
from apertura.check import as_line, load, problems_of
from apertura.check.examination import Examination, Key
from apertura.check.times import LOST_CAPTURE, Span, TimeFacts, inside, time_facts
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError, explained, quoted, shown
from apertura.formats.names import (
    PHASE_HISTORIES,
    RECORDERS,
    TRACKS,
    log_format,
    log_suffixes,
    recording_files,
)
from apertura.formats.reading import read_phase_history
from apertura.formats.signatures import log_by_content
from apertura.formats.time_tags import are_time_tags
from apertura.views.inspect.files import Surroundings, retries, surroundings
from apertura.views.inspect.report import Report, print_report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_FILES = 100
"""Maximum number of files of a folder that are inspected."""

_HEAD_BYTES = 16

Reader = Callable[[], Report]


def inspect_path(
    path: Path,
    settings: Sequence[str] = (),
    *,
    name: Path | None = None,
    plot: Path | None = None,
    as_json: bool = False,
) -> int:
    """Print the report of a file or folder; return 0, or 2 if no reader can read the file.

    Parameters
    ----------
    path
        Absolute path.
    name
        Name to print; None to print the path.
    settings
        Settings KEY=VALUE with keys of `apertura.formats.tracks.log_options.LogOptions`.
    plot
        File name, with suffix .png, of a preview to be drawn.
    as_json
        Print JSON.

    Raises
    ------
    CampaignError
        If the path does not exist, a setting is invalid, or `plot` has another suffix or is an existing file that is
        not a PNG image.
    """
    is_own_png = plot is None or (plot.suffix.lower() == ".png" and plot != path)
    if plot is not None and is_own_png and plot.exists():
        with plot.open("rb") as stream:
            is_own_png = stream.read(8) == b"\x89PNG\r\n\x1a\n"
    if plot is not None and not is_own_png:
        found = "an existing file that is not a PNG image" if plot.exists() else "a suffix other than .png"
        raise CampaignError(found, f"--plot {plot}", "the name of a new .png file", "Choose another name.")
    logging.getLogger("apertura.common.errors").addHandler(
        logging.NullHandler()
    )  # the report contains the readers' remarks, which would otherwise be printed as warnings
    report = look(path, settings)
    drawn = None if plot is None or report.picture is None else _drawn(report.picture(), plot)
    if as_json:
        print(json.dumps(report.as_json() | {"plot": drawn and str(drawn)}, indent=1, allow_nan=False))
    else:
        print_report(report, name if report.path == path else None)
        if plot is not None:
            print(shown(drawn, 400) if drawn else "no plot: there is no preview for this file")
    return 2 if report.problem else 0


def _drawn(figure: "Figure", plot: Path) -> Path:
    """Write a plot as PNG; return the path of the file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from apertura.common.atomic import replacement

    FigureCanvasAgg(figure)
    with replacement(plot) as temporary:
        figure.savefig(temporary, format="png", dpi=110, metadata={"Software": None})
    return plot


def look(path: Path, settings: Sequence[str] = ()) -> Report:
    """Identify a file or folder and return its report.

    Parameters
    ----------
    path
        Absolute path.
    settings
        Options KEY=VALUE for information that a flight log does not contain.

    Raises
    ------
    CampaignError
        If the path does not exist or a setting is invalid; errors in a file's contents are part of the report.
    """
    try:
        mode = path.stat().st_mode
    except OSError as error:
        found = shown(error.strerror or "not found")
        raise CampaignError(found, path, "a file or folder", "Correct the path.") from None
    if stat.S_ISDIR(mode):
        return _folder(path, settings)
    if not stat.S_ISREG(mode):
        raise CampaignError("not a regular file or folder", path, "a file or folder", "Copy its content to a file.")
    return _file(path, surroundings(path, settings))


def _folder(path: Path, settings: Sequence[str]) -> Report:
    if any(path.name.endswith(row.suffix) for row in PHASE_HISTORIES.values()):
        return _file(path, surroundings(path, settings))
    if (path / "config").is_dir() or (path / "raw").is_dir():
        return campaign_report(path)
    files = sorted(entry for entry in path.iterdir() if entry.is_file() and not entry.name.startswith("."))
    parts: dict[Path, Report] = {}
    for file in files[:MOST_FILES]:
        part = _file(file, surroundings(file, settings))
        parts.setdefault(part.path, part)  # all files of a recording give the same report
    more: tuple[str, ...] = ()
    if len(files) > MOST_FILES:
        more = (f"{len(files) - MOST_FILES} more files were not inspected; inspect these files individually",)
    columns = ("first_utc", "duration_s", "rate_hz", "gaps")
    return Report(path, "folder", "", {"files": len(files)}, more, parts=tuple(parts.values()), columns=columns)


def _file(path: Path, context: Surroundings) -> Report:
    """Return the report of the first reader that reads a file; if none does, the error of the first matching reader."""
    refused: list[Report] = []
    for kind, name, read in _readers(path, context):
        try:
            return _with_config(read(), context)
        except Exception as error:  # any exception of a reader is reported as a problem of the file
            refused.append(Report(path, kind, name, _size(path), problem=_as_problem(error, path)))
    if not refused:
        return _unknown(path)
    first = refused[0]
    others = [f"also refused as {other.title}: {other.problem.found}" for other in refused[1:] if other.problem]
    advice = retries(first.problem) if first.problem else []
    return _with_config(replace(first, missing=(*advice, *others)), context)


def _with_config(report: Report, context: Surroundings) -> Report:
    if context.problem is None:
        return report
    return replace(report, missing=(*report.missing, f"a valid config: {context.problem}"))


def _as_problem(error: Exception, path: Path) -> CampaignError:
    if isinstance(error, CampaignError):
        return error
    explanation = explained(error)
    found = explanation or f"the reader failed: {type(error).__name__}: {error}"
    remedy = "Check whether the file is damaged; if not, report an internal error of apertura."
    return CampaignError(found, path, "an undamaged file", remedy)


def _readers(path: Path, context: Surroundings) -> Iterator[tuple[str, str, Reader]]:
    """Yield kind, format and reader of each format that matches the name, or only of the configured format."""
    stated = "" if "format" in context.typed or ".track." in path.name else str(context.waveform.get("format", ""))
    if stated in PHASE_HISTORIES and path.name.endswith(PHASE_HISTORIES[stated].suffix):
        yield "phase history", stated, partial(_history, path, stated, context)
        return  # the campaign reads the file in the configured format, even if other readers match
    from apertura.views.inspect.files import ARRAY, DEM, array_report, dem_report

    if "format" not in context.typed:
        for row in RECORDERS:
            suffix = next((suffix for suffix in row if path.name.endswith(suffix)), None)
            if suffix is not None:
                yield "recording", row[0].lstrip("."), partial(_recording, path, suffix, context)
        for name, history in PHASE_HISTORIES.items():
            if path.name.endswith(history.suffix):
                yield "phase history", name, partial(_history, path, name, context)
    if path.is_file():
        yield from _text_readers(path, context)
    if path.suffix.lower() in DEM:
        yield "elevation model", "", partial(dem_report, path)
    if path.suffix in ARRAY:
        yield "array", "", partial(array_report, path)


def _text_readers(path: Path, context: Surroundings) -> Iterator[tuple[str, str, Reader]]:
    """Yield the reader of a flight log, by suffix or else by content, and of time tags."""
    from apertura.views.inspect.files import log_report, time_tags_report

    if ".track." in path.name or context.options.format is None or "format" in context.typed:
        try:
            name: str | None = log_format(path, context.options)
        except CampaignError:  # not the suffix of a log
            name = log_by_content(path)
            context = replace(context, options=replace(context.options, format=name))
        if name is not None:
            yield "flight log", name, partial(log_report, path, context)
    if are_time_tags(path):
        yield "time tags", "", partial(time_tags_report, path)


def _recording(path: Path, suffix: str, context: Surroundings) -> Report:
    from apertura.views.inspect.files import recording_report

    return recording_report(recording_files(path.parent, path.name.removesuffix(suffix)), context)


def _history(path: Path, name: str, context: Surroundings) -> Report:
    from apertura.views.inspect.files import history_report

    files = PHASE_HISTORIES[name].files_of(path)
    return history_report(path if path.is_dir() else files[0], files, name, context)


def _size(path: Path) -> dict[str, int]:
    return {"bytes": path.stat().st_size} if path.is_file() else {}


def _unknown(path: Path) -> Report:
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    recorders = sorted({suffix for row in RECORDERS for suffix in row})
    histories = sorted({row.suffix for row in PHASE_HISTORIES.values()})
    logs = sorted(f".{suffix}" for suffix in log_suffixes())
    from apertura.formats.recordings.sigmf import ARCHIVE, archived

    if path.suffix == ARCHIVE:
        return Report(path, "unknown", "", {**_size(path), "begins_with": quoted(head)}, problem=archived(path))
    problem = CampaignError(
        f"no known format has the suffix {quoted(path.suffix)}",
        path,
        f"a recording ({', '.join(recorders)}), a phase history ({', '.join(histories)}), a flight log "
        f"({', '.join(logs)}), an elevation model (.tif) or a campaign folder",
        "Give the file the suffix of its format, or convert the file.",
    )
    facts = {**_size(path), "begins_with": quoted(head)}
    advice = (f"if the file is a flight log, specify its format: --set format=<{'|'.join(TRACKS)}>",)
    return Report(path, "unknown", "", facts, advice, problem)


_LINES = ("recorded", "logged")
_COLUMNS = (
    "captures",
    "pulses",
    "prf_hz",
    "lost",
    "log_rate_hz",
    "log_gaps",
    "fix",
    "captures_inside_log_share",
)
_NEVER = np.array([], "datetime64[ns]")


def campaign_report(root: Path) -> Report:
    """Return the report of a campaign folder, which lists the problems found by `apertura check` as missing data."""
    campaign, problems = load(root)
    if campaign is None:
        lines = tuple(as_line(problem).replace(f"{root}/", "") for problem in problems)
        return Report(root, "campaign folder", "", {}, lines)
    examined = Examination(campaign)
    problems += problems_of(examined)
    parts: list[Report] = []
    spans: dict[Key, dict[str, Span]] = {}
    for flight in campaign.flights:
        for node in flight.participants:
            part, spans[flight.name, node], unreadable = _node_report(examined, (flight.name, node))
            parts.append(part)
            problems += unreadable
    facts = {
        "name": campaign.settings.campaign,
        "waveform": campaign.settings.waveform.kind,
        "flights": {flight.name: flight.kind for flight in campaign.flights},
        "scene_crs": examined.crs,
    }
    lines = tuple(dict.fromkeys(as_line(problem).replace(f"{root}/", "") for problem in problems))
    from apertura.views.inspect.pictures import draw_campaign

    return Report(
        root,
        "campaign folder",
        "",
        facts,
        lines,
        parts=tuple(parts),
        columns=tuple(name for name in _COLUMNS if any(name in part.facts for part in parts)),
        lines_of_parts=_LINES,
        picture=lambda: draw_campaign(spans, campaign.settings.campaign),
    )


def _node_report(examined: Examination, key: Key) -> tuple[Report, dict[str, Span], list[CampaignError]]:
    """Return the report of a node's recording and log in a flight, the time spans of both, and reading errors."""
    flight, node = key
    rows: dict[str, Any] = {}
    spans: dict[str, Span] = {}
    problems: list[CampaignError] = []
    pulses = _NEVER
    try:
        rows, pulses, recorded = _recorded(examined, key)
    except CampaignError as problem:
        problems.append(problem)
        recorded = None
    if recorded is not None:
        spans["recorded"] = recorded
        rows = {"recorded": _span_row(recorded), **rows}
    if key in examined.logs:
        log = examined.logs[key]
        spans["logged"] = log.times.span
        rows |= {
            "logged": _span_row(log.times.span),
            "log_rate_hz": log.times.rate_hz,
            "log_gaps": int(log.times.gap_at.size),
            "fix": log.fixes,
        }
        if pulses.size:
            rows["captures_inside_log_share"] = float(inside(pulses, log.times.span).mean())
    path = examined.campaign.root / "raw" / flight / node
    return Report(path, f"node of {flight}", "", rows), spans, problems


def _recorded(examined: Examination, key: Key) -> tuple[dict[str, Any], Times, Span | None]:
    """Return facts of a node's recording, its pulse times after clock correction, and the span of these times."""
    if examined.waveform is None:
        return _history_line(examined.campaign, key)
    if key not in examined.recorded:
        return {}, _NEVER, None
    facts = examined.recorded[key]  # times include the node's clock correction
    rows = {} if facts.times is None else {"captures": facts.captures, **_rate_rows(facts.times)}
    return rows, examined.recordings[key].captures.time, facts.span


def _history_line(campaign: Campaign, key: Key) -> tuple[dict[str, Any], Times, Span | None]:
    """Return the values of `_recorded` for a phase history; times are omitted if it has pulse numbers only."""
    flight, node = campaign.flight(key[0]), key[1]
    pair = next((pair for pair in flight.pairs if pair.endswith(f"-{node}")), None)
    if pair is None:
        return {}, _NEVER, None
    described = campaign.settings.waveform.model_dump()
    files = campaign.history_files(flight.name, node)
    times = read_phase_history(described["format"], files, pair=pair, described=described).time.values
    facts = time_facts(times, longer=LOST_CAPTURE)
    if facts.clock == "none":
        return {"pulses": len(times)}, _NEVER, None
    corrected = campaign.clock(*key).utc(times)
    return {"pulses": len(times), **_rate_rows(facts)}, corrected, (corrected[0], corrected[-1])


def _rate_rows(times: TimeFacts) -> dict[str, Any]:
    return {"prf_hz": times.rate_hz, "lost": times.lost}


def _span_row(span: Span) -> dict[str, str]:
    """Return the first and last time of a span in ISO 8601 with all digits."""
    return {
        name: f"{time.astype('datetime64[ns]')}Z" for name, time in zip(("first_utc", "last_utc"), span, strict=True)
    }
