"""Provenance of a product: settings, inputs, code and versions of software, of all stages before it."""

import hashlib
import json
import os
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from itertools import cycle
from pathlib import Path
from typing import Any, Protocol

from apertura import __version__
from apertura.common.code_imports import PACKAGE, built_from, import_closure, source_of, without_description
from apertura.common.errors import CampaignError
from apertura.common.paths import shipped

# ---- Versions of the software and its lock file ---------------------------------------------------------------------

_NAME = re.compile(r"[\w.-]+")


def packages() -> dict[str, str]:
    """Return name → version of apertura, of Python and of each distribution that apertura requires, sorted by name.

    Nothing is imported to learn them. What only some installations have (`extra`) is not named: where jobs run does not
    change a result.

    Examples
    --------
    >>> found = packages()
    >>> {"apertura", "python", "numpy", "numba", "zarr"} <= found.keys(), "pytest" in found
    (True, False)
    """
    return dict(_packages())


@cache
def _packages() -> tuple[tuple[str, str], ...]:
    found = {"apertura": __version__, "python": platform.python_version()}
    for requirement in requires("apertura") or ():
        if "extra ==" not in requirement and (name := _NAME.match(requirement)):
            try:
                found[name[0].lower()] = version(name[0])
            except PackageNotFoundError:  # such as a library that conda calls otherwise
                found[name[0].lower()] = "unknown"
    return tuple(sorted(found.items()))


def software() -> dict[str, str]:
    """Return `packages`, with the libraries behind rasterio and pyproj: GDAL and PROJ.

    Rasterio may bring a PROJ of its own; ``proj`` is that of pyproj, which places pixels.

    Examples
    --------
    >>> sorted(software().keys() - packages().keys())
    ['gdal', 'proj']
    """
    import pyproj
    import rasterio

    libraries = {"gdal": rasterio.__gdal_version__, "proj": pyproj.proj_version_str}
    return dict(sorted((packages() | libraries).items()))


def lock_sha256() -> str:
    """Return the sha256 of requirements/all.txt, which names each distribution of the tested environment and its hash.

    Examples
    --------
    >>> len(lock_sha256())
    64
    """
    return sha256_file(shipped() / "requirements" / "all.txt")


# ---- Settings, inputs and code of a result and of the stages before it ----------------------------------------------

_READ_BYTES = 1 << 22


class StampedStage(Protocol):
    """A dataset stamped by `apertura.stages.tags.stamp`: its attributes state its provenance."""

    @property
    def attrs(self) -> Mapping[str, Any]: ...  # noqa: D102


@dataclass(frozen=True)
class Provenance:
    """Provenance of a stage or a file.

    Attributes
    ----------
    runspec
        Every setting that mattered to it and to the stages before it.
    inputs
        Role → sha256 of each file read from outside the results.
    code_sha256
        Chain of the code hashes of the stages before it and its own.
    software
        Name → version of what ran, now and in the stages before it; several where those differ.
    """

    runspec: Mapping[str, Any]
    inputs: Mapping[str, str]
    code_sha256: str
    software: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        modules: Sequence[str],
        parents: Sequence[StampedStage] | Mapping[str, StampedStage] = (),
        *,
        settings: Mapping[str, Any] | None = None,
        inputs: Mapping[str, str] | None = None,
        software: Mapping[str, str] | None = None,
    ) -> "Provenance":
        """Return the provenance of `parents` joined with the new one.

        Parameters
        ----------
        modules
            Dotted names; their import closure is the code that ran.
        parents
            Stages of one line, whose settings agree; or name → stage of several lines, such as the pairs of a flight,
            whose settings are kept apart under their names.
        settings, inputs
            Settings used, and role → sha256 of files read, of this stage alone.
        software
            Name → version of what runs now.

        Raises
        ------
        ValueError
            If two parents give one role different hashes.

        Examples
        --------
        >>> from types import SimpleNamespace
        >>> attributes = {"runspec": '{"window":"hann"}', "inputs": {"codes": "1f"}, "code_sha256": "0"}
        >>> parent = SimpleNamespace(attrs=attributes)
        >>> Provenance.of(["apertura.common.errors"], [parent], settings={"engine": "native"}).runspec
        {'window': 'hann', 'engine': 'native'}
        >>> Provenance.of(["apertura.common.errors"], {"a-a": parent, "a-b": parent}).runspec
        {'a-a': {'window': 'hann'}, 'a-b': {'window': 'hann'}}
        """
        stages = list(parents.values() if isinstance(parents, Mapping) else parents)
        specs = [json.loads(stage.attrs["runspec"]) for stage in stages]
        runspec: dict[str, Any] = {}
        if isinstance(parents, Mapping):
            runspec = dict(zip(parents, specs, strict=True))
        else:
            for spec in specs:
                runspec |= spec
        return cls(
            runspec | dict(settings or {}),
            merged(*(stage.attrs["inputs"] for stage in stages), inputs or {}),
            chained_sha256(code_sha256(*modules), (stage.attrs["code_sha256"] for stage in stages)),
            joined(*(stage.attrs.get("software", {}) for stage in stages), software or {}),
        )

    def tags(self) -> dict[str, str]:
        """Return the tags of a file, name → text."""
        return {
            "APERTURA_RUNSPEC": canonical_json(self.runspec),
            "APERTURA_INPUTS": canonical_json(self.inputs),
            "APERTURA_CODE_SHA256": self.code_sha256,
            "APERTURA_SOFTWARE": canonical_json(self.software),
            "APERTURA_VERSION": __version__,
        }


def canonical_json(value: object) -> str:
    """Return the one JSON text of `value`: sorted keys, no spaces, no NaN.

    Examples
    --------
    >>> canonical_json({"b": 1, "a": [1.5, None]})
    '{"a":[1.5,null],"b":1}'
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def sha256_text(text: str) -> str:
    """Return the sha256 of a text in UTF-8, hex."""
    return hashlib.sha256(text.encode()).hexdigest()


LARGEST_DOCUMENT = 1_000_000_000
"""Bytes that a JSON document may have, to be hashed; an RO-Crate names every chunk, in about 300 bytes."""

LARGEST_RESULT = 1 << 36
"""Bytes that a file of the results may have, to be hashed: the largest stages are some GB, in chunks of some MB."""


def sha256_file(path: Path) -> str:
    """Return the sha256 of a file's bytes, hex; raise CampaignError where there are more than `LARGEST_RESULT`.

    Examples
    --------
    >>> len(sha256_file(Path(__file__)))
    64
    """
    with path.open("rb") as stream:
        check_size(path, os.fstat(stream.fileno()).st_size)
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_size(path: Path, size: int) -> None:
    """Raise CampaignError where a file of the results is larger than any of them: it may be sparse, and endless."""
    largest = LARGEST_DOCUMENT if path.suffix == ".json" else LARGEST_RESULT
    if size > largest:
        expected = f"a file of the results, of at most {largest} bytes"
        raise CampaignError(f"{size} bytes", path, expected, "Remove it and run the workflow again.")


def hashes_of_file(path: Path, algorithms: Sequence[str]) -> dict[str, str]:
    """Return algorithm → hash of a file's bytes, hex; read once, each hash taken by a thread of its own."""
    digests = {name: hashlib.new(name) for name in algorithms}
    updates = list[Future[None]]()
    with path.open("rb", buffering=0) as stream, ThreadPoolExecutor(len(digests)) as pool:
        block_bytes = min(_READ_BYTES, max(os.fstat(stream.fileno()).st_size, 1))  # of a small file, all
        blocks = cycle([memoryview(bytearray(block_bytes)) for _ in range(2)])
        while size := stream.readinto(block := next(blocks)):  # while the block before is hashed
            wait(updates)
            updates = [pool.submit(digest.update, block[:size]) for digest in digests.values()]
    return {name: digest.hexdigest() for name, digest in digests.items()}


def sha256_tree(folder: Path) -> dict[str, str]:
    """Return relative path → sha256 of every file below `folder`, sorted by path."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): sha256_file(path) for path in files}


def code_sha256(*modules: str, package: Path = PACKAGE) -> str:
    """Return the hash of the source of `modules` and of every apertura module they import, however deep.

    A stage's hash therefore changes when, and only when, code it can run has changed: not with a comment or a
    docstring. Compiled code counts by what it was built from: each ``*.sha256`` that was installed beside one of the
    modules. Of tables whose rows are `apertura.common.lazy.Lazy`, `modules` holds those that are called.

    Parameters
    ----------
    *modules
        Dotted names such as ``apertura.stages.echo``. Of a module of another package that package counts, and
        what it imports of apertura.
    package
        Folder of apertura's sources.

    Examples
    --------
    >>> code_sha256("apertura.common.constants") != code_sha256("apertura.common.errors")
    True
    """
    digest = hashlib.sha256()
    closure = import_closure(modules, package=package)
    for name, path in sorted(closure.items()):
        digest.update(f"{name}\0\n{_as_run(source_of(path))}".encode())
    for path in built_from(closure, package):
        digest.update(f"{path.name}\0{sha256_file(path)}\n".encode())
    return digest.hexdigest()


@cache
def _as_run(source: str) -> str:
    """Return the lines of a source that run."""
    return "".join(f"{line}\n" for line in without_description(source).split("\n") if line.strip() != "...")


def chained_sha256(own: str, parents: Iterable[str]) -> str:
    """Return one hash for a stage's own code and the chains of the stages before it."""
    return hashlib.sha256("\n".join([own, *sorted(parents)]).encode()).hexdigest()


def merged(*sources: Mapping[str, str]) -> dict[str, str]:
    """Return the union of role → hash mappings, sorted by role.

    Raises
    ------
    ValueError
        If two sources give one role different hashes.
    """
    union: dict[str, str] = {}
    for source in sources:
        for role, digest in source.items():
            if union.setdefault(role, digest) != digest:
                raise ValueError(f"{role} has two hashes: {union[role]} and {digest}")
    return dict(sorted(union.items()))


def joined(*sources: Mapping[str, str]) -> dict[str, str]:
    """Return name → version, all that were found where sources differ.

    Examples
    --------
    >>> joined({"numpy": "2.4.6"}, {"numpy": "2.4.6", "zarr": "3.1.6"}, {"zarr": "3.2.0"})
    {'numpy': '2.4.6', 'zarr': '3.1.6, 3.2.0'}
    """
    found: dict[str, set[str]] = {}
    for source in sources:
        for name, versions in source.items():
            found.setdefault(name, set()).update(versions.split(", "))
    return {name: ", ".join(sorted(versions)) for name, versions in sorted(found.items())}
