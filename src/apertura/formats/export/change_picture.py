"""Plot of the changes between two flights: amplitude ratio, loss of coherence and classes."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from numpy.typing import NDArray
from pyproj import CRS
from rasterio import Affine
from rasterio.transform import array_bounds

from apertura.common.atomic import replacement
from apertura.formats.export.change import CLASSES, NO_DATA
from apertura.formats.export.cog import placed
from apertura.formats.export.map_layout import DPI, PICTURE_DOTS, MapLayout
from apertura.formats.export.quicklook import crs_name, footer

_RATIO_LIMITS_DB = (-10.0, 10.0)


def write_change_panels(
    path: Path,
    panels: Mapping[str, NDArray[Any]],
    /,
    *,
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    title: str = "",
) -> None:
    """Plot amplitude ratio, loss of coherence and classes side by side as one PNG.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    panels
        ``amplitude_ratio``, ``coherence_loss`` and ``change``, (y, x) on the same grid.
    transform, crs, tags, title
        See `apertura.formats.export.quicklook.write_quicklook`.
    """
    first = panels["change"]
    placed(first, transform, crs)
    stride = -(-max(first.shape) // PICTURE_DOTS)
    west, south, east, north = array_bounds(*first.shape, transform)
    values = [value for value in CLASSES if value != NO_DATA]
    colours = ListedColormap([np.array(CLASSES[value][1]) / 255 for value in values])
    drawn: tuple[tuple[str, str, dict[str, Any], tuple[float, float] | None], ...] = (
        ("amplitude_ratio", "power relative to the reference, dB", {"cmap": "RdBu_r"}, _RATIO_LIMITS_DB),
        ("coherence_loss", "loss of coherence", {"cmap": "magma"}, (0.0, 1.0)),
        ("change", "", {"cmap": colours, "norm": BoundaryNorm(np.arange(-0.5, len(values)), len(values))}, None),
    )
    with matplotlib.style.context("default"):
        local = CRS.from_user_input(crs).is_engineering
        layout = first_map = MapLayout.for_bounds((west, south, east, north), maps=len(drawn), local=local)
        for number, (name, label, colouring, limits) in enumerate(drawn):
            layout = layout.beside() if number else first_map
            shown = panels[name][::stride, ::stride]
            shown = np.ma.masked_equal(shown, NO_DATA) if name == "change" else np.ma.masked_invalid(shown)
            ends: dict[str, Any] = {} if limits is None else {"vmin": limits[0], "vmax": limits[1]}
            extent = (west, east, south, north)
            picture = layout.axes.imshow(shown, extent=extent, interpolation="nearest", **colouring, **ends)
            layout.draw_frame("" if number else crs_name(crs))
            bar = layout.draw_colour_bar(picture, label, beyond="neither" if limits is None else "both")
            if limits is None:
                bar.set_ticks(values, labels=[CLASSES[value][0].replace(" ", "\n") for value in values])
            if not shown.count():
                layout.axes.text(0.5, 0.5, "no valid pixel", transform=layout.axes.transAxes, ha="center")
        first_map.draw_scale_and_north()
        first_map.write_words(title, tags.get("APERTURA_CHANGE", ""), footer(tags))
        first_map.write_flags(list(json.loads(tags.get("APERTURA_FLAGS", "{}"))))
        with replacement(path) as temporary:
            layout.figure.savefig(temporary, dpi=DPI, metadata={"Title": title, **dict(sorted(tags.items()))})
