"""Images out of the house: one file per format, one row per file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from rasterio import Affine

from apertura.export.cog import Raster, write_power, write_slc
from apertura.export.db import write_db
from apertura.export.layers import write_bistatic_angle, write_incidence, write_mask
from apertura.export.quicklook import write_quicklook


class Export(Protocol):
    """Write a north-up (y, x) raster to `path`; parameters as `apertura.export.cog.write_slc`."""

    def __call__(  # noqa: D102
        self, path: Path, image: Raster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
    ) -> None: ...


EXPORTS: Mapping[str, Export] = {
    "slc.tif": write_slc,
    "power.tif": write_power,
    "db.tif": write_db,
    "quicklook.png": write_quicklook,
}
"""File name → what writes it from a complex image."""

LAYERS: Mapping[str, Export] = {
    "incidence.tif": write_incidence,
    "bistatic_angle.tif": write_bistatic_angle,
    "mask.tif": write_mask,
}
"""File name → what writes it from a layer of the scene's geometry."""
