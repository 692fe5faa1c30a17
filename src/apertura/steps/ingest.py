"""Rules of the ingest wing: what a node recorded, as `raw` and `track`."""

from pathlib import Path

from apertura.campaign import Campaign
from apertura.errors import CampaignError
from apertura.ingest import TRACKS, cut, open_sigmf
from apertura.provenance import sha256_file
from apertura.steps.stamping import stamped
from apertura.steps.triggering import triggered
from apertura.store import save_stage


def raw(campaign: Campaign, flight: str, node: str) -> Path:
    """Write results/<flight>/<node>/raw.zarr from the node's SigMF recording; a continuous one is triggered first."""
    meta, data = (campaign.raw_file(flight, node, suffix) for suffix in (".sigmf-meta", ".sigmf-data"))
    recording = open_sigmf(meta, data)
    files = [meta, data]
    if recording.framing is None:
        dataset = cut(recording, recording.captures(), node=node)
    else:
        files.append(campaign.root / recording.framing["preamble"])
        dataset = triggered(recording, campaign, node=node)
    stamp = stamped(
        dataset,
        "raw",
        modules=[__name__],
        settings=campaign.relevant("raw") if recording.framing else {},
        inputs=_hashes(campaign.root, *files),
    )
    folder = campaign.stage("raw", flight, node)
    save_stage(stamp, folder, chunks={"channel": 1, "pulse": 256})
    return folder


def track(campaign: Campaign, flight: str, node: str) -> Path:
    """Write results/<flight>/<node>/track.zarr from the node's flight log."""
    log = campaign.track_file(flight, node)
    if log.suffix not in TRACKS:
        raise CampaignError(
            f"a flight log of kind {log.suffix!r}",
            where=log,
            expected=f"one of {sorted(TRACKS)}",
            remedy="Convert the log, or write a reader for it.",
        )
    dataset = TRACKS[log.suffix](log, node=node)
    folder = campaign.stage("track", flight, node)
    save_stage(stamped(dataset, "track", modules=[__name__], inputs=_hashes(campaign.root, log)), folder)
    return folder


def _hashes(root: Path, *files: Path) -> dict[str, str]:
    return {path.relative_to(root).as_posix(): sha256_file(path) for path in files}
