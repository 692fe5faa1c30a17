"""Where a product comes from: hashes of files, of folders and of the code that ran."""

import ast
import functools
import hashlib
import re
import sysconfig
from collections.abc import Iterable, Mapping
from pathlib import Path

_PACKAGE = Path(__file__).parent
_ROW = re.compile(r"apertura(\.\w+)+:\w+")
"""A table's row that names a function which is imported when it is used: "apertura.ingest.rtklib:read_rtklib_pos"."""


def sha256_file(path: Path) -> str:
    """Return the sha256 of a file's bytes, hex.

    Examples
    --------
    >>> len(sha256_file(Path(__file__)))
    64
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sha256_tree(folder: Path) -> dict[str, str]:
    """Return relative path → sha256 of every file below `folder`, sorted by path."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): sha256_file(path) for path in files}


def code_sha256(*modules: str) -> str:
    """Return the hash of the source of `modules` and of every apertura module they import, however deep.

    Modules that a table's row names as a string, "apertura.ingest.rtklib:read_rtklib_pos", count as imported.
    A stage's hash therefore changes when, and only when, code it can run has changed. Compiled code counts by
    what it was built from: each ``*.sha256`` that was installed beside one of the modules.

    Parameters
    ----------
    *modules
        Dotted names such as ``apertura.steps.echo``.

    Examples
    --------
    >>> code_sha256("apertura.constants") != code_sha256("apertura.errors")
    True
    """
    digest = hashlib.sha256()
    closure = _closure(modules)
    for name, path in sorted(closure.items()):
        digest.update(f"{name}\0{sha256_file(path)}\n".encode())
    for path in _compiled(closure):
        digest.update(f"{path.name}\0{sha256_file(path)}\n".encode())
    return digest.hexdigest()


def chained_sha256(own: str, parents: Iterable[str]) -> str:
    """Return one hash for a stage's own code and the chains of the stages it stands on."""
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


def _closure(modules: Iterable[str]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        path = _source(name)
        if path is None or name in found:
            continue
        found[name] = path
        waiting += _imports(path)
    return found


def _compiled(closure: Mapping[str, Path]) -> list[Path]:
    """Return what compiled code beside the modules was built from; an editable install keeps it elsewhere."""
    found: dict[str, Path] = {}
    for package in sorted({name.rpartition(".")[0] for name, path in closure.items() if path.name != "__init__.py"}):
        relative = Path(*package.split(".")[1:])
        for folder in (_PACKAGE / relative, Path(sysconfig.get_path("platlib"), _PACKAGE.name, relative)):
            for path in sorted(folder.glob("*.sha256")):
                found.setdefault(path.name, path)
    return [found[name] for name in sorted(found)]


def _source(name: str) -> Path | None:
    if name.split(".", maxsplit=1)[0] != _PACKAGE.name:
        return None
    base = _PACKAGE.joinpath(*name.split(".")[1:])
    return next((path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()), None)


@functools.cache
def _imports(path: Path) -> tuple[str, ...]:
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and _ROW.fullmatch(node.value):
            names.append(node.value.partition(":")[0])
    return tuple(names)
