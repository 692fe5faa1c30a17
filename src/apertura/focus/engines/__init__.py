"""Backprojection engines: one file and one row each; every one is tested against `reference`."""

from importlib import import_module
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from apertura.focus.engines.engine import Engine

ENGINES: dict[str, str] = {
    "native": "apertura.focus.engines.native",
    "numba": "apertura.focus.engines.numba",
    "cuda": "apertura.focus.engines.cuda",
    "reference": "apertura.focus.engines.reference",
}
"""Name → module that is an `Engine`; a module is imported when its engine is asked for."""

PATCH_PX = 16
"""Tiles begin at multiples of this: an engine may work in patches of it and give the same bits in every tiling."""


def load_engine(name: str) -> "Engine":
    """Return an engine.

    Parameters
    ----------
    name
        A key of `ENGINES`.

    Examples
    --------
    >>> load_engine("reference").READS
    'phase_history'
    """
    return cast("Engine", import_module(ENGINES[name]))


def instruction_set(name: str) -> str:
    """Return the instructions that an engine's sums run with on this machine; 'unknown' where it does not say.

    Parameters
    ----------
    name
        A key of `ENGINES`.

    Examples
    --------
    >>> instruction_set("reference").split()[0]
    'numba:'
    """
    return str(getattr(load_engine(name), "instruction_set", lambda: "unknown")())
