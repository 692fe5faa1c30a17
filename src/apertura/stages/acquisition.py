"""Recording of one node in a flight: samples per channel and antenna positions per pulse, on a common time scale."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import CONFIG, SampledWaveform
from apertura.campaign.digests import digest_of
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.errors import CampaignError
from apertura.common.units import nanoseconds
from apertura.core.echo.association import Association, associate
from apertura.core.echo.captures import Read, Samples, ordered
from apertura.core.echo.demodulate import Numerology
from apertura.core.echo.frame_codes import FrameNumbers, frame_numbers
from apertura.formats.recordings.sample_file import SampleFile, SampleLayout
from apertura.stages.node_log import NodeLog, shortest_wave
from apertura.stages.transmitted import Transmitted, check_mixing

# ---- Checks of a recording against the waveform ----------------------------------------------------------------------

_RATE_TOLERANCE = 1e-9
"""Largest relative difference between recorded and configured carriers or sample rates."""


def check_rates(waveform: SampledWaveform, recorded: Mapping[str, float], *, where: Path | str) -> None:
    """Check the recorded sample_rate_hz and carrier_hz against the waveform; raise CampaignError if they differ.

    A recorded value of 0 means "not stated"; the configured value is then used.
    """
    for key, value in recorded.items():
        stated = float(getattr(waveform, key))
        if value and not abs(value - stated) <= _RATE_TOLERANCE * stated:
            raise CampaignError(
                f"recorded with {key} {value:.6f}",
                where=where,
                expected=f"{stated:.6f}, as configured in {CONFIG}: waveform.{key}",
                remedy="Correct the wrong value; all nodes of a flight share one waveform.",
            )


def check_channels(recorded: Sequence[str], needed: Sequence[str], *, where: Path | str) -> None:
    """Check that the channels named in `needed` were recorded; raise CampaignError if a channel is missing."""
    for channel in needed:
        if channel not in recorded:
            raise CampaignError(
                f"apertura:channels {[*recorded]}",
                where=where,
                expected=f"a channel named {channel!r}",
                remedy="Correct apertura:channels (a secondary node requires its sidelink), or remove the node from "
                "the flight.",
            )


def check_length(samples: int, needed: int, *, where: Path | str) -> None:
    """Check that captures contain as many samples as an echo requires; raise CampaignError if captures are shorter."""
    if samples < needed:
        raise CampaignError(
            f"captures of {samples} samples",
            where=where,
            expected=f"at least {needed}: cyclic prefix and one period of 1/subcarrier_spacing_hz, or the sum of "
            "lead_s, pulse_s and listen_s",
            remedy=f"Correct the waveform in {CONFIG}, or record longer captures.",
        )


# ---- Recording of one node: samples per channel, antenna positions per pulse -----------------------------------------


@dataclass(frozen=True)
class Captured:
    """Recording and header of one node in one flight.

    Attributes
    ----------
    raw
        Stage `raw` of the node, or a dataset of the same content.
    samples
        Sample file of the recorder.
    files
        raw/<flight>/<node>, the prefix of the node's file names.
    recording
        Names of the sample files, for messages.
    numerology
        Numerology of the symbol.
    order
        Order of I and Q: complex, swapped or conjugate.
    frames
        Frame number of each capture; that of a receiver applies to its own clock only.
    """

    raw: xr.Dataset
    samples: SampleFile
    files: Path
    recording: str
    numerology: Numerology
    order: str
    frames: FrameNumbers

    @property
    def conjugated(self) -> "Captured":
        """The recording, of which the complex conjugates of the samples are read."""
        return replace(self, order="conjugate" if self.order == "complex" else "complex")

    def reader(self, channels: Sequence[str], pulses: NDArray[np.int64]) -> Read:
        """Return a function that reads channels of selected captures from the recorder's file, block by block.

        Parameters
        ----------
        channels
            Channel names.
        pulses
            (capture,) int64, capture indices in the recording; the function takes indices into this array.

        Raises
        ------
        CampaignError
            If a channel was not recorded, or captures are shorter than prefix and DFT window.
        """
        recorded, length = list(self.raw.attrs["channels"]), int(self.raw.attrs["capture_samples"])
        check_channels(recorded, channels, where=self.recording)
        check_length(length, self.numerology.prefix_samples + self.numerology.dft_samples, where=self.recording)
        start, columns = self.raw.start.values[pulses], {name: recorded.index(name) for name in channels}

        def read(captures: NDArray[np.int64]) -> dict[str, Samples]:
            if not self.samples.path.is_file():
                raise CampaignError(
                    "no such file",
                    where=self.samples.path,
                    expected="the recording, because the transfer functions computed from it are not stored",
                    remedy="Copy the recording there. To store the transfer functions in later runs, set "
                    f"`processing: {{keep: [echo]}}` in {CONFIG}.",
                )
            iq = self.samples.captures(start[captures], length)
            iq = np.ascontiguousarray(ordered(iq, self.order))
            # Copy each I and Q pair as one element: separate copies cost more than the Fourier transform.
            both = np.dtype(f"i{2 * iq.itemsize}")
            pairs = iq.view(both)[..., 0]
            return {
                name: np.ascontiguousarray(pairs[:, :, column])[..., None].view(iq.dtype)
                for name, column in columns.items()
            }

        return read

    @classmethod
    def of(
        cls, raw: xr.Dataset, samples: Path, files: Path, recording: str, sent: Transmitted, *, order: str
    ) -> "Captured":
        """Return the captures of a sample file; raise CampaignError if carrier or rate differ from the waveform.

        Parameters
        ----------
        raw
            Stage `raw`, or a dataset of the same content.
        samples
            Sample file of the recorder.
        files, recording, order
            As in the attributes.
        sent
            Transmitted waveform.
        """
        recorded = {"sample_rate_hz": raw.attrs["sample_rate_hz"], "carrier_hz": raw.attrs["frequency_hz"]}
        check_rates(sent.waveform, recorded, where=recording)
        opened = SampleFile(samples, len(raw.attrs["channels"]), SampleLayout.of(raw))
        check_mixing(opened, sent.numerology, where=recording)
        interval_s = 1 / sent.waveform.prf_hz
        frames = frame_numbers(nanoseconds(raw.time.values), raw.frame.values, interval_s=interval_s)
        return cls(raw, opened, files, recording, sent.numerology, order, frames)


@dataclass(frozen=True)
class Acquisition(Captured, NodeLog):
    """Recording of one node in one flight, with its log."""


def open_acquisition(campaign: Campaign, flight: str, node: str, sent: Transmitted) -> Acquisition:
    """Open the finished raw and track stages of a node.

    Raises
    ------
    CampaignError
        If the recorded carrier or sample rate differs from that of the transmitted waveform.
    """
    raw, track = (open_stage(campaign.stage(stage, flight, node), stage) for stage in ("raw", "track"))
    raw = raw.assign(time=("pulse", campaign.clock(flight, node).utc(raw.time.values)))
    files = Path("raw") / flight / node
    recording, log = (_own_sources(stage, files) for stage in (raw, track))
    path = campaign.root.named(raw.attrs["samples"], where=campaign.stage("raw", flight, node))
    captured = Captured.of(raw, path, files, recording, sent, order=campaign.settings.iq_of(node))
    name = raw.attrs["samples"]
    if (campaign.root / name).is_file() and digest_of(campaign.root, name) != raw.attrs["inputs"][name]:
        raise CampaignError(
            "the file has changed since it was ingested",
            where=campaign.root / name,
            expected="the file from which the raw stage was written",
            remedy="Run the workflow again, so that the recording is ingested again.",
        )
    wave_m = shortest_wave(sent.numerology.frequency_hz)
    own = {field.name: getattr(captured, field.name) for field in fields(captured)}
    return Acquisition(node, campaign.node(flight, node), track, log, wave_m, **own)


def _own_sources(stage: xr.Dataset, files: Path) -> str:
    """Return the names of a stage's source files that belong to the node, without the preamble, for messages."""
    own = [name for name in stage.attrs["inputs"] if name.startswith(f"{files.as_posix()}.")]
    return " and ".join(own or stage.attrs["inputs"])  # files of a SigMF collection may have other names


def common_pulses(tx: Captured, rx: Captured, *, prf_hz: float, speed_m_s: float | None = None) -> Association:
    """Associate the pulses of a transmitter, which moves at `speed_m_s`, with the captures of a receiver."""
    tx_time, rx_time = (nanoseconds(node.raw.time.values) for node in (tx, rx))
    return associate(
        tx_time,
        rx_time,
        repetition_interval_s=1 / prf_hz,
        tx_frame=tx.raw.frame.values,
        rx_frame=rx.raw.frame.values,
        speed_m_s=speed_m_s,
        where=f"{tx.files} and {rx.files}",
    )
