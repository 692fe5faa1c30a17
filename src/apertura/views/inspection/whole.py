"""A campaign folder: of every flight and node what was recorded and logged, and how much of it is both."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.core.geometry.track_checks import LONG_GAP
from apertura.formats.reading import read_phase_history
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.check import as_line, problems_of
from apertura.pipeline.check.inspected import Inspected, Key
from apertura.pipeline.check.loading import load
from apertura.pipeline.check.tags import span
from apertura.views.inspection.log import fixes
from apertura.views.inspection.recording import LOST, within
from apertura.views.inspection.report import Report
from apertura.views.inspection.timing import counted, timing

if TYPE_CHECKING:
    import xarray as xr


_SPANS = ("recorded", "logged")
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

Span = tuple[np.datetime64, np.datetime64]
_NEVER = np.array([], "datetime64[ns]")


def campaign_report(root: Path) -> Report:
    """Return what is told of a campaign folder; what is wrong with it is what is missing."""
    campaign, wrong = load(root)
    if campaign is None:
        lines = tuple(as_line(problem).replace(f"{root}/", "") for problem in wrong)
        return Report(root, "campaign folder", "", {}, lines)
    inspected = Inspected(campaign)
    wrong += problems_of(inspected)
    spans: dict[Key, dict[str, Span]] = {}
    parts = tuple(_node(inspected, key, spans.setdefault(key, {}), wrong) for key in _keys(inspected))
    facts = {
        "name": campaign.settings.campaign,
        "waveform": campaign.settings.waveform.kind,
        "flights": {flight.name: flight.kind for flight in campaign.flights},
        "scene_crs": inspected.crs,
    }
    lines = tuple(dict.fromkeys(as_line(problem).replace(f"{root}/", "") for problem in wrong))
    from apertura.views.inspection.pictures import draw_campaign

    return Report(
        root,
        "campaign folder",
        "",
        facts,
        lines,
        parts=parts,
        columns=tuple(name for name in _COLUMNS if any(name in part.facts for part in parts)),
        spelt=_SPANS,
        picture=lambda: draw_campaign(spans, campaign.settings.campaign),
    )


def _keys(inspected: Inspected) -> list[Key]:
    return [(flight.name, node) for flight in inspected.campaign.flights for node in flight.participants]


def _node(inspected: Inspected, key: Key, spans: dict[str, Span], wrong: list[CampaignError]) -> Report:
    """Return what one node brought home from one flight; `spans` learn when, `wrong` what cannot be read."""
    flight, node = key
    track = inspected.tracks.get(key)
    try:
        facts, pulses, ends = _recorded(inspected, key)
    except CampaignError as problem:
        wrong.append(problem)
        facts, pulses, ends = {}, _NEVER, _NEVER
    clock = inspected.campaign.clock(flight, node)
    if ends.size:
        first, last = clock.utc(ends)[[0, -1]]
        spans["recorded"] = (first, last)
        facts = {"recorded": _span(first, last), **facts}
    if track is not None:
        times = track.time.values
        spans["logged"] = (times[0], times[-1])
        facts |= _logged(track)
        if pulses.size:
            facts["captures_inside_log_share"] = float(within(clock.utc(pulses), times).mean())
    return Report(inspected.campaign.root / "raw" / flight / node, f"node of {flight}", "", facts)


def _recorded(inspected: Inspected, key: Key) -> tuple[dict[str, Any], Times, Times]:
    """Return facts of what a node recorded, the times of its pulses and those that it lasted from and to."""
    recording = inspected.recordings.get(key)
    if inspected.waveform is None:
        return _history(inspected.campaign, key)
    if recording is None:
        return {}, _NEVER, _NEVER
    times = recording.captures.time
    facts = {"captures": len(times), **_rate(times)} if recording.framing is None else {}
    return facts, times, np.array(span(recording))


def _history(campaign: Campaign, key: Key) -> tuple[dict[str, Any], Times, Times]:
    """Return the same of phase history, which receiving nodes have; no times where pulses are merely counted."""
    flight, node = campaign.flight(key[0]), key[1]
    pair = next((pair for pair in flight.pairs if pair.endswith(f"-{node}")), None)
    if pair is None:
        return {}, _NEVER, _NEVER
    described = campaign.settings.waveform.model_dump()
    files = campaign.history_files(flight.name, node)
    times = read_phase_history(described["format"], files, pair=pair, described=described).time.values
    if counted(times):
        return {"pulses": len(times)}, _NEVER, _NEVER
    return {"pulses": len(times), **_rate(times)}, times, times


def _rate(times: Times) -> dict[str, Any]:
    found = timing(times, longer=LOST)
    return {"prf_hz": found["rate_hz"], "lost": found.get("lost_in_gaps", 0)}


def _logged(track: "xr.Dataset") -> dict[str, Any]:
    found = timing(track.time.values, longer=LONG_GAP)
    logged = {"logged": _span(*track.time.values[[0, -1]]), "log_rate_hz": found["rate_hz"], "log_gaps": found["gaps"]}
    return {**logged, "fix": fixes(track)}


def _span(first: np.datetime64, last: np.datetime64) -> dict[str, str]:
    """Return two times, ISO 8601, with every digit that they have."""
    return {name: f"{time.astype('datetime64[ns]')}Z" for name, time in (("first_utc", first), ("last_utc", last))}
