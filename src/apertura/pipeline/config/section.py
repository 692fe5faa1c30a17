"""What every section of the config is, and the names that become names of folders."""

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict

from apertura.common.errors import quoted

RESERVED_NAMES = frozenset(
    {"fused", "layers", "stac", "map", "mosaic", "interferometry", "study", "logs", "benchmarks", "tiles", "workflow"}
)
"""Names of the results folder that no flight or node may take."""

_RESERVED_ENDS = (".json", ".geojson", ".zarr", ".wip", ".lock", ".tif", ".png", ".html", ".vrt", ".qml")
"""What files of the results folder end in: scene.json, cube.manifest.json, cube.zarr …"""

WAVEFORM_KINDS = (
    "ofdm, samples (a pulse given by its samples), fmcw (beat signals of sweeps) or phase_history "
    "(frequency-domain samples); `apertura init --kind` writes the keys of each"
)
"""What the key waveform.kind says of itself, whichever kind it is."""

_AUTHORITY = "[A-Za-z][A-Za-z0-9_]{0,31}"
_CODE = _AUTHORITY + ":[A-Za-z0-9_.-]{1,31}"
_LONGEST = 64
_LONGEST_TITLE = 120

Metres3 = tuple[float, float, float]


class Section(BaseModel):
    """A part of the config; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _plain_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_.]+", name) or name.startswith("."):
        raise ValueError(f"name {quoted(name)}: only letters, digits, '_' and '.' may be used")
    if len(name) > _LONGEST:
        raise ValueError(f"name of {len(name)} characters: at most {_LONGEST} may be used")
    if name.lower() in RESERVED_NAMES or name.lower().endswith(_RESERVED_ENDS):
        raise ValueError(f"name {name!r} is taken by the results folder; choose another")
    return name


def _title(text: str) -> str:
    odd = next((one for one in text if not one.isprintable() or one in '"<>&\\'), None)
    if odd is not None:
        raise ValueError(f"{quoted(text)}: {quoted(odd)} may not be used: it becomes part of WKT, HTML and file tags")
    if not 1 <= len(text.strip()) <= _LONGEST_TITLE:
        raise ValueError(f"{len(text.strip())} characters: 1 to {_LONGEST_TITLE} may be used")
    return text


def plain_crs(crs: str) -> str:
    """Return a CRS that is 'auto', 'local' or authority and code; raise ValueError for any other text.

    Examples
    --------
    >>> plain_crs("EPSG:32632"), plain_crs("EPSG:32632+5773")
    ('EPSG:32632', 'EPSG:32632+5773')
    """
    if not re.fullmatch(rf"auto|local|{_CODE}(\+({_AUTHORITY}:)?[0-9]+)?", crs):
        raise ValueError(
            f"{quoted(crs)}: only authority and code such as EPSG:32632, auto or local may be used, no text of PROJ, "
            "which may name files and code elsewhere"
        )
    return crs


Name = Annotated[str, AfterValidator(_plain_name)]
"""Of a flight or a node."""

CrsName = Annotated[str, AfterValidator(plain_crs)]
"""A coordinate reference system by authority and code, two of them joined by ``+``, 'auto' or 'local'."""

Title = Annotated[str, AfterValidator(_title)]
"""What people read: a line without what WKT, HTML or a terminal would take for their own."""
