"""What one node recorded in one flight: its samples by channel and its antennas by pulse."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.echo.association import Association, associate
from apertura.echo.demodulate import Numerology, subcarrier_numbers
from apertura.errors import CampaignError
from apertura.geometry.phase_centres import attitude_axes, phase_centres
from apertura.settings import Node, OfdmWaveform
from apertura.store import open_stage


@dataclass(frozen=True)
class Acquisition:
    """What one node recorded in one flight.

    Attributes
    ----------
    name, settings
        Of the node.
    raw, track
        Its stages.
    files
        raw/<flight>/<node>, what its files' names begin with.
    recording, log
        Its files of samples, and its flight log, for messages.
    numerology
        Of the symbol.
    """

    name: str
    raw: xr.Dataset
    track: xr.Dataset
    settings: Node
    files: Path
    recording: str
    log: str
    numerology: Numerology

    def captures(self, channel: str, pulses: NDArray[np.int64]) -> NDArray[np.int16]:
        """Return the samples of a channel at some pulses, (pulse, sample, 2) int16.

        Raises
        ------
        CampaignError
            If the channel was not recorded, or captures are shorter than prefix and DFT window.
        """
        channels = self.raw.attrs["channels"]
        if channel not in channels:
            raise CampaignError(
                f"channels {channels}",
                where=self.recording,
                expected=f"a channel named {channel!r}",
                remedy="A secondary node needs its sidelink; name the channel or take the node out of the flight.",
            )
        iq = self.raw.iq.isel(channel=channels.index(channel)).values[pulses]
        needed = self.numerology.prefix_samples + self.numerology.dft_samples
        if iq.shape[1] < needed:
            raise CampaignError(
                f"captures of {iq.shape[1]} samples",
                where=self.recording,
                expected=f"at least {needed}: cyclic prefix and one period of 1/subcarrier_spacing_hz",
                remedy="Correct the waveform in config/config.yaml or record longer captures.",
            )
        return np.asarray(iq)

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
            where=self.log,
        )

    def body_axes(self, pulses: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return forward, right, down of the body in ECEF at the node's own time tags, (pulse, axis, body) float64."""
        return attitude_axes(
            self.track.time.values,
            self.track.position.values,
            self.track.attitude.values,
            at=self.raw.time.values[pulses],
            attitude_from=self.settings.attitude,
            where=self.log,
        )


def open_acquisition(campaign: Campaign, flight: str, node: str, waveform: OfdmWaveform) -> Acquisition:
    """Return the finished raw and track stages of a node.

    Raises
    ------
    CampaignError
        If it was recorded at another carrier or sample rate than `waveform`.
    """
    raw, track = (open_stage(campaign.stage(stage, flight, node), stage) for stage in ("raw", "track"))
    files = Path("raw") / flight / node
    recording, log = (_read_from(stage, files) for stage in (raw, track))
    for key, recorded in (("sample_rate_hz", raw.attrs["sample_rate_hz"]), ("carrier_hz", raw.attrs["frequency_hz"])):
        asked = getattr(waveform, key)
        if abs(recorded - asked) > 1e-9 * asked:
            raise CampaignError(
                f"recorded with {key} {recorded:.6f}",
                where=recording,
                expected=f"{asked:.6f}, as config/config.yaml: waveform.{key}",
                remedy="Correct whichever is wrong; every node of a flight shares one waveform.",
            )
    return Acquisition(node, raw, track, campaign.settings.nodes[node], files, recording, log, numerology_of(waveform))


def _read_from(stage: xr.Dataset, files: Path) -> str:
    """Return the node's own files that a stage was read from; a preamble lies elsewhere."""
    return " and ".join(name for name in stage.attrs["inputs"] if name.startswith(f"{files.as_posix()}."))


def numerology_of(waveform: OfdmWaveform) -> Numerology:
    """Return how receivers sample a waveform's symbol."""
    return Numerology(
        waveform.carrier_hz,
        waveform.sample_rate_hz,
        subcarrier_numbers(waveform.subcarriers, carrier_is=waveform.carrier_is),
        prefix_samples=round(waveform.cyclic_prefix_s * waveform.sample_rate_hz),
        dft_samples=round(waveform.sample_rate_hz / waveform.subcarrier_spacing_hz),
    )


def common_pulses(tx: Acquisition, rx: Acquisition, *, prf_hz: float) -> Association:
    """Return the pulses that a transmitter and a receiver have in common."""
    tx_time, rx_time = (node.raw.time.values.astype("datetime64[ns]").astype(np.int64) for node in (tx, rx))
    return associate(
        tx_time,
        rx_time,
        repetition_interval_s=1 / prf_hz,
        tx_frame=tx.raw.frame.values,
        rx_frame=rx.raw.frame.values,
        where=f"{tx.files} and {rx.files}",
    )
