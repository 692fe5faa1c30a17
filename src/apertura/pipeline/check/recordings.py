"""Whether what was transmitted and recorded fits the waveform, the nodes of a flight and each other."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from apertura.common import paths
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.formats.recordings.recording import Recording
from apertura.pipeline.check.hints import likely_cause
from apertura.pipeline.config import CONFIG, SEGMENTS, OfdmWaveform, SampledWaveform
from apertura.pipeline.examination.campaign import Examination
from apertura.pipeline.examination.facts import RecordingFacts
from apertura.pipeline.examination.times import (
    LAG,
    apart_s,
    frame_numbers,
    inside,
    iso,
    recorded_span,
    shift_s,
    steps_s,
)
from apertura.pipeline.opening.transmitted import check_mixing

_SAME = 1e-9
"""Carriers and rates that differ by less, relative to what the config states, are the same."""

_OFF = 0.2
"""Spacings further from 1/prf_hz than this share of it are others: tags are good to a few ms, some are whole ms."""

_SOME = 0.1  # share of intervals at 1/prf_hz that says that the others are pulses missed


def check_codes(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem unless codes are complex, one per subcarrier, finite, not zero; or a pulse as long as stated."""
    waveform = examined.waveform
    if waveform is None:
        return
    path = examined.campaign.sent_file
    if not path.is_file() or path.stat().st_size == 0:
        return
    if not isinstance(waveform, OfdmWaveform):
        yield from examined.transmitted_problems
        return
    defect = _codes_defect(path, waveform.subcarriers)
    if defect:
        yield CampaignError(
            defect,
            where=path,
            expected=f"a .npy file of ({waveform.subcarriers},) complex64, waveform.subcarriers, finite, without zeros",
            remedy="Use the codes that were transmitted, or correct the waveform.",
        )


def _codes_defect(path: Path, subcarriers: int) -> str:
    """Return what is wrong with a file of codes, shape and type before any of its content is read; '' if nothing is."""
    try:
        with path.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = header(stream)
            at = stream.tell()
    except (OSError, ValueError) as error:
        return f"not a .npy file ({str(error).splitlines()[0]})"
    if shape != (subcarriers,) or dtype.kind != "c":
        return f"{dtype} of shape {shape}"
    if path.stat().st_size - at != subcarriers * dtype.itemsize:
        return f"{path.stat().st_size - at} bytes for {subcarriers} symbols of {dtype.itemsize}"
    codes = np.fromfile(path, dtype, offset=at)
    lost, silent = int((~np.isfinite(codes)).sum()), int((codes == 0).sum())
    if lost or silent:
        return f"{lost} symbols that are no number, {silent} that are zero"
    return ""


def check_recordings(examined: Examination) -> Iterator[CampaignError]:
    """Yield recordings that do not open, or were recorded at another carrier or sample rate than the waveform's."""
    yield from examined.recording_problems
    waveform = examined.waveform
    if waveform is None:
        return
    transmitted = examined.transmitted
    for recording in examined.recordings.values():
        keys = (("sample_rate_hz", "core:sample_rate"), ("carrier_hz", "core:frequency"))
        recorded = recording.sample_rate_hz, recording.frequency_hz
        for (key, name), value in zip(keys, recorded, strict=True):
            stated = float(getattr(waveform, key))
            if not abs(value - stated) <= _SAME * stated:
                yield CampaignError(
                    f"{name} {value:.6f}",
                    where=recording.files[0],
                    expected=f"{stated:.6f}, as {CONFIG}: waveform.{key}",
                    remedy="Correct whichever is wrong; every node of a flight shares one waveform.",
                )
        try:
            if transmitted is not None:
                check_mixing(recording.samples, transmitted.numerology, where=recording.files[0])
        except CampaignError as problem:
            yield problem
        preamble = recording.framing["preamble"] if recording.framing else None
        if not preamble:
            continue
        path = paths.inside(examined.campaign.root, preamble, where=f"{recording.files[0]}: apertura:framing.preamble")
        if not path.is_file():
            yield CampaignError(
                "no such file",
                where=path,
                expected=f"the preamble that {recording.files[0].name}: apertura:framing names",
                remedy="Copy it there.",
            )


def check_channels(examined: Examination) -> Iterator[CampaignError]:
    """Yield receivers without the channels they need, or with captures shorter than prefix and DFT window."""
    waveform = examined.waveform
    if waveform is None:
        return
    for flight in examined.campaign.flights:
        for node in flight.nodes:
            key = (flight.name, node)
            if key in examined.recorded:
                facts, meta = examined.recorded[key], examined.recordings[key].files[0]
                yield from _channels(facts, meta, node, secondary=node != flight.transmitter)
                yield from _long_enough(facts, meta, waveform)


def _channels(recording: RecordingFacts, meta: Path, node: str, *, secondary: bool) -> Iterator[CampaignError]:
    names = list(recording.channels)
    if secondary and "sidelink" not in names:
        yield CampaignError(
            f"apertura:channels {names}",
            where=meta,
            expected=f"a channel named 'sidelink': {node} receives what another node sends",
            remedy="Name the channel, or take the node out of the flight.",
        )
    if len(set(names)) < len(names):
        yield CampaignError(
            f"apertura:channels {names}, a name twice",
            where=meta,
            expected="another name for each channel",
            remedy="Correct the metadata.",
        )


def _long_enough(recording: RecordingFacts, meta: Path, waveform: SampledWaveform) -> Iterator[CampaignError]:
    if recording.runs_through:
        return
    if isinstance(waveform, OfdmWaveform):
        parts = (
            f"cyclic prefix ({waveform.prefix_samples}) and one period of "
            f"1/subcarrier_spacing_hz ({waveform.dft_samples})"
        )
    else:
        parts = "lead_s, pulse_s and listen_s of the waveform"
    if recording.capture_samples < waveform.needed_samples:
        yield CampaignError(
            f"captures of {recording.capture_samples} samples",
            where=meta,
            expected=f"at least {waveform.needed_samples}: {parts}",
            remedy=f"Correct the waveform in {CONFIG}, or record longer captures.",
        )


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
    if apart_s(recorded_span(tx), recorded_span(rx)) <= 1 / prf_hz:
        return None
    shift = shift_s(recorded_span(tx), recorded_span(rx))
    first, second = (" to ".join(map(iso, recorded_span(node))) for node in (tx, rx))
    return CampaignError(
        f"recorded {first} and {second}, {abs(shift):.1f} s apart{likely_cause(shift)}",
        where=where,
        expected="time tags of the same pulses",
        remedy="Check that both are of the same flight, and their core:datetime.",
    )


def check_segments(examined: Examination) -> Iterator[CampaignError]:
    """Yield pairs of which no pulse lies inside their lines of segments.tsv."""
    campaign = examined.campaign
    for flight in campaign.image_flights:
        tx = examined.recordings.get((flight.name, flight.transmitter))
        for pair in flight.pairs:
            lines = campaign.segments_of(flight.name, pair)
            if not lines or tx is None or any(_holds_pulse(tx, *line) for line in lines):
                continue
            first, last = map(iso, recorded_span(tx))
            yield CampaignError(
                f"no pulse of flight {flight.name}, pair {pair} inside {' or '.join('…'.join(line) for line in lines)}",
                where=campaign.root / SEGMENTS,
                expected=f"times between {first} and {last}, UTC",
                remedy="Correct start and end, or take the lines out to image with the whole track.",
            )


def _holds_pulse(recording: Recording, begun: str, ended: str) -> bool:
    start, end = np.datetime64(begun), np.datetime64(ended)
    if recording.framing is not None:
        first, last = recorded_span(recording)
        return bool(start <= last and end >= first)
    return bool(inside(recording.captures.time, (start, end)).any())
