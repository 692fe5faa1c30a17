"""Tables of comma-separated values that strangers wrote: columns by name, each once, numbers and nothing else."""

import csv
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from apertura.common.errors import quoted

LARGEST_LOG = 500_000_000
"""Bytes of a flight log or a table: a day at 50 Hz."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.ASCII | re.IGNORECASE)


def number(text: str) -> float:
    """Return the number in a cell, written in ASCII without underscores; ValueError if it is none.

    Examples
    --------
    >>> number("-1.5e3"), number("nan")
    (-1500.0, nan)
    """
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"{quoted(text, 40)} is no number")
    return float(text)


def cut_off(path: Path) -> bool:
    """Return whether a file ends within a line: of the last number digits may be lost.

    Parameters
    ----------
    path
        A text that ends each line; an empty one is not cut off.
    """
    with path.open("rb") as stream:
        if not stream.seek(0, 2):
            return False
        stream.seek(-1, 2)
        return stream.read() not in {b"\n", b"\r"}


def read_table(
    path: Path,
    required: Sequence[str],
    *,
    optional: Sequence[str] = (),
    texts: Sequence[str] = ("time_utc", "quality"),
) -> pd.DataFrame:
    """Return the table in a CSV file, whose columns stand under their names.

    Parameters
    ----------
    path
        UTF-8, with or without byte-order mark; the first line names the columns.
    required, optional
        Names of columns that must be there, or may, but once.
    texts
        Names of columns that are not read as numbers.

    Raises
    ------
    ValueError
        If it is no table, its cells stand between semicolons, it lacks a column or has one twice, or a line has more or
        fewer cells than the heading.
    """
    if path.stat().st_size > LARGEST_LOG:
        raise ValueError(f"{path.stat().st_size} bytes, at most {LARGEST_LOG} are read")
    _check_cells(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.errors.ParserWarning)  # cells beyond the heading would be dropped
        try:
            table = pd.read_csv(
                path,
                encoding="utf-8-sig",
                skipinitialspace=True,
                index_col=False,
                dtype=dict.fromkeys(texts, str),
                low_memory=False,
            )
        except pd.errors.ParserWarning as error:
            raise ValueError("a line has more cells than the heading") from error
    missing = [name for name in required if name not in table.columns]
    if missing:
        raise ValueError(f"no column {missing[0]} among {quoted(list(table.columns), 300)}")
    doubled = [name for name in (*required, *optional) if f"{name}.1" in table.columns]
    if doubled:
        raise ValueError(f"column {doubled[0]} a second time")
    return table


def _check_cells(path: Path) -> None:
    """Raise ValueError where a line has fewer cells than the heading, a piece is gone, maybe of a number; or more."""
    with path.open(encoding="utf-8-sig", newline="") as stream:
        rows = csv.reader(stream, skipinitialspace=True)
        try:
            heading = next((row for row in rows if row), [])
            if len(heading) == 1 and ";" in heading[0]:
                raise ValueError(f"line {rows.line_num} has its cells between semicolons, not commas")
            # one cell that is empty is a comma that ends the line
            odd = next((row for row in rows if row and len(row) - (row[-1] == "") != len(heading) != len(row)), None)
        except csv.Error as error:
            raise ValueError(f"line {rows.line_num}: {error}") from error
    if odd is not None:
        raise ValueError(f"line {rows.line_num} has {len(odd)} cells, the heading {len(heading)}")


def numbers(columns: pd.DataFrame) -> NDArray[np.float64]:
    """Return columns as (row, column) float64, NaN where a cell is empty; ValueError names a cell that is no number."""
    for name in columns.columns:
        if columns[name].dtype.kind in "fiu":
            continue
        cells = columns[name].dropna().astype(str).str.strip()
        wrong = cells[~cells.map(lambda cell: bool(_NUMBER.fullmatch(cell)))]
        if len(wrong):
            raise ValueError(f"could not convert string to a number in column {name}: {quoted(wrong.iloc[0], 40)}")
    return columns.to_numpy(np.float64, na_value=np.nan)
