"""Phase history in a Zarr folder (version 3) of a documented layout, read by zarr in a separate process."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.confined import ConfinedPath
from apertura.common.documents import CODECS, other_codec
from apertura.common.errors import quoted
from apertura.formats.isolated import BYTES_PER_BYTE, UnreadableError, read_isolated
from apertura.formats.phase_histories.history_layout import EXPECTED, LAYOUT, check_array, check_attributes, history
from apertura.formats.phase_histories.phase_history import joined, refused

if TYPE_CHECKING:
    import xarray as xr

SUFFIX = ".zarr"

_EXPECTED = f"a Zarr folder (version 3) with {EXPECTED}"
_SPARE_BYTES = 4 << 30
"""Additional address space, bytes: the threads and the event loop of zarr reserve more memory than they use."""


def read_zarr_history(paths: Sequence[Path], *, pair: str) -> "xr.Dataset":
    """Read Zarr folders, concatenated in the order of their names, as `echo` stage; `paths`: files in the folders.

    Raises
    ------
    CampaignError
        If a folder violates the layout in docs/formats/phase_history.md.
    """
    folders = folders_of(paths)
    if not folders:
        raise refused("a file, not a folder", paths[0], _EXPECTED)
    for folder in folders:
        for path in (folder, *ConfinedPath.of(folder).rglob("*")):
            if path.is_symlink():
                raise refused("a symbolic link, which is not followed", path, _EXPECTED)
    sizes = [path.stat().st_size for path in paths]
    limits: dict[str, Any] = {"memory_bytes": _SPARE_BYTES + BYTES_PER_BYTE * sum(sizes)}
    try:
        read = read_isolated(read_fields, folders, **limits)
    except UnreadableError as error:
        raise refused(f"not readable ({error})", error.path, _EXPECTED) from error
    histories = [history(folder, fields) for folder, fields in zip(folders, read, strict=True)]
    return joined(histories, pair=pair, expected=_EXPECTED)


def folders_of(paths: Iterable[Path]) -> list[Path]:
    """Return the outermost Zarr folders that contain the files, sorted.

    Examples
    --------
    >>> [path.as_posix() for path in folders_of([Path("f/b.x.zarr/time/c/0"), Path("f/a.x.zarr/zarr.json")])]
    ['f/a.x.zarr', 'f/b.x.zarr']
    """
    above = ([folder for folder in path.parents if folder.suffix == SUFFIX] for path in paths)
    return sorted({folders[-1] for folders in above if folders})


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of the layout from a Zarr folder; run by `read_isolated`.

    Raises
    ------
    ValueError
        If an array is missing, violates the layout, or uses a codec that is not permitted.
    """
    path = ConfinedPath.at(path)
    group = _metadata(path)
    fields = {
        name: _array(path / name, name)
        for name, field in LAYOUT.items()
        if (path / name).is_dir() or not field.optional
    }
    frame = _mapping(group, "attributes").get("frame")
    units = _mapping(_metadata(path / "time"), "attributes").get("units")
    check_attributes(frame, units, placed="tx_position" in fields)
    return fields | {"frame": np.array(frame or "")}


def _array(folder: Path, name: str) -> NDArray[Any]:
    import zarr
    from zarr.storage import LocalStore

    other = other_codec(_metadata(folder))
    if other is not None:
        raise ValueError(f"{name} uses codec {quoted(other)}; permitted are {', '.join(sorted(CODECS))}")
    # open the array directly: consolidated metadata of the group has not been checked
    array = zarr.open_array(LocalStore(ConfinedPath.at(folder), read_only=True), mode="r", zarr_format=3)
    check_array(name, array.shape, np.dtype(array.dtype))
    with np.errstate(over="ignore"):  # overflow becomes infinity and is rejected later
        return np.asarray(array[...], np.complex64) if name == "transfer" else np.asarray(array[...])


def _metadata(folder: Path) -> Mapping[str, Any]:
    from apertura.common.documents import read_json

    path = folder / "zarr.json"
    if not path.is_file():
        raise ValueError(f"no {path.name} in {folder.name}")
    return read_json(path, expected="metadata of Zarr, version 3", remedy="Copy the folder again.")


def _mapping(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = document.get(key)
    return value if isinstance(value, Mapping) else {}
