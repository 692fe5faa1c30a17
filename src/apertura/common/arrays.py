"""Types of arrays, by the names that signatures use; conversions to numbers that several layers need."""

from numbers import Real
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Complexes: TypeAlias = NDArray[np.complex64]
Bools: TypeAlias = NDArray[np.bool_]
Times: TypeAlias = NDArray[np.datetime64]


def is_number(value: Any) -> bool:
    """Test whether a value is one finite real number; true and false are none.

    Examples
    --------
    >>> [is_number(value) for value in (1, np.float32(2), np.nan, True, "3", None)]
    [True, True, False, False, False, False]
    """
    return isinstance(value, Real) and not isinstance(value, bool) and bool(np.isfinite(float(value)))


def decibels(power_ratio: float) -> float:
    """Return 10·log10 of a ratio of powers; -300 of none.

    Examples
    --------
    >>> decibels(100.0), decibels(0.0)
    (20.0, -300.0)
    """
    return float(10 * np.log10(max(power_ratio, 1e-30)))


def seconds_since(times: Times, start: np.datetime64) -> Floats:
    """Return the time elapsed from `start` to each of some times, seconds.

    Examples
    --------
    >>> seconds_since(np.array(["2025-05-14T09:30:01.5"], "datetime64[ns]"), np.datetime64("2025-05-14T09:30"))
    array([1.5])
    """
    return np.asarray((times - start) / np.timedelta64(1, "s"), np.float64)
