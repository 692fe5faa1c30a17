"""Extraction of variables from MATLAB files, versions 4 to 7.3; run by `read_isolated`, with minimal imports."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FIELDS = ("fp", "freq", "x", "y", "z", "r0")

CORRECTIONS = ("r_correct", "ph_correct")
"""Fields of data.af: corrections of r0 (m) and of the phase (rad) of each pulse, not applied in the data set."""

_HDF5 = b"\x89HDF\r\n\x1a\n"
_USER_BLOCK = 512


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Read fp (subcarrier, pulse) complex64; freq, x, y, z, r0 and, if present, `CORRECTIONS`, float64.

    Parameters
    ----------
    path
        MATLAB file, version 4 to 7.3.

    Raises
    ------
    ValueError
        If a field is missing or is not an array of numbers.
    """
    variables = read_variables(path, ["data"])
    if not isinstance(variables.get("data"), Mapping):
        raise ValueError("no structure data")
    data = variables["data"]
    stored = data.get("af")
    corrections = {name: stored[name] for name in CORRECTIONS if isinstance(stored, Mapping) and name in stored}
    named = {name: data.get(name) for name in _FIELDS}
    return {name: _numbers(name, value) for name, value in (named | corrections).items()}


def read_variables(path: Path, names: list[str]) -> dict[str, Any]:
    """Read variables of a MATLAB file: an array for each variable, or a mapping field → value for a structure.

    Parameters
    ----------
    path
        The file.
    names
        Requested variables; missing variables are omitted.

    Raises
    ------
    ValueError
        If the file is damaged, or part of it is stored in another file.
    """
    with path.open("rb") as stream:
        stream.seek(_USER_BLOCK)
        is_hdf5 = stream.read(len(_HDF5)) == _HDF5  # signature written by `save -v7.3`
    if is_hdf5:
        import h5py

        with h5py.File(path, "r") as file:
            return {name: _of_hdf5(file, name) for name in names if name in file}
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadWarning

    with warnings.catch_warnings():
        warnings.simplefilter("error", MatReadWarning)  # scipy only warns about a damaged or repeated variable
        try:
            document = loadmat(path, struct_as_record=False, squeeze_me=True, variable_names=names)
        except MatReadWarning as warning:
            raise ValueError(f"a damaged or repeated variable ({warning})") from warning
    return {name: _plain(document[name]) for name in names if name in document}


def _plain(value: Any) -> Any:
    names = getattr(value, "_fieldnames", None)
    return value if names is None else {name: _plain(getattr(value, name)) for name in names}


def _of_hdf5(group: Any, name: str) -> Any:
    """Read a variable of a version 7.3 file, in which the order of array axes is reversed."""
    import h5py

    link = group.get(name, getlink=True)
    value = group[name] if isinstance(link, h5py.HardLink) else None
    if isinstance(value, h5py.Group):
        return {field: _of_hdf5(value, field) for field in value}
    # links, external storage and virtual arrays could read any file outside the campaign
    if not isinstance(value, h5py.Dataset) or value.external or value.is_virtual:
        raise ValueError(f"{name} is not an array stored in this file")
    array = np.asarray(value[()]).T
    if array.dtype.names is not None and set(array.dtype.names) == {"real", "imag"}:
        array = array["real"] + 1j * array["imag"]
    return np.squeeze(array)


def _numbers(name: str, value: object) -> NDArray[Any]:
    if value is None:
        raise ValueError(f"no field data.{name}")
    array = np.asarray(value)
    kinds, least = ("fiuc", 2) if name == "fp" else ("fiu", 0)
    if array.dtype.kind not in kinds or array.size == 0 or not least <= array.ndim <= max(least, 1):
        raise ValueError(f"field data.{name} is {array.dtype} of shape {array.shape}")
    if name != "fp":
        return np.atleast_1d(array).astype(np.float64)
    with np.errstate(over="ignore"):  # overflow becomes infinity and is rejected later
        return array.astype(np.complex64)
