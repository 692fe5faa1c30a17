"""Whether the sampled antenna patterns can be read."""

from collections.abc import Iterator

from apertura.common.errors import CampaignError
from apertura.pipeline.check.inspected import Inspected


def check_patterns(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield patterns that are none."""
    campaign = inspected.campaign
    pairs = (pair for flight in campaign.image_flights for pair in flight.pairs)
    paths = {path for pair in pairs for path in campaign.pattern_files(pair).values()}
    for path in sorted(paths):
        if not path.is_file() or path.stat().st_size == 0:
            continue
        from apertura.formats.beam_pattern import read_beam_pattern

        try:
            read_beam_pattern(path)
        except CampaignError as problem:
            yield problem
