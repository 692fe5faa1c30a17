"""The manifest of a result: hashes of its files and what it was made from; written last, checked when it is opened."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from apertura.common.atomic import write_json
from apertura.common.documents import read_json, undamaged
from apertura.common.errors import CampaignError
from apertura.common.paths import inside
from apertura.common.provenance import sha256_file


def manifest_of(result: Path) -> Path:
    """Return where the manifest of a stage folder or of a document lies.

    Examples
    --------
    >>> manifest_of(Path("results/f01/uav1/raw.zarr")).name, manifest_of(Path("results/scene.json")).name
    ('raw.manifest.json', 'scene.manifest.json')
    """
    return result.with_name(f"{result.stem}.manifest.json")


def remake(result: Path) -> str:
    """Return what to do about a result that is not as it was written.

    Examples
    --------
    >>> remake(Path("results/scene.json"))
    'Delete results/scene.manifest.json and run the workflow again.'
    """
    return f"Delete {manifest_of(result)} and run the workflow again."


class ResultOrigin(Protocol):
    """What a result is being made from, `apertura.pipeline.digests.Lineage`."""

    def record(self) -> dict[str, Any]:
        """Return sources (file → sha256), settings and code for the manifest, once more compared with what is there."""


def write_manifest(manifest: Path, files: Mapping[str, str], lineage: ResultOrigin | None = None) -> None:
    """Write the manifest of a result that is complete.

    Parameters
    ----------
    manifest
        ``….manifest.json``.
    files
        File relative to the manifest's folder → sha256.
    lineage
        What it was made from; None: nobody says.
    """
    write_json(manifest, {"files": files, **(lineage.record() if lineage else {})})


def record_files(manifest: Path, files: Sequence[Path], lineage: ResultOrigin | None = None) -> None:
    """Write the manifest of some files beside or below it."""
    write_manifest(
        manifest, {path.relative_to(manifest.parent).as_posix(): sha256_file(path) for path in sorted(files)}, lineage
    )


def read_manifest(manifest: Path) -> dict[str, Any]:
    """Return a manifest.

    Raises
    ------
    CampaignError
        If it is no manifest.
    """
    expected, remedy = "a manifest as the workflow wrote it", f"Delete {manifest} and run the workflow again."
    if manifest.is_symlink():
        raise CampaignError("a symbolic link", manifest, expected, remedy)
    document = read_json(manifest, expected=expected, remedy=remedy)
    with undamaged(manifest, expected=expected, remedy=remedy):
        for hashes in (document["files"], document.get("sources", {})):
            if not all(isinstance(text, str) for pair in hashes.items() for text in pair):
                raise TypeError("a hash that is no text")
    return document


def check_document(path: Path) -> None:
    """Check a finished document against its manifest.

    Raises
    ------
    CampaignError
        If it is missing, or is not what the manifest describes.
    """
    refuse_others(manifest_of(path), _expected(path), {path.name: sha256_file(path)})


def check_stage(folder: Path) -> dict[str, str]:
    """Check which files a finished stage has, and what its metadata hold, against its manifest; return their hashes.

    Returns
    -------
    dict
        File of the folder → sha256, against which chunks are checked as they are read: a stage is not read whole to
        look at a part of it.

    Raises
    ------
    CampaignError
        If it is missing, or is not what the manifest describes.
    """
    expected, inside = _expected(folder), f"{folder.name}/"
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    there = {
        f"{inside}{name}": expected.get(f"{inside}{name}", "") if _is_chunk(name) else sha256_file(folder / name)
        for name in names
    }
    refuse_others(manifest_of(folder), expected, there)
    return {name.removeprefix(inside): digest for name, digest in expected.items()}


def _is_chunk(name: str) -> bool:
    """Return whether a file of a zarr folder, relative to it, holds values: version 3 keeps them below a folder `c`."""
    return "c" in name.split("/")[1:]


def _expected(result: Path) -> dict[str, str]:
    manifest = manifest_of(result)
    if not manifest.is_file() or not result.exists():
        raise CampaignError(
            "not there, or not finished",
            where=result,
            expected="a finished result with its manifest",
            remedy=f"{f'Delete {manifest} and run' if manifest.is_file() else 'Run'} the workflow (`apertura run`).",
        )
    return dict(read_manifest(manifest)["files"])


def damaged_files(manifest: Path) -> list[str]:
    """Return the files of a result that are not as they were written, or not there; every byte is read."""
    expected = read_manifest(manifest)["files"]
    there = {name: inside(manifest.parent, name, where=manifest) for name in expected}
    return [name for name, path in there.items() if not path.is_file() or sha256_file(path) != expected[name]]


def refuse_others(manifest: Path, expected: Mapping[str, str], present: Mapping[str, str]) -> None:
    """Raise CampaignError unless the files present are those expected."""
    names = sorted(expected.keys() | present.keys())
    differing = [name for name in names if expected.get(name) != present.get(name)]
    if differing:
        raise CampaignError(
            f"{len(differing)} files are not as they were written, first {differing[0]}",
            where=manifest.parent,
            expected=f"what {manifest.name} describes",
            remedy=f"Delete {manifest} and run the workflow again.",
        )


def save_document(path: Path, document: Mapping[str, Any], lineage: ResultOrigin | None = None) -> None:
    """Write a result that is one JSON document, and its manifest."""
    manifest_of(path).unlink(missing_ok=True)
    write_json(path, document)
    record_files(manifest_of(path), [path], lineage)


def open_document(path: Path) -> dict[str, Any]:
    """Return a result that is one JSON document, after checking it against its manifest.

    Raises
    ------
    CampaignError
        If it is missing, or is not what the manifest describes.
    """
    check_document(path)
    return read_json(path, expected="a result of the workflow", remedy=remake(path))


def open_listed(path: Path, manifest: Path) -> dict[str, Any]:
    """Return a JSON document that is one of a result's files, after checking it against their manifest.

    Raises
    ------
    CampaignError
        If it or the manifest is missing, or it is not as it was written.
    """
    document = read_json(path, expected="a finished campaign", remedy="Run the workflow first.")
    expected = read_manifest(manifest)["files"].get(path.name)
    if expected != sha256_file(path):
        found = f"not as {manifest.name} describes it"
        raise CampaignError(found, path, "what the workflow wrote", "Run the workflow again.")
    return document
