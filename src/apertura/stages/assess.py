"""Rule `assess`: agreement of a flight's images, which of them to add, and hypotheses for bad ones."""

from collections.abc import Collection, Mapping, Sequence
from itertools import combinations, permutations
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from apertura.campaign.config import SampledWaveform
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, save_document
from apertura.common.flags import Flags
from apertura.common.provenance import chained_sha256
from apertura.core.combination import CoherentSum, agreement_between, choose_fusion
from apertura.core.imaging.focus_check import UNEXPECTED_DB
from apertura.core.quality.agreement import Agreement
from apertura.core.scene.grid import SceneGrid
from apertura.stages.agreement import ComparedImage, agreement_of, agreement_report, comparable, shows_points_of
from apertura.stages.hypotheses import LEAST_SHARE, hypotheses
from apertura.stages.refine import open_refined
from apertura.stages.scene import settled_scene
from apertura.workflow.lineage import result_of

_PHASE = "pairs_out_of_phase"
_LOOKS_WRONG = frozenset(
    {"defocused", "loss_unexpected", "echo_outside_scene", "pairs_displaced", _PHASE, "pair_unconfirmed"}
)
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
    told = "; no single cause explains it"
    if named:
        told = f"; {named[0]['gain_db']:.1f} of {named[0]['lost_db']:.1f} dB come back if {named[0]['what']}"
    for pair, names in suspicious.items():
        for name in names:
            line = flags[pair].get(name) or images[pair].attrs["flags"][name]
            flags[pair][name] = line + told
        focus = images[pair].attrs["quality"]["focus"]
        if named and not names and _regained(focus, named[0]["pair_gain_db"][pair]):
            flags[pair]["loss_unexpected"] = f"{focus['why']}{told}"
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
        line = f"{pair} shows none of the bright points of {' and '.join(blind)} beyond those expected by chance"
        return {"pair_unconfirmed": f"{line}: its echo is too weak, or it is wrong"} if blind else {}
    where = one.evidence
    if one.shifted:
        return {
            "pairs_displaced": (
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
    [('a-a', 'wrong_code', 'another code; seen by a-b'), ('a-b', 'wrong_code', 'another code; seen by a-b')]
    >>> wrong_codes({"a-a": {}, "a-b": other, "a-c": found})
    [('a-b', 'wrong_code', 'another code; a-c found the code that was stated')]
    """
    carried = {pair: one.get("carried") for pair, one in codes.items()}
    flags = []
    for pair in codes:
        of_one = [other for other in codes if other.split("-")[0] == pair.split("-")[0]]
        seen_by = next((other for other in of_one if carried[other] is False), None)
        if seen_by and not any(carried[other] for other in of_one):
            flags.append((pair, "wrong_code", f"{codes[seen_by]['evidence']}; seen by {seen_by}"))
        elif carried[pair] is False:
            found = ", ".join(other for other in of_one if carried[other])
            flags.append((pair, "wrong_code", f"{codes[pair]['evidence']}; {found} found the code that was stated"))
    return flags
