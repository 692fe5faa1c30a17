"""Hypotheses of what is wrong with a flight, each tried on a bright place, and the one that explains what was lost.

Source: docs/theory/focus.md, "Hypotheses".
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import OfdmWaveform, SampledWaveform
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Times
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.units import decibels
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.compression import centre_frequency
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.imaging.focus_check import joint_peak_power, strongest_echo
from apertura.core.imaging.range_profiles import aperture_of, phase_history_of
from apertura.core.scene.grid import SceneGrid
from apertura.methods import causes
from apertura.stages.acquisition import Acquisition, open_acquisition
from apertura.stages.calibration import calibrated
from apertura.stages.echo import pair_echo
from apertura.stages.positions import scene_air
from apertura.stages.refine import open_refined
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.transfer import PairEcho
from apertura.stages.transmitted import Transmitted, transmitted

MOST_PULSES = 512
"""Pulses of a pair on which hypotheses are tried, evenly spread."""

CHANCES = 48
"""Wrong tracks drawn at random; a third each is offset, inclined and bent."""

_CHANCE_M, _CHANCE_PERIODS = (0.03, 2.0), (0.25, 1.5)  # sizes, as those of hypotheses; over the aperture
_AXES = ("forward", "right", "down")
_POINTS = ("radar_tx", "radar_rx", "sidelink")

_ALIKE_RAD = 0.5
"""RMS phase over the aperture, beside a constant and a shift of the point, below which paths differ by an offset."""

_SIDE_PX = 128
_PIXELS_PER_CELL = 2.5


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
    gain_db
        Of the joint peak power at the bright place, where the hypothesis was tried.
    is_offset
        Whether it changes the path of each pair by a constant alone, beside moving the point.
    """

    what: str
    kind: str
    histories: tuple[PhaseHistory, ...]
    height_m: float = 0.0
    gain_db: float = np.nan
    is_offset: bool = False


# ---- Hypotheses tried on a bright place -----------------------------------------------------------------------------


def hypotheses(
    campaign: Campaign,
    flight: str,
    *,
    brightest: tuple[float, float],
    cell_m: float,
    focused: Collection[str] = (),
) -> list[dict[str, Any]]:
    """Return the hypothesis that explains most of what the images of a flight lost, alone; none where several could.

    Parameters
    ----------
    campaign, flight
        Which.
    brightest
        Easting and northing of a bright place in the scene's CRS, metres.
    cell_m
        Resolution cell.
    focused
        Pairs whose own image is sharp: they have lost nothing but their agreement.

    Returns
    -------
    list
        what, kind, gain_db and lost_db: gain of the peak power at the bright place, and what there is to gain; and
        pair_gain_db, of each pair's own peak.
    """
    waveform = campaign.settings.waveform
    if not isinstance(waveform, SampledWaveform):  # positions travel with a phase history: there are no logs to doubt
        return []
    sent = transmitted(campaign, waveform)
    logged = {node: open_acquisition(campaign, flight, node, sent) for node in campaign.flight(flight).nodes}
    window, track = campaign.settings.processing.window, open_refined(campaign, flight)
    found = [
        evidence_of(logged, pair, PairEcho.cleaned(campaign, flight, pair).stage, window)
        for pair in campaign.flight(flight).pairs
    ]
    nodes = {name: track.node(node) for name, node in logged.items()}
    if track.correction is not None:
        found = flown(nodes, found)
    scene = open_scene(campaign)
    here, height_m = _around(scene, brightest, cell_m), scene.level.height_m
    now = joint_peak_power([one.history for one in found], here, height_m)
    lost_db = decibels(_possible(found, here, height_m, focused) / now)

    def tried(possible: Iterator[Hypothesis]) -> Iterator[Hypothesis]:
        for one in possible:
            place = _moved(scene, brightest, found, one)
            try:
                peak = joint_peak_power(one.histories, _around(scene, place, cell_m), height_m + one.height_m)
            except ValueError:  # the places are too far apart for one pulse: rejected
                continue
            is_offset = _is_offset(scene, (brightest, place), found, one)
            yield replace(one, gain_db=decibels(peak / now), is_offset=is_offset)

    trials = [
        *tried(_other_geometries(nodes, found)),
        *tried(_other_echoes(campaign, flight, nodes, found, sent=sent)),
    ]
    named = explanation(trials, [*tried(_by_chance(nodes, found, np.random.default_rng(0)))], lost_db)
    if named:
        best = max(trials, key=lambda one: one.gain_db)
        there, there_m = _around(scene, _moved(scene, brightest, found, best), cell_m), height_m + best.height_m
        named[0]["pair_gain_db"] = {
            one.pair: round(
                decibels(joint_peak_power([after], there, there_m) / joint_peak_power([one.history], here, height_m)), 2
            )
            for one, after in zip(found, best.histories, strict=True)
        }
    return named


def _possible(found: Sequence[PairGeometry], grid: SceneGrid, height_m: float, focused: Collection[str]) -> float:
    """Return the joint peak power if every pair were sharp at one place and in phase.

    A pair that is sharp by itself has its own peak, another one the strongest echo in its pulses.
    """
    amplitudes = np.array(
        [
            np.sqrt(joint_peak_power([one.history], grid, height_m))
            if one.pair in focused
            else strongest_echo(one.history, grid, height_m)
            for one in found
        ]
    )
    return float((amplitudes**2).mean() + amplitudes.mean() ** 2) / 2


def _is_offset(
    scene: OpenScene,
    places: tuple[tuple[float, float], tuple[float, float]],
    found: Sequence[PairGeometry],
    hypothesis: Hypothesis,
) -> bool:
    """Return whether a hypothesis changes paths by a constant for each pair, beside moving the bright place.

    Source: docs/theory/focus.md, eq. 2.
    """
    here_m, there_m = (_ground(scene, place) for place in places)
    there_m = there_m + hypothesis.height_m * np.cross(*scene.axes[:2])
    for before, after in zip((one.history for one in found), hypothesis.histories, strict=True):
        if len(before) != len(after):
            return False
        longer_m = (after.aperture.path(there_m[None]) - before.aperture.path(here_m[None]))[:, 0]
        longer_m -= before.wave_speed_m_s * (after.reference_delay_s - before.reference_delay_s)
        moves = np.column_stack([np.ones(len(longer_m)), before.aperture.path_gradient(here_m) @ scene.axes[:2].T])
        rest_m = longer_m - moves @ np.linalg.lstsq(moves, longer_m, rcond=None)[0]
        if 2 * np.pi * centre_frequency(before.frequency_hz) / before.wave_speed_m_s * float(rest_m.std()) > _ALIKE_RAD:
            return False
    return True


def _ground(scene: OpenScene, place: tuple[float, float]) -> NDArray[np.float64]:
    row, column = scene.grid.pixel_of([place[0]], [place[1]])
    return np.asarray(scene.level.positions_at(scene.grid, row, column)[0])


def _around(scene: OpenScene, place: tuple[float, float], cell_m: float) -> SceneGrid:
    """Return a grid about a place, coarser than the scene's."""
    spacing_m, (x, y) = cell_m / _PIXELS_PER_CELL, place
    half = _SIDE_PX / 2 * spacing_m
    return SceneGrid(scene.grid.crs, x - half, y + half, spacing_m, (_SIDE_PX, _SIDE_PX), name=scene.grid.name)


def _moved(
    scene: OpenScene, place: tuple[float, float], found: Sequence[PairGeometry], hypothesis: Hypothesis
) -> tuple[float, float]:
    """Return where a bright place is expected: shifted as antennas are on average, and by the height of the ground."""
    shifts = []
    for one, history in zip(found, hypothesis.histories, strict=True):
        for before, after in zip(one.history.aperture.legs, history.aperture.legs, strict=True):
            ends = scene.grid.pixel_below(np.stack([before.mean(axis=0), after.mean(axis=0)]))
            shifts.append(ends[1, :2] - ends[0, :2])
    down, right = scene.grid.spacing_m * np.mean(shifts, axis=0)
    east_m, north_m = _moved_by_height(scene, place, found, hypothesis.height_m)
    return place[0] + float(right) + east_m, place[1] - float(down) + north_m


def _moved_by_height(
    scene: OpenScene, place: tuple[float, float], found: Sequence[PairGeometry], height_m: float
) -> tuple[float, float]:
    """Return by how much a point of unchanged paths moves, metres east and north, on ground higher by `height_m`.

    With g the mean gradient of the path, g·dx = 0: dx = −g_up height g_level/|g_level|² along the level.
    """
    here_m = _ground(scene, place)
    gradient = np.mean([one.history.aperture.path_gradient(here_m).mean(axis=0) for one in found], axis=0).reshape(3)
    east, north, up = scene.axes @ gradient
    level = max(float(east**2 + north**2), 1e-6)
    return -up * height_m * east / level, -up * height_m * north / level


# ---- Echoes of a flight as they would be if a hypothesis were true ---------------------------------------------------


def evidence_of(nodes: Mapping[str, Acquisition], pair: str, echo: xr.Dataset, window: str) -> PairGeometry:
    """Return some pulses of the echo of a pair, weighted by a window, with their geometry."""
    tx, rx = (nodes[name] for name in pair.split("-"))
    some = echo.isel(pulse=aperture_of(echo).sample(MOST_PULSES))
    time = some.time.values
    return PairGeometry(pair, phase_history_of(some, window), time, _sidelink_m(tx, rx, time, time))


def flown(
    nodes: Mapping[str, Acquisition], found: Sequence[PairGeometry], late_s: Mapping[str, float] | None = None
) -> list[PairGeometry]:
    """Return the same echoes with antennas and sidelink lengths by other logs of their nodes, or by logs that are late.

    Raises
    ------
    CampaignError
        Where a log does not reach.
    """
    moved = []
    for one in found:
        tx, rx = (nodes[name] for name in one.pair.split("-"))
        tx_at, rx_at = (
            one.time + np.timedelta64(round((late_s or {}).get(node.name, 0.0) * 1e9), "ns") for node in (tx, rx)
        )
        aperture = Aperture(tx.antenna("radar_tx", tx_at), rx.antenna("radar_rx", rx_at))
        sidelink_m = _sidelink_m(tx, rx, tx_at, rx_at)
        history = one.history.moved(aperture, sidelink_m - one.sidelink_m)
        moved.append(replace(one, history=history, sidelink_m=sidelink_m))
    return moved


def _sidelink_m(tx: Acquisition, rx: Acquisition, tx_at: Times, rx_at: Times) -> NDArray[np.float64]:
    if tx.name == rx.name:
        return np.zeros(len(tx_at))
    return np.asarray(np.linalg.norm(tx.antenna("sidelink", tx_at) - rx.antenna("sidelink", rx_at), axis=1))


def _other_geometries(nodes: Mapping[str, Acquisition], found: Sequence[PairGeometry]) -> Iterator[Hypothesis]:
    """Yield hypotheses on logs, arms, heights and paths, the likeliest first; not those that logs do not cover."""
    for what, kind, changed, late_s in _other_logs(nodes):
        with suppress(CampaignError):
            moved = flown({**nodes, **changed}, found, late_s)
            yield Hypothesis(what, kind, tuple(one.history for one in moved))
    logged = tuple(one.history for one in found)
    for height_m in causes.HEIGHT.errors:
        yield Hypothesis(causes.HEIGHT.line(height_m, digits=1), causes.HEIGHT.kind, logged, height_m)
    for place, one in enumerate(found):
        tx, rx = one.pair.split("-")
        paths = [
            (path_m, causes.RANGE.kind, causes.RANGE.line(path_m, pair=one.pair)) for path_m in causes.RANGE.errors
        ]
        for count in causes.PREFIX.errors if tx == rx else ():
            path_m = count * SPEED_OF_LIGHT_M_S / nodes[tx].numerology.sample_rate_hz
            begin = "the prefix" if nodes[tx].numerology.prefix_samples else "where waveform.lead_s says"
            what = causes.PREFIX.line(count, pair=one.pair, path_m=f"{path_m:+.2f}", begin=begin)
            paths.append((path_m, causes.PREFIX.kind, what))
        for path_m, kind, what in paths:
            longer = one.history.moved(one.history.aperture, np.asarray(-path_m))
            yield Hypothesis(what, kind, (*logged[:place], longer, *logged[place + 1 :]))


def _other_logs(
    nodes: Mapping[str, Acquisition],
) -> Iterator[tuple[str, str, Mapping[str, Acquisition], Mapping[str, float]]]:
    """Yield lines and kinds of wrong logs and arms, with the nodes as they would be, and how late their logs."""
    groups = [*([name] for name in nodes), *([list(nodes)] if len(nodes) > 1 else [])]
    for late_s in causes.TIME.errors:
        for group in groups:
            what = causes.TIME.line(late_s, whose=causes.whose(group))
            yield what, causes.TIME.kind, {}, dict.fromkeys(group, late_s)
    for name, node in nodes.items():
        arms = {point: np.array(getattr(node.settings.lever_arms_m, point)) for point in _POINTS}
        for axis, word in enumerate(_AXES):
            if any(arm[axis] for arm in arms.values()):
                flip = np.where(np.arange(3) == axis, -1.0, 1.0)
                turned = node.settings.lever_arms_m.model_copy(
                    update={key: tuple(arm * flip) for key, arm in arms.items()}
                )
                settings = node.settings.model_copy(update={"lever_arms_m": turned})
                what = causes.ARM_SIGN.line(axis=word, node=name)
                yield what, causes.ARM_SIGN.kind, {name: replace(node, settings=settings)}, {}
    for first, second in combinations(nodes, 2):
        pair = nodes[first], nodes[second]
        swapped = {first: _placed(*pair), second: _placed(*pair[::-1])}
        yield causes.TRACKS.line(first=first, second=second), causes.TRACKS.kind, swapped, {}


def _placed(node: Acquisition, other: Acquisition) -> Acquisition:
    """Return a node at the positions of another, with its own attitude."""
    at = node.log_seconds(other.track.time.values)
    own = node.log_seconds(node.track.time.values)
    turned = np.unwrap(node.track.attitude.values, axis=0)
    attitude = np.stack([np.interp(at, own, angle) for angle in turned.T], axis=-1)
    return replace(node, track=other.track.assign(attitude=(("epoch", "axis"), attitude)))


def _other_echoes(
    campaign: Campaign,
    flight: str,
    nodes: Mapping[str, Acquisition],
    found: Sequence[PairGeometry],
    *,
    sent: Transmitted,
) -> Iterator[Hypothesis]:
    """Yield hypotheses that need other echoes: channels swapped, the carrier at the other end of the band."""
    calibration = {one.pair: calibrated(campaign, flight, one.pair) for one in found}

    def formed(one: PairGeometry, nodes: Mapping[str, Acquisition], sent: Transmitted) -> PhaseHistory:
        tx, rx = (nodes[name] for name in one.pair.split("-"))
        air = scene_air(campaign, tx.track.position.values)
        processing = campaign.settings.processing
        echo = pair_echo(tx, rx, sent, processing, calibration[one.pair], air)
        return evidence_of(nodes, one.pair, echo.stage, processing.window).history

    waveform = sent.waveform
    if isinstance(waveform, OfdmWaveform):
        other = "band_centre" if waveform.carrier_is == "band_start" else "band_start"
        changed = transmitted(campaign, waveform.model_copy(update={"carrier_is": other}))
        placed = {name: replace(node, numerology=changed.numerology) for name, node in nodes.items()}
        with suppress(CampaignError):
            histories = tuple(formed(one, placed, changed) for one in found)
            yield Hypothesis(causes.CARRIER.line(other=other), causes.CARRIER.kind, histories)
    for name, node in nodes.items():
        names = node.raw.attrs["channels"]
        swapped = {**nodes, name: replace(node, raw=node.raw.assign_attrs(channels=names[::-1]))}
        with suppress(CampaignError):
            if len(names) == 2:
                histories = tuple(
                    formed(one, swapped, sent) if one.pair.endswith(f"-{name}") else one.history for one in found
                )
                yield Hypothesis(causes.CHANNELS.line(node=name), causes.CHANNELS.kind, histories)


def _by_chance(
    nodes: Mapping[str, Acquisition], found: Sequence[PairGeometry], generator: np.random.Generator
) -> Iterator[Hypothesis]:
    """Yield smooth wrong tracks of one or two unknowns that are drawn: what explains no better than they do is chance.

    Drawn are node, direction, size, and whether the track is offset, inclined or bent.
    """
    for number in range(CHANCES):
        size_m = float(np.exp(generator.uniform(*np.log(_CHANCE_M))))
        direction = generator.standard_normal(3)
        error_m = size_m * direction / np.linalg.norm(direction)
        name = list(nodes)[generator.integers(len(nodes))]
        periods, phase = generator.uniform(*_CHANCE_PERIODS), generator.uniform(0, 2 * np.pi)
        histories = []
        for one in found:
            along, logged = np.linspace(0, 1, len(one.time)), one.history.aperture
            shape = (np.ones_like(along), 2 * along - 1, np.sin(2 * np.pi * periods * along + phase))[number % 3]
            wrong = TrackCorrection(along, {name: shape[:, None] * error_m})
            longer_m = wrong.longer_m(one.pair, along, logged.tx_m - logged.rx_m if one.sidelink_m.any() else None)
            histories.append(one.history.moved(wrong.aperture(logged, one.pair, along), longer_m))
        yield Hypothesis(f"the log of {name} errs by {size_m:.2f} m", "chance", tuple(histories))


# ---- Which hypothesis explains what was lost -------------------------------------------------------------------------

LEAST_SHARE = 0.7
"""Of the dB lost that a hypothesis must bring back to be named: most of it."""

LEAST_AGAINST_NEXT = 2.0
"""Its gain over that of the best other cause, and of the best wrong track drawn at random, dB over dB."""

CLEAR_DB = 10.0
"""dB by which a gain exceeds another beyond doubt, however large both are."""


def explanation(trials: Sequence[Hypothesis], drawn: Sequence[Hypothesis], lost_db: float) -> list[dict[str, Any]]:
    """Return the report of the hypothesis that alone explains most of a loss, or that an offset does; else nothing.

    Parameters
    ----------
    trials, drawn
        Hypotheses, and wrong tracks drawn at random, with what they gain.
    lost_db
        What there is to gain.

    Examples
    --------
    >>> late, arm, other = (Hypothesis("", kind, (), gain_db=db) for kind, db in (("time", 6), ("arm", 2), ("arm", 4)))
    >>> [one["kind"] for one in explanation([late, arm], [], 7.0)], explanation([late, other], [], 7.0)
    (['time'], [])
    """

    def cause(one: Hypothesis) -> str:  # a path longer by samples of the prefix or by an offset is the same
        return causes.RANGE.kind if one.kind == causes.PREFIX.kind else one.kind

    best = max(trials, key=lambda one: one.gain_db, default=None)
    if best is None or best.gain_db < max(causes.LEAST_GAIN_DB, LEAST_SHARE * lost_db):
        return []
    others = [*(one for one in trials if cause(one) != cause(best)), *drawn]
    rivals = [one for one in others if one.gain_db > max(best.gain_db / LEAST_AGAINST_NEXT, best.gain_db - CLEAR_DB)]
    if any(not (one.is_offset and best.is_offset) for one in rivals):
        return []
    what = best.what
    if rivals:  # a constant of each pair does it, whatever made it: a path, an arm, a log, a phase
        what = f"pairs are off by a constant: of a path, an arm, a phase, a log's place or time, such as: {what}"
        heights = [one for one in rivals if one.kind == causes.HEIGHT.kind]
        if heights:  # along a straight track a height does nearly the same
            what += f"; or {max(heights, key=lambda one: one.gain_db).what}"
    report = {"what": what, "kind": "offset" if rivals else best.kind}
    return [report | {"gain_db": round(best.gain_db, 2), "lost_db": round(max(lost_db, best.gain_db), 2)}]
