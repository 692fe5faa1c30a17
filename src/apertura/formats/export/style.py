"""QGIS styles: a .qml file with the name and folder of a raster, which QGIS applies when it opens the raster.

The colour scale of an image ranges from its noise floor to its peak. With the usual range, the 2nd to 98th percentile
of the pixels, all targets of a scene that consists mostly of noise would be saturated.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
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
from apertura.formats.export.change import CLASSES as CHANGE_CLASSES
from apertura.formats.export.layers import CLASSES, OUTSIDE
from apertura.formats.export.radiometry import TAG

_DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
_VERSION = "3.22"
_RAMP = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")  # viridis
_GREYS = ("#000000", "#404040", "#808080", "#c0c0c0", "#ffffff")
_DIVERGING = ("#2166ac", "#92c5de", "#f7f7f7", "#f4a582", "#b2182b")
_STEP_DB = 5.0  # the limits of the colour scale of a coefficient are multiples of this step
_DOTS = 1024  # maximum pixels along the longer side for determining the limits of a colour scale
_LEAST_DB = 1.0  # minimum range of a grey scale, for an image of constant power


def write_db_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of a raster in decibels: white at the peak, black at the noise floor of the image.

    Parameters
    ----------
    path
        ``….qml``; complete or absent. The raster of that name in the same folder has a tag `radiometry.TAG` with peak
        and noise floor.
    *_, **__
        Arguments of other export functions, ignored.

    Raises
    ------
    ContractError
        If peak or noise floor is missing.

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
    with _opened_raster_of(path) as raster:
        radiometry = json.loads(raster.tags().get(TAG, "{}"))
    top, below = radiometry.get("peak_db"), radiometry.get("noise_floor_re_peak_db")
    if top is None or below is None:
        raise ContractError(f"{path.name}: no peak and noise floor in tag {TAG}")
    _write(path, _grey(round(top + min(below, -_LEAST_DB), 2), round(top, 2), unit="dB"))


def write_linear_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of power or magnitude: black at zero, white from a tenth of the largest value.

    Parameters as in `write_db_style`. Without a style, QGIS computes statistics of the raster, and writes these into
    the mosaic or a sidecar file.
    """
    with _opened_raster_of(path) as raster:
        values = _subsampled(raster)
    largest = float(np.nanmax(values)) if np.isfinite(values).any() else 0.0
    _write(path, _grey(0.0, float(f"{largest / 10 or 1.0:.3g}")))


def write_mask_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of the mask: a colour and a label for each class; valid pixels are transparent.

    Parameters as in `write_db_style`.
    """
    _write_classes(path, CLASSES)


def write_change_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of the raster of changes: a colour and a label for each class; unchanged is transparent.

    Parameters as in `write_db_style`.
    """
    _write_classes(path, CHANGE_CLASSES)


def _write_classes(path: Path, classes: Mapping[int, tuple[str, tuple[int, int, int]]]) -> None:
    """Write a colour and a label for each class; the classes 0 and no data are transparent."""
    renderer = _renderer("paletted", band="1")
    palette = ET.SubElement(renderer, "colorPalette")
    for value, (name, colour) in classes.items():
        is_transparent = value in {0, OUTSIDE}
        entry = {
            "value": str(value),
            "color": f"#{bytes(colour).hex()}",
            "alpha": "0" if is_transparent else "255",
            "label": name,
        }
        ET.SubElement(palette, "paletteEntry", entry)
    _write(path, renderer)


def write_layer_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of a layer: a colour scale from its smallest to its largest value.

    Parameters as in `write_db_style`.
    """
    with _opened_raster_of(path) as raster:
        values, unit = _subsampled(raster), raster.units[0]
    _write_ramp(path, *_round_limits(values[np.isfinite(values)]), unit)


def write_ratio_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of a ratio in decibels: blue below 0 dB, white at 0 dB, red above; limits ±10 dB.

    Parameters as in `write_db_style`.
    """
    _write_ramp(path, -10.0, 10.0, "dB", ramp=_DIVERGING)


def write_backscatter_style(path: Path, *_: object, **__: object) -> None:
    """Write the style of a backscattering coefficient: grey scale from the 2nd to the 99.5th percentile.

    The limits are multiples of 5 dB. The percentiles exclude dark speckle and bright reflectors from the grey scale.
    Parameters as in `write_db_style`.
    """
    with _opened_raster_of(path) as raster:
        values, unit = _subsampled(raster), raster.units[0]
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, (2.0, 99.5)) if finite.size else (-30.0, 0.0)
    low, high = _STEP_DB * floor(low / _STEP_DB), _STEP_DB * ceil(high / _STEP_DB)
    _write_ramp(path, low, max(high, low + _STEP_DB), unit, ramp=_GREYS)


def _write_ramp(path: Path, low: float, high: float, unit: str, *, ramp: Sequence[str] = _RAMP) -> None:
    """Write a colour ramp between two values, and a legend with their unit."""
    options = {"classificationMin": f"{low:g}", "classificationMax": f"{high:g}"}
    renderer = _renderer("singlebandpseudocolor", band="1", **options)
    ends = {"minimumValue": f"{low:g}", "maximumValue": f"{high:g}"}
    shader = ET.SubElement(ET.SubElement(renderer, "rastershader"), "colorrampshader", ends)
    shader.attrib |= {"colorRampType": "INTERPOLATED", "classificationMode": "1", "clip": "0"}
    # without these settings, the legend in QGIS has only the two limits and no unit
    ET.SubElement(shader, "rampLegendSettings", useContinuousLegend="0", suffix=f" {unit}")
    for share, colour in zip(np.linspace(0, 1, len(ramp)), ramp, strict=True):
        value = f"{low + share * (high - low):g}"
        ET.SubElement(shader, "item", value=value, color=colour, alpha="255", label=f"{value} {unit}")
    _write(path, renderer)


def _subsampled(raster: rasterio.DatasetReader) -> NDArray[np.float32]:
    """Read a raster averaged to at most `_DOTS` pixels along the longer side, NaN for no data."""
    factor = max(1.0, max(raster.shape) / _DOTS)
    shape = tuple(ceil(size / factor) for size in raster.shape)
    # not read as a masked array, because rasterio reads every pixel of a mosaic to compute the mask
    values = raster.read(1, out_shape=shape, resampling=Resampling.average)
    return np.where(values == raster.nodata, np.nan, values).astype(np.float32, copy=False)


def _round_limits(values: NDArray[np.float32]) -> tuple[float, float]:
    """Return minimum and maximum, rounded outwards to a tenth of the largest power of ten within their difference."""
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
def _opened_raster_of(path: Path) -> Iterator[rasterio.DatasetReader]:
    """Open the raster of a style.

    A mosaic is opened by its absolute path, because it refers to its source rasters by relative paths.
    """
    file = next(file for file in map(path.with_suffix, (".tif", ".vrt")) if file.is_file())
    opened_path = nullcontext(Path(file.absolute())) if file.suffix == ".vrt" else on_disk(file)
    with opened_path as name, rasterio.Env(**ISOLATED), rasterio.open(name) as raster:
        yield raster


def _renderer(kind: str, **attributes: str) -> ET.Element:
    common = {"type": kind, "opacity": "1", "alphaBand": "-1", "nodataColor": ""}
    return ET.Element("rasterrenderer", common | attributes)


def _write(path: Path, renderer: ET.Element) -> None:
    """Write a style without resampling: nearest neighbour, also in overviews."""
    style = ET.Element("qgis", version=_VERSION, styleCategories="Symbology")
    pipe = ET.SubElement(style, "pipe")
    pipe.append(renderer)
    ET.SubElement(style, "blendMode").text = "0"
    ET.indent(style)
    write_text(path, _DOCTYPE + ET.tostring(style, encoding="unicode") + "\n")
