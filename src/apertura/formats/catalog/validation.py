"""Validation of a static STAC catalog against the schemas of pystac and of this package, without network access."""

import json
from collections.abc import Iterator
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

import pystac

from apertura.common.confined import ConfinedPath
from apertura.common.documents import read_json
from apertura.common.errors import CampaignError, shown
from apertura.formats.catalog import CATALOG

if TYPE_CHECKING:
    from pystac.validation.stac_validator import JsonSchemaSTACValidator

_DOWN = frozenset({"child", "item"})


def stac_problems(folder: Path) -> list[str]:
    """Validate a catalog; return one line for each file that violates its schemas or is missing.

    Parameters
    ----------
    folder
        Folder that contains catalog.json.

    Examples
    --------
    >>> stac_problems(Path("nowhere"))
    ['catalog.json: no such file']
    """
    return [shown(line, 500) for line in _problems(folder, CATALOG)]


def document_problem(document: dict[str, Any]) -> str | None:
    """Validate a catalog, collection or item as JSON; return the first error, or None if it is valid.

    Examples
    --------
    >>> document_problem({"type": "Catalog", "stac_version": "1.1.0", "id": "a", "description": "b", "links": []})
    >>> document_problem({"type": "Catalog", "stac_version": "1.1.0", "id": "a", "links": []})
    "'description' is a required property"
    """
    from pystac.serialization import identify_stac_object, identify_stac_object_type

    kind = identify_stac_object_type(document)
    if kind is None:
        return "not a STAC catalog, collection or item"
    version = str(identify_stac_object(document).version_range.latest_valid_version())
    extensions = document.get("stac_extensions", [])
    unknown = [uri for uri in extensions if uri not in _schemas()]
    if unknown:
        return f"the schema of {unknown[0]} is not available"
    try:
        _validator().validate(document, kind, version, extensions)
    except pystac.STACValidationError as error:
        return _reason(error)
    return None


def _problems(folder: Path, start: str) -> Iterator[str]:
    waiting, visited = [start], set[str]()
    while waiting:
        name = waiting.pop()
        if name in visited:
            continue
        visited.add(name)
        try:
            document = read_json(
                ConfinedPath.at(folder).named(name, where=folder), expected="a STAC catalog", remedy="Create it again."
            )
        except CampaignError as error:
            yield f"{name}: {error.found}"
            continue
        problem = document_problem(document)
        if problem:
            yield f"{name}: {problem}"
        waiting += _below(name, document)


def _below(name: str, document: dict[str, Any]) -> Iterator[str]:
    """Yield the child files linked in a file of the catalog, relative to the catalog's folder."""
    links = document.get("links")
    for link in links if isinstance(links, list) else ():
        if isinstance(link, dict) and link.get("rel") in _DOWN and isinstance(link.get("href"), str):
            path = urlsplit(link["href"]).path.removeprefix("./")
            parent = name.rpartition("/")[0]
            yield unquote(f"{parent}/{path}" if parent else path)


def _reason(error: pystac.STACValidationError) -> str:
    from jsonschema import ValidationError

    causes = error.source if isinstance(error.source, list) else [error.source]
    first = causes[0] if causes else error
    if isinstance(first, ValidationError):
        deepest = min([first, *first.context], key=lambda part: -len(part.absolute_path)) if first.context else first
        at = "/".join(map(str, deepest.absolute_path))
        return f"{at}: {deepest.message}" if at else deepest.message
    return str(error)


@cache
def _schemas() -> dict[str, dict[str, Any]]:
    folder = files("apertura.formats.catalog") / "schemas"
    read = [json.loads(path.read_text("utf-8")) for path in sorted(folder.iterdir(), key=lambda path: path.name)]
    return {schema["$id"]: schema for schema in read}


@cache
def _validator() -> "JsonSchemaSTACValidator":
    from pystac.validation.stac_validator import JsonSchemaSTACValidator

    validator = JsonSchemaSTACValidator()
    validator.schema_cache.update(_schemas())
    return validator
