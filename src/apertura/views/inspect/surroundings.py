"""Where a file lies: its node, its campaign if it is in one, and what that says of how it is to be read."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, get_args

from apertura.campaign.config import CLOCKS, CONFIG, read_settings
from apertura.campaign.config.nodes import Log
from apertura.common.documents import validated
from apertura.common.errors import CampaignError
from apertura.formats.tracks.log_options import AS_IT_SAYS, LogOptions, QualityNumbers, TimeSystem

NODE = "<node>"
"""Stands for a name that is not known."""

_KEY = re.compile(r"\bnodes\.\S+?\.log\.(\w+)")
_OPTIONS = {one.name for one in fields(LogOptions)}
_TABLES = {"columns", "scales"}
_TYPED = {
    "columns": "columns.NAME='COLUMN OF THE LOG'",
    "scales": "scales.NAME=FACTOR",
    "quality": f"quality={'|'.join(get_args(QualityNumbers))}",
    "base": "base=LATITUDE,LONGITUDE,HEIGHT",
    "time_system": f"time_system={'|'.join(get_args(TimeSystem))}",
    "start_utc": "start_utc=YYYY-MM-DDTHH:MM:SS",
}
_EXPECTED = f"--set KEY=VALUE, a key of {', '.join(sorted(_OPTIONS))}"


@dataclass(frozen=True)
class Surroundings:
    """How a file is to be read.

    Attributes
    ----------
    node
        Whose file it is, by its name.
    options
        Of its log.
    waveform
        Section of the config of the campaign that it lies in; empty outside.
    problem
        Why that config cannot be read.
    typed
        Keys of its log that were typed with --set.
    logged
        Whether a flight log of the node lies beside.
    aligned
        Whether its campaign says how clocks stand to logs.
    """

    node: str
    options: LogOptions = AS_IT_SAYS
    waveform: Mapping[str, Any] = field(default_factory=dict)
    problem: CampaignError | None = None
    typed: Mapping[str, Any] = field(default_factory=dict)
    logged: bool = False
    aligned: bool = False


def surroundings(path: Path, settings: Sequence[str]) -> Surroundings:
    """Return how a file is to be read: by what is typed, else as the config of its campaign says.

    Parameters
    ----------
    path
        The file, absolute.
    settings
        KEY=VALUE, keys of `LogOptions`; a column is columns.NAME, its factor scales.NAME, a base three numbers with
        commas.

    Raises
    ------
    CampaignError
        If a setting is none.
    """
    name = path.name.partition(".track.")[0] if ".track." in path.name else path.name.partition(".")[0]
    typed = _parsed(settings)
    config = path.parents[2] / CONFIG if path.parent.parent.name == "raw" else None
    if config is None or not config.is_file():
        node = name if ".track." in path.name else NODE
        return Surroundings(node, _log(typed).options, typed=typed)
    try:
        stated = read_settings(config)
    except CampaignError as problem:
        return Surroundings(name, _log(typed).options, problem=problem, typed=typed)
    log = stated.nodes[name].log.model_dump() if name in stated.nodes else {}
    return Surroundings(
        name,
        _log(log | typed).options,
        stated.waveform.model_dump(),
        typed=typed,
        logged=any(other.name.startswith(f"{name}.track.") for other in path.parent.iterdir()),
        aligned=(path.parents[2] / CLOCKS).is_file(),
    )


def _log(values: Mapping[str, Any]) -> Log:
    return validated(Log, dict(values), where="--set", expected=_EXPECTED)


def _parsed(settings: Sequence[str]) -> dict[str, Any]:
    parsed: dict[str, Any] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        table, dot, column = key.partition(".")
        if not equals or table not in (_TABLES if dot else _OPTIONS):
            raise CampaignError(setting, "--set", _EXPECTED, "Correct it.")
        if dot:
            parsed.setdefault(table, {})[column] = value
        else:
            parsed[key] = value.split(",") if key == "base" else value
    return parsed


def retries(problem: CampaignError) -> list[str]:
    """Return what to type to read a log that was refused for want of a key.

    Examples
    --------
    >>> retries(CampaignError("times of day only", "a.nmea", "key nodes.u.log.start_utc in config.yaml", "Add it."))
    ['set nodes.<node>.log.start_utc in the config; to try a value now: --set start_utc=YYYY-MM-DDTHH:MM:SS']
    """
    sentence = f"{problem.found} {problem.expected} {problem.remedy}"
    keys = [key for key in dict.fromkeys(_KEY.findall(sentence)) if key in _OPTIONS]
    return [
        f"set nodes.{NODE}.log.{key} in the config; to try a value now: --set {_TYPED.get(key, f'{key}=VALUE')}"
        for key in keys
    ]
