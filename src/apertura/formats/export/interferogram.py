"""Products of an interferogram, GeoTIFFs and one picture: phase, coherence, height and its deviation."""

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

PHASE = Band("float32", np.nan, "rad", "phase of the first image less that of the second, within a turn", "NEAREST")
COHERENCE = Band("float32", np.nan, "1", "coherence as estimated: see the tag APERTURA_CHANCE", "AVERAGE")
UNWRAPPED = Band("float32", np.nan, "rad", "phase of height alone, unwrapped: see the tag APERTURA_LEVEL", "AVERAGE")
HEIGHT = Band("float32", np.nan, "m", "height of the ground in the CRS of the scene: see APERTURA_LEVEL", "AVERAGE")
HEIGHT_STD = Band("float32", np.nan, "m", "standard deviation of the height by the phase's scatter alone", "AVERAGE")

_PANELS = (  # key, words, colours, their ends
    ("coherence", "coherence", "gray", (0.0, 1.0)),
    ("unwrapped", "phase, rad", "twilight_shifted", None),
    ("height", "height, m", "viridis", None),
    ("height_std", "its standard deviation, m", "magma", None),
)


def write_phase(
    path: Path, phase_rad: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the wrapped phase, (y, x) float32 rad; overviews take single pixels. Else as `write_height`."""
    write_cog(path, phase_rad, PHASE, transform=transform, crs=crs, tags=tags, title=title)


def write_coherence(
    path: Path, magnitude: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write coherence as estimated, (y, x) float32, 0 to 1. Else as `write_height`."""
    write_cog(path, magnitude, COHERENCE, transform=transform, crs=crs, tags=tags, title=title)


def write_unwrapped(
    path: Path, phase_rad: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the phase that height alone has, (y, x) float32 rad. Else as `write_height`."""
    write_cog(path, phase_rad, UNWRAPPED, transform=transform, crs=crs, tags=tags, title=title)


def write_height(
    path: Path, height_m: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write heights, (y, x) float32 metres, NaN where none is valid. Else as `apertura.formats.export.cog.write_slc`.

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
    """Write the standard deviation of heights, (y, x) float32 metres. Else as `write_height`."""
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
    """Draw coherence, phase, height and its deviation beside each other as one PNG.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    panels
        ``coherence``, ``unwrapped``, ``height`` and ``height_std``, (y, x) float32 on one grid; NaN is left white. Of
        more pixels than the picture has dots every so many are drawn.
    transform, crs, tags, title
        As `apertura.formats.export.quicklook.write_quicklook`.
    """
    first = panels["coherence"]
    placed(first, transform, crs)
    every = -(-max(first.shape) // PICTURE_DOTS)
    west, south, east, north = array_bounds(*first.shape, transform)
    known = CRS.from_user_input(crs)
    with matplotlib.style.context("default"):
        layout = whole = MapLayout.for_bounds((west, south, east, north), maps=len(_PANELS), local=known.is_engineering)
        for at, (name, words, colours, ends) in enumerate(_PANELS):
            layout = layout.beside() if at else whole
            thin = panels[name][::every, ::every]
            low, high = ends or _ends(thin)
            picture = layout.axes.imshow(
                np.ma.masked_invalid(thin),
                extent=(west, east, south, north),
                cmap=colours,
                vmin=low,
                vmax=high,
                interpolation="nearest",
            )
            layout.draw_frame("" if at else crs_name(crs))
            layout.draw_colour_bar(picture, words, beyond="neither" if ends else "both")
            if not np.isfinite(thin).any():
                layout.axes.text(0.5, 0.5, "no valid pixel", transform=layout.axes.transAxes, ha="center")
        whole.draw_scale_and_north()
        whole.write_words(title, tags.get("APERTURA_LEVEL", ""), footer(tags))
        whole.write_flags(list(json.loads(tags.get("APERTURA_FLAGS", "{}"))))
        with replacement(path) as temporary:
            layout.figure.savefig(temporary, dpi=DPI, metadata={"Title": title, **dict(sorted(tags.items()))})


def _ends(values: NDArray[np.float32]) -> tuple[float, float]:
    """Return the ends of a colour scale: the first and the last hundredth, a glitch left out."""
    there = values[np.isfinite(values)]
    if not there.size:
        return 0.0, 1.0
    low, high = (float(one) for one in np.percentile(there, (1, 99)))
    return (low, high) if high > low else (low - 0.5, high + 0.5)
