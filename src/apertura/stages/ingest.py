"""Rule `ingest`: the recording and log of a node in a flight, as stages `raw` and `track`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from apertura.campaign.config import CONFIG, PulseWaveform, SampledWaveform
from apertura.campaign.digests import digest_of
from apertura.campaign.folder import Campaign
from apertura.campaign.store import save_stage
from apertura.common.errors import CampaignError
from apertura.core.echo.trigger import PulseFraming, trigger_captures
from apertura.formats.reading import open_recording
from apertura.formats.recordings.recording import Recording
from apertura.stages.node_log import read_log
from apertura.stages.tags import stamped
from apertura.stages.transmitted import read_framing
from apertura.workflow.lineage import result_of


def checked_recording(campaign: Campaign, flight: str, node: str) -> Recording:
    """Open a node's recording; raise CampaignError if its samples do not match the recorder's hash."""
    recording = open_recording(campaign.recording_files(flight, node))
    recording.check_hash(lambda path: digest_of(campaign.root, campaign.relative(path), algorithm="sha512"))
    return recording


def preamble_files(recording: Recording, campaign: Campaign) -> tuple[Path, ...]:
    """Return the preamble file named in the recorder's metadata, in the campaign; empty for triggered captures."""
    if recording.framing is None:
        return ()
    name = recording.framing["preamble"]
    return (campaign.root.named(name, where=f"{recording.files[0]}: apertura:framing.preamble"),)


def captures_of(recording: Recording, campaign: Campaign, *, node: str) -> xr.Dataset:
    """Return the `raw` stage of a recording.

    Raises
    ------
    CampaignError
        If a capture contains only zeros, the file ends before the last capture, or a continuous recording contains
        no preamble.
    """
    if recording.framing is None:
        dataset = recording.cut(recording.captures, node=node)
    else:
        dataset = _triggered(recording, campaign, node=node)
    dataset.attrs["samples"] = campaign.relative(recording.samples.path)
    return dataset


def framing_of(recording: Recording, campaign: Campaign) -> PulseFraming:
    """Return the preambles sent before the symbols of a continuous recording.

    Raises
    ------
    CampaignError
        If the preamble file is invalid, or waveform.lead_s is set.
    """
    waveform = campaign.settings.waveform
    if isinstance(waveform, PulseWaveform) and waveform.lead_s:
        raise CampaignError(
            f"waveform.lead_s is {waveform.lead_s:g}, and {recording.files[0].name} is a continuous recording",
            where=CONFIG,
            expected="0: captures of a continuous recording begin with the pulse",
            remedy="Set waveform.lead_s to 0.",
        )
    return read_framing(
        preamble_files(recording, campaign)[0],
        recording.framing or {},
        sample_rate_hz=recording.sample_rate_hz,
        where=recording.files[0],
    )


def _triggered(recording: Recording, campaign: Campaign, *, node: str) -> xr.Dataset:
    """Return the `raw` stage of a continuous recording, cut into captures at its preambles."""
    waveform, metadata = campaign.settings.waveform, recording.framing or {}
    if not isinstance(waveform, SampledWaveform):
        raise TypeError("a sample recording requires a sampled waveform")
    framing = framing_of(recording, campaign)
    rate = campaign.settings.processing.false_alarms_per_s
    channel = "sidelink" if "sidelink" in recording.channels else "radar"
    samples = recording.samples.channel(recording.channels.index(channel), campaign.settings.iq_of(node))
    length = waveform.capture_samples
    bits = 8 * recording.samples.sample_bytes // len(recording.channels)
    captures = trigger_captures(samples, framing, symbol_samples=length, false_alarms_per_s=rate, sample_bits=bits)
    if not captures.start.size:
        raise CampaignError(
            f"no preamble detected in {len(samples)} samples, at a threshold of {rate} false alarms per second",
            where=recording.files[-1],
            expected=f"the preamble of {metadata['preamble']} in channel {channel}",
            remedy="Check the preamble file and apertura:framing, or record with a higher SNR.",
        )
    dataset = recording.cut(recording.captures_at(captures.start, length, captures.frame), node=node)
    return dataset.assign_attrs(trigger=captures.report)


def ingest(campaign: Campaign, flight: str, node: str) -> tuple[Path, Path]:
    """Write results/<flight>/<node>/raw.zarr and track.zarr from a node's recording and flight log.

    Raises
    ------
    CampaignError
        If a file is missing or damaged, or does not conform to its format.
    """
    logged = result_of(campaign, "track", flight, node).begin(campaign.root)
    log = read_log(campaign, flight, node)
    origin: dict[str, Any] = {"settings": logged.result.settings, "inputs": logged.sources.digests}
    track = stamped(log, "track", modules=logged.modules, **origin)
    recording = checked_recording(campaign, flight, node)
    recorded = result_of(campaign, "raw", flight, node).begin(
        campaign.root, others=[*map(campaign.relative, preamble_files(recording, campaign))]
    )
    settings: Mapping[str, Any] = {} if recording.framing is None else recorded.result.settings
    dataset = captures_of(recording, campaign, node=node)
    raw = stamped(dataset, "raw", modules=recorded.modules, settings=settings, inputs=recorded.sources.digests)
    folders = campaign.stage("raw", flight, node), campaign.stage("track", flight, node)
    save_stage(raw, folders[0], lineage=recorded)
    save_stage(track, folders[1], lineage=logged)
    return folders
