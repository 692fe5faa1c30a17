"""Rules `export` and `export_fused`: rasters, pictures and report of one image, or of the sums of a flight's images."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from rasterio import Affine

from apertura.common.atomic import write_json
from apertura.common.flags import Flags
from apertura.common.provenance import Provenance, canonical_json, chained_sha256
from apertura.core.quality.measures import Amplitude, BlockRaster, image_statistics
from apertura.core.quality.point_targets import find_peak
from apertura.core.scene.grid import SceneGrid
from apertura.formats.export import write_exports
from apertura.formats.export.radiometry import ECHO, Radiometry, of_sums
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.digests import Lineage
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.results import assessment_of
from apertura.pipeline.opening.scene import settled_scene
from apertura.pipeline.steps.stamping import tags_of
from apertura.pipeline.store import open_stage, record_files


def export(campaign: Campaign, flight: str, pair: str) -> list[Path]:
    """Write the products of one pair, or of 'fused', and image.json; return their paths."""
    if pair == "fused":
        return export_fused(campaign, flight)
    lineage = result_of(campaign, "export", flight, pair).begin(campaign.root)
    image = open_stage(campaign.stage("image", flight, pair), "image")
    assessed = assessment_of(campaign, flight)
    agreed, quality = assessed["pairs"][pair], image.attrs["quality"]
    peak = quality["brightest"]["amplitude"]
    report = quality | {
        "reference": assessed["reference"],
        "agreement": agreed["agreement"],
        "hypotheses": assessed["hypotheses"],
        "flags": Flags.merged(image.attrs["flags"], agreed["flags"]),
        "radiometry": {"image": ECHO.measured(peak, quality["noise_floor_db"]).report},
    }
    origin = _with_code(Provenance.of(lineage.modules, [image]), assessed)
    folder = campaign.result(flight, pair)
    written = write_exports(
        "pair",
        folder,
        {"image": image.image},
        radiometry=report["radiometry"],
        titles={"image": f"{campaign.settings.campaign} · flight {flight} · {pair}"},
        tags=tags_of(origin, lineage) | _quality_tags(report),
        **_georeference(settled_scene(campaign).grid),
    )
    return _finish(folder, written, {"flight": flight, "pair": pair, **report}, lineage)


def export_fused(campaign: Campaign, flight: str) -> list[Path]:
    """Write the products of the sums of a flight's pairs, and image.json; return their paths."""
    lineage = result_of(campaign, "fused", flight).begin(campaign.root)
    cube = open_stage(campaign.stage("cube"), "cube")
    index = cube.attrs["flights"].index(flight)
    sums: dict[str, BlockRaster] = {"coherent": cube.coherent[index], "noncoherent": Amplitude(cube.noncoherent[index])}
    pairs, assessed = campaign.flight(flight).pairs, assessment_of(campaign, flight)
    images = {pair: open_stage(campaign.stage("image", flight, pair), "image") for pair in pairs}
    folder, grid = campaign.result(flight, "fused"), settled_scene(campaign).grid
    report = {
        **_worst(images, assessed["fusion"]),
        **_measures(grid, campaign.settings.processing.tile_px, sums, _divided(images, assessed["fusion"])),
        "fusion": assessed["fusion"],
        "coherence": _coherence(assessed),
        "agreement": cube.attrs["agreement"]["flights"].get(flight),
        "flags": Flags.merged(
            _flags(
                {
                    pair: Flags.merged(image.attrs["flags"], assessed["pairs"][pair]["flags"])
                    for pair, image in images.items()
                },
                assessed["fusion"]["left_out"],
            ),
            cube.attrs["flags"].get(flight, {}),
        ),
    }
    name, coherently = f"{campaign.settings.campaign} · flight {flight}", assessed["fusion"]["phases_rad"]
    titles = {
        "coherent": f"coherent sum of {' + '.join(coherently)}",
        "noncoherent": f"non-coherent sum of {' + '.join(pairs)}",
        "magnitude": f"sum of magnitudes of {' + '.join(pairs)}",
    }
    written = write_exports(
        "fused",
        folder,
        {**sums, "magnitude": cube.magnitude[index]},
        radiometry=report["radiometry"],
        titles={source: f"{name} · {words}" for source, words in titles.items()},
        tags=tags_of(_fused_provenance(lineage, cube, images, assessed), lineage) | _quality_tags(report),
        **_georeference(grid),
    )
    return _finish(folder, written, {"flight": flight, "pairs": list(pairs), **report}, lineage)


def _finish(folder: Path, written: list[Path], report: Mapping[str, Any], lineage: Lineage) -> list[Path]:
    """Write image.json beside the products, then the manifest of all."""
    files = [*written, folder / "image.json"]
    write_json(files[-1], report)
    record_files(folder / "export.manifest.json", files, lineage)
    return files


def _georeference(grid: SceneGrid) -> dict[str, Any]:
    return {"transform": Affine(*grid.transform), "crs": grid.crs_wkt}


def _with_code(origin: Provenance, assessed: Mapping[str, Any]) -> Provenance:
    """Return the provenance of a file, with the code that assessed its flight."""
    return replace(origin, code_sha256=chained_sha256(origin.code_sha256, [assessed["code_sha256"]]))


def _fused_provenance(
    lineage: Lineage, cube: xr.Dataset, images: Mapping[str, xr.Dataset], assessed: Mapping[str, Any]
) -> Provenance:
    """Return settings and inputs of the flight's own pairs, each apart, and the code that made the cube and its files.

    The cube stands on every flight; a file of one flight does not.
    """
    origin = Provenance.of(lineage.modules, images, settings={"fusion": assessed["fusion"]})
    return replace(origin, code_sha256=chained_sha256(lineage.result.code_sha256, [cube.attrs["code_sha256"]]))


def _divided(images: Mapping[str, xr.Dataset], fusion: Mapping[str, Any]) -> dict[str, Radiometry]:
    """Return the radiometry of the sums: the divisor of each pair."""
    peaks = {pair: image.attrs["quality"]["brightest"]["amplitude"] for pair, image in images.items()}
    return of_sums(peaks, fusion["phases_rad"])


def _measures(
    grid: SceneGrid, tile_px: int, sums: Mapping[str, BlockRaster], radiometry: Mapping[str, Radiometry]
) -> dict[str, Any]:
    """Return the image statistics of the sums."""
    windows = list(grid.tiles(tile_px))
    statistics = {source: image_statistics(layer, windows) for source, layer in sums.items()}
    top = statistics["coherent"]
    peak = find_peak(sums["coherent"], top.row, top.column)
    x, y = map(float, grid.map_at(peak.row, peak.column))
    peaks = {source: one.peak for source, one in statistics.items()} | {"coherent": float(abs(peak.value))}
    levels = {
        source: radiometry[source].measured(peaks[source], one.noise_floor_db) for source, one in statistics.items()
    }
    return {
        "radiometry": {source: one.report for source, one in {**radiometry, **levels}.items()},
        "entropy": {source: round(one.entropy, 6) for source, one in statistics.items()},
        "noise_floor_db": top.noise_floor_db,
        "brightest": {"x_m": round(x, 4), "y_m": round(y, 4), "amplitude": float(abs(peak.value))},
    }


def _coherence(assessed: Mapping[str, Any]) -> dict[str, float | int | None]:
    """Return |Σ z|²/P² of the P pairs added with their phases, z a pair's mean phasor against the reference.

    None where no pair's phase was measured.
    """
    added, agreed = assessed["fusion"]["phases_rad"], assessed["pairs"]
    reports = {pair: agreed[pair]["agreement"] for pair in added if agreed[pair]["agreement"]}
    chance = {"chance": round(1 / (len(reports) + 1), 4), "pairs": len(reports) + 1 if reports else 0}
    if not reports:
        return {"mean": None, **chance}
    phasors = [one["coherence"] * np.exp(1j * (one["phase_rad"] - added[pair])) for pair, one in reports.items()]
    return {"mean": round(float(abs(1 + sum(phasors)) ** 2) / (len(reports) + 1) ** 2, 4), **chance}


def _flags(of_pairs: Mapping[str, Mapping[str, str]], left_out: Mapping[str, str]) -> Flags:
    """Return the flags of all pairs, each line with its pairs unless all carry it, and the pairs that are left out."""
    raised: dict[str, dict[str, list[str]]] = {}
    for pair, flags in of_pairs.items():
        for flag, line in flags.items():
            raised.setdefault(flag, {}).setdefault(line, []).append(pair)
    flags = {
        flag: "; ".join(
            line if len(pairs) == len(of_pairs) else f"{' and '.join(pairs)}: {line}" for line, pairs in lines.items()
        )
        for flag, lines in raised.items()
    }
    alone = "; ".join(f"{pair} is not in the coherent sum: {why}" for pair, why in left_out.items())
    return Flags.merged(flags, {"pair_left_out": alone} if alone else {})


def _worst(images: Mapping[str, xr.Dataset], fusion: Mapping[str, Any]) -> dict[str, Any]:
    """Return the worst errors and models of the images, as those of their sum."""
    qualities = [image.attrs["quality"] for image in images.values()]
    worst = max(qualities, key=lambda quality: quality["numerical_error_db"])
    left_out = "".join(f"; without {pair}: {why}" for pair, why in fusion["left_out"].items())
    added = {pair: images[pair].attrs["quality"] for pair in fusion["phases_rad"]}
    verdicts = {quality["focus"]["verdict"]: pair for pair, quality in added.items()}
    verdict = next(one for one in ("defocused", "cannot tell", "focused") if one in verdicts)
    return {
        "focus": {"verdict": verdict, "why": f"the worst of the pairs added coherently, {verdicts[verdict]}"},
        "budgets": {pair: image.attrs["quality"]["budget"] for pair, image in images.items()},
        "models": {
            "fusion": f"mean of the peak-normalised images, with and without phase{left_out}",
            "numerical_error": "that of the worst pair",
        },
        "numerical_error_db": worst["numerical_error_db"],
        "numerical_error_confidence": round(1 - sum(1 - one["numerical_error_confidence"] for one in qualities), 4),
        "numerical_error_estimate_db": worst["numerical_error_estimate_db"],
        "instruction_set": ", ".join(sorted({quality["instruction_set"] for quality in qualities})),
        "peak_error_db": max(quality["peak_error_db"] for quality in qualities),
        "redone": [one for quality in qualities for one in quality["redone"]],
    }


def _quality_tags(report: Mapping[str, Any]) -> dict[str, str]:
    reports = {name: report[name] for name in ("budget", "budgets", "focus", "fusion", "redone") if report.get(name)}
    return {
        "APERTURA_INSTRUCTION_SET": report["instruction_set"],
        "APERTURA_ERROR_DB": f"{report['numerical_error_db']:.2f}",
        "APERTURA_ERROR_CONFIDENCE": f"{report['numerical_error_confidence']:.2f}",
        "APERTURA_PEAK_ERROR_DB": f"{report['peak_error_db']:.2f}",
        "APERTURA_FLAGS": canonical_json(report["flags"]),
        "APERTURA_MODELS": canonical_json(report["models"]),
        **{f"APERTURA_{name.upper()}": canonical_json(value) for name, value in reports.items()},
    }
