"""Import closure of modules, and the source of all modules in the closure, for code hashes.

Imports inside functions are included. Comments, docstrings and modules that affect no value of a result
(`WITHOUT_EFFECT`) are excluded.
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
    "apertura.common.errors",  # message texts: a step that raises an error has no result
    "apertura.common.flag_table",  # descriptions of flags: they affect no value
    "apertura.common.progress",  # progress reports
    "apertura.common.processes",  # module search path and exit of a process
    "apertura.workflow.lineage",  # sources, settings and code of a result: each is recorded in the manifest
    "apertura.workflow.rules",  # the rule table that lineage evaluates
    "apertura.workflow.rule_inputs",
    "apertura.campaign.digests",  # hashes of the sources
)
"""Modules, with their submodules, excluded from code hashes because no value of a result depends on them."""

_TEXT_OR_COMMENT = re.compile(
    r'(?P<text>[A-Za-z]{0,2}(?:"""(?:\\.|[^\\])*?"""|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\'))|(?P<comment>#[^\n]*)',
    re.DOTALL,
)
_GOES_ON = frozenset("([{,=+-*/%|&<>\\")
"""Characters after which a statement continues on the next line; a string on that line is a value, not a docstring."""


def import_closure(modules: Iterable[str], *, package: Path = PACKAGE) -> dict[str, Path]:
    """Return dotted name → source path of `modules` and of every apertura module that they import.

    For the parameters see `apertura.common.provenance.code_sha256`.

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
    """Return the text of a source file, cached until its size or modification time changes."""
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
    return any(name == module or name.startswith(f"{module}.") for module in WITHOUT_EFFECT)


@functools.cache
def _source(name: str, package: Path) -> Path | None:
    parts = name.split(".")[1:]
    if not parts:  # the package itself only re-exports public names
        return None
    base = package.joinpath(*parts)
    return next((path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()), None)


def _source_outside(name: str) -> Path | None:
    """Find the source of a module of another distribution: an export or engine plug-in, or a module that it imports."""
    spec = importlib.util.find_spec(_top(name))
    if spec is None or spec.origin is None:
        return None
    return _source(name, Path(spec.origin).parent) if spec.submodule_search_locations else Path(spec.origin)


def _imports(name: str, path: Path) -> list[str]:
    """List the dotted names that a module may import, including imports inside functions."""
    status, kept = path.stat(), _kept()
    state = [status.st_mtime_ns, status.st_size]
    if kept.get(str(path), [])[:2] != state:
        kept[str(path)] = [*state, _parsed_imports(name, path)]
        if path.is_relative_to(PACKAGE):
            _keep_at_exit()
    names: list[str] = kept[str(path)][2]
    return names


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
        elif isinstance(statement, ast.If) and ast.unparse(statement.test) == "TYPE_CHECKING":  # never executed
            waiting += statement.orelse
        else:
            bodies = (getattr(statement, field, []) for field in ("body", "orelse", "finalbody"))
            handlers = (part.body for field in ("handlers", "cases") for part in getattr(statement, field, []))
            waiting += [nested for body in (*bodies, *handlers) for nested in body]
    return [imported for imported in names if "." in imported or _is_ours(imported)]


_KEPT = PACKAGE / "__pycache__" / "imports.json"
"""Cache file: source → modification time, size and imports. Parsing all sources takes half a second per process."""


@functools.cache
def _kept() -> dict[str, list[Any]]:
    """Return the imports cached by earlier processes; this process adds the imports of the modules that it parses."""
    with suppress(OSError, ValueError):
        kept: dict[str, list[Any]] = json.loads(_KEPT.read_text(encoding="utf-8"))
        return kept
    return {}


@functools.cache
def _keep_at_exit() -> None:
    """Write the imports of the package's modules to the cache file when the process exits."""

    def keep() -> None:
        ours = {path: entry for path, entry in _kept().items() if Path(path).is_relative_to(PACKAGE)}
        with suppress(OSError):  # a read-only installation has no cache: each process parses the sources
            part = _KEPT.with_suffix(f".{os.getpid()}")
            part.write_text(json.dumps(ours), encoding="utf-8")
            part.replace(_KEPT)

    atexit.register(keep)


@functools.cache
def without_description(source: str) -> str:
    r"""Remove comments and empty lines from a Python source, and replace docstrings by ellipses.

    Examples
    --------
    >>> without_description('def two():\n    \"\"\"Return it.\"\"\"\n\n    return 2  # always\n')
    'def two():\n    ...\n    return 2'
    """
    kept: list[str] = []
    last_character, at = "", 0  # last character of code, and the read position in the source
    for token in _TEXT_OR_COMMENT.finditer(source):
        between = source[at : token.start()]
        kept.append(between)
        last_character = between.rstrip()[-1:] or last_character
        at = token.end()
        if token["comment"]:
            continue
        starts_line = between.rstrip(" \t").endswith("\n") or not "".join(kept).strip()
        is_statement = starts_line and last_character not in _GOES_ON and source[at : at + 1] in {"\n", ""}
        if is_statement and token[0].startswith('"""'):
            kept.append("...")
        else:
            kept.append(token[0].replace("\n", "\0"))  # protect newlines of a string from removal of empty lines
        last_character = '"'
    lines = (line.rstrip() for line in "".join([*kept, source[at:]]).split("\n"))
    return "\n".join(line for line in lines if line).replace("\0", "\n")


def built_from(closure: Mapping[str, Path], package: Path) -> list[Path]:
    """List the hash files of compiled code in the modules' folders, or in site-packages for an editable install."""
    digests: dict[str, Path] = {}
    folders = {name.rpartition(".")[0] for name, path in closure.items() if path.name != "__init__.py"}
    for folder in sorted(filter(_is_ours, folders)):
        relative = Path(*folder.split(".")[1:])
        for location in (package / relative, Path(sysconfig.get_path("platlib"), PACKAGE.name, relative)):
            for path in sorted(location.glob("*.sha256")):
                digests.setdefault(path.name, path)
    return [digests[name] for name in sorted(digests)]
