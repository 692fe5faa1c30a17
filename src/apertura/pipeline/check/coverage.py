"""Whether the logs of a pair reach over its pulses."""

from collections.abc import Iterator

import numpy as np

from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.formats.tracks.track import FIXES
from apertura.pipeline.check.clocks import clock, gap_s, likely_cause, shift_s
from apertura.pipeline.check.inspected import Inspected, Key
from apertura.pipeline.check.tags import paired, span
from apertura.pipeline.config import CONFIG


def check_coverage(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield logs that begin after the first pulse they must place, end before the last, or are poor throughout.

    Both nodes of a pulse are placed at the transmitter's tag. Pulses beyond an end of the log whose solution is poorer
    than fixed may be left out by what is asked of it, and are none of this check's.
    """
    waveform = inspected.waveform
    told: set[Key] = set()
    for flight in inspected.campaign.flights if waveform else ():
        tx = inspected.recordings.get((flight.name, flight.transmitter))
        for node in flight.nodes:
            rx = inspected.recordings.get((flight.name, node))
            if tx is None or rx is None or waveform is None:
                continue
            pulses = paired(tx, rx, waveform.prf_hz)
            for key in ((flight.name, flight.transmitter), (flight.name, node)):
                if key in told or key not in inspected.tracks:
                    continue
                problem = (
                    _apart(inspected, key)
                    if tx.framing is not None
                    else _uncovered(inspected, key, pulses) or _all_poor(inspected, key, pulses)
                )
                if problem:
                    told.add(key)
                    yield problem


def _apart(inspected: Inspected, key: Key) -> CampaignError | None:
    """Return what is wrong where the recorder ran through: its pulses are not known, but when it ran."""
    times = inspected.tracks[key].time.values
    log, recorded = (times[0], times[-1]), span(inspected.recordings[key])
    shift = shift_s(recorded, log)
    found = f"log and recording are {abs(shift):.1f} s apart{likely_cause(shift)}"
    return _problem(inspected, key, found, recorded) if gap_s(recorded, log) > 0 else None


def _uncovered(inspected: Inspected, key: Key, pulses: Times) -> CampaignError | None:
    if not pulses.size:
        return None
    track = inspected.tracks[key]
    times = track.time.values
    before, after = pulses < times[0], pulses > times[-1]
    for out, end in ((before, 0), (after, -1)):
        if "fix" in track and int(track.fix.values[end]) not in {0, FIXES["fix"]}:
            out[:] = False
    lost = int((before | after).sum())
    if not lost:
        return None
    second = np.timedelta64(1, "s")
    ends = [f"begins {(times[0] - pulses[0]) / second:.3f} s after the first pulse"] if before.any() else []
    ends += [f"ends {(pulses[-1] - times[-1]) / second:.3f} s before the last"] if after.any() else []
    recorded = (pulses[0], pulses[-1])
    shift = shift_s(recorded, (times[0], times[-1]))
    cause = likely_cause(shift)
    apart = f"; log and recording are {abs(shift):.1f} s apart{cause}" if cause else ""
    found = f"the log {' and '.join(ends)}: {lost} of {len(pulses)} pulses without a position{apart}"
    return _problem(inspected, key, found, recorded)


def _all_poor(inspected: Inspected, key: Key, pulses: Times) -> CampaignError | None:
    """Return what is wrong where every epoch between the first and the last pulse is poorer than the config allows."""
    track, node = inspected.tracks[key], inspected.campaign.settings.nodes[key[1]]
    worst = node.worst_fix
    if "fix" not in track or not pulses.size or worst == "any":
        return None
    times, fixes = track.time.values, track.fix.values
    during = (times >= pulses[0]) & (times <= pulses[-1])
    if not during.any() or np.isin(fixes[during], (0, FIXES["fix"])).any():
        return None
    from apertura.pipeline.opening.node_log import poorer_fix

    if not poorer_fix(fixes, worst)[during].all():
        return None
    return CampaignError(
        f"all {int(during.sum())} epochs while pulses were sent have a solution poorer than {node.poorest_fix}",
        where=inspected.campaign.track_file(*key),
        expected=f"solutions that {CONFIG}: nodes.{key[1]}.worst_fix allows",
        remedy="Process the log again, or allow poorer solutions by that key.",
    )


def _problem(
    inspected: Inspected, key: Key, found: str, recorded: tuple[np.datetime64, np.datetime64]
) -> CampaignError:
    first, last = map(clock, recorded)
    return CampaignError(
        found,
        where=inspected.campaign.track_file(*key),
        expected=f"a log that covers the pulses, {first} to {last} UTC",
        remedy="Check the log's time system (GPST is 18 s ahead of UTC) and the transmitter's time tags, at which "
        "both nodes are placed, or give the whole log.",
    )
