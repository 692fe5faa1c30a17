"""Refined tracks: whether a flight is refined, and which tracks its images take their antennas from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.arrays import Times
from apertura.core.backprojection.inputs import Profiles
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.phase_centres import TrackCorrection
from apertura.core.planning.decisions import decide_autofocus
from apertura.core.planning.plan import Decision
from apertura.core.quality.budget import NodePositions
from apertura.core.quality.path_errors import Effect
from apertura.methods.autofocus.inputs import TrackErrors
from apertura.methods.autofocus.one_phase import SpaceVariance, space_variance
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.opening.acquisition import Acquisition
from apertura.pipeline.opening.pair import OpenPair
from apertura.pipeline.opening.plan import paths_to, positions_loss_db
from apertura.pipeline.opening.scene import OpenScene
from apertura.pipeline.store import open_stage

# ---- Decision whether and how the tracks of a flight are refined ----------------------------------------------------

ASSUMED_STD_M = 0.02
"""Metres in each axis, assumed for positions of unstated error when a refinement is requested: a fair RTK solution."""

LEAST_STD_M = 1e-3
"""Metres, lower bound of a stated deviation: a prior of zero would fix the track."""

ONE_PHASE = "minimum_entropy"
"""Method of auto where one phase suffices: accepted at least as often as phase_gradient, at its cost."""


def autofocus_of(campaign: Campaign, pairs: Sequence[OpenPair], scene: OpenScene) -> tuple[Decision, ...]:
    """Return whether the tracks of a flight, of which these are all pairs, are to be refined; if so, how; and why."""
    requested = campaign.settings.processing
    silent = [node for node, known in positions_of(pairs).items() if known.std_m is None]
    loss_db = {pair.name: positions_loss_db(campaign, pair, scene) for pair in pairs}
    decision = decide_autofocus(requested.autofocus, loss_db, silent)
    if decision.value == "off":
        return (decision,)
    variances = {pair.name: _variance(pair, scene, errors_of(pairs)) for pair in pairs}
    known = bool(campaign.settings.scene.reference_points)
    return decision, decide_method(requested.autofocus_method, variances, known_points=known)


def decide_method(requested: str, variances: Mapping[str, SpaceVariance], *, known_points: bool) -> Decision:
    """Return how tracks are refined, and why.

    Parameters
    ----------
    requested
        auto, tracks, or a row of `apertura.methods.autofocus.one_phase.METHODS`.
    variances
        Pair → what one phase per pulse leaves of it.
    known_points
        Whether the scene has reference points: only the method tracks can use them.

    Examples
    --------
    >>> decide_method("auto", {"a-a": SpaceVariance(0.02, -0.001)}, known_points=False).value
    'minimum_entropy'
    >>> decide_method("auto", {"a-a": SpaceVariance(0.02, -0.001)}, known_points=True).value
    'tracks'
    """
    if requested != "auto":
        return Decision("autofocus_method", requested, "asked for")
    if known_points:
        return Decision("autofocus_method", "tracks", "auto: only tracks can be tied to scene.reference_points")
    pair, worst = min(variances.items(), key=lambda one: one[1].loss_db)
    value = ONE_PHASE if worst.method == "one_phase" else "tracks"
    return Decision("autofocus_method", value, f"auto: in {pair} {worst.reason}")


def positions_of(pairs: Sequence[OpenPair]) -> Mapping[str, NodePositions]:
    """Return node → what is known of the errors of its log; it is the same in each pair."""
    return {
        node: known
        for pair in pairs
        for node, known in zip(dict.fromkeys(pair.name.split("-")), pair.positions, strict=True)
    }


def errors_of(pairs: Sequence[OpenPair]) -> Mapping[str, TrackErrors]:
    """Return node → the errors that its log is taken to have."""
    return {
        node: TrackErrors(_stated(known), known.correlation_s, known.drift_m)
        for node, known in positions_of(pairs).items()
    }


def _variance(pair: OpenPair, scene: OpenScene, errors: Mapping[str, TrackErrors]) -> SpaceVariance:
    """Return what one phase per pulse leaves at the corners of the scene."""
    last_row, last_column = (size - 1 for size in scene.grid.shape)
    rows, columns = np.array([0, 0, last_row, last_row]), np.array([0, last_column, 0, last_column])
    corners_m = scene.terrain.positions_at(scene.grid, rows, columns)
    of_nodes = [errors[node] for node in dict.fromkeys(pair.name.split("-"))]
    return space_variance(paths_to(pair, scene, scene.middle_m), corners_m, of_nodes)


def _stated(known: NodePositions) -> tuple[float, float, float]:
    """Return the errors of a node's log, east, north, up."""
    east, north, up = (max(one, LEAST_STD_M) for one in known.std_m or (ASSUMED_STD_M,) * 3)
    return east, north, up


# ---- Refined tracks, from which images take their phase centres -----------------------------------------------------

_QUOTED = ("gain_fitted_db", "gain_held_out_db", "gain_std_db")


@dataclass(frozen=True, eq=False)
class RefinedTrack:
    """Outcome of step `refine` for a flight.

    Attributes
    ----------
    stage
        `refined_track`, from which images inherit.
    correction
        Of the flight's nodes and pairs, seconds from `began`; None where images are formed from the logs as they are.
    began
        Zero of the correction's clock, UTC.
    """

    stage: xr.Dataset
    correction: TrackCorrection | None
    began: np.datetime64

    @classmethod
    def of(cls, stage: xr.Dataset) -> "RefinedTrack":
        """Return the outcome stored in a stage."""
        time, nodes = stage.time.values, stage.attrs["nodes"]
        if not stage.attrs["accepted"] or not len(time):
            return cls(stage, None, np.datetime64(0, "ns"))
        moved_m = dict(zip(nodes, stage.correction.values, strict=True))
        further_m = dict(zip(stage.attrs["pairs"], stage.further.values, strict=True))
        return cls(stage, TrackCorrection(_seconds(time - time[0]), moved_m, further_m), time[0])

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """Whether tracks were to be refined, why, and what became of it; if so, how."""
        became = {"autofocus": f"; {self.stage.attrs['why']}"}
        made = self.stage.attrs["decisions"].items()
        return tuple(Decision(name, one["value"], one["reason"] + became.get(name, "")) for name, one in made)

    def report(self, pair: str) -> dict[str, Any]:
        """Return the refinement of a pair's tracks for image.json."""
        attrs = self.stage.attrs
        made = {name: f"{one['value']}: {one['reason']}" for name, one in attrs["decisions"].items()}
        return {
            "decision": made["autofocus"],
            **({"method": made["autofocus_method"]} if "autofocus_method" in made else {}),
            "accepted": attrs["accepted"],
            "why": attrs["why"],
            **{name: attrs["report"][name] for name in _QUOTED if name in attrs["report"]},
            **({} if self.correction is None else _sizes_cm(self.correction, pair)),
        }

    def pair(self, logged: OpenPair) -> OpenPair:
        """Return an open pair as images are formed from it; its errors are those that the refinement leaves."""
        if self.correction is None:
            return logged
        aperture, further_m = self._moved(self.correction, logged)
        history = None if logged.history is None else logged.history.moved(aperture, further_m)
        left = self.stage.attrs["left"]
        return replace(logged, aperture=aperture, history=history, left=Effect(**left) if left else None)

    def profiles(self, logged: OpenPair, profiles: Profiles) -> Profiles:
        """Return the range profiles of a pair as images are formed from them."""
        return profiles if self.correction is None else profiles.moved(*self._moved(self.correction, logged))

    def node(self, logged: Acquisition) -> Acquisition:
        """Return a node with its log corrected."""
        if self.correction is None:
            return logged
        moved_m = self.moved_m(logged.name, logged.track.time.values)
        return replace(logged, track=logged.track.assign(position=logged.track.position + moved_m))

    def moved_m(self, node: str, at: Times) -> NDArray[np.float64]:
        """Return what is added to the logged points of a node at some times, (time, 3) float64 metres in the frame.

        Before the first pulse and after the last it stays what it was there.
        """
        if self.correction is None:
            return np.zeros((len(at), 3))
        return self.correction.at(node, _seconds(at - self.began))

    def left_m(self, node: str, at: Times) -> NDArray[np.float64]:
        """Return the standard deviation of what the refinement leaves of a node's error, along the axes of the frame.

        Returns
        -------
        ndarray
            (time, 3) float64, metres; NaN where the images say nothing of the node: before the first pulse, after the
            last, and everywhere if no track was moved.
        """
        left_m, nodes = np.full((len(at), 3), np.nan), self.stage.attrs["nodes"]
        if self.correction is None or self.correction.further_m or node not in nodes:
            return left_m
        knots_s, at_s = self.correction.time_s, _seconds(at - self.began)
        inside = (at_s >= knots_s[0]) & (at_s <= knots_s[-1])
        std_m = self.stage["std"].values[nodes.index(node)]
        left_m[inside] = np.stack([np.interp(at_s[inside], knots_s, axis) for axis in std_m.T], axis=-1)
        return left_m

    def _moved(self, correction: TrackCorrection, logged: OpenPair) -> tuple[Aperture, NDArray[np.float64]]:
        """Return the phase centres of a pair, and by how much paths of its echoes are longer than with the logs."""
        time_s = clock_s(logged, self.began)
        aperture = correction.aperture(logged.aperture, logged.name, time_s)
        return aperture, correction.longer_m(logged.name, time_s, logged.sidelink_m)


def open_refined(campaign: Campaign, flight: str) -> RefinedTrack:
    """Return what step `refine` wrote of a flight."""
    return RefinedTrack.of(open_stage(campaign.stage("refined_track", flight), "refined_track"))


def expected_track(
    campaign: Campaign, pairs: Sequence[OpenPair], scene: OpenScene
) -> tuple[list[OpenPair], tuple[Decision, ...]]:
    """Return the pairs of a flight as they are or will be imaged; whether and how their tracks are refined, and why.

    Before step `refine` ran, the pairs are those of the logs, whatever was decided.
    """
    if campaign.is_current(campaign.stage("refined_track", pairs[0].flight)):
        track = open_refined(campaign, pairs[0].flight)
        return [track.pair(pair) for pair in pairs], track.decisions
    return list(pairs), autofocus_of(campaign, pairs, scene)


def clock_s(pair: OpenPair, began: np.datetime64) -> NDArray[np.float64]:
    """Return the times of a pair's pulses, (pulse,) float64 seconds from an instant."""
    return pair.time_s + float(_seconds(pair.began - began))


def _sizes_cm(correction: TrackCorrection, pair: str) -> dict[str, Any]:
    """Return how far the nodes of a pair were moved, or by how much its echoes lie further, rms."""
    if pair in correction.further_m:
        return {"further_rms_cm": _rms_cm(correction.further_m[pair][:, None])}
    nodes = dict.fromkeys(pair.split("-"))
    return {"rms_cm": {node: _rms_cm(correction.moved_m[node]) for node in nodes if node in correction.moved_m}}


def _rms_cm(moved_m: NDArray[np.float64]) -> float:
    return round(100 * float(np.sqrt((moved_m**2).sum(axis=-1).mean())), 2)


def _seconds(span: Any) -> Any:
    return span / np.timedelta64(1, "s")
