"""Check that flight logs can be read, belong to the flight, and cover the pulses of the nodes."""

from collections.abc import Iterator

import numpy as np

from apertura.campaign.config import CONFIG
from apertura.campaign.folder import Campaign
from apertura.check.examination import Examination, Key
from apertura.check.times import Span, common_pulses, inside, iso, recorded_span, seconds_between, shift_s
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.formats.tracks.track import FIXES
from apertura.methods.causes import mistaken_time

FASTEST_M_S = 340.0
"""Largest accepted median speed of a node, m/s: a supersonic speed indicates a wrong unit of times or positions."""


def check_tracks(examined: Examination) -> Iterator[CampaignError]:
    """Yield problems of logs that cannot be read, have different frames, lack heights, or have a supersonic speed."""
    yield from examined.track_problems
    for key, log in examined.logs.items():
        found = expected = remedy = ""
        if log.frame != examined.frame:
            found, expected = f"positions in frame {log.frame}", f"frame {examined.frame}, as in the other logs"
            remedy = "Provide all logs in the same frame."
        elif log.frame == "ecef" and np.abs(log.bounds["height_m"]).max() < 1e-3:
            found, expected = "height 0 at every epoch", "metres above the ellipsoid"
            remedy = "Export the log with heights."
        elif log.median_speed_m_s > FASTEST_M_S:
            found, expected = f"a median speed of {log.median_speed_m_s:.0f} m/s", f"less than {FASTEST_M_S:.0f} m/s"
            remedy = "Check the units of times (seconds) and positions (decimal degrees)."
        if found:
            yield CampaignError(found, where=examined.campaign.track_file(*key), expected=expected, remedy=remedy)


def check_attitude(examined: Examination) -> Iterator[CampaignError]:
    """Yield problems of nodes whose log lacks the required attitude, or has an attitude in radians or anticlockwise.

    A wrong unit or sense of rotation is only certain if the courses cover most directions; otherwise, step `echo`
    raises a flag.
    """
    from apertura.stages.node_log import yaw_fault_of

    campaign = examined.campaign
    for (flight, node), log in examined.logs.items():
        if campaign.settings.nodes[node].attitude != "log" or not _uses_attitude(campaign, flight, node):
            continue
        fault = yaw_fault_of(examined.tracks[flight, node]) if log.has_attitude else None
        if fault is not None and fault.certain:
            yield CampaignError(
                fault.line,
                where=campaign.track_file(flight, node),
                expected="degrees, yaw clockwise from north",
                remedy=f"Export the log with these conventions, or set nodes.{node}.attitude to course.",
            )
        if not log.has_attitude:
            yield CampaignError(
                "no roll, pitch and yaw",
                where=campaign.track_file(flight, node),
                expected=f"an attitude at every epoch, because {CONFIG}: nodes.{node}.attitude is log",
                remedy="Log the attitude; or set the node's attitude to course; or set its lever arms to zero and its "
                "antennas to null.",
            )


def _uses_attitude(campaign: Campaign, flight: str, node: str) -> bool:
    """Return True if a node has an antenna with a lever arm or a beam in this flight."""
    arms = campaign.settings.nodes[node].lever_arms_m
    for pair in campaign.flight(flight).pairs:
        legs = dict(zip(("radar_tx", "radar_rx"), pair.split("-"), strict=True))
        used = [point for point, name in legs.items() if name == node]
        beams = [point for point, (name, _) in campaign.antennas(pair).items() if name == node]
        used += ["sidelink"] if used and len(set(legs.values())) > 1 else []
        if beams or any(any(getattr(arms, point)) for point in used):
            return True
    return False


def check_coverage(examined: Examination) -> Iterator[CampaignError]:
    """Yield problems of logs that do not cover the pulses of their nodes, or have only poor solutions.

    The positions of both nodes are evaluated at the transmitter's time tags. Pulses beyond an end of the log are not
    reported here if the solution at that end is poorer than fixed, because the configuration may exclude these pulses.
    """
    waveform = examined.waveform
    reported: set[Key] = set()
    for flight in examined.campaign.flights if waveform else ():
        tx = examined.recordings.get((flight.name, flight.transmitter))
        for node in flight.nodes:
            rx = examined.recordings.get((flight.name, node))
            if tx is None or rx is None or waveform is None:
                continue
            pulses = common_pulses(tx, rx, waveform.prf_hz)
            for key in ((flight.name, flight.transmitter), (flight.name, node)):
                if key in reported or key not in examined.tracks:
                    continue
                problem = (
                    _no_overlap(examined, key)
                    if tx.framing is not None
                    else _uncovered(examined, key, pulses) or _all_poor(examined, key, pulses)
                )
                if problem:
                    reported.add(key)
                    yield problem


def _no_overlap(examined: Examination, key: Key) -> CampaignError | None:
    """Return the problem of a log that does not overlap a continuous recording (with unknown pulse times)."""
    log, recorded = examined.logs[key].times.span, recorded_span(examined.recordings[key])
    shift = shift_s(recorded, log)
    found = f"the times of log and recording differ by {abs(shift):.1f} s{mistaken_time(shift)}"
    return _problem(examined, key, found, recorded) if seconds_between(recorded, log) > 0 else None


def _uncovered(examined: Examination, key: Key, pulses: Times) -> CampaignError | None:
    if not pulses.size:
        return None
    track = examined.tracks[key]
    times = track.time.values
    before, after = pulses < times[0], pulses > times[-1]
    for outside, end in ((before, 0), (after, -1)):
        if "fix" in track and int(track.fix.values[end]) not in {0, FIXES["fix"]}:
            outside[:] = False
    uncovered = int((before | after).sum())
    if not uncovered:
        return None
    second = np.timedelta64(1, "s")
    ends = [f"starts {(times[0] - pulses[0]) / second:.3f} s after the first pulse"] if before.any() else []
    ends += [f"ends {(pulses[-1] - times[-1]) / second:.3f} s before the last pulse"] if after.any() else []
    recorded = (pulses[0], pulses[-1])
    shift = shift_s(recorded, (times[0], times[-1]))
    cause = mistaken_time(shift)
    difference = f"; the times of log and recording differ by {abs(shift):.1f} s{cause}" if cause else ""
    found = f"the log {' and '.join(ends)}: {uncovered} of {len(pulses)} pulses without a position{difference}"
    return _problem(examined, key, found, recorded)


def _all_poor(examined: Examination, key: Key, pulses: Times) -> CampaignError | None:
    """Return the problem of a log whose epochs during the pulses all have a solution poorer than the configured one."""
    track, node = examined.tracks[key], examined.campaign.settings.nodes[key[1]]
    worst = node.worst_fix
    if "fix" not in track or not pulses.size or worst == "any":
        return None
    times, fixes = track.time.values, track.fix.values
    during = inside(times, (pulses[0], pulses[-1]))
    if not during.any() or np.isin(fixes[during], (0, FIXES["fix"])).any():
        return None
    from apertura.stages.node_log import poorer_fix

    if not poorer_fix(fixes, worst)[during].all():
        return None
    return CampaignError(
        f"all {int(during.sum())} epochs during the pulses have a solution poorer than {node.poorest_fix}",
        where=examined.campaign.track_file(*key),
        expected=f"solutions allowed by {CONFIG}: nodes.{key[1]}.worst_fix",
        remedy="Process the log again, or set this key to allow poorer solutions.",
    )


def _problem(examined: Examination, key: Key, found: str, recorded: Span) -> CampaignError:
    first, last = map(iso, recorded)
    return CampaignError(
        found,
        where=examined.campaign.track_file(*key),
        expected=f"a log that covers the pulses, {first} to {last} UTC",
        remedy="Check the log's time system (GPST is 18 s ahead of UTC) and the transmitter's time tags, at which the "
        "positions of both nodes are evaluated, or provide the complete log.",
    )
