"""A campaign folder: of every flight and node what was recorded and logged, and how much of it is both."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.check import as_line, problems_of
from apertura.check.inspected import Inspected, Key
from apertura.check.loading import load
from apertura.check.tags import span
from apertura.geometry.track_checks import LONG_GAP
from apertura.inspection.log import fixes
from apertura.inspection.recording import LOST, within
from apertura.inspection.report import Report
from apertura.inspection.timing import timing

if TYPE_CHECKING:
    import xarray as xr

    from apertura.ingest.recording import Recording

_COLUMNS = ("recorded", "prf_hz", "lost", "logged", "log_rate_hz", "log_gaps", "fix", "captures_inside_log_share")

Span = tuple[np.datetime64, np.datetime64]


def campaign_report(root: Path) -> Report:
    """Return what is told of a campaign folder; what is wrong with it is what is missing."""
    campaign, wrong = load(root)
    if campaign is None:
        lines = tuple(as_line(problem).replace(f"{root}/", "") for problem in wrong)
        return Report(root, "campaign folder", "", {}, lines)
    inspected = Inspected(campaign)
    wrong += problems_of(inspected)
    spans: dict[Key, dict[str, Span]] = {}
    parts = tuple(_node(inspected, key, spans.setdefault(key, {})) for key in _keys(inspected))
    facts = {
        "name": campaign.settings.campaign,
        "waveform": campaign.settings.waveform.kind,
        "flights": {flight.name: flight.kind for flight in campaign.flights},
        "scene_crs": inspected.crs,
    }
    lines = tuple(dict.fromkeys(as_line(problem).replace(f"{root}/", "") for problem in wrong))
    from apertura.inspection.pictures import draw_campaign

    return Report(
        root,
        "campaign folder",
        "",
        facts,
        lines,
        parts=parts,
        columns=tuple(name for name in _COLUMNS if any(name in part.facts for part in parts)),
        picture=lambda: draw_campaign(spans, campaign.settings.campaign),
    )


def _keys(inspected: Inspected) -> list[Key]:
    return [(flight.name, node) for flight in inspected.campaign.flights for node in flight.participants]


def _node(inspected: Inspected, key: Key, spans: dict[str, Span]) -> Report:
    """Return what one node brought home from one flight; `spans` learn when it recorded and logged."""
    flight, node = key
    recording, track = inspected.recordings.get(key), inspected.tracks.get(key)
    facts: dict[str, Any] = {}
    if recording is not None:
        clock = inspected.campaign.clock(flight, node)
        spans["recorded"] = tuple(clock.utc(np.array(span(recording))))
        facts |= _recorded(recording)
    if track is not None:
        times = track.time.values
        spans["logged"] = (times[0], times[-1])
        facts |= _logged(track)
        if recording is not None:
            inside = within(inspected.campaign.clock(flight, node).utc(recording.captures.time), times)
            facts["captures_inside_log_share"] = float(inside.mean())
    where = inspected.campaign.root / "raw" / flight / node
    return Report(where, f"node of {flight}", "", facts)


def _recorded(recording: "Recording") -> dict[str, Any]:
    found = timing(recording.captures.time, longer=LOST)
    if recording.framing is not None:
        return {"recorded": _clock(np.array(span(recording)))}
    lost = found.get("lost_in_gaps", 0)
    recorded = {"recorded": _clock(recording.captures.time), "captures": len(recording.captures.start)}
    return {**recorded, "prf_hz": found["rate_hz"], "lost": lost}


def _logged(track: "xr.Dataset") -> dict[str, Any]:
    found = timing(track.time.values, longer=LONG_GAP)
    logged = {"logged": _clock(track.time.values), "log_rate_hz": found["rate_hz"], "log_gaps": found["gaps"]}
    return {**logged, "fix": fixes(track)}


def _clock(times: NDArray[np.datetime64]) -> str:
    """Return first and last of some times: the day once, to a second."""
    first, last = (np.datetime_as_string(time, "s") for time in (times[0], times[-1]))
    return f"{first}…{last[11:]}"
