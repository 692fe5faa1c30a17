"""Links below the results: what is written or deleted there must not reach another place."""

import os
from collections.abc import Iterator
from pathlib import Path

from apertura.check.inspected import Inspected
from apertura.errors import CampaignError


def check_links(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield an error for each symbolic link that the results, or Snakemake's own records, hold or are."""
    for folder in ("results", ".snakemake"):
        top = inspected.campaign.root / folder
        yield from (_refused(path) for path in _links(top))


def _links(top: Path) -> Iterator[Path]:
    if top.is_symlink():
        yield top
        return
    for folder, folders, files in os.walk(top):  # never into a linked folder
        yield from (path for path in (Path(folder, name) for name in (*folders, *files)) if path.is_symlink())


def _refused(path: Path) -> CampaignError:
    return CampaignError(
        "a symbolic link",
        where=path,
        expected="a folder or a file: nothing is written or deleted through a link",
        remedy="Remove it; to keep results elsewhere, put the whole campaign folder there.",
    )
