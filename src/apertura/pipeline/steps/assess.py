"""Rule `assess`: agreement of a flight's images, which of them to add, and hypotheses for bad ones."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.provenance import chained_sha256
from apertura.core.combination import choose_fusion
from apertura.core.focus.inputs import PhaseHistory
from apertura.core.imaging.focus_check import joint_peak_power
from apertura.core.quality.agreement import Agreement
from apertura.core.scene.grid import SceneGrid
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import OfdmWaveform, SampledWaveform
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.acquisition import Acquisition, open_acquisition
from apertura.pipeline.opening.autofocus import open_refined
from apertura.pipeline.opening.diagnosis import (
    Hypothesis,
    PairGeometry,
    evidence_of,
    hypotheses_of,
    moved_evidence,
    some_pulses,
)
from apertura.pipeline.opening.echo import pair_echo
from apertura.pipeline.opening.images import agreement_of, agreement_report, comparable, shows_points_of
from apertura.pipeline.opening.scene import OpenScene, open_scene, settled_scene
from apertura.pipeline.opening.transmitted import Transmitted, transmitted
from apertura.pipeline.steps.calibration import calibrated
from apertura.pipeline.store import open_stage, save_document

# ---- Hypotheses that would sharpen a bad image, tried on a bright place ---------------------------------------------

LEAST_GAIN_DB = 1.0
"""Least gain of the measure at which a hypothesis is reported; below 2 dB weak evidence (docs/theory/focus.md)."""

_SIDE_PX = 128
_PIXELS_PER_CELL = 2.5
_MOST_NAMED = 3


def hypotheses(
    campaign: Campaign, flight: str, *, brightest: tuple[float, float], cell_m: float
) -> list[dict[str, Any]]:
    """Return the hypotheses that would make the images of a flight sharper and agree, the best first.

    Parameters
    ----------
    campaign, flight
        Which.
    brightest
        Easting and northing of a bright place in the scene's CRS, metres.
    cell_m
        Resolution cell.

    Returns
    -------
    list
        what, kind, and gain_db: gain of the peak power at the bright place.
    """
    waveform = campaign.settings.waveform
    if not isinstance(waveform, SampledWaveform):
        return []
    sent = transmitted(campaign, waveform)
    logged = {node: open_acquisition(campaign, flight, node, sent) for node in campaign.flight(flight).nodes}
    window, track = campaign.settings.processing.window, open_refined(campaign, flight)
    found = [
        _evidence(logged, pair, open_stage(campaign.stage("echo", flight, pair), "echo"), window)
        for pair in campaign.flight(flight).pairs
    ]
    nodes = {name: track.node(node) for name, node in logged.items()}
    if track.correction is not None:
        found = moved_evidence(nodes, found)
    scene = open_scene(campaign)
    now = joint_peak_power([one.history for one in found], _around(scene, brightest, cell_m), scene.level.height_m)
    named: list[tuple[float, Hypothesis]] = []
    for hypothesis in chain(hypotheses_of(nodes, found), _other_echoes(campaign, flight, nodes, found, sent=sent)):
        grid = _around(scene, _moved(scene.grid, brightest, found, hypothesis.histories), cell_m)
        try:
            then = joint_peak_power(hypothesis.histories, grid, scene.level.height_m + hypothesis.height_m)
        except ValueError:  # the places are too far apart for one pulse: rejected
            continue
        gain_db = 10 * float(np.log10(max(then, 1e-12) / now))
        if gain_db > LEAST_GAIN_DB:
            named.append((gain_db, hypothesis))
    named.sort(key=lambda one: -one[0])
    return [{"what": one.what, "kind": one.kind, "gain_db": round(gain_db, 2)} for gain_db, one in named[:_MOST_NAMED]]


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
        echo = pair_echo(tx, rx, sent, campaign.settings.processing, calibration[one.pair])
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
    """Return the best hypothesis, to append to a flag; empty without one."""
    return f"; focus improves {named[0]['gain_db']:.1f} dB if {named[0]['what']}" if named else ""


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


# ---- Rule `assess`: agreement of a flight's images, and which are added ---------------------------------------------

_PHASE = "pairs_out_of_phase"
_LOOKS_WRONG = frozenset({"defocused", "echo_elsewhere", "pairs_apart", _PHASE, "pair_unconfirmed"})
"""Flags that a wrong geometry raises; hypotheses are tried where one is raised."""

_VISIBLE_SNR_DB = 20.0
"""A bright point this far above the noise should show in every image of the scene."""


def assess(campaign: Campaign, flight: str) -> Path:
    """Write results/<flight>/assessment.json: agreement of the pairs, hypotheses, members of the coherent sum."""
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
        and _visible(quality[reference]["focus"])
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
    # A path that is constant for a pair is invisible to the refinement of tracks: its phase is removed here.
    flags = _flags(found, reference, unconfirmed, taken_off={_PHASE} if refined else set())
    for pair, name, line in _wrong_codes(quality):
        flags[pair][name] = line
    named = _hypotheses(campaign, flight, images, flags, reference)
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
    """Return pair → flags of disagreement; both of two carry it, since their images do not show which is wrong.

    Flags in `taken_off`, as the phase of refined tracks, are corrected before pairs are added and not raised.
    """
    flags = {pair: Flags() for pair in (reference, *found)}
    for pair, one in found.items():
        raised = _disagreement(one, (reference, pair), certain=pair in unconfirmed)
        for side, (name, line) in product((pair, reference), raised.items()):
            if name not in taken_off:
                flags[side] = Flags.merged(flags[side], {name: line})
    return flags


def _unfit(found: Mapping[str, Agreement | None], unconfirmed: Collection[str], reference: str) -> dict[str, str]:
    """Return pair → reason, for pairs whose points lie elsewhere than the reference's: their phases mean nothing."""
    apart = {
        pair: f"its bright points lie {100 * one.shift_m:.1f} cm from those of {reference}"
        for pair, one in found.items()
        if one is not None and one.shifted
    }
    return apart | dict.fromkeys(unconfirmed, f"shows none of the bright points of {reference}")


def _hypotheses(
    campaign: Campaign,
    flight: str,
    images: Mapping[str, xr.Dataset],
    flags: dict[str, Flags],
    reference: str,
) -> list[dict[str, Any]]:
    """Try hypotheses where flags indicate a wrong geometry; append the best to these flags."""
    suspicious = {pair: _LOOKS_WRONG & {*images[pair].attrs["flags"], *raised} for pair, raised in flags.items()}
    if not any(suspicious.values()):
        return []
    quality = images[reference].attrs["quality"]
    brightest = quality["brightest"]["x_m"], quality["brightest"]["y_m"]
    named = hypotheses(campaign, flight, brightest=brightest, cell_m=quality["focus"]["cell_m"])
    for pair, names in suspicious.items():
        for name in names:
            line = flags[pair].get(name) or images[pair].attrs["flags"][name]
            flags[pair][name] = line + hypothesis_line(named)
    return named


def _rank(focus: Mapping[str, Any]) -> tuple[int, float]:
    """Return the rank of a pair's focus, the best first."""
    return ["focused", "defocused", "cannot tell"].index(focus["verdict"]), -focus.get("loss_db", 0.0)


def _visible(focus: Mapping[str, Any]) -> bool:
    return any(point["snr_db"] > _VISIBLE_SNR_DB for point in focus["points"])


def _disagreement(one: Agreement | None, pairs: tuple[str, str], *, certain: bool) -> dict[str, str]:
    """Return flags of the reference and another pair; their images alone do not show which of them is wrong."""
    reference, pair = pairs
    if one is None:
        line = f"{pair} shows none of the bright points of {reference}: its echo is too weak, or one of them is wrong"
        return {"pair_unconfirmed": line} if certain else {}
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
