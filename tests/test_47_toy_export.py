"""Export format of another package: one function and one table row add a product to every pair."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import rasterio
from folders import copy_writable

ROOT = Path(__file__).parents[1]
TOY = """
from apertura.common.atomic import write_json
from apertura.formats.export import Export

def write_power(path, image, *, transform, crs, tags, title=""):
    power = abs(image[:, :]) ** 2
    write_json(path, {"title": title, "mean_power": float(power.mean()), "error_db": tags["APERTURA_ERROR_DB"]})

ROW = Export("power.json", "image", write_power)
"""
PRODUCTS = {f"results/f01/{pair}/power.json" for pair in ("uav1-uav1", "uav1-uav2")}


@pytest.fixture
def toy_package(tmp_path):
    folder = tmp_path / "site"
    (folder / "toy_export-1.0.dist-info").mkdir(parents=True)
    (folder / "toy_export.py").write_text(TOY)
    (folder / "toy_export-1.0.dist-info" / "entry_points.txt").write_text("[apertura.exports]\ntoy = toy_export:ROW\n")
    return folder


def output_of(package, *command):
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PYTHONPATH": str(package), "PATH": path}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.mark.slow
def test_step_writes_a_toy_product_with_the_others(finished_tiny, toy_package, tmp_path):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    written = output_of(toy_package, "apertura", "step", "export", "f01", "uav1-uav1", "--campaign", str(root))
    folder = root / "results" / "f01" / "uav1-uav1"
    names = [Path(line).name for line in written.splitlines() if line.startswith(str(folder))]
    assert names[-4:] == ["power.json", "image.json", "ceos_ard.json", "ceos_ard.html"]
    with rasterio.open(folder / "power.tif") as raster:
        mean, tags = raster.read(1).mean(), raster.tags()
    toy = json.loads((folder / "power.json").read_text())
    assert toy["mean_power"] == pytest.approx(mean, rel=1e-5)
    assert toy["title"] == tags["TIFFTAG_IMAGEDESCRIPTION"]
    assert toy["error_db"] == tags["APERTURA_ERROR_DB"]


@pytest.mark.slow
def test_workflow_lists_a_toy_product_of_every_pair(tiny, toy_package):
    planned = output_of(toy_package, "snakemake", "-n", "--directory", str(tiny), "--quiet", "progress")
    assert {name for name in PRODUCTS if name in planned} == PRODUCTS
