"""Export of an interferogram as GeoTIFFs and one plot: phase, coherence, height and its standard deviation."""

import json
from collections.abc import Mapping
from pathlib import Path

import matplotlib.style
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from rasterio import Affine
from rasterio.transform import array_bounds

from apertura.common.atomic import replacement
from apertura.formats.export.cog import Band, NorthUpRaster, placed, write_cog
from apertura.formats.export.map_layout import DPI, PICTURE_DOTS, MapLayout
from apertura.formats.export.quicklook import crs_name, footer

PHASE = Band("float32", np.nan, "rad", "wrapped phase of the first image relative to the second", "NEAREST")
COHERENCE = Band("float32", np.nan, "1", "estimated coherence; bias: see the tag APERTURA_CHANCE", "AVERAGE")
UNWRAPPED = Band("float32", np.nan, "rad", "unwrapped topographic phase: see the tag APERTURA_LEVEL", "AVERAGE")
HEIGHT = Band("float32", np.nan, "m", "terrain height in the CRS of the scene: see the tag APERTURA_LEVEL", "AVERAGE")
HEIGHT_STD = Band(
    "float32",
    np.nan,
    "m",
    "standard deviation of the height due to phase noise, reference level and track errors",
    "AVERAGE",
)

_PANELS = (  # key, label, colour map, limits
    ("coherence", "coherence", "gray", (0.0, 1.0)),
    ("unwrapped", "phase, rad", "twilight_shifted", None),
    ("height", "height, m", "viridis", None),
    ("height_std", "standard deviation of height, m", "magma", None),
)


def write_phase(
    path: Path, phase_rad: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the wrapped phase, (y, x) float32 rad; overviews are subsampled. Otherwise as `write_height`."""
    write_cog(path, phase_rad, PHASE, transform=transform, crs=crs, tags=tags, title=title)


def write_coherence(
    path: Path, magnitude: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the estimated coherence, (y, x) float32, 0 to 1. Otherwise as `write_height`."""
    write_cog(path, magnitude, COHERENCE, transform=transform, crs=crs, tags=tags, title=title)


def write_unwrapped(
    path: Path, phase_rad: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the unwrapped topographic phase, (y, x) float32 rad. Otherwise as `write_height`."""
    write_cog(path, phase_rad, UNWRAPPED, transform=transform, crs=crs, tags=tags, title=title)


def write_height(
    path: Path, height_m: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write heights, (y, x) float32 metres, NaN where invalid; see `apertura.formats.export.cog.write_slc`.

    Examples
    --------
    >>> import rasterio
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "height.tif"
    ...     write_height(path, np.ones((2, 3), "f4"), transform=Affine(1, 0, 5, 0, -1, 9), crs="EPSG:32632", tags={})
    ...     with rasterio.open(path) as raster:
    ...         raster.units[0], raster.read(1)[0, 0].item()
    ('m', 1.0)
    """
    write_cog(path, height_m, HEIGHT, transform=transform, crs=crs, tags=tags, title=title)


def write_height_std(
    path: Path, std_m: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the standard deviation of heights, (y, x) float32 metres. Otherwise as `write_height`."""
    write_cog(path, std_m, HEIGHT_STD, transform=transform, crs=crs, tags=tags, title=title)


def write_panels(
    path: Path,
    panels: Mapping[str, NDArray[np.float32]],
    /,
    *,
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    title: str = "",
) -> None:
    """Plot coherence, phase, height and its standard deviation side by side as one PNG.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    panels
        ``coherence``, ``unwrapped``, ``height`` and ``height_std``, (y, x) float32 on the same grid; NaN is white.
        Panels with more pixels than can be displayed in the plot are subsampled.
    transform, crs, tags, title
        See `apertura.formats.export.quicklook.write_quicklook`.
    """
    first = panels["coherence"]
    placed(first, transform, crs)
    stride = -(-max(first.shape) // PICTURE_DOTS)
    west, south, east, north = array_bounds(*first.shape, transform)
    is_local = CRS.from_user_input(crs).is_engineering
    with matplotlib.style.context("default"):
        layout = first_map = MapLayout.for_bounds((west, south, east, north), maps=len(_PANELS), local=is_local)
        for number, (name, label, colours, limits) in enumerate(_PANELS):
            layout = layout.beside() if number else first_map
            values = panels[name][::stride, ::stride]
            low, high = limits or _limits(values)
            picture = layout.axes.imshow(
                np.ma.masked_invalid(values),
                extent=(west, east, south, north),
                cmap=colours,
                vmin=low,
                vmax=high,
                interpolation="nearest",
            )
            layout.draw_frame("" if number else crs_name(crs))
            layout.draw_colour_bar(picture, label, beyond="neither" if limits else "both")
            if not np.isfinite(values).any():
                layout.axes.text(0.5, 0.5, "no valid pixel", transform=layout.axes.transAxes, ha="center")
        first_map.draw_scale_and_north()
        first_map.write_words(title, tags.get("APERTURA_LEVEL", ""), footer(tags))
        first_map.write_flags(list(json.loads(tags.get("APERTURA_FLAGS", "{}"))))
        with replacement(path) as temporary:
            layout.figure.savefig(temporary, dpi=DPI, metadata={"Title": title, **dict(sorted(tags.items()))})


def _limits(values: NDArray[np.float32]) -> tuple[float, float]:
    """Return the limits of a colour scale: the 1st and 99th percentiles, which exclude outliers."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = (float(limit) for limit in np.percentile(finite, (1, 99)))
    return (low, high) if high > low else (low - 0.5, high + 0.5)
