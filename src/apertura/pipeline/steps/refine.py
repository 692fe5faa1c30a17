"""Rule `refine`: errors of a flight's tracks as its images show them, all pairs together, or why they are left."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.flags import Flags
from apertura.common.provenance import merged
from apertura.core.geometry.phase_centres import TrackCorrection
from apertura.core.imaging.range_profiles import profiles_of
from apertura.core.planning.plan import Decision
from apertura.methods.autofocus.inputs import Refinement, Sighting
from apertura.methods.autofocus.patches import Candidates
from apertura.methods.autofocus.path_offsets import refine_one_phase
from apertura.methods.autofocus.refine import refine as refine_tracks
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.autofocus import autofocus_of
from apertura.pipeline.opening.pair import open_pair, pattern_digests
from apertura.pipeline.opening.scene import OpenScene, open_scene
from apertura.pipeline.opening.sightings import RefinementInputs, seen
from apertura.pipeline.steps.stamping import stamped
from apertura.pipeline.store import open_stage, save_stage


def refine(campaign: Campaign, flight: str) -> Path:
    """Write results/<flight>/refined_track.zarr; where tracks are left as they are it says why, and has no knots."""
    lineage = result_of(campaign, "refined_track", flight).begin(campaign.root)
    names, scene = campaign.flight(flight).pairs, open_scene(campaign)
    asked = campaign.settings.processing.autofocus
    pairs = [] if asked == "off" else [open_pair(campaign, flight, pair) for pair in names]
    decisions, folder = autofocus_of(campaign, pairs, scene), campaign.stage("refined_track", flight)
    if decisions[0].value == "on":
        stages = {pair: open_stage(campaign.stage("profile", flight, pair), "profile") for pair in names}
        profiles = {pair: profiles_of(stages[pair.name], lazy=True) for pair in pairs}
        given = seen(campaign, profiles, scene)
        found = _searched(given, scene, str(decisions[1].value))
        stage = refined_stage(found, decisions, given, scene)
    else:
        found = _unrefined(node for pair in names for node in pair.split("-"))
        stages, stage = {}, refined_stage(found, decisions, None, scene)
    print("; ".join([*(f"{one.name} {one.value}: {one.reason}" for one in decisions), found.why]), flush=True)
    patterns = [pattern_digests(campaign, pair) for pair in names]
    inherits: dict[str, Any] = {"parents": stages, "inputs": merged(scene.inputs, *patterns)}
    settings = {**lineage.result.settings, "refined": found.accepted}
    # Images that are formed from the logs stand on their own echoes alone, whatever was looked at here.
    how: dict[str, Any] = {"modules": lineage.modules, "settings": settings, **(inherits if found.accepted else {})}
    save_stage(stamped(stage, "refined_track", **how), folder, lineage=lineage)
    return folder


def _searched(given: RefinementInputs, scene: OpenScene, method: str) -> Refinement:
    """Return what images say of the tracks, or of the phases of pulses."""
    sightings, errors = given.sightings, given.errors
    if method == "tracks":
        return refine_tracks(sightings, scene.grid, scene.terrain, errors, reference_points=given.points)
    found = Candidates.of(sightings, scene.grid, scene.terrain, errors)
    return refine_one_phase(sightings, found, errors, method=method)


def _unrefined(nodes: Any) -> Refinement:
    """Return that the tracks of some nodes are those of their logs."""
    nothing = {node: np.zeros((0, 3)) for node in dict.fromkeys(nodes)}
    why = "images are formed from the logs as they are"
    return Refinement(TrackCorrection(np.zeros(0), nothing), nothing, accepted=False, why=why)


def refined_stage(
    found: Refinement, decisions: Sequence[Decision], given: RefinementInputs | None, scene: OpenScene
) -> xr.Dataset:
    """Return stage `refined_track`, to be stamped.

    Parameters
    ----------
    found, decisions
        What was found of the tracks; whether it was looked for, and how, and why.
    given
        What it was found from; None where it was not looked for.
    scene
        The campaign's.
    """
    knots_s, nodes = found.correction.time_s, list(found.correction.moved_m)
    further_m = found.correction.further_m
    began = np.datetime64(0, "ns") if given is None else given.began.astype("datetime64[ns]")
    logged = _logged(() if given is None else given.sightings, knots_s)
    moved_m, std_m = (np.stack([values[node] for node in nodes]) for values in (found.correction.moved_m, found.std_m))
    position_m = np.stack([logged.get(node, np.zeros((0, 3))) for node in nodes])
    by_node = ("node", "knot", "axis")
    return xr.Dataset(
        {
            "time": ("knot", began + np.rint(1e9 * knots_s).astype("timedelta64[ns]")),
            "correction": (by_node, moved_m),
            "further": (("pair", "knot"), np.reshape([*further_m.values()], (len(further_m), len(knots_s)))),
            "std": (by_node, std_m),
            "position": (by_node, position_m),
        },
        attrs={
            "frame": scene.grid.frame,
            "flags": Flags(found.flags),
            "nodes": nodes,
            "pairs": list(further_m),
            "decisions": {one.name: {"value": one.value, "reason": one.reason} for one in decisions},
            "accepted": found.accepted,
            "why": found.why,
            "report": dict(found.report),
            "left": _left(found.report),
        },
    )


def _logged(sightings: Collection[Sighting], knots_s: NDArray[np.float64]) -> Mapping[str, NDArray[np.float64]]:
    """Return node → (knot, 3), its radar phase centre as the log has it, in the first pair that it takes part in."""
    places: dict[str, NDArray[np.float64]] = {}
    for one in sightings:
        for node, leg in zip(one.nodes, one.profiles.aperture.legs, strict=True):
            places.setdefault(node, np.stack([np.interp(knots_s, one.time_s, axis) for axis in leg.T], axis=-1))
    return places


def _left(report: Mapping[str, Any]) -> dict[str, float]:
    """Return what the errors left do to an image, as `Effect` names it; {} where that is not known."""
    named = {"loss_db": "left_db", "shift_m": "gauge_shift_m", "phase_rad": "left_rad"}
    return {effect: report[name] for effect, name in named.items()} if {*named.values()} <= report.keys() else {}
