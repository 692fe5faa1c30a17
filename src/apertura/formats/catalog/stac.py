"""Static STAC catalog of images: one item per image, with footprint, time, radar, processing, files and inputs."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pystac
from pystac.layout import CustomLayoutStrategy

from apertura.common.attribution import Attribution
from apertura.common.errors import CampaignError
from apertura.common.leap_seconds import GPS_EPOCH
from apertura.common.raster import opened_raster
from apertura.common.units import frequency_band
from apertura.core.geometry.geodesy import longitude_range
from apertura.formats.catalog import CATALOG

# ---- Fields and schemas of STAC extensions --------------------------------------------------------------------------

_BASE = "https://stac-extensions.github.io"

EXTENSIONS: Mapping[str, str] = {
    "file": f"{_BASE}/file/v2.1.0/schema.json",
    "insar": f"{_BASE}/insar/v1.0.0/schema.json",
    "processing": f"{_BASE}/processing/v1.2.0/schema.json",
    "product": f"{_BASE}/product/v1.0.0/schema.json",
    "proj": f"{_BASE}/projection/v2.0.0/schema.json",
    "raster": f"{_BASE}/raster/v2.0.0/schema.json",
    "sar": f"{_BASE}/sar/v1.3.0/schema.json",
    "sci": f"{_BASE}/scientific/v1.0.0/schema.json",
    "view": f"{_BASE}/view/v1.1.0/schema.json",
}
"""Prefix of the fields → URI of the schema, which is used only as an identifier and is not downloaded."""

POLARISATIONS = frozenset({"HH", "HV", "VH", "VV", "LH", "LV", "RH", "RV"})
"""Polarisations of the SAR extension that a configured pair of antennas can have."""

_FIRST_CLOCK = GPS_EPOCH.astype("datetime64[us]").item().replace(tzinfo=UTC)  # earlier times are pulse counters
_NO_CLOCK = "none: the recording contains no time of day; times are pulse numbers in seconds since 1970-01-01"


@dataclass(frozen=True)
class AcquisitionTime:
    """Acquisition time and frequency band of an image.

    Attributes
    ----------
    start, end
        UTC of the first and of the last pulse.
    centre_hz, bandwidth_hz
        Centre frequency and bandwidth of the received band.
    """

    start: datetime
    end: datetime
    centre_hz: float
    bandwidth_hz: float

    @property
    def middle(self) -> datetime:
        """Mid-time between start and end."""
        return self.start + (self.end - self.start) / 2

    @property
    def fields(self) -> dict[str, Any]:
        """Fields of the SAR extension; the frequency band is omitted if no letter is defined for it."""
        band = frequency_band(self.centre_hz)
        return {
            "sar:center_frequency": round(self.centre_hz / 1e9, 9),
            "sar:bandwidth": round(self.bandwidth_hz / 1e9, 9),
            **({"sar:frequency_band": band} if band else {}),
            **({"apertura:clock": _NO_CLOCK} if self.start < _FIRST_CLOCK else {}),
        }

    @classmethod
    def together(cls, parts: Sequence["AcquisitionTime"]) -> "AcquisitionTime":
        """Combine the acquisition metadata of the summed images.

        The result extends from the first to the last pulse and covers all frequencies.

        Examples
        --------
        >>> day = [datetime(2025, 5, 14, hour, tzinfo=UTC) for hour in range(4)]
        >>> low, high = AcquisitionTime(*day[:2], 1.3e9, 2e8), AcquisitionTime(*day[1:3], 1.5e9, 2e8)
        >>> both = AcquisitionTime.together([low, high])
        >>> both.end.hour, both.centre_hz, both.bandwidth_hz
        (2, 1400000000.0, 400000000.0)
        """
        low = min(part.centre_hz - part.bandwidth_hz / 2 for part in parts)
        high = max(part.centre_hz + part.bandwidth_hz / 2 for part in parts)
        ends = min(part.start for part in parts), max(part.end for part in parts)
        return cls(*ends, (low + high) / 2, high - low)


def projection(wkt: str, shape: tuple[int, int], transform: Sequence[float]) -> dict[str, Any]:
    """Return the properties of the projection extension for a north-up raster.

    Parameters
    ----------
    wkt
        CRS in any format supported by pyproj.
    shape
        Rows, columns.
    transform
        Six coefficients of the affine transform, row by row: column and row to easting and northing, metres.

    Examples
    --------
    >>> from pyproj import CRS
    >>> fields = projection(CRS("EPSG:32632").to_wkt(), (40, 60), (0.5, 0, 500000, 0, -0.5, 100))
    >>> fields["proj:code"], fields["proj:bbox"]
    ('EPSG:32632', [500000, 80.0, 500030.0, 100])
    """
    from pyproj import CRS

    crs = CRS.from_user_input(wkt)
    code = crs.to_authority(min_confidence=100)
    step_x, _, west, _, step_y, north = transform
    return {
        "proj:code": ":".join(code) if code else None,
        "proj:wkt2": crs.to_wkt(),
        "proj:shape": list(shape),
        "proj:transform": list(transform),
        "proj:bbox": [west, north + shape[0] * step_y, west + shape[1] * step_x, north],
    }


def true_azimuth_deg(wkt: str, point: tuple[float, float], grid_azimuth_deg: float | None) -> float | None:
    """Convert a direction from grid north to true north, degrees clockwise; None in a local frame.

    Parameters
    ----------
    wkt
        CRS in any format supported by pyproj.
    point
        Easting and northing of the point at which the direction is measured, metres.
    grid_azimuth_deg
        Direction clockwise from grid north; None: not known.

    Examples
    --------
    >>> true_azimuth_deg("EPSG:32632", (600000.0, 5300000.0), 90.0)
    90.9909
    """
    from pyproj import CRS, Geod, Transformer

    crs = CRS.from_user_input(wkt)
    if grid_azimuth_deg is None or not crs.is_projected:
        return None
    (x, y), angle = point, np.radians(grid_azimuth_deg)
    step_m = 100.0  # long enough for rounding, short enough for the curvature of grid lines: below 1e-3 degrees
    to_degrees = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    longitude, latitude = to_degrees.transform([x, x + step_m * np.sin(angle)], [y, y + step_m * np.cos(angle)])
    azimuth, _, _ = Geod(ellps="WGS84").inv(longitude[0], latitude[0], longitude[1], latitude[1])
    return round(float(azimuth) % 360, 4)


# ---- Assets: type, role, size, checksum and bands of a file ---------------------------------------------------------

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
"""Suffix of a file → its media type."""

UNKNOWN_TYPE = "application/octet-stream"

_ROLES: Mapping[str, tuple[str, ...]] = {
    "coherence.tif": ("data", "coherence"),
    "phase.tif": ("data", "phase"),
    "unwrapped.tif": ("data", "unwrapped_phase"),
    "quicklook.png": ("overview", "visual"),
    "mask.tif": ("data-mask", "metadata"),
    "incidence.tif": ("local-incidence-angle", "metadata"),
    "ellipsoidal_incidence.tif": ("incidence-angle", "metadata"),
    "scattering_area.tif": ("metadata",),
    "gamma_sigma_ratio.tif": ("metadata",),
    "looks.tif": ("metadata",),
    "bistatic_angle.tif": ("metadata",),
    "line_of_sight_enu.tif": ("metadata",),
    "slant_range_distance.tif": ("metadata",),
    "nesz.tif": ("noise-power", "metadata"),
}
_ROLES_OF_TYPE: Mapping[str, tuple[str, ...]] = {".tif": ("data",), ".qml": ("style",)}


@dataclass(frozen=True)
class FileFacts:
    """Metadata read from a file.

    Attributes
    ----------
    title
        Title.
    bands
        For a raster: common fields and those of the raster extension, one mapping per band.
    inputs
        For a raster: source file → SHA-256 of the file.
    place
        For a raster: shape and transform, fields of the projection extension.
    """

    title: str
    bands: list[dict[str, Any]] = field(default_factory=list)
    inputs: Mapping[str, str] = field(default_factory=dict)
    place: Mapping[str, Any] = field(default_factory=dict)


def multihash(sha256: str) -> str:
    """Format a SHA-256 as a multihash for the file extension: code of the hash function, length in bytes, hash.

    Examples
    --------
    >>> multihash("ab" * 32)[:8]
    '1220abab'
    """
    return f"1220{sha256}"


def media_type(name: str) -> str:
    """Return the media type of a file according to its name.

    Examples
    --------
    >>> media_type("f01/a-b/mask.tif"), media_type("raw/f01/a.sigmf-data")
    ('image/tiff; application=geotiff; profile=cloud-optimized', 'application/octet-stream')
    """
    return MEDIA_TYPES.get(Path(name).suffix, UNKNOWN_TYPE)


def read_facts(path: Path) -> FileFacts:
    """Read the metadata of a file; for a GeoTIFF, its bands and the sources stated in its tags.

    Raises
    ------
    CampaignError
        If a .tif file cannot be opened as GeoTIFF.
    """
    if path.suffix != ".tif":
        return FileFacts(path.name)
    expected, remedy = "a GeoTIFF of the workflow", "Delete the manifest in its folder and run the workflow again."
    try:
        with opened_raster(path, expected=expected, remedy=remedy) as raster:
            bands = [_band(raster, number, path.stem) for number in range(raster.count)]
            facts = json.loads(raster.tags().get("APERTURA_INPUTS", "{}"))
            inputs = {str(name): str(digest) for name, digest in facts.items()}
            place = {"proj:shape": list(raster.shape), "proj:transform": list(raster.transform)[:6]}
            return FileFacts(raster.descriptions[0] or path.name, bands, inputs, place)
    except (ValueError, AttributeError) as error:
        raise CampaignError("cannot be read as GeoTIFF", path, expected, remedy) from error


def _band(raster: Any, number: int, name: str) -> dict[str, Any]:
    dtype, nodata, unit = (values[number] for values in (raster.dtypes, raster.nodatavals, raster.units))
    band: dict[str, Any] = {
        "name": name if raster.count == 1 else f"{name}_{number + 1}",
        "description": raster.descriptions[number] or name,
        "data_type": {"complex64": "cfloat32", "complex128": "cfloat64"}.get(dtype, dtype),
        "raster:sampling": "area",
        "raster:spatial_resolution": raster.res[0],
        "raster:bits_per_sample": 8 * np.dtype(dtype).itemsize,
    }
    if nodata is not None:
        band["nodata"] = "nan" if nodata != nodata else nodata  # noqa: PLR0124 - only NaN differs from itself
    if unit:
        band["unit"] = unit
    return band


def asset_of(path: Path, href: str, *, sha256: str, facts: FileFacts) -> pystac.Asset:
    """Build the STAC asset of a file.

    Parameters
    ----------
    path
        The file; only its size is read.
    href
        Path relative to the item, percent-encoded.
    sha256
        SHA-256 of the file, hex.
    facts
        Metadata of the file, from `read_facts`.
    """
    name = path.name
    roles = _ROLES.get(name) or _ROLES_OF_TYPE.get(path.suffix) or ("metadata",)
    extra = {"file:checksum": multihash(sha256), "file:size": path.stat().st_size}
    if facts.bands:
        extra |= {"bands": facts.bands, "file:byte_order": "little-endian"}
    return pystac.Asset(href, facts.title, media_type=media_type(name), roles=list(roles), extra_fields=extra)


# ---- Static catalog: one item per image -----------------------------------------------------------------------------

RECORDED = "apertura:recorded"
"""Field of the catalog: UTC of the first and the last pulse of all images."""

_NO_PLACE = "Local frame, not georeferenced: items have no geometry, which a STAC collection would require."


@dataclass(frozen=True)
class Image:
    """Image of a flight, or interferogram, the content of a STAC item.

    Attributes
    ----------
    flight, name
        Flight, and name of the image: a pair, 'coherent' or 'noncoherent'; or 'interferometry' and the interferogram.
    title
        Title.
    geometry
        GeoJSON, longitude and latitude of WGS 84; None in a local frame, or if nothing was illuminated.
    acquisition
        Acquisition time and frequency band.
    properties
        Fields of the extensions, and quality measures of the image.
    assets
        Key → file.
    inputs
        File relative to the campaign folder → SHA-256 of its content when it was read.
    made_from
        Names of the flight's images of which this image is the sum.
    compared
        Link relation, 'reference' or 'secondary' → flight and name of an image of this interferogram.
    """

    flight: str
    name: str
    title: str
    geometry: Mapping[str, Any] | None
    acquisition: AcquisitionTime
    properties: Mapping[str, Any]
    assets: Mapping[str, pystac.Asset] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    made_from: Sequence[str] = ()
    compared: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """Identifier, which is unique because no name contains a hyphen except the hyphen of a pair."""
        return f"{self.flight}-{self.name}"


_SOMETIMES = frozenset({"view", "sci", "insar"})
"""Extensions whose fields are not known for every image."""


def item_of(image: Image, root: str) -> pystac.Item:
    """Build the STAC item of an image.

    Parameters
    ----------
    image
        Content of the item.
    root
        Path of the campaign folder, relative to the item.

    Examples
    --------
    >>> from datetime import timedelta
    >>> start = datetime(2025, 5, 14, 9, tzinfo=UTC)
    >>> acquisition = AcquisitionTime(start, start + timedelta(seconds=20), 1.4e9, 4e8)
    >>> square = {"type": "Polygon", "coordinates": [[[9, 48], [9.1, 48], [9.1, 48.1], [9, 48.1], [9, 48]]]}
    >>> item = item_of(Image("f01", "a-b", "a scene", square, acquisition, {}), "../../..")
    >>> item.id, item.bbox, item.datetime.isoformat(), item.properties["sar:frequency_band"]
    ('f01-a-b', [9.0, 48.0, 9.1, 48.1], '2025-05-14T09:00:10+00:00', 'L')
    """
    acquisition = image.acquisition
    names = {"title": image.title, "apertura:flight": image.flight, "apertura:image": image.name}
    properties = {**names, **acquisition.fields, **image.properties}
    item = pystac.Item(
        image.id,
        None if image.geometry is None else dict(image.geometry),
        None if image.geometry is None else bounds([image.geometry]),
        acquisition.middle,
        properties,
        acquisition.start,
        acquisition.end,
        [
            uri
            for prefix, uri in EXTENSIONS.items()
            if prefix not in _SOMETIMES or any(name.startswith(f"{prefix}:") for name in properties)
        ],
    )
    for key, asset in image.assets.items():
        item.add_asset(key, asset)
    for name, sha256 in sorted(image.inputs.items()):
        link = pystac.Link("derived_from", f"{root}/{quote(name)}", media_type(name), name)
        link.extra_fields["file:checksum"] = multihash(sha256)
        item.add_link(link)
    for name in image.made_from:
        title = f"{image.flight} · {name}"
        item.add_link(pystac.Link("derived_from", f"./{name}.json", pystac.MediaType.GEOJSON, title))
    for relation, (flight, name) in image.compared.items():
        item.add_link(pystac.Link(relation, f"../{flight}/{name}.json", pystac.MediaType.GEOJSON, f"{flight} · {name}"))
    return item


def bounds(geometries: Iterable[Mapping[str, Any]]) -> list[float]:
    """Return west, south, east, north of GeoJSON geometries in degrees; west > east across the antimeridian.

    Examples
    --------
    >>> bounds([{"coordinates": [[[1, 2], [3, 4]]]}, {"coordinates": [[0, 9]]}])
    [0.0, 2.0, 3.0, 9.0]
    """
    positions = [position for geometry in geometries for position in _positions(geometry["coordinates"])]
    longitudes, latitudes = zip(*positions, strict=True)
    west, east = longitude_range(np.array(longitudes))
    return [west, min(latitudes), east, max(latitudes)]


def _positions(nested: Sequence[Any]) -> Iterator[tuple[float, float]]:
    if isinstance(nested[0], (int, float)):
        yield float(nested[0]), float(nested[1])
    else:
        for part in nested:
            yield from _positions(part)


def catalog_files(
    campaign: str,
    images: Sequence[Image],
    attribution: Attribution,
) -> dict[str, dict[str, Any]]:
    """Return all files of the catalog of images: path in the catalog's folder → JSON.

    Links are relative, and self links are omitted, so that the folder can be moved, or served from any location.

    Parameters
    ----------
    campaign
        Name of the campaign, free text.
    images
        The images, in any order; their files are below the parent folder of the catalog's folder.
    attribution
        Attribution of all images.
    """
    ordered = sorted(images, key=lambda image: (image.flight, image.name))
    times = min(image.acquisition.start for image in ordered), max(image.acquisition.end for image in ordered)
    fields = {RECORDED: [pystac.utils.datetime_to_str(time) for time in times]}
    catalog = pystac.Catalog("apertura", f"Images of the campaign {campaign}.", title=campaign, extra_fields=fields)
    parent = _parent(campaign, ordered, times)
    credited = _credited(attribution, campaign, times[0])
    if isinstance(parent, pystac.Collection):
        parent.license = attribution.licence or "other"
        parent.providers = [pystac.Provider.from_dict(provider) for provider in credited.get("providers", [])] or None
        cited = {name: value for name, value in credited.items() if name.startswith("sci:")}
        parent.extra_fields |= cited
        parent.stac_extensions += [EXTENSIONS["sci"]] if cited else []
    if attribution.doi:
        parent.add_link(pystac.Link("cite-as", f"https://doi.org/{quote(attribution.doi)}"))
    catalog.add_child(parent)
    for image in ordered:
        item = item_of(replace(image, properties={**image.properties, **credited}), "../../../..")
        item.set_collection(parent if isinstance(parent, pystac.Collection) else None)
        parent.add_item(item)
    catalog.catalog_type = pystac.CatalogType.SELF_CONTAINED
    catalog.normalize_hrefs("/stac", _layout(), skip_unresolved=True)
    files = {}
    for entry in [catalog, parent, *parent.get_items()]:
        files[str(entry.self_href).removeprefix("/stac/")] = entry.to_dict(include_self_link=False)
    return files


def _credited(attribution: Attribution, campaign: str, start: datetime) -> dict[str, Any]:
    """Return the fields of an item that attribute it: providers, licence, platform, instruments and citation."""
    producers = [attribution.institution] if attribution.institution else []
    people = [
        {"name": str(person), "roles": ["producer"]}
        | ({"url": f"https://orcid.org/{person.orcid}"} if person.orcid else {})
        for person in attribution.creators
    ]
    fields = {
        "providers": [{"name": name, "roles": ["producer", "processor"]} for name in producers] + people,
        "license": attribution.licence,
        "platform": attribution.platform,
        "instruments": [attribution.instrument] if attribution.instrument else None,
        "processing:facility": attribution.institution,
        "sci:doi": attribution.doi,
        "sci:citation": attribution.citation(campaign, start.year if start >= _FIRST_CLOCK else None),
    }
    return {name: value for name, value in fields.items() if value}


def _layout() -> CustomLayoutStrategy:
    """Return the file layout: catalog.json and the parent of the items in one folder; images/<flight>/<image>.json."""

    def path_of(item: pystac.Item, folder: str) -> str:
        flight, _, name = item.id.partition("-")
        return f"{folder}/images/{flight}/{name}.json"

    return CustomLayoutStrategy(
        catalog_func=lambda _, folder, is_root: f"{folder}/{CATALOG if is_root else 'images.json'}",
        collection_func=lambda _, folder, _is_root: f"{folder}/collection.json",
        item_func=path_of,
    )


def _parent(campaign: str, images: Sequence[Image], times: tuple[datetime, datetime]) -> pystac.Catalog:
    """Return the parent of the items: a collection, or a catalog if the campaign is not georeferenced."""
    geometries = [image.geometry for image in images if image.geometry is not None]
    title = f"{campaign} · images"
    if not geometries:
        return pystac.Catalog("images", f"Radar images of the campaign {campaign}. {_NO_PLACE}", title)
    extent = pystac.Extent(pystac.SpatialExtent([bounds(geometries)]), pystac.TemporalExtent([list(times)]))
    return pystac.Collection("images", f"Radar images of the campaign {campaign}.", extent, title, license="other")


def instant(nanoseconds: int) -> datetime:
    """Convert nanoseconds since 1970 to a UTC datetime, truncated to microseconds.

    Examples
    --------
    >>> instant(1_500_000_000).isoformat()
    '1970-01-01T00:00:01.500000+00:00'
    """
    seconds, rest = divmod(nanoseconds, 10**9)
    return datetime.fromtimestamp(seconds, UTC).replace(microsecond=rest // 1000)
