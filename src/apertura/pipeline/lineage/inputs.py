"""What a campaign's results are made from, in a folder of its own."""

import os
import shutil
from contextlib import suppress
from pathlib import Path

from apertura.pipeline.campaign import Campaign
from apertura.pipeline.lineage import results_of

_WHOLE = ("config", "raw")
"""Folders of a campaign that are inputs with all that is in them."""


def with_inputs(campaign: Campaign, target: Path, *, link: bool) -> Path:
    """Fill a folder with what a campaign's results are made from; return it.

    What stays is copied: who edits it later must not edit the recordings of the campaign.

    Parameters
    ----------
    campaign
        Of whose folder plain files are taken: those of config/ and raw/, and others that its configuration names.
    target
        The folder, made where it is missing.
    link
        Give recordings as hard links where that is possible.
    """
    sources = {source for _, result in results_of(campaign) for source in result.sources}
    named = [campaign.root / source for source in sources if source.partition("/")[0] not in {"results", *_WHOLE}]
    for path in sorted({*named, *(path for folder in _WHOLE for path in (campaign.root / folder).rglob("*"))}):
        if path.is_file() and not path.is_symlink():
            here = path.relative_to(campaign.root)
            (target / here).parent.mkdir(parents=True, exist_ok=True)
            _put(path, target / here, link=link and here.parts[0] == "raw")
    return target


def _put(path: Path, target: Path, *, link: bool) -> None:
    if link:
        with suppress(OSError):  # another disk, or a file of somebody else's
            os.link(path, target)
            return
    shutil.copy2(path, target)
