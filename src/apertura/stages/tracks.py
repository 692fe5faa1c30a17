"""Rule `tracks`: export of a flight's refined tracks, with their corrections and accuracy."""

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
    """Write results/<flight>/tracks: tracks.png, and per node a .csv and, unless the frame is local, a .pos.

    Returns the paths of the files. Positions stored with the samples of a phase history are written as phase centres,
    one epoch per pulse. If the refinement was not attempted, was not accepted, or did not correct a track, the files
    contain the unchanged logs.
    """
    lineage = result_of(campaign, "tracks", flight).begin(campaign.root)
    refined = open_refined(campaign, flight)
    positions = {node: _positions(campaign, flight, node) for node in refined.stage.attrs["nodes"]}
    outcome, folder = outcome_of(refined), (campaign.root / lineage.result.manifest).parent
    folder.mkdir(parents=True, exist_ok=True)
    logs = [refined_log(refined, node, track, campaign.node(flight, node)) for node, track in positions.items()]
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
        provenance = Provenance.of(lineage.modules, [refined.stage, *positions.values()])
    else:
        provenance = Provenance.of(lineage.modules, [refined.stage], inputs=lineage.sources.digests)
    tags = tags_of(provenance, lineage)
    title = f"{campaign.settings.campaign} · tracks of flight {flight}"
    write_picture(picture, logs, title=title, outcome=outcome, tags=tags)
    record_files(campaign.root / lineage.result.manifest, [*written, picture], lineage)
    return [*written, picture]


def _positions(campaign: Campaign, flight: str, node: str) -> xr.Dataset:
    """Return positions in the form of stage `track`, from the log, or else of the node's antenna at the pulses."""
    if is_sampled(campaign):
        track: xr.Dataset = open_stage(campaign.stage("track", flight, node), "track")
        return track
    if campaign.logged(flight, node):
        return read_log(campaign, flight, node)
    pair = next(pair for pair in campaign.flight(flight).pairs if node in pair.split("-"))
    echo, leg = open_stage(campaign.stage("echo", flight, pair), "echo"), "tx" if pair.startswith(f"{node}-") else "rx"
    position_m = echo[f"{leg}_position"].values
    return xr.Dataset(  # times are not UTC if the recorder has no clock
        {
            "time": ("epoch", echo.time.values),
            "position": (("epoch", "axis"), position_m),
            "attitude": (("epoch", "axis"), np.full(position_m.shape, np.nan)),
        },
        attrs={"node": node, "frame": echo.attrs["frame"]},
    )


def outcome_of(refined: RefinedTrack) -> str:
    """Return the outcome of the refinement for the tracks of a flight, with the reason, in one line."""
    decision = refined.decisions[0]
    reason = f"autofocus {decision.value}: {decision.reason}"
    if refined.correction is None:
        return f"as logged: {reason}"
    if refined.correction.extra_path_m:
        return f"as logged: the refinement estimated one path offset per pulse and pair, and no node position; {reason}"
    return f"refined: {reason}"


def refined_log(refined: RefinedTrack, node: str, track: xr.Dataset, settings: Node) -> RefinedLog:
    """Return a node's log with its corrections.

    Parameters
    ----------
    refined
        Outcome of step `refine`.
    node, track, settings
        Name, stage `track` and settings of the node.
    """
    at = track.time.values
    return RefinedLog(node, track, refined.moved_m(node, at), refined.left_m(node, at), _stated_m(track, settings))


def _stated_m(track: xr.Dataset, settings: Node) -> Floats:
    """Return the accuracy of a log's epochs, (epoch, 3) metres east, north, up, from the log or else the config."""
    config_m = np.nan if settings.position_std_m is None else settings.position_std_m
    stated_m = np.array(np.broadcast_to(config_m, track.position.shape), np.float64)
    if "position_std" in track:
        logged_m = track.position_std.values
        is_stated = (logged_m > 0).all(axis=1)  # 0 means that the log states no accuracy, as in the error budget
        stated_m[is_stated] = logged_m[is_stated]
    return stated_m[:, [1, 0, 2]]
