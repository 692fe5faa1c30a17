"""What one node recorded in one flight: its samples by channel and its antennas by pulse."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.echo.demodulate import demodulate, subcarrier_numbers
from apertura.echo.resampling import Waveform
from apertura.errors import CampaignError
from apertura.geometry.phase_centres import attitude_axes, phase_centres
from apertura.settings import Node, OfdmWaveform
from apertura.store import open_stage


@dataclass(frozen=True)
class Recording:
    """What one node recorded in one flight."""

    name: str
    raw: xr.Dataset
    track: xr.Dataset
    settings: Node
    files: Path
    waveform: Waveform

    def captures(self, channel: str, pulses: NDArray[np.int64]) -> NDArray[np.int16]:
        """Return the samples of a channel at some pulses, (pulse, sample, 2) int16."""
        channels = self.raw.attrs["channels"]
        if channel not in channels:
            raise CampaignError(
                f"channels {channels}",
                where=f"{self.files}.sigmf-meta: apertura:channels",
                expected=f"a channel named {channel!r}",
                remedy="A secondary node needs its sidelink; name the channel or take the node out of the flight.",
            )
        iq = self.raw.iq.isel(channel=channels.index(channel)).values[pulses]
        needed = self.waveform.prefix_samples + self.waveform.dft_samples
        if iq.shape[1] < needed:
            raise CampaignError(
                f"captures of {iq.shape[1]} samples",
                where=f"{self.files}.sigmf-meta",
                expected=f"at least {needed}: cyclic prefix and one period of 1/subcarrier_spacing_hz",
                remedy="Correct the waveform in config/config.yaml or record longer captures.",
            )
        return np.asarray(iq)

    def symbols(self, captures: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return the code symbols of captures, (pulse, subcarrier) complex64."""
        wave = self.waveform
        return demodulate(
            captures, numbers=wave.numbers, prefix_samples=wave.prefix_samples, dft_samples=wave.dft_samples
        )

    def antenna(
        self, name: Literal["radar_tx", "radar_rx", "sidelink"], pulses: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the ECEF position of an antenna at the node's own time tags, (pulse, 3) float64 metres."""
        return phase_centres(
            self.track.time.values,
            self.track.position.values,
            self.track.attitude.values,
            at=self.raw.time.values[pulses],
            lever_arm_m=getattr(self.settings.lever_arms_m, name),
            attitude_from=self.settings.attitude,
            where=f"{self.files}.track",
        )

    def body_axes(self, pulses: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return forward, right, down of the body in ECEF at the node's own time tags, (pulse, axis, body) float64."""
        return attitude_axes(
            self.track.time.values,
            self.track.position.values,
            self.track.attitude.values,
            at=self.raw.time.values[pulses],
            attitude_from=self.settings.attitude,
            where=f"{self.files}.track",
        )


def open_recording(campaign: Campaign, flight: str, node: str, waveform: OfdmWaveform) -> Recording:
    """Return the finished raw and track stages of a node, refusing a recording of another waveform."""
    raw, track = (open_stage(campaign.stage(stage, flight, node), stage) for stage in ("raw", "track"))
    files = Path("raw") / flight / node
    for key, found in (("sample_rate_hz", raw.attrs["sample_rate_hz"]), ("carrier_hz", raw.attrs["frequency_hz"])):
        asked = getattr(waveform, key)
        if abs(found - asked) > 1e-9 * asked:
            raise CampaignError(
                f"recorded with {key} {found:.6f}",
                where=f"{files}.sigmf-meta",
                expected=f"{asked:.6f}, as config/config.yaml: waveform.{key}",
                remedy="Correct whichever is wrong; every node of a flight shares one waveform.",
            )
    sampled = Waveform(
        waveform.carrier_hz,
        waveform.sample_rate_hz,
        subcarrier_numbers(waveform.subcarriers, carrier_is=waveform.carrier_is),
        prefix_samples=round(waveform.cyclic_prefix_s * waveform.sample_rate_hz),
        dft_samples=round(waveform.sample_rate_hz / waveform.subcarrier_spacing_hz),
    )
    return Recording(node, raw, track, campaign.settings.nodes[node], files, sampled)
