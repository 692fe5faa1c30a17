"""A file of an image as STAC describes it: type, role, size, checksum, and what the pixels of a raster are."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pystac

from apertura.common.errors import CampaignError
from apertura.common.raster import opened_raster

COG = "image/tiff; application=geotiff; profile=cloud-optimized"

MEDIA_TYPES: Mapping[str, str] = {
    ".cphd": "application/octet-stream",
    ".csv": "text/csv",
    ".geojson": "application/geo+json",
    ".html": "text/html",
    ".json": "application/json",
    ".npy": "application/octet-stream",
    ".png": "image/png",
    ".qml": "application/xml",
    ".tif": COG,
    ".tsv": "text/tab-separated-values",
    ".vrt": "application/xml",
    ".xml": "application/xml",
    ".yaml": "application/yaml",
}
"""How the name of a file ends → its media type."""

UNKNOWN_TYPE = "application/octet-stream"

_ROLES: Mapping[str, tuple[str, ...]] = {
    "quicklook.png": ("overview", "visual"),
    "mask.tif": ("data-mask", "metadata"),
    "incidence.tif": ("local-incidence-angle", "metadata"),
    "looks.tif": ("metadata",),
    "bistatic_angle.tif": ("metadata",),
    "nesz.tif": ("noise-power", "metadata"),
}
_ROLES_OF_TYPE: Mapping[str, tuple[str, ...]] = {".tif": ("data",), ".qml": ("style",)}


@dataclass(frozen=True)
class Told:
    """What a file says of itself.

    Attributes
    ----------
    title
        What a person would call it.
    bands
        Of a raster: fields of the raster extension, one mapping a band.
    inputs
        File → sha256 of what a raster was made from.
    """

    title: str
    bands: list[dict[str, Any]] = field(default_factory=list)
    inputs: Mapping[str, str] = field(default_factory=dict)


def multihash(sha256: str) -> str:
    """Return a sha256 as the file extension writes it: which hash, how many bytes, the hash.

    Examples
    --------
    >>> multihash("ab" * 32)[:8]
    '1220abab'
    """
    return f"1220{sha256}"


def media_type(name: str) -> str:
    """Return the media type of a file by its name.

    Examples
    --------
    >>> media_type("f01/a-b/mask.tif"), media_type("raw/f01/a.sigmf-data")
    ('image/tiff; application=geotiff; profile=cloud-optimized', 'application/octet-stream')
    """
    return MEDIA_TYPES.get(Path(name).suffix, UNKNOWN_TYPE)


def told_by(path: Path) -> Told:
    """Return what a file says of itself; of a GeoTIFF its bands and what it was made from.

    Raises
    ------
    CampaignError
        If it is called a GeoTIFF and cannot be opened as one.
    """
    if path.suffix != ".tif":
        return Told(path.name)
    expected, remedy = "a GeoTIFF of the workflow", "Delete the manifest beside it and run the workflow again."
    try:
        with opened_raster(path, expected=expected, remedy=remedy) as raster:
            bands = [_band(raster, number) for number in range(raster.count)]
            told = json.loads(raster.tags().get("APERTURA_INPUTS", "{}"))
            inputs = {str(name): str(digest) for name, digest in told.items()}
            return Told(raster.descriptions[0] or path.name, bands, inputs)
    except (ValueError, AttributeError) as error:
        raise CampaignError("cannot be read as GeoTIFF", path, expected, remedy) from error


def _band(raster: Any, number: int) -> dict[str, Any]:
    dtype, nodata, unit = (of[number] for of in (raster.dtypes, raster.nodatavals, raster.units))
    band: dict[str, Any] = {
        "data_type": {"complex64": "cfloat32", "complex128": "cfloat64"}.get(dtype, dtype),
        "sampling": "area",
        "spatial_resolution": raster.res[0],
    }
    if nodata is not None:
        band["nodata"] = "nan" if nodata != nodata else nodata  # noqa: PLR0124 - NaN alone differs from itself
    if unit:
        band["unit"] = unit
    return band


def asset_of(path: Path, href: str, *, sha256: str, told: Told) -> pystac.Asset:
    """Return the asset of a file.

    Parameters
    ----------
    path
        The file; only its size is looked up.
    href
        Where it lies, seen from the item, percent-encoded.
    sha256
        Of its bytes, hex.
    told
        What it says of itself.
    """
    name = path.name
    roles = _ROLES.get(name) or _ROLES_OF_TYPE.get(path.suffix) or ("metadata",)
    extra = {"file:checksum": multihash(sha256), "file:size": path.stat().st_size}
    if told.bands:
        extra["raster:bands"] = told.bands
    return pystac.Asset(href, told.title, media_type=media_type(name), roles=list(roles), extra_fields=extra)
