"""Whether results may be written."""

import os
from collections.abc import Iterator

from apertura.common.errors import CampaignError
from apertura.pipeline.check.inspected import Inspected


def check_writable(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield a problem where neither the campaign folder nor its results may be written: a read-only disk, another's."""
    campaign = inspected.campaign
    for folder in (campaign.root, campaign.results):
        if folder.exists() and not (folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)):
            yield CampaignError(
                "may not be written" if folder.is_dir() else "is no folder",
                where=folder,
                expected="a folder in which results can be made",
                remedy="Copy the campaign to a disk of your own, or change the folder's permissions.",
            )
