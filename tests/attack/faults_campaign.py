"""Smallest campaign with every step: a calibration flight, an imaging flight, a DEM and tiles."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio
import yaml
from rasterio.transform import from_origin

from apertura.simulation import ImageGrid, preset, simulate
from apertura.simulation.targets import PointTarget

STEPS = (
    "ingest c01 uav1",
    "ingest c01 uav2",
    "ingest f01 uav1",
    "ingest f01 uav2",
    "echo c01 uav1-uav1",
    "echo c01 uav1-uav2",
    "calibrate c01",
    "echo f01 uav1-uav1",
    "echo f01 uav1-uav2",
    "scene",
    "terrain",
    "profile f01 uav1-uav1",
    "profile f01 uav1-uav2",
    "refine f01",
    "tracks f01",
    "tiles f01 uav1-uav2 1-of-2",
    "image f01 uav1-uav1",
    "image f01 uav1-uav2",
    "assess f01",
    "cube",
    "layers f01 uav1-uav1",
    "layers f01 uav1-uav2",
    "export f01 uav1-uav1",
    "export f01 uav1-uav2",
    "export f01 fused",
    "coverage",
    "mosaic",
    "map",
    "stac",
    "ro-crate",
)
"""All commands of a run in order."""

TARGETS = (
    "ingest f01 uav2",
    "echo f01 uav1-uav2",
    "calibrate c01",
    "scene",
    "terrain",
    "profile f01 uav1-uav2",
    "refine f01",
    "tracks f01",
    "tiles f01 uav1-uav2 1-of-2",
    "image f01 uav1-uav2",
    "assess f01",
    "cube",
    "layers f01 uav1-uav2",
    "export f01 uav1-uav2",
    "export f01 fused",
    "coverage",
    "mosaic",
    "map",
    "stac",
    "ro-crate",
)
"""One command per kind of step."""


def make_campaign(folder: Path, *, pulses: int = 40, half_width_m: float = 1.6) -> Path:
    """Write the campaign: 64 x 64 pixels in four tiles."""
    plan = replace(preset("demo", pulses=pulses), scene=ImageGrid("EPSG:32632", half_width_m, spacing_m=0.05))
    calibration = replace(plan.flights[0], name="c01", kind="calibration", targets=(PointTarget((0.0, 0.0, 0.0), 5.0),))
    imaging = replace(plan.flights[0], start_utc="2025-05-14T10:00:00")
    root = simulate(folder / "campaign", replace(plan, flights=(calibration, imaging)), seed=21)
    truth = json.loads((root / "truth.json").read_text())["targets"][0]
    path = root / "config" / "config.yaml"
    document = yaml.safe_load(path.read_text())
    document["calibration"] = {"flight": "c01", "reflector_m": [truth["x"], truth["y"], truth["height_m"]]}
    document["processing"] = {"tile_px": 32}
    document["scene"] |= {"dem": "dem.tif", "dem_datum": "ellipsoid"}
    path.write_text(yaml.safe_dump(document))
    _write_dem(root / "dem.tif", document["scene"]["bounds_m"], document["scene"]["height_m"])
    return root


def _write_dem(path: Path, bounds_m: list[float], height_m: float) -> None:
    west, north = np.floor(bounds_m[0]) - 10, np.ceil(bounds_m[3]) + 10
    profile = {"driver": "GTiff", "width": 40, "height": 40, "count": 1, "dtype": "float64", "crs": "EPSG:32632"}
    with rasterio.open(path, "w", transform=from_origin(west, north, 1, 1), **profile) as raster:
        raster.write(np.full((40, 40), height_m) + np.arange(40) * 0.01, 1)
