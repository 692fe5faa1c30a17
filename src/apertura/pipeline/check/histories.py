"""Phase history: whether it can be read, and whether its pulses have places."""

from collections.abc import Iterator

from apertura.common.errors import CampaignError
from apertura.pipeline.check.inspected import Inspected


def check_histories(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield phase history that cannot be read, or whose pulses no flight log places by `config/clocks.tsv`."""
    if not inspected.other_frame:  # which 'crs' tells of
        yield from inspected.unread_histories
