"""The map of a finished campaign, ready to be served."""

from apertura.campaign import Campaign
from apertura.digests import digest_of
from apertura.errors import CampaignError
from apertura.export import COVERAGE, product_files
from apertura.webmap.page import DATA, FILES
from apertura.webmap.server import PAGE, MapServer


def served(campaign: Campaign, *, port: int = 0) -> MapServer:
    """Return a server of the campaign's products and of nothing else.

    Parameters
    ----------
    campaign
        With results.
    port
        To listen on; 0 for a free one.

    Raises
    ------
    CampaignError
        If there is no map, or the port is taken.
    """
    folder, root = campaign.results, campaign.root
    if not campaign.result(PAGE).is_file():
        raise CampaignError(
            "no such file", campaign.result(PAGE), "the map of a finished campaign", f"`apertura run {root}` makes it."
        )
    products = product_files({flight.name: flight.pairs for flight in campaign.image_flights})
    files = {*products, *COVERAGE, *(f"map/{name}" for name in (DATA, *FILES))}
    results = folder.relative_to(root).as_posix()
    return MapServer(folder, files, sha256_of=lambda name: digest_of(root, f"{results}/{name}"), port=port)
