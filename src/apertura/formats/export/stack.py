"""Export of the rasters of a stack: flattened and residual phase, measured and expected coherence."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from rasterio import Affine

from apertura.formats.export.cog import Band, NorthUpRaster, write_cog

FLATTENED = Band(
    "float32", np.nan, "rad", "flattened phase of slc.tif, without the phase of the residual track", "NEAREST"
)
RESIDUAL_PHASE = Band(
    "float32", np.nan, "rad", "phase of the residual track, removed from the image", "AVERAGE", smooth=True
)
COHERENCE = Band("float32", np.nan, "1", "estimated coherence with the reference flight of the stack", "AVERAGE")
EXPECTED = Band("float32", np.nan, "1", "coherence expected from noise, spectral overlap and residual phase", "AVERAGE")


def write_flattened_phase(
    path: Path, phase_rad: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the flattened phase of an image, (y, x) float32 rad. Otherwise as `write_residual_phase`."""
    write_cog(path, phase_rad, FLATTENED, transform=transform, crs=crs, tags=tags, title=title)


def write_residual_phase(
    path: Path, phase_rad: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the phase removed from a flight's image, (y, x) float32 rad; parameters as in `cog.write_slc`.

    Examples
    --------
    >>> import rasterio
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path, north_up = Path(folder) / "residual_phase.tif", Affine(1, 0, 5, 0, -1, 9)
    ...     write_residual_phase(path, np.ones((2, 3), "f4"), transform=north_up, crs="EPSG:32632", tags={})
    ...     with rasterio.open(path) as raster:
    ...         raster.units[0], raster.read(1)[0, 0].item()
    ('rad', 1.0)
    """
    write_cog(path, phase_rad, RESIDUAL_PHASE, transform=transform, crs=crs, tags=tags, title=title)


def write_stack_coherence(
    path: Path, magnitude: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the estimated coherence with the reference, (y, x) float32. Otherwise as `write_residual_phase`."""
    write_cog(path, magnitude, COHERENCE, transform=transform, crs=crs, tags=tags, title=title)


def write_expected_coherence(
    path: Path, magnitude: NorthUpRaster, /, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the expected coherence with the reference, (y, x) float32. Otherwise as `write_residual_phase`."""
    write_cog(path, magnitude, EXPECTED, transform=transform, crs=crs, tags=tags, title=title)
