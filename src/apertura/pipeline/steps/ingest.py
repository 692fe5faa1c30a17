"""Rule `ingest`: the recording and log of a node in a flight, as stages `raw` and `track`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from apertura.common.errors import CampaignError
from apertura.common.paths import inside
from apertura.formats.reading import open_recording
from apertura.formats.recordings.recording import Recording
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import CONFIG, PulseWaveform, SampledWaveform
from apertura.pipeline.digests import digest_of
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.reading import read_log
from apertura.pipeline.opening.transmitted import read_framing
from apertura.pipeline.steps.stamping import stamped
from apertura.pipeline.store import save_stage


def ingest(campaign: Campaign, flight: str, node: str) -> tuple[Path, Path]:
    """Write results/<flight>/<node>/raw.zarr and track.zarr from a node's recording and flight log.

    Raises
    ------
    CampaignError
        If a file is missing, damaged, or not what its format promises.
    """
    logged = result_of(campaign, "track", flight, node).begin(campaign.root)
    log = read_log(campaign, flight, node)
    how: dict[str, Any] = {"settings": logged.result.settings, "inputs": logged.sources.digests}
    track = stamped(log, "track", modules=logged.modules, **how)
    recording = open_recording(campaign.recording_files(flight, node))
    recording.check_hash(lambda path: digest_of(campaign.root, campaign.relative(path), algorithm="sha512"))
    preamble = () if recording.framing is None else (_preamble(recording, campaign),)
    recorded = result_of(campaign, "raw", flight, node).begin(
        campaign.root, further=[campaign.relative(path) for path in preamble]
    )
    settings: Mapping[str, Any] = {} if recording.framing is None else recorded.result.settings
    if recording.framing is None:
        dataset = recording.cut(recording.captures, node=node)
    else:
        dataset = _triggered(recording, campaign, node=node)
    dataset.attrs["samples"] = campaign.relative(recording.samples.path)
    raw = stamped(dataset, "raw", modules=recorded.modules, settings=settings, inputs=recorded.sources.digests)
    folders = campaign.stage("raw", flight, node), campaign.stage("track", flight, node)
    save_stage(raw, folders[0], lineage=recorded)
    save_stage(track, folders[1], lineage=logged)
    return folders


def _triggered(recording: Recording, campaign: Campaign, *, node: str) -> xr.Dataset:
    """Return the `raw` stage of a continuous recording, as a triggered recorder would have written it."""
    from apertura.core.echo.trigger import trigger_captures

    waveform, described = campaign.settings.waveform, recording.framing or {}
    if not isinstance(waveform, SampledWaveform):
        raise TypeError("a recording of samples needs a waveform that was recorded as samples")
    if isinstance(waveform, PulseWaveform) and waveform.lead_s:
        raise CampaignError(
            f"waveform.lead_s is {waveform.lead_s:g}, and {recording.files[0].name} never stopped",
            where=CONFIG,
            expected="0: its captures are cut where the pulse begins",
            remedy="Set waveform.lead_s to 0.",
        )
    framing = read_framing(
        _preamble(recording, campaign),
        described,
        sample_rate_hz=recording.sample_rate_hz,
        where=recording.files[0],
    )
    rate = campaign.settings.processing.false_alarms_per_s
    channel = "sidelink" if "sidelink" in recording.channels else "radar"
    samples, length = recording.samples.channel(recording.channels.index(channel)), waveform.capture_samples
    bits = 8 * recording.samples.sample_bytes // len(recording.channels)
    captures = trigger_captures(samples, framing, symbol_samples=length, false_alarms_per_s=rate, sample_bits=bits)
    if not captures.start.size:
        raise CampaignError(
            f"no preamble in {len(samples)} samples at a threshold for {rate} false alarms per second",
            where=recording.files[-1],
            expected=f"preambles of {described['preamble']} in channel {channel}",
            remedy="Check the preamble file and apertura:framing, or record with more signal.",
        )
    dataset = recording.cut(recording.captures_at(captures.start, length, captures.frame), node=node)
    return dataset.assign_attrs(trigger=captures.report)


def _preamble(recording: Recording, campaign: Campaign) -> Path:
    """Return the file of chips that the recorder's metadata name, which must lie in the campaign."""
    name = (recording.framing or {})["preamble"]
    return inside(campaign.root, name, where=f"{recording.files[0]}: apertura:framing.preamble")
