"""Stages saved at once, and opened after checking."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apertura.contracts import check
from apertura.store.manifest import check_files
from apertura.store.progress import finish, writable_zarr, writing

if TYPE_CHECKING:
    import xarray as xr


def save_stage(
    dataset: "xr.Dataset",
    folder: Path,
    *,
    chunks: Mapping[str, int] | None = None,
    lineage: Mapping[str, Any] | None = None,
) -> None:
    """Write a stage at once: `folder`.wip, rename, manifest.

    Parameters
    ----------
    dataset
        A stamped stage.
    folder
        ``…/<stage>.zarr``.
    chunks
        Dimension → chunk length; a dimension not named is one chunk.
    lineage
        What it was made from, as `apertura.store.manifest.write_manifest` takes it.
    """
    writable_zarr()
    with writing(folder) as wip:
        shutil.rmtree(wip, ignore_errors=True)
        encoding: dict[Any, dict[str, Any]] = {
            name: {"chunks": tuple((chunks or {}).get(str(dim), size) for dim, size in array.sizes.items())}
            for name, array in dataset.variables.items()
            if array.ndim and array.size
        }
        for name in set(encoding) & {"time"}:
            encoding[name] |= {"units": "nanoseconds since 1970-01-01", "dtype": "int64"}
        for name, array in dataset.data_vars.items():
            if "spatial_ref" in dataset.variables and {"y", "x"} <= set(array.dims):
                encoding[name]["grid_mapping"] = "spatial_ref"
        dataset.to_zarr(wip, mode="w", consolidated=False, zarr_format=3, encoding=encoding)
        finish(wip, folder, lineage=lineage)


def open_stage(folder: Path, stage: str) -> "xr.Dataset":
    """Open a finished stage lazily after checking its files against the manifest and its arrays against the contract.

    Raises
    ------
    CampaignError
        If the folder is missing, or is not what the manifest describes.
    ContractError
        If its arrays break the contract.
    """
    import xarray as xr

    check_files(folder)
    return check(xr.open_zarr(folder, consolidated=False, chunks=None), stage)
