"""Which pulses of a flight image a pair: those inside its lines of segments.tsv."""

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import SEGMENTS


def inside_segments(campaign: Campaign, flight: str, pair: str, times: NDArray[np.datetime64]) -> NDArray[np.bool_]:
    """Return (pulse,) bool: which pulses, by the transmitter's time tags (pulse,), image a pair.

    Raises
    ------
    CampaignError
        If none does.
    """
    segments = campaign.segments_of(flight, pair)
    inside = np.full(len(times), not segments)
    for start, end in segments:
        inside |= (times >= np.datetime64(start)) & (times <= np.datetime64(end))
    if len(times) and not inside.any():
        raise CampaignError(
            f"no pulse of flight {flight}, pair {pair} inside {' or '.join('…'.join(line) for line in segments)}",
            where=campaign.root / SEGMENTS,
            expected=f"times between {times.min()} and {times.max()}, UTC",
            remedy="Correct start and end, or take the lines out to image with the whole track.",
        )
    return inside


def keep_segments(campaign: Campaign, flight: str, pair: str, echo: xr.Dataset) -> xr.Dataset:
    """Return an echo without the pulses outside the segments of its pair, and with their number in `pulses`."""
    if not campaign.segments_of(flight, pair):
        return echo
    inside = inside_segments(campaign, flight, pair, echo.time.values)
    counts = {**echo.attrs.get("pulses", {}), "used": int(inside.sum()), "outside_segments": int((~inside).sum())}
    return echo.isel(pulse=inside).assign_attrs(pulses=counts)
