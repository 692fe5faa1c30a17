"""Which product a path means: its campaign folder, the manifest that lists it, and what the result consists of."""

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.pipeline.config import CONFIG
from apertura.pipeline.store import manifest_of, read_manifest

SUFFIX = ".manifest.json"

_EXPECTED = "a file or stage that the workflow wrote, a manifest, or a campaign folder"


@dataclass(frozen=True)
class Product:
    """What is asked about.

    Attributes
    ----------
    root
        The campaign folder.
    manifest
        Of the result it belongs to, relative to `root`; empty: nobody knows.
    file
        The file, stage or manifest itself, wherever it lies; None: the whole campaign.
    """

    root: Path
    manifest: str = ""
    file: Path | None = None


def find_product(path: Path, campaign: Path | None = None) -> Product:
    """Return the product that a path means.

    Parameters
    ----------
    path
        Absolute: a file, a stage or a manifest below results/, or a campaign folder.
    campaign
        Where a file that lies elsewhere was made.

    Raises
    ------
    CampaignError
        If it is not there, or belongs to no campaign.
    """
    if path.is_dir() and ((path / CONFIG).is_file() or (path / "results").is_dir()):
        return Product(path)
    results = next((folder for folder in unlinked(path).parents if folder.name == "results"), None)
    if campaign is not None and not path.is_relative_to(campaign / "results") and path.is_file():
        return Product(campaign, _listing(campaign / "results", path, sha256=sha256_file(path)), path)
    product = Product(results.parent, _manifest(results, path), path) if results is not None else Product(path.parent)
    known = (product.root / product.manifest).is_file()
    if not path.exists() and not known:
        remedy = "Correct the path." if results is None else "Correct the path, or run the workflow (`apertura run`)."
        raise CampaignError("no such file or folder", path, _EXPECTED, remedy)
    if not known and not (product.root / CONFIG).is_file():
        remedy = "Name the folder of its campaign with --campaign."
        raise CampaignError("lies in no campaign: its chain cannot be walked", path, "a file below results/", remedy)
    if path.is_dir() and not product.manifest:
        raise CampaignError("a folder that is no result", path, _EXPECTED, "Name one of its files.")
    return product


def unlinked(path: Path) -> Path:
    """Return a path; raise CampaignError if it leads through a link of the campaign that it lies in."""
    results = next((folder for folder in path.parents if folder.name == "results"), None)
    for way in (path, *path.parents):
        if results is not None and way.is_relative_to(results) and way.is_symlink():
            raise CampaignError("a symbolic link", way, "what the workflow wrote", "Name what it leads to.")
    return path


def _manifest(results: Path, path: Path) -> str:
    """Return the manifest of the result that a path below a folder of results belongs to; empty if none lists it."""
    stage = next((folder for folder in (path, *path.parents) if folder.suffix == ".zarr"), None)
    manifest = path if path.name.endswith(SUFFIX) else None if stage is None else manifest_of(stage)
    return _listing(results, path) if manifest is None else manifest.relative_to(results.parent).as_posix()


def _listing(results: Path, path: Path, *, sha256: str = "") -> str:
    """Return the manifest that lists a file, relative to the campaign; empty if none does.

    A file that lies elsewhere is known by its hash; where it was edited since, nothing tells which one it was.
    """
    for manifest in manifests(results):
        with suppress(CampaignError):  # a damaged manifest lists nothing
            files = read_manifest(manifest)["files"]
            listed = sha256 in files.values() if sha256 else any(manifest.parent / name == path for name in files)
            if listed:
                return manifest.relative_to(results.parent).as_posix()
    return ""


def manifests(results: Path) -> Iterator[Path]:
    """Yield every manifest below a folder of results, in order of their names; links are not followed."""
    for folder, folders, files in os.walk(results):
        folders[:] = sorted(name for name in folders if ".zarr" not in name)
        yield from (Path(folder, name) for name in sorted(files) if name.endswith(SUFFIX))
