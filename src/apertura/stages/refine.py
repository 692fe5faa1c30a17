"""Rule `refine`: joint estimation of a flight's track errors from the images of all its pairs (autofocus)."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, save_stage
from apertura.common.arrays import Floats, Times
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.flags import Flags
from apertura.common.provenance import merged
from apertura.common.units import seconds_since
from apertura.core.backprojection.inputs import Profiles
from apertura.core.echo.compression import centre_frequency
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import frame_from_map
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.imaging.range_profiles import profiles_of
from apertura.core.planning.decisions import decide_autofocus
from apertura.core.planning.plan import Decision, no_aperture
from apertura.core.quality.budget import NodePositions
from apertura.core.quality.path_errors import Effect
from apertura.methods.autofocus.evidence import FOLDS
from apertura.methods.autofocus.inputs import PairRecord, ReferencePoint, Refinement, TrackErrors
from apertura.methods.autofocus.one_phase import SpaceVariance, space_variance
from apertura.methods.autofocus.patches import Candidates
from apertura.methods.autofocus.path_offsets import refine_one_phase
from apertura.methods.autofocus.refine import refine as refine_tracks
from apertura.methods.causes import Cause, late_logs, other_arm, other_height
from apertura.stages.acquisition import Acquisition
from apertura.stages.node_log import raw_log
from apertura.stages.pair import OpenPair, open_pair, pattern_digests
from apertura.stages.planning import gated, paths_to, positions_loss_db, weighing
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.tags import stamped
from apertura.workflow.lineage import result_of

# ---- Decision on the refinement of a flight's tracks, and on its method ----------------------------------------------

ASSUMED_STD_M = 0.02
"""Assumed position accuracy per axis if none is stated and a refinement is requested, metres: RTK fix."""

LEAST_STD_M = 1e-3
"""Lower bound of a stated position accuracy, metres: a prior of zero would fix the track."""

ONE_PHASE = "minimum_entropy"
"""Method of `auto` if one phase per pulse suffices; its results are accepted at least as often as phase_gradient's."""


_CORNERS = 2
"""Points along each side of the scene at which the length of the aperture is evaluated."""


def autofocus_of(campaign: Campaign, pairs: Sequence[OpenPair], scene: OpenScene) -> tuple[Decision, ...]:
    """Decide on the refinement of a flight's tracks and on its method; `pairs` are all pairs of the flight."""
    requested = campaign.settings.processing
    ground_m = scene.grid.sample_points(_CORNERS, scene.level.height_m)
    for pair in pairs:
        wave_m = SPEED_OF_LIGHT_M_S / centre_frequency(pair.frequency_hz)
        if still := no_aperture(pair.aperture, ground_m, wavelength_m=wave_m):
            return (Decision("autofocus", "off", f"{pair.name}: {still}"),)
    unstated = [node for node, accuracy in positions_of(pairs).items() if accuracy.std_m is None]
    loss_db = {pair.name: positions_loss_db(campaign, pair, scene) for pair in pairs}
    decision = decide_autofocus(requested.autofocus, loss_db, unstated)
    if decision.value == "off":
        return (decision,)
    variances = {pair.name: _variance(pair, scene, errors_of(pairs)) for pair in pairs}
    has_points = bool(campaign.settings.scene.reference_points)
    return decision, decide_method(requested.autofocus_method, variances, known_points=has_points)


def decide_method(requested: str, variances: Mapping[str, SpaceVariance], *, known_points: bool) -> Decision:
    """Choose the refinement method, with the reason.

    Parameters
    ----------
    requested
        auto, tracks, or a row of `apertura.methods.autofocus.one_phase.METHODS`.
    variances
        Pair → residual error with one phase per pulse.
    known_points
        True if the scene has reference points, which only the method `tracks` uses.

    Examples
    --------
    >>> decide_method("auto", {"a-a": SpaceVariance(0.02, -0.001)}, known_points=False).value
    'minimum_entropy'
    >>> decide_method("auto", {"a-a": SpaceVariance(0.02, -0.001)}, known_points=True).value
    'tracks'
    """
    if requested != "auto":
        return Decision("autofocus_method", requested, "configured")
    if known_points:
        return Decision("autofocus_method", "tracks", "auto: only method tracks uses scene.reference_points")
    pair, worst = min(variances.items(), key=lambda item: item[1].loss_db)
    value = ONE_PHASE if worst.method == "one_phase" else "tracks"
    return Decision("autofocus_method", value, f"auto: in {pair} {worst.reason}")


def positions_of(pairs: Sequence[OpenPair]) -> Mapping[str, NodePositions]:
    """Return node → position accuracy of its log, which is the same in each pair."""
    return {
        node: accuracy
        for pair in pairs
        for node, accuracy in zip(dict.fromkeys(pair.name.split("-")), pair.positions, strict=True)
    }


def errors_of(pairs: Sequence[OpenPair]) -> Mapping[str, TrackErrors]:
    """Return node → stated or assumed error statistics of its log."""
    return {
        node: TrackErrors(_std_m(accuracy), accuracy.correlation_s, accuracy.drift_m)
        for node, accuracy in positions_of(pairs).items()
    }


def _variance(pair: OpenPair, scene: OpenScene, errors: Mapping[str, TrackErrors]) -> SpaceVariance:
    """Return the residual error with one phase per pulse at the corners of the scene."""
    last_row, last_column = (size - 1 for size in scene.grid.shape)
    rows, columns = np.array([0, 0, last_row, last_row]), np.array([0, last_column, 0, last_column])
    corners_m = scene.terrain.positions_at(scene.grid, rows, columns)
    node_errors = [errors[node] for node in dict.fromkeys(pair.name.split("-"))]
    return space_variance(paths_to(pair, scene, scene.middle_m), corners_m, node_errors)


def _std_m(accuracy: NodePositions) -> tuple[float, float, float]:
    """Return the stated or assumed standard deviations of a node's log, east, north, up."""
    east, north, up = (max(std_m, LEAST_STD_M) for std_m in accuracy.std_m or (ASSUMED_STD_M,) * 3)
    return east, north, up


# ---- Refined tracks, which give images their phase centres -----------------------------------------------------------

_QUOTED = ("gain_fitted_db", "gain_held_out_db", "gain_std_db")


@dataclass(frozen=True, eq=False)
class RefinedTrack:
    """Outcome of step `refine` for a flight.

    Attributes
    ----------
    stage
        Stage `refined_track`, a parent of the images.
    correction
        Correction of the flight's nodes and pairs, with times in seconds since `began`; None if images are formed from
        the unchanged logs.
    began
        Zero of the correction's time scale, UTC.
    """

    stage: xr.Dataset
    correction: TrackCorrection | None
    began: np.datetime64

    @classmethod
    def of(cls, stage: xr.Dataset) -> "RefinedTrack":
        """Read the outcome from a stage."""
        time, nodes = stage.time.values, stage.attrs["nodes"]
        if not stage.attrs["accepted"] or not len(time):
            return cls(stage, None, np.datetime64(0, "ns"))
        moved_m = dict(zip(nodes, stage.correction.values, strict=True))
        extra_path_m = dict(zip(stage.attrs["pairs"], stage.further.values, strict=True))
        return cls(stage, TrackCorrection(seconds_since(time, time[0]), moved_m, extra_path_m), time[0])

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """Decisions on refinement and its method, with reason and outcome."""
        outcome = {"autofocus": f"; {self.stage.attrs['reason']}"}
        return tuple(
            Decision(name, decision["value"], decision["reason"] + outcome.get(name, ""))
            for name, decision in self.stage.attrs["decisions"].items()
        )

    def report(self, pair: str) -> dict[str, Any]:
        """Return the refinement of a pair's tracks for image.json."""
        attrs = self.stage.attrs
        decisions = {
            name: f"{decision['value']}: {decision['reason']}" for name, decision in attrs["decisions"].items()
        }
        return {
            "decision": decisions["autofocus"],
            **({"method": decisions["autofocus_method"]} if "autofocus_method" in decisions else {}),
            "accepted": attrs["accepted"],
            "reason": attrs["reason"],
            **{name: attrs["report"][name] for name in _QUOTED if name in attrs["report"]},
            **({} if self.correction is None else _sizes_cm(self.correction, pair)),
        }

    def pair(self, logged: OpenPair) -> OpenPair:
        """Return an open pair with corrected phase centres and the residual errors of the refinement."""
        if self.correction is None:
            return logged
        aperture, extra_path_m = self._moved(self.correction, logged)
        history = None if logged.history is None else logged.history.moved(aperture, extra_path_m)
        residual, gate = self.stage.attrs["left"], logged.gate and logged.gate.moved(extra_path_m)
        left = Effect(**residual) if residual else None
        return replace(logged, aperture=aperture, history=history, left=left, gate=gate)

    def profiles(self, logged: OpenPair, profiles: Profiles) -> Profiles:
        """Return the range profiles of a pair with corrected phase centres and paths."""
        return profiles if self.correction is None else profiles.moved(*self._moved(self.correction, logged))

    def node(self, logged: Acquisition) -> Acquisition:
        """Return a node with its log corrected."""
        if self.correction is None:
            return logged
        moved_m = self.moved_m(logged.name, logged.track.time.values)
        return replace(logged, track=logged.track.assign(position=logged.track.position + moved_m))

    def moved_m(self, node: str, at: Times) -> NDArray[np.float64]:
        """Return the correction of a node's logged positions at given times, (time, 3) float64 metres in the frame.

        Before the first and after the last pulse, the correction is constant.
        """
        if self.correction is None:
            return np.zeros((len(at), 3))
        return self.correction.at(node, seconds_since(at, self.began))

    def left_m(self, node: str, at: Times) -> NDArray[np.float64]:
        """Return the standard deviation of a node's residual position error, along the axes of the frame.

        Returns
        -------
        ndarray
            (time, 3) float64, metres; NaN where the node's position is not observable in the images: before the first
            pulse, after the last pulse, and at all times if no track was corrected.
        """
        residual_m, nodes = np.full((len(at), 3), np.nan), self.stage.attrs["nodes"]
        if self.correction is None or self.correction.extra_path_m or node not in nodes:
            return residual_m
        knots_s, at_s = self.correction.time_s, seconds_since(at, self.began)
        inside = (at_s >= knots_s[0]) & (at_s <= knots_s[-1])
        std_m = self.stage["std"].values[nodes.index(node)]
        residual_m[inside] = np.stack([np.interp(at_s[inside], knots_s, axis) for axis in std_m.T], axis=-1)
        return residual_m

    def _moved(self, correction: TrackCorrection, logged: OpenPair) -> tuple[Aperture, NDArray[np.float64]]:
        """Return the corrected phase centres of a pair, and the extra path of its echoes relative to the logs."""
        time_s = clock_s(logged, self.began)
        aperture = correction.aperture(logged.aperture, logged.name, time_s)
        return aperture, correction.longer_m(logged.name, time_s, logged.sidelink_m)


def open_refined(campaign: Campaign, flight: str) -> RefinedTrack:
    """Open the refined track of a flight."""
    return RefinedTrack.of(open_stage(campaign.stage("refined_track", flight), "refined_track"))


def expected_track(
    campaign: Campaign, pairs: Sequence[OpenPair], scene: OpenScene
) -> tuple[list[OpenPair], tuple[Decision, ...]]:
    """Return the pairs of a flight with refined tracks if they exist, and the decisions on the refinement.

    Before step `refine`, the pairs are those of the logs, regardless of the decision.
    """
    if campaign.is_current(campaign.stage("refined_track", pairs[0].flight)):
        track = open_refined(campaign, pairs[0].flight)
        return [track.pair(pair) for pair in pairs], track.decisions
    return list(pairs), autofocus_of(campaign, pairs, scene)


def clock_s(pair: OpenPair, began: np.datetime64) -> NDArray[np.float64]:
    """Return the times of a pair's pulses, (pulse,) float64 seconds since `began`."""
    return pair.time_s + float((pair.began - began) / np.timedelta64(1, "s"))


def _sizes_cm(correction: TrackCorrection, pair: str) -> dict[str, Any]:
    """Return the RMS correction of a pair: of its nodes, or of its path."""
    if pair in correction.extra_path_m:
        return {"extra_path_rms_cm": _rms_cm(correction.extra_path_m[pair][:, None])}
    nodes = dict.fromkeys(pair.split("-"))
    return {"rms_cm": {node: _rms_cm(correction.moved_m[node]) for node in nodes if node in correction.moved_m}}


def _rms_cm(moved_m: NDArray[np.float64]) -> float:
    return round(100 * float(np.sqrt((moved_m**2).sum(axis=-1).mean())), 2)


# ---- Inputs of the refinement: profiles of each pair, errors of the logs ---------------------------------------------


@dataclass(frozen=True, eq=False)
class RefinementInputs:
    """Inputs of the refinement of a flight's tracks.

    Attributes
    ----------
    records
        Record of each pair, on the flight's time scale.
    errors
        Node → error statistics of its log.
    points
        Reference points of the scene, with known positions.
    began
        Zero of the time scale, UTC.
    causes
        Configured constants that may be wrong.
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
        Campaign with its settings.
    pairs
        Every pair of the flight, from the logs, and its range profiles.
    scene
        Scene of the campaign.
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
    """Yield possible causes: terrain height; times of logs; lever arms of nodes with known attitude."""
    tracks = {
        node: (record.time_s, leg)
        for record in records
        for node, leg in zip(record.nodes, record.profiles.aperture.legs, strict=True)
    }
    yield other_height(list(tracks), records[0].time_s, up)
    logged = [node for node in tracks if campaign.logged(flight, node)]
    for node in logged:
        yield late_logs([node], tracks)
        time_s, _ = tracks[node]
        wave_m = 2 * np.pi / records[0].profiles.wavenumber_rad_m
        log = raw_log(campaign, flight, node, wave_m)
        if log.has_attitude:
            yield other_arm(node, time_s, log.body_axes(began + (1e9 * time_s).astype("timedelta64[ns]")))
    if len(logged) > 1:
        yield late_logs(logged, tracks)


def reference_points(campaign: Campaign) -> tuple[ReferencePoint, ...]:
    """Return the configured reference points, in the frame of the phase centres."""
    requested, points = campaign.settings.scene, []
    for point in requested.reference_points:
        x, y, z = frame_from_map(requested.crs, *point.position_m).tolist()
        points.append(ReferencePoint(point.name, (x, y, z), point.std_m))
    return tuple(points)


# ---- Rule `refine`: corrections of a flight's tracks from the images of all its pairs --------------------------------


def refine(campaign: Campaign, flight: str) -> Path:
    """Write results/<flight>/refined_track.zarr; without a correction, the stage contains the reason and no knots."""
    lineage = result_of(campaign, "refined_track", flight).begin(campaign.root)
    names, scene = campaign.flight(flight).pairs, open_scene(campaign)
    requested = campaign.settings.processing.autofocus
    pairs = [] if requested == "off" else [gated(campaign, open_pair(campaign, flight, pair), scene) for pair in names]
    decisions, folder = autofocus_of(campaign, pairs, scene), campaign.stage("refined_track", flight)
    if decisions[0].value == "on":
        stages = {pair: open_stage(campaign.stage("profile", flight, pair), "profile") for pair in names}
        profiles = {pair: profiles_of(stages[pair.name], lazy=True) for pair in pairs}
        inputs = refinement_inputs(campaign, profiles, scene)
        refinement = _estimated(inputs, scene, str(decisions[1].value))
        stage = refined_stage(refinement, decisions, inputs, scene)
    else:
        empty = {node: np.zeros((0, 3)) for pair in names for node in pair.split("-")}
        reason = "images are formed from the unchanged logs"
        refinement = Refinement(TrackCorrection(np.zeros(0), empty), empty, accepted=False, reason=reason)
        stages, stage = {}, refined_stage(refinement, decisions, None, scene)
    lines = [f"{decision.name} {decision.value}: {decision.reason}" for decision in decisions]
    print("; ".join([*lines, refinement.reason]), flush=True)
    patterns = [pattern_digests(campaign, pair) for pair in names]
    inherits: dict[str, Any] = {"parents": stages, "inputs": merged(scene.inputs, *patterns)}
    accepted = refinement.accepted
    settings = {**lineage.result.settings, "refined": accepted}
    # Without a correction, images depend only on their own echoes, not on the profiles read by this step.
    origin: dict[str, Any] = {"modules": lineage.modules, "settings": settings, **(inherits if accepted else {})}
    save_stage(stamped(stage, "refined_track", **origin), folder, lineage=lineage)
    return folder


def _estimated(inputs: RefinementInputs, scene: OpenScene, method: str) -> Refinement:
    """Return the refinement of tracks, or of one phase per pulse if there are enough patches to validate it."""
    records, errors = inputs.records, inputs.errors
    candidates = None if method == "tracks" else Candidates.of(records, scene.grid, scene.terrain, errors)
    if candidates is None or len(candidates.patches) < FOLDS:
        points, causes = inputs.points, inputs.causes
        return refine_tracks(records, scene.grid, scene.terrain, errors, reference_points=points, causes=causes)
    return refine_one_phase(records, candidates, errors, method=method)


def refined_stage(
    refinement: Refinement, decisions: Sequence[Decision], inputs: RefinementInputs | None, scene: OpenScene
) -> xr.Dataset:
    """Return stage `refined_track` without provenance.

    Parameters
    ----------
    refinement, decisions
        Refinement; decisions on it and on its method.
    inputs
        Inputs of the refinement; None if no refinement was attempted.
    scene
        Scene of the campaign.
    """
    correction = refinement.correction
    knots_s, nodes = correction.time_s, list(correction.moved_m)
    extra_path_m = correction.extra_path_m
    began = np.datetime64(0, "ns") if inputs is None else inputs.began.astype("datetime64[ns]")
    logged = _logged_positions(() if inputs is None else inputs.records, knots_s)
    moved_m, std_m = (np.stack([values[node] for node in nodes]) for values in (correction.moved_m, refinement.std_m))
    position_m = np.stack([logged.get(node, np.zeros((0, 3))) for node in nodes])
    by_node = ("node", "knot", "axis")
    report_names = {"loss_db": "left_db", "shift_m": "gauge_shift_m", "phase_rad": "left_rad"}
    has_residual = {*report_names.values()} <= refinement.report.keys()
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
            "flags": Flags(refinement.flags),
            "nodes": nodes,
            "pairs": list(extra_path_m),
            "decisions": {
                decision.name: {"value": decision.value, "reason": decision.reason} for decision in decisions
            },
            "accepted": refinement.accepted,
            "reason": refinement.reason,
            "report": dict(refinement.report),
            # effect of the residual errors, by the fields of `Effect`, if it is known
            "left": {effect: refinement.report[name] for effect, name in report_names.items() if has_residual},
        },
    )


def _logged_positions(
    records: Collection[PairRecord], knots_s: NDArray[np.float64]
) -> Mapping[str, NDArray[np.float64]]:
    """Return node → (knot, 3), radar phase centre from the log, in the first pair of the node."""
    positions: dict[str, NDArray[np.float64]] = {}
    for record in records:
        for node, leg in zip(record.nodes, record.profiles.aperture.legs, strict=True):
            at_knots = [np.interp(knots_s, record.time_s, axis) for axis in leg.T]
            positions.setdefault(node, np.stack(at_knots, axis=-1))
    return positions
