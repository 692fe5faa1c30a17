"""Captures cut from a recording that never stopped, at the preamble before each symbol."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.echo.framing import Framing
from apertura.echo.trigger import Samples, find_preambles

_SAMPLES_AT_ONCE = 2**18
_BITS = 16


@dataclass(frozen=True)
class TriggeredRate:
    """What a triggered recorder would have kept of a recording.

    Attributes
    ----------
    duty_cycle
        γ, share of the time that is captured.
    mean_rate_bit_s
        C = 2·f_s·ν·γ, of one channel: I and Q of ν bits.
    """

    duty_cycle: float
    mean_rate_bit_s: float


@dataclass(frozen=True)
class TriggeredCaptures:
    """What a triggered recorder would have captured of a recording.

    Attributes
    ----------
    start
        (capture,) int64, first sample of each symbol's cyclic prefix.
    frame
        (capture,) int64, frame number sent before it, -1 where not read.
    report
        Captures, rate of false alarms, median SNR, duty cycle and mean data rate.
    """

    start: NDArray[np.int64]
    frame: NDArray[np.int64]
    report: dict[str, Any]


def trigger_captures(
    samples: Samples, framing: Framing, *, symbol_samples: int, false_alarms_per_s: float
) -> TriggeredCaptures:
    """Return the symbols of a continuous recording that follow a preamble and end inside it.

    Parameters
    ----------
    samples
        (sample, 2) int16, I and Q of the trigger's channel; may be memory-mapped, is read in blocks.
    framing, symbol_samples, false_alarms_per_s
        As `find_preambles`.
    """
    detections = [
        detection
        for detection in find_preambles(
            _blocks(samples), framing, symbol_samples=symbol_samples, false_alarms_per_s=false_alarms_per_s
        )
        if detection.sample + framing.lead_samples + symbol_samples <= len(samples)
    ]
    places = np.array([detection.sample for detection in detections], np.int64)
    numbers = [framing.read_counter(samples[place : place + framing.lead_samples]) for place in places]
    rate = triggered_rate(
        len(detections),
        symbol_samples,
        recorded_samples=len(samples),
        sample_rate_hz=framing.sample_rate_hz,
        bits=_BITS,
    )
    snr_db = round(float(np.median([detection.snr_db for detection in detections])), 2) if detections else None
    report = {"captures": len(detections), "false_alarms_per_s": false_alarms_per_s, "snr_db": snr_db, **asdict(rate)}
    return TriggeredCaptures(places + framing.lead_samples, np.array(numbers, np.int64), report)


def triggered_rate(
    captures: int, symbol_samples: int, *, recorded_samples: int, sample_rate_hz: float, bits: int
) -> TriggeredRate:
    """Return duty cycle and mean data rate of captures cut from a recording.

    Examples
    --------
    >>> triggered_rate(100, 16000, recorded_samples=1_024_000_000, sample_rate_hz=1.024e9, bits=14)
    TriggeredRate(duty_cycle=0.0015625, mean_rate_bit_s=44800000.0)
    """
    duty = captures * symbol_samples / recorded_samples
    return TriggeredRate(duty, 2 * sample_rate_hz * bits * duty)


def _blocks(samples: Samples) -> Iterator[Samples]:
    for start in range(0, len(samples), _SAMPLES_AT_ONCE):
        yield samples[start : start + _SAMPLES_AT_ONCE]
