"""Snakemake's own records in a campaign folder: of no use where they are damaged, and of no harm to lose."""

import json
from pathlib import Path

_FOLDERS = ("metadata", "incomplete")


def drop_damaged_records(root: Path) -> int:
    """Remove the records of earlier runs that Snakemake could not read; return how many.

    What is stale is told by hashes, not by these: without them, a report only lacks how long earlier jobs took.
    """
    records = root / ".snakemake"
    damaged = [path for folder in _FOLDERS for path in (records / folder).rglob("*") if _is_damaged(path)]
    for path in damaged:
        path.unlink()
    if (records / "metadata").is_dir():
        (records / "incomplete").mkdir(exist_ok=True)  # without it Snakemake takes the records for those of version 7
    return len(damaged)


def _is_damaged(path: Path) -> bool:
    if not path.is_file() or path.name == "migration_underway":
        return path.is_file()
    try:
        return not isinstance(json.loads(path.read_bytes() or b"{}"), dict)
    except (ValueError, RecursionError):
        return True
