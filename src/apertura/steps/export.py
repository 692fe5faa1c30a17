"""Rules of the export wing: rasters and pictures of one image, or of what a flight's images add up to."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rasterio import Affine

from apertura import __version__
from apertura.campaign import Campaign
from apertura.contracts import canonical_json
from apertura.export import EXPORTS
from apertura.geodesy import local_crs
from apertura.image.grid import LOCAL
from apertura.image.peaks import brightest, ground_position
from apertura.image.quality import entropy, noise_floor_db
from apertura.provenance import chained_sha256, code_sha256
from apertura.steps.scene import scene_grid
from apertura.store import open_stage, write_json

Image = NDArray[np.complex64]


def export(campaign: Campaign, flight: str, pair: str) -> list[Path]:
    """Write slc, power and db GeoTIFFs and the quicklook of one pair; return their paths."""
    dataset = open_stage(campaign.stage("image", flight, pair), "image")
    tags = _tags(dataset, dataset.attrs["quality"]["numerical_error_db"])
    title = f"{campaign.settings.campaign} · flight {flight} · {pair}"
    folder = campaign.results / flight / pair
    return [_write(campaign, folder / name, dataset.image.values, tags, title) for name in EXPORTS]


def export_fused(campaign: Campaign, flight: str) -> list[Path]:
    """Write the coherent and non-coherent sums of a flight's pairs, and image.json; return their paths."""
    dataset = open_stage(campaign.stage("cube"), "cube")
    index = dataset.attrs["flights"].index(flight)
    coherent = dataset.coherent.values[index]
    amplitude = np.sqrt(dataset.noncoherent.values[index]).astype(np.complex64)
    pairs = campaign.flight(flight).pairs
    images = [open_stage(campaign.stage("image", flight, pair), "image") for pair in pairs]
    error = max(image.attrs["quality"]["numerical_error_db"] for image in images)
    tags, folder = _tags(dataset, error), campaign.results / flight / "fused"
    title = f"{campaign.settings.campaign} · flight {flight} · coherent sum of {' + '.join(pairs)}"
    sums = {"coherent": coherent, "noncoherent": amplitude}
    written = [
        _write(campaign, folder / f"{kind}_{name}", sums[kind], tags, title)
        for kind, names in (("coherent", ("slc.tif", "power.tif", "db.tif")), ("noncoherent", ("power.tif", "db.tif")))
        for name in names
    ]
    report = folder / "image.json"
    write_json(report, _fused_report(campaign, flight, coherent, amplitude, error))
    return [*written, _write(campaign, folder / "quicklook.png", coherent, tags, title), report]


def _write(campaign: Campaign, path: Path, image: Image, tags: dict[str, str], title: str) -> Path:
    grid = scene_grid(campaign)
    crs = local_crs(campaign.settings.campaign) if grid.crs == LOCAL else grid.crs
    product = path.name.removeprefix("coherent_").removeprefix("noncoherent_")
    EXPORTS[product](path, image, transform=Affine(*grid.transform), crs=crs, tags=tags, title=title)
    return path


def _fused_report(campaign: Campaign, flight: str, coherent: Image, amplitude: Image, error: float) -> dict[str, Any]:
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


def _tags(dataset: xr.Dataset, error_db: float) -> dict[str, str]:
    """Return the tags of DESIGN section 6; the export's own code ends the chain."""
    return {
        "APERTURA_RUNSPEC": dataset.attrs["runspec"],
        "APERTURA_INPUTS": canonical_json(dataset.attrs["inputs"]),
        "APERTURA_CODE_SHA256": chained_sha256(code_sha256(__name__), [dataset.attrs["code_sha256"]]),
        "APERTURA_VERSION": __version__,
        "APERTURA_ERROR_DB": f"{error_db:.2f}",
    }
