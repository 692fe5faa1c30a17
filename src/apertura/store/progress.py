"""Work in progress: a stage laid out, whose blocks are written one by one and picked up after a kill."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import xarray as xr
import zarr

from apertura.contracts import Window

_PROVENANCE = ("runspec", "inputs", "code_sha256")


def tiles_missing(wip: Path, empty: xr.Dataset, name: str, windows: Sequence[Window]) -> list[Window]:
    """Return the windows of array `name` that `wip` does not hold yet, starting `wip` afresh if it is other work.

    Parameters
    ----------
    wip
        Work in progress, from `writing`.
    empty
        The stamped stage; of array `name` only shape and dtype count, so it may be a broadcast zero.
    name
        The array that is written tile by tile.
    windows
        Every tile, square but at the edges; the first one's shape is the chunk's.

    Notes
    -----
    A chunk file is written beside and renamed, so one that exists is whole. Work in progress is other work
    when its settings, inputs or code differ.
    """
    if not is_work_on(wip, empty):
        lay_out(wip, empty, {name: _side(windows)})
    return not_written(wip, name, windows)


def not_written(wip: Path, name: str, windows: Sequence[Window]) -> list[Window]:
    """Return the windows of array `name` whose chunks `wip`, laid out before, does not hold."""
    chunks, (high, wide) = wip / name / "c", _side(windows)
    return [
        (rows, columns)
        for rows, columns in windows
        if not (chunks / str(rows.start // high) / str(columns.start // wide)).is_file()
    ]


def _side(windows: Sequence[Window]) -> tuple[int, ...]:
    return tuple(part.stop - part.start for part in windows[0])


def lay_out(wip: Path, empty: xr.Dataset, chunks: Mapping[str, tuple[int, ...]]) -> None:
    """Start `wip` afresh: metadata and coordinates of `empty`, and arrays to be written block by block.

    Parameters
    ----------
    wip
        Work in progress, from `writing`; what is there is thrown away.
    empty
        The stamped stage; of the arrays in `chunks` only dims, dtype and attributes count, so they may be broadcast.
    chunks
        Array name → shape of its chunks.
    """
    shutil.rmtree(wip, ignore_errors=True)
    empty.drop_vars(list(chunks)).to_zarr(wip, mode="w", consolidated=False, zarr_format=3)
    group = zarr.open_group(wip, mode="r+")
    for name, side in chunks.items():
        array = empty[name]
        group.create_array(
            name,
            shape=array.shape,
            chunks=side,
            dtype=array.dtype,
            fill_value=array.values.flat[0],  # what a block that nobody writes holds
            dimension_names=[str(dim) for dim in array.dims],
            attributes={**array.attrs, "grid_mapping": "spatial_ref"},
        )


def is_work_on(wip: Path, stage: xr.Dataset) -> bool:
    """Return whether `wip` was begun with the settings, inputs and code of the stamped `stage`."""
    asked = {key: stage.attrs[key] for key in _PROVENANCE}
    try:
        begun = zarr.open_group(wip, mode="r").attrs
        return {key: begun[key] for key in asked} == asked
    except (FileNotFoundError, KeyError, ValueError):
        return False
