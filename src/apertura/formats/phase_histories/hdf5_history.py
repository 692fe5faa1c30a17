"""Phase history in an HDF5 file of a documented layout, through h5py in a process of its own."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.formats.isolated import UnreadableError, read_isolated
from apertura.formats.phase_histories.history_layout import EXPECTED, LAYOUT, check_array, check_attributes, history
from apertura.formats.phase_histories.phase_history import joined, refused

if TYPE_CHECKING:
    import xarray as xr

_EXPECTED = f"an HDF5 file of {EXPECTED}"


def read_hdf5_history(paths: Sequence[Path], *, pair: str) -> "xr.Dataset":
    """Return the `echo` stage of HDF5 files, joined in the order of their names.

    Raises
    ------
    CampaignError
        If a file is not of the layout of docs/formats/phase_history.md.
    """
    paths = sorted(paths)
    try:
        files = read_isolated(read_fields, paths)
    except UnreadableError as error:
        raise refused(f"not readable ({error})", error.path, _EXPECTED) from error
    return joined([history(*one) for one in zip(paths, files, strict=True)], pair=pair, expected=_EXPECTED)


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an HDF5 file that the layout names; run by `read_isolated`.

    Raises
    ------
    ValueError
        If one is missing, is not of the layout, or is kept in another file.
    """
    import h5py

    with h5py.File(path, "r") as file:
        fields = {name: _array(file, name) for name, field in LAYOUT.items() if name in file or not field.optional}
        frame = file.attrs.get("frame")
        check_attributes(frame, file["time"].attrs.get("units"), placed="tx_position" in fields)
    return fields | {"frame": np.array(frame or "")}


def _array(file: Any, name: str) -> NDArray[Any]:
    import h5py

    link = file.get(name, getlink=True)
    if link is None:
        raise ValueError(f"no array {name}")
    # what lies in another file is not the campaign's: a link, external storage or a virtual array could name any
    array = file[name] if isinstance(link, h5py.HardLink) else None
    if not isinstance(array, h5py.Dataset) or array.external or array.is_virtual:
        raise ValueError(f"{name} is no array in this file itself")
    check_array(name, array.shape or (), array.dtype)
    with np.errstate(over="ignore"):  # becomes infinite, and is refused as such
        return np.asarray(array[...], np.complex64) if name == "transfer" else np.asarray(array[...])
