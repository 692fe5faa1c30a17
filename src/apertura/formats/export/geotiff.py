"""GeoTIFFs of images in Python: `apertura.write_geotiff` and `apertura.read_geotiff`."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rasterio import Affine

from apertura import __version__
from apertura.common.errors import CampaignError, quoted
from apertura.formats.export.cog import Band, write_cog, write_slc
from apertura.formats.export.db import write_db

if TYPE_CHECKING:
    import xarray as xr

_TAGS = {
    "numerical_error_db": "APERTURA_ERROR_DB",
    "numerical_error_confidence": "APERTURA_ERROR_CONFIDENCE",
    "predicted_error_db": "APERTURA_PREDICTED_ERROR_DB",
    "wave_speed_m_s": "APERTURA_WAVE_SPEED_M_S",
    "setting": "APERTURA_SETTING",
    "models": "APERTURA_MODELS",
    "flags": "APERTURA_FLAGS",
    "budget": "APERTURA_BUDGET",
}
"""Attribute of an image from `apertura.backproject` → tag of the file."""

_NUMBERS = {"numerical_error_db", "numerical_error_confidence", "predicted_error_db", "wave_speed_m_s"}

_FOCUS = "APERTURA_FOCUS"
"""Tag with verdict and reason as JSON, as in the products of a campaign."""

_UNIFORM = 1e-3
"""Largest deviation of a coordinate from a uniform grid, in pixels."""


def write_geotiff(
    image: "xr.DataArray", path: str | Path, *, db: bool = False, title: str = "", tags: Mapping[str, str] | None = None
) -> Path:
    """Write an image as a cloud-optimised GeoTIFF, with CRS, units, and its certificate as tags.

    A lazy image is computed block by block by the caller's dask scheduler.

    Parameters
    ----------
    image
        (y, x) array with coordinates in metres and its CRS in the coordinate spatial_ref, such as the result of
        `apertura.backproject`, an image of a campaign, their sums, or their coordinates `sigma0` and `rcs`. Complex
        values are written as complex64 with carrier phase, real values as float32; NaN marks pixels without data.
    path
        File to write; an existing file is replaced when the new file is complete.
    db
        True to write 20 log10 of the magnitude of a complex image, for display in a GIS.
    title
        Title of the file (TIFF tag ImageDescription).
    tags
        Further tags, name → text; these replace tags of the certificate with the same name.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    CampaignError
        If the array is not (y, x), has no CRS, is not on a uniform north-up or south-up grid of square pixels, or is
        real with `db`.
    OSError
        If the file cannot be written.

    Notes
    -----
    The certificate are the attributes of the image: numerical error and its confidence, verdict on focus with its
    reason, flags, planned models with reasons, and error budget. Arithmetic in xarray drops attributes; a file without
    the tag APERTURA_ERROR_DB states no error.

    Examples
    --------
    >>> import apertura as ap
    >>> import numpy as np
    >>> from tempfile import TemporaryDirectory
    >>> frequency = 1.2e9 + 1e6 * np.arange(256)
    >>> track = np.stack([np.linspace(-4, 4, 128), np.full(128, -20.0), np.full(128, 10.0)], -1)
    >>> aperture = ap.Aperture(track, track)
    >>> echo = np.exp(-2j * np.pi * frequency * aperture.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    >>> history = ap.PhaseHistory(echo, frequency, np.full(256, 1 / 256), np.zeros(128), aperture)
    >>> image = ap.backproject(history, ap.SceneGrid("local", -5.0, 5.0, 0.1, (100, 100)))
    >>> with TemporaryDirectory() as folder:
    ...     again = ap.read_geotiff(ap.write_geotiff(image, f"{folder}/image.tif")).load()
    >>> bool((again == image).all()), again.attrs["verdict"], again.attrs["numerical_error_db"] < -60
    (True, 'focused', True)
    """
    path = Path(path)
    image, transform = _north_up(image)
    wkt = image.coords["spatial_ref"].attrs.get("crs_wkt") if "spatial_ref" in image.coords else None
    if not wkt:
        raise CampaignError(
            "an array without a CRS",
            where="write_geotiff: image",
            expected="a coordinate spatial_ref with the attribute crs_wkt",
            remedy="Use an image of ap.backproject, or set the CRS by image.rio.write_crs.",
        )
    is_complex = image.dtype.kind == "c"
    if db and not is_complex:
        raise CampaignError(
            f"real values ({image.dtype})",
            where="write_geotiff: db",
            expected="a complex image",
            remedy="Pass the complex image, or omit db.",
        )
    placed: dict[str, Any] = {"transform": transform, "crs": wkt, "tags": _certificate(image.attrs) | dict(tags or {})}
    path.parent.mkdir(parents=True, exist_ok=True)
    if is_complex:
        (write_db if db else write_slc)(path, image.astype(np.complex64), title=title, **placed)
    else:
        meaning = str(image.attrs.get("long_name", image.name or "real values"))
        band = Band("float32", np.nan, str(image.attrs.get("units", "1")), meaning.replace("{", "{{"), "AVERAGE")
        write_cog(path, image.astype(np.float32), band, title=title, **placed)
    return path


def read_geotiff(path: str | Path, *, chunks: int | None = None) -> "xr.DataArray":
    """Open a GeoTIFF of apertura, or any other north-up GeoTIFF of one band, as an array with coordinates.

    Parameters
    ----------
    path
        File written by `write_geotiff` or by a campaign.
    chunks
        Side of dask chunks, pixels; None: values are read on first access.

    Returns
    -------
    xarray.DataArray
        (y, x), with the CRS in the coordinate spatial_ref, and NaN for pixels without data. Tags of the certificate are
        attributes as in an image of `apertura.backproject`; all other tags are attributes under their own names.

    Raises
    ------
    CampaignError
        If the file is missing, is not a raster, or has several bands.

    Examples
    --------
    >>> read_geotiff("nowhere.tif")
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere.tif: cannot be opened; ...
    """
    import rioxarray
    import xarray as xr
    from rasterio.errors import RasterioIOError

    try:
        side = {"x": chunks, "y": chunks} if chunks else None
        raster = rioxarray.open_rasterio(path, chunks=side, masked=True)
    except RasterioIOError as error:
        raise CampaignError(
            "cannot be opened", str(path), "a GeoTIFF", f"Check the path and the file ({error})."
        ) from error
    if not isinstance(raster, xr.DataArray) or raster.sizes["band"] != 1:
        bands = f"{raster.sizes['band']} bands" if isinstance(raster, xr.DataArray) else "several rasters"
        raise CampaignError(bands, str(path), "a GeoTIFF of one band", "Read it with rioxarray.open_rasterio.")
    image = raster.isel(band=0, drop=True).rename("image")
    attributes = dict(image.attrs)
    for name, tag in _TAGS.items():
        if tag in attributes:
            value = attributes.pop(tag)
            attributes[name] = float(value) if name in _NUMBERS else str(value)
    if _FOCUS in attributes:
        focus = json.loads(attributes[_FOCUS])
        attributes |= {"verdict": focus["verdict"], "verdict_reason": focus.get("reason", "")}
    image.attrs = attributes
    return image


def _north_up(image: "xr.DataArray") -> tuple["xr.DataArray", Affine]:
    """Return the image with row 0 in the north, and the outer corner and spacing of its pixels."""
    where = "write_geotiff: image"
    if getattr(image, "dims", None) != ("y", "x") or not {"x", "y"} <= set(image.coords):
        found = f"dimensions {image.dims}" if hasattr(image, "dims") else f"an object of type {type(image).__name__}"
        raise CampaignError(
            found, where, "a DataArray (y, x) with coordinates in metres", "Select one image, or transpose it."
        )
    if image.y.size > 1 and image.y[0] < image.y[-1]:
        image = image.isel(y=slice(None, None, -1))
    steps = [np.diff(image.x.values), -np.diff(image.y.values)]
    spacing = np.concatenate(steps)
    if not spacing.size:
        raise CampaignError(
            "a single pixel", where, "at least two pixels, from which the spacing is known", "Write a larger window."
        )
    spacing_m = float(spacing.mean())
    if spacing_m <= 0 or np.abs(spacing - spacing_m).max() > _UNIFORM * spacing_m:
        raise CampaignError(
            f"coordinate steps from {quoted(float(spacing.min()))} to {quoted(float(spacing.max()))} m",
            where,
            "a uniform grid of square pixels",
            "Interpolate the image to a uniform grid, or select windows without gaps.",
        )
    west_m, north_m = float(image.x[0]) - spacing_m / 2, float(image.y[0]) + spacing_m / 2
    return image, Affine(spacing_m, 0.0, west_m, 0.0, -spacing_m, north_m)


def _certificate(attributes: Mapping[str, Any]) -> dict[str, str]:
    """Return the certificate in the attributes of an image as tags."""
    tags = {tag: str(attributes[name]) for name, tag in _TAGS.items() if name in attributes}
    if "verdict" in attributes:
        focus = {"verdict": attributes["verdict"], "reason": attributes.get("verdict_reason", "")}
        tags[_FOCUS] = json.dumps(focus, ensure_ascii=False)
    return tags | {"APERTURA_VERSION": __version__, "TIFFTAG_SOFTWARE": f"apertura {__version__}"}
