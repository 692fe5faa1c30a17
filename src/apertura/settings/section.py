"""What every section of the config is, and the names that become names of folders."""

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict

RESERVED_NAMES = frozenset({"fused", "layers", "stac", "map", "study", "logs", "benchmarks", "cube.zarr"})
"""Names of the results folder that no flight or node may take."""

Metres3 = tuple[float, float, float]


class Section(BaseModel):
    """A part of the config; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _plain_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_.]+", name) or name.startswith("."):
        raise ValueError(f"name {name!r}: only letters, digits, '_' and '.' may be used")
    if name in RESERVED_NAMES:
        raise ValueError(f"name {name!r} is taken by the results folder; choose another")
    return name


Name = Annotated[str, AfterValidator(_plain_name)]
"""Of a flight or a node."""
