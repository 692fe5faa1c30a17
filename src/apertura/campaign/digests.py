"""Hashes of the source files of results, computed once per state of a file.

The state of a file consists of its size, inode, modification time and change time: `cp -p` and `rsync -a` restore the
modification time, but not the change time. Hashes are cached with the state in ``results/.hashes``, so that large files
are read once.
"""

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from apertura.common.atomic import write_json
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError
from apertura.common.provenance import canonical_json, check_size, code_sha256, hashes_of_file, sha256_text

_KEPT = Path("results/.hashes")
_SMALL = 1 << 16  # bytes; smaller files are hashed faster than their cached state is read
_SETTLED_S = 2.0
"""Minimum age of a file whose hash is cached, seconds: a newer file may change again within the same clock tick."""


def digest_of(
    root: Path, name: str, *, algorithm: Literal["sha256", "sha512"] = "sha256", paranoid: bool = False
) -> str:
    """Return the hash of a file in a campaign, hex, from `results/.hashes` if the state of the file is unchanged.

    Parameters
    ----------
    root
        Campaign folder.
    name
        Path of the file relative to the folder.
    algorithm
        sha256 or sha512; with sha512, both hashes are computed in one pass, because recordings need both.
    paranoid
        True to read the file even if its state is unchanged.

    Raises
    ------
    CampaignError
        If the file is missing, is reached through a link, or changes while it is read.
    """
    root = ConfinedPath.at(root)
    path = root.named(name, where=root)
    state = _state(path)
    if name.startswith("results/"):
        check_size(path, state["size"])
    algorithms = list(dict.fromkeys(["sha256", algorithm]))
    if state["size"] < _SMALL:
        return hashes_of_file(path, algorithms)[algorithm]
    kept = root / _KEPT / f"{name}.json"
    if not paranoid:
        with suppress(OSError, ValueError, TypeError, KeyError, CampaignError):
            known = json.loads(kept.read_bytes(_SMALL))
            if known["state"] == state:
                return str(known[algorithm])
    digests = hashes_of_file(path, algorithms)
    if _state(path) != state:
        raise _changed(path)
    if max(state["mtime_ns"], state["ctime_ns"]) < time.time_ns() - _SETTLED_S * 1e9:
        with suppress(OSError, CampaignError):  # in a read-only folder, hashes are not cached
            write_json(kept, {"state": state, **digests})
    return digests[algorithm]


@dataclass(frozen=True)
class Sources:
    """Source files of a step with their hashes and states.

    Attributes
    ----------
    root
        Campaign folder.
    digests
        Path of each file relative to the folder → SHA-256.
    """

    root: Path
    digests: Mapping[str, str]
    _states: Mapping[str, Mapping[str, int]]

    @classmethod
    def of(cls, root: Path, names: Iterable[str]) -> "Sources":
        """Hash the given files; raise CampaignError if a file is missing."""
        root = ConfinedPath.at(root)
        states = {name: _state(root.named(name, where=root)) for name in sorted(set(names))}
        return cls(root, {name: digest_of(root, name) for name in states}, states)

    def unchanged(self) -> dict[str, str]:
        """Return file → SHA-256; raise CampaignError if a file has changed since it was hashed.

        Examples
        --------
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "log.csv").write_text("time")
        ...     sources = Sources.of(Path(folder), ["log.csv"])
        ...     list(sources.unchanged())
        ...     _ = (Path(folder) / "log.csv").write_text("other")
        ...     sources.unchanged()
        Traceback (most recent call last):
        ...
        apertura.common.errors.CampaignError: ...log.csv: the file changed while it was read; expected ...
        """
        for name, state in self._states.items():
            if _state(self.root / name) != state:
                raise _changed(self.root / name)
        return dict(self.digests)


def _state(path: Path) -> dict[str, int]:
    try:
        state = path.stat()
    except OSError as error:
        problem = "no such file" if isinstance(error, FileNotFoundError) else f"not readable ({error.strerror})"
        raise CampaignError(problem, path, "a source file of a result", "Copy the file there.") from error
    return {
        "size": state.st_size,
        "inode": state.st_ino,
        "device": state.st_dev,
        "mtime_ns": state.st_mtime_ns,
        "ctime_ns": state.st_ctime_ns,
    }


def _changed(path: Path) -> CampaignError:
    return CampaignError(
        "the file changed while it was read",
        where=path,
        expected="a file that is not being modified",
        remedy="Wait until the file is completely written, then run the workflow again.",
    )


@cache
def _code_sha256(modules: tuple[str, ...]) -> str:
    return code_sha256(*modules)  # identical for all flights and pairs


@dataclass(frozen=True)
class Result:
    """Result of a rule and its lineage.

    Attributes
    ----------
    manifest
        Manifest, relative to the campaign folder.
    sources
        Source files, and manifests of other results, relative to the campaign folder.
    settings
        Settings that affect the result.
    modules
        Modules whose import closure is the code of the result, as returned by `apertura.workflow.lineage.result_of`.
    """

    manifest: str
    sources: tuple[str, ...]
    settings: Mapping[str, Any]
    modules: tuple[str, ...] = ()

    @property
    def settings_sha256(self) -> str:
        """Hash of the settings, as stored in the manifest."""
        return sha256_text(canonical_json(self.settings))

    @property
    def code_sha256(self) -> str:
        """Hash of the code, as stored in the manifest."""
        return _code_sha256(self.modules)

    def begin(self, root: Path, *, others: Sequence[str] = ()) -> "Lineage":
        """Hash the sources, and the files `others` to which the sources refer."""
        return Lineage(self, Sources.of(root, (*self.sources, *others)))


@dataclass(frozen=True)
class Lineage:
    """Result that is being computed, with the hashes of its sources at the start."""

    result: Result
    sources: Sources

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules whose import closure is the code of the result."""
        return self.result.modules

    def record(self) -> dict[str, Any]:
        """Return the provenance of the result for its manifest.

        Raises
        ------
        CampaignError
            If a source has changed since it was hashed.
        """
        hashes = {"settings": self.result.settings_sha256, "code": self.result.code_sha256}
        return {"sources": self.sources.unchanged(), **hashes}
