"""Finished campaigns with single damaged bytes, for tests of integrity checks."""

import json

import rasterio

from apertura.views.verify.chain import verify

DB = "results/f01/uav1-uav2/db.tif"
EXPORT = "results/f01/uav1-uav2/export.manifest.json"
IMAGE = "results/f01/uav1-uav2/image.zarr"
RAW = "raw/f01/uav2.sigmf-data"


def flip(path, at=None):
    """Change one bit of one byte."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2 if at is None else at] ^= 1
    path.write_bytes(data)


def wrong(root, product=DB):
    """Return the state of each link that differs from "same"."""
    return {link.name: link.state for link in verify(root / product).links if link.state != "same"}


def edited(path, change):
    """Change a JSON file and write it in the format of the workflow."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document, indent=1, sort_keys=True) + "\n")


def retag(path, **tags):
    with rasterio.Env(GDAL_PAM_ENABLED=False), rasterio.open(path, "r+", IGNORE_COG_LAYOUT_BREAK="YES") as raster:
        raster.update_tags(**{f"APERTURA_{name}": text for name, text in tags.items()})


def tag(path, name):
    with rasterio.open(path) as raster:
        return json.loads(raster.tags()[f"APERTURA_{name}"])
