"""Rule `refine`: errors of a flight's tracks as its images show them, all pairs together, or why they are left."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, save_stage
from apertura.common.arrays import Floats
from apertura.common.flags import Flags
from apertura.common.provenance import merged
from apertura.core.backprojection.inputs import Profiles
from apertura.core.geometry.geodesy import frame_from_map
from apertura.core.geometry.phase_centres import TrackCorrection
from apertura.core.imaging.range_profiles import profiles_of
from apertura.core.planning.plan import Decision
from apertura.methods.autofocus.causes import Cause, late_logs, other_arm, other_height
from apertura.methods.autofocus.evidence import FOLDS
from apertura.methods.autofocus.inputs import PairRecord, ReferencePoint, Refinement, TrackErrors
from apertura.methods.autofocus.patches import Candidates
from apertura.methods.autofocus.path_offsets import refine_one_phase
from apertura.methods.autofocus.refine import refine as refine_tracks
from apertura.stages.node_log import raw_log
from apertura.stages.pair import OpenPair, open_pair, pattern_digests
from apertura.stages.planning import weighing
from apertura.stages.refine import autofocus_of, clock_s, errors_of
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.stamping import stamped
from apertura.workflow.lineage import result_of

# ---- Inputs of a refinement of tracks from an open flight: profiles of each pair, errors of the logs ---------------


@dataclass(frozen=True, eq=False)
class RefinementInputs:
    """Inputs of the refinement of a flight's tracks.

    Attributes
    ----------
    records
        One for each pair, by the flight's clock.
    errors
        Node → error statistics of its log.
    points
        Points of the scene whose places are known.
    began
        Zero of the clock, UTC.
    causes
        Constants of the config that may be wrong.
    """

    records: tuple[PairRecord, ...]
    errors: Mapping[str, TrackErrors]
    points: tuple[ReferencePoint, ...]
    began: np.datetime64
    causes: tuple[Cause, ...] = ()


def refinement_inputs(campaign: Campaign, pairs: Mapping[OpenPair, Profiles], scene: OpenScene) -> RefinementInputs:
    """Return the inputs of the refinement of a flight's tracks.

    Parameters
    ----------
    campaign
        With its settings.
    pairs
        Every pair of the flight, as the logs have it, and its range profiles.
    scene
        The campaign's.
    """
    began = min(pair.began for pair in pairs)
    records = [
        PairRecord(pair.name, profiles, clock_s(pair, began), pair.sidelink_m, weighing(campaign, pair, scene))
        for pair, profiles in pairs.items()
    ]
    flight, height = next(iter(pairs)).flight, scene.axes[2]
    causes = tuple(_causes(campaign, flight, records, began, height))
    return RefinementInputs(tuple(records), errors_of(list(pairs)), reference_points(campaign), began, causes)


def _causes(
    campaign: Campaign, flight: str, records: Sequence[PairRecord], began: np.datetime64, up: Floats
) -> Iterator[Cause]:
    """Yield what may be wrong: height of the ground; times of logs; lever arms of nodes whose attitude is known."""
    flown = {
        node: (one.time_s, leg)
        for one in records
        for node, leg in zip(one.nodes, one.profiles.aperture.legs, strict=True)
    }
    yield other_height(list(flown), records[0].time_s, up)
    logged = [node for node in flown if campaign.logged(flight, node)]
    for node in logged:
        yield late_logs([node], flown)
        time_s, _ = flown[node]
        wave_m = 2 * np.pi / records[0].profiles.wavenumber_rad_m
        log = raw_log(campaign, flight, node, wave_m)
        if log.has_attitude:
            yield other_arm(node, time_s, log.body_axes(began + (1e9 * time_s).astype("timedelta64[ns]")))
    if len(logged) > 1:
        yield late_logs(logged, flown)


def reference_points(campaign: Campaign) -> tuple[ReferencePoint, ...]:
    """Return the reference points of the config, in the frame of the phase centres."""
    requested, points = campaign.settings.scene, []
    for point in requested.reference_points:
        x, y, z = frame_from_map(requested.crs, *point.position_m).tolist()
        points.append(ReferencePoint(point.name, (x, y, z), point.std_m))
    return tuple(points)


# ---- Rule `refine`: corrections of a flight's tracks by the images of all its pairs, or why there are none ---------


def refine(campaign: Campaign, flight: str) -> Path:
    """Write results/<flight>/refined_track.zarr; without corrections it states the reason and has no knots."""
    lineage = result_of(campaign, "refined_track", flight).begin(campaign.root)
    names, scene = campaign.flight(flight).pairs, open_scene(campaign)
    requested = campaign.settings.processing.autofocus
    pairs = [] if requested == "off" else [open_pair(campaign, flight, pair) for pair in names]
    decisions, folder = autofocus_of(campaign, pairs, scene), campaign.stage("refined_track", flight)
    if decisions[0].value == "on":
        stages = {pair: open_stage(campaign.stage("profile", flight, pair), "profile") for pair in names}
        profiles = {pair: profiles_of(stages[pair.name], lazy=True) for pair in pairs}
        given = refinement_inputs(campaign, profiles, scene)
        found = _searched(given, scene, str(decisions[1].value))
        stage = refined_stage(found, decisions, given, scene)
    else:
        found = _unrefined(node for pair in names for node in pair.split("-"))
        stages, stage = {}, refined_stage(found, decisions, None, scene)
    print("; ".join([*(f"{one.name} {one.value}: {one.reason}" for one in decisions), found.why]), flush=True)
    patterns = [pattern_digests(campaign, pair) for pair in names]
    inherits: dict[str, Any] = {"parents": stages, "inputs": merged(scene.inputs, *patterns)}
    settings = {**lineage.result.settings, "refined": found.accepted}
    # Images that are formed from the logs depend on their own echoes alone, not on those read here.
    how: dict[str, Any] = {"modules": lineage.modules, "settings": settings, **(inherits if found.accepted else {})}
    save_stage(stamped(stage, "refined_track", **how), folder, lineage=lineage)
    return folder


def _searched(given: RefinementInputs, scene: OpenScene, method: str) -> Refinement:
    """Return the refinement of tracks, or of one phase per pulse where there are places enough to validate it."""
    records, errors = given.records, given.errors
    found = None if method == "tracks" else Candidates.of(records, scene.grid, scene.terrain, errors)
    if found is None or len(found.patches) < FOLDS:
        points, causes = given.points, given.causes
        return refine_tracks(records, scene.grid, scene.terrain, errors, reference_points=points, causes=causes)
    return refine_one_phase(records, found, errors, method=method)


def _unrefined(nodes: Any) -> Refinement:
    """Return the refinement that leaves the tracks of some nodes as logged."""
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
        The refinement; whether it was tried, how, and why.
    given
        Its inputs; None where it was not tried.
    scene
        The campaign's.
    """
    knots_s, nodes = found.correction.time_s, list(found.correction.moved_m)
    extra_path_m = found.correction.extra_path_m
    began = np.datetime64(0, "ns") if given is None else given.began.astype("datetime64[ns]")
    logged = _logged(() if given is None else given.records, knots_s)
    moved_m, std_m = (np.stack([values[node] for node in nodes]) for values in (found.correction.moved_m, found.std_m))
    position_m = np.stack([logged.get(node, np.zeros((0, 3))) for node in nodes])
    by_node = ("node", "knot", "axis")
    return xr.Dataset(
        {
            "time": ("knot", began + np.rint(1e9 * knots_s).astype("timedelta64[ns]")),
            "correction": (by_node, moved_m),
            "further": (("pair", "knot"), np.reshape([*extra_path_m.values()], (len(extra_path_m), len(knots_s)))),
            "std": (by_node, std_m),
            "position": (by_node, position_m),
        },
        attrs={
            "frame": scene.grid.frame,
            "flags": Flags(found.flags),
            "nodes": nodes,
            "pairs": list(extra_path_m),
            "decisions": {one.name: {"value": one.value, "reason": one.reason} for one in decisions},
            "accepted": found.accepted,
            "why": found.why,
            "report": dict(found.report),
            "left": _left(found.report),
        },
    )


def _logged(records: Collection[PairRecord], knots_s: NDArray[np.float64]) -> Mapping[str, NDArray[np.float64]]:
    """Return node → (knot, 3), its radar phase centre as the log has it, in the first pair that it takes part in."""
    places: dict[str, NDArray[np.float64]] = {}
    for one in records:
        for node, leg in zip(one.nodes, one.profiles.aperture.legs, strict=True):
            places.setdefault(node, np.stack([np.interp(knots_s, one.time_s, axis) for axis in leg.T], axis=-1))
    return places


def _left(report: Mapping[str, Any]) -> dict[str, float]:
    """Return the effect of the remaining errors on an image, by the names of `Effect`; {} where unknown."""
    named = {"loss_db": "left_db", "shift_m": "gauge_shift_m", "phase_rad": "left_rad"}
    return {effect: report[name] for effect, name in named.items()} if {*named.values()} <= report.keys() else {}
