"""Layers of the scene's geometry that explain an image: angles of view, and where it saw nothing or too much."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from rasterio import Affine

from apertura.errors import ContractError
from apertura.export.cog import Band, Pixels, Raster, write_cog

SHADOW, LAYOVER, UNKNOWN = 1, 2, 255
"""Bits of the mask, and its value where there is no terrain to decide from; 0 is seen once and plainly."""

INCIDENCE = Band("float32", np.nan, "deg", "incidence angle from the normal of the terrain", "AVERAGE")
BISTATIC_ANGLE = Band("float32", np.nan, "deg", "angle at the pixel between transmitter and receiver", "AVERAGE")
MASK = Band("uint8", UNKNOWN, "bits", "0 seen, 1 shadow, 2 layover, 3 both, 255 unknown", "MODE")


def write_incidence(
    path: Path, angle_deg: Raster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the incidence angle, (y, x) float32 degrees, NaN where unknown. Else as `apertura.export.cog.write_slc`."""
    check = _only("float32")
    write_cog(path, angle_deg, INCIDENCE, transform=transform, crs=crs, tags=tags, title=title, value=check)


def write_bistatic_angle(
    path: Path, angle_deg: Raster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the bistatic angle, (y, x) float32 degrees, NaN where unknown. Else as `apertura.export.cog.write_slc`."""
    check = _only("float32")
    write_cog(path, angle_deg, BISTATIC_ANGLE, transform=transform, crs=crs, tags=tags, title=title, value=check)


def write_mask(
    path: Path, bits: Raster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write where the image is in shadow or layover, (y, x) uint8 sums of `SHADOW` and `LAYOVER`, or `UNKNOWN`.

    Overviews take the commonest value, so that bits never mix. Else as `apertura.export.cog.write_slc`.

    Examples
    --------
    >>> import rasterio
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "mask.tif"
    ...     write_mask(path, np.ones((2, 3), "u1"), transform=Affine(1, 0, 5, 0, -1, 9), crs="EPSG:32632", tags={})
    ...     with rasterio.open(path) as raster:
    ...         raster.descriptions[0], raster.read(1)[0, 0].item()
    ('0 seen, 1 shadow, 2 layover, 3 both, 255 unknown', 1)
    """
    check = _only("uint8")
    write_cog(path, bits, MASK, transform=transform, crs=crs, tags=tags, title=title, value=check)


def _only(dtype: str) -> Callable[[Pixels], Pixels]:
    def check(block: Pixels) -> Pixels:
        if block.dtype != dtype:
            raise ContractError(f"layer to export is {block.dtype}, not {dtype}")
        return block

    return check
