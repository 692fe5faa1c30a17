"""Draft of a config: values with their origin, questions, and keys left open with the reason."""

from collections.abc import Callable, Mapping, Sequence
from datetime import date
from typing import Annotated, Any, NamedTuple, get_args

import yaml
from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from apertura.campaign.config import Node, Settings
from apertura.campaign.config.template import WAVEFORMS
from apertura.common.errors import CampaignError, number_of, quoted

SIDE = "side"
"""Name of the side of the track in questions; it is not a key of the config."""

SIDES = ("left", "right", "both")
"""Sides of the track, in flight direction, on which the scene may lie."""


class Question(NamedTuple):
    """Question for values that no file contains.

    Attributes
    ----------
    keys
        Keys of the config that the words of the answer set, or log, transmitter, side.
    text
        Meaning and unit of each word.
    example
        Valid answer.
    """

    keys: tuple[str, ...]
    text: str
    example: str


Ask = Callable[[Question, str], str]
"""Function of a question, and the problem of the previous answer or empty text → answer; empty: leave open."""


def described_key(key: str, kind: str) -> FieldInfo:
    """Return the field of a key of the config.

    Parameters
    ----------
    key
        Key with its sections, separated by dots.
    kind
        waveform.kind.

    Raises
    ------
    CampaignError
        If there is no such key.

    Examples
    --------
    >>> described_key("scene.height_m", "ofdm").description
    'height of flat terrain, m; ignored if dem is set'
    """
    model: Any = Settings
    parts = key.split(".")
    info: FieldInfo | None = None
    for depth, part in enumerate(parts):
        if depth == 1 and parts[0] == "nodes":
            model = Node
            continue
        info = getattr(model, "model_fields", {}).get(part)
        if info is None:
            break
        kinds = [one for one in (info.annotation, *get_args(info.annotation)) if isinstance(one, type)]
        model = WAVEFORMS[kind] if key.startswith("waveform.") and depth == 0 else None
        model = model or next((one for one in kinds if issubclass(one, BaseModel)), None)
    if info is None:
        raise CampaignError(f"unknown key {quoted(key)}", "--set", "a key of config/config.yaml", "Correct the key.")
    return info


class Draft:
    """Contents of config.yaml.

    Parameters
    ----------
    given
        Key → text of its value, as given by the user.
    ask
        Function that asks the user; None: values stay open.
    """

    def __init__(self, given: Mapping[str, str], ask: Ask | None) -> None:
        self.given, self.ask = dict(given), ask
        self.questions: list[Question] = []
        self.values: dict[str, Any] = {}
        self.comments: dict[str, str] = {}
        self.open: dict[str, str] = {}
        self.kind = "ofdm"

    def value(self, key: str, text: str) -> Any:
        """Validate the text of a value against the schema of the config; return a plain value for YAML."""
        if key == SIDE:
            if text not in SIDES:
                raise CampaignError(quoted(text), SIDE, f"one of {', '.join(SIDES)}", "Name a side of the track.")
            return text
        info = described_key(key, self.kind)
        adapter: TypeAdapter[Any] = TypeAdapter(Annotated[info.annotation, info])  # type: ignore[arg-type]
        try:
            read = yaml.safe_load(text)
            value = adapter.validate_python(text if isinstance(read, date) else read)  # times are texts in the config
            return adapter.dump_python(value, mode="json", exclude_unset=True)
        except (ValidationError, yaml.YAMLError) as error:
            reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else "not readable as YAML"
            raise CampaignError(f"{quoted(text)}: {reason}", key, str(info.description), "Correct the value.") from None

    def set(self, key: str, value: Any, origin: str) -> None:
        """Set a key to a value from the files, unless the user has given its value."""
        is_given = key in self.given
        self.values[key] = self.value(key, self.given[key]) if is_given else value
        self.comments[key] = "given" if is_given else origin

    def leave(self, key: str, reason: str) -> None:
        """Leave a key open, with a reason, unless the user has given its value."""
        if not any(f"{other}.".startswith(f"{key}.") for other in self.given):
            self.open[key] = reason

    def need(self, keys: Mapping[str, tuple[str, str]], reason: str) -> bool:
        """Set keys to given values or to the words of one answer; without an answer leave them open.

        `keys` contains the meaning and an example of each key. True if the keys are set.
        """
        for key in keys.keys() & self.given.keys():
            self.set(key, None, "given")
        rest = {key: words for key, words in keys.items() if key not in self.given}
        if not rest:
            return True
        meanings, examples = zip(*rest.values(), strict=True)
        answer = self.answer(Question(tuple(rest), "; ".join(meanings), " ".join(examples)))
        for key, word in zip(rest, answer or (), strict=False):
            self.values[key], self.comments[key] = word, "answered"
        for key in rest if answer is None else ():
            self.leave(key, reason)
        return answer is not None

    def answer(self, question: Question, allowed: Sequence[str] = ()) -> list[Any] | None:
        """Ask a question until the answer is valid; None if it stays open.

        Answers are one of the texts `allowed`, or a valid value of each key; the word for `SIDE` may be missing.
        """
        if self.ask is None:
            return None
        self.questions.append(question)
        problem = ""
        while text := self.ask(question, problem).strip():
            try:
                return self._words(question.keys, text, allowed)
            except CampaignError as error:
                problem = str(error)
        return None

    def _words(self, keys: Sequence[str], text: str, allowed: Sequence[str]) -> list[Any]:
        if allowed:
            if text not in allowed:
                raise CampaignError(quoted(text), keys[0], f"one of {', '.join(allowed)}", "Answer again.")
            return [text]
        texts = text.replace(",", " ").split() if len(keys) > 1 else [text]
        if not len(keys) - (SIDE in keys) <= len(texts) <= len(keys):
            raise CampaignError(number_of(len(texts), "value"), keys[0], f"{', '.join(keys)}", "Answer again.")
        return [self.value(key, word) for key, word in zip(keys, texts, strict=False)]

    def document(self) -> dict[str, Any]:
        """Return all values as nested sections, including given values that the files did not need."""
        for key in [key for key in self.given if key not in self.values]:
            self.set(key, None, "given")
        nested: dict[str, Any] = {}
        for key, value in self.values.items():
            *sections, last = key.split(".")
            part = nested
            for section in sections:
                part = part.setdefault(section, {})
            part[last] = value
        return nested

    def is_complete(self) -> bool:
        """Return True if no required key is open."""
        return not any(described_key(key, self.kind).is_required() or key == "scene.dem_datum" for key in self.open)
