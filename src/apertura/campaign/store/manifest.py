"""The manifest of a result: hashes of its files and what it was made from; written last, compared when it is opened."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from apertura.common.atomic import write_json
from apertura.common.confined import ConfinedPath
from apertura.common.documents import read_json, undamaged
from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file


def manifest_of(result: Path) -> Path:
    """Return the path of the manifest of a stage folder or of a document.

    Examples
    --------
    >>> manifest_of(Path("results/f01/uav1/raw.zarr")).name, manifest_of(Path("results/scene.json")).name
    ('raw.manifest.json', 'scene.manifest.json')
    """
    return result.with_name(f"{result.stem}.manifest.json")


def remake(result: Path) -> str:
    """Return the remedy for a result that is not as it was written.

    Examples
    --------
    >>> remake(Path("results/scene.json"))
    'Delete results/scene.manifest.json and run the workflow again.'
    """
    return remake_from(manifest_of(result))


def remake_from(manifest: Path) -> str:
    """Return the remedy for a result whose files contradict their manifest, or have none that is whole."""
    return f"Delete {manifest} and run the workflow again."


class ResultOrigin(Protocol):
    """Origin of a result that is being made, `apertura.campaign.digests.Lineage`."""

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
        Its origin; None: not stated.
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
    expected, remedy = "a manifest as the workflow wrote it", remake_from(manifest)
    document = read_json(manifest, expected=expected, remedy=remedy)
    with undamaged(manifest, expected=expected, remedy=remedy):
        for hashes in (document["files"], document.get("sources", {})):
            if not all(isinstance(text, str) for pair in hashes.items() for text in pair):
                raise TypeError("a hash that is no text")
    return document


@dataclass(frozen=True)
class Difference:
    """One thing that is not as a manifest records it.

    Attributes
    ----------
    part
        Of the record: a file of the result, a source, the settings or the code.
    name
        Of the file or source, as recorded; empty of settings and code.
    state
        missing: recorded, and not there; altered: with another hash; added: there, and not recorded.
    recorded, present
        sha256, hex; empty of what is added, and where a file is missing.
    """

    part: Literal["file", "source", "settings", "code"]
    name: str
    state: Literal["missing", "altered", "added"]
    recorded: str = ""
    present: str = ""


class CurrentInputs(Protocol):
    """Origin that a result would have now, `apertura.campaign.digests.Result`."""

    @property
    def sources(self) -> Sequence[str]:
        """Files and manifests, relative to the campaign folder."""

    @property
    def settings_sha256(self) -> str:
        """Hash of its settings."""

    @property
    def code_sha256(self) -> str:
        """Hash of its code."""


def compare(
    recorded: Mapping[str, str],
    present: Callable[[str], str],
    *,
    added: Iterable[str] = (),
    part: Literal["file", "source"] = "file",
) -> Iterator[Difference]:
    """Compare files with recorded hashes; yield what differs, in order of the names.

    Parameters
    ----------
    recorded
        Name → sha256, hex.
    present
        Returns the sha256 of a file as it is now; empty where it is not there.
    added
        Names that are there now, or that count now.
    part
        Which part of the record it is.

    Examples
    --------
    >>> now = {"a": "4c", "b": "0f", "d": "1a"}
    >>> found = compare({"a": "4c", "b": "9e", "c": "77"}, lambda name: now.get(name, ""), added=now)
    >>> [(one.name, one.state) for one in found]
    [('b', 'altered'), ('c', 'missing'), ('d', 'added')]
    """
    for name in sorted({*recorded, *added}):
        if name not in recorded:
            yield Difference(part, name, "added")
        elif (now := present(name)) != recorded[name]:
            yield Difference(part, name, "altered" if now else "missing", recorded[name], now)


def compare_origin(
    document: Mapping[str, Any], expected: CurrentInputs, present: Callable[[str], str]
) -> Iterator[Difference]:
    """Compare what a manifest says of where its result comes from with what is there now: sources, settings and code.

    Parameters
    ----------
    document
        The manifest, with ``sources``, ``settings`` and ``code``.
    expected
        What the result would be made from now.
    present
        As `compare`, of sources.
    """
    yield from compare(document["sources"], present, added=expected.sources, part="source")
    if document["settings"] != expected.settings_sha256:
        yield Difference("settings", "", "altered", str(document["settings"]), expected.settings_sha256)
    if document["code"] != expected.code_sha256:
        yield Difference("code", "", "altered", str(document["code"]), expected.code_sha256)


def states_origin(document: Mapping[str, Any]) -> bool:
    """Test whether a manifest states the origin of its result; those before 0.1.0 did not."""
    return {"sources", "settings", "code"} <= document.keys()


def sha256_present(path: Path) -> str:
    """Return the sha256 of a file, every byte read; empty where there is none."""
    return sha256_file(path) if path.is_file() else ""


def damaged_files(manifest: Path) -> list[str]:
    """Return the files of a result that are not as they were written, or not there; every byte is read."""

    def present(name: str) -> str:
        return sha256_present(ConfinedPath.of(manifest).parent.named(name, where=manifest))

    return [difference.name for difference in compare(read_manifest(manifest)["files"], present)]


def check_document(path: Path) -> None:
    """Check a finished document against its manifest.

    Raises
    ------
    CampaignError
        If it is missing, or is not what the manifest describes.
    """
    _check(manifest_of(path), _files_of(path), {path.name: sha256_file(path)})


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
    recorded, inside = _files_of(folder), f"{folder.name}/"
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    present = {
        # zarr version 3 keeps values in files below a folder `c`
        f"{inside}{name}": recorded.get(f"{inside}{name}", "")
        if "c" in name.split("/")[1:]
        else sha256_file(folder / name)
        for name in names
    }
    _check(manifest_of(folder), recorded, present)
    return {name.removeprefix(inside): digest for name, digest in recorded.items()}


def _files_of(result: Path) -> dict[str, str]:
    """Return the files of a finished result and their hashes; raise CampaignError if it is not finished."""
    manifest = manifest_of(result)
    if not manifest.is_file() or not result.exists():
        raise CampaignError(
            "not there, or not finished",
            where=result,
            expected="a finished result with its manifest",
            remedy=f"{f'Delete {manifest} and run' if manifest.is_file() else 'Run'} the workflow (`apertura run`).",
        )
    return dict(read_manifest(manifest)["files"])


def _check(manifest: Path, recorded: Mapping[str, str], present: Mapping[str, str]) -> None:
    """Raise CampaignError unless the files present are those recorded."""
    differing = list(compare(recorded, lambda name: present.get(name, ""), added=present))
    if differing:
        raise CampaignError(
            f"{len(differing)} files are not as they were written, first {differing[0].name}",
            where=manifest.parent,
            expected=f"what {manifest.name} describes",
            remedy=remake_from(manifest),
        )


def check_listed(path: Path, manifest: Path, *, present: Callable[[Path], str] = sha256_present) -> str:
    """Check one of a result's files against their manifest; return its sha256.

    Parameters
    ----------
    path
        The file, in the manifest's folder or below.
    manifest
        That lists it.
    present
        Returns the sha256 of the file as it is now; empty where it is not there.

    Raises
    ------
    CampaignError
        If it is not as it was written, or the manifest does not list it.
    """
    recorded = str(read_manifest(manifest)["files"].get(path.relative_to(manifest.parent).as_posix(), ""))
    if not recorded or present(path) != recorded:
        remedy = remake_from(manifest)
        raise CampaignError("not as it was written", path, f"what {manifest.name} describes", remedy)
    return recorded


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
    check_listed(path, manifest)
    return document
