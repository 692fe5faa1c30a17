"""Recording of one node in a flight: samples by channel, antennas by pulse, by the clocks of recorder and log."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.paths import inside
from apertura.core.echo.association import Association, associate
from apertura.core.echo.captures import Read, Samples
from apertura.core.echo.demodulate import Numerology
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.range_profiles import wave_speed_of
from apertura.formats.recordings.sample_file import SampleFile, SampleLayout
from apertura.formats.times import FIRST
from apertura.methods.autofocus.motion import Logged, Recorded
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import CONFIG, FLIGHTS, SampledWaveform
from apertura.pipeline.digests import digest_of
from apertura.pipeline.opening.air import scene_air
from apertura.pipeline.opening.node_log import NodeLog, raw_log, shortest_wave
from apertura.pipeline.opening.reading import read_history
from apertura.pipeline.opening.transmitted import Transmitted, check_mixing
from apertura.pipeline.store import manifest_of, open_stage

# ---- What a recording must be ---------------------------------------------------------------------------------------

_SAME = 1e-9
"""Carriers and rates that differ by less, relative to what the config states, are the same."""


def check_rates(waveform: SampledWaveform, recorded: Mapping[str, float], *, where: Path | str) -> None:
    """Raise CampaignError unless what was `recorded`, sample_rate_hz and carrier_hz, is that of the waveform."""
    for key, value in recorded.items():
        stated = float(getattr(waveform, key))
        if not abs(value - stated) <= _SAME * stated:
            raise CampaignError(
                f"recorded with {key} {value:.6f}",
                where=where,
                expected=f"{stated:.6f}, as {CONFIG}: waveform.{key}",
                remedy="Correct whichever is wrong; every node of a flight shares one waveform.",
            )


def check_channels(recorded: Sequence[str], needed: Sequence[str], *, where: Path | str) -> None:
    """Raise CampaignError unless channels were recorded under the names `needed`."""
    for channel in needed:
        if channel not in recorded:
            raise CampaignError(
                f"apertura:channels {[*recorded]}",
                where=where,
                expected=f"a channel named {channel!r}",
                remedy="A secondary node needs its sidelink; name the channel or take the node out of the flight.",
            )


def check_length(samples: int, needed: int, *, where: Path | str) -> None:
    """Raise CampaignError unless captures hold as many samples as an echo takes."""
    if samples < needed:
        raise CampaignError(
            f"captures of {samples} samples",
            where=where,
            expected=f"at least {needed}: cyclic prefix and one period of 1/subcarrier_spacing_hz, or lead_s, "
            "pulse_s and listen_s",
            remedy=f"Correct the waveform in {CONFIG}, or record longer captures.",
        )


# ---- Recording of one node: samples by channel, antennas by pulse ---------------------------------------------------


@dataclass(frozen=True)
class Captured:
    """What one node recorded in one flight.

    Attributes
    ----------
    raw
        Its stage, or what it would hold.
    samples
        The recorder's file.
    files
        raw/<flight>/<node>, with which its files' names begin.
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
        """Return a function that reads channels of some captures from the recorder's file, block by block.

        Parameters
        ----------
        channels
            Names.
        pulses
            (capture,) int64, captures of the recording; the function takes indices into this.

        Raises
        ------
        CampaignError
            If a channel was not recorded, or captures are shorter than prefix and DFT window.
        """
        recorded, length = list(self.raw.attrs["channels"]), int(self.raw.attrs["capture_samples"])
        check_channels(recorded, channels, where=self.recording)
        check_length(length, self.numerology.prefix_samples + self.numerology.dft_samples, where=self.recording)
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

    @classmethod
    def of(cls, raw: xr.Dataset, samples: Path, files: Path, recording: str, sent: Transmitted) -> "Captured":
        """Return captures of a file of samples; raise CampaignError unless carrier and rate are those of what was sent.

        Parameters
        ----------
        raw
            Stage `raw`, or what it would hold.
        samples
            The recorder's file.
        files, recording
            As the attributes.
        sent
            What was transmitted.
        """
        recorded = {"sample_rate_hz": raw.attrs["sample_rate_hz"], "carrier_hz": raw.attrs["frequency_hz"]}
        check_rates(sent.waveform, recorded, where=recording)
        opened = SampleFile(samples, len(raw.attrs["channels"]), SampleLayout.of(raw))
        check_mixing(opened, sent.numerology, where=recording)
        return cls(raw, opened, files, recording, sent.numerology)


@dataclass(frozen=True)
class Acquisition(Captured, NodeLog):
    """What one node recorded in one flight, beside its log."""


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
    path = inside(campaign.root, raw.attrs["samples"], where=campaign.stage("raw", flight, node))
    captured = Captured.of(raw, path, files, recording, sent)
    _check_same(campaign, raw)
    wave_m = shortest_wave(sent.numerology.frequency_hz)
    own = {field.name: getattr(captured, field.name) for field in fields(captured)}
    return Acquisition(node, campaign.node(flight, node), track, log, wave_m, **own)


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
    """Return the node's own files that a stage was read from, without the preamble."""
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


# ---- Echoes by the recorder's clock and antennas by the log's -------------------------------------------------------

MOST_PULSES = 8192
"""Of a recording, evenly spread: bounds memory; their changes show when the node moved."""

_SECOND = np.timedelta64(1, "s")


@dataclass(frozen=True, eq=False)
class Unaligned:
    """Echoes and log of a node before alignment.

    Attributes
    ----------
    echo, log
        As `apertura.methods.synchronisation` takes them: each by seconds of its own, from its first pulse and epoch.
    apart_ns
        Delay of the log's first epoch against the recorder's first pulse, nanoseconds.
    applied_ns
        Offset of config/clocks.tsv that the recorder's times already contain, nanoseconds.
    stated_ns
        That offset, 0 without.
    applied_ppm
        Drift stated there that they already contain.
    taken_off_m
        Path beyond geometry that was already removed from the echoes.
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
        """Return the offset for clocks.tsv, given one between the first pulse and the first epoch."""
        return self.applied_ns + self.apart_ns + round(offset_s * 1e9)

    @property
    def stated_s(self) -> float:
        """Offset at which `offset_ns` returns the stated one, seconds."""
        return (self.stated_ns - self.applied_ns - self.apart_ns) * 1e-9


def unaligned(campaign: Campaign, flight: str, node: str) -> Unaligned:
    """Return echoes and log of a node that sends and receives.

    Raises
    ------
    CampaignError
        If the node does not send and receive in that flight, has no log, or its echoes are not there yet.
    """
    flown = campaign.flight(flight)
    if f"{node}-{node}" not in flown.pairs:
        raise CampaignError(
            f"{node} does not send and receive in {flight}",
            where=campaign.root / FLIGHTS,
            expected=f"a node whose own pulses come back to it; pairs of {flight}: {', '.join(flown.pairs)}",
            remedy="Name such a node, or correct the line of the flight.",
        )
    clock = campaign.clock(flight, node)
    applied_ns, applied_ppm = 0, 0.0
    sampled = isinstance(campaign.settings.waveform, SampledWaveform)
    if sampled:
        path = campaign.stage("echo", flight, f"{node}-{node}")
        if not manifest_of(path).is_file():
            raise CampaignError(
                "not there yet",
                where=path,
                expected=f"the echo of {node} by its own pulses",
                remedy="Run `apertura run CAMPAIGN --until echo` first.",
            )
        history = _some(open_stage(path, "echo"))
        off_m, applied_ns = float(history.attrs["stated_offset_m"]), clock.offset_ns
        applied_ppm = clock.drift_ppm
    else:
        history = _some(read_history(campaign, flight, node, pair=f"{node}-{node}"))
        off_m = 0.0
    times = history.time.values
    log = raw_log(campaign, flight, node, shortest_wave(history.frequency.values))
    speed = wave_speed_of(history) if sampled else _wave_speed(campaign, log)
    echo = Recorded(
        np.asarray(history.transfer.values),
        history.frequency.values,
        history.reference_delay.values,
        _seconds(times, times[0]),
        speed,
    )
    apart_ns = int((log.track.time.values[0] - times[0]).astype("timedelta64[ns]").astype(np.int64))
    own_clock = bool(times[0] < FIRST)
    return Unaligned(echo, _logged(log), apart_ns, applied_ns, clock.offset_ns, applied_ppm, off_m, own_clock)


def _some(history: xr.Dataset) -> xr.Dataset:
    """Return at most `MOST_PULSES` pulses, evenly spread."""
    return history.isel(pulse=slice(None, None, -(-history.sizes["pulse"] // MOST_PULSES)))


def _wave_speed(campaign: Campaign, log: NodeLog) -> float:
    """Return the speed of the wave over a whole log: which part of it was recorded is not known before alignment."""
    times = log.track.time.values[log.checked.kept]
    times = times[:: -(-len(times) // MOST_PULSES)][1:-1]
    aperture = Aperture(log.antenna("radar_tx", times), log.antenna("radar_rx", times))
    return scene_air(campaign, aperture.tx_m).over(aperture).wave_speed_m_s


def _logged(log: NodeLog) -> Logged:
    times = log.track.time.values[log.checked.kept]
    began = log.track.time.values[0]

    def phase_centres(at_s: NDArray[np.float64]) -> Aperture:
        at = began + np.round(at_s * 1e9).astype("timedelta64[ns]")
        return Aperture(log.antenna("radar_tx", at), log.antenna("radar_rx", at))

    first_s, last_s = _seconds(times[[0, -1]], began)
    return Logged(phase_centres, first_s + 1e-9, last_s - 1e-9)


def _seconds(times: NDArray[np.datetime64], began: np.datetime64) -> NDArray[np.float64]:
    return np.asarray((times - began) / _SECOND, np.float64)
