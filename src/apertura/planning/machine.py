"""What the machine costs: the constants of the cost model, shipped, measured, and kept in files."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from apertura.focus.engines import ENGINES, native
from apertura.planning.cost import Costs

DEFAULTS: Mapping[str, Mapping[str, float]] = {
    "common": {
        "numba.table": 3.1e-08,
        "numba.pixel": 3.2e-08,
        "reference.subcarrier": 5.3e-10,
        "place.ecef": 2.0e-08,
        "place.local": 2.7e-09,
        "tile": 4.0e-03,
        "weight": 1.2e-07,
        "thin": 8.0e-08,
    },
    "avx512": {
        "native.table": 1.5e-09,
        "native.shared.1": 2.4e-10,
        "native.shared.2": 2.8e-10,
        "native.wide.1": 2.9e-10,
        "native.wide.2": 3.7e-10,
        "native.exact.1": 3.2e-09,
        "native.exact.2": 3.8e-09,
        "native.beam": 6.7e-10,
        "native.edge": 3.4e-08,
        "native.dark": 1.2e-10,
    },
    "avx2": {
        "native.table": 2.5e-09,
        "native.shared.1": 4.3e-10,
        "native.shared.2": 5.0e-10,
        "native.wide.1": 7.0e-10,
        "native.wide.2": 8.5e-10,
        "native.exact.1": 4.5e-09,
        "native.exact.2": 5.5e-09,
        "native.beam": 1.0e-09,
        "native.edge": 3.5e-08,
        "native.dark": 1.2e-10,
    },
    "portable": {
        "native.table": 4.0e-09,
        "native.shared.1": 2.3e-09,
        "native.shared.2": 2.7e-09,
        "native.wide.1": 2.4e-09,
        "native.wide.2": 2.8e-09,
        "native.exact.1": 1.1e-08,
        "native.exact.2": 1.2e-08,
        "native.beam": 1.2e-09,
        "native.edge": 4.1e-08,
        "native.dark": 1.6e-10,
    },
}
"""Seconds on one core of a 2.x GHz server of 2023, by instruction set; `apertura calibrate-cost` replaces them."""


def cache_file() -> Path:
    """Return where measured costs are kept: $XDG_CACHE_HOME/apertura/cost.json.

    Examples
    --------
    >>> cache_file().name
    'cost.json'
    """
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "apertura" / "cost.json"


def machine() -> str:
    """Return what costs depend on: the instruction set of the compiled kernel, 'portable' without one.

    Examples
    --------
    >>> machine() in DEFAULTS
    True
    """
    return native.instruction_set() if ENGINES["native"].available() else "portable"


def default_costs(instruction_set: str = "avx512") -> Costs:
    """Return the shipped constants for an instruction set.

    Examples
    --------
    >>> default_costs("avx2").source
    'shipped defaults for avx2'
    """
    return Costs({**DEFAULTS["common"], **DEFAULTS[instruction_set]}, f"shipped defaults for {instruction_set}")


def read_costs(path: Path | None = None) -> Costs:
    """Return the costs measured on this machine, or the shipped ones where none that fit are found.

    Parameters
    ----------
    path
        `cache_file()` by default. A file that is unreadable, was measured with another instruction set or lacks a
        constant counts as none.

    Examples
    --------
    >>> read_costs(Path("nowhere.json")).source.startswith("shipped defaults")
    True
    """
    found = _stored(path or cache_file())
    if found is None or found["machine"] != machine():
        return default_costs(machine())
    return Costs(found["seconds"], f"measured on this machine ({machine()})")


def kept_costs(path: Path) -> Costs:
    """Return the costs that a campaign keeps, wherever they were measured; those of this machine before it keeps any.

    All jobs of a campaign plan with the same costs, on whatever machines they run: so they plan the same.
    """
    found = _stored(path)
    return read_costs() if found is None else Costs(found["seconds"], f"{found['source']}, as {path.name} keeps them")


def _stored(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        seconds = {name: float(value) for name, value in found["seconds"].items()}
        document = {"machine": str(found["machine"]), "source": str(found["source"]), "seconds": seconds}
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    whole = seconds.keys() >= default_costs().seconds.keys() and all(0 < value < 1 for value in seconds.values())
    return document if whole else None


def write_costs(costs: Costs, path: Path | None = None) -> Path:
    """Keep costs for later plans, of this machine or at `path`; return the file."""
    path = path or cache_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    document = {"machine": machine(), "source": costs.source, "seconds": dict(sorted(costs.seconds.items()))}
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    beside.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    beside.replace(path)
    return path
