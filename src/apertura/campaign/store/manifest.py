"""Manifest of a result: hashes of the files, and lineage; written last, and checked when the result is opened."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from apertura.common.atomic import write_json
from apertura.common.confined import ConfinedPath
from apertura.common.documents import read_json, undamaged
from apertura.common.errors import CampaignError, number_of
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
    """Return the remedy for a result that has changed since it was written.

    Examples
    --------
    >>> remake(Path("results/scene.json"))
    'Delete results/scene.manifest.json and run the workflow again.'
    """
    return remake_from(manifest_of(result))


def remake_from(manifest: Path) -> str:
    """Return the remedy for a result whose files contradict the manifest, or whose manifest is damaged."""
    return f"Delete {manifest} and run the workflow again."


class ResultOrigin(Protocol):
    """Lineage of a result that is being computed, `apertura.campaign.digests.Lineage`."""

    def record(self) -> dict[str, Any]:
        """Return sources (file → SHA-256), settings and code for the manifest; check that the sources are unchanged."""


def write_manifest(manifest: Path, files: Mapping[str, str], lineage: ResultOrigin | None = None) -> None:
    """Write the manifest of a complete result.

    Parameters
    ----------
    manifest
        ``….manifest.json``.
    files
        File relative to the folder of the manifest → SHA-256.
    lineage
        Lineage of the result; None to omit the lineage.
    """
    write_json(manifest, {"files": files, **(lineage.record() if lineage else {})})


def record_files(manifest: Path, files: Sequence[Path], lineage: ResultOrigin | None = None) -> None:
    """Hash files in the folder of the manifest, at any depth, and write the manifest."""
    write_manifest(
        manifest, {path.relative_to(manifest.parent).as_posix(): sha256_file(path) for path in sorted(files)}, lineage
    )


def read_manifest(manifest: Path) -> dict[str, Any]:
    """Read a manifest.

    Raises
    ------
    CampaignError
        If the file is not a valid manifest.
    """
    expected, remedy = "a manifest of the workflow", remake_from(manifest)
    document = read_json(manifest, expected=expected, remedy=remedy)
    with undamaged(manifest, expected=expected, remedy=remedy):
        for hashes in (document["files"], document.get("sources", {})):
            if not all(isinstance(text, str) for pair in hashes.items() for text in pair):
                raise TypeError("a hash that is not text")
    return document


@dataclass(frozen=True)
class Difference:
    """Difference between the current state of a result and its manifest.

    Attributes
    ----------
    part
        Part of the manifest: a file of the result, a source, the settings or the code.
    name
        Name of the file or source; empty for settings and code.
    state
        missing: recorded, but absent; altered: hash differs; added: present, but not recorded.
    recorded, present
        Recorded and current SHA-256, hex; `recorded` is empty for added files, `present` for missing files.
    """

    part: Literal["file", "source", "settings", "code"]
    name: str
    state: Literal["missing", "altered", "added"]
    recorded: str = ""
    present: str = ""


class CurrentInputs(Protocol):
    """Current lineage of a result, `apertura.campaign.digests.Result`."""

    @property
    def sources(self) -> Sequence[str]:
        """Files and manifests, relative to the campaign folder."""

    @property
    def settings_sha256(self) -> str:
        """Hash of the settings."""

    @property
    def code_sha256(self) -> str:
        """Hash of the code."""


def compare(
    recorded: Mapping[str, str],
    present: Callable[[str], str],
    *,
    added: Iterable[str] = (),
    part: Literal["file", "source"] = "file",
) -> Iterator[Difference]:
    """Compare files with recorded hashes; yield the differences in the order of names.

    Parameters
    ----------
    recorded
        Name → SHA-256, hex.
    present
        Function that returns the current SHA-256 of a file; empty if it is missing.
    added
        Names of current files or sources.
    part
        Part of the manifest.

    Examples
    --------
    >>> now = {"a": "4c", "b": "0f", "d": "1a"}
    >>> differences = compare({"a": "4c", "b": "9e", "c": "77"}, lambda name: now.get(name, ""), added=now)
    >>> [(difference.name, difference.state) for difference in differences]
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
    """Compare the lineage in a manifest with the current one: sources, settings and code.

    Parameters
    ----------
    document
        Manifest with ``sources``, ``settings`` and ``code``.
    expected
        Current lineage of the result.
    present
        Function that returns the current SHA-256 of a source; empty if it is missing.
    """
    yield from compare(document["sources"], present, added=expected.sources, part="source")
    if document["settings"] != expected.settings_sha256:
        yield Difference("settings", "", "altered", str(document["settings"]), expected.settings_sha256)
    if document["code"] != expected.code_sha256:
        yield Difference("code", "", "altered", str(document["code"]), expected.code_sha256)


def states_origin(document: Mapping[str, Any]) -> bool:
    """Return True if a manifest contains the lineage of the result; manifests before version 0.1.0 do not."""
    return {"sources", "settings", "code"} <= document.keys()


def sha256_present(path: Path) -> str:
    """Return the SHA-256 of a file, reading all bytes; empty if the file is missing."""
    return sha256_file(path) if path.is_file() else ""


def damaged_files(manifest: Path) -> list[str]:
    """Return the files of a result that are missing or have changed since they were written; all bytes are read."""

    def present(name: str) -> str:
        return sha256_present(ConfinedPath.of(manifest).parent.named(name, where=manifest))

    return [difference.name for difference in compare(read_manifest(manifest)["files"], present)]


def check_document(path: Path) -> None:
    """Check a finished document against its manifest.

    Raises
    ------
    CampaignError
        If the document is missing, or differs from its manifest.
    """
    _check(manifest_of(path), _files_of(path), {path.name: sha256_file(path)})


def check_stage(folder: Path) -> dict[str, str]:
    """Check file names and metadata of a finished stage against its manifest; return the recorded hashes.

    Returns
    -------
    dict
        File of the folder → SHA-256, for the verification of chunks on reading, because opening a stage does not read
        its chunks.

    Raises
    ------
    CampaignError
        If the stage is missing, or differs from its manifest.
    """
    recorded, inside = _files_of(folder), f"{folder.name}/"
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    present = {
        # Zarr version 3 stores chunks below a folder `c`
        f"{inside}{name}": recorded.get(f"{inside}{name}", "")
        if "c" in name.split("/")[1:]
        else sha256_file(folder / name)
        for name in names
    }
    _check(manifest_of(folder), recorded, present)
    return {name.removeprefix(inside): digest for name, digest in recorded.items()}


def _files_of(result: Path) -> dict[str, str]:
    """Return the files of a finished result and their hashes; raise CampaignError if the result is not finished."""
    manifest = manifest_of(result)
    if not manifest.is_file() or not result.exists():
        raise CampaignError(
            "the result is missing or unfinished",
            where=result,
            expected="a finished result with its manifest",
            remedy=f"{f'Delete {manifest} and run' if manifest.is_file() else 'Run'} the workflow (`apertura run`).",
        )
    return dict(read_manifest(manifest)["files"])


def _check(manifest: Path, recorded: Mapping[str, str], present: Mapping[str, str]) -> None:
    """Raise CampaignError if the current files of a result differ from those recorded in the manifest."""
    differing = list(compare(recorded, lambda name: present.get(name, ""), added=present))
    if differing:
        count = f"{number_of(len(differing), 'file')} {'differs' if len(differing) == 1 else 'differ'}"
        raise CampaignError(
            f"{count} from the manifest; the first is {differing[0].name}",
            where=manifest.parent,
            expected=f"the files listed in {manifest.name}",
            remedy=remake_from(manifest),
        )


def check_listed(path: Path, manifest: Path, *, present: Callable[[Path], str] = sha256_present) -> str:
    """Check a file of a result against the manifest; return its SHA-256.

    Parameters
    ----------
    path
        File in the folder of the manifest, at any depth.
    manifest
        Manifest that lists the file.
    present
        Function that returns the current SHA-256 of the file; empty if it is missing.

    Raises
    ------
    CampaignError
        If the file has changed since it was written, or the manifest does not list it.
    """
    recorded = str(read_manifest(manifest)["files"].get(path.relative_to(manifest.parent).as_posix(), ""))
    now = present(path)
    if not recorded or now != recorded:
        problem = "the file has changed since it was written" if now else "no such file"
        raise CampaignError(problem, path, f"the file listed in {manifest.name}", remake_from(manifest))
    return recorded


def save_document(path: Path, document: Mapping[str, Any], lineage: ResultOrigin | None = None) -> None:
    """Write a result that consists of a single JSON document, and write its manifest."""
    manifest_of(path).unlink(missing_ok=True)
    write_json(path, document)
    record_files(manifest_of(path), [path], lineage)


def open_document(path: Path) -> dict[str, Any]:
    """Read a result that consists of a single JSON document, after checking the document against its manifest.

    Raises
    ------
    CampaignError
        If the document is missing, or differs from its manifest.
    """
    check_document(path)
    return read_json(path, expected="a result of the workflow", remedy=remake(path))


def open_listed(path: Path, manifest: Path) -> dict[str, Any]:
    """Read a JSON document that is a file of a result, and check the document against the manifest.

    Raises
    ------
    CampaignError
        If the document or the manifest is missing, or if the document has changed since it was written.
    """
    document = read_json(path, expected="a finished campaign", remedy="Run the workflow first.")
    check_listed(path, manifest)
    return document
