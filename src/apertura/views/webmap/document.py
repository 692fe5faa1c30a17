"""Rule `map`: contents of the map page as JSON, i.e. images, layers with display ranges, points, and links to files."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, unquote, urlsplit

import numpy as np

from apertura.campaign.config import FUSED
from apertura.campaign.digests import digest_of
from apertura.campaign.folder import Campaign
from apertura.campaign.store import check_listed, manifest_of, open_listed, read_manifest, record_files, remake_from
from apertura.common.atomic import write_json
from apertura.common.documents import read_json, undamaged
from apertura.common.errors import CampaignError
from apertura.common.raster import opened_raster
from apertura.core.geometry.geodesy import LOCAL, frame_from_map, geodetic_from_ecef
from apertura.core.scene.grid import SceneGrid
from apertura.formats.export import COVERAGE, MAP, Export, exports_in
from apertura.stages.scene import settled_scene
from apertura.views.quality import ImageValues, explained_flags, read_report
from apertura.workflow.lineage import result_of
from apertura.workflow.rules import INTERFEROMETRY, STACK

FORMAT = 2
"""Format version of `map.json`; the page rejects other versions."""

KINDS = ("image", "classes", "measure", "phase")
"""Styles of a layer: greyscale between two adjustable values in dB; a colour for each class; a colour ramp; a cyclic
colour ramp.
"""

CLASSES = {0: "visible", 1: "shadow", 2: "layover", 3: "shadow and layover"}
"""Value of the mask → class name."""


@dataclass(frozen=True)
class Layer:
    """Raster of an image.

    Attributes
    ----------
    file, sha256
        File name, and the hash that the served file must have.
    kind
        One of `KINDS`.
    title, unit
        Quantity and unit of the values.
    low, high
        Values at the ends of the colour scale, in `unit`.
    folder
        Folder of the file relative to the results; empty for the folder of the image.
    """

    file: str
    sha256: str
    kind: str
    title: str
    unit: str
    low: float
    high: float
    folder: str = ""


@dataclass(frozen=True)
class Place:
    """A point of the target list.

    Attributes
    ----------
    name
        Name of the point.
    source
        Origin: 'truth' (simulation), 'stated' (config) or 'found' (image).
    x_m, y_m
        Easting and northing, metres in the campaign's CRS.
    image
        ``flight/pair`` of the image in which the point was found; None for other sources.
    """

    name: str
    source: str
    x_m: float
    y_m: float
    image: str | None = None


def image_entry(
    flight: str, image: str, report: Mapping[str, Any], layers: Iterable[Layer], tags: Mapping[str, str]
) -> dict[str, Any]:
    """Return the entry of an image in the document.

    Parameters
    ----------
    flight, image
        Flight, and pair or 'fused'.
    report
        Contents of the image's ``image.json``.
    layers
        Rasters of the image.
    tags
        Tags of the image's GeoTIFF, with the time of acquisition and the licence.
    """
    values = ImageValues.of(report)
    times = [tags[name] for name in ("APERTURA_ACQUISITION_START", "APERTURA_ACQUISITION_END") if name in tags]
    return {
        "flight": flight,
        "image": image,
        "verdict": values.verdict,
        "reason": values.reason,
        "error_db": values.error_db,
        "flags": explained_flags(values.flags),
        "acquired": times,
        "licence": tags.get("TIFFTAG_COPYRIGHT"),
        "layers": [
            {
                **{name: value for name, value in asdict(layer).items() if name != "folder"},
                "url": url_of(f"{layer.folder or f'{flight}/{image}'}/{layer.file}", layer.sha256),
            }
            for layer in layers
        ],
    }


def found_places(flight: str, image: str, report: Mapping[str, Any]) -> list[Place]:
    """Return the brightest pixel of an image and the bright points used for the focus verdict.

    Examples
    --------
    >>> found_places("f01", "a-a", {"brightest": {"x_m": 3.0, "y_m": 4.0}, "focus": {"verdict": "inconclusive"}})
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
    """Return the URL of a file in the results, relative to ``map/``, with the hash that `MapServer` compares.

    Examples
    --------
    >>> url_of("f 1/a-b/db.tif", "0f")
    '../f%201/a-b/db.tif?sha256=0f'
    """
    return f"../{quote(file)}?sha256={sha256}"


def requested_file(target: str) -> tuple[str, str | None]:
    """Return file name and expected hash (None if absent) of a request; '' as the name of an invalid request.

    Parameters
    ----------
    target
        Target of the request, percent-encoded.

    Examples
    --------
    >>> requested_file("/f01/a-b/db.tif?sha256=0f"), requested_file("http://x/y"), requested_file("/%ff")
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
    """Return the result files named in a `map.json`, file → SHA-256; empty for a format that the page rejects.

    Parameters
    ----------
    document
        A document returned by `map_document`.

    Examples
    --------
    >>> layer = {"url": url_of("f 1/a-b/db.tif", "0f")}
    >>> named_files({"format": FORMAT, "images": [{"layers": [layer]}], "coverage_url": None})
    {'f 1/a-b/db.tif': '0f'}
    """
    if document["format"] != FORMAT:
        return {}
    urls = [layer["url"] for image in document["images"] for layer in image["layers"]]
    requests = (requested_file(url.removeprefix("..")) for url in (*urls, document["coverage_url"]) if url is not None)
    return {name: sha256 for name, sha256 in requests if sha256 is not None}


def listed_document(campaign: Campaign) -> Mapping[str, Any]:
    """Return the contents of the campaign's `map.json`, verified by its manifest."""
    path = campaign.result(MAP)
    return open_listed(path, manifest_of(path))


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
    """Return the contents of `map.json`.

    Parameters
    ----------
    campaign
        Name of the campaign.
    grid
        ``bounds_m`` (west, south, east, north), ``spacing_m``, ``shape`` (rows, columns).
    crs
        ``name``; ``local``; ``code`` and ``proj4`` (None if not available); ``control``: (n, 4) easting and northing
        (m), and longitude and latitude (deg, WGS 84) computed by PROJ, with which the page checks its projection.
    images
        Entries returned by `image_entry`.
    places
        The target list.
    coverage_url
        URL of the GeoJSON with tracks and footprints; None for a local frame.
    notes
        Remarks on the map for the user.
    again_s
        Interval in seconds at which the page reloads the document during a flight; None if it does not change.
    """
    return {
        "format": FORMAT,
        "campaign": campaign,
        "grid": dict(grid),
        "crs": dict(crs),
        "classes": {str(value): name for value, name in CLASSES.items()},
        "images": [dict(image) for image in images],
        "places": [asdict(place) for place in places],
        "coverage_url": coverage_url,
        "notes": list(notes),
        "again_s": again_s,
    }


_RANGE_SAMPLES = 512  # samples along the longer side of a raster from which the range of values is determined
_MOST_TARGETS = 1000


def webmap(campaign: Campaign) -> list[Path]:
    """Write results/map/map.json; return the path of the file."""
    lineage = result_of(campaign, "map").begin(campaign.root)
    scene = settled_scene(campaign)
    images, places = [], [*stated_places(campaign)]
    notes: list[str] = []
    places += true_places(campaign, scene.grid.crs, notes)
    # The last image of a flight is the sum. It is listed first in the document, because the map shows the first image.
    names = [(flight, image) for flight, (*pairs, last) in campaign.images.items() for image in (last, *pairs)]
    for flight, image in names:
        report = read_report(campaign, flight, image)
        with undamaged(campaign.result(flight, image, "image.json"), expected="a report", remedy="Run export again."):
            layers = _layers(campaign, flight, image, report)
            tags = _tags_of(campaign.result(flight, image, layers[0].file))
            images.append(image_entry(flight, image, report, layers, tags))
            places += found_places(flight, image, report)
    images += [_interferogram_entry(campaign, name) for name in campaign.settings.interferometry.pairs]
    coverage = None
    if scene.grid.crs != LOCAL:
        coverage = read_manifest(campaign.root / campaign.manifest("coverage"))["files"].get(COVERAGE[1])
    document = map_document(
        campaign.settings.campaign,
        grid={"bounds_m": scene.grid.bounds_m, "spacing_m": scene.grid.spacing_m, "shape": scene.grid.shape},
        crs=crs_of(scene.grid),
        images=images,
        places=places,
        coverage_url=url_of(COVERAGE[1], coverage) if coverage else None,
        notes=notes,
    )
    path = campaign.result(MAP)
    write_json(path, document)
    record_files(campaign.root / lineage.result.manifest, [path], lineage)
    return [path]


def _layers(campaign: Campaign, flight: str, image: str, report: Mapping[str, Any]) -> list[Layer]:
    """Return the displayed layers of an image: real-valued rasters, in linear units only if there is no dB version."""
    of_pairs = [("export", "pair"), ("layers", "layers"), ("layers", "radiometry")]
    kinds = [("export", "fused")] if image == FUSED else of_pairs
    layers = [
        layer
        for result, kind in kinds
        for row in exports_in(kind)
        if row.file.endswith(".tif")
        and (kind != "radiometry" or row.source in campaign.coefficients)
        and (layer := _layer(campaign.root / campaign.manifest(result, flight, image), row, report)) is not None
    ]
    stack = campaign.settings.stack
    if stack and flight in stack.flights and image == stack.pair:
        manifest = campaign.root / campaign.manifest("change", STACK, flight)
        rows = [row for row in exports_in("change") if row.file.endswith(".tif")]
        changes = [layer for row in rows if (layer := _layer(manifest, row, report)) is not None]
        layers += [replace(layer, folder=f"{STACK}/{flight}") for layer in changes]
    return layers


def _interferogram_entry(campaign: Campaign, name: str) -> dict[str, Any]:
    """Return the entry of an interferogram, which is listed as an image of flight 'interferometry'."""
    path = campaign.result(INTERFEROMETRY, name, "interferogram.json")
    manifest = path.with_suffix(".manifest.json")
    report, rows = open_listed(path, manifest), exports_in("interferogram")
    with undamaged(path, expected="the report of an interferogram", remedy=remake_from(manifest)):
        layers = [_layer(manifest, row, report) for row in rows if row.file.endswith(".tif")]
        focus = {"verdict": "interferogram", "reason": report["says"]}
        quality = {"focus": focus, "numerical_error_db": 0.0, "flags": report["flags"]}
    tags = _tags_of(path.with_name("phase.tif"))
    entry = image_entry(INTERFEROMETRY, name, quality, [layer for layer in layers if layer is not None], tags)
    return {**entry, "error_db": None}


def _tags_of(path: Path) -> dict[str, str]:
    with opened_raster(path, expected="an image that the workflow wrote", remedy="Run export again.") as raster:
        return dict(raster.tags())


def _layer(manifest: Path, row: Export, report: Mapping[str, Any]) -> Layer | None:
    path, root = manifest.with_name(row.file), manifest.parents[3]

    def present(file: Path) -> str:
        return digest_of(root, file.relative_to(root).as_posix()) if file.is_file() else ""

    sha256 = check_listed(path, manifest, present=present)
    remedy = remake_from(manifest)
    with opened_raster(path, expected="a raster that the workflow wrote", remedy=remedy) as raster:
        title, unit = str(raster.descriptions[0] or row.file), str(raster.units[0] or "")
        if np.dtype(raster.dtypes[0]).kind == "c" or (unit == "1" and row.source in _SHOWN_IN_DB):
            return None
        if row.source in _LIMITS:
            kind, low, high = _LIMITS[row.source]
            return Layer(row.file, sha256, kind, title, unit, low, high)
        if row.source == "mask":
            return Layer(row.file, sha256, "classes", title, "", 0.0, 3.0)
        if unit == "dB" and row.source in _SHOWN_IN_DB:
            peak_db = 20 * math.log10(max(float(report["brightest"]["amplitude"]), 1e-30))
            low, high = peak_db + float(report["noise_floor_db"]), peak_db
            return Layer(row.file, sha256, "image", title, unit, round(low, 2) + 0.0, round(high, 2) + 0.0)
        factor = max(1.0, max(raster.shape) / _RANGE_SAMPLES)
        values = raster.read(1, out_shape=tuple(max(1, round(size / factor)) for size in raster.shape), masked=True)
    valid = np.ma.masked_invalid(values).compressed()
    low, high = (float(valid.min()), float(valid.max())) if valid.size else (0.0, 1.0)
    return Layer(row.file, sha256, "measure", title, unit, _rounded(low), _rounded(high))


_SHOWN_IN_DB = frozenset({"image", "coherent", "noncoherent", "magnitude"})
"""Sources of products whose power is also exported in dB."""


_LIMITS = {"phase": ("phase", -math.pi, math.pi), "coherence": ("measure", 0.0, 1.0)}
"""Source of a product with a fixed colour scale → style and ends of the scale."""


def _rounded(value: float) -> float:
    return float(f"{value:.4g}") + 0.0  # the sum avoids -0


def crs_of(grid: SceneGrid) -> dict[str, Any]:
    """Return the CRS of a grid for the page, with control points for checking the page's projection."""
    from pyproj import CRS

    crs = CRS.from_user_input(grid.crs_wkt)
    if grid.crs == LOCAL:
        return {"name": crs.name, "code": None, "local": True, "proj4": None, "control": []}
    west, south, east, north = grid.bounds_m
    x, y = np.array([(x, y) for x in (west, (west + east) / 2, east) for y in (south, (south + north) / 2, north)]).T
    latitude, longitude, _ = geodetic_from_ecef(frame_from_map(grid.crs, x, y, np.zeros(len(x)))).T
    control = np.stack([x, y, longitude, latitude], axis=-1).round(10).tolist()
    return {"name": crs.name, "code": grid.crs, "local": False, "proj4": _proj4(crs), "control": control}


def _proj4(crs: Any) -> str | None:
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # control points detect information missing in the PROJ.4 string
        return str(crs.to_proj4()) or None


def stated_places(campaign: Campaign) -> list[Place]:
    """Return the reference points and the calibration reflector given in the config."""
    scene, calibration = campaign.settings.scene, campaign.settings.calibration
    points = [(point.name, point.position_m) for point in scene.reference_points]
    points += [("reflector", calibration.reflector_m)] if calibration is not None else []
    return [Place(name, "stated", float(x), float(y)) for name, (x, y, _) in points]


def true_places(campaign: Campaign, crs: str, notes: list[str]) -> list[Place]:
    """Return the targets of a simulation, numbered as in `apertura score`; add a note if truth.json is unreadable."""
    path = campaign.root.named("truth.json", where=campaign.root)
    if not path.is_file():
        return []
    try:
        document = read_json(path, expected="the true targets of a simulation", remedy="Delete the file.")
        with undamaged(path, expected="the true targets of a simulation", remedy="Delete the file."):
            targets = [(float(target["x"]), float(target["y"])) for target in document["targets"]]
            if document.get("crs", crs) != crs:
                raise ValueError("targets and images are in different CRSs")
    except CampaignError as error:
        notes.append(f"No simulated targets are listed: {error}".replace(f"{campaign.root}/", ""))
        return []
    if len(targets) > _MOST_TARGETS:
        notes.append(f"Only the first {_MOST_TARGETS} of {len(targets)} targets are listed.")
    return [Place(f"target {number}", "truth", x, y) for number, (x, y) in enumerate(targets[:_MOST_TARGETS])]
