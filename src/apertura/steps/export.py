"""Rules of the export wing: rasters and pictures of one image, or of what a flight's images add up to."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from rasterio import Affine

from apertura import __version__
from apertura.campaign import Campaign
from apertura.contracts import canonical_json
from apertura.export import write_db, write_power, write_quicklook, write_slc
from apertura.image.grid import LOCAL, SceneGrid
from apertura.image.peaks import brightest, ground_position
from apertura.image.quality import entropy, noise_floor_db
from apertura.geodesy import local_crs
from apertura.provenance import chained_sha256, code_sha256
from apertura.steps.scene import scene_grid
from apertura.store import open_stage, write_json


def export(campaign: Campaign, flight: str, pair: str) -> list[Path]:
    """Write slc, power and db GeoTIFFs and the quicklook of one pair; return their paths."""
    dataset = open_stage(campaign.stage("image", flight, pair), "image")
    folder = campaign.results / flight / pair
    place, tags = _place(campaign), _tags(dataset, dataset.attrs["quality"]["numerical_error_db"])
    written = _rasters(folder, "", dataset.image.values, [write_slc, write_power, write_db], place, tags)
    quicklook = folder / "quicklook.png"
    error = dataset.attrs["quality"]["numerical_error_db"]
    write_quicklook(
        quicklook,
        dataset.image.values,
        title=f"{campaign.settings.campaign} · flight {flight} · {pair}",
        footer=_footer(tags, f"numerical error {error:.1f} dB"),
        **place,
    )
    return [*written, quicklook]


def export_fused(campaign: Campaign, flight: str) -> list[Path]:
    """Write the coherent and non-coherent sums of a flight's pairs, and image.json; return their paths."""
    dataset = open_stage(campaign.stage("cube"), "cube")
    index = dataset.attrs["flights"].index(flight)
    coherent = dataset.coherent.values[index]
    amplitude = np.sqrt(dataset.noncoherent.values[index]).astype(np.complex64)
    folder = campaign.results / flight / "fused"
    error = max(
        open_stage(campaign.stage("image", flight, pair), "image").attrs["quality"]["numerical_error_db"]
        for pair in campaign.flight(flight).pairs
    )
    place, tags = _place(campaign), _tags(dataset, error)
    written = _rasters(folder, "coherent_", coherent, [write_slc, write_power, write_db], place, tags)
    written += _rasters(folder, "noncoherent_", amplitude, [write_power, write_db], place, tags)
    quicklook = folder / "quicklook.png"
    pairs = " + ".join(campaign.flight(flight).pairs)
    write_quicklook(
        quicklook,
        coherent,
        title=f"{campaign.settings.campaign} · flight {flight} · coherent sum of {pairs}",
        footer=_footer(tags, f"numerical error of the parts ≤ {error:.1f} dB"),
        **place,
    )
    report = folder / "image.json"
    write_json(report, _fused_report(campaign, flight, coherent, amplitude, error))
    return [*written, quicklook, report]


def _fused_report(
    campaign: Campaign, flight: str, coherent: np.ndarray, amplitude: np.ndarray, error: float
) -> dict[str, Any]:
    peak = brightest(coherent)
    x, y = ground_position(scene_grid(campaign), peak)
    return {
        "flight": flight,
        "pairs": list(campaign.flight(flight).pairs),
        "models": {"fusion": "mean of the peak-normalised images, with and without phase"},
        "numerical_error_db": error,
        "entropy": {"coherent": round(entropy(coherent), 6), "noncoherent": round(entropy(amplitude), 6)},
        "noise_floor_db": round(noise_floor_db(coherent), 3),
        "brightest": {"x_m": round(x, 4), "y_m": round(y, 4), "amplitude": float(abs(peak.value))},
        "flags": {},
    }


def _place(campaign: Campaign) -> dict[str, Any]:
    grid: SceneGrid = scene_grid(campaign)
    crs = local_crs(campaign.settings.campaign) if grid.crs == LOCAL else grid.crs
    return {"transform": Affine(*grid.transform), "crs": crs}


def _tags(dataset: xr.Dataset, error_db: float) -> dict[str, str]:
    """Return the tags of DESIGN section 6; the export's own code ends the chain."""
    return {
        "APERTURA_RUNSPEC": dataset.attrs["runspec"],
        "APERTURA_INPUTS": canonical_json(dataset.attrs["inputs"]),
        "APERTURA_CODE_SHA256": chained_sha256(code_sha256(__name__), [dataset.attrs["code_sha256"]]),
        "APERTURA_VERSION": __version__,
        "APERTURA_ERROR_DB": f"{error_db:.2f}",
    }


def _footer(tags: dict[str, str], error: str) -> str:
    return f"apertura {tags['APERTURA_VERSION']} · {error} · code {tags['APERTURA_CODE_SHA256'][:12]}"


def _rasters(
    folder: Path,
    prefix: str,
    image: np.ndarray,
    writers: list[Callable[..., None]],
    place: dict[str, Any],
    tags: dict[str, str],
) -> list[Path]:
    written = []
    for write in writers:
        path = folder / f"{prefix}{write.__name__.removeprefix('write_')}.tif"
        write(path, image, tags=tags, **place)
        written.append(path)
    return written
