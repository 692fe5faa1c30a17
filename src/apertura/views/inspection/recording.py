"""A recording: captures, their times and numbers, and how strong the first of them are."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.formats.names import log_suffixes
from apertura.formats.reading import open_recording, read_track
from apertura.views.inspection.report import Report
from apertura.views.inspection.surroundings import NODE, Surroundings
from apertura.views.inspection.timing import own_clock, timing, utc

if TYPE_CHECKING:
    from apertura.formats.recordings.recording import Recording

LOST = 1.5
"""Intervals between captures from which on one is missing between them."""

FIRST = 128
"""Captures that are looked into."""

_MOST_SAMPLES = 1 << 21


def recording_report(files: Sequence[Path], beside: Surroundings) -> Report:
    """Return what is told of a recording.

    Parameters
    ----------
    files
        In the order of a row of `apertura.formats.names.RECORDERS`.
    beside
        Where they lie.

    Raises
    ------
    CampaignError
        If they are none.
    """
    recording = open_recording(files)
    samples = first_samples(recording)
    facts = recording_facts(recording) | {"first_captures": _levels(recording.channels, samples)}
    from apertura.views.inspection.pictures import draw_recording

    logs = sorted(files[0].parent.glob("*.track.*"))
    own = [log for log in logs if log.name.startswith(f"{_stem(files[0])}.track.")]
    missing = _missing(recording, facts, beside)
    missing += _against_log(recording, own[0], beside, facts) if own else [_no_log(_stem(files[0]))]
    return Report(
        files[0],
        "recording",
        Path(files[0]).suffix.lstrip("."),
        facts,
        tuple(missing),
        picture=lambda: draw_recording(recording, samples, files[0].name),
    )


def recording_facts(recording: "Recording") -> dict[str, Any]:
    """Return the facts of a recording's header."""
    captures = recording.captures
    found: dict[str, Any] = {
        "files": [file.name for file in recording.files],
        "channels": list(recording.channels),
        "sample_rate_hz": float(recording.sample_rate_hz),
        "carrier_hz": float(recording.frequency_hz) or None,
        "samples": len(recording.samples),
        "captures": len(captures.start),
        "capture_samples": captures.length,
    }
    if recording.framing is not None:
        length_s = len(recording.samples) / recording.sample_rate_hz
        return found | {"runs_through": True, "first_utc": utc(captures.time[0]), "duration_s": length_s}
    return found | timing(captures.time, longer=LOST) | {"frame_numbers": _numbered(captures.frame)}


def _numbered(frame: NDArray[np.int64]) -> dict[str, int] | None:
    """Return the span of frame numbers, how many in it are missing and how often the counter starts again."""
    known = frame[frame >= 0]
    if not known.size:
        return None
    steps = np.diff(known)
    lost = int((steps[steps > 1] - 1).sum())
    return {"first": int(known[0]), "last": int(known[-1]), "missing": lost, "restarts": int((steps <= 0).sum())}


def first_samples(recording: "Recording") -> NDArray[np.complex64]:
    """Return (capture, sample, channel) complex64: the first captures; of one that runs through its first samples."""
    captures = recording.captures
    each = min(captures.length, _MOST_SAMPLES)
    count = max(1, min(FIRST, len(captures.start), _MOST_SAMPLES // max(each, 1)))
    iq = recording.samples.captures(captures.start[:count], each).astype(np.float32)
    return np.asarray(iq[..., 0] + 1j * iq[..., 1], np.complex64)


def _levels(channels: Sequence[str], samples: NDArray[np.complex64]) -> dict[str, dict[str, float]]:
    """Return channel → RMS amplitude and the largest of either component, in counts of the recorder."""
    parts = samples.view(np.float32)
    peaks = np.abs(parts.reshape(-1, len(channels), 2)).max(axis=(0, 2))
    rms = np.sqrt(np.mean(np.abs(samples.astype(np.complex128)) ** 2, axis=(0, 1)))
    return {
        name: {"rms": float(one), "largest": float(peak)} for name, one, peak in zip(channels, rms, peaks, strict=True)
    }


def _missing(recording: "Recording", facts: dict[str, Any], beside: Surroundings) -> list[str]:
    found = []
    if not beside.waveform:
        stated = {"sample_rate_hz": facts["sample_rate_hz"], "carrier_hz": facts["carrier_hz"]}
        stated |= {"prf_hz": facts["rate_hz"]} if facts.get("rate_hz") else {}
        known = ", ".join(f"{key}: {value:.9g}" for key, value in stated.items() if value)
        found.append(f"what was transmitted: section waveform of config/config.yaml, with {known} as recorded here")
        found.append(f"its place: raw/<flight>/{NODE}{'|'.join(file.suffix for file in recording.files)} of a campaign")
    if not facts["carrier_hz"]:
        found.append("the carrier: the recording does not say; the one of the config will be taken")
    if len(recording.captures.start) == 1 and recording.framing is None:
        found.append("pulses: it is one capture; write one per trigger, or apertura:framing where the recorder ran on")
    if own_clock(recording.captures.time):
        found.append("the time: the recorder has a clock of its own; `apertura align` finds how it stands to the log's")
    return found


def _no_log(node: str) -> str:
    return f"where it was: no flight log {node}.track.<{'|'.join(log_suffixes())}> lies beside"


def _stem(file: Path) -> str:
    return file.name.removesuffix(file.suffix)


def _against_log(recording: "Recording", log: Path, beside: Surroundings, facts: dict[str, Any]) -> list[str]:
    """Return what of a recording its log leaves out; facts learn how much it covers."""
    try:
        logged = read_track(log, node=_stem(recording.files[0]), options=beside.options).time.values
    except CampaignError as problem:
        return [f"a readable flight log: {problem}"]
    facts["log_beside"] = log.name
    facts["captures_inside_log_share"] = inside = float(np.mean(within(recording.captures.time, logged)))
    if inside == 1.0:
        return []
    first, last = utc(logged[0]), utc(logged[-1])
    clocks = "; `apertura align` finds a clock that is off" if inside == 0 else ""
    return [f"positions for {1 - inside:.1%} of the captures: {log.name} lasts from {first} to {last}{clocks}"]


def within(times: NDArray[np.datetime64], logged: NDArray[np.datetime64]) -> NDArray[np.bool_]:
    """Return (time,) bool: whether a log lasts then.

    Examples
    --------
    >>> days = np.arange("2025-01-01", "2025-01-06", dtype="datetime64[D]")
    >>> within(days, days[1:4])
    array([False,  True,  True,  True, False])
    """
    return np.asarray((times >= logged[0]) & (times <= logged[-1]))
