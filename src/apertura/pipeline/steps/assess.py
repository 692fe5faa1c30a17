"""Rule `assess`: what the images of one flight say of each other, and which of them may be added up."""

from collections.abc import Collection, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import xarray as xr

from apertura.common.flags.raised import Flags
from apertura.common.provenance import chained_sha256
from apertura.core.combination.choice import choose_fusion
from apertura.core.quality.agreement import Agreement
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.agreement import agreement_of, agreement_report, comparable, shows_points_of
from apertura.pipeline.opening.refined import open_refined
from apertura.pipeline.opening.scene import settled_scene
from apertura.pipeline.steps.suspect import hypotheses, hypothesis_line
from apertura.pipeline.store import open_stage, save_document

_PHASE = "pairs_out_of_phase"
_LOOKS_WRONG = frozenset({"defocused", "echo_elsewhere", "pairs_apart", _PHASE, "pair_unconfirmed"})
"""Flags that a wrong geometry raises, and for which a remedy is looked for."""

_SURE_SNR_DB = 20.0
"""A bright point this far above the noise should show in every image of the scene."""


def assess(campaign: Campaign, flight: str) -> Path:
    """Write results/<flight>/assessment.json: how the pairs agree, what to look at, what the coherent sum holds."""
    lineage = result_of(campaign, "assessment", flight).begin(campaign.root)
    pairs, grid = campaign.flight(flight).pairs, settled_scene(campaign).grid
    images = {pair: open_stage(campaign.stage("image", flight, pair), "image") for pair in pairs}
    quality = {pair: image.attrs["quality"] for pair, image in images.items()}
    reference = min(pairs, key=lambda pair: (*_rank(quality[pair]["focus"]), pairs.index(pair)))
    found = {pair: agreement_of(images[reference], images[pair], grid) for pair in pairs if pair != reference}
    refined = open_refined(campaign, flight).correction is not None
    unconfirmed = {
        pair
        for pair, one in found.items()
        if one is None
        and _sure(quality[reference]["focus"])
        and comparable(images[reference], images[pair], grid)
        and (
            quality[pair]["focus"]["verdict"] == "defocused"
            or not shows_points_of(images[reference], images[pair], grid)
        )
    }
    fusion = choose_fusion(
        reference,
        found,
        unfit=_unfit(found, unconfirmed, reference),
        align=refined or campaign.settings.processing.fusion.align_phase,
    )
    # A path that is constant for a pair is what images do not tell of refined tracks: its phase was taken off.
    flags = _flags(found, reference, unconfirmed, taken_off={_PHASE} if refined else set())
    for pair, name, line in _wrong_codes(quality):
        flags[pair][name] = line
    named = _suspected(campaign, flight, images, flags, reference)
    report = {
        "flight": flight,
        "reference": reference,
        "hypotheses": named,
        "pairs": {pair: {"agreement": agreement_report(found.get(pair)), "flags": flags[pair]} for pair in pairs},
        "fusion": fusion.report,
        "code_sha256": chained_sha256(
            lineage.result.code_sha256, [image.attrs["code_sha256"] for image in images.values()]
        ),
    }
    path = campaign.result(flight, "assessment.json")
    save_document(path, report, lineage)
    return path


def _flags(
    found: Mapping[str, Agreement | None], reference: str, unconfirmed: Collection[str], *, taken_off: Collection[str]
) -> dict[str, Flags]:
    """Return pair → flags of disagreement; both of two carry it, since which is wrong their images cannot tell.

    What is `taken_off` before pairs are added, as the phase of tracks that were refined, is none.
    """
    flags = {pair: Flags() for pair in (reference, *found)}
    for pair, one in found.items():
        raised = _disagreement(one, (reference, pair), sure=pair in unconfirmed)
        for side, (name, line) in product((pair, reference), raised.items()):
            if name not in taken_off:
                flags[side] = Flags.merged(flags[side], {name: line})
    return flags


def _unfit(found: Mapping[str, Agreement | None], unconfirmed: Collection[str], reference: str) -> dict[str, str]:
    """Return pairs that show other places than the reference, whose phases there mean nothing → why."""
    apart = {
        pair: f"its bright points lie {100 * one.shift_m:.1f} cm from those of {reference}"
        for pair, one in found.items()
        if one is not None and one.shifted
    }
    return apart | dict.fromkeys(unconfirmed, f"shows none of the bright points of {reference}")


def _suspected(
    campaign: Campaign,
    flight: str,
    images: Mapping[str, xr.Dataset],
    flags: dict[str, Flags],
    reference: str,
) -> list[dict[str, Any]]:
    """Try what may be wrong where the images look so; put the best behind their flags."""
    looking = {pair: _LOOKS_WRONG & {*images[pair].attrs["flags"], *raised} for pair, raised in flags.items()}
    if not any(looking.values()):
        return []
    quality = images[reference].attrs["quality"]
    brightest = quality["brightest"]["x_m"], quality["brightest"]["y_m"]
    named = hypotheses(campaign, flight, brightest=brightest, cell_m=quality["focus"]["cell_m"])
    for pair, names in looking.items():
        for name in names:
            line = flags[pair].get(name) or images[pair].attrs["flags"][name]
            flags[pair][name] = line + hypothesis_line(named)
    return named


def _rank(focus: Mapping[str, Any]) -> tuple[int, float]:
    """Return how little a pair's focus is to be trusted."""
    return ["focused", "defocused", "cannot tell"].index(focus["verdict"]), -focus.get("loss_db", 0.0)


def _sure(focus: Mapping[str, Any]) -> bool:
    return any(point["snr_db"] > _SURE_SNR_DB for point in focus["points"])


def _disagreement(one: Agreement | None, pairs: tuple[str, str], *, sure: bool) -> dict[str, str]:
    """Return flags of the reference and another pair: which of them is wrong, their images alone cannot tell."""
    reference, pair = pairs
    if one is None:
        line = f"{pair} shows none of the bright points of {reference}: its echo is too weak, or one of them is wrong"
        return {"pair_unconfirmed": line} if sure else {}
    raised = {}
    if one.shifted:
        raised["pairs_apart"] = (
            f"{one.points} bright points of {pair} lie {100 * one.shift_m:.1f} ± {100 * one.shift_std_m:.1f} cm from "
            f"where {reference} has them, {100 * one.shift_east_m:+.1f} cm east and {100 * one.shift_north_m:+.1f} cm "
            "north: positions, lever arms, path offsets or heights of one are wrong"
        )
    if one.out_of_phase:
        raised[_PHASE] = (
            f"{pair} is {one.phase_rad:+.2f} ± {one.phase_std_rad:.2f} rad from {reference} at {one.points} bright "
            "points: path offsets or positions of one are wrong by a fraction of the wavelength"
        )
    return raised


def _wrong_codes(quality: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Return pair, flag and line for each pair of a transmitter whose sidelink carries another code."""
    evidence = {
        pair.split("-")[0]: (pair, one["code"]["evidence"])
        for pair, one in quality.items()
        if one.get("code", {}).get("carried") is False
    }
    return [
        (pair, "wrong_code", f"{evidence[tx][1]} (seen by {evidence[tx][0]})")
        for pair, tx in ((pair, pair.split("-")[0]) for pair in quality)
        if tx in evidence
    ]
