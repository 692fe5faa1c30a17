"""Fields of the structure `data` in a MATLAB file; run by `read_isolated`, and importing no more than that takes."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FIELDS = ("fp", "freq", "x", "y", "z", "r0")


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Return fp (subcarrier, pulse) complex64 and freq, x, y, z, r0 float64 of one dimension.

    Parameters
    ----------
    path
        MATLAB file, version 4 to 7.

    Raises
    ------
    ValueError
        If a field is missing or is not an array of numbers.
    """
    from scipy.io import loadmat

    document = loadmat(path, squeeze_me=True, struct_as_record=False, variable_names=["data"])
    if "data" not in document:
        raise ValueError("no structure called data")
    return {name: _numbers(name, getattr(document["data"], name, None)) for name in _FIELDS}


def _numbers(name: str, value: object) -> NDArray[Any]:
    if value is None:
        raise ValueError(f"no field data.{name}")
    array = np.asarray(value)
    wanted, least = ("fiuc", 2) if name == "fp" else ("fiu", 0)
    if array.dtype.kind not in wanted or array.size == 0 or not least <= array.ndim <= max(least, 1):
        raise ValueError(f"field data.{name} holds {array.dtype} of shape {array.shape}")
    if name != "fp":
        return np.atleast_1d(array).astype(np.float64)
    with np.errstate(over="ignore"):  # becomes infinite, and is refused as such
        return array.astype(np.complex64)
