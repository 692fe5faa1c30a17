"""QGIS styles: a .qml of the raster's name beside it, which QGIS takes up when it opens the raster.

An image spans its own noise floor to its own peak. The usual 2 to 98 % of the pixels would blacken all targets of
a scene that is mostly noise, and whiten the noise.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from math import ceil, floor, log10
from pathlib import Path
from xml.etree import ElementTree as ET  # only written, never parsed

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling

from apertura.common.atomic import write_text
from apertura.common.confined import on_disk
from apertura.common.errors import ContractError
from apertura.common.raster import ISOLATED
from apertura.formats.export.layers import CLASSES, OUTSIDE
from apertura.formats.export.radiometry import TAG

_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
_VERSION = "3.22"
_RAMP = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")  # viridis
_GREYS = ("#000000", "#404040", "#808080", "#c0c0c0", "#ffffff")
_STEP_DB = 5.0  # that the ends of the colours of a coefficient are whole multiples of
_DOTS = 1024  # of the longer side of a layer, among which the ends of its colours are looked for
_LEAST_DB = 1.0  # between black and white, of an image that is all one power


def write_db_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of decibels: white at the image's peak, black at its noise floor.

    Parameters
    ----------
    path
        ``….qml``; complete or absent. A raster of that name lies beside it: its tag `radiometry.TAG` states
        peak and noise floor.
    *_, **__
        What other products are written from.

    Raises
    ------
    ContractError
        If they were not measured.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from rasterio import Affine
    >>> from apertura.formats.export.db import write_db
    >>> with TemporaryDirectory() as folder:
    ...     image, path = np.full((2, 3), 1j, "c8"), Path(folder) / "db.qml"
    ...     tags = {TAG: '{"peak_db": 32.0, "noise_floor_re_peak_db": -49.0}'}
    ...     write_db(path.with_suffix(".tif"), image, transform=Affine(1, 0, 5, 0, -1, 9), crs="EPSG:32632", tags=tags)
    ...     write_db_style(path)
    ...     [line.strip() for line in path.read_text().splitlines() if "Value>" in line]
    ['<minValue>-17.0</minValue>', '<maxValue>32.0</maxValue>']
    """
    with _beside(path) as raster:
        about = json.loads(raster.tags().get(TAG, "{}"))
    top, below = about.get("peak_db"), about.get("noise_floor_re_peak_db")
    if top is None or below is None:
        raise ContractError(f"{path.name}: no peak and noise floor in tag {TAG}")
    _write(path, _grey(round(top + min(below, -_LEAST_DB), 2), round(top, 2), unit="dB"))


def write_linear_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of power or magnitude: black where there is none, white from a tenth of the largest value.

    Parameters as `write_db_style`. A style of their own also keeps QGIS from measuring the raster, and from
    writing what it measured into a mosaic or beside an image.
    """
    with _beside(path) as raster:
        values = _few(raster)
    largest = float(np.nanmax(values)) if np.isfinite(values).any() else 0.0
    _write(path, _grey(0.0, float(f"{largest / 10 or 1.0:.3g}")))


def write_mask_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of the mask: a colour and a name of each class, valid pixels transparent.

    Parameters as `write_db_style`.
    """
    renderer = _renderer("paletted", band="1")
    palette = ET.SubElement(renderer, "colorPalette")
    for value, (name, colour) in CLASSES.items():
        seen_through = value in {0, OUTSIDE}
        entry = {
            "value": str(value),
            "color": f"#{bytes(colour).hex()}",
            "alpha": "0" if seen_through else "255",
            "label": name,
        }
        ET.SubElement(palette, "paletteEntry", entry)
    _write(path, renderer)


def write_layer_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of a layer: colours from its smallest to its largest value.

    Parameters as `write_db_style`.
    """
    with _beside(path) as raster:
        values, unit = _few(raster), raster.units[0]
    _write_ramp(path, *_round_ends(values[np.isfinite(values)]), unit)


def write_backscatter_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of a backscattering coefficient: grey over whole 5 dB that hold 2 to 99.5 % of the pixels.

    Parameters as `write_db_style`. Speckle reaches down to nothing and reflectors far up: neither sets the colours.
    """
    with _beside(path) as raster:
        values, unit = _few(raster), raster.units[0]
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (2.0, 99.5)) if known.size else (-30.0, 0.0)
    low, high = _STEP_DB * floor(low / _STEP_DB), _STEP_DB * ceil(high / _STEP_DB)
    _write_ramp(path, low, max(high, low + _STEP_DB), unit, ramp=_GREYS)


def _write_ramp(path: Path, low: float, high: float, unit: str, *, ramp: Sequence[str] = _RAMP) -> None:
    """Write colours between two values, and a legend with their unit."""
    options = {"classificationMin": f"{low:g}", "classificationMax": f"{high:g}"}
    renderer = _renderer("singlebandpseudocolor", band="1", **options)
    ends = {"minimumValue": f"{low:g}", "maximumValue": f"{high:g}"}
    shader = ET.SubElement(ET.SubElement(renderer, "rastershader"), "colorrampshader", ends)
    shader.attrib |= {"colorRampType": "INTERPOLATED", "classificationMode": "1", "clip": "0"}
    # Else QGIS draws the ramp with its two ends alone, and without the unit.
    ET.SubElement(shader, "rampLegendSettings", useContinuousLegend="0", suffix=f" {unit}")
    for share, colour in zip(np.linspace(0, 1, len(ramp)), ramp, strict=True):
        value = f"{low + share * (high - low):g}"
        ET.SubElement(shader, "item", value=value, color=colour, alpha="255", label=f"{value} {unit}")
    _write(path, renderer)


def _few(raster: rasterio.DatasetReader) -> NDArray[np.float32]:
    """Return a raster averaged to few places, NaN where it holds nothing."""
    fewer = max(1.0, max(raster.shape) / _DOTS)
    shape = tuple(ceil(size / fewer) for size in raster.shape)
    # Not as a masked array: for its mask rasterio reads every pixel of a mosaic.
    values = raster.read(1, out_shape=shape, resampling=Resampling.average)
    return np.where(values == raster.nodata, np.nan, values).astype(np.float32, copy=False)


def _round_ends(values: NDArray[np.float32]) -> tuple[float, float]:
    """Return the ends of some values, rounded outwards to a tenth of the power of ten below their span."""
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    step = 10.0 ** floor(log10(high - low)) / 10 if high > low else 1.0
    return floor(low / step) * step, max(ceil(high / step), floor(low / step) + 1) * step


def _grey(low: float, high: float, *, unit: str = "") -> ET.Element:
    renderer = _renderer("singlebandgray", grayBand="1", gradient="BlackToWhite")
    if unit:
        ET.SubElement(renderer, "rampLegendSettings", useContinuousLegend="1", suffix=f" {unit}")
    stretch = ET.SubElement(renderer, "contrastEnhancement")
    for name, value in {"minValue": low, "maxValue": high, "algorithm": "StretchToMinimumMaximum"}.items():
        ET.SubElement(stretch, name).text = str(value)
    return renderer


@contextmanager
def _beside(path: Path) -> Iterator[rasterio.DatasetReader]:
    """Open the raster that a style is for, of a mosaic by its whole name: its rasters are named relative to that."""
    file = next(file for file in map(path.with_suffix, (".tif", ".vrt")) if file.is_file())
    named = nullcontext(Path(file.absolute())) if file.suffix == ".vrt" else on_disk(file)
    with named as name, rasterio.Env(**ISOLATED), rasterio.open(name) as raster:
        yield raster


def _renderer(kind: str, **attributes: str) -> ET.Element:
    common = {"type": kind, "opacity": "1", "alphaBand": "-1", "nodataColor": ""}
    return ET.Element("rasterrenderer", common | attributes)


def _write(path: Path, renderer: ET.Element) -> None:
    """Write a style that shows pixels as they are: no smoothing, and of overviews the nearest."""
    style = ET.Element("qgis", version=_VERSION, styleCategories="Symbology")
    pipe = ET.SubElement(style, "pipe")
    pipe.append(renderer)
    ET.SubElement(style, "blendMode").text = "0"
    ET.indent(style)
    write_text(path, _DOCTYPE + ET.tostring(style, encoding="unicode") + "\n")
