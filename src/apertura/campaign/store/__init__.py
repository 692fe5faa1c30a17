"""Stages on disk: Zarr folders that are complete or absent, each with a manifest of hashes.

A stage is written as ``<stage>.zarr.wip`` under a kernel lock and finished by renaming the folder.
``<stage>.manifest.json`` is written last, so that the folder is complete if the manifest exists. Documents and products
have manifests of the same format, which contain the hashes of their files and their lineage.
"""

from apertura.campaign.store.manifest import (
    check_listed,
    compare,
    compare_origin,
    damaged_files,
    manifest_of,
    open_document,
    open_listed,
    read_manifest,
    record_files,
    remake,
    remake_from,
    save_document,
    sha256_present,
    states_origin,
)
from apertura.campaign.store.progress import (
    attributes_of,
    blocks_of_rows,
    create,
    describe_stage,
    finish,
    mark_rewritten,
    missing,
    open_array,
    open_stage,
    replacing,
    resume,
    save_stage,
    sharing,
    write_blocks,
    writing,
)

__all__ = [
    "attributes_of",
    "blocks_of_rows",
    "check_listed",
    "compare",
    "compare_origin",
    "create",
    "damaged_files",
    "describe_stage",
    "finish",
    "manifest_of",
    "mark_rewritten",
    "missing",
    "open_array",
    "open_document",
    "open_listed",
    "open_stage",
    "read_manifest",
    "record_files",
    "remake",
    "remake_from",
    "replacing",
    "resume",
    "save_document",
    "save_stage",
    "sha256_present",
    "sharing",
    "states_origin",
    "write_blocks",
    "writing",
]
