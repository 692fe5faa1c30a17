"""Captures cut from a recording that never stopped, at the preamble before each symbol."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from apertura.core.echo.captures import Samples
from apertura.core.echo.framing import Framing
from apertura.core.echo.trigger import find_preambles

_SAMPLES_AT_ONCE = 2**18


class SampleSource(Protocol):
    """(sample, 2), I and Q: an array, or what reads slices of one from a file."""

    def __len__(self) -> int: ...

    def __getitem__(self, span: slice, /) -> Samples: ...


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
    samples: SampleSource, framing: Framing, *, symbol_samples: int, false_alarms_per_s: float, sample_bits: int = 32
) -> TriggeredCaptures:
    """Return the symbols of a continuous recording that follow a preamble and end inside it.

    Parameters
    ----------
    samples
        (sample, 2), I and Q of the trigger's channel; read in blocks.
    framing, symbol_samples, false_alarms_per_s
        As for `find_preambles`.
    sample_bits
        Of a sample of one channel as it was recorded.
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
    duty_cycle = len(detections) * symbol_samples / len(samples)
    report = {
        "captures": len(detections),
        "false_alarms_per_s": false_alarms_per_s,
        "snr_db": round(float(np.median([one.snr_db for one in detections])), 2) if detections else None,
        "duty_cycle": duty_cycle,
        "mean_rate_bit_s": framing.sample_rate_hz * sample_bits * duty_cycle,  # of one channel
    }
    return TriggeredCaptures(places + framing.lead_samples, np.array(numbers, np.int64), report)


def _blocks(samples: SampleSource) -> Iterator[Samples]:
    for start in range(0, len(samples), _SAMPLES_AT_ONCE):
        yield samples[start : start + _SAMPLES_AT_ONCE]
