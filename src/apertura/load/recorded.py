"""The echo of a recorder that hands over transfer functions, as it lies in raw/."""

import xarray as xr

from apertura.campaign import Campaign
from apertura.ingest import read_phase_history
from apertura.load.positions import stated_error


def recorded_echo(campaign: Campaign, flight: str, pair: str, kind: str) -> xr.Dataset:
    """Return the echo of a pair; `kind` is a key of `PHASE_HISTORIES`.

    Its positions travel with its samples; how well they are known only the config can say.
    """
    tx, rx = pair.split("-")
    nodes, files = campaign.settings.nodes, list(campaign.raw_files(flight, rx).values())
    known = {leg: stated_error(nodes[node]) | {"node": node} for leg, node in (("tx", tx), ("rx", rx))}
    return read_phase_history(kind, files, pair=pair).assign_attrs(positions=known)
