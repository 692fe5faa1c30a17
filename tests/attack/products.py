"""Products from untrusted sources: tags, rasters and images that `apertura verify` and `diff` read."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image, PngImagePlugin
from rasterio import Affine

from apertura.formats.export.cog import write_slc
from apertura.views.verify.products import document, hashes, read_tags, sections_of

_HASHES = {"raw/f01/uav1.sigmf-data": "0f" * 32, "results/scene.manifest.json": "1e" * 32}
_TAGS = {
    "APERTURA_SOURCES": json.dumps(_HASHES),
    "APERTURA_RUNSPEC": '{"window":"hann","nodes":{"uav1":{"lever":[0,1]}}}',
    "APERTURA_VERSION": "0.1.0",
}


def tag_texts() -> list[bytes]:
    """Return texts of a tag."""
    return [_TAGS["APERTURA_SOURCES"].encode(), b"{}"]


def rasters() -> list[bytes]:
    """Return a small product."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "slc.tif"
        place = {"transform": Affine(1, 0, 5, 0, -1, 9), "crs": "EPSG:32632"}
        write_slc(path, np.full((4, 6), 1j, "c8"), tags=_TAGS, **place)
        return [path.read_bytes()]


def pictures() -> list[bytes]:
    """Return a small PNG with tags before its pixels, plain and compressed."""
    images = []
    for packed in (False, True):
        texts = PngImagePlugin.PngInfo()
        for name, text in _TAGS.items():
            texts.add_text(name, text, zip=packed)
        texts.add_itxt("Title", "flight f01", zip=packed)
        with TemporaryDirectory() as folder:
            Image.fromarray(np.arange(48, dtype="u1").reshape(4, 4, 3)).save(Path(folder) / "a.png", pnginfo=texts)
            images.append((Path(folder) / "a.png").read_bytes())
    return images


def read_tag_text(path: Path) -> Any:
    """Return the content of a tag whose text is the content of a file."""
    tags = {"APERTURA_SOURCES": path.read_bytes().decode("utf-8", "replace")}
    return document(tags, "SOURCES", path), hashes(tags, "SOURCES", path)


def read_product(path: Path) -> Any:
    """Return tags and sections of a product."""
    return read_tags(path), sections_of(path)
