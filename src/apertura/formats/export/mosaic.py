"""Mosaics of a product of several flights as GDAL virtual rasters (VRT), which refer to the files of the flights."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET  # only written, never parsed

from rasterio.enums import ColorInterp

from apertura.common.atomic import write_text
from apertura.common.errors import ContractError
from apertura.common.provenance import canonical_json
from apertura.common.raster import opened_raster
from apertura.formats.export.radiometry import TAG

_TYPES = {"uint8": "Byte", "float32": "Float32"}


def write_mosaic(path: Path, rasters: Sequence[Path], *, title: str = "") -> None:
    """Write a VRT of rasters on the same grid; where several rasters have data, the last of these rasters is used.

    Parameters
    ----------
    path
        ``….vrt``; complete or absent. Paths of the rasters are relative to this file, so that the folder can be moved.
    rasters
        Real single-band files on the same grid; later files cover earlier ones.
    title
        Title, written as ImageDescription.

    Raises
    ------
    ContractError
        If the rasters differ in grid, data type or colours.

    Notes
    -----
    Source: GDAL documentation of the VRT driver, ComplexSource with NODATA.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np, rasterio
    >>> from rasterio import Affine
    >>> from apertura.formats.export.cog import write_power
    >>> grid = {"transform": Affine(1, 0, 5, 0, -1, 9), "crs": "EPSG:32632", "tags": {}}
    >>> with TemporaryDirectory() as folder:
    ...     below, above = files = [Path(folder) / "f01.tif", Path(folder) / "f02.tif"]
    ...     write_power(below, np.array([[1, 1]], "c8"), **grid)
    ...     write_power(above, np.array([[2, np.nan]], "c8"), **grid)
    ...     write_mosaic(Path(folder) / "power.vrt", files)
    ...     with rasterio.open(Path(folder) / "power.vrt") as mosaic:
    ...         mosaic.read(1)
    array([[4., 1.]], dtype=float32)
    """
    first, kind, tags = _opened(rasters)
    root = ET.Element("VRTDataset", rasterXSize=str(first["width"]), rasterYSize=str(first["height"]))
    ET.SubElement(root, "SRS").text = first["crs"]
    ET.SubElement(root, "GeoTransform").text = ", ".join(map(repr, first["transform"]))
    radiometry = canonical_json(_common([json.loads(tag) for tag in tags]))
    tags_written = {"TIFFTAG_IMAGEDESCRIPTION": title, TAG: radiometry}
    metadata = ET.SubElement(root, "Metadata")
    for name, value in tags_written.items():
        ET.SubElement(metadata, "MDI", key=name).text = value
    band = ET.SubElement(root, "VRTRasterBand", dataType=kind["type"], band="1")
    for name in ("Description", "UnitType", "NoDataValue"):
        ET.SubElement(band, name).text = kind[name]
    if kind["colours"]:
        table = ET.SubElement(band, "ColorTable")
        for colour in kind["colours"]:
            ET.SubElement(table, "Entry", dict(zip(("c1", "c2", "c3", "c4"), map(str, colour), strict=True)))
    for raster in rasters:
        band.append(_source(os.path.relpath(str(raster), str(path.parent)), first, kind))
    ET.indent(root)
    write_text(path, ET.tostring(root, encoding="unicode") + "\n")


def _opened(rasters: Sequence[Path]) -> tuple[dict[str, Any], dict[str, Any], list[str]]:
    """Return the common grid and kind of the rasters, and the radiometry of each raster."""
    layouts: list[tuple[dict[str, Any], dict[str, Any], dict[str, str]]] = []
    tags = []
    for path in rasters:
        remedy = "Run the workflow again."
        with opened_raster(path, expected="a raster written by the workflow", remedy=remedy) as raster:
            grid = {"width": raster.width, "height": raster.height, "transform": raster.transform.to_gdal()}
            kind: dict[str, Any] = {"type": _TYPES.get(raster.dtypes[0]), "NoDataValue": f"{raster.nodata:g}"}
            # descriptions of sums differ in the number of summed images: the description of the last raster is used
            description = {"Description": raster.descriptions[0] or "", "UnitType": raster.units[0] or ""}
            has_palette = raster.colorinterp[0] == ColorInterp.palette
            colours = [colour for _, colour in sorted(raster.colormap(1).items())] if has_palette else []
            layouts.append((grid | {"crs": raster.crs.to_wkt()}, kind | {"colours": colours}, description))
            tags.append(raster.tags().get(TAG, "{}"))
    grid, kind, _ = layouts[0]
    for path, (other_grid, other_kind, _) in zip(rasters, layouts, strict=True):
        if other_grid != grid or other_kind != kind or kind["type"] is None:
            raise ContractError(f"{path}: not a real raster on the grid of {rasters[0]}")
    return grid, kind | layouts[-1][2], tags


def _source(name: str, grid: Mapping[str, Any], kind: Mapping[str, Any]) -> ET.Element:
    source, width, height = ET.Element("ComplexSource"), str(grid["width"]), str(grid["height"])
    ET.SubElement(source, "SourceFilename", relativeToVRT="1").text = Path(name).as_posix()
    ET.SubElement(source, "SourceBand").text = "1"
    ET.SubElement(source, "SourceProperties", RasterXSize=width, RasterYSize=height, DataType=kind["type"])
    for rectangle in ("SrcRect", "DstRect"):
        ET.SubElement(source, rectangle, xOff="0", yOff="0", xSize=width, ySize=height)
    ET.SubElement(source, "NODATA").text = kind["NoDataValue"]
    return source


def _common(radiometries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the radiometry common to all rasters, with the highest peak and the lowest noise floor."""
    common = {
        name: value
        for name, value in radiometries[-1].items()
        if all(radiometry.get(name) == value for radiometry in radiometries)
    }
    if all({"peak_db", "noise_floor_re_peak_db"} <= radiometry.keys() for radiometry in radiometries):
        top = max(radiometry["peak_db"] for radiometry in radiometries)
        floor = min(radiometry["peak_db"] + radiometry["noise_floor_re_peak_db"] for radiometry in radiometries)
        common |= {"peak_db": top, "noise_floor_re_peak_db": round(floor - top, 2)}
    return common
