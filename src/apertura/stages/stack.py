"""Rules `stack_image` and `stack`: images of several flights, their phases referred to one reference flight."""

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio import Affine

from apertura.campaign.config import Stack
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_listed, open_stage, record_files
from apertura.common.arrays import Floats
from apertura.common.atomic import write_json, write_text
from apertura.common.contracts import Window
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.provenance import Provenance, canonical_json
from apertura.core.imaging.range_profiles import aperture_of
from apertura.core.scene.looks import Looks
from apertura.formats.export import write_exports
from apertura.methods.interferometry.coherence import chance, map_coherence, unbiased
from apertura.stages.agreement import opened_layer
from apertura.stages.image_tags import acquisition_tags
from apertura.stages.interferogram import legs_of, sensed_heights
from apertura.stages.multilook import LazyLayer
from apertura.stages.pair import OpenPair, open_pair
from apertura.stages.planning import gated, integration_of, weighing
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.tags import tags_of
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of
from apertura.workflow.rules import STACK

STACK_JSON = "stack.json"
"""Report on a flight of the stack, and on the whole stack."""

BASELINES = "baselines.csv"
"""Table of the flights of the stack."""

_COLUMNS = (
    "flight",
    "used",
    "start_utc",
    "temporal_baseline_days",
    "perpendicular_baseline_m",
    "along_track_offset_m",
    "height_of_ambiguity_m",
    "coherence",
    "expected_coherence",
    "residual_phase_std_rad",
    "reason",
)


@dataclass(frozen=True, eq=False)
class StackedImage:
    """Image of a flight of the stack, with its geometry.

    Attributes
    ----------
    opened, looks
        Pair with its geometry, and the pulses of each pixel.
    image
        (y, x) complex64.
    visible
        (y, x) bool, False in shadow, in layover and outside the beams.
    noise
        (y, x) float64, noise power of the pixels; NaN where it is unknown.
    stage
        Stage `image`.
    """

    opened: OpenPair
    looks: Looks
    image: NDArray[np.complex64]
    visible: NDArray[np.bool_]
    noise: Floats
    stage: Any


def open_stacked(campaign: Campaign, flight: str, pair: str, scene: OpenScene) -> StackedImage:
    """Open the image of a flight of the stack."""
    echo = PairEcho.cleaned(campaign, flight, pair).stage
    profile = open_stage(campaign.stage("profile", flight, pair), "profile")
    opened = gated(campaign, open_pair(campaign, flight, pair, echo=echo), scene)
    looks = Looks.of(scene.grid, scene.terrain, aperture_of(profile), weighing(campaign, opened, scene))
    stage = open_stage(campaign.stage("image", flight, pair), "image")
    with opened_layer(campaign, flight, pair, "mask.tif") as raster:
        visible, pulse_noise = raster.read(1) == 0, float(raster.tags()["APERTURA_PULSE_NOISE"])
    whole: Window = (slice(0, scene.grid.shape[0]), slice(0, scene.grid.shape[1]))
    # a pixel is Σw·profile over the count of integrated pulses: its noise power is Σw² times that of one pulse
    noise = pulse_noise / integration_of(campaign, opened, scene).count ** 2 * looks.weight_squares(whole)
    return StackedImage(opened, looks, stage.image.values, visible, np.asarray(noise, np.float64), stage)


def stack_image(campaign: Campaign, flight: str) -> list[Path]:
    """Write results/stack/<flight>: the image with the phase of the reference, coherence and stack.json.

    Parameters
    ----------
    campaign
        Campaign with a section `stack`.
    flight
        The reference or another flight of the stack.
    """
    requested = _requested(campaign)
    scene = open_scene(campaign)
    lineage = result_of(campaign, "stack_image", flight).begin(campaign.root)
    reference = open_stacked(campaign, requested.reference, requested.pair, scene)
    image = reference if flight == requested.reference else open_stacked(campaign, flight, requested.pair, scene)
    tiles = list(scene.grid.tiles(campaign.settings.processing.tile_px))
    magnitude, phase, looks, _ = map_coherence(image.image, reference.image, tiles, window=requested.window_px)
    common = reference.visible & image.visible & np.isfinite(magnitude)
    if image is reference:
        removed = np.zeros(scene.grid.shape, np.float32)
        expected = np.where(common, 1.0, np.nan)
    else:
        sum_of_phasors = (magnitude * np.exp(1j * phase.astype(np.float64)))[common].sum()
        removed = np.full(scene.grid.shape, np.angle(sum_of_phasors), np.float32)
        band = (float(image.opened.frequency_hz.min()), float(image.opened.frequency_hz.max()))
        legs = [legs_of(one.looks) for one in (image, reference)]
        expected = sensed_heights(scene, image.looks, legs, band).overlap
    corrected = (image.image * np.exp(-1j * removed.astype(np.float64))).astype(np.complex64)
    report = {
        "flight": flight,
        "pair": requested.pair,
        "reference": requested.reference,
        "used": True,
        "reason": None,
        "residual_track": {"terms": {"constant": float(removed[0, 0])}},
        "residual_phase_std_rad": 0.0,
        "perpendicular_baseline_m": 0.0,
        "along_track_offset_m": 0.0,
        "height_of_ambiguity_m": None,
        **_times(image, reference),
        "coherence": _median(unbiased(magnitude, looks) if looks > 1 else magnitude, common),
        "expected_coherence": _median(expected, common),
        "looks": round(looks, 3) if np.isfinite(looks) else None,
        "chance": round(chance(looks), 4) if looks > 1 else 1.0,
        "flags": Flags(),
    }
    origin = Provenance.of(
        lineage.modules,
        {name: one.stage for name, one in ((requested.reference, reference), (flight, image))},
        settings=lineage.result.settings,
    )
    rasters = {
        "stack_image": corrected,
        "residual_phase": removed,
        "stack_coherence": np.where(common, magnitude, np.nan).astype(np.float32),
        "expected_coherence": np.where(common, expected, np.nan).astype(np.float32),
        "line_of_sight": LazyLayer(scene.grid, np.float32, image.looks.line_of_sight_enu, 1, components=3),
        "slant_range": LazyLayer(scene.grid, np.float32, image.looks.slant_ranges_m, 1, components=2),
    }
    title = f"{campaign.settings.campaign} · stack of {requested.pair} · {flight}"
    folder = campaign.result(STACK, flight)
    views = {(flight, requested.pair): image.stage.attrs["quality"]["view"]}
    written = write_exports(
        "stack",
        folder,
        rasters,
        titles={source: f"{title} · {source.replace('_', ' ')}" for source in rasters},
        tags=tags_of(origin, lineage) | acquisition_tags(campaign, views) | _tags(report),
        transform=Affine(*scene.grid.transform),
        crs=scene.grid.crs_wkt,
    )
    written.append(folder / STACK_JSON)
    write_json(written[-1], report)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written


def _requested(campaign: Campaign) -> Stack:
    requested = campaign.settings.stack
    if requested is None:
        raise CampaignError(
            "no stack is configured", "config/config.yaml: stack", "a section stack", "Add the section to the config."
        )
    return requested


def _times(image: StackedImage, reference: StackedImage) -> dict[str, Any]:
    """Return the acquisition times of a flight, and the days since the reference flight."""
    times = [
        one.opened.began + np.array([0, one.opened.time_s[-1] / 2, one.opened.time_s[-1]]) * np.timedelta64(10**9, "ns")
        for one in (image, reference)
    ]
    names = ("start_utc", "middle_utc", "end_utc")
    stated = {name: f"{np.datetime_as_string(time, unit='us')}Z" for name, time in zip(names, times[0], strict=True)}
    days = float((times[0][1] - times[1][1]) / np.timedelta64(1, "D"))
    return {"acquisition": stated, "temporal_baseline_days": round(days, 6)}


def _median(values: NDArray[Any], common: NDArray[np.bool_]) -> float | None:
    known = values[common & np.isfinite(values)]
    return round(float(np.median(known)), 4) if known.size else None


def _tags(report: dict[str, Any]) -> dict[str, str]:
    return {
        "APERTURA_FLAGS": canonical_json(report["flags"]),
        "APERTURA_STACK_REFERENCE": report["reference"],
        "APERTURA_PERPENDICULAR_BASELINE_M": f"{report['perpendicular_baseline_m']:.4g}",
        "APERTURA_LOOKS": "none" if report["looks"] is None else f"{report['looks']:.2f}",
        "APERTURA_CHANCE": f"{report['chance']:.3f}",
    }


def stack(campaign: Campaign) -> list[Path]:
    """Write results/stack/baselines.csv and stack.json from the reports of all flights of the stack."""
    requested = _requested(campaign)
    lineage = result_of(campaign, "stack").begin(campaign.root)
    reports = [
        open_listed(
            campaign.result(STACK, flight, STACK_JSON), campaign.result(STACK, flight, "stack_image.manifest.json")
        )
        for flight in requested.all_flights
    ]
    folder = campaign.result(STACK)
    table = io.StringIO()
    writer = csv.DictWriter(table, _COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({**report, "start_utc": report["acquisition"]["start_utc"]} for report in reports)
    write_text(folder / BASELINES, table.getvalue())
    write_json(
        folder / STACK_JSON,
        {
            "reference": requested.reference,
            "pair": requested.pair,
            "flights": [report["flight"] for report in reports if report["used"]],
            "excluded": {report["flight"]: report["reason"] for report in reports if not report["used"]},
            "flags": {report["flight"]: report["flags"] for report in reports if report["flags"]},
        },
    )
    written: list[Path] = [folder / BASELINES, folder / STACK_JSON]
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written
