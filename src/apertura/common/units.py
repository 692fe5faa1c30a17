"""Unit conversions: power ratios to decibels, times to seconds, frequencies to band letters."""

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats, Times


def decibels(power_ratio: float) -> float:
    """Convert a power ratio to decibels, with -300 dB as the lower limit.

    Examples
    --------
    >>> decibels(100.0), decibels(0.0)
    (20.0, -300.0)
    """
    return float(10 * np.log10(max(power_ratio, 1e-30)))


def seconds_since(times: Times, start: np.datetime64) -> Floats:
    """Convert times to seconds since `start`, (time,) float64.

    Examples
    --------
    >>> times = np.array(["2025-05-14T09:30:00", "2025-05-14T09:30:01.5"], "datetime64[ns]")
    >>> seconds_since(times, times[0])
    array([0. , 1.5])
    """
    return np.asarray((times - start) / np.timedelta64(1, "s"), np.float64)


def nanoseconds(times: Times) -> NDArray[np.int64]:
    """Convert times to nanoseconds since 1970-01-01.

    Examples
    --------
    >>> nanoseconds(np.array(["1970-01-01T00:00:01"], "datetime64[s]")).tolist()
    [1000000000]
    """
    return times.astype("datetime64[ns]").astype(np.int64)


_BANDS_GHZ = {
    "P": (0.25, 1.0),
    "L": (1.0, 2.0),
    "S": (2.0, 4.0),
    "C": (4.0, 8.0),
    "X": (8.0, 12.5),
    "Ku": (12.5, 18.0),
    "K": (18.0, 26.5),
    "Ka": (26.5, 40.0),
}
"""Frequency bands of the SAR extension of STAC, which defines no bands below P and above Ka."""


def frequency_band(frequency_hz: float) -> str | None:
    """Return the letter of the radar band of a frequency; None below 0.25 GHz and above 40 GHz.

    Examples
    --------
    >>> frequency_band(1.4e9), frequency_band(9.65e9), frequency_band(77e9)
    ('L', 'X', None)
    """
    ghz = frequency_hz / 1e9
    return next((name for name, (low, high) in _BANDS_GHZ.items() if low <= ghz < high), None)
