"""Export of the changes between two flights: rasters, and polygons of the regions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio import Affine
from rasterio.features import shapes

from apertura.formats.export.cog import Band, only, write_cog
from apertura.formats.export.geopackage import Ring, write_geopackage

NO_DATA = 255

CLASSES = {
    0: ("unchanged", (235, 235, 235)),
    1: ("brighter", (200, 30, 40)),
    2: ("darker", (35, 80, 180)),
    3: ("coherent change", (250, 180, 30)),
    NO_DATA: ("no data", (0, 0, 0)),
}
"""Value of the raster of changes → meaning and colour."""

RATIO = Band("float32", np.nan, "dB", "mean power relative to the reference flight, without the gain", "AVERAGE")
LOSS = Band("float32", np.nan, "1", "expected minus measured coherence with the reference flight", "AVERAGE")
CLASS = Band(
    "uint8",
    NO_DATA,
    "class",
    "0 unchanged, 1 brighter, 2 darker, 3 coherent change, 255 no data",
    "MODE",
    {value: colour for value, (_, colour) in CLASSES.items()},
)

COLUMNS: Mapping[str, type] = {
    "kind": str,
    "area_m2": float,
    "ratio_db": float,
    "coherence": float,
    "coherence_loss": float,
    "p_value": float,
    "expected_false": float,
    "confidence": float,
    "x_m": float,
    "y_m": float,
    "reference": str,
    "flight": str,
}
"""Attributes of a region and their types."""


@dataclass(frozen=True)
class ChangedRegions:
    """Regions for export.

    Attributes
    ----------
    labels
        (y, x) int32, number of the region of each pixel, 0 outside.
    rows
        Attributes of the regions 1, 2, …: `COLUMNS`.
    date
        Date of the content, UTC.
    """

    labels: NDArray[np.int32]
    rows: Sequence[Mapping[str, Any]]
    date: str


# Writers of one raster each, (y, x); parameters of `apertura.formats.export.cog.write_slc`.
write_amplitude_ratio = partial(write_cog, band=RATIO)
write_coherence_loss = partial(write_cog, band=LOSS)
write_change = partial(write_cog, band=CLASS, value=only("uint8"))


def write_regions(
    path: Path, regions: ChangedRegions, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the regions as multipolygons of a GeoPackage, with the attributes `COLUMNS`.

    Pixels that touch only at a corner belong to different polygons of the same feature. Otherwise as
    `apertura.formats.export.cog.write_slc`; `tags` are not written.
    """
    del tags
    polygons: dict[int, list[list[Ring]]] = {}
    for outline, number in shapes(regions.labels, mask=regions.labels > 0, connectivity=4, transform=transform):
        rings = [np.array(ring, np.float64) for ring in outline["coordinates"]]
        polygons.setdefault(int(number), []).append(rings)
    features = ((polygons[number], row) for number, row in enumerate(regions.rows, start=1))
    write_geopackage(path, features, COLUMNS, crs=crs, table="change_regions", description=title, changed=regions.date)
