"""From a config file to `Settings`, or to the one message that says all that is wrong with it."""

import difflib
import re
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from apertura.errors import CampaignError
from apertura.settings.config import Settings

_TYPE = r"(ofdm|phase_history|constrained-\w+|literal\[.*|function-.*|tuple\[.*|bool|int|float|str)$"
"""What pydantic adds to the way to a key where it may hold one of several types."""


def read_settings(path: Path) -> Settings:
    """Return the settings in a config file.

    Raises
    ------
    CampaignError
        If it is not there, is not YAML, or `validated` refuses it.
    """
    if not path.is_file():
        raise CampaignError(
            "no such file", where=path, expected="a campaign folder", remedy="`apertura init` writes a commented one."
        )
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CampaignError(
            f"not readable as YAML ({' '.join(str(error).split())})",
            where=path,
            expected="YAML",
            remedy="Mend the line named.",
        ) from error
    return validated(document, where=path)


def validated(document: object, *, where: object) -> Settings:
    """Return `document` as Settings; one message names every wrong key and the nearest valid one.

    Raises
    ------
    CampaignError
        With file, key, what was found and what was expected.

    Examples
    --------
    >>> validated({"campaing": "x"}, where="config.yaml")
    Traceback (most recent call last):
    ...
    apertura.errors.CampaignError: config.yaml: campaing: unknown key (did you mean 'campaign'?); campaign: missing; ...
    """
    try:
        return Settings.model_validate(document)
    except ValidationError as error:
        wrong: dict[str, list[str]] = {}
        for item in error.errors(include_url=False):
            key, line = _complaint(dict(item))
            wrong.setdefault(key, []).append(line)
        lines = [f"{key}: {' or '.join(found)}" for key, found in wrong.items()]
        raise CampaignError(
            "; ".join(sorted(lines, key=lambda line: "unknown key" not in line)),
            where=where,
            expected="the keys and values of config/config.yaml as `apertura init` writes it",
            remedy="Correct what is named.",
        ) from error


def _complaint(item: dict[str, Any]) -> tuple[str, str]:
    """Return the key and what is wrong with it; the names of alternative types are no keys."""
    location = [str(part) for part in item["loc"] if not re.match(_TYPE, str(part))]
    key = ".".join(location) or "the whole file"
    if item["type"] == "extra_forbidden":
        known = sorted(_known_keys(Settings.model_json_schema()))
        near = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.5)
        return key, "unknown key" + (f" (did you mean '{near[0]}'?)" if near else "")
    if item["type"] == "missing":
        return key, "missing"
    found = "" if isinstance(item["input"], dict | BaseModel) else f" (found {item['input']!r})"
    return key, f"{item['msg'].removeprefix('Value error, ')}{found}"


def _known_keys(schema: object) -> set[str]:
    if isinstance(schema, list):
        return set().union(*map(_known_keys, schema))
    if not isinstance(schema, dict):
        return set()
    nested = set().union(*map(_known_keys, schema.values()))
    properties = schema.get("properties", {})
    return nested | set(properties) if isinstance(properties, dict) else nested
