"""Images as cloud-optimised GeoTIFFs: `slc` keeps the carrier, `power` is for measuring.

Pixels pass through in blocks, so that an image far larger than memory can come tile by tile from
zarr or dask. Nothing here reads a clock: identical inputs give identical bytes.
"""

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from math import ceil, log2
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.errors import CRSError, NotGeoreferencedWarning
from rasterio.windows import Window

from apertura.common.errors import CampaignError, ContractError
from apertura.common.provenance import canonical_json
from apertura.formats.export.radiometry import TAG
from apertura.formats.export.writing import (
    IN_MEMORY_BYTES,
    READ,
    BlockSlices,
    added,
    blocks_of,
    check_written,
    gdal_replacement,
)

BLOCK = 512  # pixels along a side of a COG tile; overviews halve the raster until it fits into one tile

Pixels = NDArray[Any]


class NorthUpRaster(Protocol):
    """A 2-D array with row 0 in the north: numpy, dask, zarr or xarray."""

    @property
    def shape(self) -> tuple[int, ...]: ...  # noqa: D102

    def __getitem__(self, key: BlockSlices, /) -> Any: ...


@dataclass(frozen=True)
class Band:
    """Band of a raster file.

    Attributes
    ----------
    dtype, nodata
        Type on disk, and the value of a pixel that holds nothing.
    unit, meaning
        Written beside the band and as a tag; see `with_radiometry`.
    overviews
        What an overview makes of two by two pixels: see `halved`.
    colours
        Value → (red, green, blue), 0 to 255, of a band of classes.
    smooth
        Whether neighbouring pixels of floats are alike: whole differences of them are compressed, else their bytes.
    """

    dtype: str
    nodata: float
    unit: str
    meaning: str
    overviews: Literal["AVERAGE", "AVERAGE_MAGPHASE", "MODE", "NEAREST"]
    colours: Mapping[int, tuple[int, int, int]] | None = None
    smooth: bool = False


SLC = Band("complex64", np.nan, "1", "{amplitude}, complex, carrier kept", "AVERAGE_MAGPHASE")
MAGNITUDE = Band("float32", np.nan, "1", "{amplitude}", "AVERAGE")
POWER = Band("float32", np.nan, "1", "{power}, linear", "AVERAGE")


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
    write_cog(path, image, SLC, transform=transform, crs=crs, tags=tags, title=title, value=only("complex64"))


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


def write_mean_power(
    path: Path, power: NorthUpRaster, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the mean power of squares of pixels, (y, x) float32: below zero where the noise subtracted exceeds it.

    Parameters and errors as `write_slc`.
    """
    write_cog(path, power, POWER, transform=transform, crs=crs, tags=tags, title=title, value=only("float32"))


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
    shown: Callable[[Pixels], Pixels] = np.asarray,
) -> None:
    """Write any north-up raster as a COG.

    Parameters
    ----------
    path, transform, crs, tags, title
        As `write_slc`.
    image
        (y, x), north-up.
    band
        Dtype, no data, unit and description.
    value
        Block of `image` → values of which overviews are made.
    shown
        These values, or those of an overview → block of the file, in the dtype of `band`.

    Raises
    ------
    ContractError, CampaignError
        As `write_slc`.
    """
    place = placed(image, transform, crs)
    band, tags = with_radiometry(band, tags)
    words = tags | ({"TIFFTAG_IMAGEDESCRIPTION": title} if title else {})
    size = int(np.prod(image.shape)) * np.dtype(band.dtype).itemsize
    with gdal_replacement(path, size=size) as temporary:
        source = temporary.with_name("source.tif")
        checksum = _fill(source, lambda block: value(np.asarray(image[block])), shown, band, place, words)
        _finish(source, temporary, band)
        if size > IN_MEMORY_BYTES:
            check_written(temporary, checksum, words)


def power(image: Pixels) -> NDArray[np.float32]:
    """Return |image|² of complex64, as float32.

    Examples
    --------
    >>> power(np.array([3 + 4j], "c8"))
    array([25.], dtype=float32)
    """
    only("complex64")(image)
    squared: NDArray[np.float32] = image.real**2 + image.imag**2
    return squared


def only(dtype: str) -> Callable[[Pixels], Pixels]:
    """Return a function that returns its block if that is of a dtype, and raises ContractError else."""

    def check(block: Pixels) -> Pixels:
        if block.dtype != dtype:
            raise ContractError(f"raster to export is {block.dtype}, not {dtype}")
        return block

    return check


def with_radiometry(band: Band, tags: Mapping[str, str]) -> tuple[Band, dict[str, str]]:
    """Return a band and tags that state the meaning of its values, from `TAG` of its source raster.

    Parameters
    ----------
    band
        Its meaning may name ``{amplitude}`` or ``{power}``.
    tags
        Of the file; without `TAG` the raster is any focused scene.

    Examples
    --------
    >>> from apertura.formats.export.radiometry import ECHO
    >>> with_radiometry(POWER, {TAG: canonical_json(ECHO.report)})[0].meaning
    'echo power, linear'
    """
    raster = {"amplitude": "amplitude of the focused scene", "power": "power of the focused scene"}
    raster |= json.loads(tags.get(TAG, "{}"))
    meaning = band.meaning.format(**raster)
    meanings = {
        name: value for name, value in raster.items() if name not in {"amplitude", "power"} and value is not None
    }
    words = canonical_json({**meanings, "quantity": meaning, "unit": band.unit})
    return replace(band, meaning=meaning), {**tags, TAG: words}


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


def halved(pixels: Pixels, band: Band) -> Pixels:
    """Return pixels at half the resolution, each of two by two that are not no data; at an odd edge, of fewer.

    Their mean (AVERAGE), their mean magnitude with the phase of their mean (AVERAGE_MAGPHASE), the commonest, of
    equally common ones that which is so first (MODE), or the first (NEAREST).

    Examples
    --------
    >>> halved(np.array([[1, 3, np.nan], [5, 7, 8]], np.float32), POWER)
    array([[4., 8.]], dtype=float32)
    """
    odd = [(0, size % 2) for size in pixels.shape]
    pixels = np.pad(pixels, odd, constant_values=band.nodata) if np.any(odd) else pixels
    four = [pixels[row::2, column::2] for row in (0, 1) for column in (0, 1)]
    match band.overviews:
        case "AVERAGE":
            return _mean(four, band.nodata)
        case "AVERAGE_MAGPHASE":
            mean, magnitude = _mean(four, band.nodata), _mean([np.abs(one) for one in four], band.nodata)
            size = np.abs(mean)
            return np.where(size > 0, mean * (magnitude / np.where(size > 0, size, 1)), magnitude).astype(pixels.dtype)
        case "MODE":
            return _commonest(four, band.nodata)
        case "NEAREST":
            return four[0]


def _mean(four: Sequence[Pixels], nodata: float) -> Pixels:
    """Return the mean of those of four pixels each that hold something, no data where none does."""
    if not np.isnan(nodata):
        known_mean = _mean([np.where(one == nodata, np.nan, one) for one in four], np.nan)
        return np.asarray(np.where(np.isnan(known_mean), nodata, known_mean))
    mean: Pixels = (four[0] + four[1] + (four[2] + four[3])) / 4
    some = np.nonzero(np.isnan(mean))
    if some[0].size:
        few = np.array([one[some] for one in four])
        known = ~np.isnan(few)
        count = known.sum(axis=0)
        mean[some] = np.where(count > 0, np.where(known, few, 0).sum(axis=0) / np.maximum(count, 1), np.nan)
    return mean


def _commonest(four: Sequence[Pixels], nodata: float) -> Pixels:
    """Return the commonest of those of four pixels each that hold something, no data where none does."""
    if all((one == four[0][0, 0]).all() for one in four):
        return four[0]
    found, most = np.full_like(four[0], nodata), np.zeros(four[0].shape, np.uint8)
    for number, one in enumerate(four):
        count = np.sum([one == other for other in four[: number + 1]], axis=0, dtype=np.uint8) * (one != nodata)
        found, most = np.where(count > most, one, found), np.maximum(count, most)
    return found


def _fill(
    path: Path,
    read: Callable[[BlockSlices], Pixels],
    shown: Callable[[Pixels], Pixels],
    band: Band,
    place: Mapping[str, Any],
    tags: Mapping[str, str],
) -> int:
    """Write a plain tiled GeoTIFF and its overviews block by block, tags included; return a sum over its pixels.

    Blocks are halved while they pass: GDAL, which would read them again, takes several times as long.
    """
    checksum, shape = 0, (place["height"], place["width"])
    levels = min(max(0, ceil(log2(max(shape) / BLOCK))), int(log2(READ)))
    with ExitStack() as opened:
        # GDAL finds the first overview of source.tif in source.tif.ovr, the next in source.tif.ovr.ovr, …
        files = [opened.enter_context(_created(path, band, place))]
        for level in range(1, levels + 1):
            height, width = (-(-size // 2**level) for size in shape)
            overview = path.with_name(path.name + level * ".ovr")
            files.append(opened.enter_context(_created(overview, band, {"height": height, "width": width})))
        files[0].update_tags(**tags)
        files[0].set_band_description(1, band.meaning)
        files[0].set_band_unit(1, band.unit)
        if band.colours:
            files[0].write_colormap(1, band.colours)
        for rows, columns in blocks_of(shape):
            pixels = read((rows, columns))
            for level, file in enumerate(files):
                pixels = halved(pixels, band) if level else pixels
                written = shown(pixels).astype(band.dtype, copy=False)
                at = Window(columns.start >> level, rows.start >> level, *written.shape[::-1])
                file.write(written, 1, window=at)
                checksum = checksum if level else added(checksum, written)
    return checksum


def _created(path: Path, band: Band, place: Mapping[str, Any]) -> Any:
    layout = {"tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK, "BIGTIFF": "IF_SAFER"}
    form = {"driver": "GTiff", "count": 1, "dtype": band.dtype, "nodata": band.nodata}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # an overview has no georeference of its own
        return rasterio.open(path, "w", **form, **layout, **place)


def _finish(source: Path, target: Path, band: Band) -> None:
    """Turn a GeoTIFF with overviews into a COG."""
    differences = "STANDARD" if band.smooth else "YES"
    rasterio.shutil.copy(
        source,
        target,
        driver="COG",
        COMPRESS="DEFLATE",
        LEVEL=1,  # noise is no smaller at any other, and takes twice as long
        PREDICTOR="NO" if band.dtype.startswith("complex") else differences,
        BLOCKSIZE=BLOCK,
        BIGTIFF="IF_SAFER",
    )
