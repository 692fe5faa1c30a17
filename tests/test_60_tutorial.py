"""Tutorial: every code block runs in order and prints the output shown."""

import re
import shutil
import subprocess
import zipfile
from pathlib import Path

import pytest
import rasterio
from walked import walk

from apertura.core.backprojection.engines import native

TUTORIAL = Path(__file__).parents[1] / "docs/tutorial.md"
PROJECT = Path(__file__).parents[1] / "examples/qgis_project.py"


@pytest.mark.slow
@pytest.mark.skipif(not native.available(), reason="the plan in the tutorial uses the compiled engine")
def test_code_blocks_of_the_tutorial_print_what_they_show(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = walk(TUTORIAL)
    with rasterio.open(tmp_path / "both.tif") as raster:
        certified = [pair.attrs["numerical_error_db"] for pair in names["pairs"]]
        assert raster.tags()["APERTURA_ERROR_DB"] == f"{max(certified):.2f}"


def with_qgis():
    """Return the Python interpreter of QGIS, or None if QGIS is not installed."""
    python = shutil.which("python3", path="/usr/bin")
    command = [python or "false", "-c", "import qgis.core"]
    return python if subprocess.run(command, capture_output=True, check=False).returncode == 0 else None


def test_qgis_project_of_the_tutorial_contains_every_image(finished_tiny, tmp_path):
    python = with_qgis()
    if python is None:
        pytest.skip("QGIS with its Python is not installed")
    campaign = tmp_path / "a campaign"
    for path in finished_tiny.root.glob("results/*/*/*db.tif"):
        copied = campaign / path.relative_to(finished_tiny.root)
        copied.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, copied)
    done = subprocess.run([python, PROJECT, campaign], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines()[-1:] == ["4 images, EPSG:32632"], done.stderr
    again = subprocess.run([python, PROJECT, campaign], capture_output=True, text=True, check=False)
    assert again.returncode == 1
    assert "exists already" in again.stderr
    with zipfile.ZipFile(campaign / "campaign.qgz") as project:
        text = project.read("campaign.qgs").decode()
    layers = re.findall(r"<maplayer .*?</maplayer>", text, re.S)
    sources = [re.search(r"<datasource>(.*?)</datasource>", layer)[1] for layer in layers]
    assert sorted(sources) == sorted(f"./{path.relative_to(campaign)}" for path in campaign.rglob("*.tif"))
    for layer, source in zip(layers, sources, strict=True):
        with rasterio.open(campaign / source) as raster:
            edges = [
                float(re.search(rf"<{side}>(.*?)</{side}>", layer)[1]) for side in ("xmin", "ymin", "xmax", "ymax")
            ]
            assert edges == pytest.approx(list(raster.bounds), abs=1e-6)
            assert re.search(r"<srs>.*?<authid>(.*?)</authid>", layer, re.S)[1] == str(raster.crs)
