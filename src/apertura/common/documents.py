"""Reading and validation of untrusted text, YAML and JSON files; each error is converted to a single message."""

import difflib
import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import ArgsKwargs

from apertura.common.errors import CampaignError, quoted

# ---- Text, YAML and JSON of untrusted files -------------------------------------------------------------------------
#
# No content of a file is trusted: size, nesting depth and alias expansion are checked before any object is built.

LARGEST_YAML = 1_000_000
"""Maximum size of a YAML file, bytes."""

DEEPEST = 32
"""Maximum nesting depth of a YAML document."""

MOST_NODES = 100_000
"""Maximum number of keys and values in a YAML document, with all aliases expanded."""

LARGEST_JSON = 64_000_000
"""Maximum size of a JSON file, bytes."""

DAMAGED = "Delete the file and run the workflow again."
"""Remedy for a damaged result."""

_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_KINDS = ("null", "bool", "int", "float", "str", "timestamp", "seq", "map", "merge")
_PLAIN = {f"tag:yaml.org,2002:{kind}" for kind in _KINDS}
_LONGEST_INTEGER = 25


def read_text(path: Path, *, expected: str, remedy: str, largest: int) -> str:
    """Read the UTF-8 text of a file, without its byte-order mark.

    Parameters
    ----------
    path
        The file.
    expected, remedy
        Parts of the message for a missing file.
    largest
        Maximum size in bytes.

    Raises
    ------
    CampaignError
        If the file is missing, too large or not UTF-8.
    """
    if not path.is_file():
        raise CampaignError("no such file", where=path, expected=expected, remedy=remedy)
    with path.open("rb") as stream:
        data = stream.read(largest + 1)
    if len(data) > largest:
        found = f"{path.stat().st_size} bytes"
        raise CampaignError(found, path, f"a file of at most {largest} bytes", "Check the path, or shorten the file.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        found = f"byte {data[error.start]:#04x} in line {line} is not UTF-8"
        raise CampaignError(found, path, "UTF-8 text", "Save the file as UTF-8.") from error


def read_yaml(path: Path, *, expected: str, remedy: str) -> object:
    """Read a YAML document of plain values, with unique keys, within the limits above.

    Parameters
    ----------
    path
        The file.
    expected, remedy
        Parts of the message for a missing file.

    Raises
    ------
    CampaignError
        If the file is missing, is not YAML, or exceeds the limits of size or depth.
    """
    text = read_text(path, expected=expected, remedy=remedy, largest=LARGEST_YAML)
    try:
        _count_nodes(text)
        root = yaml.compose(text, Loader=_LOADER)
        if root is None:
            return None
        _check_nodes(root)
        document: object = yaml.constructor.SafeConstructor().construct_document(root)
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, ArithmeticError, LookupError) as error:
        raise CampaignError(
            f"not readable as YAML ({_problem(error)})", where=path, expected="YAML", remedy="Correct that line."
        ) from error
    return document


def _problem(error: Exception) -> str:
    mark: Any = getattr(error, "problem_mark", None)
    if mark is None:
        return quoted(" ".join(str(error).split()), 200)[1:-1]
    return f"line {mark.line + 1}, column {mark.column + 1}: {getattr(error, 'problem', '')}"


def _wrong(problem: str, at: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=at.start_mark)


def _count_nodes(text: str) -> None:
    """Raise YAMLError if a document exceeds the limits of depth or size, before any object is built."""
    sizes, names, anchors = [0], [""], dict[str, int]()
    for event in yaml.parse(text, Loader=_LOADER):
        if isinstance(event, yaml.CollectionStartEvent):
            sizes.append(1)
            names.append(event.anchor or "")
            if len(sizes) > DEEPEST + 1:
                raise _wrong(f"nested more than {DEEPEST} levels deep", event)
            continue
        if isinstance(event, yaml.CollectionEndEvent):
            size, name = sizes.pop(), names.pop()
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in anchors:
                raise _wrong(f"alias {quoted(event.anchor)} does not refer to a complete preceding node", event)
            size, name = anchors[event.anchor], ""
        elif isinstance(event, yaml.ScalarEvent):
            size, name = 1, event.anchor or ""
        else:
            continue
        if name:
            anchors[name] = size
        sizes[-1] += size
        if sizes[-1] > MOST_NODES:
            raise _wrong(f"more than {MOST_NODES} values after expansion of aliases", event)


def _check_nodes(root: yaml.Node) -> None:
    """Raise YAMLError at a repeated key, a tag that is not a plain value, or an integer with too many digits."""
    visited, waiting = set[int](), [root]
    while waiting:
        node = waiting.pop()
        if id(node) in visited:
            continue
        visited.add(id(node))
        if node.tag not in _PLAIN:
            raise _wrong(f"tag {quoted(node.tag)} instead of a plain value", node)
        if isinstance(node, yaml.ScalarNode):
            if node.tag.endswith(":int") and len(node.value) > _LONGEST_INTEGER:
                raise _wrong(f"an integer of {len(node.value)} digits", node)
            continue
        if isinstance(node, yaml.MappingNode):
            keys = set[tuple[str, str]]()
            for key, _ in node.value:
                if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in keys:
                    raise _wrong(f"repeated key {quoted(key.value)}", key)
                keys.add((key.tag, str(key.value) if isinstance(key, yaml.ScalarNode) else ""))
            waiting += [part for pair in node.value for part in pair]
        else:
            waiting += node.value


def read_json(path: Path, *, expected: str, remedy: str, largest: int = LARGEST_JSON) -> dict[str, Any]:
    """Read the object in a JSON file.

    Parameters
    ----------
    path
        The file.
    expected, remedy
        Parts of the message for a missing file.
    largest
        Maximum size in bytes.

    Raises
    ------
    CampaignError
        If the file is missing or is not a JSON object.
    """
    if not path.is_file():
        raise CampaignError("no such file", where=path, expected=expected, remedy=remedy)
    text = read_text(path, expected=expected, remedy=DAMAGED, largest=largest)
    with undamaged(path, expected=expected, remedy=DAMAGED):
        document = json.loads(text, parse_constant=_refuse_constant)
        if not isinstance(document, dict):
            raise TypeError(f"{quoted(document)} instead of an object")
        return document


@contextmanager
def undamaged(path: object, *, expected: str, remedy: str) -> Iterator[None]:
    """Convert errors raised while a document is parsed to a single message about the file.

    Parameters
    ----------
    path
        File of the document, or its address.
    expected, remedy
        Parts of the message; `remedy` is `DAMAGED` for a damaged result.

    Raises
    ------
    CampaignError
        For all errors that a missing key, a wrong type or a number out of range causes in the context.
    """
    try:
        yield
    except CampaignError:
        raise
    except (ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RecursionError) as error:
        found = f"key {quoted(error.args[0])} missing" if isinstance(error, KeyError) and error.args else str(error)
        raise CampaignError(f"damaged ({quoted(found, 200)[1:-1]})", path, expected, remedy) from error


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a valid JSON number")


CODECS = frozenset({"bytes", "transpose", "zstd", "gzip", "blosc", "crc32c", "sharding_indexed", "vlen-utf8"})
"""Permitted codecs of Zarr chunks; others may be unsafe, such as the pickle codec, which executes code in a chunk."""


def other_codec(metadata: object) -> str | None:
    """Find a codec that is not in `CODECS` in Zarr version 3 metadata, at any depth.

    Parameters
    ----------
    metadata
        Parsed ``zarr.json`` of an array, or of a group with consolidated metadata.

    Examples
    --------
    >>> shard = {"name": "sharding_indexed", "configuration": {"codecs": [{"name": "numcodecs.pickle"}]}}
    >>> other_codec({"codecs": [shard]}), other_codec({"codecs": ["bytes"]}), other_codec({"codecs": 3})
    ('numcodecs.pickle', None, '3')
    """
    listed = metadata if isinstance(metadata, list) else []
    for key, value in metadata.items() if isinstance(metadata, Mapping) else enumerate(listed):
        if key in {"codecs", "index_codecs"}:
            for codec in value if isinstance(value, list) else [value]:
                name = codec.get("name") if isinstance(codec, Mapping) else codec
                if name not in CODECS:
                    return str(name)
        found = other_codec(value)
        if found is not None:
            return found
    return None


# ---- Validation of documents by models ------------------------------------------------------------------------------

T = TypeVar("T")

_TYPE = r"(constrained-\w+|literal\[.*|function-.*|tuple\[.*|bool|int|float|str)$"
"""Components that pydantic adds to the location of a key if the key accepts several types."""

_UNKNOWN = {"extra_forbidden", "unexpected_keyword_argument"}

_MOST_COMPLAINTS = 12

LARGEST_NUMBER = 1e15
"""Largest accepted length, time, frequency or count; sums of larger float64 values lose significant digits."""


def validated(model: type[T], document: object, *, where: object, expected: str) -> T:
    """Validate `document` as a `model`; a single message lists all invalid keys, each with the most similar valid key.

    Parameters
    ----------
    model
        A pydantic model or dataclass that forbids extra keys.
    document
        Parsed content of the YAML file.
    where, expected
        File and description of its valid keys and values, for the message.

    Raises
    ------
    CampaignError
        If keys or values are invalid; the message contains file, key, invalid value and valid values.
    """
    adapter = TypeAdapter(model)
    try:
        value = adapter.validate_python(document)
    except ValidationError as error:
        found = _complaints(error, *_tags_and_keys(model))  # type: ignore[arg-type]  # a class is hashable
        if all(item["type"] == "value_error" for item in error.errors(include_url=False, include_context=False)):
            expected = "consistent values"  # keys and types are valid
        raise CampaignError(found, where=where, expected=expected, remedy="Correct these keys.") from error
    except ArithmeticError as error:  # each number is valid, but their combination is not
        found = f"numeric overflow or underflow ({error})"
        raise CampaignError(found, where=where, expected=expected, remedy="Correct the most extreme value.") from error
    for key, number in _numbers(adapter.dump_python(value, warnings=False), ()):
        if not abs(number) <= LARGEST_NUMBER:
            found = f"{quoted(key)[1:-1]} is {quoted(number)}"
            raise CampaignError(found, where, f"numbers within ±{LARGEST_NUMBER:g}", "Correct this value.")
    return value


@cache
def _tags_and_keys(model: Any) -> tuple[set[str], set[str]]:
    """Return the names of alternative types and the keys in the JSON schema of a model."""
    schema = TypeAdapter(model).json_schema()
    tags = _collected(schema, lambda part: part.get("discriminator", {}).get("mapping", {}))
    return tags | set(schema.get("$defs", {})), _collected(schema, _properties)


def _numbers(value: object, location: tuple[str, ...]) -> Iterator[tuple[str, float]]:
    """Yield key and absolute value of every number."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _numbers(part, (*location, str(key)))
    elif isinstance(value, list | tuple):
        for index, part in enumerate(value):
            yield from _numbers(part, (*location, str(index)))
    elif isinstance(value, int | float | complex):
        yield ".".join(location), abs(value)


def _complaints(error: ValidationError, tags: set[str], keys: set[str]) -> str:
    wrong: dict[str, dict[str, None]] = {}
    items = _of_nearest_types([dict(item) for item in error.errors(include_url=False, include_context=False)], tags)
    for item in items[: 10 * _MOST_COMPLAINTS]:
        key, line = _complaint(item, tags, keys)
        wrong.setdefault(quoted(key)[1:-1], {})[line] = None
    lines = [f"{key}: {' or '.join([*complaints][:_MOST_COMPLAINTS])}" for key, complaints in wrong.items()]
    lines.sort(key=lambda line: "unknown key" not in line)
    more = len(lines) > _MOST_COMPLAINTS or len(items) > 10 * _MOST_COMPLAINTS
    return "; ".join(lines[:_MOST_COMPLAINTS]) + (f"; and more, {len(items)} in total" if more else "")


def _of_nearest_types(items: list[dict[str, Any]], tags: set[str]) -> list[dict[str, Any]]:
    """Keep, of the errors of keys that accept several types, those of the type with the fewest wrong parts.

    Types whose parts were not examined, since the value has another type, are kept only if no other type is left.
    """
    wrong_parts: defaultdict[tuple[str, ...], Counter[str]] = defaultdict(Counter)
    for item in items:
        parts = tuple(map(str, item["loc"]))
        for at in _types_in(item, tags):
            wrong_parts[parts[:at]][parts[at]] += len(parts) > at + 1

    def is_nearest(key: tuple[str, ...], name: str) -> bool:
        counts = wrong_parts[key]
        return counts[name] == min(filter(None, counts.values()), default=0)

    def is_kept(item: dict[str, Any]) -> bool:
        parts = tuple(map(str, item["loc"]))
        return all(is_nearest(parts[:at], parts[at]) for at in _types_in(item, tags))

    return list(filter(is_kept, items))


def _types_in(item: dict[str, Any], tags: set[str]) -> list[int]:
    """Return the positions of the names of alternative types in the location of an error."""
    parts = [*map(str, item["loc"])]
    keys = parts[: -(item["type"] in _UNKNOWN) or None]  # an unknown key may have the name of a type
    return [at for at, part in enumerate(keys) if re.match(_TYPE, part) or part in tags]


def _complaint(item: dict[str, Any], tags: set[str], keys: set[str]) -> tuple[str, str]:
    """Return a key and its error; the location of the key is stripped of the names of alternative types."""
    types, unknown = _types_in(item, tags), item["type"] in _UNKNOWN
    location = [str(part) for at, part in enumerate(item["loc"]) if at not in types]
    key = ".".join(location) or "the whole file"
    if unknown:
        known = sorted(keys - {location[-1]})  # the key may belong to another section
        near = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.5)
        return key, "unknown key" + (f" (did you mean '{near[0]}'?)" if near else "")
    if item["type"] == "missing":
        return key, "missing"
    shown = "" if isinstance(item["input"], dict | BaseModel | ArgsKwargs) else f" (found {quoted(item['input'])})"
    message = re.sub(r"dictionary or instance of \w+", "mapping", item["msg"].removeprefix("Value error, "))
    return key, f"{message}{shown}"


def _properties(part: dict[str, Any]) -> Any:
    properties = part.get("properties", {})
    return properties if isinstance(properties, dict) else {}


def _collected(schema: object, names: Any) -> set[str]:
    """Return the union of `names`, a function, over all parts of a JSON schema."""
    if isinstance(schema, list):
        return set().union(*(_collected(part, names) for part in schema))
    if not isinstance(schema, dict):
        return set()
    return set(names(schema)).union(*(_collected(part, names) for part in schema.values()))
