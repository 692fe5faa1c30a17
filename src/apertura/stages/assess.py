"""Rule `assess`: agreement of a flight's images, which of them to add, and hypotheses for bad ones."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, combinations, permutations
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import OfdmWaveform, SampledWaveform
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, save_document
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.provenance import chained_sha256
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.combination import CoherentSum, agreement_between, choose_fusion
from apertura.core.echo.compression import centre_frequency
from apertura.core.imaging.focus_check import UNEXPECTED_DB, joint_peak_power, strongest_echo
from apertura.core.quality.agreement import Agreement
from apertura.core.scene.grid import SceneGrid
from apertura.stages.acquisition import Acquisition, open_acquisition
from apertura.stages.agreement import ComparedImage, agreement_of, agreement_report, comparable, shows_points_of
from apertura.stages.calibration import calibrated
from apertura.stages.diagnosis import (
    LEAST_SHARE,
    Hypothesis,
    PairGeometry,
    Trial,
    evidence_of,
    explanation,
    hypotheses_by_chance,
    hypotheses_of,
    moved_evidence,
    some_pulses,
)
from apertura.stages.echo import pair_echo
from apertura.stages.positions import scene_air
from apertura.stages.refine import open_refined
from apertura.stages.scene import OpenScene, open_scene, settled_scene
from apertura.stages.transfer import PairEcho
from apertura.stages.transmitted import Transmitted, transmitted
from apertura.workflow.lineage import result_of

# ---- Hypotheses that would sharpen a bad image, tried on a bright place ---------------------------------------------

_ALIKE_RAD = 0.5
"""RMS phase over the aperture, beside a constant and a shift of the point, below which paths differ by an offset."""

_SIDE_PX = 128
_PIXELS_PER_CELL = 2.5


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
        gain_of_pairs_db, of each pair's own peak.

    Notes
    -----
    Source: docs/theory/focus.md, "Hypotheses".
    """
    waveform = campaign.settings.waveform
    if not isinstance(waveform, SampledWaveform):  # positions travel with a phase history: there are no logs to doubt
        return []
    sent = transmitted(campaign, waveform)
    logged = {node: open_acquisition(campaign, flight, node, sent) for node in campaign.flight(flight).nodes}
    window, track = campaign.settings.processing.window, open_refined(campaign, flight)
    found = [
        _evidence(logged, pair, PairEcho.opened(campaign, flight, pair).stage, window)
        for pair in campaign.flight(flight).pairs
    ]
    nodes = {name: track.node(node) for name, node in logged.items()}
    if track.correction is not None:
        found = moved_evidence(nodes, found)
    scene = open_scene(campaign)
    here, height_m = _around(scene, brightest, cell_m), scene.level.height_m
    now = joint_peak_power([one.history for one in found], here, height_m)
    lost_db = _db(_possible(found, here, height_m, focused) / now)

    def moved(hypothesis: Hypothesis) -> tuple[float, float]:
        x_m, y_m = _moved(scene.grid, brightest, found, hypothesis.histories)
        east_m, north_m = _moved_by_height(scene, brightest, found, hypothesis.height_m)
        return x_m + east_m, y_m + north_m

    def peak(hypothesis: Hypothesis, place: tuple[float, float], pairs: slice = slice(None)) -> float:
        grid = _around(scene, place, cell_m)
        return joint_peak_power(hypothesis.histories[pairs], grid, height_m + hypothesis.height_m)

    def tried(hypothesis: Hypothesis) -> Trial | None:
        place = moved(hypothesis)
        try:
            gain_db = _db(peak(hypothesis, place) / now)
        except ValueError:  # the places are too far apart for one pulse: rejected
            return None
        return Trial(gain_db, hypothesis, offset=_is_offset(scene, (brightest, place), found, hypothesis))

    possible = chain(hypotheses_of(nodes, found), _other_echoes(campaign, flight, nodes, found, sent=sent))
    trials = [one for one in map(tried, possible) if one is not None]
    by_chance = hypotheses_by_chance(nodes, found, np.random.default_rng(0))
    drawn = [one for one in map(tried, by_chance) if one is not None]
    named = explanation(trials, drawn, lost_db)
    if named:
        best = max(trials, key=lambda one: one.gain_db).hypothesis
        place = moved(best)
        gains = {
            pair: round(_db(peak(best, place, slice(at, at + 1)) / joint_peak_power([one.history], here, height_m)), 2)
            for at, (pair, one) in enumerate(zip(campaign.flight(flight).pairs, found, strict=True))
        }
        named[0]["gain_of_pairs_db"] = gains
    return named


def _db(ratio: float) -> float:
    return 10 * float(np.log10(max(ratio, 1e-12)))


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
    for one, changed in zip(found, hypothesis.histories, strict=True):
        before, after = one.history, changed
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


def _evidence(nodes: Mapping[str, Acquisition], pair: str, echo: xr.Dataset, window: str) -> PairGeometry:
    return evidence_of(nodes, pair, echo.isel(pulse=some_pulses(echo)), window)


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
        echo = pair_echo(tx, rx, sent, campaign.settings.processing, calibration[one.pair], air)
        some = echo.at(some_pulses(echo.dataset))
        return evidence_of(nodes, one.pair, some, campaign.settings.processing.window).history

    waveform = sent.waveform
    if isinstance(waveform, OfdmWaveform):
        other = "band_centre" if waveform.carrier_is == "band_start" else "band_start"
        changed = transmitted(campaign, waveform.model_copy(update={"carrier_is": other}))
        placed = {name: replace(node, numerology=changed.numerology) for name, node in nodes.items()}
        with suppress(CampaignError):
            yield Hypothesis(
                f"waveform.carrier_is is {other}", "carrier_is", tuple(formed(one, placed, changed) for one in found)
            )
    for name, node in nodes.items():
        names = node.raw.attrs["channels"]
        swapped = {**nodes, name: replace(node, raw=node.raw.assign_attrs(channels=names[::-1]))}
        with suppress(CampaignError):
            if len(names) == 2:
                histories = (
                    formed(one, swapped, sent) if one.pair.endswith(f"-{name}") else one.history for one in found
                )
                yield Hypothesis(f"the channels of {name} are swapped", "channels", tuple(histories))


def hypothesis_line(named: Sequence[dict[str, Any]]) -> str:
    """Return the hypothesis named, to append to a flag, or that there is none."""
    if not named:
        return "; no single cause explains it"
    return f"; {named[0]['gain_db']:.1f} of {named[0]['lost_db']:.1f} dB come back if {named[0]['what']}"


def _around(scene: OpenScene, place: tuple[float, float], cell_m: float) -> SceneGrid:
    """Return a grid about a place, coarser than the scene's."""
    spacing_m, (x, y) = cell_m / _PIXELS_PER_CELL, place
    half = _SIDE_PX / 2 * spacing_m
    return SceneGrid(scene.grid.crs, x - half, y + half, spacing_m, (_SIDE_PX, _SIDE_PX), name=scene.grid.name)


def _moved(
    grid: SceneGrid, place: tuple[float, float], found: Sequence[PairGeometry], histories: Sequence[Any]
) -> tuple[float, float]:
    """Return the expected place for other antenna positions: shifted by their mean shift."""
    rows, columns = [], []
    for one, history in zip(found, histories, strict=True):
        for before, after in zip(one.history.aperture.legs, history.aperture.legs, strict=True):
            ends = grid.pixel_below(np.stack([before.mean(axis=0), after.mean(axis=0)]))
            rows.append(ends[1, 0] - ends[0, 0])
            columns.append(ends[1, 1] - ends[0, 1])
    return place[0] + grid.spacing_m * float(np.mean(columns)), place[1] - grid.spacing_m * float(np.mean(rows))


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


# ---- Rule `assess`: agreement of a flight's images, and which are added ---------------------------------------------

_PHASE = "pairs_out_of_phase"
_LOOKS_WRONG = frozenset({"defocused", "loss_unexpected", "echo_elsewhere", "pairs_apart", _PHASE, "pair_unconfirmed"})
"""Flags that a wrong geometry raises; hypotheses are tried where one is raised."""

_TIED = "as many pairs say the opposite, and their images do not show which is wrong"

_SPREAD = ", by amounts that differ from point to point by more than a resolution cell"

_EXPLAINED_SIGMAS = 3.0
"""Standard deviations of the phase that errors of the logs make between pairs, beyond which it has another cause."""

_REGAINED_SIGMAS = 3.0
"""Standard deviations of a loss from none, beyond which a cause named for another image is told of this one too."""

_VISIBLE_SNR_DB = 20.0
"""A bright point this far above the noise should show in every image of the scene."""


def assess(campaign: Campaign, flight: str) -> Path:
    """Write results/<flight>/assessment.json: agreement of the pairs, hypotheses, members of the coherent sum."""
    lineage = result_of(campaign, "assessment", flight).begin(campaign.root)
    pairs, grid = campaign.flight(flight).pairs, settled_scene(campaign).grid
    images = {pair: open_stage(campaign.stage("image", flight, pair), "image") for pair in pairs}
    quality = {pair: image.attrs["quality"] for pair, image in images.items()}
    windows = list(grid.tiles(campaign.settings.processing.tile_px))
    shown = {pair: ComparedImage.of(image, grid, windows) for pair, image in images.items()}
    between = {(one, two): agreement_of(shown[one], shown[two], grid, windows) for one, two in combinations(pairs, 2)}
    hidden = {
        (one, two)
        for one, two in permutations(pairs, 2)
        if between.get((one, two), between.get((two, one))) is None and _hides(shown[one], shown[two], grid)
    }
    rank = {pair: _rank(one["focus"]) for pair, one in quality.items()}
    track = open_refined(campaign, flight)
    refined = track.correction is not None
    coarse = _too_coarse(shown, grid)
    as_formed = choose_fusion(rank, between, hidden=hidden, coarse=coarse, align=False)
    # A path that is constant for a pair is invisible to the refinement of tracks: its phase is removed here.
    align = refined or campaign.settings.processing.fusion.align_phase
    fusion = choose_fusion(rank, between, hidden=hidden, coarse=coarse, align=True) if align else as_formed
    explained_rad = track.stage.attrs["report"].get("pair_phase_std_rad", {}) if refined else None
    flags = _flags(pairs, as_formed, hidden, explained_rad=explained_rad)
    for pair, name, line in wrong_codes({pair: one.get("code", {}) for pair, one in quality.items()}):
        flags[pair][name] = line
    reference = fusion.reference
    named = _hypotheses(campaign, flight, images, flags, reference)
    against = {pair: agreement_between(between, reference, pair) for pair in pairs if pair != reference}
    report = {
        "flight": flight,
        "reference": reference,
        "hypotheses": named,
        "pairs": {pair: {"agreement": agreement_report(against.get(pair)), "flags": flags[pair]} for pair in pairs},
        "between": [
            {"first": one, "second": two, **(agreement_report(found) or {})} for (one, two), found in between.items()
        ],
        "fusion": fusion.report,
        "code_sha256": chained_sha256(
            lineage.result.code_sha256, [image.attrs["code_sha256"] for image in images.values()]
        ),
    }
    path = campaign.result(flight, "assessment.json")
    save_document(path, report, lineage)
    return path


def _too_coarse(shown: Mapping[str, ComparedImage], grid: SceneGrid) -> str:
    """Return why no two images can be compared where pixels are wider than their cells; empty where they can."""
    if any(comparable(one, two, grid) for one, two in combinations(shown.values(), 2)):
        return ""
    cell_m = min((image.cell_m for image in shown.values()), default=np.inf)
    return f"pixels of {grid.spacing_m:g} m do not resolve cells of {cell_m:.3g} m: make scene.spacing_m finer"


def _hides(first: ComparedImage, second: ComparedImage, grid: SceneGrid) -> bool:
    """Return whether a second image lacks the bright points of a first that stand far enough above its noise."""
    return (
        any(point["snr_db"] > _VISIBLE_SNR_DB for point in first.focus["points"])
        and comparable(first, second, grid)
        and (second.focus["verdict"] == "defocused" or not shows_points_of(first, second, grid))
    )


def _flags(
    pairs: Sequence[str],
    chosen: CoherentSum,
    hidden: Collection[tuple[str, str]],
    *,
    explained_rad: Mapping[str, float] | None,
) -> dict[str, Flags]:
    """Return pair → flags of disagreement.

    Where most pairs agree, the others carry them; where as many say the opposite, as of two pairs that differ, their
    images do not show which is wrong, and both sides do. The phase of refined tracks is corrected before pairs are
    added, and raised only where errors of the logs do not explain it: by `explained_rad`, pair → standard deviation
    against the first pair; None: tracks are those of the logs.
    """
    flags = {pair: Flags() for pair in pairs}
    for pair in pairs:
        blind = [one for one in chosen.agreeing if (one, pair) in hidden]
        raised = _disagreement(chosen, pair, blind)
        if not raised:
            continue
        # Two pairs of which one shows nothing of the other: the other may as well show what is not there.
        tied = {one for tie in chosen.ties for one in tie if pair in tie} or (len(chosen.agreeing) == 1 and blind)
        opposite = f"; {_TIED}" if tied else ""
        for side in (pair, *(chosen.agreeing if tied else ())):
            if explained_rad is not None and _explained(chosen, pair, explained_rad):
                raised.pop(_PHASE, None)
            lines = {name: line + opposite for name, line in raised.items()}
            flags[side] = Flags.merged(flags[side], lines)
    return flags


def _explained(chosen: CoherentSum, pair: str, std_rad: Mapping[str, float]) -> bool:
    """Return whether errors of the logs may turn a pair against the reference by the phase measured."""
    one = chosen.apart.get(pair)
    if one is None or not std_rad:  # one phase per pulse and pair takes any constant
        return True
    if one.incoherent:
        return False
    std = np.sqrt(sum(std_rad.get(of, 0.0) ** 2 for of in (pair, chosen.reference)) + one.phase_std_rad**2)
    return abs(float(one.phase_rad)) <= _EXPLAINED_SIGMAS * float(std)


def _hypotheses(
    campaign: Campaign,
    flight: str,
    images: Mapping[str, xr.Dataset],
    flags: dict[str, Flags],
    reference: str,
) -> list[dict[str, Any]]:
    """Try hypotheses where flags indicate a wrong geometry; append the best to these flags."""
    suspicious = {pair: _LOOKS_WRONG & {*images[pair].attrs["flags"], *raised} for pair, raised in flags.items()}
    if not any(suspicious.values()) or not isinstance(campaign.settings.waveform, SampledWaveform):
        return []
    quality = images[reference].attrs["quality"]
    brightest = quality["brightest"]["x_m"], quality["brightest"]["y_m"]
    sharp = {
        pair
        for pair, image in images.items()
        if image.attrs["quality"]["focus"]["verdict"] == "focused" and "pair_unconfirmed" not in flags[pair]
    }
    named = hypotheses(campaign, flight, brightest=brightest, cell_m=quality["focus"]["cell_m"], focused=sharp)
    for pair, names in suspicious.items():
        for name in names:
            line = flags[pair].get(name) or images[pair].attrs["flags"][name]
            flags[pair][name] = line + hypothesis_line(named)
        focus = images[pair].attrs["quality"]["focus"]
        if named and not names and _regained(focus, named[0]["gain_of_pairs_db"][pair]):
            flags[pair]["loss_unexpected"] = f"{focus['why']}{hypothesis_line(named)}"
    return named


def _regained(focus: Mapping[str, Any], gain_db: float) -> bool:
    """Return whether a cause named for other images of the flight brings back what this one lost, beyond chance."""
    lost_db = -float(focus.get("loss_db", 0.0))
    beyond = max(UNEXPECTED_DB, _REGAINED_SIGMAS * float(focus.get("std_db", 0.0)))
    return lost_db > beyond and gain_db > max(beyond, LEAST_SHARE * lost_db)


def _rank(focus: Mapping[str, Any]) -> tuple[int, float]:
    """Return the rank of a pair's focus, the best first."""
    uncertain = "cannot tell" if "loss_db" in focus else "not measured"
    verdict = uncertain if focus["verdict"] == "cannot tell" else focus["verdict"]
    return ["focused", "cannot tell", "defocused", "not measured"].index(verdict), -focus.get("loss_db", 0.0)


def _disagreement(chosen: CoherentSum, pair: str, blind: Sequence[str]) -> dict[str, str]:
    """Return the flags of a pair that is not of the set that agrees; `blind`: members none of whose points it shows."""
    agreeing, one = " and ".join(chosen.agreeing), chosen.apart.get(pair)
    if one is None:
        line = f"{pair} shows none of the bright points of {' and '.join(blind)}: its echo is too weak, or it is wrong"
        return {"pair_unconfirmed": line} if blind else {}
    where = one.evidence
    if one.shifted:
        return {
            "pairs_apart": (
                f"{where} of {pair} lie {100 * one.shift_m:.1f} ± {100 * one.shift_std_along_m:.1f} cm from where "
                f"{agreeing} {'has' if len(chosen.agreeing) == 1 else 'have'} them, "
                f"{100 * one.shift_east_m:+.1f} cm east and {100 * one.shift_north_m:+.1f} cm north"
                f"{_SPREAD * one.spread}: positions, lever arms, path offsets or heights are wrong"
            ),
            **({_PHASE: _phase_line(one, where, pair, chosen.reference)} if one.out_of_phase else {}),
        }
    return {_PHASE: _phase_line(one, where, pair, chosen.reference)}


def _phase_line(one: Agreement, where: str, pair: str, reference: str) -> str:
    found = f"{pair} is {one.phase_rad:+.2f} ± {one.phase_std_rad:.2f} rad from {reference} at {where}"
    if one.incoherent:
        return (
            f"{found}, coherence {one.coherence:.2f}: no common phase; positions of one are wrong from point to point"
        )
    return f"{found}: path offsets or positions are wrong by a fraction of the wavelength"


def wrong_codes(codes: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Return pair, flag and line for each pair whose transmitter sent, or whose receiver recorded, another code.

    Where some receivers find the code and others find another, the transmitter sent it, and these recorded another
    transmitter; where none finds it, all pairs of the transmitter are wrong.

    Parameters
    ----------
    codes
        Pair → `CodeEvidence` as it stands in image.json.

    Examples
    --------
    >>> found, other = {"carried": True, "evidence": "locked"}, {"carried": False, "evidence": "another code"}
    >>> wrong_codes({"a-a": {}, "a-b": other})
    [('a-a', 'wrong_code', 'another code (seen by a-b)'), ('a-b', 'wrong_code', 'another code (seen by a-b)')]
    >>> wrong_codes({"a-a": {}, "a-b": other, "a-c": found})
    [('a-b', 'wrong_code', 'another code; a-c found the code that was stated')]
    """
    carried = {pair: one.get("carried") for pair, one in codes.items()}
    flags = []
    for pair in codes:
        of_one = [other for other in codes if other.split("-")[0] == pair.split("-")[0]]
        seen_by = next((other for other in of_one if carried[other] is False), None)
        if seen_by and not any(carried[other] for other in of_one):
            flags.append((pair, "wrong_code", f"{codes[seen_by]['evidence']} (seen by {seen_by})"))
        elif carried[pair] is False:
            found = ", ".join(other for other in of_one if carried[other])
            flags.append((pair, "wrong_code", f"{codes[pair]['evidence']}; {found} found the code that was stated"))
    return flags
