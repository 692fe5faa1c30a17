"""CSV tables of the studies: one dataclass instance per row, one file per table; a file that exists is complete.

The csv module is used instead of pandas, because importing pandas takes one second of jobs that last a few seconds, and
pandas converts text columns that resemble numbers.
"""

import csv
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from apertura.common.atomic import replacement
from apertura.common.errors import CampaignError

Row = TypeVar("Row")


def write_table(path: Path, rows: Iterable[Any], *, digits: int | None = None) -> None:
    """Write rows as CSV, one line per row; an interrupted process leaves a complete file or no file.

    Parameters
    ----------
    path
        The file; missing parent folders are created.
    rows
        At least one dataclass instance or mapping; all rows have the columns of the first row.
    digits
        Significant digits of floats; None for the shortest exact representation.
    """
    records = [_record(row, digits) for row in rows]
    with replacement(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)


def _record(row: Any, digits: int | None) -> Mapping[str, object]:
    record: Mapping[str, object] = asdict(row) if is_dataclass(row) and not isinstance(row, type) else row
    if digits is None:
        return record
    return {name: f"{value:.{digits}g}" if isinstance(value, float) else value for name, value in record.items()}


def read_table(path: Path, kind: type[Row]) -> list[Row]:
    """Read a file written by `write_table`; each row becomes an instance of dataclass `kind`.

    The fields of `kind` have the types str, int or float.

    Raises
    ------
    CampaignError
        If the file is missing.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> from tempfile import TemporaryDirectory
    >>> @dataclass(frozen=True)
    ... class Loss:
    ...     cause: str
    ...     loss_db: float
    >>> with TemporaryDirectory() as folder:
    ...     write_table(Path(folder) / "losses.csv", [Loss("timing", 1.5)])
    ...     read_table(Path(folder) / "losses.csv", Loss)
    [Loss(cause='timing', loss_db=1.5)]
    """
    if not path.is_file():
        raise CampaignError("no such file", path, "a table of a study", "First run the command that writes the table.")
    types = get_type_hints(kind)
    convert = {field.name: types[field.name] for field in fields(kind)}  # type: ignore[arg-type]
    with path.open(encoding="utf-8", newline="") as stream:
        return [kind(**{name: convert[name](text) for name, text in row.items()}) for row in csv.DictReader(stream)]
