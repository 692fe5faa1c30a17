"""Rule `tracks`: the logs of a flight as refined, for other programs, with what was moved and how sure that is."""

from pathlib import Path

import numpy as np
import xarray as xr

from apertura import __version__
from apertura.campaign.config import Node
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, record_files
from apertura.common.arrays import Floats
from apertura.common.provenance import Provenance
from apertura.formats.export.tracks import RefinedLog, write_csv, write_picture, write_pos
from apertura.stages.node_log import read_log
from apertura.stages.refine import RefinedTrack, open_refined
from apertura.stages.tags import tags_of
from apertura.workflow.lineage import result_of
from apertura.workflow.rule_inputs import is_sampled


def tracks(campaign: Campaign, flight: str) -> list[Path]:
    """Write results/<flight>/tracks: of each node .csv and, on Earth, .pos, and tracks.png; return their paths.

    Positions that travel with the samples of a phase history are written as phase centres, an epoch per pulse.
    Where the refinement was not accepted, moved no track or was not tried, the files hold the logs as they are.
    """
    lineage = result_of(campaign, "tracks", flight).begin(campaign.root)
    found = open_refined(campaign, flight)
    positions = {node: _positions(campaign, flight, node) for node in found.stage.attrs["nodes"]}
    outcome, folder = outcome_of(found), (campaign.root / lineage.result.manifest).parent
    folder.mkdir(parents=True, exist_ok=True)
    logs = [refined_log(found, node, track, campaign.node(flight, node)) for node, track in positions.items()]
    written = []
    for log in logs:
        table, solution = (folder / f"{log.node}.{suffix}" for suffix in ("csv", "pos"))
        write_csv(table, log)
        written.append(table)
        if not log.local:
            write_pos(solution, log, outcome=outcome, version=__version__)
            written.append(solution)
    picture = folder / "tracks.png"
    if is_sampled(campaign):
        provenance = Provenance.of(lineage.modules, [found.stage, *positions.values()])
    else:
        provenance = Provenance.of(lineage.modules, [found.stage], inputs=lineage.sources.digests)
    tags = tags_of(provenance, lineage)
    title = f"{campaign.settings.campaign} · tracks of flight {flight}"
    write_picture(picture, logs, title=title, outcome=outcome, tags=tags)
    record_files(campaign.root / lineage.result.manifest, [*written, picture], lineage)
    return [*written, picture]


def _positions(campaign: Campaign, flight: str, node: str) -> xr.Dataset:
    """Return the positions of a node as stage `track` holds them: as logged, else of its antenna at the pulses."""
    if is_sampled(campaign):
        track: xr.Dataset = open_stage(campaign.stage("track", flight, node), "track")
        return track
    if campaign.logged(flight, node):
        return read_log(campaign, flight, node)
    pair = next(pair for pair in campaign.flight(flight).pairs if node in pair.split("-"))
    echo, leg = open_stage(campaign.stage("echo", flight, pair), "echo"), "tx" if pair.startswith(f"{node}-") else "rx"
    place_m = echo[f"{leg}_position"].values
    return xr.Dataset(  # its times may be of no calendar, as where a recorder states none
        {
            "time": ("epoch", echo.time.values),
            "position": (("epoch", "axis"), place_m),
            "attitude": (("epoch", "axis"), np.full(place_m.shape, np.nan)),
        },
        attrs={"node": node, "frame": echo.attrs["frame"]},
    )


def outcome_of(found: RefinedTrack) -> str:
    """Return the outcome of refinement for the tracks of a flight, with the reason, in a line."""
    decided = found.decisions[0]
    why = f"autofocus {decided.value}: {decided.reason}"
    if found.correction is None:
        return f"as logged: {why}"
    if found.correction.extra_path_m:
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
    """Return stated errors of a log's epochs, (epoch, 3) metres east, north, up: the log's own, else the config's."""
    config_m = np.nan if settings.position_std_m is None else settings.position_std_m
    stated_m = np.array(np.broadcast_to(config_m, track.position.shape), np.float64)
    if "position_std" in track:
        own_m = track.position_std.values
        is_stated = (own_m > 0).all(axis=1)  # 0 states nothing, as when an error is budgeted
        stated_m[is_stated] = own_m[is_stated]
    return stated_m[:, [1, 0, 2]]
