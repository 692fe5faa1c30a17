"""Hashes of the source files of results, computed once per state of a file.

A file's state is its size, inode, and times of content and of inode: `cp -p` and `rsync -a` set the former time back,
none sets the latter. A hash is kept under that state in ``results/.hashes``, so that nothing large is read twice.
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
_SMALL = 1 << 16  # bytes; hashed faster than its state is looked up
_SETTLED_S = 2.0
"""A file changed within this time of being read may change again in the same tick of the clock: not kept."""


def digest_of(
    root: Path, name: str, *, algorithm: Literal["sha256", "sha512"] = "sha256", paranoid: bool = False
) -> str:
    """Return the hash of a campaign's file, hex; from `results/.hashes` where its state is known.

    Parameters
    ----------
    root
        The campaign folder.
    name
        The file relative to it.
    algorithm
        sha256, or sha512, with which the other is taken, too: a recording is read once for both.
    paranoid
        Read the file in any case.

    Raises
    ------
    CampaignError
        If the file is not there, is reached through a link, or changes while it is read.
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
        with suppress(OSError, CampaignError):  # a folder that cannot be written: the next one hashes again
            write_json(kept, {"state": state, **digests})
    return digests[algorithm]


@dataclass(frozen=True)
class Sources:
    """Source files of a step with their hashes and states.

    Attributes
    ----------
    root
        The campaign folder.
    digests
        File relative to it → sha256.
    """

    root: Path
    digests: Mapping[str, str]
    _states: Mapping[str, Mapping[str, int]]

    @classmethod
    def of(cls, root: Path, names: Iterable[str]) -> "Sources":
        """Hash some files; raise CampaignError if one is not there."""
        root = ConfinedPath.at(root)
        states = {name: _state(root.named(name, where=root)) for name in sorted(set(names))}
        return cls(root, {name: digest_of(root, name) for name in states}, states)

    def unchanged(self) -> dict[str, str]:
        """Return file → sha256; raise CampaignError if one has changed since it was hashed: what was read is unknown.

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
        apertura.common.errors.CampaignError: ...log.csv: changed while it was read; expected ...
        """
        for name, state in self._states.items():
            if _state(self.root / name) != state:
                raise _changed(self.root / name)
        return dict(self.digests)


def _state(path: Path) -> dict[str, int]:
    try:
        state = path.stat()
    except OSError as error:
        found = "no such file" if isinstance(error, FileNotFoundError) else f"not readable ({error.strerror})"
        raise CampaignError(found, path, "a file that was there", "Copy it there.") from error
    return {
        "size": state.st_size,
        "inode": state.st_ino,
        "device": state.st_dev,
        "mtime_ns": state.st_mtime_ns,
        "ctime_ns": state.st_ctime_ns,
    }


def _changed(path: Path) -> CampaignError:
    return CampaignError(
        "changed while it was read",
        where=path,
        expected="a file that nobody writes to",
        remedy="Wait until it is copied, then run the workflow again.",
    )


@cache
def _code_sha256(modules: tuple[str, ...]) -> str:
    return code_sha256(*modules)  # the same for every flight and pair


@dataclass(frozen=True)
class Result:
    """Result of one rule.

    Attributes
    ----------
    manifest
        Its manifest, relative to the campaign folder.
    sources
        Its sources: files, and manifests of other results, relative to the campaign folder.
    settings
        Settings of the config that affect it.
    modules
        Modules whose import closure is the code that makes it, as `apertura.workflow.lineage.result_of` returns them.
    """

    manifest: str
    sources: tuple[str, ...]
    settings: Mapping[str, Any]
    modules: tuple[str, ...] = ()

    @property
    def settings_sha256(self) -> str:
        """Hash of the settings, as the manifest records it."""
        return sha256_text(canonical_json(self.settings))

    @property
    def code_sha256(self) -> str:
        """Hash of the code that makes it, as the manifest records it."""
        return _code_sha256(self.modules)

    def begin(self, root: Path, *, others: Sequence[str] = ()) -> "Lineage":
        """Hash its sources, and `others` that these name."""
        return Lineage(self, Sources.of(root, (*self.sources, *others)))


@dataclass(frozen=True)
class Lineage:
    """A result in the making, and its sources with their hashes at the start."""

    result: Result
    sources: Sources

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules whose import closure makes the result."""
        return self.result.modules

    def record(self) -> dict[str, Any]:
        """Return the provenance of the result for its manifest.

        Raises
        ------
        CampaignError
            If a source has changed since it was hashed.
        """
        made_by = {"settings": self.result.settings_sha256, "code": self.result.code_sha256}
        return {"sources": self.sources.unchanged(), **made_by}
