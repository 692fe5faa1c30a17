"""Which modules a module can run: its imports, however deep, read from their sources, and compiled code beside them."""

import functools
import importlib.util
import re
import sysconfig
from collections.abc import Iterable, Mapping
from pathlib import Path

PACKAGE = Path(__file__).parent

_IMPORT = re.compile(r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|.*)|import[ \t]+(.*))$", re.MULTILINE)
_NAME = re.compile(r"[\w.]+")
_TYPING = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+.*\n|\n)+", re.MULTILINE)  # never run
_ROW = re.compile(r"[\"'](apertura(?:\.\w+)+):\w+[\"']")  # a row that names a function, imported when it is used


def import_closure(modules: Iterable[str], *, package: Path = PACKAGE) -> dict[str, Path]:
    """Return dotted name → source of `modules` and of every apertura module they import.

    Parameters as of `apertura.provenance.code_sha256`.

    Examples
    --------
    >>> sorted(import_closure(["apertura.constants"]))
    ['apertura.constants']
    """
    closure: dict[str, Path] = {}
    waiting = list(modules)
    outside = {name for name in waiting if not _is_ours(name)}
    while waiting:
        name = waiting.pop()
        path = _source(name, package) if _is_ours(name) else _source_outside(name) if name in outside else None
        if path is None or name in closure:
            continue
        closure[name] = path
        waiting += _imports(path.read_text(encoding="utf-8"))
    return closure


def _is_ours(name: str) -> bool:
    return name.split(".", maxsplit=1)[0] == PACKAGE.name


def _source(name: str, package: Path) -> Path | None:
    parts = name.split(".")[1:]
    if not parts:  # the package itself only hands out public names
        return None
    base = package.joinpath(*parts)
    return next((path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()), None)


def _source_outside(name: str) -> Path | None:
    spec = importlib.util.find_spec(name)
    return Path(spec.origin) if spec is not None and spec.origin else None


@functools.cache
def _imports(source: str) -> tuple[str, ...]:
    """Return the dotted names that a source may import; a parser would take ten times as long."""
    names: list[str] = []
    for module, members, modules in _IMPORT.findall(_TYPING.sub("", source)):
        names += [module, *(f"{module}.{member}" for member in _NAME.findall(members))] if module else []
        names += _NAME.findall(modules)
    return tuple(name for name in [*names, *_ROW.findall(source)] if _is_ours(name))


def built_from(closure: Mapping[str, Path], package: Path) -> list[Path]:
    """Return what compiled code beside the modules was built from; an editable install keeps it elsewhere."""
    digests: dict[str, Path] = {}
    folders = {name.rpartition(".")[0] for name, path in closure.items() if path.name != "__init__.py"}
    for folder in sorted(filter(_is_ours, folders)):
        relative = Path(*folder.split(".")[1:])
        for place in (package / relative, Path(sysconfig.get_path("platlib"), PACKAGE.name, relative)):
            for path in sorted(place.glob("*.sha256")):
                digests.setdefault(path.name, path)
    return [digests[name] for name in sorted(digests)]
