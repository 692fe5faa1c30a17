"""Reading and writing of benchmarks/latest.json, a list of rows; each benchmark replaces its own rows."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

LATEST = Path(__file__).with_name("latest.json")
Row = dict[str, Any]


def replace_rows(new: list[Row], old: Callable[[Row], bool]) -> list[Row]:
    """Replace the old rows by new ones, written after the kept rows; return all rows."""
    kept = [row for row in read_rows() if not old(row)]
    LATEST.write_text(json.dumps([*kept, *new], indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return [*kept, *new]


def read_rows() -> list[Row]:
    """Read all rows."""
    return list(json.loads(LATEST.read_text(encoding="utf-8"))) if LATEST.exists() else []
