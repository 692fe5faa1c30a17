"""What may be wrong with a flight, as geometries to try: each hypothesis with the echoes as they would be then."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.arrays import Times
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.range_profiles import aperture_of, phase_history_of
from apertura.stages.acquisition import Acquisition

# ---- Hypotheses of what is wrong with a flight, each with its echoes ------------------------------------------------

MOST_PULSES = 512
"""Pulses of a pair on which hypotheses are tried, evenly spread."""

_SHIFTS_S = (18.0, 37.0, 19.0, 17.0, 5.0, 3.0, 2.0, 1.0, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05)
_UNDULATION_M = 10.0  # from here on heights above a geoid may have been taken for ellipsoidal ones, or the reverse
_HEIGHTS_M = (50.0, 47.0, 20.0, 10.0, 5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.0, 0.5)
_PREFIX_SAMPLES = (1, 2, 3, 5, 10, 20, 50)
_TIME_SYSTEMS = {
    18.0: ": GPST taken for UTC?",
    -18.0: ": UTC taken for GPST?",
    37.0: ": TAI taken for UTC?",
    19.0: ": TAI taken for GPST?",
}
_RANGES_M = (0.05, 0.1, 0.15, 0.3, 0.5, 1.0, 2.0, 4.0)
CHANCES = 48
"""Wrong tracks drawn at random; a third each is offset, inclined and bent."""

_CHANCE_M, _CHANCE_PERIODS = (0.03, 2.0), (0.25, 1.5)  # sizes, as those of hypotheses; over the aperture
_AXES = ("forward", "right", "down")
_POINTS = ("radar_tx", "radar_rx", "sidelink")


@dataclass(frozen=True, eq=False)
class PairGeometry:
    """The echo of a pair with what its geometry was made from.

    Attributes
    ----------
    pair
        Its name.
    history
        Of some of its pulses.
    time
        (pulse,) datetime64[ns], their tags.
    sidelink_m
        (pulse,) float64, length of the sidelink that was put into the echo, metres; 0 without.
    """

    pair: str
    history: PhaseHistory
    time: Times
    sidelink_m: NDArray[np.float64]


@dataclass(frozen=True)
class Hypothesis:
    """One possible error of the campaign.

    Attributes
    ----------
    what
        Line for the reader: 'the times of the log of uav1 are 18.00 s late: GPST taken for UTC?'.
    kind
        Short name of its kind.
    histories
        Echoes of the flight's pairs if it is true.
    height_m
        Rise of the ground, metres.
    """

    what: str
    kind: str
    histories: tuple[PhaseHistory, ...]
    height_m: float = 0.0


def evidence_of(nodes: Mapping[str, Acquisition], pair: str, echo: xr.Dataset, window: str) -> PairGeometry:
    """Return the echo of a pair, weighted by a window, with its geometry; give it `some_pulses`."""
    tx, rx = (nodes[name] for name in pair.split("-"))
    time = echo.time.values
    return PairGeometry(pair, phase_history_of(echo, window), time, _sidelink_m(tx, rx, time))


def moved_evidence(nodes: Mapping[str, Acquisition], found: Sequence[PairGeometry]) -> list[PairGeometry]:
    """Return the same echoes with antennas and sidelink lengths from other logs of their nodes."""
    moved = []
    for one, history in zip(found, _flown(nodes, found), strict=True):
        tx, rx = (nodes[name] for name in one.pair.split("-"))
        moved.append(replace(one, history=history, sidelink_m=_sidelink_m(tx, rx, one.time)))
    return moved


def some_pulses(echo: xr.Dataset) -> slice:
    """Return the pulses of an echo on which hypotheses are tried."""
    return aperture_of(echo).sample(MOST_PULSES)


def hypotheses_of(nodes: Mapping[str, Acquisition], found: Sequence[PairGeometry]) -> Iterator[Hypothesis]:
    """Yield all hypotheses on a flight, the likeliest first; those that its logs do not cover are left out.

    Parameters
    ----------
    nodes
        Every node of the flight.
    found
        The echo of each pair.

    Notes
    -----
    Source: docs/theory/focus.md, "Hypotheses".
    """
    yield from _shifted_logs(nodes, found)
    yield from _other_arms(nodes, found)
    yield from _swapped_tracks(nodes, found)
    for height_m in (sign * size for size in _HEIGHTS_M for sign in (1, -1)):
        what = f"the ground lies {abs(height_m):.1f} m {'above' if height_m > 0 else 'below'} where the config has it"
        what += ": another vertical datum?" if abs(height_m) >= _UNDULATION_M else ""
        yield Hypothesis(what, "height", tuple(one.history for one in found), height_m)
    yield from _longer_paths(nodes, found)


def hypotheses_by_chance(
    nodes: Mapping[str, Acquisition], found: Sequence[PairGeometry], generator: np.random.Generator
) -> Iterator[Hypothesis]:
    """Yield smooth wrong tracks of one or two unknowns that are drawn: what explains no better than they do is chance.

    Parameters
    ----------
    nodes, found
        As `hypotheses_of`.
    generator
        Draws node, direction, size, and whether the track is offset, inclined or bent.

    Notes
    -----
    Source: docs/theory/focus.md, "Hypotheses".
    """
    for number in range(CHANCES):
        size_m = float(np.exp(generator.uniform(*np.log(_CHANCE_M))))
        direction = generator.standard_normal(3)
        error_m = size_m * direction / np.linalg.norm(direction)
        name = list(nodes)[generator.integers(len(nodes))]
        periods, phase = generator.uniform(*_CHANCE_PERIODS), generator.uniform(0, 2 * np.pi)
        histories = []
        for one in found:
            along = np.linspace(0, 1, len(one.time))
            shape = (np.ones_like(along), 2 * along - 1, np.sin(2 * np.pi * periods * along + phase))[number % 3]
            sent, received = (float(node == name) * shape[:, None] * error_m for node in one.pair.split("-"))
            aperture = one.history.aperture
            moved = replace(one.history, aperture=Aperture(aperture.tx_m + sent, aperture.rx_m + received))
            apart = aperture.tx_m - aperture.rx_m
            longer_m = np.linalg.norm(apart + sent - received, axis=1) - np.linalg.norm(apart, axis=1)
            histories.append(_delayed(moved, longer_m) if one.sidelink_m.any() else moved)
        yield Hypothesis(f"the log of {name} errs by {size_m:.2f} m", "chance", tuple(histories))


def _shifted_logs(nodes: Mapping[str, Acquisition], found: Sequence[PairGeometry]) -> Iterator[Hypothesis]:
    groups = [*((name,) for name in nodes), *([tuple(nodes)] if len(nodes) > 1 else [])]
    for shift_s in (sign * size for size in _SHIFTS_S for sign in (-1, 1)):
        for group in groups:
            who = f"the log of {group[0]}" if len(group) == 1 else "all logs"
            late = f"{abs(shift_s):.2f} s {'late' if shift_s > 0 else 'early'}{_TIME_SYSTEMS.get(shift_s, '')}"
            histories = _flown(nodes, found, shift_s=dict.fromkeys(group, shift_s))
            if histories:
                yield Hypothesis(f"the times of {who} are {late}", "time", histories)


def _other_arms(nodes: Mapping[str, Acquisition], found: Sequence[PairGeometry]) -> Iterator[Hypothesis]:
    for name, node in nodes.items():
        arms = {point: np.array(getattr(node.settings.lever_arms_m, point)) for point in _POINTS}
        if not any(arm.any() for arm in arms.values()):
            continue
        for axis, word in enumerate(_AXES):
            flip = np.where(np.arange(3) == axis, -1.0, 1.0)
            if any(arm[axis] for arm in arms.values()):
                turned = {point: tuple(arm * flip) for point, arm in arms.items()}
                histories = _flown({**nodes, name: _with_arms(node, turned)}, found)
                if histories:
                    yield Hypothesis(
                        f"{word} axis of the lever arms of {name} has the other sign", "lever arm", histories
                    )


def _with_arms(node: Acquisition, arms: Mapping[str, tuple[float, ...]]) -> Acquisition:
    lever_arms = node.settings.lever_arms_m.model_copy(update=dict(arms))
    return replace(node, settings=node.settings.model_copy(update={"lever_arms_m": lever_arms}))


def _swapped_tracks(nodes: Mapping[str, Acquisition], found: Sequence[PairGeometry]) -> Iterator[Hypothesis]:
    names = list(nodes)
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            swapped = {
                **nodes,
                first: _placed(nodes[first], nodes[second]),
                second: _placed(nodes[second], nodes[first]),
            }
            histories = _flown(swapped, found)
            if histories:
                yield Hypothesis(f"the tracks of {first} and {second} are swapped", "tracks swapped", histories)


def _placed(node: Acquisition, other: Acquisition) -> Acquisition:
    """Return a node at the positions of another, with its own attitude."""
    at = node.log_seconds(other.track.time.values)
    own = node.log_seconds(node.track.time.values)
    turned = np.unwrap(node.track.attitude.values, axis=0)
    attitude = np.stack([np.interp(at, own, angle) for angle in turned.T], axis=-1)
    return replace(node, track=other.track.assign(attitude=(("epoch", "axis"), attitude)))


def _longer_paths(nodes: Mapping[str, Acquisition], found: Sequence[PairGeometry]) -> Iterator[Hypothesis]:
    for place, one in enumerate(found):
        tx, rx = one.pair.split("-")
        cell_m = SPEED_OF_LIGHT_M_S / nodes[tx].numerology.sample_rate_hz
        samples = [(count * cell_m, f"{count:+d} samples") for size in _PREFIX_SAMPLES for count in (size, -size)]
        ranges = [(sign * size, "") for size in _RANGES_M for sign in (1, -1)]
        for path_m, count in (*(samples if tx == rx else ()), *ranges):
            what = f"paths of {one.pair} are {path_m:+.2f} m off"
            begin = "the prefix" if nodes[tx].numerology.prefix_samples else "where waveform.lead_s says"
            what = f"{what}: captures begin {count} from {begin}?" if count else f"{what}: a path offset?"
            histories = [other.history for other in found]
            histories[place] = _delayed(one.history, -path_m)
            yield Hypothesis(what, "prefix" if count else "range", tuple(histories))


def _flown(
    nodes: Mapping[str, Acquisition], found: Sequence[PairGeometry], *, shift_s: Mapping[str, float] | None = None
) -> tuple[PhaseHistory, ...]:
    """Return the echoes with antennas where other logs, arms or times put them; nothing where a log does not reach."""
    histories = []
    for one in found:
        tx, rx = (nodes[name] for name in one.pair.split("-"))
        at = [one.time + _span((shift_s or {}).get(node.name, 0.0)) for node in (tx, rx)]
        try:
            aperture = Aperture(tx.antenna("radar_tx", at[0]), rx.antenna("radar_rx", at[1]))
            length_m = _sidelink_m(tx, rx, *at)
        except CampaignError:
            return ()
        moved = replace(one.history, aperture=aperture)
        histories.append(_delayed(moved, length_m - one.sidelink_m))
    return tuple(histories)


def _sidelink_m(tx: Acquisition, rx: Acquisition, tx_at: Times, rx_at: Times | None = None) -> NDArray[np.float64]:
    if tx.name == rx.name:
        return np.zeros(len(tx_at))
    ends = tx.antenna("sidelink", tx_at), rx.antenna("sidelink", tx_at if rx_at is None else rx_at)
    return np.asarray(np.linalg.norm(ends[0] - ends[1], axis=1))


def _delayed(history: PhaseHistory, path_m: Any) -> PhaseHistory:
    """Return an echo over paths that are longer by `path_m`."""
    return replace(history, reference_delay_s=history.reference_delay_s + path_m / history.wave_speed_m_s)


def _span(seconds: float) -> np.timedelta64:
    return np.timedelta64(round(seconds * 1e9), "ns")


# ---- Which hypothesis explains what was lost -------------------------------------------------------------------------

LEAST_GAIN_DB = 0.5
"""Least gain of the measure at which a hypothesis is named."""

LEAST_SHARE = 0.7
"""Of the dB lost that a hypothesis must bring back to be named: most of it."""

LEAST_AGAINST_NEXT = 2.0
"""Its gain over that of the best other cause, and of the best wrong track drawn at random, dB over dB."""

CLEAR_DB = 10.0
"""dB by which a gain exceeds another beyond doubt, however large both are."""


@dataclass(frozen=True)
class Trial:
    """A hypothesis that was tried.

    Attributes
    ----------
    gain_db
        Of the joint peak power at the bright place.
    hypothesis
        What was tried.
    offset
        It changes the path of each pair by a constant alone, beside moving the point.
    """

    gain_db: float
    hypothesis: Hypothesis
    offset: bool

    @property
    def cause(self) -> str:
        """Kinds that are one cause: a path longer by samples of the prefix or by an offset is the same."""
        return "range" if self.hypothesis.kind == "prefix" else self.hypothesis.kind


def explanation(trials: Sequence[Trial], drawn: Sequence[Trial], lost_db: float) -> list[dict[str, Any]]:
    """Return the report of the trial that alone explains most of what was lost, or that an offset does; else nothing.

    Parameters
    ----------
    trials, drawn
        Of hypotheses, and of wrong tracks drawn at random.
    lost_db
        What there is to gain.

    Notes
    -----
    Source: docs/theory/focus.md, "Hypotheses".

    Examples
    --------
    >>> late, arm = (Hypothesis(kind, kind, ()) for kind in ("time", "lever arm"))
    >>> [one["kind"] for one in explanation([Trial(6.0, late, False), Trial(2.0, arm, True)], [], 7.0)]
    ['time']
    >>> explanation([Trial(6.0, late, False), Trial(4.0, arm, True)], [], 7.0)
    []
    """
    best = max(trials, key=lambda one: one.gain_db, default=None)
    if best is None or best.gain_db < max(LEAST_GAIN_DB, LEAST_SHARE * lost_db):
        return []
    others = [*(one for one in trials if one.cause != best.cause), *drawn]
    rivals = [one for one in others if one.gain_db > max(best.gain_db / LEAST_AGAINST_NEXT, best.gain_db - CLEAR_DB)]
    if any(not (one.offset and best.offset) for one in rivals):
        return []
    what = best.hypothesis.what
    if rivals:  # a constant of each pair does it, whatever made it: a path, an arm, a log, a phase
        what = f"pairs are off by a constant: of a path, an arm, a phase, a log's place or time, such as: {what}"
        heights = [one for one in rivals if isinstance(one, Trial) and one.hypothesis.kind == "height"]
        if heights:  # along a straight track a height does nearly the same
            what += f"; or {max(heights, key=lambda one: one.gain_db).hypothesis.what}"
    report = {"what": what, "kind": "offset" if rivals else best.hypothesis.kind}
    return [report | {"gain_db": round(best.gain_db, 2), "lost_db": round(max(lost_db, best.gain_db), 2)}]
