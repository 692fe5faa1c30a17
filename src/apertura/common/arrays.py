"""Type aliases of arrays for signatures."""

from numbers import Real
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Complexes: TypeAlias = NDArray[np.complex64]
Bools: TypeAlias = NDArray[np.bool_]
Times: TypeAlias = NDArray[np.datetime64]


def is_number(value: Any) -> bool:
    """Return True if a value is a finite real number and not a boolean.

    Examples
    --------
    >>> [is_number(value) for value in (1, np.float32(2), np.nan, True, "3", None)]
    [True, True, False, False, False, False]
    """
    return isinstance(value, Real) and not isinstance(value, bool) and bool(np.isfinite(float(value)))
