"""Stages on disk: zarr folders that are complete or absent, each beside a manifest of hashes.

A stage is written as ``<stage>.zarr.wip`` under a kernel lock, finished by a rename, and described by
``<stage>.manifest.json``, which is written last: where the manifest stands, the folder is complete.
"""

from apertura.store.manifest import manifest_of
from apertura.store.progress import create, finish, missing, open_array, resume, sharing, writing
from apertura.store.stages import open_stage, save_stage

__all__ = [
    "create",
    "finish",
    "manifest_of",
    "missing",
    "open_array",
    "open_stage",
    "resume",
    "save_stage",
    "sharing",
    "writing",
]
