"""Rule `assess`: agreement of a flight's images, choice of the coherent sum, and causes of defocused images."""

from collections.abc import Collection, Mapping, Sequence
from itertools import combinations, permutations
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from apertura.campaign.config import SampledWaveform
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, save_document
from apertura.common.contracts import Window
from apertura.common.flags import Flags
from apertura.common.provenance import chained_sha256
from apertura.core.combination import CoherentSum, agreement_between, choose_fusion
from apertura.core.imaging.focus_check import UNEXPECTED_DB
from apertura.core.quality.agreement import Agreement
from apertura.core.scene.grid import SceneGrid
from apertura.stages.agreement import (
    ComparedImage,
    agreement_of,
    agreement_report,
    assessment_of,
    comparable,
    shows_points_of,
)
from apertura.stages.hypotheses import LEAST_SHARE, hypotheses
from apertura.stages.refine import open_refined
from apertura.stages.scene import settled_scene
from apertura.workflow.lineage import result_of

_PHASE = "pairs_out_of_phase"
_LOOKS_WRONG = frozenset(
    {"defocused", "loss_unexpected", "echo_outside_scene", "pairs_displaced", _PHASE, "pair_unconfirmed"}
)
"""Flags that indicate a wrong geometry; hypotheses are tested if one of them is raised."""

_TIED = "an equal number of pairs contradict this, and the images do not show which pairs are wrong"

_SPREAD = ", by amounts that differ between points by more than a resolution cell"

_EXPLAINED_SIGMAS = 3.0
"""Largest phase difference between pairs that is attributed to log errors, in standard deviations."""

_REGAINED_SIGMAS = 3.0
"""Smallest peak loss, in standard deviations, to which a cause identified for another image is applied."""

_VISIBLE_SNR_DB = 20.0
"""SNR from which a bright point is expected in every image of the scene, dB."""


def assess(campaign: Campaign, flight: str) -> Path:
    """Write results/<flight>/assessment.json: agreement of the pairs, hypotheses, members of the coherent sum."""
    lineage = result_of(campaign, "assessment", flight).begin(campaign.root)
    pairs, grid = campaign.flight(flight).pairs, settled_scene(campaign).grid
    images = {pair: open_stage(campaign.stage("image", flight, pair), "image") for pair in pairs}
    quality = {pair: image.attrs["quality"] for pair, image in images.items()}
    windows = list(grid.tiles(campaign.settings.processing.tile_px))
    compared = {pair: ComparedImage.of(image, grid, windows) for pair, image in images.items()}
    between = {
        (one, two): agreement_of(compared[one], compared[two], grid, windows) for one, two in combinations(pairs, 2)
    }
    hidden = {
        (one, two)
        for one, two in permutations(pairs, 2)
        if between.get((one, two), between.get((two, one))) is None and _hides(compared[one], compared[two], grid)
    }
    rank = {pair: _rank(measures["focus"]) for pair, measures in quality.items()}
    track = open_refined(campaign, flight)
    refined = track.correction is not None
    coarse = _too_coarse(compared, grid)
    as_formed = choose_fusion(rank, between, hidden=hidden, coarse=coarse, align=False)
    # Track refinement cannot observe a constant path offset of a pair; the phase of that offset is removed here.
    align = refined or campaign.settings.processing.fusion.align_phase
    fusion = choose_fusion(rank, between, hidden=hidden, coarse=coarse, align=True) if align else as_formed
    explained_rad = track.stage.attrs["report"].get("pair_phase_std_rad", {}) if refined else None
    flags = _flags(pairs, as_formed, hidden, explained_rad=explained_rad)
    for pair, name, line in wrong_codes({pair: measures.get("code", {}) for pair, measures in quality.items()}):
        flags[pair][name] = line
    reference = fusion.reference
    causes = _hypotheses(campaign, flight, images, flags, reference)
    against = {pair: agreement_between(between, reference, pair) for pair in pairs if pair != reference}
    report = {
        "flight": flight,
        "reference": reference,
        "hypotheses": causes,
        "pairs": {pair: {"agreement": agreement_report(against.get(pair)), "flags": flags[pair]} for pair in pairs},
        "between": [
            {"first": one, "second": two, **(agreement_report(measured) or {})}
            for (one, two), measured in between.items()
        ],
        "fusion": fusion.report,
        **_against_first_flight(campaign, flight, compared[reference], windows),
        "code_sha256": chained_sha256(
            lineage.result.code_sha256, [image.attrs["code_sha256"] for image in images.values()]
        ),
    }
    path = campaign.result(flight, "assessment.json")
    save_document(path, report, lineage)
    return path


def _against_first_flight(
    campaign: Campaign, flight: str, image: ComparedImage, windows: Sequence[Window]
) -> dict[str, Any]:
    """Return the displacement of a flight's reference image relative to that of the first flight, and flags.

    The result is empty for the first flight. A comparison with one flight, not with all, leaves the assessments of
    earlier flights unchanged when a flight is added.
    """
    first = campaign.image_flights[0].name
    if flight == first:
        return {}
    reference = open_stage(campaign.stage("image", first, assessment_of(campaign, first)["reference"]), "image")
    agreement = agreement_of(ComparedImage.of(reference, image.grid, windows), image, image.grid, windows)
    flags = Flags()
    if agreement is not None and agreement.shifted:
        flags["flights_displaced"] = (
            f"{agreement.evidence} of flight {flight} displaced by {100 * agreement.shift_m:.1f} ± "
            f"{100 * agreement.shift_std_along_m:.1f} cm relative to flight {first}, "
            f"{100 * agreement.shift_east_m:+.1f} cm east and "
            f"{100 * agreement.shift_north_m:+.1f} cm north: a base station, datum or time system differs"
        )
    return {"first_flight": {"reference": first, "agreement": agreement_report(agreement), "flags": flags}}


def _too_coarse(compared: Mapping[str, ComparedImage], grid: SceneGrid) -> str:
    """Return the reason if pixels are too coarse to compare any two images; empty if they are fine enough."""
    if any(comparable(one, two, grid) for one, two in combinations(compared.values(), 2)):
        return ""
    cell_m = min((image.cell_m for image in compared.values()), default=np.inf)
    return f"pixels of {grid.spacing_m:g} m do not sample resolution cells of {cell_m:.3g} m: reduce scene.spacing_m"


def _hides(first: ComparedImage, second: ComparedImage, grid: SceneGrid) -> bool:
    """Return True if a second image lacks the bright points of a first image although the SNR of these is high."""
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

    The flags are raised on the pairs outside the largest set of pairs that agree. If an equally large set contradicts
    that set, as with two pairs that differ, the images do not determine which set is wrong, and the pairs of both sets
    are flagged. With refined tracks, phase differences are corrected before pairs are added, and flagged only if log
    errors do not explain them. `explained_rad`: pair → standard deviation of its phase difference from the first pair
    due to log errors; None if the tracks were not refined.
    """
    flags = {pair: Flags() for pair in pairs}
    for pair in pairs:
        blind = [member for member in chosen.agreeing if (member, pair) in hidden]
        raised = _disagreement(chosen, pair, blind)
        if not raised:
            continue
        # If one of two pairs lacks the points of the other, the points themselves may be wrong.
        tied = {member for tie in chosen.ties for member in tie if pair in tie} or (len(chosen.agreeing) == 1 and blind)
        opposite = f"; {_TIED}" if tied else ""
        for side in (pair, *(chosen.agreeing if tied else ())):
            if explained_rad is not None and _explained(chosen, pair, explained_rad):
                raised.pop(_PHASE, None)
            lines = {name: line + opposite for name, line in raised.items()}
            flags[side] = Flags.merged(flags[side], lines)
    return flags


def _explained(chosen: CoherentSum, pair: str, std_rad: Mapping[str, float]) -> bool:
    """Return True if log errors explain the measured phase difference of a pair from the reference."""
    measured = chosen.apart.get(pair)
    if measured is None or not std_rad:  # a correction with one phase per pulse and pair includes any constant
        return True
    if measured.incoherent:
        return False
    std = np.sqrt(sum(std_rad.get(of, 0.0) ** 2 for of in (pair, chosen.reference)) + measured.phase_std_rad**2)
    return abs(float(measured.phase_rad)) <= _EXPLAINED_SIGMAS * float(std)


def _hypotheses(
    campaign: Campaign,
    flight: str,
    images: Mapping[str, xr.Dataset],
    flags: dict[str, Flags],
    reference: str,
) -> list[dict[str, Any]]:
    """Test hypotheses if flags indicate a wrong geometry; append the best hypothesis to these flags."""
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
    causes = hypotheses(campaign, flight, brightest=brightest, cell_m=quality["focus"]["cell_m"], focused=sharp)
    cause = "; no single cause explains this"
    if causes:
        cause = f"; {causes[0]['gain_db']:.1f} of {causes[0]['lost_db']:.1f} dB of the peak loss are explained if "
        cause += str(causes[0]["what"])
    for pair, names in suspicious.items():
        for name in names:
            line = flags[pair].get(name) or images[pair].attrs["flags"][name]
            flags[pair][name] = line + cause
        focus = images[pair].attrs["quality"]["focus"]
        if causes and not names and _regained(focus, causes[0]["pair_gain_db"][pair]):
            flags[pair]["loss_unexpected"] = f"{focus['reason']}{cause}"
    return causes


def _regained(focus: Mapping[str, Any], gain_db: float) -> bool:
    """Return True if a cause identified in other images of the flight recovers a significant loss of this image."""
    lost_db = -float(focus.get("loss_db", 0.0))
    beyond = max(UNEXPECTED_DB, _REGAINED_SIGMAS * float(focus.get("std_db", 0.0)))
    return lost_db > beyond and gain_db > max(beyond, LEAST_SHARE * lost_db)


def _rank(focus: Mapping[str, Any]) -> tuple[int, float]:
    """Return the sort key of a pair's focus; the best focus has the lowest key."""
    uncertain = "inconclusive" if "loss_db" in focus else "not measured"
    verdict = uncertain if focus["verdict"] == "inconclusive" else focus["verdict"]
    return ["focused", "inconclusive", "defocused", "not measured"].index(verdict), -focus.get("loss_db", 0.0)


def _disagreement(chosen: CoherentSum, pair: str, blind: Sequence[str]) -> dict[str, str]:
    """Return the flags of a pair outside the set of agreeing pairs.

    `blind`: members of the set whose bright points are all missing in the image of the pair.
    """
    agreeing, measured = " and ".join(chosen.agreeing), chosen.apart.get(pair)
    if measured is None:
        line = f"bright points of {' and '.join(blind)} are found in {pair} no more often than expected from speckle"
        line += f": the echo of {pair} is too weak, or the geometry is wrong"
        return {"pair_unconfirmed": line} if blind else {}
    where = measured.evidence
    if measured.shifted:
        return {
            "pairs_displaced": (
                f"{where} of {pair} displaced by {100 * measured.shift_m:.1f} ± "
                f"{100 * measured.shift_std_along_m:.1f} cm relative to {agreeing}, "
                f"{100 * measured.shift_east_m:+.1f} cm east and {100 * measured.shift_north_m:+.1f} cm north"
                f"{_SPREAD * measured.spread}: positions, lever arms, path offsets or heights are wrong"
            ),
            **({_PHASE: _phase_line(measured, where, pair, chosen.reference)} if measured.out_of_phase else {}),
        }
    return {_PHASE: _phase_line(measured, where, pair, chosen.reference)}


def _phase_line(measured: Agreement, where: str, pair: str, reference: str) -> str:
    line = (
        f"phase of {pair} differs by {measured.phase_rad:+.2f} ± {measured.phase_std_rad:.2f} rad from {reference} "
        f"at {where}"
    )
    if measured.incoherent:
        return (
            f"{line}, coherence {measured.coherence:.2f}: no common phase; the position errors of one pair differ "
            "between points"
        )
    return f"{line}: path offsets or positions are wrong by a fraction of the wavelength"


def wrong_codes(codes: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Return pair, flag and line for each pair whose sidelink does not contain the configured code.

    If some receivers detect the configured code, the transmitter sent that code, and the other receivers recorded
    another transmitter. If no receiver detects the configured code, the transmitter sent another code, and all pairs of
    the transmitter are flagged.

    Parameters
    ----------
    codes
        Pair → `CodeEvidence` as in image.json.

    Examples
    --------
    >>> locked, other = {"carried": True, "evidence": "locked"}, {"carried": False, "evidence": "another code"}
    >>> wrong_codes({"a-a": {}, "a-b": other})
    [('a-a', 'wrong_code', 'another code; measured in a-b'), ('a-b', 'wrong_code', 'another code; measured in a-b')]
    >>> wrong_codes({"a-a": {}, "a-b": other, "a-c": locked})
    [('a-b', 'wrong_code', 'another code; the configured code was detected in a-c')]
    """
    carried = {pair: evidence.get("carried") for pair, evidence in codes.items()}
    flags = []
    for pair in codes:
        same_tx = [other for other in codes if other.split("-")[0] == pair.split("-")[0]]
        without_code = next((other for other in same_tx if carried[other] is False), None)
        if without_code and not any(carried[other] for other in same_tx):
            flags.append((pair, "wrong_code", f"{codes[without_code]['evidence']}; measured in {without_code}"))
        elif carried[pair] is False:
            detected = ", ".join(other for other in same_tx if carried[other])
            line = f"{codes[pair]['evidence']}; the configured code was detected in {detected}"
            flags.append((pair, "wrong_code", line))
    return flags
