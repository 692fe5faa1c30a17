"""Rules of the export wing: rasters and pictures of one image, or of what a flight's images add up to."""

from collections.abc import Mapping
from dataclasses import dataclass
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
from apertura.load.scene import settled_scene
from apertura.provenance import chained_sha256, code_sha256
from apertura.quality.measures import Raster, coherence_factor, survey
from apertura.quality.point_targets import Patch, find_peak
from apertura.scene.grid import SceneGrid
from apertura.store import open_stage, write_json


@dataclass(frozen=True)
class Amplitude:
    """A raster of power as complex amplitudes without phase, block by block."""

    power: xr.DataArray

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows, columns."""
        return self.power.shape

    def __getitem__(self, window: tuple[slice, slice]) -> NDArray[np.complex64]:
        return np.asarray(np.sqrt(self.power[window].values), np.complex64)


def export(campaign: Campaign, flight: str, pair: str) -> list[Path]:
    """Write slc, power and db GeoTIFFs and the quicklook of one pair, or of 'fused'; return their paths."""
    if pair == "fused":
        return export_fused(campaign, flight)
    dataset = open_stage(campaign.stage("image", flight, pair), "image")
    tags = _tags(dataset, dataset.attrs["quality"])
    title = f"{campaign.settings.campaign} · flight {flight} · {pair}"
    folder, grid = campaign.results / flight / pair, settled_scene(campaign).grid
    return [_write(grid, folder / name, dataset.image, tags, title) for name in EXPORTS]


def export_fused(campaign: Campaign, flight: str) -> list[Path]:
    """Write the coherent and non-coherent sums of a flight's pairs, and image.json; return their paths."""
    dataset = open_stage(campaign.stage("cube"), "cube")
    index = dataset.attrs["flights"].index(flight)
    coherent, amplitude = dataset.coherent[index], Amplitude(dataset.noncoherent[index])
    pairs = campaign.flight(flight).pairs
    images = [open_stage(campaign.stage("image", flight, pair), "image") for pair in pairs]
    quality = _worst(images)
    tags, folder = _tags(dataset, quality), campaign.results / flight / "fused"
    title = f"{campaign.settings.campaign} · flight {flight} · coherent sum of {' + '.join(pairs)}"
    grid = settled_scene(campaign).grid
    sums: dict[str, Raster] = {"coherent": coherent, "noncoherent": amplitude}
    written = [
        _write(grid, folder / f"{kind}_{name}", sums[kind], tags, title)
        for kind, names in (("coherent", ("slc.tif", "power.tif", "db.tif")), ("noncoherent", ("power.tif", "db.tif")))
        for name in names
    ]
    report = folder / "image.json"
    write_json(report, quality | _fused_report(campaign, flight, grid, sums, images))
    return [*written, _write(grid, folder / "quicklook.png", coherent, tags, title), report]


def _write(grid: SceneGrid, path: Path, image: Raster, tags: dict[str, str], title: str) -> Path:
    product = path.name.removeprefix("coherent_").removeprefix("noncoherent_")
    EXPORTS[product](path, image, transform=Affine(*grid.transform), crs=grid.crs_wkt, tags=tags, title=title)
    return path


def _fused_report(
    campaign: Campaign, flight: str, grid: SceneGrid, sums: dict[str, Raster], images: list[xr.Dataset]
) -> dict[str, Any]:
    windows = list(grid.tiles(campaign.settings.processing.tile_px))
    found = {kind: survey(layer, windows) for kind, layer in sums.items()}
    top = found["coherent"]
    peak = find_peak(sums["coherent"], top.row, top.column)
    x, y = map(float, grid.map_at(peak.row, peak.column))
    values = [
        complex(Patch(image.image, top.row, top.column).at(peak.row, peak.column))
        / image.attrs["quality"]["brightest"]["amplitude"]
        for image in images
    ]
    return {
        "flight": flight,
        "pairs": list(campaign.flight(flight).pairs),
        "entropy": {kind: round(layer.entropy, 6) for kind, layer in found.items()},
        "noise_floor_db": top.noise_floor_db,
        "brightest": {
            "x_m": round(x, 4),
            "y_m": round(y, 4),
            "amplitude": float(abs(peak.value)),
            "coherence_factor": coherence_factor(np.array(values)),
        },
        "flags": {name: line for image in images for name, line in image.attrs["flags"].items()},
    }


def _worst(images: list[xr.Dataset]) -> dict[str, Any]:
    """Return what the errors and models of some images say of their sum."""
    errors = ("numerical_error_db", "peak_error_db")
    fusion = "mean of the peak-normalised images, with and without phase"
    return {
        "models": {"fusion": fusion, "numerical_error": "that of the worst pair"},
        **{name: max(image.attrs["quality"][name] for image in images) for name in errors},
        "redone": [one for image in images for one in image.attrs["quality"]["redone"]],
    }


def _tags(dataset: xr.Dataset, quality: Mapping[str, Any]) -> dict[str, str]:
    """Return the tags of DESIGN section 6; the export's own code ends the chain."""
    return {
        "APERTURA_RUNSPEC": dataset.attrs["runspec"],
        "APERTURA_INPUTS": canonical_json(dataset.attrs["inputs"]),
        "APERTURA_CODE_SHA256": chained_sha256(code_sha256(__name__), [dataset.attrs["code_sha256"]]),
        "APERTURA_VERSION": __version__,
        "APERTURA_ERROR_DB": f"{quality['numerical_error_db']:.2f}",
        "APERTURA_PEAK_ERROR_DB": f"{quality['peak_error_db']:.2f}",
        "APERTURA_MODELS": canonical_json(quality["models"]),
        **({"APERTURA_REDONE": canonical_json(quality["redone"])} if quality["redone"] else {}),
    }
