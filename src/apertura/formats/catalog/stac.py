"""Images as a static STAC catalog: one item for each, with footprint, time, radar, processing, files and inputs."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any
from urllib.parse import quote

import pystac
from pystac.layout import CustomLayoutStrategy

from apertura.formats.catalog import CATALOG
from apertura.formats.catalog.assets import media_type, multihash
from apertura.formats.catalog.fields import EXTENSIONS, Acquisition

RECORDED = "apertura:recorded"
"""Field of the catalog: the first and the last pulse of all images, UTC."""

_NO_PLACE = "Local axes without a place on Earth: items have no geometry, and there is no collection, which needs one."


@dataclass(frozen=True)
class Image:
    """What an item says: one image of a flight.

    Attributes
    ----------
    flight, name
        Which: a pair, 'coherent' or 'noncoherent'.
    title
        What a person would call it.
    geometry
        GeoJSON, longitude and latitude of WGS 84; None where there is no place on Earth, or nothing was seen.
    acquisition
        When and on which frequencies.
    properties
        Fields of the extensions, and what the image says of itself.
    assets
        Key → file.
    inputs
        File relative to the campaign folder → sha256, as it was read.
    made_from
        Names of images of the flight that it is the sum of.
    """

    flight: str
    name: str
    title: str
    geometry: Mapping[str, Any] | None
    acquisition: Acquisition
    properties: Mapping[str, Any]
    assets: Mapping[str, pystac.Asset] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    made_from: Sequence[str] = ()

    @property
    def id(self) -> str:
        """Its identifier: names hold no hyphen but the one inside a pair, so no two images share it."""
        return f"{self.flight}-{self.name}"


def item_of(image: Image, root: str) -> pystac.Item:
    """Return the item of an image.

    Parameters
    ----------
    image
        What it says.
    root
        The campaign folder, seen from the item.

    Examples
    --------
    >>> from datetime import timedelta
    >>> start = datetime(2025, 5, 14, 9, tzinfo=UTC)
    >>> flown = Acquisition(start, start + timedelta(seconds=20), 1.4e9, 4e8)
    >>> square = {"type": "Polygon", "coordinates": [[[9, 48], [9.1, 48], [9.1, 48.1], [9, 48.1], [9, 48]]]}
    >>> item = item_of(Image("f01", "a-b", "a scene", square, flown, {}), "../../..")
    >>> item.id, item.bbox, item.datetime.isoformat(), item.properties["sar:frequency_band"]
    ('f01-a-b', [9.0, 48.0, 9.1, 48.1], '2025-05-14T09:00:10+00:00', 'L')
    """
    flown = image.acquisition
    named = {"title": image.title, "apertura:flight": image.flight, "apertura:image": image.name}
    told = {**named, **flown.fields, **image.properties}
    item = pystac.Item(
        image.id,
        None if image.geometry is None else dict(image.geometry),
        None if image.geometry is None else bounds([image.geometry]),
        flown.middle,
        told,
        flown.start,
        flown.end,
        [uri for prefix, uri in EXTENSIONS.items() if prefix != "sar" or "sar:frequency_band" in told],
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
    return item


def bounds(geometries: Iterable[Mapping[str, Any]]) -> list[float]:
    """Return west, south, east, north of GeoJSON geometries, degrees.

    Examples
    --------
    >>> bounds([{"coordinates": [[[1, 2], [3, 4]]]}, {"coordinates": [[0, 9]]}])
    [0.0, 2.0, 3.0, 9.0]
    """
    places = [place for geometry in geometries for place in _places(geometry["coordinates"])]
    longitudes, latitudes = zip(*places, strict=True)
    return [min(longitudes), min(latitudes), max(longitudes), max(latitudes)]


def _places(nested: Sequence[Any]) -> Iterator[tuple[float, float]]:
    if isinstance(nested[0], (int, float)):
        yield float(nested[0]), float(nested[1])
    else:
        for part in nested:
            yield from _places(part)


def catalog_files(campaign: str, images: Sequence[Image]) -> dict[str, dict[str, Any]]:
    """Return every file of the catalog of some images, its path in the catalog's folder → JSON.

    Links are relative and nothing names itself, so that the folder may be moved or served from anywhere.

    Parameters
    ----------
    campaign
        Its name, free text.
    images
        In any order; their files lie in the folder that holds the catalog's folder.
    """
    ordered = sorted(images, key=lambda image: (image.flight, image.name))
    times = min(image.acquisition.start for image in ordered), max(image.acquisition.end for image in ordered)
    told = {RECORDED: [pystac.utils.datetime_to_str(time) for time in times]}
    catalog = pystac.Catalog("apertura", f"Images of the campaign {campaign}.", title=campaign, extra_fields=told)
    parent = _parent(campaign, ordered, times)
    catalog.add_child(parent)
    for image in ordered:
        item = item_of(image, "../../../..")
        item.set_collection(parent if isinstance(parent, pystac.Collection) else None)
        parent.add_item(item)
    catalog.catalog_type = pystac.CatalogType.SELF_CONTAINED
    catalog.normalize_hrefs("/stac", _layout(), skip_unresolved=True)
    files = {}
    for thing in [catalog, parent, *parent.get_items()]:
        files[str(thing.self_href).removeprefix("/stac/")] = thing.to_dict(include_self_link=False)
    return files


def _layout() -> CustomLayoutStrategy:
    """Return where the files lie: catalog.json, beside it what holds the items, images/<flight>/<image>.json."""

    def item(one: pystac.Item, folder: str) -> str:
        flight, _, name = one.id.partition("-")
        return f"{folder}/images/{flight}/{name}.json"

    return CustomLayoutStrategy(
        catalog_func=lambda _, folder, is_root: f"{folder}/{CATALOG if is_root else 'images.json'}",
        collection_func=lambda _, folder, _is_root: f"{folder}/collection.json",
        item_func=item,
    )


def _parent(campaign: str, images: Sequence[Image], times: tuple[datetime, datetime]) -> pystac.Catalog:
    """Return what holds the items: a collection, or a catalog where the campaign has no place."""
    placed = [image.geometry for image in images if image.geometry is not None]
    title = f"{campaign} · images"
    if not placed:
        return pystac.Catalog("images", f"Radar images of the campaign {campaign}. {_NO_PLACE}", title)
    extent = pystac.Extent(pystac.SpatialExtent([bounds(placed)]), pystac.TemporalExtent([list(times)]))
    return pystac.Collection("images", f"Radar images of the campaign {campaign}.", extent, title, license="other")


def instant(nanoseconds: int) -> datetime:
    """Return a time of a recording, whole microseconds.

    Examples
    --------
    >>> instant(1_500_000_000).isoformat()
    '1970-01-01T00:00:01.500000+00:00'
    """
    seconds, rest = divmod(nanoseconds, 10**9)
    return datetime.fromtimestamp(seconds, UTC).replace(microsecond=rest // 1000)
