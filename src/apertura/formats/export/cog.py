"""Images as cloud-optimised GeoTIFFs: `slc` keeps the carrier, `power` is for measuring.

Pixels pass through in blocks, so that an image far larger than memory can come tile by tile from
zarr or dask. Nothing here reads a clock: identical inputs give identical bytes.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.errors import CRSError, NotGeoreferencedWarning
from rasterio.windows import Window

from apertura.common.errors import CampaignError, ContractError
from apertura.formats.export.radiometry import with_radiometry
from apertura.formats.export.writing import IN_MEMORY_BYTES, Block, added, blocks_of, check_written, gdal_replacement

BLOCK = 512  # pixels along a side of a COG tile; overviews halve the raster until it fits into one tile

Pixels = NDArray[Any]


class NorthUpRaster(Protocol):
    """A 2-D array with row 0 in the north: numpy, dask, zarr or xarray."""

    @property
    def shape(self) -> tuple[int, ...]: ...  # noqa: D102

    def __getitem__(self, key: Block, /) -> Any: ...


@dataclass(frozen=True)
class Band:
    """Band of a raster file.

    Attributes
    ----------
    dtype, nodata
        Type on disk, and the value of a pixel that holds nothing.
    unit, meaning
        Written beside the band and as a tag; see `apertura.formats.export.radiometry.with_radiometry`.
    overviews
        How the COG driver shrinks it: its OVERVIEW_RESAMPLING.
    colours
        Value → (red, green, blue), 0 to 255, of a band of classes.
    effort
        How hard the COG driver packs it: its LEVEL. Speckle is not made smaller by more than 1, smooth layers by half.
    """

    dtype: str
    nodata: float
    unit: str
    meaning: str
    overviews: str
    colours: Mapping[int, tuple[int, int, int]] | None = None
    effort: int = 6


SLC = Band("complex64", np.nan, "1", "{amplitude}, complex, carrier kept", "AVERAGE_MAGPHASE", effort=1)
MAGNITUDE = Band("float32", np.nan, "1", "{amplitude}", "AVERAGE", effort=1)
POWER = Band("float32", np.nan, "1", "{power}, linear", "AVERAGE", effort=1)


def write_slc(
    path: Path, image: NorthUpRaster, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the complex image as it is, carrier kept, as a CFloat32 COG.

    Its overviews average the magnitude and take the phase of the mean: the carrier turns from pixel
    to pixel and would cancel a plain average.

    Parameters
    ----------
    path
        ``….tif``; complete or absent.
    image
        (y, x) complex64, north-up, NaN where nothing was formed; read block by block.
    transform
        Outer corner of the north-west pixel, and spacing; metres in `crs`.
    crs
        Such as ``EPSG:32632``, or the result of `apertura.core.geometry.geodesy.local_crs`.
    tags
        Provenance, name → text.
    title
        Title for people, the TIFF's ImageDescription.

    Raises
    ------
    ContractError
        If `image` is not two-dimensional and complex, or `transform` is not north-up.
    CampaignError
        If `crs` is no coordinate reference system.

    Notes
    -----
    Source: GDAL's documentation of the COG driver, OVERVIEW_RESAMPLING.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "slc.tif"
    ...     write_slc(path, np.full((2, 3), 1j, "c8"), transform=Affine(1, 0, 5, 0, -1, 9), crs="EPSG:32632", tags={})
    ...     with rasterio.open(path) as raster:
    ...         raster.read(1)[0, 0].item(), tuple(raster.bounds)
    (1j, (5.0, 7.0, 8.0, 9.0))
    """
    write_cog(path, image, SLC, transform=transform, crs=crs, tags=tags, title=title, value=complex_only)


def write_power(
    path: Path, image: NorthUpRaster, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write |image|² as a float32 COG; overviews average the power. Parameters and errors as `write_slc`."""
    write_cog(path, image, POWER, transform=transform, crs=crs, tags=tags, title=title, value=power)


def write_magnitude(
    path: Path, image: NorthUpRaster, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write a real raster of magnitudes as a float32 COG. Parameters and errors as `write_slc`."""
    write_cog(path, image, MAGNITUDE, transform=transform, crs=crs, tags=tags, title=title)


def write_cog(
    path: Path,
    image: NorthUpRaster,
    band: Band,
    *,
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    title: str = "",
    value: Callable[[Pixels], Pixels] = np.asarray,
) -> None:
    """Write any north-up raster as a COG whose overviews GDAL builds.

    Parameters
    ----------
    path, transform, crs, tags, title
        As `write_slc`.
    image
        (y, x), north-up.
    band
        Dtype, no data, unit and description.
    value
        Block of `image` → block of the file, in the dtype of `band`.

    Raises
    ------
    ContractError, CampaignError
        As `write_slc`.
    """
    place = placed(image, transform, crs)
    band, tags = with_radiometry(band, tags)
    words = described(tags, title)
    with gdal_replacement(path, size=(size := size_of(image, band))) as temporary:
        source = temporary.with_name("source.tif")
        checksum = fill(source, lambda block: value(np.asarray(image[block])), band, place, words)
        finish(source, temporary, band)
        if size > IN_MEMORY_BYTES:
            check_written(temporary, checksum, words)


def size_of(image: NorthUpRaster, band: Band) -> int:
    """Return the bytes of the pixels of a file."""
    return int(np.prod(image.shape)) * np.dtype(band.dtype).itemsize


def power(image: Pixels) -> NDArray[np.float32]:
    """Return |image|² of complex64, as float32.

    Examples
    --------
    >>> power(np.array([3 + 4j], "c8"))
    array([25.], dtype=float32)
    """
    complex_only(image)
    squared: NDArray[np.float32] = image.real**2 + image.imag**2
    return squared


def complex_only(image: Pixels) -> Pixels:
    """Return `image` if it is complex64."""
    if image.dtype != np.complex64:
        raise ContractError(f"image to export is {image.dtype}, not complex64")
    return image


def placed(image: NorthUpRaster, transform: Affine, crs: str) -> dict[str, Any]:
    """Return size and georeference as rasterio names them."""
    if len(image.shape) != 2:
        raise ContractError(f"image to export has shape {image.shape}, not (y, x)")
    if transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
        raise ContractError(f"image to export is not north-up: {tuple(transform)[:6]}")
    try:
        known = CRS.from_user_input(crs)
    except CRSError as error:
        raise CampaignError(
            f"crs {crs!r}",
            where="scene",
            expected="an EPSG code, or local axes as LOCAL_CS",
            remedy="Check scene.crs.",
        ) from error
    return {"height": image.shape[0], "width": image.shape[1], "transform": transform, "crs": known}


def described(tags: Mapping[str, str], title: str) -> dict[str, str]:
    """Return the tags of the file; GDAL sorts them by name."""
    return dict(tags) | ({"TIFFTAG_IMAGEDESCRIPTION": title} if title else {})


def fill(
    path: Path, read: Callable[[Block], Pixels], band: Band, place: Mapping[str, Any], tags: Mapping[str, str]
) -> int:
    """Write a plain tiled GeoTIFF block by block, tags included; return a sum over its pixels."""
    checksum = 0
    layout = {"tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK, "BIGTIFF": "IF_SAFER"}
    form = {"driver": "GTiff", "count": 1, "dtype": band.dtype, "nodata": band.nodata}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # an overview has no georeference of its own
        raster = rasterio.open(path, "w", **form, **layout, **place)
    with raster:
        raster.update_tags(**tags)
        raster.set_band_description(1, band.meaning)
        raster.set_band_unit(1, band.unit)
        if band.colours:
            raster.write_colormap(1, band.colours)
        for block in blocks_of(raster.shape):
            pixels = read(block).astype(band.dtype, copy=False)
            checksum = added(checksum, pixels)
            raster.write(pixels, 1, window=Window.from_slices(*block))
    return checksum


def finish(source: Path, target: Path, band: Band) -> None:
    """Turn a GeoTIFF into a COG; overviews that `source` has are kept."""
    rasterio.shutil.copy(
        source,
        target,
        driver="COG",
        COMPRESS="DEFLATE",
        LEVEL=band.effort,
        PREDICTOR="NO" if band.dtype.startswith("complex") else "YES",
        BLOCKSIZE=BLOCK,
        BIGTIFF="IF_SAFER",
        OVERVIEW_RESAMPLING=band.overviews,
    )
