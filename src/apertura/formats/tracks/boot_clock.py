"""An autopilot's clock, which counts from its start, against UTC: the line through what its receiver tells."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError

Floats = NDArray[np.float64]

_AGREES_S = 0.25  # receivers' messages are late by about 0.1 s, and now and then by some tens of milliseconds more
_FASTEST = 1e-4  # the worst of quartz clocks
_MOST_AGREE = 0.9


@dataclass(frozen=True)
class Clock:
    """The autopilot's clock against UTC: UTC = origin + offset_s + rate·boot_s, when it heard of epochs.

    Attributes
    ----------
    origin
        Some UTC near the log.
    offset_s, rate
        Of the line.
    delay_s
        By how much later than they were true epochs are heard of.
    """

    origin: np.datetime64
    offset_s: float
    rate: float
    delay_s: float

    def utc(self, boot_s: Floats) -> NDArray[np.datetime64]:
        """Return UTC of the autopilot's clock.

        Examples
        --------
        >>> clock = Clock(np.datetime64("2025-05-14T09:30:00", "ns"), 0.0, 1.0, 0.1)
        >>> str(clock.utc(np.array([1.1]))[0])
        '2025-05-14T09:30:01.200000000'
        """
        since = self.offset_s + self.rate * (boot_s + self.delay_s)
        return np.asarray(self.origin + np.rint(since * 1e9).astype("timedelta64[ns]"))

    def boot_s(self, utc: NDArray[np.datetime64]) -> Floats:
        """Return the autopilot's clock at UTC."""
        return np.asarray(((utc - self.origin) / np.timedelta64(1, "s") - self.offset_s) / self.rate - self.delay_s)


def clock_of(
    boot_s: Floats, time_utc: NDArray[np.datetime64], *, delay_s: float, where: Path
) -> tuple[Clock, NDArray[np.bool_]]:
    """Return the autopilot's clock against UTC, and which epochs agree with it: a line through what most say.

    Parameters
    ----------
    boot_s, time_utc
        (epoch,): the autopilot's clock when it heard of epochs, and their times.
    delay_s
        By how much it hears of them late.
    where
        The log, for messages.

    Raises
    ------
    CampaignError
        If more than a tenth of the epochs is 0.25 s off, as where the receiver learns of a leap second late.

    Examples
    --------
    >>> times = np.datetime64("2025-05-14T09:30:00", "ns") + np.array([0, 1, 2]) * np.timedelta64(1, "s")
    >>> clock, agree = clock_of(np.array([5.0, 6.0, 7.1]), times, delay_s=0.0, where=Path("x.ulg"))
    >>> str(clock.utc(np.array([6.0]))[0]), bool(agree.all())
    ('2025-05-14T09:30:01.000000000', True)
    """
    origin, zero = time_utc[0], float(np.median(boot_s))
    since = (time_utc - origin) / np.timedelta64(1, "s")
    ahead, beside = since - boot_s, boot_s - zero
    line = np.array([0.0, float(np.median(ahead))])
    reach = _AGREES_S + _FASTEST * float(np.ptp(boot_s)) / 2
    for _ in range(2):  # what is off by seconds goes before a line is laid through the rest
        near = np.abs(ahead - np.polyval(line, beside)) <= reach
        if near.sum() >= 8 and np.ptp(beside[near]) * _FASTEST > 0.01:
            line = np.polyfit(beside[near], ahead[near], 1)
        elif near.any():
            line = np.array([0.0, float(np.median(ahead[near]))])
        reach = _AGREES_S
    off = np.abs(ahead - np.polyval(line, beside))
    agree = off <= _AGREES_S
    if agree.mean() < _MOST_AGREE:
        first = int(np.flatnonzero(~agree)[0])
        raise CampaignError(
            f"{int((~agree).sum())} of {agree.size} times of the receiver do not fit the autopilot's clock; epoch "
            f"{first} at {time_utc[first]} is {off[first]:.2f} s off",
            where,
            f"one line within {_AGREES_S} s",
            "Cut the log where the receiver corrects its time, or take another source (nodes.<node>.log.body).",
        )
    slope, middle = (float(one) for one in line)
    return Clock(origin, middle - slope * zero, 1 + slope, delay_s), agree
