"""Hypotheses on errors of a flight, tested on a bright point, and choice of the hypothesis that explains the peak loss.

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
"""Largest number of pulses per pair on which hypotheses are tested, evenly spaced."""

RANDOM_TRACKS = 48
"""Number of wrong tracks drawn at random, with an offset, a slope or a sinusoidal error in equal numbers."""

_RANDOM_SIZE_M, _RANDOM_PERIODS = (0.03, 2.0), (0.25, 1.5)  # ranges of track errors, and of periods per aperture
_AXES = ("forward", "right", "down")
_POINTS = ("radar_tx", "radar_rx", "sidelink")

_OFFSET_RESIDUAL_RAD = 0.5
"""Largest RMS phase residual over the aperture for which a path change is classified as an offset, radians.

The residual is that of a fit of a constant and a displacement of the point.
"""

_SIDE_PX = 128
_PIXELS_PER_CELL = 2.5


@dataclass(frozen=True, eq=False)
class PairGeometry:
    """Phase history of a pair for a subset of its pulses, with their time tags and sidelink lengths.

    Attributes
    ----------
    pair
        Name of the pair.
    history
        Phase history of the subset.
    time
        (pulse,) datetime64[ns], time tags.
    sidelink_m
        (pulse,) float64, sidelink length that was added to the echo, metres; 0 for a monostatic pair.
    """

    pair: str
    history: PhaseHistory
    time: Times
    sidelink_m: NDArray[np.float64]


@dataclass(frozen=True)
class Hypothesis:
    """Possible error of the campaign.

    Attributes
    ----------
    what
        Sentence for reports: 'the times of the log of uav1 are 18.00 s late (possible cause: GPST interpreted as UTC)'.
    kind
        Short name of the kind of error.
    histories
        Phase histories of the flight's pairs under the hypothesis.
    height_m
        Change of the terrain height, metres.
    gain_db
        Gain of the joint peak power at the bright point; NaN before the test.
    is_offset
        True if the hypothesis changes the path of each pair by a constant only, apart from a displacement of the point.
    """

    what: str
    kind: str
    histories: tuple[PhaseHistory, ...]
    height_m: float = 0.0
    gain_db: float = np.nan
    is_offset: bool = False


# ---- Test of hypotheses on a bright point ----------------------------------------------------------------------------


def hypotheses(
    campaign: Campaign,
    flight: str,
    *,
    brightest: tuple[float, float],
    cell_m: float,
    focused: Collection[str] = (),
) -> list[dict[str, Any]]:
    """Return the only hypothesis that explains most of the peak loss of a flight; empty if several or none explain it.

    Parameters
    ----------
    campaign, flight
        Campaign, and name of the flight.
    brightest
        Easting and northing of a bright point in the scene's CRS, metres.
    cell_m
        Resolution cell.
    focused
        Pairs whose own image is focused, and which therefore have no peak loss of their own.

    Returns
    -------
    list
        At most one dict: what, kind, gain_db and lost_db (gain of the joint peak power at the bright point, and its
        loss), and pair_gain_db (gain of each pair's own peak).
    """
    waveform = campaign.settings.waveform
    if not isinstance(waveform, SampledWaveform):  # a phase history contains its positions: there are no logs to test
        return []
    sent = transmitted(campaign, waveform)
    logged = {node: open_acquisition(campaign, flight, node, sent) for node in campaign.flight(flight).participants}
    window, track = campaign.settings.processing.window, open_refined(campaign, flight)
    geometries = [
        subset_geometry(logged, pair, PairEcho.cleaned(campaign, flight, pair).stage, window)
        for pair in campaign.flight(flight).pairs
    ]
    nodes = {name: track.node(node) for name, node in logged.items()}
    if track.correction is not None:
        geometries = with_logs(nodes, geometries)
    scene = open_scene(campaign)
    grid, height_m = _grid_around(scene, brightest, cell_m), scene.level.height_m
    measured_power = joint_peak_power([geometry.history for geometry in geometries], grid, height_m)
    lost_db = decibels(_focused_power(geometries, grid, height_m, focused) / measured_power)

    def tested(candidates: Iterator[Hypothesis]) -> Iterator[Hypothesis]:
        for candidate in candidates:
            point = _displaced(scene, brightest, geometries, candidate)
            point_grid, point_height_m = _grid_around(scene, point, cell_m), height_m + candidate.height_m
            try:
                power = joint_peak_power(candidate.histories, point_grid, point_height_m)
            except ValueError:  # the grid is deeper than the unambiguous range
                continue
            is_offset = _is_offset(scene, (brightest, point), geometries, candidate)
            yield replace(candidate, gain_db=decibels(power / measured_power), is_offset=is_offset)

    trials = [
        *tested(_other_geometries(nodes, geometries)),
        *tested(_other_echoes(campaign, flight, nodes, geometries, sent=sent)),
    ]
    drawn = [*tested(_random_tracks(nodes, geometries, np.random.default_rng(0)))]
    reports = explanation(trials, drawn, lost_db)
    if reports:
        best = max(trials, key=lambda trial: trial.gain_db)
        best_grid = _grid_around(scene, _displaced(scene, brightest, geometries, best), cell_m)
        best_height_m = height_m + best.height_m
        reports[0]["pair_gain_db"] = {
            geometry.pair: round(
                decibels(
                    joint_peak_power([after], best_grid, best_height_m)
                    / joint_peak_power([geometry.history], grid, height_m)
                ),
                2,
            )
            for geometry, after in zip(geometries, best.histories, strict=True)
        }
    return reports


def _focused_power(
    geometries: Sequence[PairGeometry], grid: SceneGrid, height_m: float, focused: Collection[str]
) -> float:
    """Return the joint peak power if every pair were focused at one point and in phase.

    A focused pair contributes its own peak; any other pair contributes the strongest echo of its pulses.
    """
    amplitudes = np.array(
        [
            np.sqrt(joint_peak_power([geometry.history], grid, height_m))
            if geometry.pair in focused
            else strongest_echo(geometry.history, grid, height_m)
            for geometry in geometries
        ]
    )
    return float((amplitudes**2).mean() + amplitudes.mean() ** 2) / 2


def _is_offset(
    scene: OpenScene,
    points: tuple[tuple[float, float], tuple[float, float]],
    geometries: Sequence[PairGeometry],
    hypothesis: Hypothesis,
) -> bool:
    """Return True if a hypothesis changes the path of each pair by a constant, apart from displacing the point.

    `points`: the bright point before and after. Source: docs/theory/focus.md, eq. 2.
    """
    before_m, after_m = (_on_level(scene, point) for point in points)
    after_m = after_m + hypothesis.height_m * np.cross(*scene.axes[:2])
    for before, after in zip((geometry.history for geometry in geometries), hypothesis.histories, strict=True):
        if len(before) != len(after):
            return False
        extra_m = (after.aperture.path(after_m[None]) - before.aperture.path(before_m[None]))[:, 0]
        extra_m -= before.wave_speed_m_s * (after.reference_delay_s - before.reference_delay_s)
        # Least-squares fit of a constant and a horizontal displacement to the change of path.
        gradient = before.aperture.path_gradient(before_m) @ scene.axes[:2].T
        design = np.column_stack([np.ones(len(extra_m)), gradient])
        residual_m = extra_m - design @ np.linalg.lstsq(design, extra_m, rcond=None)[0]
        wavenumber = 2 * np.pi * centre_frequency(before.frequency_hz) / before.wave_speed_m_s
        if wavenumber * float(residual_m.std()) > _OFFSET_RESIDUAL_RAD:
            return False
    return True


def _on_level(scene: OpenScene, point: tuple[float, float]) -> NDArray[np.float64]:
    row, column = scene.grid.pixel_of([point[0]], [point[1]])
    return np.asarray(scene.level.positions_at(scene.grid, row, column)[0])


def _grid_around(scene: OpenScene, point: tuple[float, float], cell_m: float) -> SceneGrid:
    """Return a grid centred on a point, with its own spacing."""
    spacing_m, (x, y) = cell_m / _PIXELS_PER_CELL, point
    half = _SIDE_PX / 2 * spacing_m
    return SceneGrid(scene.grid.crs, x - half, y + half, spacing_m, (_SIDE_PX, _SIDE_PX), name=scene.grid.name)


def _displaced(
    scene: OpenScene, point: tuple[float, float], geometries: Sequence[PairGeometry], hypothesis: Hypothesis
) -> tuple[float, float]:
    """Return a bright point displaced by the mean antenna displacement and by the change of the terrain height."""
    shifts = []
    for geometry, history in zip(geometries, hypothesis.histories, strict=True):
        for before, after in zip(geometry.history.aperture.legs, history.aperture.legs, strict=True):
            ends = scene.grid.pixel_below(np.stack([before.mean(axis=0), after.mean(axis=0)]))
            shifts.append(ends[1, :2] - ends[0, :2])
    down, right = scene.grid.spacing_m * np.mean(shifts, axis=0)
    east_m, north_m = _displacement_by_height(scene, point, geometries, hypothesis.height_m)
    return point[0] + float(right) + east_m, point[1] - float(down) + north_m


def _displacement_by_height(
    scene: OpenScene, point: tuple[float, float], geometries: Sequence[PairGeometry], height_m: float
) -> tuple[float, float]:
    """Return the displacement of a point with unchanged paths if the terrain is `height_m` higher, m east and north.

    With g the mean gradient of the path, g·dx = 0: dx = −g_up height g_level/|g_level|² along the level.
    """
    point_m = _on_level(scene, point)
    gradients = [geometry.history.aperture.path_gradient(point_m).mean(axis=0) for geometry in geometries]
    gradient = np.mean(gradients, axis=0).reshape(3)
    east, north, up = scene.axes @ gradient
    level = max(float(east**2 + north**2), 1e-6)
    return -up * height_m * east / level, -up * height_m * north / level


# ---- Echoes of a flight under a hypothesis ---------------------------------------------------------------------------


def subset_geometry(nodes: Mapping[str, Acquisition], pair: str, echo: xr.Dataset, window: str) -> PairGeometry:
    """Return evenly spaced pulses of a pair's echo, weighted by a window, with their geometry."""
    tx, rx = (nodes[name] for name in pair.split("-"))
    subset = echo.isel(pulse=aperture_of(echo).sample(MOST_PULSES))
    time = subset.time.values
    return PairGeometry(pair, phase_history_of(subset, window), time, _sidelink_m(tx, rx, time, time))


def with_logs(
    nodes: Mapping[str, Acquisition], geometries: Sequence[PairGeometry], late_s: Mapping[str, float] | None = None
) -> list[PairGeometry]:
    """Return the echoes with antenna positions and sidelink lengths from other logs, or from delayed logs.

    Raises
    ------
    CampaignError
        If a log does not cover all pulses.
    """
    changed = []
    for geometry in geometries:
        tx, rx = (nodes[name] for name in geometry.pair.split("-"))
        tx_at, rx_at = (
            geometry.time + np.timedelta64(round((late_s or {}).get(node.name, 0.0) * 1e9), "ns") for node in (tx, rx)
        )
        aperture = Aperture(tx.antenna("radar_tx", tx_at), rx.antenna("radar_rx", rx_at))
        sidelink_m = _sidelink_m(tx, rx, tx_at, rx_at)
        history = geometry.history.moved(aperture, sidelink_m - geometry.sidelink_m)
        changed.append(replace(geometry, history=history, sidelink_m=sidelink_m))
    return changed


def _sidelink_m(tx: Acquisition, rx: Acquisition, tx_at: Times, rx_at: Times) -> NDArray[np.float64]:
    if tx.name == rx.name:
        return np.zeros(len(tx_at))
    return np.asarray(np.linalg.norm(tx.antenna("sidelink", tx_at) - rx.antenna("sidelink", rx_at), axis=1))


def _other_geometries(nodes: Mapping[str, Acquisition], geometries: Sequence[PairGeometry]) -> Iterator[Hypothesis]:
    """Yield hypotheses on logs (if these cover the pulses), lever arms, heights and paths, the most likely first."""
    for what, kind, changed, late_s in _other_logs(nodes):
        with suppress(CampaignError):
            moved = with_logs({**nodes, **changed}, geometries, late_s)
            yield Hypothesis(what, kind, tuple(geometry.history for geometry in moved))
    logged = tuple(geometry.history for geometry in geometries)
    for height_m in causes.HEIGHT.errors:
        yield Hypothesis(causes.HEIGHT.line(height_m, digits=1), causes.HEIGHT.kind, logged, height_m)
    for index, geometry in enumerate(geometries):
        tx, rx = geometry.pair.split("-")
        paths = [
            (path_m, causes.RANGE.kind, causes.RANGE.line(path_m, pair=geometry.pair)) for path_m in causes.RANGE.errors
        ]
        for count in causes.PREFIX.errors if tx == rx else ():
            path_m = count * SPEED_OF_LIGHT_M_S / nodes[tx].numerology.sample_rate_hz
            begin = "the prefix" if nodes[tx].numerology.prefix_samples else "the start that waveform.lead_s implies"
            what = causes.PREFIX.line(count, pair=geometry.pair, path_m=f"{path_m:+.2f}", begin=begin)
            paths.append((path_m, causes.PREFIX.kind, what))
        for path_m, kind, what in paths:
            longer = geometry.history.moved(geometry.history.aperture, np.asarray(-path_m))
            yield Hypothesis(what, kind, (*logged[:index], longer, *logged[index + 1 :]))


def _other_logs(
    nodes: Mapping[str, Acquisition],
) -> Iterator[tuple[str, str, Mapping[str, Acquisition], Mapping[str, float]]]:
    """Yield sentences and kinds of wrong logs and lever arms, with the changed nodes and the delay of their logs."""
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
                flipped = node.settings.lever_arms_m.model_copy(
                    update={key: tuple(arm * flip) for key, arm in arms.items()}
                )
                settings = node.settings.model_copy(update={"lever_arms_m": flipped})
                what = causes.ARM_SIGN.line(axis=word, node=name)
                yield what, causes.ARM_SIGN.kind, {name: replace(node, settings=settings)}, {}
    for first, second in combinations(nodes, 2):
        pair = nodes[first], nodes[second]
        swapped = {first: _on_track_of(*pair), second: _on_track_of(*pair[::-1])}
        yield causes.TRACKS.line(first=first, second=second), causes.TRACKS.kind, swapped, {}


def _on_track_of(node: Acquisition, other: Acquisition) -> Acquisition:
    """Return a node with the positions of another node and its own attitude."""
    at = node.log_seconds(other.track.time.values)
    own = node.log_seconds(node.track.time.values)
    unwrapped = np.unwrap(node.track.attitude.values, axis=0)
    attitude = np.stack([np.interp(at, own, angle) for angle in unwrapped.T], axis=-1)
    return replace(node, track=other.track.assign(attitude=(("epoch", "axis"), attitude)))


def _other_echoes(
    campaign: Campaign,
    flight: str,
    nodes: Mapping[str, Acquisition],
    geometries: Sequence[PairGeometry],
    *,
    sent: Transmitted,
) -> Iterator[Hypothesis]:
    """Yield hypotheses that require other echoes: swapped channels, or another reference of the carrier frequency."""
    pairs = [geometry.pair for geometry in geometries]
    calibration = {pair: calibrated(campaign, flight, pair) for pair in pairs}

    def formed(pair: str, nodes: Mapping[str, Acquisition], sent: Transmitted) -> PhaseHistory:
        tx, rx = (nodes[name] for name in pair.split("-"))
        air = scene_air(campaign, tx.track.position.values)
        processing = campaign.settings.processing
        source = campaign.symbol_source(flight, pair)
        echo = pair_echo(tx, rx, sent, processing, calibration[pair], air, source=nodes[source] if source else None)
        return subset_geometry(nodes, pair, echo.stage, processing.window).history

    waveform = sent.waveform
    if isinstance(waveform, OfdmWaveform):
        other = "band_centre" if waveform.carrier_is == "band_start" else "band_start"
        changed = transmitted(campaign, waveform.model_copy(update={"carrier_is": other}))
        retuned = {name: replace(node, numerology=changed.numerology) for name, node in nodes.items()}
        with suppress(CampaignError):
            histories = tuple(formed(pair, retuned, changed) for pair in pairs)
            yield Hypothesis(causes.CARRIER.line(other=other), causes.CARRIER.kind, histories)
    for name, node in nodes.items():
        names = node.raw.attrs["channels"]
        swapped = {**nodes, name: replace(node, raw=node.raw.assign_attrs(channels=names[::-1]))}
        with suppress(CampaignError):
            if len(names) == 2:
                histories = tuple(
                    formed(geometry.pair, swapped, sent) if geometry.pair.endswith(f"-{name}") else geometry.history
                    for geometry in geometries
                )
                yield Hypothesis(causes.CHANNELS.line(node=name), causes.CHANNELS.kind, histories)


def _random_tracks(
    nodes: Mapping[str, Acquisition], geometries: Sequence[PairGeometry], generator: np.random.Generator
) -> Iterator[Hypothesis]:
    """Yield smooth wrong tracks drawn at random, against which the gain of a hypothesis is compared.

    Node, direction and size of the error are drawn; the error is an offset, a slope or a sinusoid.
    """
    for number in range(RANDOM_TRACKS):
        size_m = float(np.exp(generator.uniform(*np.log(_RANDOM_SIZE_M))))
        direction = generator.standard_normal(3)
        error_m = size_m * direction / np.linalg.norm(direction)
        name = list(nodes)[generator.integers(len(nodes))]
        periods, phase = generator.uniform(*_RANDOM_PERIODS), generator.uniform(0, 2 * np.pi)
        histories = []
        for geometry in geometries:
            along, logged = np.linspace(0, 1, len(geometry.time)), geometry.history.aperture
            shape = (np.ones_like(along), 2 * along - 1, np.sin(2 * np.pi * periods * along + phase))[number % 3]
            wrong = TrackCorrection(along, {name: shape[:, None] * error_m})
            sidelink = logged.tx_m - logged.rx_m if geometry.sidelink_m.any() else None
            extra_m = wrong.longer_m(geometry.pair, along, sidelink)
            histories.append(geometry.history.moved(wrong.aperture(logged, geometry.pair, along), extra_m))
        yield Hypothesis(f"the log of {name} has an error of {size_m:.2f} m", "chance", tuple(histories))


# ---- Choice of the hypothesis that explains the loss -----------------------------------------------------------------

LEAST_SHARE = 0.7
"""Smallest fraction of the loss in dB that a hypothesis must recover to be reported."""

LEAST_AGAINST_NEXT = 2.0
"""Smallest ratio of a hypothesis's gain in dB to that of the best other cause and of the best random track."""

CLEAR_DB = 10.0
"""Difference in dB from which a gain is regarded as the larger gain, whatever the ratio of the gains is."""


def explanation(trials: Sequence[Hypothesis], drawn: Sequence[Hypothesis], lost_db: float) -> list[dict[str, Any]]:
    """Return the report of the only hypothesis, or of an offset, that explains most of a loss; else an empty list.

    Parameters
    ----------
    trials, drawn
        Tested hypotheses, and random wrong tracks, with their gains.
    lost_db
        Peak loss.

    Examples
    --------
    >>> late, arm, other = (Hypothesis("", kind, (), gain_db=db) for kind, db in (("time", 6), ("arm", 2), ("arm", 4)))
    >>> [report["kind"] for report in explanation([late, arm], [], 7.0)], explanation([late, other], [], 7.0)
    (['time'], [])
    """

    def cause(trial: Hypothesis) -> str:  # an offset by samples of the prefix is a path offset as well
        return causes.RANGE.kind if trial.kind == causes.PREFIX.kind else trial.kind

    best = max(trials, key=lambda trial: trial.gain_db, default=None)
    if best is None or best.gain_db < max(causes.LEAST_GAIN_DB, LEAST_SHARE * lost_db):
        return []
    others = [*(trial for trial in trials if cause(trial) != cause(best)), *drawn]
    rival_gain_db = max(best.gain_db / LEAST_AGAINST_NEXT, best.gain_db - CLEAR_DB)
    rivals = [trial for trial in others if trial.gain_db > rival_gain_db]
    if any(not (trial.is_offset and best.is_offset) for trial in rivals):
        return []
    what = best.what
    if rivals:  # several causes of a constant path offset per pair explain the loss equally well
        what = (
            "the path of each pair has a constant offset, caused by a path offset, lever arm, phase, or position or "
            f"time of a log, for example: {what}"
        )
        heights = [trial for trial in rivals if trial.kind == causes.HEIGHT.kind]
        if heights:  # with a straight track, a height error has nearly the same effect
            what += f"; or {max(heights, key=lambda trial: trial.gain_db).what}"
    report = {"what": what, "kind": "offset" if rivals else best.kind}
    return [report | {"gain_db": round(best.gain_db, 2), "lost_db": round(max(lost_db, best.gain_db), 2)}]
