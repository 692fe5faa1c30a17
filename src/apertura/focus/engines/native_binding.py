"""The compiled library: where it lies, what it takes, and which instruction set it uses.

Bound with ctypes: the GIL is released during a call, and one wheel serves every Python version.
"""

import ctypes
import os
from functools import lru_cache
from importlib.resources import files
from pathlib import Path

from apertura.errors import CampaignError

INSTRUCTION_SETS = ("avx512", "avx2", "portable")

_pointer = ctypes.c_void_p
_int64 = ctypes.c_int64
_double = ctypes.c_double


class BeamJob(ctypes.Structure):
    """native/job.hpp, BeamJob."""

    _fields_ = [
        ("axes", _pointer),
        ("gain", _pointer * 2),
        ("count", _int64 * 2),
        ("first_rad", _double * 2),
        ("samples_per_rad", _double * 2),
        ("peak", _double),
    ]


class ApertureJob(ctypes.Structure):
    """native/job.hpp, ApertureJob."""

    _fields_ = [
        *((name, _pointer) for name in ("cells", "transmitter", "receiver", "first_path", "pixels")),
        *((name, _pointer) for name in ("image", "counts")),
        *((name, _int64) for name in ("pulses", "padded", "width", "rows", "columns")),
        *((name, _double) for name in ("cells_per_metre", "radians_per_cell", "tolerance_rad")),
        *((name, ctypes.c_int32) for name in ("degree", "phase_form", "wide_sum")),
        ("phase", ctypes.c_float * 9),
        ("beam", ctypes.POINTER(BeamJob) * 2),
    ]


class TableJob(ctypes.Structure):
    """native/job.hpp, TableJob."""

    _fields_ = [
        *((name, _pointer) for name in ("samples", "taps", "lead", "carrier", "turn", "cells")),
        *((name, _int64) for name in ("pulses", "length", "width", "up", "down", "steps", "margin", "used")),
        ("degree", ctypes.c_int32),
    ]


def available() -> bool:
    """Return whether the kernel was compiled when the package was installed.

    Examples
    --------
    >>> available() in (True, False)
    True
    """
    return _library_path() is not None


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
    found = _library().apertura_form(asked.encode())
    if found is None:
        raise _unfit(asked, "instructions that this machine has")
    return str(found.decode())


def _unfit(asked: str, expected: str) -> CampaignError:
    return CampaignError(f"{asked!r}", where="environment variable APERTURA_ISA", expected=expected, remedy="Unset it.")


def call(function: str, job: ctypes.Structure) -> None:
    """Run `function` of the library on `job`; the GIL is released meanwhile.

    Raises
    ------
    MemoryError
        If the library found no memory for its scratch.
    """
    status = getattr(_library(), function)(instruction_set().encode(), ctypes.byref(job))
    if status == 1:
        raise MemoryError(f"{function}: no memory for scratch")
    if status:
        raise RuntimeError(f"{function}: failed with status {status}")


@lru_cache(maxsize=1)
def _library_path() -> Path | None:
    named = os.environ.get("APERTURA_KERNEL")  # another build, such as one with sanitizers
    path = Path(named or str(files("apertura.focus.engines") / "_backprojection.so"))
    return path if path.is_file() else None


@lru_cache(maxsize=1)
def _library() -> ctypes.CDLL:
    path = _library_path()
    if path is None:
        raise RuntimeError(
            "the compiled kernel is missing: install a C++ compiler and reinstall apertura, or use numba"
        )
    library = ctypes.CDLL(str(path))
    library.apertura_form.restype = ctypes.c_char_p
    library.apertura_form.argtypes = [ctypes.c_char_p]
    return library
