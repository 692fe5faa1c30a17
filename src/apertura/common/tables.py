"""Tables of the studies: one dataclass per row, one CSV file per table; a file that exists is complete.

The csv module does it: a job of a study takes seconds, importing pandas alone one of them, and a column of text that
looks like numbers stays text.
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
    """Write rows as CSV, one line each; a kill leaves all of the file or none.

    Parameters
    ----------
    path
        Folders above it are made.
    rows
        At least one dataclass instance or mapping, all with the columns of the first.
    digits
        Significant digits of floats; None: as many as distinguish them.
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
    """Return the rows of a file of `write_table`, each a dataclass `kind` with fields of str, int and float.

    Raises
    ------
    CampaignError
        If it is not there.

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
        raise CampaignError("no such file", path, "the rows of a study", "Run the command that writes it first.")
    types = get_type_hints(kind)
    convert = {field.name: types[field.name] for field in fields(kind)}  # type: ignore[arg-type]
    with path.open(encoding="utf-8", newline="") as stream:
        return [kind(**{name: convert[name](text) for name, text in row.items()}) for row in csv.DictReader(stream)]
