"""Stages saved at once, and opened after checking."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from apertura.common.atomic import naming, remove
from apertura.common.contracts import check
from apertura.pipeline.store.manifest import ResultOrigin, check_stage
from apertura.pipeline.store.progress import finish, writing

if TYPE_CHECKING:
    import xarray as xr


def save_stage(
    dataset: "xr.Dataset",
    folder: Path,
    *,
    chunks: Mapping[str, int] | None = None,
    lineage: ResultOrigin | None = None,
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
        Its sources, settings and code, for `apertura.pipeline.store.manifest.write_manifest`.
    """
    from apertura.pipeline.store.chunks import encoding_of

    with writing(folder) as wip, naming(folder):
        remove(wip)
        encoding = encoding_of(dataset, chunks or {})
        dataset.to_zarr(wip, mode="w", consolidated=False, zarr_format=3, encoding=encoding)
        finish(wip, folder, lineage=lineage)


def open_stage(folder: Path, stage: str) -> "xr.Dataset":
    """Open a finished stage lazily, after checking its metadata and coordinates against the manifest and the contract.

    Chunks are checked against the manifest as they are read.

    Raises
    ------
    CampaignError
        If the folder is missing or contradicts its manifest; on reading, if a chunk is damaged.
    ContractError
        If its arrays break the contract.
    """
    import xarray as xr

    from apertura.pipeline.store.chunks import StageStore

    store = StageStore(folder, read_only=True, sha256=check_stage(folder))
    return check(xr.open_zarr(store, consolidated=False, chunks=None), stage)
