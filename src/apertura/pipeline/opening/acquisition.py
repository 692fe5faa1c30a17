"""What one node recorded in one flight: its samples by channel and its antennas by pulse."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.common.paths import inside
from apertura.core.echo.association import Association, associate
from apertura.core.echo.captures import Read, Samples
from apertura.core.echo.demodulate import Numerology
from apertura.formats.recordings.sample_file import SampleFile
from apertura.formats.recordings.sample_layout import SampleLayout
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.digests import digest_of
from apertura.pipeline.opening.mixing import check_mixing
from apertura.pipeline.opening.node_log import NodeLog, shortest_wave
from apertura.pipeline.opening.transmitted import Transmitted
from apertura.pipeline.store import open_stage


@dataclass(frozen=True)
class Acquisition(NodeLog):
    """What one node recorded in one flight, beside its log.

    Attributes
    ----------
    raw
        Its stage.
    samples
        The recorder's file.
    files
        raw/<flight>/<node>, what its files' names begin with.
    recording
        Its files of samples, for messages.
    numerology
        Of the symbol.
    """

    raw: xr.Dataset
    samples: SampleFile
    files: Path
    recording: str
    numerology: Numerology

    def reader(self, channels: Sequence[str], pulses: NDArray[np.int64]) -> Read:
        """Return what reads channels of some captures from the recorder's file, a block of them at a time.

        Parameters
        ----------
        channels
            Names.
        pulses
            (capture,) int64, which captures of the recording; they are then asked for by their place here.

        Raises
        ------
        CampaignError
            If a channel was not recorded, or captures are shorter than prefix and DFT window.
        """
        recorded, length = list(self.raw.attrs["channels"]), int(self.raw.attrs["capture_samples"])
        for channel in channels:
            if channel not in recorded:
                raise CampaignError(
                    f"channels {recorded}",
                    where=self.recording,
                    expected=f"a channel named {channel!r}",
                    remedy="A secondary node needs its sidelink; name the channel or take the node out of the flight.",
                )
        needed = self.numerology.prefix_samples + self.numerology.dft_samples
        if length < needed:
            raise CampaignError(
                f"captures of {length} samples",
                where=self.recording,
                expected=f"at least {needed}: cyclic prefix and one period of 1/subcarrier_spacing_hz, or lead_s, "
                "pulse_s and listen_s",
                remedy="Correct the waveform in config/config.yaml or record longer captures.",
            )
        start, places = self.raw.start.values[pulses], {name: recorded.index(name) for name in channels}

        def read(captures: NDArray[np.int64]) -> dict[str, Samples]:
            iq = self.samples.captures(start[captures], length)
            # I and Q move together: one by one they cost more than their transform
            both = np.dtype(f"i{2 * iq.itemsize}")
            pairs = iq.view(both)[..., 0]
            return {
                name: np.ascontiguousarray(pairs[:, :, place])[..., None].view(iq.dtype)
                for name, place in places.items()
            }

        return read


def open_acquisition(campaign: Campaign, flight: str, node: str, sent: Transmitted) -> Acquisition:
    """Return the finished raw and track stages of a node.

    Raises
    ------
    CampaignError
        If it was recorded at another carrier or sample rate than what was sent.
    """
    raw, track = (open_stage(campaign.stage(stage, flight, node), stage) for stage in ("raw", "track"))
    raw = raw.assign(time=("pulse", campaign.clock(flight, node).utc(raw.time.values)))
    files = Path("raw") / flight / node
    recording, log = (_read_from(stage, files) for stage in (raw, track))
    for key, recorded in (("sample_rate_hz", raw.attrs["sample_rate_hz"]), ("carrier_hz", raw.attrs["frequency_hz"])):
        asked = getattr(sent.waveform, key)
        if abs(recorded - asked) > 1e-9 * asked:
            raise CampaignError(
                f"recorded with {key} {recorded:.6f}",
                where=recording,
                expected=f"{asked:.6f}, as config/config.yaml: waveform.{key}",
                remedy="Correct whichever is wrong; every node of a flight shares one waveform.",
            )
    path = inside(campaign.root, raw.attrs["samples"], where=campaign.stage("raw", flight, node))
    samples = SampleFile(path, len(raw.attrs["channels"]), SampleLayout.of(raw))
    _check_same(campaign, raw)
    settings, numerology = campaign.node(flight, node), sent.numerology
    check_mixing(samples, numerology, where=recording)
    wave_m = shortest_wave(numerology.frequency_hz)
    return Acquisition(node, settings, track, log, wave_m, raw, samples, files, recording, numerology)


def _check_same(campaign: Campaign, raw: xr.Dataset) -> None:
    """Raise CampaignError unless the recorder's file is the one that the stage describes."""
    name = raw.attrs["samples"]
    if digest_of(campaign.root, name) != raw.attrs["inputs"][name]:
        raise CampaignError(
            "changed since it was ingested",
            where=campaign.root / name,
            expected="the file that the raw stage describes",
            remedy="Run the workflow again: it ingests the recording first.",
        )


def _read_from(stage: xr.Dataset, files: Path) -> str:
    """Return the node's own files that a stage was read from; a preamble lies elsewhere."""
    own = [name for name in stage.attrs["inputs"] if name.startswith(f"{files.as_posix()}.")]
    return " and ".join(own or stage.attrs["inputs"])  # a collection may give other names


def common_pulses(tx: Acquisition, rx: Acquisition, *, prf_hz: float) -> Association:
    """Return the pulses that a transmitter and a receiver have in common."""
    tx_time, rx_time = (node.raw.time.values.astype("datetime64[ns]").astype(np.int64) for node in (tx, rx))
    return associate(
        tx_time,
        rx_time,
        repetition_interval_s=1 / prf_hz,
        tx_frame=tx.raw.frame.values,
        rx_frame=rx.raw.frame.values,
        speed_m_s=tx.speed_m_s,
        where=f"{tx.files} and {rx.files}",
    )
