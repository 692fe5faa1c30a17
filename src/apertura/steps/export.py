"""Rules `export` and `export_fused`: rasters and pictures of one image, or of what a flight's images add up to."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import xarray as xr
from rasterio import Affine

from apertura.atomic import write_json
from apertura.campaign import Campaign
from apertura.export import export_modules, write_exports
from apertura.load.scene import settled_scene
from apertura.provenance import Provenance, canonical_json, chained_sha256, code_sha256
from apertura.quality.fused import Amplitude, coherence_of_images
from apertura.quality.measures import Raster, survey
from apertura.quality.point_targets import find_peak
from apertura.scene.grid import SceneGrid
from apertura.store import open_stage


def export(campaign: Campaign, flight: str, pair: str) -> list[Path]:
    """Write the products of one pair, or of 'fused'; return their paths."""
    if pair == "fused":
        return export_fused(campaign, flight)
    image = open_stage(campaign.stage("image", flight, pair), "image")
    origin = Provenance.of([__name__, *export_modules("pair")], [image])
    return write_exports(
        "pair",
        campaign.results / flight / pair,
        {"image": image.image},
        titles={"image": f"{campaign.settings.campaign} · flight {flight} · {pair}"},
        tags=origin.tags() | _quality_tags(image.attrs["quality"], image.attrs["flags"]),
        **_georeference(settled_scene(campaign).grid),
    )


def export_fused(campaign: Campaign, flight: str) -> list[Path]:
    """Write the products of the sums of a flight's pairs, and image.json; return their paths."""
    cube = open_stage(campaign.stage("cube"), "cube")
    index = cube.attrs["flights"].index(flight)
    sums: dict[str, Raster] = {"coherent": cube.coherent[index], "noncoherent": Amplitude(cube.noncoherent[index])}
    pairs = campaign.flight(flight).pairs
    images = {pair: open_stage(campaign.stage("image", flight, pair), "image") for pair in pairs}
    quality, name = _worst(list(images.values())), f"{campaign.settings.campaign} · flight {flight}"
    titles = {"coherent": "coherent sum", "noncoherent": "non-coherent sum"}
    folder, grid = campaign.results / flight / "fused", settled_scene(campaign).grid
    written = write_exports(
        "fused",
        folder,
        sums,
        titles={source: f"{name} · {words} of {' + '.join(pairs)}" for source, words in titles.items()},
        tags=_fused_provenance(cube, images).tags() | _quality_tags(quality, _flags(images)),
        **_georeference(grid),
    )
    report = folder / "image.json"
    found = _measures(grid, campaign.settings.processing.tile_px, sums, images)
    write_json(report, {"flight": flight, "pairs": list(pairs), **quality, **found})
    return [*written, report]


def _georeference(grid: SceneGrid) -> dict[str, Any]:
    return {"transform": Affine(*grid.transform), "crs": grid.crs_wkt}


def _fused_provenance(cube: xr.Dataset, images: Mapping[str, xr.Dataset]) -> Provenance:
    """Return settings and inputs of the flight's own pairs, each apart, and the code that made the cube and its files.

    The cube stands on every flight; a file of one flight does not.
    """
    modules = [__name__, *export_modules("fused")]
    code = chained_sha256(code_sha256(*modules), [cube.attrs["code_sha256"]])
    return replace(Provenance.of(modules, images), code_sha256=code)


def _measures(
    grid: SceneGrid, tile_px: int, sums: Mapping[str, Raster], images: Mapping[str, xr.Dataset]
) -> dict[str, Any]:
    """Return what the pixels of the sums tell, and the flags of the images."""
    windows = list(grid.tiles(tile_px))
    surveys = {source: survey(layer, windows) for source, layer in sums.items()}
    top = surveys["coherent"]
    peak = find_peak(sums["coherent"], top.row, top.column)
    x, y = map(float, grid.map_at(peak.row, peak.column))
    amplitudes = [image.attrs["quality"]["brightest"]["amplitude"] for image in images.values()]
    coherence = coherence_of_images([image.image for image in images.values()], amplitudes, (top.row, top.column), peak)
    return {
        "entropy": {source: round(one.entropy, 6) for source, one in surveys.items()},
        "noise_floor_db": top.noise_floor_db,
        "brightest": {
            "x_m": round(x, 4),
            "y_m": round(y, 4),
            "amplitude": float(abs(peak.value)),
            "coherence_factor": coherence,
        },
        "flags": _flags(images),
    }


def _flags(images: Mapping[str, xr.Dataset]) -> dict[str, str]:
    """Return the flags of all pairs; where pairs say different things of one flag, each with its name."""
    raised: dict[str, dict[str, str]] = {}
    for pair, image in images.items():
        for flag, line in image.attrs["flags"].items():
            raised.setdefault(flag, {})[pair] = line
    return {
        flag: next(iter(lines.values()))
        if len(set(lines.values())) == 1
        else "; ".join(f"{pair}: {line}" for pair, line in lines.items())
        for flag, lines in raised.items()
    }


def _worst(images: Sequence[xr.Dataset]) -> dict[str, Any]:
    """Return what the errors and models of some images say of their sum."""
    qualities = [image.attrs["quality"] for image in images]
    worst = max(qualities, key=lambda quality: quality["numerical_error_db"])
    return {
        "models": {
            "fusion": "mean of the peak-normalised images, with and without phase",
            "numerical_error": "that of the worst pair",
        },
        "numerical_error_db": worst["numerical_error_db"],
        "numerical_error_confidence": worst["numerical_error_confidence"],
        "numerical_error_estimate_db": worst["numerical_error_estimate_db"],
        "peak_error_db": max(quality["peak_error_db"] for quality in qualities),
        "redone": [one for quality in qualities for one in quality["redone"]],
    }


def _quality_tags(quality: Mapping[str, Any], flags: Mapping[str, str]) -> dict[str, str]:
    return {
        "APERTURA_ERROR_DB": f"{quality['numerical_error_db']:.2f}",
        "APERTURA_ERROR_CONFIDENCE": f"{quality['numerical_error_confidence']:.2f}",
        "APERTURA_PEAK_ERROR_DB": f"{quality['peak_error_db']:.2f}",
        "APERTURA_FLAGS": canonical_json(flags),
        "APERTURA_MODELS": canonical_json(quality["models"]),
        **({"APERTURA_REDONE": canonical_json(quality["redone"])} if quality["redone"] else {}),
    }
