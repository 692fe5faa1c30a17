"""Export of an interferogram as GeoTIFFs and one plot: phase, coherence, height and its standard deviation."""

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import matplotlib.style
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from rasterio import Affine
from rasterio.transform import array_bounds

from apertura.common.atomic import replacement
from apertura.formats.export.cog import Band, placed, write_cog
from apertura.formats.export.map_layout import DPI, PICTURE_DOTS, MapLayout
from apertura.formats.export.quicklook import crs_name, footer

_COHERENCE = Band("float32", np.nan, "1", "estimated coherence; bias: see the tag APERTURA_CHANCE", "AVERAGE")
_PHASE = replace(_COHERENCE, unit="rad", meaning="wrapped phase of the first image relative to the second")
_UNWRAPPED = replace(_COHERENCE, unit="rad", meaning="unwrapped topographic phase: see the tag APERTURA_LEVEL")
_HEIGHT = replace(_COHERENCE, unit="m", meaning="terrain height in the CRS of the scene: see the tag APERTURA_LEVEL")
_STD = "standard deviation of the height due to phase noise, reference level and track errors"

# Writers of one raster each, (y, x) float32, NaN where invalid; parameters of `apertura.formats.export.cog.write_slc`.
write_coherence = partial(write_cog, band=_COHERENCE)
write_phase = partial(write_cog, band=replace(_PHASE, overviews="NEAREST"))  # a mean of wrapped phases has no meaning
write_unwrapped = partial(write_cog, band=_UNWRAPPED)
write_height = partial(write_cog, band=_HEIGHT)
write_height_std = partial(write_cog, band=replace(_HEIGHT, meaning=_STD))

_PANELS = (  # key, label, colour map, limits
    ("coherence", "coherence", "gray", (0.0, 1.0)),
    ("unwrapped", "phase, rad", "twilight_shifted", None),
    ("height", "height, m", "viridis", None),
    ("height_std", "standard deviation of height, m", "magma", None),
)


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
