"""Backprojection engines. Each engine has a module and an entry in `ENGINES`, and is tested against `reference`."""

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from apertura.common.contracts import Window
    from apertura.core.backprojection.engines.engine import Engine

ENGINES: dict[str, str] = {
    "tree": "apertura.core.backprojection.engines.tree",
    "native": "apertura.core.backprojection.engines.native",
    "numba": "apertura.core.backprojection.engines.numba",
    "cuda": "apertura.core.backprojection.engines.cuda",
    "reference": "apertura.core.backprojection.engines.reference",
}
"""Name → module that implements `Engine`, imported when the engine is loaded."""

PATCH_PX = 16
"""Side of a patch, pixels. Tiles start at multiples of this number, so that an engine that forms patches of this size
yields bit-identical images for every tiling."""


def load_engine(name: str) -> "Engine":
    """Return an engine.

    Parameters
    ----------
    name
        Key of `ENGINES`.

    Examples
    --------
    >>> load_engine("reference").READS
    'phase_history'
    """
    return cast("Engine", import_module(ENGINES[name]))


def missing_kernel() -> str | None:
    """Return one line on the cost of an installation without the compiled kernel; None if the kernel is installed.

    The factors are the ratios of `numba` to `native` with portable code and with AVX-512 in benchmarks/latest.json.

    Examples
    --------
    >>> (missing_kernel() is None) == load_engine("native").available()
    True
    """
    if load_engine("native").available():
        return None
    return (
        "no compiled kernel is installed: engine numba forms the images, 16 to 115 times slower than engine native. "
        "Install the wheel for Linux on x86-64 or aarch64, or install from the sources with a C++ compiler."
    )


def pieces(name: str, shape: tuple[int, ...], form_options: Mapping[str, Any]) -> "list[Window]":
    """Return windows of a tile that an engine can form independently with bit-identical results.

    Parameters
    ----------
    name
        Key of `ENGINES`.
    shape
        Shape of the tile, pixels.
    form_options
        Options of the engine's `form`.

    Examples
    --------
    >>> pieces("reference", (20, 16), {})
    [(slice(0, 16, None), slice(0, 16, None)), (slice(16, 20, None), slice(0, 16, None))]
    """
    own = getattr(load_engine(name), "pieces", None)
    if own is not None:
        return list(own(shape, form_options))
    rows, columns = ([slice(at, min(at + PATCH_PX, size)) for at in range(0, size, PATCH_PX)] for size in shape)
    return [(row, column) for row in rows for column in columns]


def instruction_set(name: str) -> str:
    """Return the instruction set used for the sums of an engine on this machine; 'unknown' if it is not reported.

    Parameters
    ----------
    name
        Key of `ENGINES`.

    Examples
    --------
    >>> instruction_set("reference").split()[0]
    'numba:'
    """
    return str(getattr(load_engine(name), "instruction_set", lambda: "unknown")())
