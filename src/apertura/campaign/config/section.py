"""Base class of config sections, types of names, and reading of config tables."""

import csv
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict

from apertura.common.documents import read_text
from apertura.common.errors import CampaignError, quoted

# ---- Base class of sections; names that become folder names ----------------------------------------------------------

RESERVED_NAMES = frozenset(
    {
        *("fused", "layers", "stac", "map", "mosaic", "interferometry", "stack", "study", "logs", "benchmarks"),
        *("tiles", "tracks", "workflow", "preview"),
    }
)
"""Names of files and folders in the results folder, which flights and nodes must not have."""

_RESERVED_ENDS = (".json", ".geojson", ".zarr", ".wip", ".lock", ".tif", ".png", ".html", ".vrt", ".qml")
"""Suffixes of files in the results folder: scene.json, cube.manifest.json, cube.zarr …"""

WAVEFORM_KINDS = (
    "ofdm, samples (a pulse given by its samples), fmcw (beat signals of sweeps) or phase_history "
    "(frequency-domain samples); `apertura init --kind` writes the keys of a kind"
)
"""Description of the key waveform.kind."""

_AUTHORITY = "[A-Za-z][A-Za-z0-9_]{0,31}"
_CODE = _AUTHORITY + ":[A-Za-z0-9_.-]{1,31}"
_LONGEST = 64

Metres3 = tuple[float, float, float]


class Section(BaseModel):
    """Section of the config; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _plain_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_.]+", name) or name.startswith("."):
        raise ValueError(f"name {quoted(name)}: only letters, digits, '_' and '.' may be used")
    if len(name) > _LONGEST:
        raise ValueError(f"name of {len(name)} characters: at most {_LONGEST} may be used")
    if name.lower() in RESERVED_NAMES or name.lower().endswith(_RESERVED_ENDS):
        raise ValueError(f"name {name!r} is reserved for files in the results folder; choose another name")
    return name


def _absolute(path: str) -> str:
    if not path.startswith("/") or not path.isprintable() or ".." in path.split("/"):
        raise ValueError(f"{quoted(path)}: must be the absolute path of a folder without '..'")
    return path


def plain_crs(crs: str) -> str:
    """Check that a CRS is 'auto', 'local' or authority and code, and return it; raise ValueError for any other text.

    Examples
    --------
    >>> plain_crs("EPSG:32632"), plain_crs("EPSG:32632+5773")
    ('EPSG:32632', 'EPSG:32632+5773')
    """
    if not re.fullmatch(rf"auto|local|{_CODE}(\+({_AUTHORITY}:)?[0-9]+)?", crs):
        raise ValueError(
            f"{quoted(crs)}: must be authority and code such as EPSG:32632, or auto, or local; PROJ strings and WKT "
            "are not accepted, because they may refer to files"
        )
    return crs


Name = Annotated[str, AfterValidator(_plain_name)]
"""Name of a flight or a node."""

CrsName = Annotated[str, AfterValidator(plain_crs)]
"""Coordinate reference system: authority and code (two codes joined by ``+`` if compound), 'auto' or 'local'."""

RawRoot = Annotated[str, AfterValidator(_absolute)]
"""Path of a folder outside the campaign."""


# ---- Tab-separated tables of the config: a header line, then one line per row ----------------------------------------

LARGEST_TABLE = 1_000_000
"""Maximum size of a config table, bytes."""


def table_rows(path: Path, columns: Sequence[str], *, remedy: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield, for each row, file and line number (for messages) and the stripped cells by column.

    Parameters
    ----------
    path
        Path of the table; lines that begin with # and blank lines are ignored.
    columns
        Column names of the header line.
    remedy
        Remedy for a missing file.

    Raises
    ------
    CampaignError
        If the file is missing, is not UTF-8, or has other columns.
    """
    listed = f"a tab-separated table {list(columns)}"
    text = read_text(path, expected=listed, remedy=remedy, largest=LARGEST_TABLE)
    rows = csv.reader(io.StringIO(text, newline=""), delimiter="\t", strict=True)
    heading = None
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if not any(cells) or cells[0].startswith("#"):
                continue
            if heading is None:
                heading = cells
                if cells != list(columns):
                    raise CampaignError(f"columns {quoted(cells, 300)}", path, listed, "Correct the header line.")
            elif len(cells) > len(columns):
                problem = f"{len(cells)} cells, the last of which is {quoted(cells[-1])}"
                raise CampaignError(problem, f"{path}: line {rows.line_num}", listed, "Correct the line.")
            else:
                yield f"{path}: line {rows.line_num}", dict(zip(columns, cells + [""] * len(columns), strict=False))
    except csv.Error as error:
        raise CampaignError(
            f"not readable as a table ({error})", f"{path}: line {rows.line_num}", listed, "Correct the line."
        ) from error
    if heading is None:
        raise CampaignError("an empty file", path, listed, remedy)
