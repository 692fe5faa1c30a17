"""Lazy references to functions of a table: the module of a function is imported only when the function is called."""

import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Lazy:
    """Reference to a package, module or function by dotted path.

    Attributes are references, too. A call imports the module and calls the function.

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
        """Import the function and call it."""
        return pkgutil.resolve_name(self.path)(*arguments, **named)


def module_of(function: Callable[..., Any]) -> str:
    """Return the dotted name of the module that defines a function, without importing it.

    Examples
    --------
    >>> module_of(Lazy("apertura.common").units.decibels), module_of(module_of)
    ('apertura.common.units', 'apertura.common.lazy')
    """
    return function.path.rpartition(".")[0] if isinstance(function, Lazy) else function.__module__


def name_of(function: Callable[..., Any]) -> str:
    """Return the name of a function, without importing its module."""
    return function.path.rpartition(".")[2] if isinstance(function, Lazy) else function.__name__
