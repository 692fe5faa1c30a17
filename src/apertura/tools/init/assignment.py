"""Names of flights and nodes, and the log of each recording: by times first, by words of file names second."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from apertura.campaign.config.nodes import Log
from apertura.check.facts import log_facts
from apertura.common.errors import CampaignError, shown
from apertura.formats.reading import read_track
from apertura.tools.init.draft import Draft, Question, described_key
from apertura.tools.init.files import Found, FoundLog, FoundRecording, log_key, overlap, words

_COMMON = (
    *("iq", "raw", "rec", "recording", "data", "samples", "radar", "rx", "tx", "adc", "beat", "sweeps", "flight"),
    *("log", "track", "gps", "gnss", "rtk", "pos", "nav", "time", "times", "tags", "solution"),
)
"""Words of file names that do not distinguish nodes."""

_REMEDY = "State flight and node: --assign FILE=FLIGHT/NODE."
_ZONE_S, _LARGEST_ZONE_S = 900, 50_400
_EXAMPLES = {"height_offset_m": "47.2", "time_system": "utc", "start_utc": "2025-05-14T09:30:00", "quality": "gga"}


def assign(found: Found, assigned: Mapping[Path, str], draft: Draft) -> None:
    """Set flight, node, log and time zone of each recording.

    Parameters
    ----------
    found
        Recognised files.
    assigned
        File → node or flight/node, as given by the user.
    draft
        Settings of logs that are given or requested.

    Raises
    ------
    CampaignError
        If two recordings would be the same node in a flight, if several logs are equally suitable, or if a log cannot
        be read.
    """
    known = {one.path for one in found.recordings} | {log.path for log in found.logs}
    for path, target in assigned.items():
        if path not in known or not re.fullmatch(r"(\w+/)?\w+", target, re.ASCII):
            expected = f"FILE=NODE or FILE=FLIGHT/NODE, with one of {', '.join(sorted(path.name for path in known))}"
            raise CampaignError(f"{path}={target}", "--assign", expected, "Correct file and names.")
    _name(found.recordings, assigned)
    for log in found.logs:
        _read(log, found, assigned, draft)
    for flight in dict.fromkeys(recording.flight for recording in found.recordings):
        own = [one for one in found.recordings if one.flight == flight and not one.has_positions]
        options = {one.node: _options(one, own, found, assigned) for one in own}
        for recording in sorted(own, key=lambda one: len(options[one.node])):
            logs = [log for log in options[recording.node] if all(log is not other.log for other in own)]
            recording.log = _chosen(recording, logs, draft)
            recording.zone_s = _zone(recording)


# ---- Flights and nodes -----------------------------------------------------------------------------------------------


def _name(recordings: list[FoundRecording], assigned: Mapping[Path, str]) -> None:
    flights: list[list[FoundRecording]] = []
    for recording in sorted(recordings, key=lambda one: str(one.span)):
        group = next((flight for flight in flights if any(_together(recording, one) for one in flight)), None)
        if group is None:
            flights.append([recording])
        else:
            group.append(recording)
    folders = [sorted({one.path.parent.name for one in flight}) for flight in flights]
    are_folders = len({*map(tuple, folders)}) == len(flights) > 1 and all(
        len(names) == 1 and re.fullmatch(r"\w+", names[0], re.ASCII) for names in folders
    )
    of_all = set.intersection(*({word for one in flight for word in words(one.path)} for flight in flights))
    for number, flight in enumerate(flights, 1):
        name = folders[number - 1][0] if are_folders else f"f{number:02d}"
        for recording, node in zip(flight, _nodes(flight, of_all), strict=True):
            given, _, given_node = assigned.get(recording.path, "").rpartition("/")
            recording.flight, recording.node = given or name, given_node or node
    for recording in recordings:
        same = [one for one in recordings if (one.flight, one.node) == (recording.flight, recording.node)]
        if len(same) > 1:
            names = " and ".join(one.path.name for one in same)
            problem = f"{names} would all be the recording of {recording.node} in {recording.flight}"
            raise CampaignError(problem, recording.path, "one recording per flight and node", _REMEDY)


def _together(one: FoundRecording, other: FoundRecording) -> bool:
    """Return True if two recordings belong to the same flight; without UTC, if they are in the same folder."""
    if one.span is None or other.span is None:
        return one.span is other.span and one.path.parent == other.path.parent
    return overlap(one.span, other.span) or overlap(other.span, one.span)


def _nodes(flight: Sequence[FoundRecording], of_all: set[str]) -> list[str]:
    """Return the node of each recording of a flight: the words that distinguish it, preferably those of all flights."""
    every = [[word for word in _own_words(one) if not word.isdigit()] for one in flight]
    shared = set.intersection(*map(set, every)) if len(flight) > 1 else set[str]()
    names = []
    for own in every:
        distinct = [word for word in own if word not in shared]
        for preferred in ([word for word in distinct if word in of_all], distinct):
            chosen = [word for word in preferred if word not in _COMMON]
            if chosen:
                break
        names.append("_".join(chosen or distinct) or "uav1")
    return names if len({*names}) == len(names) else ["_".join(_own_words(one)) for one in flight]


def _own_words(recording: FoundRecording) -> list[str]:
    """Return the words that the names of all files of a recording have in common."""
    common = set.intersection(*({*words(file)} for file in recording.files))
    return [word for word in words(recording.path) if word in common]


# ---- Logs ------------------------------------------------------------------------------------------------------------


def _is_named(log: FoundLog, recording: FoundRecording) -> bool:
    """Return True if the words of a log's file name contain the node."""
    own = words(log.path)
    return {*recording.node.lower().split("_")} <= {*own} or any(
        word.startswith(recording.node.lower()) for word in own
    )


def _read(log: FoundLog, found: Found, assigned: Mapping[Path, str], draft: Draft) -> None:
    """Read a log; a value that it does not contain is given, or requested with the key that the reader states."""
    named = [one.node for one in found.recordings if _is_named(log, one)]
    node = assigned.get(log.path, "").rpartition("/")[2] or (named or [one.node for one in found.recordings])[0]
    section = f"nodes.{node}.log."
    log.options = {
        key.removeprefix(section): draft.value(key, text)
        for key, text in draft.given.items()
        if key.startswith(section)
    }
    while log.track is None:
        options = replace(Log(**log.options).options, format=log.options.get("format", log.format))
        try:
            log.track = read_track(log.path, node=node, options=options)
        except CampaignError as problem:
            key = log_key(problem)
            if not key or key in log.options:
                raise
            text = f"{log.path.name}: {problem.found}; {described_key(f'{section}{key}', draft.kind).description}"
            answer = draft.answer(Question((f"{section}{key}",), text, _EXAMPLES.get(key, "")))
            if answer is None:
                remedy = f"Add --set {section}{key}=VALUE, or run on a terminal."
                raise CampaignError(problem.found, log.path, problem.expected, remedy) from problem
            log.options[key] = answer[0]
    log.facts = log_facts(log.track)


def _options(
    recording: FoundRecording, own: Iterable[FoundRecording], found: Found, assigned: Mapping[Path, str]
) -> list[FoundLog]:
    """Return the logs that may belong to a recording.

    These are the assigned log, or else logs that cover its times, or else logs that cover no recording; of several
    logs, those with the name of the node, or else those without the name of another node of the flight.
    """
    targets = {recording.node, f"{recording.flight}/{recording.node}"}
    stated = [log for log in found.logs if assigned.get(log.path) in targets]
    if stated:
        return stated
    free = [log for log in found.logs if log.path not in assigned]
    covering = [log for log in free if log.covers(recording.span)]
    logs = covering or [log for log in free if not any(log.covers(one.span) for one in found.recordings)]
    foreign = [log for log in logs if any(_is_named(log, one) for one in own if one is not recording)]
    return [log for log in logs if _is_named(log, recording)] or [log for log in logs if log not in foreign]


def _chosen(recording: FoundRecording, logs: Sequence[FoundLog], draft: Draft) -> FoundLog | None:
    if len(logs) < 2:
        return logs[0] if logs else None
    names, where = [log.path.name for log in logs], f"{recording.node} in {recording.flight}"
    text = f"log of {where} ({shown(recording.path.name)}): {', '.join(names)}"
    answer = draft.answer(Question(("log",), text, names[0]), allowed=names)
    if answer is None:
        problem = f"{' and '.join(names)} may both be the log of {where}"
        remedy = f"Add --assign {names[0]}={recording.flight}/{recording.node}, or leave out the other log."
        raise CampaignError(problem, recording.path, "a single log with these times or this name", remedy)
    return logs[names.index(answer[0])]


def _zone(recording: FoundRecording) -> float | None:
    """Return the only time zone of a recorder that makes its log cover the recording (recordings.md, eq. 7)."""
    log = recording.log
    if log is None or recording.span is None or log.covers(recording.span):
        return None
    zones = range(-_LARGEST_ZONE_S, _LARGEST_ZONE_S + 1, _ZONE_S)
    fitting = [zone for zone in zones if log.covers(recording.span, zone)]
    return float(fitting[0]) if len(fitting) == 1 else None
