"""Tab-separated tables of the config: a heading, then one line per row."""

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

from apertura.common.documents import read_text
from apertura.common.errors import CampaignError, quoted

LARGEST_TABLE = 1_000_000
"""Bytes of a table of the config."""


def table_rows(path: Path, columns: Sequence[str], *, remedy: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield where each row stands, for messages, and its stripped cells by column.

    Parameters
    ----------
    path
        Of the table.
    columns
        The heading.
    remedy
        What to do if there is no such file.

    Raises
    ------
    CampaignError
        If the file is not there, is not UTF-8, or has other columns.
    """
    listed = f"a tab-separated table {list(columns)}"
    text = read_text(path, expected=listed, remedy=remedy, largest=LARGEST_TABLE)
    rows = csv.reader(io.StringIO(text, newline=""), delimiter="\t", strict=True)
    heading = None
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if heading is None:
                heading = cells
                if cells != list(columns):
                    raise CampaignError(f"columns {quoted(cells, 300)}", path, listed, "Correct the heading.")
            elif len(cells) > len(columns):
                found = f"{len(cells)} cells, the last {quoted(cells[-1])}"
                raise CampaignError(found, f"{path}: line {rows.line_num}", listed, "Correct the line.")
            elif row:
                yield f"{path}: line {rows.line_num}", dict(zip(columns, cells + [""] * len(columns), strict=False))
    except csv.Error as error:
        raise CampaignError(
            f"not readable as a table ({error})", f"{path}: line {rows.line_num}", listed, "Correct the line."
        ) from error
    if heading is None:
        raise CampaignError("an empty file", path, listed, remedy)
