"""Whether and how the tracks of an open flight are refined, before anything is looked for."""

from collections.abc import Mapping, Sequence

import numpy as np

from apertura.core.planning.autofocus import decide_autofocus
from apertura.core.planning.plan import Decision
from apertura.core.quality.budget import NodePositions
from apertura.methods.autofocus.inputs import TrackErrors
from apertura.methods.autofocus.space_variance import SpaceVariance, space_variance
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.opening.budget import paths_to_middle, positions_loss_db
from apertura.pipeline.opening.pair import OpenPair
from apertura.pipeline.opening.scene import OpenScene

ASSUMED_STD_M = 0.02
"""Error of positions in each axis where a refinement is asked for and nobody said: that of a fair RTK solution."""

LEAST_STD_M = 1e-3
"""Of what a log or config states as exact."""

ONE_PHASE = "minimum_entropy"
"""What auto takes where one phase suffices: at the cost of the phase gradient it is believed at least as often."""


def autofocus_of(campaign: Campaign, pairs: Sequence[OpenPair], scene: OpenScene) -> tuple[Decision, ...]:
    """Return whether the tracks of a flight, of which these are all pairs, are to be refined; if so, how; and why."""
    asked = campaign.settings.processing
    silent = [node for node, known in positions_of(pairs).items() if known.std_m is None]
    loss_db = {pair.name: positions_loss_db(campaign, pair, scene) for pair in pairs}
    decision = decide_autofocus(asked.autofocus, loss_db, silent)
    if decision.value == "off":
        return (decision,)
    variances = {pair.name: _variance(pair, scene, errors_of(pairs)) for pair in pairs}
    known = bool(campaign.settings.scene.reference_points)
    return decision, decide_method(asked.autofocus_method, variances, known_points=known)


def decide_method(asked: str, variances: Mapping[str, SpaceVariance], *, known_points: bool) -> Decision:
    """Return how tracks are refined, and why.

    Parameters
    ----------
    asked
        auto, tracks, or a row of `apertura.methods.autofocus.one_phase.METHODS`.
    variances
        Pair → what one phase per pulse leaves of it.
    known_points
        Whether the scene has points whose places are known: only tracks can be tied to them.

    Examples
    --------
    >>> decide_method("auto", {"a-a": SpaceVariance(0.02, -0.001)}, known_points=False).value
    'minimum_entropy'
    >>> decide_method("auto", {"a-a": SpaceVariance(0.02, -0.001)}, known_points=True).value
    'tracks'
    """
    if asked != "auto":
        return Decision("autofocus_method", asked, "asked for")
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
    return space_variance(paths_to_middle(pair, scene), corners_m, of_nodes)


def _stated(known: NodePositions) -> tuple[float, float, float]:
    """Return the errors of a node's log, east, north, up."""
    east, north, up = (max(one, LEAST_STD_M) for one in known.std_m or (ASSUMED_STD_M,) * 3)
    return east, north, up
