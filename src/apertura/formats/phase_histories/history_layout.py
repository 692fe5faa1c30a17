"""Layout of a phase history in an HDF5 file or a Zarr folder, with the fields of stage `echo`.

docs/formats/phase_history.md, "HDF5 and zarr", documents this table; the readers of both formats return these arrays.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import quoted
from apertura.formats.phase_histories.phase_history import LARGEST, LEAST, History, largest_by_row, refused

EXPECTED = (
    "arrays transfer, frequency, time, tx_position, rx_position, reference_delay and attribute frame, as documented"
)

TIME_UNITS = "nanoseconds since 1970-01-01"
"""Attribute `units` of `time`, in UTC."""


class Field(NamedTuple):
    """Required type and shape of an array in a file."""

    dims: tuple[str, ...]
    kinds: str
    """Accepted dtype kinds of NumPy."""
    largest: float
    """Largest magnitude."""
    optional: bool = False
    least: float = 0.0
    """Smallest accepted magnitude of the largest value."""


LAYOUT: Mapping[str, Field] = {
    "transfer": Field(("pulse", "subcarrier"), "c", LARGEST, least=LEAST),
    "frequency": Field(("subcarrier",), "fiu", 1e12),
    "time": Field(("pulse",), "i", 9e18),
    "tx_position": Field(("pulse", "axis"), "fiu", 1e8, optional=True),
    "rx_position": Field(("pulse", "axis"), "fiu", 1e8, optional=True),
    "reference_delay": Field(("pulse",), "fiu", 1.0),
    "path_limit": Field(("pulse",), "fiu", 1e12, optional=True),
}
"""Name → array of the layout; in Hz, metres, seconds."""

POSITIONS = ("tx_position", "rx_position")
"""Arrays that are omitted if positions come from flight logs."""


def check_array(name: str, shape: Sequence[int], dtype: np.dtype[Any]) -> None:
    """Raise ValueError if the shape or dtype of an array violates the layout.

    Examples
    --------
    >>> check_array("time", (5,), np.dtype("float64"))
    Traceback (most recent call last):
    ValueError: time is float64 of shape (5,), not of dtype kind i along (pulse)
    """
    field = LAYOUT[name]
    least = {"pulse": 1, "subcarrier": 2, "axis": 3}
    fits = len(shape) == len(field.dims) and all(
        size >= least[dim] and (dim != "axis" or size == least[dim])
        for dim, size in zip(field.dims, shape, strict=False)
    )
    if dtype.kind not in field.kinds or not fits:
        raise ValueError(
            f"{name} is {dtype} of shape {tuple(shape)}, not of dtype kind {' or '.join(field.kinds)} along "
            f"({', '.join(field.dims)})"
        )


def check_attributes(frame: object, units: object, *, placed: bool) -> None:
    """Raise ValueError unless a file specifies the units of its times and, if `placed`, the frame of its positions.

    Examples
    --------
    >>> check_attributes("ecef", "seconds since 1970-01-01", placed=True)
    Traceback (most recent call last):
    ValueError: units of time are 'seconds since 1970-01-01', not 'nanoseconds since 1970-01-01' (UTC)
    """
    if placed and frame not in {"ecef", "local"}:
        raise ValueError(f"frame is {quoted(frame)}, not 'ecef' or 'local'")
    if units != TIME_UNITS:
        raise ValueError(f"units of time are {quoted(units)}, not {TIME_UNITS!r} (UTC)")


def history(path: Path, fields: Mapping[str, NDArray[Any]]) -> History:
    """Convert the arrays of a file of this layout to a phase history.

    Parameters
    ----------
    path
        The file or folder, for messages.
    fields
        Arrays of `LAYOUT` with the dimensions required by `check_array`, and text ``frame``, which is used if the file
        contains positions.

    Raises
    ------
    CampaignError
        If array lengths are inconsistent, or a value is not finite or out of range.
    """
    refuse = partial(refused, path=path, expected=EXPECTED)
    present = {name: field for name, field in LAYOUT.items() if name in fields}
    positions = [name for name in POSITIONS if name in fields]
    if len(positions) == 1:
        raise refuse(f"{positions[0]} without the position of the other antenna")
    sizes: dict[str, int] = {}
    for name, field in present.items():
        for dim, size in zip(field.dims, fields[name].shape, strict=True):
            if sizes.setdefault(dim, size) != size:
                raise refuse(f"{name} has length {size} along {dim}, other arrays {sizes[dim]}")
    maxima = {
        name: largest_by_row(name, fields[name], field.largest, refuse, least=field.least)
        for name, field in present.items()
        if name != "path_limit"
    }
    limit = np.asarray(fields.get("path_limit", np.full(sizes["pulse"], np.inf)), np.float64)
    if not (limit > 0).all():
        raise refuse("a path_limit that is not positive")
    is_zero = maxima["transfer"] == 0
    tx, rx = (np.asarray(fields[name], np.float64) if positions else None for name in POSITIONS)
    return History(
        path,
        np.asarray(fields["time"], np.int64).astype("datetime64[ns]"),
        tx,
        rx,
        transfer=fields["transfer"],
        frequency=np.asarray(fields["frequency"], np.float64),
        reference_delay=np.asarray(fields["reference_delay"], np.float64),
        path_limit=limit,
        used=~is_zero,
        frame=str(fields["frame"]) if positions else "",
        dropped={"all samples zero": int(is_zero.sum())} if is_zero.any() else {},
    )
