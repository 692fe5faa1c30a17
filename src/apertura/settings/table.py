"""Tab-separated tables of the config: a heading, then one line per row."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from apertura.errors import CampaignError


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
        If the file is not there or has other columns.
    """
    if not path.is_file():
        raise CampaignError(
            "no such file", where=path, expected=f"a tab-separated table {list(columns)}", remedy=remedy
        )
    with path.open(encoding="utf-8", newline="") as lines:
        table = csv.DictReader(lines, delimiter="\t")
        if table.fieldnames is None or [name.strip() for name in table.fieldnames] != list(columns):
            raise CampaignError(
                f"columns {table.fieldnames}",
                where=path,
                expected=f"{list(columns)}, tab-separated",
                remedy="Correct it.",
            )
        for number, row in enumerate(table, start=2):
            yield f"{path}: line {number}", {key: (row.get(key) or "").strip() for key in columns}
