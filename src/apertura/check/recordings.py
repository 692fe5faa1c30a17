"""Check recordings against the transmitted waveform, the nodes of a flight and each other."""

from collections.abc import Iterator

import numpy as np

from apertura.campaign.config import CONFIG, is_monostatic
from apertura.check.examination import Examination
from apertura.check.times import (
    LAG,
    expected_pulses,
    frame_numbers,
    iso,
    recorded_span,
    seconds_between,
    shift_s,
    steps_s,
)
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.formats.recordings.recording import Recording
from apertura.methods.causes import mistaken_time
from apertura.stages.acquisition import check_channels, check_length, check_rates
from apertura.stages.ingest import framing_of
from apertura.stages.positions import inside_segments
from apertura.stages.symbols import ambiguous_symbols
from apertura.stages.transmitted import check_mixing

_OFF = 0.2
"""Tolerated relative deviation of intervals from 1/prf_hz: time tags have errors of a few ms, or a resolution of 1 ms.
"""

# minimum fraction of intervals equal to 1/prf_hz for which longer intervals are attributed to missed pulses
_SOME = 0.1


def check_codes(examined: Examination) -> Iterator[CampaignError]:
    """Yield the problems of the file that contains the codes or the transmitted pulse."""
    waveform = examined.waveform
    if waveform is None:
        return
    if all(path.is_file() and path.stat().st_size for path in examined.campaign.sent_files):
        yield from examined.transmitted_problems
    unknown = None if examined.transmitted is None else examined.transmitted.unknown
    if unknown is not None and not unknown.unambiguous:
        pairs = [pair for flight in examined.campaign.image_flights for pair in flight.pairs]
        if any(map(is_monostatic, pairs)):
            yield ambiguous_symbols()


def check_recordings(examined: Examination) -> Iterator[CampaignError]:
    """Yield problems of recordings that cannot be opened, or contradict the waveform in carrier or sample rate."""
    yield from examined.recording_problems
    waveform = examined.waveform
    if waveform is None:
        return
    transmitted = examined.transmitted
    for recording in examined.recordings.values():
        recorded = {"sample_rate_hz": recording.sample_rate_hz, "carrier_hz": recording.frequency_hz}
        try:
            check_rates(waveform, recorded, where=recording.files[0])
            if transmitted is not None:
                check_mixing(recording.samples, transmitted.numerology, where=recording.files[0])
            if recording.framing is not None:
                framing_of(recording, examined.campaign)
        except CampaignError as problem:
            yield problem


def check_receivers(examined: Examination) -> Iterator[CampaignError]:
    """Yield problems of recordings that lack a required channel, or whose captures are shorter than required."""
    waveform = examined.waveform
    if waveform is None:
        return
    for flight in examined.campaign.flights:
        for node in flight.nodes:
            key = (flight.name, node)
            if key in examined.recorded:
                facts, meta = examined.recorded[key], examined.recordings[key].files[0]
                needed = ("radar", "sidelink") if node != flight.transmitter else ("radar",)
                try:
                    check_channels(facts.channels, needed, where=meta)
                    if not facts.runs_through:
                        check_length(facts.capture_samples, waveform.needed_samples, where=meta)
                except CampaignError as problem:
                    yield problem


def check_histories(examined: Examination) -> Iterator[CampaignError]:
    """Yield problems of phase histories that cannot be read, or whose pulses have no position in the log."""
    if not examined.other_frame:  # reported by check 'crs'
        yield from examined.history_problems


def check_intervals(examined: Examination) -> Iterator[CampaignError]:
    """Yield problems of recordings whose time tag interval differs from 1/prf_hz for a reason other than missed pulses.

    A receiver that records only every second or third pulse is accepted, because each of its pulses has a match at the
    transmitter.
    """
    waveform = examined.waveform
    transmitters = {(flight.name, flight.transmitter) for flight in examined.campaign.flights}
    for key, recording in examined.recordings.items() if waveform else ():
        interval_s = waveform and odd_interval_s(recording.captures.time, waveform.prf_hz)
        if not interval_s or not waveform:
            continue
        ratio = interval_s * waveform.prf_hz
        whole = round(ratio) if ratio > 1 + _OFF and abs(ratio - round(ratio)) <= _OFF else 0
        if whole and key not in transmitters:
            continue
        ordinal = {2: "second", 3: "third"}.get(whole, f"{whole}th")
        reason = f": only every {ordinal} pulse was recorded, or waveform.prf_hz is {whole} times the true rate"
        yield CampaignError(
            f"time tag interval {interval_s:.6g} s ({1 / interval_s:.6g} Hz){reason if whole else ''}",
            where=recording.files[0],
            expected=f"{1 / waveform.prf_hz:.6g} s, 1/waveform.prf_hz ({waveform.prf_hz:g} Hz)",
            remedy=f"Correct waveform.prf_hz in {CONFIG}, or the trigger of the recorder.",
        )


def odd_interval_s(times: Times, prf_hz: float) -> float | None:
    """Return the interval of time tags if single intervals and means over 16 intervals differ from 1/prf_hz, else None.

    Examples
    --------
    >>> tags = np.datetime64("2025-05-14T09:30", "ns") + np.arange(40) * np.timedelta64(50, "ms")
    >>> odd_interval_s(tags, 20.0), odd_interval_s(tags, 40.0)
    (None, 0.05)
    >>> odd_interval_s(tags[np.sort(np.random.default_rng(1).permutation(40)[:16])], 20.0)  # most pulses are missed
    """
    if len(times) < 3:
        return None
    lag = min(LAG, len(times) - 1)
    single_s = steps_s(times)
    single, smooth = float(np.median(single_s)), float(np.median(steps_s(times, over=lag) / lag))
    if min(abs(single * prf_hz - 1), abs(smooth * prf_hz - 1)) <= _OFF:
        return None
    if single * prf_hz > 1 and float(np.mean(np.abs(single_s * prf_hz - 1) <= _OFF)) >= _SOME:
        return None
    return single


def check_overlap(examined: Examination) -> Iterator[CampaignError]:
    """Yield problems of pairs of nodes without common pulses, judged by frame numbers if available, else by times."""
    waveform = examined.waveform
    for flight in examined.campaign.flights if waveform else ():
        tx = examined.recordings.get((flight.name, flight.transmitter))
        for node in flight.nodes:
            rx = examined.recordings.get((flight.name, node))
            if waveform and tx and rx and tx is not rx:
                problem = _nothing_in_common(tx, rx, waveform.prf_hz)
                if problem:
                    yield problem


def _nothing_in_common(tx: Recording, rx: Recording, prf_hz: float) -> CampaignError | None:
    if tx.framing is not None or rx.framing is not None:
        return None  # continuous recordings have their frame numbers in the samples
    where, numbers = f"{tx.files[0]} and {rx.files[0].name}", (frame_numbers(tx), frame_numbers(rx))
    if all(own.size for own in numbers):
        if np.isin(*numbers).any():
            return None
        first, second = (f"{own.min()} to {own.max()}" for own in numbers)
        return CampaignError(
            f"frame numbers {first} and {second}, without a common number",
            where=where,
            expected="recordings of the same pulses",
            remedy="Check that both recordings belong to the same flight, and check apertura:frame of their captures.",
        )
    if seconds_between(recorded_span(tx), recorded_span(rx)) <= 1 / prf_hz:
        return None
    shift = shift_s(recorded_span(tx), recorded_span(rx))
    first, second = (" to ".join(map(iso, recorded_span(node))) for node in (tx, rx))
    return CampaignError(
        f"recorded {first} and {second}, a difference of {abs(shift):.1f} s{mistaken_time(shift)}",
        where=where,
        expected="time tags of the same pulses",
        remedy="Check that both recordings belong to the same flight, and check core:datetime of their captures.",
    )


def check_segments(examined: Examination) -> Iterator[CampaignError]:
    """Yield problems of pairs that have no pulse inside the segments given in segments.tsv."""
    campaign, waveform = examined.campaign, examined.waveform
    for flight in campaign.image_flights:
        tx = examined.recordings.get((flight.name, flight.transmitter))
        for pair in flight.pairs:
            if tx is not None and waveform is not None:
                try:
                    inside_segments(campaign, flight.name, pair, expected_pulses(tx, tx, waveform.prf_hz))
                except CampaignError as problem:
                    yield problem
