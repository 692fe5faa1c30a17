"""Tracks as refined: where images take the places of their antennas from, and the only place where that is decided."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.focus.inputs import Profiles
from apertura.geometry.aperture import Aperture
from apertura.geometry.track_correction import TrackCorrection
from apertura.load.acquisition import Acquisition
from apertura.load.budget import positions_loss_db
from apertura.load.pair import OpenPair
from apertura.load.scene import OpenScene
from apertura.planning.autofocus import decide_autofocus
from apertura.planning.plan import Decision
from apertura.quality.budget import NodePositions
from apertura.quality.path_errors import Effect
from apertura.store import manifest_of, open_stage

_QUOTED = ("gain_fitted_db", "gain_held_out_db", "held_out_better")


@dataclass(frozen=True, eq=False)
class RefinedTrack:
    """What step `refine` found of a flight.

    Attributes
    ----------
    stage
        `refined_track`, from which images inherit.
    correction
        Of the flight's nodes, seconds from `began`; None where images are formed from the logs as they are.
    began
        Zero of the correction's clock, UTC.
    """

    stage: xr.Dataset
    correction: TrackCorrection | None
    began: np.datetime64

    @classmethod
    def of(cls, stage: xr.Dataset) -> "RefinedTrack":
        """Return what a stage says."""
        time, nodes = stage.time.values, stage.attrs["nodes"]
        if not stage.attrs["accepted"] or not len(time):
            return cls(stage, None, np.datetime64(0, "ns"))
        moved_m = dict(zip(nodes, stage.correction.values, strict=True))
        return cls(stage, TrackCorrection(_seconds(time - time[0]), moved_m), time[0])

    @property
    def decision(self) -> Decision:
        """Whether tracks were to be refined, why, and what became of it."""
        made = self.stage.attrs["decision"]
        return Decision("autofocus", made["value"], f"{made['reason']}; {self.stage.attrs['why']}")

    def report(self, pair: str) -> dict[str, Any]:
        """Return what image.json says of a pair's tracks."""
        told = self.stage.attrs
        moved = {} if self.correction is None else self.correction.moved_m
        rms_cm = {node: _rms_cm(moved[node]) for node in dict.fromkeys(pair.split("-")) if node in moved}
        return {
            "decision": f"{told['decision']['value']}: {told['decision']['reason']}",
            "accepted": told["accepted"],
            "why": told["why"],
            **{name: told["report"][name] for name in _QUOTED if name in told["report"]},
            **({"rms_cm": rms_cm} if rms_cm else {}),
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
        moved_m = self.correction.at(logged.name, _seconds(logged.track.time.values - self.began))
        return replace(logged, track=logged.track.assign(position=logged.track.position + moved_m))

    def _moved(self, correction: TrackCorrection, logged: OpenPair) -> tuple[Aperture, NDArray[np.float64]]:
        """Return the phase centres of a pair, and by how much paths of its echoes are longer than with the logs."""
        time_s = clock_s(logged, self.began)
        aperture = correction.aperture(logged.aperture, logged.name, time_s)
        if logged.sidelink_m is None:
            return aperture, np.zeros(len(time_s))
        return aperture, correction.sidelink_m(logged.sidelink_m, logged.name, time_s)


def open_refined(campaign: Campaign, flight: str) -> RefinedTrack:
    """Return what step `refine` wrote of a flight."""
    return RefinedTrack.of(open_stage(campaign.stage("refined_track", flight), "refined_track"))


def expected_track(campaign: Campaign, pairs: Sequence[OpenPair], scene: OpenScene) -> tuple[list[OpenPair], Decision]:
    """Return the pairs of a flight as they are or will be imaged, and whether their tracks are refined, and why.

    Before step `refine` ran, the pairs are those of the logs, whatever was decided.
    """
    if manifest_of(campaign.stage("refined_track", pairs[0].flight)).is_file():
        track = open_refined(campaign, pairs[0].flight)
        return [track.pair(pair) for pair in pairs], track.decision
    return list(pairs), autofocus_of(campaign, pairs, scene)


def autofocus_of(campaign: Campaign, pairs: Sequence[OpenPair], scene: OpenScene) -> Decision:
    """Return whether the tracks of a flight, of which these are all pairs, are to be refined, and why."""
    silent = [node for node, known in positions_of(pairs).items() if known.std_m is None]
    loss_db = {pair.name: positions_loss_db(campaign, pair, scene) for pair in pairs}
    return decide_autofocus(campaign.settings.processing.autofocus, loss_db, silent)


def positions_of(pairs: Sequence[OpenPair]) -> Mapping[str, NodePositions]:
    """Return node → what is known of the errors of its log; it is the same in each pair."""
    return {
        node: known
        for pair in pairs
        for node, known in zip(dict.fromkeys(pair.name.split("-")), pair.positions, strict=True)
    }


def clock_s(pair: OpenPair, began: np.datetime64) -> NDArray[np.float64]:
    """Return the times of a pair's pulses, (pulse,) float64 seconds from an instant."""
    return pair.time_s + float(_seconds(pair.began - began))


def _rms_cm(moved_m: NDArray[np.float64]) -> float:
    return round(100 * float(np.sqrt((moved_m**2).sum(axis=-1).mean())), 2)


def _seconds(span: Any) -> Any:
    return span / np.timedelta64(1, "s")
