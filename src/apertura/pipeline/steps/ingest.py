"""Rule `ingest`: the recording and log of a node in a flight, as stages `raw` and `track`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from apertura.pipeline.campaign import Campaign
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.reading import read_log
from apertura.pipeline.opening.recordings import captures_of, checked_recording, preamble_files
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
    recording = checked_recording(campaign, flight, node)
    recorded = result_of(campaign, "raw", flight, node).begin(
        campaign.root, further=[*map(campaign.relative, preamble_files(recording, campaign))]
    )
    settings: Mapping[str, Any] = {} if recording.framing is None else recorded.result.settings
    dataset = captures_of(recording, campaign, node=node)
    raw = stamped(dataset, "raw", modules=recorded.modules, settings=settings, inputs=recorded.sources.digests)
    folders = campaign.stage("raw", flight, node), campaign.stage("track", flight, node)
    save_stage(raw, folders[0], lineage=recorded)
    save_stage(track, folders[1], lineage=logged)
    return folders
