"""From a document to a validated value, or to the one message that says all that is wrong with it."""

import difflib
import re
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import ArgsKwargs

from apertura.common.errors import CampaignError, quoted

T = TypeVar("T")

_TYPE = r"(constrained-\w+|literal\[.*|function-.*|tuple\[.*|bool|int|float|str)$"
"""What pydantic adds to the way to a key where it may hold one of several types."""

_MOST_COMPLAINTS = 12

LARGEST_NUMBER = 1e15
"""No length, time, frequency or count of ours is larger; beyond, sums lose what is added to them."""


def validated(model: type[T], document: object, *, where: object, expected: str) -> T:
    """Return `document` as a `model`; one message names every wrong key and the nearest valid one.

    Parameters
    ----------
    model
        A pydantic model or dataclass that forbids extra keys.
    document
        What YAML made of the file.
    where, expected
        File, and what its keys and values should be, for the message.

    Raises
    ------
    CampaignError
        With file, key, what was found and what was expected.
    """
    adapter = TypeAdapter(model)
    try:
        value = adapter.validate_python(document)
    except ValidationError as error:
        found = _complaints(error, adapter.json_schema())
        raise CampaignError(found, where=where, expected=expected, remedy="Correct what is named.") from error
    except ArithmeticError as error:  # of numbers that are each allowed and not together
        found = f"numbers too large or small to calculate with ({error})"
        raise CampaignError(found, where=where, expected=expected, remedy="Correct the wildest.") from error
    for key, number in _numbers(adapter.dump_python(value, warnings=False), ()):
        if not abs(number) <= LARGEST_NUMBER:
            found = f"{quoted(key)[1:-1]} is {quoted(number)}"
            raise CampaignError(found, where, f"no number beyond ±{LARGEST_NUMBER:g}", "Correct what is named.")
    return value


def _numbers(value: object, way: tuple[str, ...]) -> Iterator[tuple[str, float]]:
    """Yield key and absolute value of every number."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _numbers(part, (*way, str(key)))
    elif isinstance(value, list | tuple):
        for index, part in enumerate(value):
            yield from _numbers(part, (*way, str(index)))
    elif isinstance(value, int | float | complex):
        yield ".".join(way), abs(value)


def _complaints(error: ValidationError, schema: dict[str, Any]) -> str:
    wrong: dict[str, list[str]] = {}
    for item in error.errors(include_url=False, include_context=False)[: 10 * _MOST_COMPLAINTS]:
        key, line = _complaint(dict(item), schema)
        wrong.setdefault(quoted(key)[1:-1], []).append(line)
    lines = [f"{key}: {' or '.join(complaints[:_MOST_COMPLAINTS])}" for key, complaints in wrong.items()]
    lines.sort(key=lambda line: "unknown key" not in line)
    more = len(lines) > _MOST_COMPLAINTS or error.error_count() > 10 * _MOST_COMPLAINTS
    return "; ".join(lines[:_MOST_COMPLAINTS]) + (f"; and more, {error.error_count()} in all" if more else "")


def _complaint(item: dict[str, Any], schema: dict[str, Any]) -> tuple[str, str]:
    """Return the key and what is wrong with it; the names of alternative types are no keys."""
    tags = _collected(schema, lambda part: part.get("discriminator", {}).get("mapping", {}))
    location = [str(part) for part in item["loc"] if not (re.match(_TYPE, str(part)) or part in tags)]
    key = ".".join(location) or "the whole file"
    if item["type"] in {"extra_forbidden", "unexpected_keyword_argument"}:
        near = difflib.get_close_matches(location[-1], sorted(_collected(schema, _properties)), n=1, cutoff=0.5)
        return key, "unknown key" + (f" (did you mean '{near[0]}'?)" if near else "")
    if item["type"] == "missing":
        return key, "missing"
    shown = "" if isinstance(item["input"], dict | BaseModel | ArgsKwargs) else f" (found {quoted(item['input'])})"
    return key, f"{item['msg'].removeprefix('Value error, ')}{shown}"


def _properties(part: dict[str, Any]) -> Any:
    properties = part.get("properties", {})
    return properties if isinstance(properties, dict) else {}


def _collected(schema: object, names: Any) -> set[str]:
    """Return the `names` of every part of a JSON schema."""
    if isinstance(schema, list):
        return set().union(*(_collected(part, names) for part in schema))
    if not isinstance(schema, dict):
        return set()
    return set(names(schema)).union(*(_collected(part, names) for part in schema.values()))
