"""Stages on disk: zarr folders that are whole or absent, each beside a manifest of hashes.

A stage is written as ``<stage>.zarr.wip`` under a kernel lock, finished by a rename, and described by
``<stage>.manifest.json``, which is written last: where the manifest stands, the folder is whole.
"""

import zarr

from apertura.store.locks import finish, sharing, writing
from apertura.store.manifest import manifest_of, write_json
from apertura.store.progress import lay_out, tiles_missing
from apertura.store.stages import open_stage, save_stage

# An all-zero chunk must exist on disk: a missing chunk means "not computed yet".
zarr.config.set({"array.write_empty_chunks": True})

__all__ = [
    "finish",
    "lay_out",
    "manifest_of",
    "open_stage",
    "save_stage",
    "sharing",
    "tiles_missing",
    "write_json",
    "writing",
]
