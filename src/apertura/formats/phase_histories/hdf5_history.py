"""Phase history in an HDF5 file of a documented layout, read by h5py in a separate process."""

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

_EXPECTED = f"an HDF5 file with {EXPECTED}"


def read_hdf5_history(paths: Sequence[Path], *, pair: str) -> "xr.Dataset":
    """Read HDF5 files, concatenated in the order of their names, as `echo` stage.

    Raises
    ------
    CampaignError
        If a file violates the layout in docs/formats/phase_history.md.
    """
    paths = sorted(paths)
    try:
        files = read_isolated(read_fields, paths)
    except UnreadableError as error:
        raise refused(f"not readable ({error})", error.path, _EXPECTED) from error
    histories = [history(path, fields) for path, fields in zip(paths, files, strict=True)]
    return joined(histories, pair=pair, expected=_EXPECTED)


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of the layout from an HDF5 file; run by `read_isolated`.

    Raises
    ------
    ValueError
        If an array is missing, violates the layout, or is stored in another file.
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
    # links, external storage and virtual arrays could read any file outside the campaign
    array = file[name] if isinstance(link, h5py.HardLink) else None
    if not isinstance(array, h5py.Dataset) or array.external or array.is_virtual:
        raise ValueError(f"{name} is not an array stored in this file")
    check_array(name, array.shape or (), array.dtype)
    with np.errstate(over="ignore"):  # overflow becomes infinity and is rejected later
        return np.asarray(array[...], np.complex64) if name == "transfer" else np.asarray(array[...])
