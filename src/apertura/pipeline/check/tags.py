"""Time tags of captures: their spacing against the PRF, the nodes of a flight against each other, segments."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.formats.recordings.recording import Recording
from apertura.pipeline.check.clocks import clock, gap_s, likely_cause, shift_s
from apertura.pipeline.check.inspected import Inspected
from apertura.pipeline.config import CONFIG, SEGMENTS

_OFF = 0.2
"""Spacings further from 1/prf_hz than this share of it are others: tags are good to a few ms, some are whole ms."""

_LAG = 16  # captures over which the spacing is measured as well: what cuts single tags averages out
_SOME = 0.1  # share of intervals at 1/prf_hz that says that the others are pulses missed


def span(recording: Recording) -> tuple[np.datetime64, np.datetime64]:
    """Return the times of the first and the last capture; of all samples where the recorder ran through."""
    first, last = recording.captures.time[0], recording.captures.time[-1]
    if recording.framing is not None:
        last = last + np.timedelta64(round(len(recording.samples) / recording.sample_rate_hz * 1e9), "ns")
    return first, last


def paired(tx: Recording, rx: Recording, prf_hz: float) -> Times:
    """Return the transmitter's tags of pulses that surely find a partner in the receiver's recording.

    By equal frame numbers where both nodes have them, else by tags, but for one interval at either end. None where a
    counter wraps or the recorder ran through: their pulses are not known from headers.
    """
    times = tx.captures.time
    if tx.framing is not None or rx.framing is not None:
        return times[:0]
    if tx is rx:
        return times
    numbers = _numbers(tx), _numbers(rx)
    if all(own.size for own in numbers):
        wrapped = any((np.diff(own) <= 0).any() for own in numbers)
        return times[:0] if wrapped else times[np.isin(tx.captures.frame, numbers[1])]
    interval = np.timedelta64(round(1e9 / prf_hz), "ns")
    first, last = span(rx)
    return times[(times >= first + interval) & (times <= last - interval)]


def _numbers(recording: Recording) -> NDArray[np.int64]:
    """Return the frame numbers of the captures that have one."""
    frame = recording.captures.frame
    return np.asarray(frame[frame >= 0])


def check_intervals(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield recordings whose tags have another spacing than 1/prf_hz, unless pulses in between were missed.

    A receiver may take every second or third pulse; each still finds its partner.
    """
    waveform = inspected.waveform
    sent = {(flight.name, flight.transmitter) for flight in inspected.campaign.flights}
    for key, recording in inspected.recordings.items() if waveform else ():
        found = waveform and odd_interval_s(recording.captures.time, waveform.prf_hz)
        if not found or not waveform:
            continue
        ratio = found * waveform.prf_hz
        whole = round(ratio) if ratio > 1 + _OFF and abs(ratio - round(ratio)) <= _OFF else 0
        if whole and key not in sent:
            continue
        ordinal = {2: "second", 3: "third"}.get(whole, f"{whole}th")
        why = f": only every {ordinal} pulse was recorded, or waveform.prf_hz is {whole} times the true one"
        yield CampaignError(
            f"time tags {found:.6g} s apart, {1 / found:.6g} Hz{why if whole else ''}",
            where=recording.files[0],
            expected=f"{1 / waveform.prf_hz:.6g} s, 1/waveform.prf_hz ({waveform.prf_hz:g} Hz)",
            remedy=f"Correct waveform.prf_hz in {CONFIG}, or the recorder's trigger.",
        )


def odd_interval_s(times: Times, prf_hz: float) -> float | None:
    """Return the spacing of tags where it is not 1/prf_hz, by single tags and over sixteen; None where it is.

    Examples
    --------
    >>> tags = np.datetime64("2025-05-14T09:30", "ns") + np.arange(40) * np.timedelta64(50, "ms")
    >>> odd_interval_s(tags, 20.0), odd_interval_s(tags, 40.0)
    (None, 0.05)
    >>> odd_interval_s(tags[np.sort(np.random.default_rng(1).permutation(40)[:16])], 20.0)  # most are missed
    """
    if len(times) < 3:
        return None
    steps_s = np.diff(times) / np.timedelta64(1, "s")
    lag = min(_LAG, len(times) - 1)
    apart_s = (times[lag:] - times[:-lag]) / np.timedelta64(1, "s") / lag
    single, smooth = float(np.median(steps_s)), float(np.median(apart_s))
    if min(abs(single * prf_hz - 1), abs(smooth * prf_hz - 1)) <= _OFF:
        return None
    if single * prf_hz > 1 and float(np.mean(np.abs(steps_s * prf_hz - 1) <= _OFF)) >= _SOME:
        return None
    return single


def check_overlap(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield pairs of nodes without a pulse in common: by frame numbers where both have them, else by their tags."""
    waveform = inspected.waveform
    for flight in inspected.campaign.flights if waveform else ():
        tx = inspected.recordings.get((flight.name, flight.transmitter))
        for node in flight.nodes:
            rx = inspected.recordings.get((flight.name, node))
            if waveform and tx and rx and tx is not rx:
                problem = _nothing_in_common(tx, rx, waveform.prf_hz)
                if problem:
                    yield problem


def _nothing_in_common(tx: Recording, rx: Recording, prf_hz: float) -> CampaignError | None:
    if tx.framing is not None or rx.framing is not None:
        return None  # their frame numbers are in the samples
    where, numbers = f"{tx.files[0]} and {rx.files[0].name}", (_numbers(tx), _numbers(rx))
    if all(own.size for own in numbers):
        if np.isin(*numbers).any():
            return None
        first, second = (f"{own.min()} to {own.max()}" for own in numbers)
        return CampaignError(
            f"frame numbers {first} and {second}, none in common",
            where=where,
            expected="recordings of the same pulses",
            remedy="Check that both are of the same flight, and apertura:frame of their captures.",
        )
    if gap_s(span(tx), span(rx)) <= 1 / prf_hz:
        return None
    shift = shift_s(span(tx), span(rx))
    first, second = (" to ".join(map(clock, span(node))) for node in (tx, rx))
    return CampaignError(
        f"recorded {first} and {second}, {abs(shift):.1f} s apart{likely_cause(shift)}",
        where=where,
        expected="time tags of the same pulses",
        remedy="Check that both are of the same flight, and their core:datetime.",
    )


def check_segments(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield pairs of which no pulse lies inside their lines of segments.tsv."""
    campaign = inspected.campaign
    for flight in campaign.image_flights:
        tx = inspected.recordings.get((flight.name, flight.transmitter))
        for pair in flight.pairs:
            lines = campaign.segments_of(flight.name, pair)
            if not lines or tx is None or any(_holds_pulse(tx, *line) for line in lines):
                continue
            first, last = map(clock, span(tx))
            yield CampaignError(
                f"no pulse of flight {flight.name}, pair {pair} inside {' or '.join('…'.join(line) for line in lines)}",
                where=campaign.root / SEGMENTS,
                expected=f"times between {first} and {last}, UTC",
                remedy="Correct start and end, or take the lines out to image with the whole track.",
            )


def _holds_pulse(recording: Recording, begun: str, ended: str) -> bool:
    start, end = np.datetime64(begun), np.datetime64(ended)
    if recording.framing is not None:
        first, last = span(recording)
        return bool(start <= last and end >= first)
    times = recording.captures.time
    return bool(((times >= start) & (times <= end)).any())
