"""References to functions whose modules are imported when they are called: tables cost no import of what rows name."""

import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Lazy:
    """A package, module or function by its dotted path; attributes are further references, and a call imports.

    Examples
    --------
    >>> common = Lazy("apertura.common")
    >>> common.units.decibels(100.0)
    20.0
    """

    path: str

    def __getattr__(self, name: str) -> "Lazy":
        if name.startswith("__"):
            raise AttributeError(name)
        return Lazy(f"{self.path}.{name}")

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Import the function, and call it."""
        return pkgutil.resolve_name(self.path)(*arguments, **named)


def module_of(function: Callable[..., Any]) -> str:
    """Return the dotted name of the module that defines a function, which is not imported for it.

    Examples
    --------
    >>> module_of(Lazy("apertura.common").units.decibels), module_of(module_of)
    ('apertura.common.units', 'apertura.common.lazy')
    """
    return function.path.rpartition(".")[0] if isinstance(function, Lazy) else function.__module__


def name_of(function: Callable[..., Any]) -> str:
    """Return the name of a function, which is not imported for it."""
    return function.path.rpartition(".")[2] if isinstance(function, Lazy) else function.__name__
