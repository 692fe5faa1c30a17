"""Provenance of a product: settings, inputs, code and software versions of its stage and of all upstream stages."""

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
from types import MappingProxyType
from typing import Any, Protocol

from apertura import __version__
from apertura.common.code_imports import PACKAGE, built_from, import_closure, source_of, without_description
from apertura.common.errors import CampaignError
from apertura.common.paths import shipped

# ---- Versions of the software and its lock file ---------------------------------------------------------------------

_NAME = re.compile(r"[\w.-]+")


def packages() -> dict[str, str]:
    """Return name → version of apertura, of Python and of each distribution that apertura requires, sorted by name.

    The distributions are not imported. Optional dependencies (`extra`) are excluded, because they affect no result.

    Examples
    --------
    >>> versions = packages()
    >>> {"apertura", "python", "numpy", "numba", "zarr"} <= versions.keys(), "pytest" in versions
    (True, False)
    """
    return dict(_packages())


@cache
def _packages() -> tuple[tuple[str, str], ...]:
    versions = {"apertura": __version__, "python": platform.python_version()}
    for requirement in requires("apertura") or ():
        if "extra ==" not in requirement and (name := _NAME.match(requirement)):
            try:
                versions[name[0].lower()] = version(name[0])
            except PackageNotFoundError:  # for example a distribution that has another name in conda
                versions[name[0].lower()] = "unknown"
    return tuple(sorted(versions.items()))


def software() -> dict[str, str]:
    """Return `packages` with the versions of GDAL (in rasterio) and PROJ (in pyproj).

    ``proj`` is the library in pyproj, which computes pixel coordinates; rasterio may contain another version of PROJ.

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
    """Return the SHA-256 of requirements/all.txt, which lists the distributions of the tested environment.

    Examples
    --------
    >>> len(lock_sha256())
    64
    """
    return sha256_file(shipped() / "requirements" / "all.txt")


# ---- Settings, inputs and code of a result and of its upstream stages -----------------------------------------------

_READ_BYTES = 1 << 22


class StampedStage(Protocol):
    """Dataset stamped by `apertura.stages.tags.stamp`; its attributes contain its provenance."""

    @property
    def attrs(self) -> Mapping[str, Any]: ...  # noqa: D102


@dataclass(frozen=True)
class Provenance:
    """Provenance of a stage or a file.

    Attributes
    ----------
    runspec
        All settings that affect the stage and its upstream stages.
    inputs
        Role → SHA-256 of each input file outside the results.
    code_sha256
        Chained code hash of the stage and its upstream stages.
    software
        Name → version of the software of this stage and the upstream stages; several versions if the stages differ.
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
        """Combine the provenance of `parents` with that of a new stage.

        Parameters
        ----------
        modules
            Dotted names of the executed modules; their import closure is hashed.
        parents
            Upstream stages of a single chain, whose settings agree; or name → stage for several chains, such as the
            pairs of a flight, whose settings are stored separately under these names.
        settings, inputs
            Settings of the new stage alone, and role → SHA-256 of its input files.
        software
            Name → version of the running software.

        Raises
        ------
        ValueError
            If two parents have different hashes for the same role.

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
        """Return the provenance as file tags, name → text."""
        return {
            "APERTURA_RUNSPEC": canonical_json(self.runspec),
            "APERTURA_INPUTS": canonical_json(self.inputs),
            "APERTURA_CODE_SHA256": self.code_sha256,
            "APERTURA_SOFTWARE": canonical_json(self.software),
            "APERTURA_VERSION": __version__,
        }


def canonical_json(value: object) -> str:
    """Serialize `value` as canonical JSON: sorted keys, no spaces, no NaN.

    Examples
    --------
    >>> canonical_json({"b": 1, "a": [1.5, None]})
    '{"a":[1.5,null],"b":1}'
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def sha256_text(text: str) -> str:
    """Return the SHA-256 of a text in UTF-8, hex."""
    return hashlib.sha256(text.encode()).hexdigest()


LARGEST_DOCUMENT = 1_000_000_000
"""Maximum size of a JSON document to be hashed, bytes; an RO-Crate contains about 300 bytes per chunk."""

LARGEST_RESULT = 1 << 36
"""Maximum size of a result file to be hashed, bytes; results of the largest stages occupy several GB, stored in chunks
of several MB."""


def sha256_file(path: Path) -> str:
    """Return the SHA-256 of a file, hex; raise CampaignError if it exceeds `LARGEST_RESULT`.

    Examples
    --------
    >>> len(sha256_file(Path(__file__)))
    64
    """
    with path.open("rb") as stream:
        check_size(path, os.fstat(stream.fileno()).st_size)
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_size(path: Path, size: int) -> None:
    """Raise CampaignError if a result file exceeds the maximum size; a sparse file could take very long to hash."""
    largest = LARGEST_DOCUMENT if path.suffix == ".json" else LARGEST_RESULT
    if size > largest:
        expected = f"a result file of at most {largest} bytes"
        raise CampaignError(f"{size} bytes", path, expected, "Remove the file and run the workflow again.")


def hashes_of_file(path: Path, algorithms: Sequence[str]) -> dict[str, str]:
    """Return algorithm → hash of a file, hex; the file is read once, and each hash is computed in a separate thread."""
    digests = {name: hashlib.new(name) for name in algorithms}
    updates = list[Future[None]]()
    with path.open("rb", buffering=0) as stream, ThreadPoolExecutor(len(digests)) as pool:
        block_bytes = min(_READ_BYTES, max(os.fstat(stream.fileno()).st_size, 1))
        blocks = cycle([memoryview(bytearray(block_bytes)) for _ in range(2)])
        while size := stream.readinto(block := next(blocks)):  # meanwhile, the previous block is being hashed
            wait(updates)
            updates = [pool.submit(digest.update, block[:size]) for digest in digests.values()]
    return {name: digest.hexdigest() for name, digest in digests.items()}


def sha256_tree(folder: Path, known: Mapping[str, str] = MappingProxyType({})) -> dict[str, str]:
    """Return relative path → SHA-256 of every file below `folder`, sorted by path; files with `known` are not read."""
    files = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*")) if path.is_file()}
    return {name: known.get(name) or sha256_file(path) for name, path in files.items()}


def code_sha256(*modules: str, package: Path = PACKAGE) -> str:
    """Hash the source of `modules` and of every apertura module in their import closure.

    The hash of a stage changes if and only if executable code in this closure changes; comments and docstrings are
    ignored. Compiled code is represented by the hash of its sources, a file ``*.sha256`` installed in the folder of
    one of the modules. For a table with rows of `apertura.common.lazy.Lazy`, `modules` contains the modules of the
    functions.

    Parameters
    ----------
    *modules
        Dotted names such as ``apertura.stages.echo``. For a module of another package, the hash includes that package
        and the apertura modules that it imports.
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
    """Return the executable lines of a source text."""
    return "".join(f"{line}\n" for line in without_description(source).split("\n") if line.strip() != "...")


def chained_sha256(own: str, parents: Iterable[str]) -> str:
    """Combine the code hash of a stage with the chained hashes of its upstream stages."""
    return hashlib.sha256("\n".join([own, *sorted(parents)]).encode()).hexdigest()


def merged(*sources: Mapping[str, str]) -> dict[str, str]:
    """Merge role → hash mappings, sorted by role.

    Raises
    ------
    ValueError
        If two sources have different hashes for the same role.
    """
    union: dict[str, str] = {}
    for source in sources:
        for role, digest in source.items():
            if union.setdefault(role, digest) != digest:
                raise ValueError(f"{role} has two hashes: {union[role]} and {digest}")
    return dict(sorted(union.items()))


def joined(*sources: Mapping[str, str]) -> dict[str, str]:
    """Merge name → version mappings; versions that differ are joined by commas.

    Examples
    --------
    >>> joined({"numpy": "2.4.6"}, {"numpy": "2.4.6", "zarr": "3.1.6"}, {"zarr": "3.2.0"})
    {'numpy': '2.4.6', 'zarr': '3.1.6, 3.2.0'}
    """
    merged_versions: dict[str, set[str]] = {}
    for source in sources:
        for name, versions in source.items():
            merged_versions.setdefault(name, set()).update(versions.split(", "))
    return {name: ", ".join(sorted(versions)) for name, versions in sorted(merged_versions.items())}
