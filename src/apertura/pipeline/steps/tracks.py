"""Rule `tracks`: the logs of a flight as refined, for other programs, with what was moved and how sure that is."""

from pathlib import Path

import numpy as np
import xarray as xr

from apertura import __version__
from apertura.common.arrays import Floats
from apertura.common.provenance import Provenance
from apertura.formats.export.tracks import RefinedLog, write_csv, write_picture, write_pos
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import Node
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.autofocus import RefinedTrack, open_refined
from apertura.pipeline.steps.stamping import tags_of
from apertura.pipeline.store import open_stage, record_files


def tracks(campaign: Campaign, flight: str) -> list[Path]:
    """Write results/<flight>/tracks: of each node .csv and, on Earth, .pos, and tracks.png; return their paths.

    Where the refinement was not accepted, moved no track or was not tried, the files hold the logs as they are.
    """
    lineage = result_of(campaign, "tracks", flight).begin(campaign.root)
    found = open_refined(campaign, flight)
    stages = {node: open_stage(campaign.stage("track", flight, node), "track") for node in found.stage.attrs["nodes"]}
    outcome, folder = outcome_of(found), (campaign.root / lineage.result.manifest).parent
    folder.mkdir(parents=True, exist_ok=True)
    logs = [refined_log(found, node, stage, campaign.node(flight, node)) for node, stage in stages.items()]
    written = []
    for log in logs:
        table, solution = (folder / f"{log.node}.{suffix}" for suffix in ("csv", "pos"))
        write_csv(table, log)
        written.append(table)
        if not log.local:
            write_pos(solution, log, outcome=outcome, version=__version__)
            written.append(solution)
    picture = folder / "tracks.png"
    tags = tags_of(Provenance.of(lineage.modules, [found.stage, *stages.values()]), lineage)
    title = f"{campaign.settings.campaign} · tracks of flight {flight}"
    write_picture(picture, logs, title=title, outcome=outcome, tags=tags)
    record_files(campaign.root / lineage.result.manifest, [*written, picture], lineage)
    return [*written, picture]


def outcome_of(found: RefinedTrack) -> str:
    """Return whether the tracks of a flight are refined, or why they are as logged: a line."""
    decided = found.decisions[0]
    why = f"autofocus {decided.value}: {decided.reason}"
    if found.correction is None:
        return f"as logged: {why}"
    if found.correction.further_m:
        return f"as logged: one path offset per pulse and pair was refined, which moves no node; {why}"
    return f"refined: {why}"


def refined_log(found: RefinedTrack, node: str, track: xr.Dataset, settings: Node) -> RefinedLog:
    """Return a node's log with its corrections.

    Parameters
    ----------
    found
        Outcome of step `refine`.
    node, track, settings
        Of the node: its name, its stage `track` and what the config says of it.
    """
    at = track.time.values
    return RefinedLog(node, track, found.moved_m(node, at), found.left_m(node, at), _stated_m(track, settings))


def _stated_m(track: xr.Dataset, settings: Node) -> Floats:
    """Return what is stated of the errors of a log's epochs, (epoch, 3) metres east, north, up: its own word first."""
    config_m = np.nan if settings.position_std_m is None else settings.position_std_m
    stated_m = np.array(np.broadcast_to(config_m, track.position.shape), np.float64)
    if "position_std" in track:
        own_m = track.position_std.values
        told = (own_m > 0).all(axis=1)  # 0 states nothing, as when an error is budgeted
        stated_m[told] = own_m[told]
    return stated_m[:, [1, 0, 2]]
