"""Classify differences between the value of a valid file and that of a modified file that was accepted."""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from pydantic import BaseModel


def leaves(value: object, path: str = "") -> Iterator[tuple[str, object]]:
    """Yield the leaves of a parsed value with their paths: numbers, texts, and arrays (as shape and bytes)."""
    if isinstance(value, np.memmap | np.ndarray):
        array = np.asarray(value)
        yield f"{path} (shape)", array.shape
        yield f"{path} (values)", array.tobytes() if array.size < 100_000 else array[:1000].tobytes()
    elif isinstance(value, xr.Dataset):
        yield from leaves({name: value[name].values for name in value.variables} | dict(value.attrs), path)
    elif isinstance(value, BaseModel):
        yield from leaves({name: getattr(value, name) for name in type(value).model_fields}, path)
    elif dataclasses.is_dataclass(value):
        yield from leaves({field.name: getattr(value, field.name) for field in dataclasses.fields(value)}, path)
    elif isinstance(value, Mapping):
        yield f"{path} (keys)", tuple(map(str, value))
        for key, part in value.items():
            yield from leaves(part, f"{path}.{key}")
    elif isinstance(value, list | tuple):
        yield f"{path} (length)", len(value)
        for index, part in enumerate(value):
            yield from leaves(part, f"{path}[{index}]")
    elif not isinstance(value, Path):
        yield path, value


def same(one: object, other: object) -> bool:
    """Return True if two leaves are equal; NaN is equal to NaN."""
    return type(one) is type(other) and (one == other or (one != one and other != other))  # noqa: PLR0124


def kinds(before: dict[str, object], after: dict[str, object]) -> set[str]:
    """Return the kinds of difference between two values, an empty set if they are equal."""
    changed = [path for path in before.keys() & after.keys() if not same(before[path], after[path])]
    differences = {_kind(path, before[path], after[path]) for path in changed}
    if not any("more or fewer" in kind for kind in differences) and before.keys() != after.keys():
        differences.add("more or fewer parts")
    return differences


_ENDINGS = {
    "(shape)": "more or fewer values",
    "(values)": "values of",
    "(keys)": "more or fewer keys, or another name or order",
    "(length)": "more or fewer entries",
}


def _kind(path: str, before: Any, after: Any) -> str:
    name, _, ending = path.rpartition(" ")
    if ending in _ENDINGS:
        return _ENDINGS[ending] + (f" {name.rpartition('.')[2]}" if ending == "(values)" else "")
    if before is None or after is None or isinstance(before, bool) or isinstance(after, bool):
        return "a choice, or an omitted key"
    if isinstance(before, str) and isinstance(after, str):
        return "a text"
    numbers = isinstance(before, int | float) and isinstance(after, int | float)
    return "a number" if numbers else "a value of another kind"
