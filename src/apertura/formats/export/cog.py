"""Export of images as cloud-optimised GeoTIFF: complex with spatial carrier (`slc`), and power for measurements.

Pixels are processed in blocks, so that an image much larger than memory can be read tile by tile from zarr or dask.
Output contains no time stamps: identical inputs give identical bytes.
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
from rasterio import Affine, warp
from rasterio.crs import CRS
from rasterio.errors import CRSError, NotGeoreferencedWarning
from rasterio.transform import array_bounds
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

BLOCK = 512  # pixels along a side of a COG tile; each overview halves the raster, until it fits into one tile

Pixels = NDArray[Any]


class NorthUpRaster(Protocol):
    """2-D array with row 0 in the north: numpy, dask, zarr or xarray."""

    @property
    def shape(self) -> tuple[int, ...]: ...  # noqa: D102

    def __getitem__(self, key: BlockSlices, /) -> Any: ...


@dataclass(frozen=True)
class Band:
    """Band of a raster file.

    Attributes
    ----------
    dtype, nodata
        Data type on disk, and value of a pixel without data.
    unit, meaning
        Unit and description of the band, also written as a tag; see `with_radiometry`.
    overviews
        Resampling of two by two pixels for overviews, see `halved`.
    colours
        Value → (red, green, blue), 0 to 255, for a band of classes.
    smooth
        True if neighbouring floating-point pixels have similar values; determines the predictor of the compression.
    """

    dtype: str
    nodata: float
    unit: str
    meaning: str
    overviews: Literal["AVERAGE", "AVERAGE_MAGPHASE", "MODE", "NEAREST"]
    colours: Mapping[int, tuple[int, int, int]] | None = None
    smooth: bool = False


SLC = Band("complex64", np.nan, "1", "{amplitude}, complex, phase flattened, with spatial carrier", "AVERAGE_MAGPHASE")
PHASE = (
    "flattened: the phase of the path to the pixel's own position on the terrain is removed, so that flat-earth and "
    "terrain phase are absent; within the response of a point, the spatial carrier remains: the phase increases by 1 "
    "cycle per wavelength of total path at the centre frequency"
)
"""Phase convention of complex images, a tag of their files (docs/theory/stack.md, eqs. 1 and 2)."""

MAGNITUDE = Band("float32", np.nan, "1", "{amplitude}", "AVERAGE")
POWER = Band("float32", np.nan, "1", "{power}, linear", "AVERAGE")


def write_slc(
    path: Path, image: NorthUpRaster, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write the complex image unchanged, with its spatial carrier, as a CFloat32 COG.

    Overviews contain the mean magnitude and the phase of the complex mean. The magnitude of the complex mean is not
    used, because the carrier phase changes from pixel to pixel, so that pixels would cancel.

    Parameters
    ----------
    path
        ``….tif``; complete or absent.
    image
        (y, x) complex64, north-up, NaN where no image is formed; read block by block.
    transform
        Outer corner of the north-west pixel, and spacing; metres in `crs`.
    crs
        For example ``EPSG:32632``, or the result of `apertura.core.geometry.geodesy.local_crs`.
    tags
        Provenance, name → text.
    title
        Title, written as ImageDescription of the TIFF.

    Raises
    ------
    ContractError
        If `image` is not two-dimensional and complex, or `transform` is not north-up.
    CampaignError
        If `crs` is not a coordinate reference system.

    Notes
    -----
    Source: GDAL documentation of the COG driver, OVERVIEW_RESAMPLING.

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
    """Write |image|² as a float32 COG with overviews of averaged power. Parameters and errors as in `write_slc`."""
    write_cog(path, image, POWER, transform=transform, crs=crs, tags=tags, title=title, value=power)


def write_magnitude(
    path: Path, image: NorthUpRaster, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write a real raster of magnitudes as a float32 COG. Parameters and errors as in `write_slc`."""
    write_cog(path, image, MAGNITUDE, transform=transform, crs=crs, tags=tags, title=title)


def write_mean_power(
    path: Path, power: NorthUpRaster, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write a multilooked power, (y, x) float32; negative where the subtracted noise power exceeds the echo power.

    Parameters and errors as in `write_slc`.
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
    """Write a north-up raster as a COG.

    Parameters
    ----------
    path, transform, crs, tags, title
        See `write_slc`.
    image
        (y, x), north-up.
    band
        Dtype, no-data value, unit and description.
    value
        Function that converts a block of `image` to the values that are averaged in overviews.
    shown
        Function that converts these values, at full resolution or in an overview, to pixels in the dtype of `band`.

    Raises
    ------
    ContractError, CampaignError
        See `write_slc`.
    """
    georeference = placed(image, transform, crs)
    band, tags = with_radiometry(band, tags)
    all_tags = tags | _outline_tag(georeference) | ({"TIFFTAG_IMAGEDESCRIPTION": title} if title else {})
    size = int(np.prod(image.shape)) * np.dtype(band.dtype).itemsize
    with gdal_replacement(path, size=size) as temporary:
        source = temporary.with_name("source.tif")
        checksum = _fill(source, lambda block: value(np.asarray(image[block])), shown, band, georeference, all_tags)
        _finish(source, temporary, band)
        if size > IN_MEMORY_BYTES:
            check_written(temporary, checksum, all_tags)


def power(image: Pixels) -> NDArray[np.float32]:
    """Compute |image|² of complex64 as float32.

    Examples
    --------
    >>> power(np.array([3 + 4j], "c8"))
    array([25.], dtype=float32)
    """
    only("complex64")(image)
    squared: NDArray[np.float32] = image.real**2 + image.imag**2
    return squared


def only(dtype: str) -> Callable[[Pixels], Pixels]:
    """Return a function that returns its argument if it has the dtype, and raises ContractError otherwise."""

    def check(block: Pixels) -> Pixels:
        if block.dtype != dtype:
            raise ContractError(f"raster to export is {block.dtype}, not {dtype}")
        return block

    return check


def with_radiometry(band: Band, tags: Mapping[str, str]) -> tuple[Band, dict[str, str]]:
    """Add the meaning of pixel values, from the tag `TAG` of the source raster, to the band and to the tags.

    Parameters
    ----------
    band
        Band whose meaning may contain ``{amplitude}`` or ``{power}``.
    tags
        Tags of the file; without `TAG`, a focused image is assumed.

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
    tag = canonical_json({**meanings, "quantity": meaning, "unit": band.unit})
    readable = {"APERTURA_QUANTITY": meaning, "APERTURA_UNIT": band.unit}
    if band.dtype.startswith("complex"):
        readable["APERTURA_PHASE"] = PHASE
    if "one_is" in meanings:
        readable["APERTURA_REFERENCE"] = f"{'0 dB' if band.unit == 'dB' else '1'}: {meanings['one_is']}"
        readable["APERTURA_SPECKLE_FILTER"] = meanings.get("speckle_filter", "none")
        readable["APERTURA_NOISE_REMOVAL"] = "subtracted" if meanings.get("noise") == "subtracted" else "none"
    if "calibration_std_db" in meanings:
        readable["APERTURA_CALIBRATION_STD_DB"] = f"{meanings['calibration_std_db']:g}"
    return replace(band, meaning=meaning), {**tags, **readable, TAG: tag}


def placed(image: NorthUpRaster, transform: Affine, crs: str) -> dict[str, Any]:
    """Return size and georeference as keyword arguments for rasterio."""
    if len(image.shape) != 2:
        raise ContractError(f"image to export has shape {image.shape}, not (y, x)")
    if transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
        raise ContractError(f"image to export is not north-up: {tuple(transform)[:6]}")
    try:
        parsed_crs = CRS.from_user_input(crs)
    except CRSError as error:
        raise CampaignError(
            f"crs {crs!r}",
            where="scene",
            expected="an EPSG code, or a local frame as LOCAL_CS",
            remedy="Check scene.crs.",
        ) from error
    return {"height": image.shape[0], "width": image.shape[1], "transform": transform, "crs": parsed_crs}


def _outline_tag(georeference: Mapping[str, Any]) -> dict[str, str]:
    """Return the outline of a raster, longitude and latitude of WGS 84, as a tag; empty for a local frame."""
    crs = georeference["crs"]
    if not (crs.is_projected or crs.is_geographic):
        return {}
    west, south, east, north = array_bounds(*(georeference[name] for name in ("height", "width", "transform")))
    x, y = (west, west, east, east), (north, south, south, north)  # counterclockwise from the north-west corner
    longitude, latitude = warp.transform(crs, "EPSG:4326", x, y)
    points = [f"{lon:.7f} {lat:.7f}" for lon, lat in zip(longitude, latitude, strict=True)]
    return {"APERTURA_OUTLINE_WGS84": f"POLYGON (({', '.join([*points, points[0]])}))"}


def halved(pixels: Pixels, band: Band) -> Pixels:
    """Resample pixels to half the resolution, from the valid pixels of groups of 2 × 2 pixels (fewer at an odd edge).

    The result is the mean (AVERAGE), the mean magnitude with the phase of the mean (AVERAGE_MAGPHASE), the most
    frequent value, or the first of equally frequent values (MODE), or the first pixel of each group (NEAREST).

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
            mean, magnitude = _mean(four, band.nodata), _mean([np.abs(values) for values in four], band.nodata)
            size = np.abs(mean)
            return np.where(size > 0, mean * (magnitude / np.where(size > 0, size, 1)), magnitude).astype(pixels.dtype)
        case "MODE":
            return _commonest(four, band.nodata)
        case "NEAREST":
            return four[0]


def _mean(four: Sequence[Pixels], nodata: float) -> Pixels:
    """Return the mean of the valid pixels of each group of four; nodata if the group has no valid pixel."""
    if not np.isnan(nodata):
        valid_mean = _mean([np.where(values == nodata, np.nan, values) for values in four], np.nan)
        return np.asarray(np.where(np.isnan(valid_mean), nodata, valid_mean))
    mean: Pixels = (four[0] + four[1] + (four[2] + four[3])) / 4
    incomplete = np.nonzero(np.isnan(mean))
    if incomplete[0].size:
        pixels = np.array([values[incomplete] for values in four])
        valid = ~np.isnan(pixels)
        count = valid.sum(axis=0)
        mean[incomplete] = np.where(count > 0, np.where(valid, pixels, 0).sum(axis=0) / np.maximum(count, 1), np.nan)
    return mean


def _commonest(four: Sequence[Pixels], nodata: float) -> Pixels:
    """Return the most frequent value of the valid pixels of each group of four; nodata without a valid pixel."""
    if all((values == four[0][0, 0]).all() for values in four):
        return four[0]
    mode, most = np.full_like(four[0], nodata), np.zeros(four[0].shape, np.uint8)
    for number, values in enumerate(four):
        count = np.sum([values == other for other in four[: number + 1]], axis=0, dtype=np.uint8) * (values != nodata)
        mode, most = np.where(count > most, values, mode), np.maximum(count, most)
    return mode


def _fill(
    path: Path,
    read: Callable[[BlockSlices], Pixels],
    shown: Callable[[Pixels], Pixels],
    band: Band,
    georeference: Mapping[str, Any],
    tags: Mapping[str, str],
) -> int:
    """Write a tiled GeoTIFF with tags and its overviews block by block; return a checksum of its pixels.

    Overviews are computed from the blocks in memory. GDAL would read the blocks again, which takes several times as
    long.
    """
    checksum, shape = 0, (georeference["height"], georeference["width"])
    levels = min(max(0, ceil(log2(max(shape) / BLOCK))), int(log2(READ)))
    with ExitStack() as opened:
        # GDAL reads the first overview of source.tif from source.tif.ovr, the next from source.tif.ovr.ovr, …
        files = [opened.enter_context(_created(path, band, georeference))]
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


def _created(path: Path, band: Band, georeference: Mapping[str, Any]) -> Any:
    layout = {"tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK, "BIGTIFF": "IF_SAFER"}
    profile = {"driver": "GTiff", "count": 1, "dtype": band.dtype, "nodata": band.nodata}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # overviews have no georeference
        return rasterio.open(path, "w", **profile, **layout, **georeference)


def _finish(source: Path, target: Path, band: Band) -> None:
    """Convert a GeoTIFF with overviews to a COG."""
    predictor = "STANDARD" if band.smooth else "YES"
    rasterio.shutil.copy(
        source,
        target,
        driver="COG",
        COMPRESS="DEFLATE",
        LEVEL=1,  # higher levels take twice as long and do not compress noise better
        PREDICTOR="NO" if band.dtype.startswith("complex") else predictor,
        BLOCKSIZE=BLOCK,
        BIGTIFF="IF_SAFER",
    )
