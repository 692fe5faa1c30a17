"""Rule `interferogram`: coherence, unwrapped phase and heights of two images of one scene."""

from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from rasterio import Affine

from apertura.common.atomic import write_json
from apertura.common.provenance import Provenance, canonical_json
from apertura.formats.export import write_exports
from apertura.methods.interferometry.comparison import Interferogram, form_interferogram, interferogram_flags
from apertura.methods.interferometry.heights import Level
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.scene import open_scene
from apertura.pipeline.opening.two_images import TwoImages, open_two
from apertura.pipeline.rules import INTERFEROMETRY
from apertura.pipeline.steps.stamping import tags_of
from apertura.pipeline.store import record_files


def interferogram(campaign: Campaign, name: str) -> list[Path]:
    """Write results/interferometry/<name>: GeoTIFFs, a picture and interferogram.json; return their paths.

    Parameters
    ----------
    campaign
        Settings and flights.
    name
        A key of `interferometry.pairs`.

    Raises
    ------
    CampaignError
        If there is no such key, or the two images are of other frequencies.
    """
    scene = open_scene(campaign)
    two = open_two(campaign, name, scene)
    lineage = result_of(campaign, "interferogram", name).begin(campaign.root)
    tiles = scene.grid.tiles(campaign.settings.processing.tile_px)
    first, second = (stage.image for stage in two.images)
    window = campaign.settings.interferometry.window_px
    found = form_interferogram(first, second, two.ground, tiles, window=window)
    origin = Provenance.of(
        lineage.modules,
        dict(zip(two.names, two.images, strict=True)),
        settings=lineage.result.settings,
    )
    report = _report(found, two)
    folder = campaign.result(INTERFEROMETRY, name)
    title = f"{campaign.settings.campaign} · {two.names[0]} against {two.names[1]}"
    written = write_exports(
        "interferogram",
        folder,
        {**found.panels, "panels": found.panels},
        titles={source: f"{title} · {source}" for source in found.panels} | {"panels": title},
        tags=tags_of(origin, lineage) | _tags(report),
        transform=Affine(*scene.grid.transform),
        crs=scene.grid.crs_wkt,
    )
    written.append(folder / "interferogram.json")
    write_json(written[-1], report)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written


def _report(found: Interferogram, two: TwoImages) -> dict[str, Any]:
    """Return the values of interferogram.json."""
    flagged = {name: stage.attrs["flags"] for name, stage in zip(two.names, two.images, strict=True)}
    stds = found.panels["height_std"]
    there = stds[np.isfinite(stds)]
    std_m = round(float(np.median(there)), 4) if there.size else None
    measured = {key: round(one, 4) if isinstance(one, float) else one for key, one in asdict(found.measured).items()}
    return {
        "images": list(two.names),
        "flags_of_images": {name: flags for name, flags in flagged.items() if flags},
        "looks": round(found.looks, 3) if isfinite(found.looks) else None,
        "measured": measured,
        "level": None if found.level is None else {**asdict(found.level), "says": _level_line(found.level)},
        "height_std_m": std_m,
        "says": _summary(found, std_m),
        "flags": interferogram_flags(found.measured),
    }


def _summary(found: Interferogram, std_m: float | None) -> str:
    """Return the outcome in one line."""
    coherence = f"coherence {found.measured.coherence:.2f}, {found.measured.chance:.2f} by chance"
    if found.level is None or std_m is None:
        return f"{coherence}; no heights"
    return (
        f"{coherence}; heights to {std_m:.2g} m, {found.measured.ambiguity_m:.3g} m for a turn of the phase; "
        f"{_level_line(found.level)}"
    )


def _level_line(level: Level) -> str:
    """Return the reference of the heights in one line."""
    if not level.points:
        return "heights count from the terrain: the median phase is taken for none"
    spread = "" if level.spread_rad is None else f", which agree to {level.spread_rad:.2f} rad"
    known = "" if level.std_rad is None else f", known to {level.std_rad:.2f} rad"
    return f"heights count from {' and '.join(level.points)}{spread}{known}"


def _tags(report: dict[str, Any]) -> dict[str, str]:
    measured = report["measured"]
    needed = measured["by"] or "no: snaphu is not installed"
    return {
        "APERTURA_FLAGS": canonical_json(report["flags"]),
        "APERTURA_LEVEL": report["level"]["says"] if report["level"] else "no heights",
        "APERTURA_LOOKS": "none" if report["looks"] is None else f"{report['looks']:.2f}",
        "APERTURA_CHANCE": f"{measured['chance']:.3f}",
        "APERTURA_UNWRAPPED": needed if measured["jumps"] else "not needed: no jumps",
    }
