"""Links below the results, through which another place would be written; modules that Snakemake's jobs would import."""

import os
from collections.abc import Iterator
from pathlib import Path

from apertura.common.errors import CampaignError
from apertura.pipeline.check.inspected import Inspected

_IMPORTED = ".snakemake/pip-deployments"
"""Relative to the working folder (snakemake 9, `PIP_DEPLOYMENTS_PATH`): for plugins that a job installs itself."""


def check_links(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield an error for each symbolic link that the results, or Snakemake's own records, hold or are."""
    for folder in ("results", ".snakemake"):
        top = inspected.campaign.root / folder
        yield from (_refused(path) for path in _links(top))


def check_modules(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield an error where modules lie in the folder that Snakemake puts on its search path in every job."""
    folder = inspected.campaign.root / _IMPORTED
    if folder.is_dir() and any(folder.iterdir()):
        yield CampaignError(
            "Python modules in Snakemake's own folder",
            where=folder,
            expected="a campaign folder without code: every job would import them",
            remedy="Remove that folder; plugins of Snakemake are installed beside apertura.",
        )


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
