"""The map of a finished campaign, ready to be served."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache

from apertura.common.documents import undamaged
from apertura.formats.export import MAP, product_files
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.digests import digest_of
from apertura.pipeline.store import manifest_of, open_listed, read_manifest
from apertura.views.webmap.document import named_files
from apertura.views.webmap.page import page_files
from apertura.views.webmap.server import MapServer


def served(campaign: Campaign, *, port: int = 0) -> MapServer:
    """Return a server of the campaign's map, of the products that it names and of nothing else.

    Parameters
    ----------
    campaign
        With results.
    port
        To listen on; 0 for a free one.

    Raises
    ------
    CampaignError
        If there is no map, it is not as it was written, or the port is taken.
    """
    files = _listing(campaign)
    files()
    results = campaign.relative(campaign.results)

    def sha256_of(name: str) -> str:
        return digest_of(campaign.root, f"{results}/{name}")

    return MapServer(campaign.results, files, page=page_files(), sha256_of=sha256_of, port=port)


def _listing(campaign: Campaign) -> Callable[[], Mapping[str, str]]:
    """Return what gives file of the results → sha256: `map.json` by its manifest, and what that names.

    Both are read again when the manifest is another: the workflow ran meanwhile.
    """
    products = frozenset(product_files({flight.name: flight.pairs for flight in campaign.image_flights}))

    @lru_cache(maxsize=1)
    def listed(*_: int) -> Mapping[str, str]:
        path = campaign.result(MAP)
        manifest = manifest_of(path)
        document = open_listed(path, manifest)
        with undamaged(path, expected="the map of a finished campaign", remedy="Run the workflow again."):
            named = {name: sha256 for name, sha256 in named_files(document).items() if name in products}
        return {**named, MAP: read_manifest(manifest)["files"][path.name]}

    def listed_now() -> Mapping[str, str]:
        with suppress(OSError):
            state = manifest_of(campaign.result(MAP)).stat()
            return listed(state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
        return listed()

    return listed_now
