"""A node's echoes by the clock of its recorder, and where it was by the clock of its log."""

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.geometry.aperture import Aperture
from apertura.formats.times import FIRST
from apertura.methods.autofocus.motion import Logged, Recorded
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import SampledWaveform
from apertura.pipeline.opening.node_log import NodeLog, raw_log, shortest_wave
from apertura.pipeline.opening.reading import read_history
from apertura.pipeline.store import manifest_of, open_stage

MOST_PULSES = 8192
"""That are read of a recording: their changes tell when the node moved."""

_SECOND = np.timedelta64(1, "s")


@dataclass(frozen=True, eq=False)
class Unaligned:
    """What is to be aligned.

    Attributes
    ----------
    echo, log
        As `apertura.methods.synchronisation` takes them: each by seconds of its own, from its first pulse and epoch.
    apart_ns
        By how much the log's first epoch is later than the recorder's first pulse.
    applied_ns
        What of an offset in config/clocks.tsv is in the recorder's times already.
    stated_ns
        That offset, 0 without.
    applied_ppm
        What of a drift stated there is in them already.
    taken_off_m
        Path beyond geometry that is taken off the echoes already.
    own_clock
        Whether the recorder's times mean nothing but differences.
    """

    echo: Recorded
    log: Logged
    apart_ns: int
    applied_ns: int
    stated_ns: int
    applied_ppm: float
    taken_off_m: float
    own_clock: bool

    def less_path(self, path_m: float) -> "Unaligned":
        """Return the same without so much path beyond geometry in the echoes."""
        delay_s = self.echo.reference_delay_s - (path_m - self.taken_off_m) / SPEED_OF_LIGHT_M_S
        return replace(self, echo=replace(self.echo, reference_delay_s=delay_s), taken_off_m=path_m)

    def offset_ns(self, offset_s: float) -> int:
        """Return what clocks.tsv is to state, for an offset between the first pulse and the first epoch."""
        return self.applied_ns + self.apart_ns + round(offset_s * 1e9)

    @property
    def stated_s(self) -> float:
        """What `offset_ns` makes of it is what is stated already."""
        return (self.stated_ns - self.applied_ns - self.apart_ns) * 1e-9


def unaligned(campaign: Campaign, flight: str, node: str) -> Unaligned:
    """Return what a node that sends and receives recorded in a flight, and its log.

    Raises
    ------
    CampaignError
        If the node has no log, or its echoes are not there yet.
    """
    clock = campaign.clock(flight, node)
    applied_ns, applied_ppm = 0, 0.0
    if isinstance(campaign.settings.waveform, SampledWaveform):
        path = campaign.stage("echo", flight, f"{node}-{node}")
        if not manifest_of(path).is_file():
            raise CampaignError(
                "not there yet",
                where=path,
                expected=f"the echo of {node} by its own pulses",
                remedy=f"Run `snakemake results/{flight}/{node}-{node}/echo.manifest.json` first.",
            )
        history = _some(open_stage(path, "echo"))
        off_m, applied_ns = float(history.attrs["stated_offset_m"]), clock.offset_ns
        applied_ppm = clock.drift_ppm
    else:
        history = _some(read_history(campaign, flight, node, pair=f"{node}-{node}"))
        off_m = 0.0
    times = history.time.values
    log = raw_log(campaign, flight, node, shortest_wave(history.frequency.values))
    echo = Recorded(
        np.asarray(history.transfer.values),
        history.frequency.values,
        history.reference_delay.values,
        _seconds(times, times[0]),
    )
    apart_ns = int((log.track.time.values[0] - times[0]).astype("timedelta64[ns]").astype(np.int64))
    own_clock = bool(times[0] < FIRST)
    return Unaligned(echo, _logged(log), apart_ns, applied_ns, clock.offset_ns, applied_ppm, off_m, own_clock)


def _some(history: xr.Dataset) -> xr.Dataset:
    """Return so many of the pulses, evenly spread, that memory is bounded."""
    return history.isel(pulse=slice(None, None, -(-history.sizes["pulse"] // MOST_PULSES)))


def _logged(log: NodeLog) -> Logged:
    times = log.track.time.values[log.checked.kept]
    began = log.track.time.values[0]

    def placed(at_s: NDArray[np.float64]) -> Aperture:
        at = began + np.round(at_s * 1e9).astype("timedelta64[ns]")
        return Aperture(log.antenna("radar_tx", at), log.antenna("radar_rx", at))

    first_s, last_s = _seconds(times[[0, -1]], began)
    return Logged(placed, first_s + 1e-9, last_s - 1e-9)


def _seconds(times: NDArray[np.datetime64], began: np.datetime64) -> NDArray[np.float64]:
    return np.asarray((times - began) / _SECOND, np.float64)
