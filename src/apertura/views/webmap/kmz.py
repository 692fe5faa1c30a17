"""KMZ of an image for Google Earth: the image on a grid of latitude and longitude, its legend, and its outline.

Equations: docs/theory/export.md, "Overlay in latitude and longitude".
"""

import html
import math
import re
import zipfile
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from textwrap import fill
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.common.raster import opened_raster
from apertura.core.geometry.geodesy import (
    ecef_from_geodetic,
    frame_from_map,
    geodetic_from_ecef,
    longitudes_about,
    map_from_frame,
)
from apertura.views.webmap.document import requested_file

COLOURS = {"grey": "gray", "inferno": "inferno", "viridis": "viridis", "cyclic": "twilight_shifted"}
"""Colour ramp of the page → colour map of Matplotlib."""

MOST_PIXELS = 4096
"""Maximum pixels along a side of the source; of a larger raster an overview is used, whose spacing the KMZ states."""

_NODE_PX = 32  # distance of the nodes between which map coordinates are interpolated
_BAND_ROWS = 256
_EDGE_SAMPLES = 65
_SEMI_MAJOR_M, _ECCENTRICITY_SQUARED = 6_378_137.0, 0.00669437999014  # WGS 84
_UNPRINTABLE = re.compile(r"[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # not allowed in XML 1.0


def overlay_of(folder: Path, document: Mapping[str, Any], name: str, parameters: Mapping[str, str]) -> bytes:
    """Return the KMZ of a layer of the map, with the colour scale of the page.

    Parameters
    ----------
    folder
        The results folder.
    document
        Contents of `map.json`.
    name
        Raster of the layer, relative to `folder`.
    parameters
        ``low``, ``high`` and ``colours`` as in `kmz_of`.

    Raises
    ------
    CampaignError
        If the frame is local, or if the parameters are not those of a colour scale.
    """
    if document["crs"]["local"]:
        raise CampaignError("a local frame", name, "a campaign with geographic positions", "Export a PNG instead.")
    named = [
        (entry, layer)
        for entry in document["images"]
        for layer in entry["layers"]
        if requested_file(layer["url"].removeprefix(".."))[0] == name and layer["kind"] != "classes"
    ]
    try:
        low, high, colours = float(parameters["low"]), float(parameters["high"]), parameters["colours"]
    except (KeyError, ValueError):
        low = high = math.nan
    if not (named and -math.inf < low < high < math.inf and colours in COLOURS):
        raise CampaignError(
            f"parameters {dict(parameters)}", name, "an image and a colour scale", "Export the image from the map page."
        )
    entry, layer = named[0]
    return kmz_of(folder / name, document, entry, layer, low=low, high=high, colours=colours)


def kmz_of(
    path: Path,
    document: Mapping[str, Any],
    entry: Mapping[str, Any],
    layer: Mapping[str, Any],
    *,
    low: float,
    high: float,
    colours: str,
) -> bytes:
    """Return the KMZ of a layer of an image.

    Parameters
    ----------
    path
        Raster of the layer.
    document, entry, layer
        Contents of `map.json`, and the entries of image and layer in it.
    low, high
        Values at the ends of the colour scale, in the unit of the layer.
    colours
        A key of `COLOURS`.
    """
    crs, (west, south, east, north) = document["crs"]["code"], document["grid"]["bounds_m"]
    with opened_raster(path, expected="a raster that the workflow wrote", remedy="Run the workflow again.") as raster:
        factor = next((each for each in (1, *raster.overviews(1)) if max(raster.shape) <= each * MOST_PIXELS), 1)
        values = raster.read(1, out_shape=tuple(-(-size // factor) for size in raster.shape), masked=True)
    values = values.astype(np.float32).filled(np.nan)
    spacing_m = factor * document["grid"]["spacing_m"]
    is_power = layer["unit"] == "dB"
    placed, edges = geographic(
        10 ** (values / 10) if is_power else values, crs=crs, west=west, north=north, spacing_m=spacing_m
    )
    with np.errstate(divide="ignore"):
        placed = 10 * np.log10(placed) if is_power else placed

    x, y = np.array([west, east, east, west, west]), np.array([south, south, north, north, south])
    latitude, longitude = _degrees(crs, x, y)
    lines = dict(_lines(document, entry, layer, spacing_m))
    rows = "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in lines.items())
    words = {"name": f"{document['campaign']} · {lines['image']}", "description": f"<table>{rows}</table>"}
    box = dict(zip(("north", "south", "east", "west"), (edges[3], edges[1], edges[2], edges[0]), strict=True))
    ring = " ".join(f"{x:.10f},{y:.10f},0" for x, y in zip(longitude, latitude, strict=True))
    corner = {"x": "0", "y": "0", "xunits": "fraction", "yunits": "fraction"}
    contents = {
        "GroundOverlay": words
        | {"Icon": {"href": "image.png"}, "LatLonBox": {name: f"{edge:.10f}" for name, edge in box.items()}},
        "ScreenOverlay": {"name": "legend", "Icon": {"href": "legend.png"}, "overlayXY": corner, "screenXY": corner},
        "Placemark": words
        | {
            "Style": {"LineStyle": {"color": "ffffffff", "width": "1"}},
            "LineString": {"tessellate": "1", "coordinates": ring},
        },
    }
    kml = ElementTree.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    _fill(kml, {"Document": {"name": words["name"]} | contents})
    files = {
        "doc.kml": ElementTree.tostring(kml, encoding="utf-8", xml_declaration=True),
        "image.png": _picture(placed, low, high, colours),
        "legend.png": _legend(words["name"], entry, low, high, colours),
    }
    packed = BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content)  # without the time of day: equal inputs, equal bytes
    return packed.getvalue()


def geographic(
    values: NDArray[np.float32], *, crs: str, west: float, north: float, spacing_m: float
) -> tuple[NDArray[np.float32], tuple[float, float, float, float]]:
    """Resample a raster to a grid of latitude and longitude; return it and its west, south, east and north edge, deg.

    Parameters
    ----------
    values
        (y, x) float32, north-up, NaN where there is no value.
    crs
        CRS of the raster.
    west, north
        Outer edges of the raster, metres.
    spacing_m
        Pixel spacing, metres.

    Examples
    --------
    >>> values = np.ones((20, 10), "f4")
    >>> placed, edges = geographic(values, crs="EPSG:32632", west=7e5, north=5.3e6, spacing_m=1.0)
    >>> placed.shape, np.round(edges, 4).tolist()
    ((21, 11), [11.672, 47.822, 11.6722, 47.8222])
    """
    from scipy.ndimage import map_coordinates

    height, width = values.shape
    south, east = north - height * spacing_m, west + width * spacing_m
    share = np.linspace(0, 1, _EDGE_SAMPLES)
    x, y = west + share * (east - west), south + share * (north - south)
    latitude, longitude = _degrees(
        crs,
        np.concatenate([x, x, np.full_like(share, west), np.full_like(share, east)]),
        np.concatenate([np.full_like(share, south), np.full_like(share, north), y, y]),
    )

    # eq. 1: steps of one pixel spacing along the meridian and along the parallel
    sine = np.sin(np.radians(latitude.mean()))
    normal_m = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY_SQUARED * sine**2)
    meridian_m = normal_m * (1 - _ECCENTRICITY_SQUARED) / (1 - _ECCENTRICITY_SQUARED * sine**2)
    down = np.degrees(spacing_m / meridian_m)
    right = np.degrees(spacing_m / (normal_m * np.sqrt(1 - sine**2)))
    top, left = latitude.max(), longitude.min()
    rows, columns = int(np.ceil(np.ptp(latitude) / down)), int(np.ceil(np.ptp(longitude) / right))

    # eq. 2: source pixel at each node, interpolated to each pixel
    i, j = (_NODE_PX * np.arange(-(-size // _NODE_PX) + 1) for size in (rows, columns))
    node_latitude, node_longitude = np.broadcast_arrays((top - (i + 0.5) * down)[:, None], left + (j + 0.5) * right)
    position = ecef_from_geodetic(node_latitude, node_longitude, np.zeros_like(node_latitude))
    easting, northing, _ = np.moveaxis(map_from_frame(crs, position), -1, 0)
    nodes = (north - northing) / spacing_m - 0.5, (easting - west) / spacing_m - 0.5

    # eq. 3: bilinear mean of the valid pixels
    valid = np.isfinite(values)
    weighted = np.where(valid, values, 0).astype(np.float32)
    placed = np.empty((rows, columns), np.float32)
    for first in range(0, rows, _BAND_ROWS):
        at = np.mgrid[first : min(rows, first + _BAND_ROWS), 0:columns] / _NODE_PX
        source = [map_coordinates(node, at, order=1) for node in nodes]
        total, weight = (
            map_coordinates(each, source, order=1, mode="grid-constant")
            for each in (weighted, valid.astype(np.float32))
        )
        placed[first : first + _BAND_ROWS] = np.where(weight >= 0.5, total / np.maximum(weight, 0.5), np.nan)
    return placed, (left, top - rows * down, left + columns * right, top)


def _degrees(crs: str, x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return latitude, and longitude without wraps, of map coordinates."""
    latitude, longitude, _ = geodetic_from_ecef(frame_from_map(crs, x, y, np.zeros_like(x))).T
    return latitude, longitudes_about(longitude, longitude[0])


def _lines(
    document: Mapping[str, Any], entry: Mapping[str, Any], layer: Mapping[str, Any], spacing_m: float
) -> Iterator[tuple[str, str]]:
    """Yield the rows of the balloon: heading, text."""
    yield "image", f"{entry['flight']} · {entry['image']} · {quantity(layer)}"
    yield "verdict", f"{entry['verdict']}: {entry['reason']}"
    yield from ((f"flag {name}", text) for name, text in entry["flags"].items())
    if not entry["flags"]:
        yield "flags", "no flags raised"
    if entry["error_db"] is not None:
        yield "numerical error", f"below {entry['error_db']:.1f} dB"
    if entry["acquired"]:
        yield "acquisition", " to ".join(entry["acquired"])
    if entry["licence"]:
        yield "licence", entry["licence"]
    yield "source", f"{layer['file']}, {document['crs']['name']} ({document['crs']['code']})"
    yield "pixel spacing", f"{spacing_m:g} m, resampled to WGS 84 latitude and longitude"


def quantity(layer: Mapping[str, Any]) -> str:
    """Return quantity and unit of a layer.

    Examples
    --------
    >>> quantity({"title": "echo power", "unit": "dB"}), quantity({"title": "ratio", "unit": ""})
    ('echo power, dB', 'ratio')
    """
    return f"{layer['title']}, {layer['unit']}" if layer["unit"] else str(layer["title"])


def _fill(parent: ElementTree.Element, contents: Mapping[str, Any]) -> None:
    """Append elements; a value is the text of an element, its attributes (overlayXY, screenXY), or its contents."""
    for name, value in contents.items():
        if name.endswith("XY"):
            ElementTree.SubElement(parent, name, value)
        elif isinstance(value, str):
            ElementTree.SubElement(parent, name).text = _UNPRINTABLE.sub("?", value)
        else:
            _fill(ElementTree.SubElement(parent, name), value)


def _picture(values: NDArray[np.float32], low: float, high: float, colours: str) -> bytes:
    """Return values as a PNG; pixels without a value are transparent."""
    from matplotlib import colormaps
    from PIL import Image

    pixels = colormaps[COLOURS[colours]](np.nan_to_num((values - low) / (high - low)), bytes=True)
    pixels[np.isnan(values), 3] = 0
    file = BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def _legend(title: str, entry: Mapping[str, Any], low: float, high: float, colours: str) -> bytes:
    """Return a PNG with the colour bar, and with verdict and flags of the image."""
    import matplotlib.style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from apertura.formats.export.map_layout import flag_words

    with matplotlib.style.context("default"):
        figure = Figure(figsize=(4.2, 1.5), dpi=100)
        FigureCanvasAgg(figure)
        axes = figure.add_axes((0.05, 0.5, 0.9, 0.1))
        figure.colorbar(ScalarMappable(Normalize(low, high), COLOURS[colours]), axes, orientation="horizontal")
        axes.tick_params(labelsize=7)
        words: dict[str, Any] = {"size": 7, "parse_math": False, "va": "top"}
        figure.text(0.05, 0.96, fill(_UNPRINTABLE.sub("?", title), 72, max_lines=2), weight="bold", **words)
        verdict, flags = f"{entry['verdict']}: {entry['reason']}", flag_words(list(entry["flags"]), 140)
        colour = "firebrick" if entry["flags"] else "black"
        figure.text(0.05, 0.3, fill(_UNPRINTABLE.sub("?", verdict), 78, max_lines=2), **words)
        figure.text(0.05, 0.14, fill(_UNPRINTABLE.sub("?", flags), 78, max_lines=2), color=colour, **words)
        file = BytesIO()
        figure.savefig(file, format="png")
    return file.getvalue()
