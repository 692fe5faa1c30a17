"""Times of recordings and logs: span, rate, gaps, and the overlap of two recordings or logs."""

from dataclasses import dataclass
from math import fsum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Times
from apertura.common.units import seconds_since
from apertura.formats.recordings.recording import Recording

Span = tuple[np.datetime64, np.datetime64]
"""First and last time."""

LOST_CAPTURE = 1.5
"""Separation of two captures, in intervals, above which a capture between them is missing."""

LAG = 16
"""Number of intervals over which a rate is additionally averaged, to reduce the effect of rounded times."""

_UNIX_DAYS = np.timedelta64(3650, "D")


@dataclass(frozen=True, eq=False)
class TimeFacts:
    """Times of a log or recording.

    Attributes
    ----------
    count
        Number of times.
    span
        First and last time.
    clock
        'UTC'; 'its own' for a clock that was never set; 'none' if the times only count pulses.
    interval_s
        Typical interval, seconds; inf for a single time.
    gap_at
        (gap,) intp: index of the first time after each gap.
    after_s, gap_s
        (gap,) float64: start of each gap, in seconds since the first time, and duration of each gap, seconds.
    """

    count: int
    span: Span
    clock: Literal["UTC", "its own", "none"]
    interval_s: float
    gap_at: NDArray[np.intp]
    after_s: NDArray[np.float64]
    gap_s: NDArray[np.float64]

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last time."""
        return float((self.span[1] - self.span[0]) / np.timedelta64(1, "s"))

    @property
    def rate_hz(self) -> float | None:
        """Rate of times outside gaps, Hz; None for a single time."""
        return 1 / self.interval_s if 0 < self.interval_s < np.inf else None

    @property
    def lost(self) -> int:
        """Number of missing times in all gaps."""
        return int((np.round(self.gap_s / self.interval_s) - 1).sum())


def time_facts(times: Times, *, longer: float) -> TimeFacts:
    """Summarise the times of a log or recording.

    Parameters
    ----------
    times
        (time,) datetime64[ns], ascending, at least one time.
    longer
        Minimum duration of a gap, in typical intervals.

    Examples
    --------
    >>> kept = np.delete(np.arange(40), [20, 21])
    >>> facts = time_facts(np.datetime64("2025-05-14", "ns") + kept * np.timedelta64(50, "ms"), longer=1.5)
    >>> facts.clock, round(facts.rate_hz, 9), facts.gap_at.tolist(), facts.gap_s.round(9).tolist(), facts.lost
    ('UTC', 20.0, [20], [0.15], 2)
    """
    late, elapsed_s = gaps(times, longer), seconds_since(times, times[0])
    return TimeFacts(
        count=len(times),
        span=(times[0], times[-1]),
        clock="none" if counted(times) else "its own" if own_clock(times) else "UTC",
        interval_s=interval_s(times),
        gap_at=late,
        after_s=elapsed_s[late - 1],
        gap_s=np.diff(elapsed_s)[late - 1],
    )


def iso(time: np.datetime64) -> str:
    """Format a time as date and time of day to the millisecond.

    Examples
    --------
    >>> iso(np.datetime64("2025-05-14T09:30:00.0021", "ns"))
    '2025-05-14T09:30:00.002'
    """
    return str(np.datetime_as_string(time, "ms"))


def utc(time: np.datetime64) -> str:
    """Format a time as ISO 8601 in UTC, to the millisecond.

    Examples
    --------
    >>> utc(np.datetime64("2025-05-14T09:30:00.1234567", "ns"))
    '2025-05-14T09:30:00.123Z'
    """
    return f"{iso(time)}Z"


def steps_s(times: Times, *, over: int = 1) -> NDArray[np.float64]:
    """Return (time - over,) float64: seconds from each time to the time `over` intervals later."""
    return np.asarray((times[over:] - times[:-over]) / np.timedelta64(1, "s"), np.float64)


def interval_s(times: Times) -> float:
    """Return the typical interval, seconds; inf for a single time.

    The median of single intervals selects the stretches without losses. The mean over these stretches is not limited by
    the resolution of the times.

    Examples
    --------
    >>> kept = np.delete(np.arange(60), np.arange(20, 60, 9))
    >>> coarse_ms = np.round(kept * 33.34).astype("timedelta64[ms]")
    >>> round(interval_s(np.datetime64("2025-05-14", "ns") + coarse_ms), 4)
    0.0333
    """
    if len(times) < 2:
        return np.inf
    single_s = float(np.median(steps_s(times)))
    lag = min(LAG, len(times) - 1)
    spans_s = steps_s(times, over=lag)
    whole_s = spans_s[np.abs(spans_s - lag * single_s) < single_s / 2]
    return fsum(whole_s) / (whole_s.size * lag) if whole_s.size else single_s


def gaps(times: Times, longer: float) -> NDArray[np.intp]:
    """Return the indices of times that follow a gap of more than `longer` typical intervals.

    Examples
    --------
    >>> kept = np.delete(np.arange(40), [20, 21])
    >>> gaps(np.datetime64("2025-05-14", "ns") + kept * np.timedelta64(50, "ms"), 1.5)
    array([20])
    """
    return np.flatnonzero(np.diff(seconds_since(times, times[0])) > longer * interval_s(times)) + 1


def own_clock(times: Times) -> bool:
    """Return True if times are within ten years of the Unix epoch, which indicates a clock that was never set.

    Examples
    --------
    >>> own_clock(np.array(["1970-01-01T00:00:05"], "datetime64[ns]"))
    True
    """
    return bool(times[0] < np.datetime64(0, "ns") + _UNIX_DAYS)


def counted(times: Times) -> bool:
    """Return True if times only count pulses, one per second from the Unix epoch, which indicates a missing clock.

    Examples
    --------
    >>> counted(np.arange(3).astype("datetime64[s]").astype("datetime64[ns]"))
    True
    """
    return own_clock(times) and bool((np.diff(times) == np.timedelta64(1, "s")).all())


def recorded_span(recording: Recording) -> Span:
    """Return the times of the first and last capture; for a continuous recording, of the first and last sample."""
    first, last = recording.captures.time[0], recording.captures.time[-1]
    if recording.framing is not None:
        last = last + np.timedelta64(round(len(recording.samples) / recording.sample_rate_hz * 1e9), "ns")
    return first, last


def frame_numbers(recording: Recording) -> NDArray[np.int64]:
    """Return the frame numbers of the captures that have a frame number, (n,) int64."""
    frame = recording.captures.frame
    return np.asarray(frame[frame >= 0])


def common_pulses(tx: Recording, rx: Recording, prf_hz: float) -> Times:
    """Return the transmitter's time tags of pulses that certainly have a match in the receiver's recording.

    Pulses are matched by frame numbers if both nodes record frame numbers; otherwise by the receiver's time span,
    reduced by one interval at either end. The result is empty if a frame counter wraps or a recording is continuous,
    because the pulses then cannot be identified from the headers.

    Parameters
    ----------
    tx, rx
        Recordings of the transmitting and of the receiving node, which may be the same node.
    prf_hz
        Pulses per second.
    """
    times = tx.captures.time
    if tx.framing is not None or rx.framing is not None:
        return times[:0]
    if tx is rx:
        return times
    numbers = frame_numbers(tx), frame_numbers(rx)
    if all(own.size for own in numbers):
        wrapped = any((np.diff(own) <= 0).any() for own in numbers)
        return times[:0] if wrapped else times[np.isin(tx.captures.frame, numbers[1])]
    interval = np.timedelta64(round(1e9 / prf_hz), "ns")
    first, last = recorded_span(rx)
    return times[inside(times, (first + interval, last - interval))]


def expected_pulses(tx: Recording, rx: Recording, prf_hz: float) -> Times:
    """Return the result of `common_pulses`, or, if that is empty, a regular series over the transmitter's recording."""
    times = common_pulses(tx, rx, prf_hz)
    if times.size:
        return times
    first, last = (time.astype("datetime64[ns]").astype(np.int64) for time in recorded_span(tx))
    count = max(2, round((last - first) * 1e-9 * prf_hz))
    return np.linspace(first, last, count).astype(np.int64).astype("datetime64[ns]")


def inside(times: Times, span: Span) -> NDArray[np.bool_]:
    """Return (time,) bool, True for times inside a span, including both ends.

    Examples
    --------
    >>> days = np.arange("2025-01-01", "2025-01-06", dtype="datetime64[D]")
    >>> inside(days, (days[1], days[3]))
    array([False,  True,  True,  True, False])
    """
    return np.asarray((times >= span[0]) & (times <= span[1]))


def seconds_between(first: Span, second: Span) -> float:
    """Return the time between two spans, seconds; 0 or less if they touch or overlap.

    Examples
    --------
    >>> first, second = (np.datetime64(f"2025-05-14T{time}", "ns") for time in ("09:30:00", "09:30:10"))
    >>> late = np.timedelta64(1, "h")
    >>> seconds_between((first, second), (first + late, second + late))
    3590.0
    >>> seconds_between((first, second), (second, second + late))
    0.0
    """
    one_second = np.timedelta64(1, "s")
    return float(max((second[0] - first[1]) / one_second, (first[0] - second[1]) / one_second))


def shift_s(first: Span, second: Span) -> float:
    """Return the delay of the midpoint of the second span relative to the midpoint of the first, seconds."""
    one_second = np.timedelta64(1, "s")
    return float(((second[0] - first[0]) / one_second + (second[1] - first[1]) / one_second) / 2)
