"""Code that a module can run: its import closure, and the source of these modules without descriptions.

An import counts wherever it stands, also inside a function. What only describes code, comments and docstrings, does not
count, nor do modules that decide no value of a result (`WITHOUT_EFFECT`).
"""

import ast
import atexit
import functools
import importlib.util
import json
import os
import re
import sysconfig
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parents[1]

WITHOUT_EFFECT = (
    "apertura.common.errors",  # texts of messages: a step that raised one has no result
    "apertura.common.flag_table",  # texts that explain flags: they decide no value
    "apertura.common.progress",  # lines of a log
    "apertura.common.processes",  # where a process may look for code, and how it ends
    "apertura.workflow.lineage",  # sources, settings and code of a result: a manifest records each, for itself
    "apertura.workflow.rules",  # the rows that these follow from
    "apertura.workflow.rule_inputs",
    "apertura.campaign.digests",  # their hashes
)
"""Modules, with those below them, excluded from code hashes: nothing that they compute is in a result."""

_TEXT_OR_COMMENT = re.compile(
    r'(?P<text>[A-Za-z]{0,2}(?:"""(?:\\.|[^\\])*?"""|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\'))|(?P<comment>#[^\n]*)',
    re.DOTALL,
)
_GOES_ON = frozenset("([{,=+-*/%|&<>\\")
"""What ends a line whose statement goes on: a text on the next line is a value, and no docstring."""


def import_closure(modules: Iterable[str], *, package: Path = PACKAGE) -> dict[str, Path]:
    """Return dotted name → source of `modules` and of every apertura module they import.

    Parameters as of `apertura.common.provenance.code_sha256`.

    Examples
    --------
    >>> sorted(import_closure(["apertura.common.constants"]))
    ['apertura.common.constants']
    """
    closure: dict[str, Path] = {}
    waiting = list(modules)
    followed = {PACKAGE.name, *map(_top, waiting)}
    while waiting:
        name = waiting.pop()
        if name in closure or _top(name) not in followed or _has_no_effect(name):
            continue
        path = _source(name, package) if _is_ours(name) else _source_outside(name)
        if path is not None:
            closure[name] = path
            waiting += _imports(name, path)
    return closure


def source_of(path: Path) -> str:
    """Return the text of a source; it is read again only where its size or its time has changed."""
    state = path.stat()
    return _read(path, state.st_mtime_ns, state.st_size)


@functools.cache
def _read(path: Path, *_: int) -> str:
    return path.read_text(encoding="utf-8")


def _top(name: str) -> str:
    return name.partition(".")[0]


def _is_ours(name: str) -> bool:
    return _top(name) == PACKAGE.name


@functools.cache
def _has_no_effect(name: str) -> bool:
    return any(name == one or name.startswith(f"{one}.") for one in WITHOUT_EFFECT)


@functools.cache
def _source(name: str, package: Path) -> Path | None:
    parts = name.split(".")[1:]
    if not parts:  # the package itself only hands out public names
        return None
    base = package.joinpath(*parts)
    return next((path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()), None)


def _source_outside(name: str) -> Path | None:
    """Find the source of a module of another distribution: a file of exports or engines, or one of their package."""
    spec = importlib.util.find_spec(_top(name))
    if spec is None or spec.origin is None:
        return None
    return _source(name, Path(spec.origin).parent) if spec.submodule_search_locations else Path(spec.origin)


def _imports(name: str, path: Path) -> list[str]:
    """Return the dotted names that a module may import, wherever the statement stands."""
    status, kept = path.stat(), _kept()
    state = [status.st_mtime_ns, status.st_size]
    if kept.get(str(path), [])[:2] != state:
        kept[str(path)] = [*state, _parsed_imports(name, path)]
        if path.is_relative_to(PACKAGE):
            _keep_at_exit()
    found: list[str] = kept[str(path)][2]
    return found


def _parsed_imports(name: str, path: Path) -> list[str]:
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    names: list[str] = []
    waiting: list[ast.stmt] = list(ast.parse(source_of(path)).body)
    while waiting:
        statement = waiting.pop()
        if isinstance(statement, ast.Import):
            names += [alias.name for alias in statement.names]
        elif isinstance(statement, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - statement.level + 1] if statement.level else []
            module = ".".join(filter(None, [*above, statement.module or ""]))
            names += [module, *(f"{module}.{alias.name}" for alias in statement.names)]
        elif isinstance(statement, ast.If) and ast.unparse(statement.test) == "TYPE_CHECKING":  # never run
            waiting += statement.orelse
        else:
            bodies = (getattr(statement, field, []) for field in ("body", "orelse", "finalbody"))
            handlers = (part.body for field in ("handlers", "cases") for part in getattr(statement, field, []))
            waiting += [one for body in (*bodies, *handlers) for one in body]
    return [one for one in names if "." in one or _is_ours(one)]


_KEPT = PACKAGE / "__pycache__" / "imports.json"
"""Source → its time, size and imports: parsing all of them takes half a second of every process."""


@functools.cache
def _kept() -> dict[str, list[Any]]:
    """Return the imports that earlier processes found, to which this one adds."""
    with suppress(OSError, ValueError):
        kept: dict[str, list[Any]] = json.loads(_KEPT.read_text(encoding="utf-8"))
        return kept
    return {}


@functools.cache
def _keep_at_exit() -> None:
    """Write what this process has found of the package when it ends."""

    def keep() -> None:
        ours = {path: found for path, found in _kept().items() if Path(path).is_relative_to(PACKAGE)}
        with suppress(OSError):  # a package that is read only: each process parses
            part = _KEPT.with_suffix(f".{os.getpid()}")
            part.write_text(json.dumps(ours), encoding="utf-8")
            part.replace(_KEPT)

    atexit.register(keep)


@functools.cache
def without_description(source: str) -> str:
    r"""Return a Python source without its comments and empty lines, docstrings as ellipses.

    Examples
    --------
    >>> without_description('def two():\n    \"\"\"Return it.\"\"\"\n\n    return 2  # always\n')
    'def two():\n    ...\n    return 2'
    """
    kept: list[str] = []
    ends, at = "", 0  # the last character of code, and how far the source is read
    for found in _TEXT_OR_COMMENT.finditer(source):
        between = source[at : found.start()]
        kept.append(between)
        ends = between.rstrip()[-1:] or ends
        at = found.end()
        if found["comment"]:
            continue
        begins = between.rstrip(" \t").endswith("\n") or not "".join(kept).strip()
        if begins and found[0].startswith('"""') and ends not in _GOES_ON and source[at : at + 1] in {"\n", ""}:
            kept.append("...")
        else:
            kept.append(found[0].replace("\n", "\0"))  # lines of a text are no lines of code
        ends = '"'
    lines = (line.rstrip() for line in "".join([*kept, source[at:]]).split("\n"))
    return "\n".join(line for line in lines if line).replace("\0", "\n")


def built_from(closure: Mapping[str, Path], package: Path) -> list[Path]:
    """List the hashes of the sources of compiled code beside the modules; an editable install keeps them elsewhere."""
    digests: dict[str, Path] = {}
    folders = {name.rpartition(".")[0] for name, path in closure.items() if path.name != "__init__.py"}
    for folder in sorted(filter(_is_ours, folders)):
        relative = Path(*folder.split(".")[1:])
        for place in (package / relative, Path(sysconfig.get_path("platlib"), PACKAGE.name, relative)):
            for path in sorted(place.glob("*.sha256")):
                digests.setdefault(path.name, path)
    return [digests[name] for name in sorted(digests)]
