"""Commented config template and JSON schema, both generated from `Settings`."""

import json
import textwrap
import types
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Union, get_args, get_origin

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from apertura.campaign.config import Node, Settings
from apertura.campaign.config.waveform import Waveform
from apertura.common.errors import CampaignError, quoted
from apertura.core.backprojection.engines import ENGINES, load_engine

WAVEFORMS: dict[str, type[BaseModel]] = {
    get_args(section.model_fields["kind"].annotation)[0]: section for section in get_args(get_args(Waveform)[0])
}
"""waveform.kind → class of the section `waveform`."""

_FLIGHTS = "flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\t{nodes}\n"
_NODES = {"fmcw": ("uav1",), "phase_history": ("uav1",)}
"""Kinds of waveform whose example has a single node; the examples of other kinds have two nodes."""


def config_template(kind: str = "ofdm") -> str:
    """Return config/config.yaml with all keys; each key has its meaning as a comment, and its default or an example.

    Parameters
    ----------
    kind
        Kind of waveform, a key of `WAVEFORMS`.

    Raises
    ------
    CampaignError
        If the kind does not exist.

    Examples
    --------
    >>> print(config_template().splitlines()[2])
    # name of the campaign
    """
    if kind not in WAVEFORMS:
        raise CampaignError(
            f"kind {quoted(kind)}",
            where="apertura init",
            expected=f"one of {', '.join(WAVEFORMS)}",
            remedy="Choose one of these kinds.",
        )
    examples = {"waveform": WAVEFORMS[kind], "nodes": dict.fromkeys(_nodes(kind), Node)}
    header = "# Generated from the settings model by `apertura init`; see config/README.md.\n\n"
    return header + "\n".join(_section(Settings, 0, examples)) + "\n"


def flights_template(kind: str = "ofdm") -> str:
    """Return config/flights.tsv with an example flight for a kind of waveform."""
    return _FLIGHTS.format(nodes=",".join(_nodes(kind)))


def _nodes(kind: str) -> tuple[str, ...]:
    return _NODES.get(kind, ("uav1", "uav2"))


_WIDTH = 116


def commented_yaml(values: Mapping[str, Any], comments: Mapping[str, str], open_keys: Mapping[str, str]) -> str:
    """Return a config with a comment for each value, and commented keys for values that are not known.

    Parameters
    ----------
    values
        Nested sections; sections without values are omitted.
    comments
        Key, with sections separated by dots → origin of its value.
    open_keys
        Key → reason for which it is open, and the value to be written.

    Examples
    --------
    >>> print(commented_yaml({"a": {"b": 1}}, {"a.b": "of a file"}, {"a.c": "unknown; write c"}), end="")
    a:
      # of a file
      b: 1
      # unknown; write c
      # c:
    """
    return "\n".join(_commented(values, comments, open_keys, "", 0)) + "\n"


def _commented(
    values: Mapping[str, Any], comments: Mapping[str, str], open_keys: Mapping[str, str], section: str, depth: int
) -> list[str]:
    indent, lines = "  " * depth, list[str]()

    def comment(text: str) -> list[str]:
        return [f"{indent}# {line}" for line in textwrap.wrap(text, _WIDTH - len(indent), break_long_words=False)]

    for name, value in values.items():
        key = f"{section}{name}"
        lines += comment(comments[key]) if key in comments else []
        if isinstance(value, dict) and value and key not in comments:
            lines += [f"{indent}{name}:", *_commented(value, comments, open_keys, f"{key}.", depth + 1)]
        else:
            scalar = yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("\n").removesuffix("\n...")
            lines.append(f"{indent}{name}: {scalar}")
    for key, reason in open_keys.items():
        if key.startswith(section) and "." not in key[len(section) :]:
            lines += [*comment(reason), f"{indent}# {key[len(section) :]}:"]
    return lines


def config_schema() -> str:
    """Return the JSON schema of config/config.yaml."""
    return json.dumps(Settings.model_json_schema(), indent=1) + "\n"


def _section(model: type[BaseModel], depth: int, examples: Mapping[str, Any] = MappingProxyType({})) -> list[str]:
    lines: list[str] = []
    for name, field in model.model_fields.items():
        indent = "  " * depth
        lines.append(f"{indent}# {field.description}{_choices(field)}")
        if name == "engine_options":
            engines = {name: load_engine(name).Options.model_fields for name in ENGINES}
            lines += [
                f"{indent}#   {engine}.{key}: {option.description}{_choices(option)}"
                for engine, options in engines.items()
                for key, option in options.items()
            ]
        value = examples[name] if name in examples else _value(field)
        if isinstance(value, type) and issubclass(value, BaseModel):
            lines += [f"{indent}{name}:", *_section(value, depth + 1)]
        elif isinstance(value, dict) and value:
            lines.append(f"{indent}{name}:")
            for key, inner in value.items():
                lines += [f"{indent}  {key}:", *_section(inner, depth + 2)]
        else:
            plain = list(value) if isinstance(value, tuple) else value
            scalar = yaml.safe_dump(plain, default_flow_style=True).removesuffix("\n").removesuffix("\n...")
            lines.append(f"{indent}{name}: {scalar}")
    return lines


def _value(field: FieldInfo) -> Any:
    if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
        return field.annotation
    if field.examples:
        return field.examples[0]
    if field.default is not PydanticUndefined:
        return field.default
    if field.default_factory is dict:
        return {}
    return get_args(field.annotation)[0]  # first choice of a Literal without default


def _choices(field: FieldInfo) -> str:
    """Return the allowed values or the range of a field in parentheses, unless the description lists the values."""
    kinds = (
        get_args(field.annotation) if get_origin(field.annotation) in (Union, types.UnionType) else (field.annotation,)
    )
    words = [str(word) for kind in kinds if str(kind).startswith("typing.Literal") for word in get_args(kind)]
    listed = [word for word in words if word not in (field.description or "")]
    if listed and len(words) > 1:
        return f" ({' | '.join(words)})"
    limits = [
        limit
        for kind in kinds
        for metadata in getattr(kind, "__metadata__", ())
        for limit in getattr(metadata, "metadata", ())
    ]
    ends = [getattr(limit, end) for end in ("gt", "ge", "lt", "le") for limit in limits if hasattr(limit, end)]
    above = any(hasattr(limit, "gt") for limit in limits)
    return f" ({'above ' if above else ''}{ends[0]:g} to {ends[1]:g})" if len(ends) == 2 else ""
