"""Backprojection engines: one file and one row each; every one is tested against `reference`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from apertura.focus.engines import native, numba, reference


@dataclass(frozen=True)
class Engine:
    """How an engine is called.

    Attributes
    ----------
    prepare
        (history, **options) → what all tiles share.
    form
        (prepared, pixels (y, x, 3) float64, beams=None) → (y, x) complex; releases the GIL, starts no threads.
    reads
        Which history it is given: `Spectra` of the echo, or `Profiles`.
    available
        Whether it can run here.
    """

    prepare: Callable[..., Any]
    form: Callable[..., Any]
    reads: Literal["echo", "profile"]
    available: Callable[[], bool] = lambda: True


ENGINES = {
    "reference": Engine(reference.prepare, reference.form, "echo"),
    "numba": Engine(numba.prepare, numba.form, "profile"),
    "native": Engine(native.prepare, native.form, "profile", native.available),
}
