"""Rule `change`: changes of a flight of the stack relative to the reference flight, as rasters and polygons."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio import Affine

from apertura.campaign.folder import Campaign
from apertura.campaign.store import check_listed, open_listed, open_stage, record_files, remake_from
from apertura.common.atomic import write_json
from apertura.common.errors import number_of
from apertura.common.provenance import Provenance, canonical_json
from apertura.common.raster import opened_raster
from apertura.core.scene.grid import SceneGrid
from apertura.formats.export import write_exports
from apertura.formats.export.change import ChangedRegions
from apertura.methods.change.detection import (
    CLASS_NAMES,
    Changes,
    Region,
    change_flags,
    change_regions,
    detect_changes,
)
from apertura.stages.image_tags import acquisition_tags
from apertura.stages.scene import settled_scene
from apertura.stages.stack import STACK_JSON, requested_stack
from apertura.stages.tags import tags_of
from apertura.workflow.lineage import result_of
from apertura.workflow.rules import STACK

CHANGE_JSON = "change.json"
"""Report on the changes of a flight."""

POINT_HEIGHT_STD_M = 1.0
"""Standard deviation of the height of a point above the assumed terrain; its phase is that of a baseline."""


def change(campaign: Campaign, flight: str) -> list[Path]:
    """Write results/stack/<flight>: amplitude ratio, loss of coherence, classes, regions and change.json.

    Parameters
    ----------
    campaign
        Campaign with a section `stack`.
    flight
        Flight of the stack other than the reference.

    Raises
    ------
    CampaignError
        If the flight is not in the stack, or is the reference.
    """
    lineage = result_of(campaign, "change", flight).begin(campaign.root)
    grid, stack = settled_scene(campaign).grid, requested_stack(campaign)
    names = (stack.reference, flight)
    reference, image = (_read(campaign, name, "slc.tif") for name in names)
    expected = _read(campaign, flight, "expected_coherence.tif")
    folder = campaign.result(STACK, flight)
    stacked = open_listed(folder / STACK_JSON, folder / "stack_image.manifest.json")
    if not stacked["used"]:
        expected = np.full_like(expected, np.nan)
    of_height = 2 * np.pi * POINT_HEIGHT_STD_M / (stacked["height_of_ambiguity_m"] or np.inf)
    phase_std_rad = float(np.hypot(stacked["residual_phase_std_rad"] or 0.0, of_height))
    window, rate = stack.window_px, stack.change.false_alarm_rate
    changes = detect_changes(reference, image, expected, window=window, rate=rate, phase_std_rad=phase_std_rad)
    least_pixels = stack.change.smallest_m2 / grid.spacing_m**2
    regions, labels = change_regions(changes, window=window, least_pixels=least_pixels)
    report = _report(changes, regions, window, rate, grid, stacked)
    rows = [{**row, "reference": stack.reference, "flight": flight} for row in report["regions"]]
    rasters: dict[str, Any] = {
        "amplitude_ratio": changes.ratio_db,
        "coherence_loss": changes.coherence_loss,
        "change": changes.classes,
        "change_regions": ChangedRegions(labels, rows, stacked["acquisition"]["end_utc"][:23] + "Z"),
    }
    title = f"{campaign.settings.campaign} · changes of {flight} relative to {stack.reference}"
    stages = {name: open_stage(campaign.stage("image", name, stack.pair), "image") for name in names}
    origin = Provenance.of(lineage.modules, stages, settings=lineage.result.settings)
    tags = {
        "APERTURA_FLAGS": canonical_json(report["flags"]),
        "APERTURA_STACK_REFERENCE": stack.reference,
        "APERTURA_LOOKS": f"{changes.looks:.2f}",
        "APERTURA_CHANGE": report["says"],
    }
    views = {(flight, stack.pair): stages[flight].attrs["quality"]["view"]}
    written = write_exports(
        "change",
        folder,
        rasters | {"change_panels": rasters},
        titles=dict.fromkeys([*rasters, "change_panels"], title),
        tags=tags_of(origin, lineage) | acquisition_tags(campaign, views) | tags,
        transform=Affine(*grid.transform),
        crs=grid.crs_wkt,
    )
    written.append(folder / CHANGE_JSON)
    write_json(written[-1], report)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written


def _read(campaign: Campaign, flight: str, file: str) -> NDArray[Any]:
    """Read a raster of step stack-image that agrees with its manifest."""
    path, manifest = campaign.result(STACK, flight, file), campaign.result(STACK, flight, "stack_image.manifest.json")
    check_listed(path, manifest)
    with opened_raster(path, expected="a raster of step stack-image", remedy=remake_from(manifest)) as raster:
        values: NDArray[Any] = raster.read(1)
    return values


def _report(
    changes: Changes, regions: Sequence[Region], window: int, rate: float, grid: SceneGrid, stacked: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the values of change.json."""
    counts = {name: int((changes.classes == value).sum()) for value, name in CLASS_NAMES.items()}
    rows = []
    for region in regions:
        x_m, y_m = grid.map_at(region.row, region.column)
        rows.append(
            {
                "kind": region.kind,
                "area_m2": round(region.pixels * grid.spacing_m**2, 4),
                "ratio_db": round(region.ratio_db, 2),
                "coherence": round(region.coherence, 4),
                "coherence_loss": round(region.coherence_loss, 4),
                "p_value": float(f"{region.probability:.3g}"),
                "expected_false": float(f"{region.expected_false:.3g}"),
                "confidence": round(region.confidence, 6),
                "x_m": round(float(x_m), 3),
                "y_m": round(float(y_m), 3),
            }
        )
    flags = change_flags(changes)
    return {
        "reference": stacked["reference"],
        "flight": stacked["flight"],
        "pair": stacked["pair"],
        "used": stacked["used"],
        "false_alarm_rate": rate,
        "pixels": counts,
        "expected_false_pixels": round(rate * changes.valid, 2),
        "expected_false_regions": round(rate * changes.tests(window), 3),
        "windows": round(changes.valid / window**2, 1),
        "looks": round(changes.looks, 3),
        "matched_looks": round(changes.matched, 3),
        "gain_db": round(changes.gain_db, 3),
        "scene_coherence_ratio": round(changes.scene_ratio, 4),
        "expected_coherence": round(changes.expected, 4),
        "least_unchanged_coherence": round(changes.least_detected, 4),
        "regions": rows,
        "says": _summary(changes, rows, rate, window, stacked),
        "flags": flags,
    }


def _summary(
    changes: Changes, rows: Sequence[Mapping[str, Any]], rate: float, window: int, stacked: Mapping[str, Any]
) -> str:
    """Return a one-line summary: regions, their area, and false alarms."""
    if not stacked["used"]:
        return f"left out of the stack: {stacked['reason']}"
    if not changes.valid:
        return "no window with data in both flights"
    certain = sum(row["confidence"] > 0.95 for row in rows)
    area_m2 = sum(row["area_m2"] for row in rows)
    return (
        f"{number_of(len(rows), 'changed region')}, {area_m2:.3g} m², {certain} with a confidence above 0.95; at most "
        f"{rate * changes.tests(window):.2g} false regions expected at a false-alarm rate of {rate:g} per pixel"
    )
