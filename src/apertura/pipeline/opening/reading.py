"""Flight logs and phase histories of raw/, read by the settings of a campaign."""

from typing import TYPE_CHECKING

from apertura.formats.reading import read_phase_history, read_track
from apertura.pipeline.campaign import Campaign

if TYPE_CHECKING:
    import xarray as xr


def read_log(campaign: Campaign, flight: str, node: str) -> "xr.Dataset":
    """Return the `track` stage of a node's flight log."""
    options = campaign.settings.nodes[node].log.options
    return read_track(campaign.track_file(flight, node), node=node, options=options)


def read_history(campaign: Campaign, flight: str, node: str, *, pair: str) -> "xr.Dataset":
    """Return the phase history recorded by a node of a pair, by its format and the config."""
    described = campaign.settings.waveform.model_dump()
    files = campaign.history_files(flight, node)
    history = read_phase_history(described["format"], files, pair=pair, described=described)
    if described["kind"] == "phase_history" and described["iq"] == "conjugate":
        return history.assign(transfer=history.transfer.conj())
    return history
