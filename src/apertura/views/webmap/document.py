"""What the page shows, as plain values: images with their layers and stretches, places, and how to reach the files."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any
from urllib.parse import parse_qs, quote, unquote, urlsplit

from apertura.views.image_report import ImageValues, explained_flags

FORMAT = 1
"""Of `map.json`; the page refuses another."""

KINDS = ("image", "classes", "measure")
"""How a layer is drawn: grey between two dB that the reader chooses, colours with a name each, a ramp of colours."""

CLASSES = {0: "seen", 1: "shadow", 2: "layover", 3: "shadow and layover"}
"""Value of the mask → what it means."""


@dataclass(frozen=True)
class Layer:
    """One raster of an image.

    Attributes
    ----------
    file, sha256
        Its name, and the hash of the file that is meant and of no other.
    kind
        One of `KINDS`.
    title, unit
        What its values are.
    low, high
        Values at the ends of the colours, in `unit`.
    """

    file: str
    sha256: str
    kind: str
    title: str
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class Place:
    """A point of the target list.

    Attributes
    ----------
    name
        What it is called.
    source
        Where it is known from: 'truth', 'stated' or 'found' (in an image).
    x_m, y_m
        Easting and northing, metres in the campaign's CRS.
    image
        ``flight/pair`` that it was found in; None if in none.
    """

    name: str
    source: str
    x_m: float
    y_m: float
    image: str | None = None


def image_entry(flight: str, image: str, report: Mapping[str, Any], layers: Iterable[Layer]) -> dict[str, Any]:
    """Return what the page knows of an image.

    Parameters
    ----------
    flight, image
        Flight, and pair or 'fused'.
    report
        Its ``image.json``.
    layers
        Its rasters.
    """
    values = ImageValues.of(report)
    return {
        "flight": flight,
        "image": image,
        "verdict": values.verdict,
        "why": values.why,
        "error_db": values.error_db,
        "flags": explained_flags(values.flags),
        "layers": [
            {**asdict(layer), "url": url_of(f"{flight}/{image}/{layer.file}", layer.sha256)} for layer in layers
        ],
    }


def found_places(flight: str, image: str, report: Mapping[str, Any]) -> list[Place]:
    """Return the brightest pixel of an image and the bright points that its focus was judged by.

    Examples
    --------
    >>> found_places("f01", "a-a", {"brightest": {"x_m": 3.0, "y_m": 4.0}, "focus": {"verdict": "cannot tell"}})
    [Place(name='brightest', source='found', x_m=3.0, y_m=4.0, image='f01/a-a')]
    """
    where = f"{flight}/{image}"
    brightest = report["brightest"]
    points = [
        (f"bright point {number + 1}", point["x_m"], point["y_m"])
        for number, point in enumerate(report["focus"].get("points", ()))
        if (point["x_m"], point["y_m"]) != (brightest["x_m"], brightest["y_m"])
    ]
    return [
        Place(name, "found", float(x), float(y), where)
        for name, x, y in (("brightest", brightest["x_m"], brightest["y_m"]), *points)
    ]


def url_of(file: str, sha256: str) -> str:
    """Return the address of a file of the results as seen from ``map/``, with the hash that `MapServer` compares.

    Examples
    --------
    >>> url_of("f 1/a-b/db.tif", "0f")
    '../f%201/a-b/db.tif?sha256=0f'
    """
    return f"../{quote(file)}?sha256={sha256}"


def asked_file(target: str) -> tuple[str, str | None]:
    """Return the file that a request names and the hash it expects, if any; '' is no name of a file.

    Parameters
    ----------
    target
        As it stands in the request, percent-encoded.

    Examples
    --------
    >>> asked_file("/f01/a-b/db.tif?sha256=0f"), asked_file("http://x/y"), asked_file("/%ff")
    (('f01/a-b/db.tif', '0f'), ('', None), ('', None))
    """
    try:
        if not target.startswith("/"):
            return "", None
        split = urlsplit(target)
        name = unquote(split.path[1:], errors="strict")
        return name, parse_qs(split.query).get("sha256", [None])[-1]
    except ValueError:
        return "", None


def named_files(document: Mapping[str, Any]) -> dict[str, str]:
    """Return file of the results → sha256, of those that a `map.json` names; none where no page reads its format.

    Parameters
    ----------
    document
        Of `map_document`.

    Examples
    --------
    >>> layer = {"url": url_of("f 1/a-b/db.tif", "0f")}
    >>> named_files({"format": FORMAT, "images": [{"layers": [layer]}], "coverage_url": None})
    {'f 1/a-b/db.tif': '0f'}
    """
    if document["format"] != FORMAT:
        return {}
    urls = [layer["url"] for image in document["images"] for layer in image["layers"]]
    asked = (asked_file(url.removeprefix("..")) for url in (*urls, document["coverage_url"]) if url is not None)
    return {name: sha256 for name, sha256 in asked if sha256 is not None}


def map_document(
    campaign: str,
    *,
    grid: Mapping[str, Any],
    crs: Mapping[str, Any],
    images: Sequence[Mapping[str, Any]],
    places: Iterable[Place],
    coverage_url: str | None,
    notes: Sequence[str] = (),
    again_s: float | None = None,
) -> dict[str, Any]:
    """Return `map.json`.

    Parameters
    ----------
    campaign
        Its name.
    grid
        ``bounds_m`` (west, south, east, north), ``spacing_m``, ``shape`` (rows, columns).
    crs
        ``name``; ``local``; ``code`` and ``proj4`` (None where there is none); ``control``: (n, 4) easting and northing
        (m) with longitude and latitude (deg, WGS 84) by PROJ, which the page holds its own arithmetic against.
    images
        Of `image_entry`.
    places
        The target list.
    coverage_url
        Of the GeoJSON with tracks and footprints; None where it has no place on Earth.
    notes
        What the reader should know of the map.
    again_s
        Seconds after which the page reads it again: images of a flight that goes on; None: it is as it will be.
    """
    return {
        "format": FORMAT,
        "campaign": campaign,
        "grid": dict(grid),
        "crs": dict(crs),
        "classes": {str(value): words for value, words in CLASSES.items()},
        "images": [dict(image) for image in images],
        "places": [asdict(place) for place in places],
        "coverage_url": coverage_url,
        "notes": list(notes),
        "again_s": again_s,
    }
