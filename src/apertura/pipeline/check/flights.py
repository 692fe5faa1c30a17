"""Whether there is a flight to image."""

from collections.abc import Iterator

from apertura.common.errors import CampaignError
from apertura.pipeline.check.inspected import Inspected
from apertura.pipeline.config import FLIGHTS


def check_flights(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield a problem where no flight becomes an image."""
    if not inspected.campaign.image_flights:
        yield CampaignError(
            f"{len(inspected.campaign.flights)} flights, none of kind image",
            where=inspected.campaign.root / FLIGHTS,
            expected="at least one flight of kind image",
            remedy="Add one, or correct its kind.",
        )
