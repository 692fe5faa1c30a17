"""The layout of a phase history in an HDF5 file or a zarr folder: that of stage `echo`, field by field.

docs/formats/phase_history.md, "HDF5 and zarr", is written from this table; readers of both bring arrays by these names.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import quoted
from apertura.formats.phase_histories.phase_history import LARGEST, History, largest_by_row, refused

EXPECTED = (
    "arrays transfer, frequency, time, tx_position, rx_position, reference_delay and attribute frame, as documented"
)

TIME_UNITS = "nanoseconds since 1970-01-01"
"""Attribute `units` of `time`, which counts in UTC."""


class Field(NamedTuple):
    """Required type and shape of an array of a file."""

    dims: tuple[str, ...]
    kinds: str
    """Of numpy's dtypes."""
    largest: float
    """Range of its values."""
    optional: bool = False


LAYOUT: Mapping[str, Field] = {
    "transfer": Field(("pulse", "subcarrier"), "c", LARGEST),
    "frequency": Field(("subcarrier",), "fiu", 1e12),
    "time": Field(("pulse",), "i", 9e18),
    "tx_position": Field(("pulse", "axis"), "fiu", 1e8, optional=True),
    "rx_position": Field(("pulse", "axis"), "fiu", 1e8, optional=True),
    "reference_delay": Field(("pulse",), "fiu", 1.0),
    "path_limit": Field(("pulse",), "fiu", 1e12, optional=True),
}
"""Name → array of the layout; Hz, metres, seconds."""

POSITIONS = ("tx_position", "rx_position")
"""Left out where flight logs hold them."""


def check_array(name: str, shape: Sequence[int], dtype: np.dtype[Any]) -> None:
    """Raise ValueError if an array of a file, not read yet, violates the layout.

    Examples
    --------
    >>> check_array("time", (5,), np.dtype("float64"))
    Traceback (most recent call last):
    ValueError: time holds float64 of shape (5,), and not numbers of kind i along (pulse)
    """
    field = LAYOUT[name]
    least = {"pulse": 1, "subcarrier": 2, "axis": 3}
    fits = len(shape) == len(field.dims) and all(
        size >= least[dim] and (dim != "axis" or size == least[dim])
        for dim, size in zip(field.dims, shape, strict=False)
    )
    if dtype.kind not in field.kinds or not fits:
        raise ValueError(
            f"{name} holds {dtype} of shape {tuple(shape)}, and not numbers of kind {field.kinds} along "
            f"({', '.join(field.dims)})"
        )


def check_attributes(frame: object, units: object, *, placed: bool) -> None:
    """Raise ValueError unless a file names the frame of its positions, where it has any, and what its times count.

    Examples
    --------
    >>> check_attributes("ecef", "seconds since 1970-01-01", placed=True)
    Traceback (most recent call last):
    ValueError: units 'seconds since 1970-01-01' of time, and not 'nanoseconds since 1970-01-01' (UTC)
    """
    if placed and frame not in {"ecef", "local"}:
        raise ValueError(f"frame {quoted(frame)}, and neither 'ecef' nor 'local'")
    if units != TIME_UNITS:
        raise ValueError(f"units {quoted(units)} of time, and not {TIME_UNITS!r} (UTC)")


def history(path: Path, fields: Mapping[str, NDArray[Any]]) -> History:
    """Return the arrays of a file of this layout.

    Parameters
    ----------
    path
        The file or folder, for messages.
    fields
        Arrays of `LAYOUT`, each with the dimensions that `check_array` requires, and ``frame`` as text, which counts
        where there are positions.

    Raises
    ------
    CampaignError
        If lengths do not fit each other, or a value is not a number or larger than any radar's.
    """
    refuse = partial(refused, path=path, expected=EXPECTED)
    there = {name: field for name, field in LAYOUT.items() if name in fields}
    placed = [name for name in POSITIONS if name in fields]
    if len(placed) == 1:
        raise refuse(f"{placed[0]} alone, where both antennas have a position, or neither")
    sizes: dict[str, int] = {}
    for name, field in there.items():
        for dim, size in zip(field.dims, fields[name].shape, strict=True):
            if sizes.setdefault(dim, size) != size:
                raise refuse(f"{name} has {size} along {dim}, where others have {sizes[dim]}")
    loudest = {
        name: largest_by_row(name, fields[name], field.largest, refuse)
        for name, field in there.items()
        if name != "path_limit"
    }
    limit = np.asarray(fields.get("path_limit", np.full(sizes["pulse"], np.inf)), np.float64)
    if not (limit > 0).all():
        raise refuse("a path_limit that is not positive")
    silent = loudest["transfer"] == 0
    tx, rx = (np.asarray(fields[name], np.float64) if placed else None for name in POSITIONS)
    return History(
        path,
        np.asarray(fields["time"], np.int64).astype("datetime64[ns]"),
        tx,
        rx,
        transfer=fields["transfer"],
        frequency=np.asarray(fields["frequency"], np.float64),
        reference_delay=np.asarray(fields["reference_delay"], np.float64),
        path_limit=limit,
        used=~silent,
        frame=str(fields["frame"]) if placed else "",
        dropped={"silent": int(silent.sum())} if silent.any() else {},
    )
