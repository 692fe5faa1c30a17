"""The report of a campaign folder: what each node of each flight recorded and logged, and how far both overlap."""

from pathlib import Path
from typing import Any

import numpy as np

from apertura.campaign.folder import Campaign
from apertura.check import as_line, load, problems_of
from apertura.check.examination import Examination, Key
from apertura.check.facts import LogFacts
from apertura.check.times import LOST_CAPTURE, Span, TimeFacts, inside, time_facts
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.formats.reading import read_phase_history
from apertura.views.inspect.report import Report

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
    """Return the report of a campaign folder; what is wrong with it is what is missing."""
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
    """Return what one node recorded and logged in one flight, when, and what of it cannot be read."""
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
        rows |= _log_rows(log)
        if pulses.size:
            rows["captures_inside_log_share"] = float(inside(pulses, log.times.span).mean())
    path = examined.campaign.root / "raw" / flight / node
    return Report(path, f"node of {flight}", "", rows), spans, problems


def _recorded(examined: Examination, key: Key) -> tuple[dict[str, Any], Times, Span | None]:
    """Return facts of what a node recorded, and by the log's clock the times of its pulses, the first and the last."""
    if examined.waveform is None:
        return _history(examined.campaign, key)
    if key not in examined.recorded:
        return {}, _NEVER, None
    facts = examined.recorded[key]  # times are corrected by the node's clock
    rows = {} if facts.times is None else {"captures": facts.captures, **_rate_rows(facts.times)}
    return rows, examined.recordings[key].captures.time, facts.span


def _history(campaign: Campaign, key: Key) -> tuple[dict[str, Any], Times, Span | None]:
    """Return the same of phase history, which receiving nodes have; no times where pulses are merely counted."""
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


def _log_rows(log: LogFacts) -> dict[str, Any]:
    times = log.times
    return {
        "logged": _span_row(times.span),
        "log_rate_hz": times.rate_hz,
        "log_gaps": int(times.gap_at.size),
        "fix": log.fixes,
    }


def _span_row(span: Span) -> dict[str, str]:
    """Return two times, ISO 8601, with every digit that they have."""
    return {
        name: f"{time.astype('datetime64[ns]')}Z" for name, time in zip(("first_utc", "last_utc"), span, strict=True)
    }
