"""Code that a module can run: its import closure, and the source of these modules without descriptions.

An import counts wherever it stands, also inside a function. What only describes code, comments and docstrings, does not
count, nor do modules that decide no value of a result (`WITHOUT_EFFECT`).
"""

import functools
import importlib.util
import re
import sysconfig
from collections.abc import Iterable, Mapping
from pathlib import Path

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

_IMPORT = re.compile(r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|.*)|import[ \t]+(.*))$", re.MULTILINE)
_NAME = re.compile(r"[\w.]+")
_TYPING = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+.*\n|\n)+", re.MULTILINE)  # never run
_CALLED = re.compile(r"\(\s*[\"'](apertura(?:\.\w+)+):\w+[\"']")  # f("module:function"): f imports and calls it
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
            waiting += _imports(source_of(path))
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


@functools.cache
def _imports(source: str) -> tuple[str, ...]:
    """Return the dotted names that a source may import; a parser would take ten times as long."""
    names: list[str] = []
    for module, members, modules in _IMPORT.findall(_TYPING.sub("", source)):
        names += [module, *(f"{module}.{member}" for member in _NAME.findall(members))] if module else []
        names += _NAME.findall(modules)
    return tuple(name for name in [*names, *_CALLED.findall(source)] if "." in name or _is_ours(name))


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
