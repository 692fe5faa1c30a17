"""benchmarks/latest.json: one list of rows, of several benchmarks, each of which replaces its own."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

LATEST = Path(__file__).with_name("latest.json")
Row = dict[str, Any]


def replace_rows(made: list[Row], old: Callable[[Row], bool]) -> list[Row]:
    """Write rows in the place of those that are old, after what is kept; return all."""
    kept = [row for row in read_rows() if not old(row)]
    LATEST.write_text(json.dumps([*kept, *made], indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return [*kept, *made]


def read_rows() -> list[Row]:
    """Return all rows."""
    return list(json.loads(LATEST.read_text(encoding="utf-8"))) if LATEST.exists() else []
