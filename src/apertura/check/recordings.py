"""Check recordings against the transmitted waveform, the nodes of a flight and each other."""

from collections.abc import Iterator

import numpy as np

from apertura.campaign.config import CONFIG
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
from apertura.stages.transmitted import check_mixing

_OFF = 0.2
"""Spacings further from 1/prf_hz than this share of it are others: tags are good to a few ms, some are whole ms."""

_SOME = 0.1  # share of intervals at 1/prf_hz that says that the others are pulses missed


def check_codes(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem unless codes are complex, one per subcarrier, finite, not zero; or a pulse as long as stated."""
    waveform = examined.waveform
    if waveform is None:
        return
    path = examined.campaign.sent_file
    if path.is_file() and path.stat().st_size:
        yield from examined.transmitted_problems


def check_recordings(examined: Examination) -> Iterator[CampaignError]:
    """Yield recordings that do not open, or were recorded at another carrier or sample rate than the waveform's."""
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
    """Yield receivers without the channels they need, or with captures shorter than prefix and DFT window."""
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
    """Yield phase history that cannot be read, or whose pulses have no position by log and `config/clocks.tsv`."""
    if not examined.other_frame:  # which 'crs' reports
        yield from examined.history_problems


def check_intervals(examined: Examination) -> Iterator[CampaignError]:
    """Yield recordings whose tags have another spacing than 1/prf_hz, unless pulses in between were missed.

    A receiver may take every second or third pulse; each still finds its partner.
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
        why = f": only every {ordinal} pulse was recorded, or waveform.prf_hz is {whole} times the true one"
        yield CampaignError(
            f"time tags {interval_s:.6g} s apart, {1 / interval_s:.6g} Hz{why if whole else ''}",
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
    lag = min(LAG, len(times) - 1)
    single_s = steps_s(times)
    single, smooth = float(np.median(single_s)), float(np.median(steps_s(times, over=lag) / lag))
    if min(abs(single * prf_hz - 1), abs(smooth * prf_hz - 1)) <= _OFF:
        return None
    if single * prf_hz > 1 and float(np.mean(np.abs(single_s * prf_hz - 1) <= _OFF)) >= _SOME:
        return None
    return single


def check_overlap(examined: Examination) -> Iterator[CampaignError]:
    """Yield pairs of nodes without a pulse in common: by frame numbers where both have them, else by their tags."""
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
        return None  # their frame numbers are in the samples
    where, numbers = f"{tx.files[0]} and {rx.files[0].name}", (frame_numbers(tx), frame_numbers(rx))
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
    if seconds_between(recorded_span(tx), recorded_span(rx)) <= 1 / prf_hz:
        return None
    shift = shift_s(recorded_span(tx), recorded_span(rx))
    first, second = (" to ".join(map(iso, recorded_span(node))) for node in (tx, rx))
    return CampaignError(
        f"recorded {first} and {second}, {abs(shift):.1f} s apart{mistaken_time(shift)}",
        where=where,
        expected="time tags of the same pulses",
        remedy="Check that both are of the same flight, and their core:datetime.",
    )


def check_segments(examined: Examination) -> Iterator[CampaignError]:
    """Yield pairs of which no pulse lies inside their lines of segments.tsv."""
    campaign, waveform = examined.campaign, examined.waveform
    for flight in campaign.image_flights:
        tx = examined.recordings.get((flight.name, flight.transmitter))
        for pair in flight.pairs:
            if tx is not None and waveform is not None:
                try:
                    inside_segments(campaign, flight.name, pair, expected_pulses(tx, tx, waveform.prf_hz))
                except CampaignError as problem:
                    yield problem
