"""A raster of heights: where it lies, and what its heights count from."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError, shown
from apertura.common.raster import opened_raster
from apertura.core.scene.dem import MOST_POSTS, open_dem
from apertura.views.inspection.report import Report

if TYPE_CHECKING:
    from rasterio import DatasetReader

SUFFIXES = (".tif", ".tiff")

_EXPECTED, _REMEDY = "a GeoTIFF of heights", "Convert it."
_ACROSS = 512  # posts along a side that are looked at


def elevation_report(path: Path) -> Report:
    """Return what is told of a raster of heights.

    Raises
    ------
    CampaignError
        If it is no GeoTIFF.
    """
    with opened_raster(path, expected=_EXPECTED, remedy=_REMEDY) as raster:
        facts, heights = _header(raster), _heights(raster)
        extent = tuple(raster.bounds)
    known = None if heights is None else heights[np.isfinite(heights)]
    if known is not None and heights is not None:
        facts["height_m"] = [float(known.min()), float(known.max())] if known.size else None
        facts["posts_without_height_share"] = 1 - known.size / max(heights.size, 1)
    from apertura.views.inspection.pictures import draw_heights

    picture = None if heights is None else (lambda: draw_heights(heights, extent, path.name))
    return Report(path, "elevation model", "", facts, tuple(_missing(path)), picture=picture)


def _header(raster: "DatasetReader") -> dict[str, Any]:
    spacing = [abs(float(side)) for side in raster.res]
    bounds = raster.bounds
    return {
        "posts": f"{raster.height} × {raster.width}",
        "crs": shown(raster.crs or "none", 200),
        "x": f"{bounds.left:.9g} to {bounds.right:.9g}",
        "y": f"{bounds.bottom:.9g} to {bounds.top:.9g}",
        "spacing": f"{spacing[0]:.6g} × {spacing[1]:.6g} {raster.crs.linear_units if _projected(raster) else 'deg'}",
        "bands": raster.count,
        "type": str(raster.dtypes[0]),
    }


def _projected(raster: "DatasetReader") -> bool:
    return bool(raster.crs and raster.crs.is_projected)


def _heights(raster: "DatasetReader") -> NDArray[np.float32] | None:
    """Return a coarse look at the heights, NaN where there are none; None where the raster is too large for one."""
    if raster.height * raster.width > MOST_POSTS:
        return None
    shape = tuple(min(side, _ACROSS) for side in raster.shape)
    read = raster.read(1, out_shape=shape, masked=True).astype(np.float32)
    return np.asarray(np.ma.filled(read, np.nan), np.float32)


def _missing(path: Path) -> list[str]:
    """Return what keeps it from being the ground of a scene as it is."""
    try:
        open_dem(path, "a scene on Earth")
    except CampaignError as problem:
        return [f"{problem.found}; expected {problem.expected}: set scene.dem_datum if that is what it lacks"]
    return []
