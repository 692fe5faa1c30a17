"""Names of flights and nodes: they become names of folders."""

import re
from typing import Annotated

from pydantic import AfterValidator

RESERVED_NAMES = frozenset({"fused", "layers", "stac", "map", "study", "logs", "benchmarks", "cube.zarr"})


def _plain_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_.]+", name) or name.startswith("."):
        raise ValueError(f"name {name!r}: only letters, digits, '_' and '.' may be used")
    if name in RESERVED_NAMES:
        raise ValueError(f"name {name!r} is taken by the results folder; choose another")
    return name


Name = Annotated[str, AfterValidator(_plain_name)]
