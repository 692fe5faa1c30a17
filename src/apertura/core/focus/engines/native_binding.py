"""The compiled library: where it lies, what it takes, and which instruction set it uses.

Bound with ctypes: the GIL is released during a call, and one wheel serves every Python version. The library says how
its structs are laid out; where that differs from the mirrors here it is refused when it is loaded.
"""

import ctypes
import os
from collections.abc import Callable
from functools import lru_cache
from importlib.resources import files
from pathlib import Path

from apertura.common.errors import CampaignError, quoted, shown
from apertura.core.focus.engines.native_structs import STRUCTS

INSTRUCTION_SETS = ("avx512", "avx2", "portable")

NAMED_BY = "APERTURA_KERNEL"
"""Environment variable: another library than the one installed."""

_BUILT = str(files("apertura.core.focus.engines") / "_backprojection.so")  # found once: calls may be short


def layout() -> dict[str, str]:
    """Return the layout of the structs as this module lays them out: field → where it lies, struct → its size.

    Examples
    --------
    >>> layout()["ApertureJob.transmitter"]
    'byte 8, 8 bytes'
    """
    lines: dict[str, str] = {}
    for struct in STRUCTS:
        for name, *_ in struct._fields_:
            field = getattr(struct, name)
            lines[f"{struct.__name__}.{name}"] = _place(field.offset, field.size)
        lines[struct.__name__] = _place(0, ctypes.sizeof(struct))
    return lines


def _place(offset: int, size: int) -> str:
    return f"byte {offset}, {size} bytes"


def check_layout(theirs: dict[str, str], path: Path) -> None:
    """Refuse a library whose structs are not those of this module.

    Parameters
    ----------
    theirs
        As `layout`, from the library.
    path
        Of the library.

    Raises
    ------
    CampaignError
        Naming the first field that differs, as it is there and here.
    """
    ours = layout()
    for name in [*ours, *(theirs.keys() - ours.keys())]:
        if ours.get(name) != theirs.get(name):
            raise CampaignError(
                f"{name} at {theirs.get(name, 'no place')}",
                where=str(path),
                expected=f"{name} at {ours.get(name, 'no place')}, as in apertura's native_structs.py",
                remedy="Reinstall apertura, so that the library and Python are of one version; unset APERTURA_KERNEL.",
            )


def available() -> bool:
    """Return whether the kernel was compiled when the package was installed.

    Examples
    --------
    >>> available() in (True, False)
    True
    """
    return library_path().is_file()


def instruction_set() -> str:
    """Return the instruction set in use: the best of this machine, or what APERTURA_ISA names.

    Raises
    ------
    RuntimeError
        If the kernel was not compiled.
    CampaignError
        If APERTURA_ISA names none, or one that this machine lacks.

    Examples
    --------
    >>> not available() or instruction_set() in INSTRUCTION_SETS
    True
    """
    asked = os.environ.get("APERTURA_ISA", "")
    if asked and asked not in INSTRUCTION_SETS:
        raise _unfit(asked, f"one of {', '.join(INSTRUCTION_SETS)}, or unset")
    chosen = library().apertura_isa(asked.encode())
    if chosen is None:
        raise _unfit(asked, "instructions that this machine has")
    return str(chosen.decode())


def runs(isa: str) -> bool:
    """Return whether the kernel was compiled and this machine has the instruction set of that name."""
    return available() and library().apertura_isa(isa.encode()) is not None


def _unfit(asked: str, expected: str) -> CampaignError:
    return CampaignError(f"{asked!r}", where="environment variable APERTURA_ISA", expected=expected, remedy="Unset it.")


def call(function: str, job: ctypes.Structure) -> None:
    """Run `function` of the library on `job`; the GIL is released meanwhile.

    Raises
    ------
    MemoryError
        If the library found no memory for its scratch.
    """
    status = getattr(library(), function)(instruction_set().encode(), ctypes.byref(job))
    if status == 1:
        raise MemoryError(f"{function}: no memory for scratch")
    if status:
        raise RuntimeError(f"{function}: failed with status {status}")


def library_path() -> Path:
    """Return where the library lies once it is compiled; APERTURA_KERNEL names another, such as one with sanitizers.

    Raises
    ------
    CampaignError
        If APERTURA_KERNEL names no file, or a relative path: every process has a working folder of its own.
    """
    named = os.environ.get(NAMED_BY)
    if not named:
        return Path(_BUILT)
    if not (Path(named).is_absolute() and Path(named).is_file()):
        raise _no_kernel(named, "no such file" if Path(named).is_absolute() else "a relative path")
    return Path(named)


def _no_kernel(named: str, found: str) -> CampaignError:
    where = f"environment variable {NAMED_BY}"
    expected = "the whole path of a library built from native/ of this version"
    return CampaignError(f"{quoted(named)}: {found}", where=where, expected=expected, remedy="Unset it.")


def library() -> ctypes.CDLL:
    """Return the compiled library.

    Raises
    ------
    RuntimeError
        If it was not compiled.
    CampaignError
        If its structs are laid out otherwise than here.
    """
    path = library_path()
    if not path.is_file():
        raise RuntimeError(
            "the compiled kernel is missing: install a C++ compiler and reinstall apertura, or use numba"
        )
    return _load(path)


def kernel_constants() -> dict[str, float]:
    """Return the constants that the library was compiled with, by name (native/bounds.hpp).

    Examples
    --------
    >>> not available() or kernel_constants()["window"] == 16
    True
    """
    return {name: float(value) for name, value in _lines(library().apertura_constants)}


@lru_cache
def _load(path: Path) -> ctypes.CDLL:
    try:
        loaded = ctypes.CDLL(str(path))
    except OSError as error:
        raise _no_kernel(str(path), shown(error, 200)) from error
    if not hasattr(loaded, "apertura_layout"):
        check_layout({}, path)
    for function in (loaded.apertura_isa, loaded.apertura_layout, loaded.apertura_constants):
        function.restype = ctypes.c_char_p
    loaded.apertura_isa.argtypes = [ctypes.c_char_p]
    check_layout({name: _place(int(at), int(size)) for name, at, size in _lines(loaded.apertura_layout)}, path)
    return loaded


def _lines(function: Callable[[], bytes]) -> list[list[str]]:
    return [line.split() for line in function().decode().splitlines()]
