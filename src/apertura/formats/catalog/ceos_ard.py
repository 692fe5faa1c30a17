"""CEOS-ARD sheet of an image: requirements of the SAR product family specifications, assessed on its files.

The specifications are those of CEOS for satellites: Normalised Radar Backscatter (NRB) and Geocoded Single-Look Complex
(GSLC). A requirement is met only if its item is present in the folder of the image. The sheet is a self-assessment, not
an endorsement by CEOS.
"""

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

from apertura.common.raster import opened_raster
from apertura.formats.catalog import DOCUMENTS
from apertura.formats.export import EXPORTS

_, SHEET, PAGE = DOCUMENTS
"""Names of the sheet and of its page, in the folder of an image."""

_SOURCE = "https://github.com/ceos-org/ceos-ard/blob/2902a63b6aea8802f926f183bd220ff36fe53b13/pfs"
SPECIFICATIONS: Mapping[str, Mapping[str, str]] = {
    "NRB": {"title": "Normalised Radar Backscatter", "version": "5.6.0", "url": f"{_SOURCE}/NRB/document.yaml"},
    "GSLC": {"title": "Geocoded Single-Look Complex", "version": "2.0.0", "url": f"{_SOURCE}/GSLC/document.yaml"},
}
"""Product type → product family specification."""

_NOTE = (
    "Self-assessment against specifications for satellites; not an endorsement by CEOS. A requirement is met only if "
    "its item is present in the files of this image."
)


# ---- Files of an image ----------------------------------------------------------------------------------------------


class _Raster(NamedTuple):
    """Tags, data type and georeference of a GeoTIFF."""

    tags: Mapping[str, str]
    dtype: str
    is_georeferenced: bool
    transform: tuple[float, ...]


@dataclass(frozen=True)
class ImageFiles:
    """Files of an image: the folder, and the content of its image.json.

    Attributes
    ----------
    folder
        Folder of a pair or of the sums of a flight.
    report
        Content of image.json.
    """

    folder: Path
    report: Mapping[str, Any]

    @cached_property
    def rasters(self) -> Mapping[str, _Raster]:
        """File name → facts, of every GeoTIFF of the folder."""
        facts = {}
        for name in dict.fromkeys(row.file for row in EXPORTS if row.file.endswith(".tif")):
            if self.has(name):
                expected, remedy = "a raster of the workflow", "Run the workflow again."
                with opened_raster(self.folder / name, expected=expected, remedy=remedy) as raster:
                    is_georeferenced = bool(raster.crs and (raster.crs.is_projected or raster.crs.is_geographic))
                    transform = tuple(raster.transform)[:6]
                    facts[name] = _Raster(raster.tags(), raster.dtypes[0], is_georeferenced, transform)
        return facts

    @cached_property
    def main(self) -> _Raster:
        """Facts of the raster in decibels of a pair, or of the coherent sum."""
        return self.rasters["db.tif" if "db.tif" in self.rasters else "coherent_db.tif"]

    @property
    def has_dem(self) -> bool:
        """True if the heights of the pixels are those of a DEM."""
        return bool((self.report.get("terrain") or {}).get("dem"))

    def has(self, name: str) -> bool:
        """Return True if the folder contains a file or folder of that name."""
        return (self.folder / name).exists()


# ---- Assessment of a requirement ------------------------------------------------------------------------------------

Status = Literal["met", "not met", "not applicable"]
_STATUSES: tuple[Status, ...] = ("met", "not met", "not applicable")


class Finding(NamedTuple):
    """Result of an assessment: status, and where the item is found, or the reason."""

    status: Status
    evidence: str


Assessment = Callable[[ImageFiles], Finding]

_CONFIGURED_BY = {
    "APERTURA_POLARISATION": "nodes.<name>.antennas.radar_tx_polarisation and radar_rx_polarisation",
    "APERTURA_PLATFORM": "metadata.platform",
    "APERTURA_INSTRUMENT": "metadata.instrument",
    "APERTURA_INSTITUTION": "metadata.institution",
    "APERTURA_DOI": "metadata.doi",
    "APERTURA_ACQUISITION_START": "a recording with the time of day",
    "APERTURA_FREQUENCY_BAND": "a carrier between 0.25 and 40 GHz, for which a band letter is defined",
    "APERTURA_OUTLINE_WGS84": "scene.crs with a geodetic position",
    "APERTURA_LOOK_VECTOR_ECEF": "a single pair in a georeferenced frame",
}
"""Tag → config key or property of the recording that provides the tag."""


def _tags(*names: str) -> Assessment:
    """Met if the rasters of the image have all these tags."""

    def assess(files: ImageFiles) -> Finding:
        missing = [name for name in names if name not in files.main.tags]
        if missing:
            return Finding("not met", f"requires {'; '.join(_CONFIGURED_BY.get(name, name) for name in missing)}")
        return Finding("met", f"tags {', '.join(names)}")

    return assess


def _when(condition: Callable[[ImageFiles], bool], evidence: str, otherwise: str) -> Assessment:
    """Met under a condition; `otherwise` is the reason if the condition is not fulfilled."""
    return lambda files: Finding("met", evidence) if condition(files) else Finding("not met", otherwise)


def _never(reason: str) -> Assessment:
    return lambda _: Finding("not met", reason)


def _inapplicable(reason: str) -> Assessment:
    return lambda _: Finding("not applicable", reason)


_GAMMA0 = "requires a calibrated pair and gamma0 in processing.radiometry"
_NO_DEM = "flat terrain is configured (scene.height_m): requires scene.dem"


def _with_dem(name: str, content: str, missing: str = "") -> Assessment:
    """Met if a raster exists that is computed from a DEM; `missing`: what the raster requires besides the DEM."""
    condition, otherwise = lambda files: name in files.rasters and files.has_dem, f"{missing}{_NO_DEM}"
    return _when(condition, f"{name}: {content}", otherwise)


def _brightest(key: str, content: str) -> Assessment:
    """Met if a property of the brightest point was measured."""
    met = f"image.json, brightest: {content}"
    return _when(lambda files: (files.report.get("brightest") or {}).get(key) is not None, met, "no isolated point")


def _gamma0(name: str) -> Assessment:
    """Met if a file with terrain-flattened γ⁰ and known polarisation exists."""

    def assess(files: ImageFiles) -> Finding:
        missing = [] if name in files.rasters else [_GAMMA0]
        missing += [] if files.has_dem else [_NO_DEM]
        missing += [] if "APERTURA_POLARISATION" in files.main.tags else [_CONFIGURED_BY["APERTURA_POLARISATION"]]
        if missing:
            return Finding("not met", "; ".join(missing))
        return Finding("met", f"{name}: γ⁰ of the area of each facet of the DEM (docs/theory/radiometry.md, eq. 6a)")

    return assess


def _backscatter_gslc(files: ImageFiles) -> Finding:
    """Assess the complex backscattering coefficient, whose phase is that of the terrain."""
    if "gamma0_slc.tif" in files.rasters and "APERTURA_POLARISATION" in files.main.tags:
        return Finding("met", "gamma0_slc.tif: complex amplitude of γ⁰; the phase of the path to each pixel is removed")
    found = "slc.tif is echo amplitude, without a coefficient: " if "slc.tif" in files.rasters else ""
    return Finding("not met", f"{found}{_GAMMA0}, and {_CONFIGURED_BY['APERTURA_POLARISATION']}")


def _product_access(files: ImageFiles) -> Finding:
    lacking = ["processing date (files contain none, so that identical inputs give identical files)"]
    lacking += [key for tag, key in _CONFIGURED_BY.items() if tag in _ACCESS and tag not in files.main.tags]
    return Finding("not met", f"requires {'; '.join(lacking)}; the software version is tag TIFFTAG_SOFTWARE")


_ACCESS = frozenset({"APERTURA_INSTITUTION", "APERTURA_DOI"})


def _geolocation(files: ImageFiles) -> Finding:
    """Assess the geolocation accuracy, which is predicted by the error budget and not measured."""
    tags = files.main.tags
    if "APERTURA_GEOLOCATION_UNCERTAINTY_M" not in tags:
        return Finding("not met", "no geolocation accuracy is stated")
    value, method = tags["APERTURA_GEOLOCATION_UNCERTAINTY_M"], tags.get("APERTURA_GEOLOCATION_METHOD", "")
    return Finding("not met", f"{value} m is {method}; bias and standard deviation measured at reflectors are required")


def _is_snapped(files: ImageFiles) -> bool:
    spacing_m, _, west_m, _, _, north_m = files.main.transform
    return all(abs(edge / spacing_m - round(edge / spacing_m)) < 1e-3 for edge in (west_m, north_m))


def _atmosphere(files: ImageFiles) -> Finding:
    source = (files.report.get("atmosphere") or {}).get("source")
    if source is None:
        return Finding("not applicable", "no atmospheric correction is applied (scene.atmosphere: vacuum)")
    return Finding("met", f"image.json, atmosphere: refractivity along the path, {source} (docs/theory/atmosphere.md)")


def _refined(files: ImageFiles) -> Finding:
    autofocus = files.report.get("autofocus") or {}
    if autofocus.get("accepted"):
        return Finding("met", f"image.json, autofocus: {autofocus.get('method')}, correction of the tracks")
    return Finding("not met", "no refinement of the tracks was applied (image.json, autofocus)")


def _looks(files: ImageFiles) -> Finding:
    averaged = next((name for name in files.rasters if name.startswith("multilook") and "noise" not in name), None)
    if averaged is None:
        return Finding("not met", "single-look image: requires processing.multilook")
    return Finding("met", f"{averaged}: tag APERTURA_RADIOMETRY, equivalent_looks")


# ---- Table of requirements ------------------------------------------------------------------------------------------


class Requirement(NamedTuple):
    """Requirement: identifier and title of the specification, assessments of threshold and goal, product types."""

    id: str
    title: str
    threshold: Assessment | None
    goal: Assessment | None
    types: tuple[str, ...] = ("NRB", "GSLC")
    category: str = ""


def _section(category: str, *rows: Requirement) -> tuple[Requirement, ...]:
    return tuple(row._replace(category=category) for row in rows)


_R = Requirement
_NRB, _GSLC = ("NRB",), ("GSLC",)
_TIME = _tags("APERTURA_ACQUISITION_START", "APERTURA_ACQUISITION_END", "APERTURA_FLIGHTS")
_OF_RADAR = "FREQUENCY_BAND", "CENTRE_FREQUENCY_HZ", "MODE", "POLARISATION", "LOOK_SIDE"
_RADAR = _tags(*(f"APERTURA_{name}" for name in _OF_RADAR))
_THIS_SHEET = _when(lambda _: True, "this sheet: specifications", "")
_READABLE = _when(lambda files: bool(files.rasters), "GeoTIFF tags, image.json, this sheet", "no GeoTIFF")
_STANDARD = _never("GeoTIFF tags follow no standard; the STAC item and the cube (CF, ACDD) of the campaign repeat them")
_NOT_RETRIEVABLE = _never("no location from which a program can retrieve the files is stated")
_NO_SOURCE_PRODUCT = _inapplicable("the sources are recordings, not processed products; APERTURA_INPUTS: their hashes")
_NO_SLANT_RANGE = _inapplicable("the image is formed on the map grid; no image in slant range exists")
_UNDER_IONOSPHERE = _inapplicable("the paths lie below the ionosphere")
_NO_REFERENCE_ORBIT = _inapplicable("a UAV has no orbit, and no reference orbit is used")
_CENTRE_ONLY = _never("stated at the scene centre only")
_NO_DEM_RESOLUTION = _never("the resolution of the DEM is not compared with that of the image")
_HEADING = _when(
    lambda files: "APERTURA_HEADING_DEG" in files.main.tags and "positions" in files.report,
    "tag APERTURA_HEADING_DEG in place of the pass direction; image.json, positions: source of the track",
    "no heading or no source of the track is stated for this image",
)
_TRACK = _when(
    lambda files: files.has("echo.zarr") and "APERTURA_HEADING_DEG" in files.main.tags,
    "echo.zarr: phase centres of every pulse; tags APERTURA_HEADING_DEG and APERTURA_HEIGHT_ABOVE_TERRAIN_M",
    "the phase centres of the pulses are not in the folder of this image",
)
_CALIBRATED = _when(
    lambda files: (files.report.get("cross_sections") or {}).get("constant_db") is not None,
    "radiometry.json: calibration constant and link budget",
    "the pair is not calibrated",
)
_NOISE = _when(
    lambda files: "APERTURA_REFERENCE" in files.rasters["nesz.tif"].tags if "nesz.tif" in files.rasters else False,
    "nesz.tif: noise-equivalent σ⁰",
    "nesz.tif is relative, or missing: the pair is not calibrated",
)
_SIDELOBES = _brightest("cross_range_pslr_db", "PSLR and ISLR")
_WIDTHS = _brightest("ground_range_width_m", "−3 dB widths")
_DEM = _when(lambda files: files.has_dem, "image.json, terrain: DEM, geoid and datum; one DEM for all steps", _NO_DEM)
_CRS = _when(lambda files: files.main.is_georeferenced, "GeoTIFF: CRS", "local frame (scene.crs: local)")
_MASK = _when(lambda files: "mask.tif" in files.rasters, "mask.tif: 0 valid, 255 no data", "no mask.tif in this folder")
_SHADOW = _with_dem("mask.tif", "bit 1 shadow, bit 2 layover")
_LOCAL_ANGLE = _with_dem("incidence.tif", "from the normal of each facet")
_LEVEL_ANGLE = _when(
    lambda files: (
        "ellipsoidal_incidence.tif" in files.rasters or ("incidence.tif" in files.rasters and not files.has_dem)
    ),
    "ellipsoidal_incidence.tif; without a DEM, incidence.tif: angle from the vertical (WGS 84)",
    f"with a DEM, incidence.tif contains the local angle only: {_GAMMA0}",
)
_HEIGHTS = _when(
    lambda files: files.has_dem and (files.folder.parent.parent / "terrain.zarr").exists(),
    "results/terrain.zarr: height of every pixel, on the same grid",
    _NO_DEM,
)
_GRID = _when(
    lambda files: files.main.is_georeferenced and _is_snapped(files),
    "GeoTIFF: the corner is a multiple of the pixel size, the same for all images of the campaign",
    "the corner is not a multiple of the pixel size, or the frame is local: see scene.bounds_m",
)

REQUIREMENTS: Sequence[Requirement] = (
    *_section(
        "general metadata",
        _R("trace-sar", "Traceability", None, _never("no document with a DOI relates the values to SI standards")),
        _R("memare-sar", "Metadata machine readability", _READABLE, _STANDARD),
        _R("protype", "Product type", _THIS_SHEET, None),
        _R("pfsurl", "Document identifier", _THIS_SHEET, None),
        _R("time-sar", "Data collection time", _TIME, _TIME),
    ),
    *_section(
        "source metadata",
        _R("macqid", "Acquisition ID", _tags("APERTURA_FLIGHTS", "APERTURA_PAIRS"), None),
        _R("daccess-src", "Source data access", _tags("APERTURA_DOI", "APERTURA_INPUTS"), _NOT_RETRIEVABLE),
        _R(
            "instru-sar",
            "Instrument",
            _tags("APERTURA_PLATFORM", "APERTURA_INSTRUMENT"),
            _inapplicable("the CEOS database lists instruments of satellites"),
        ),
        _R("time-src", "Source data acquisition time", _tags("APERTURA_ACQUISITION_START"), None),
        _R("acqpar", "Source data acquisition parameters", _RADAR, None),
        _R("orbit", "Source data orbit information", _HEADING, _TRACK, _NRB),
        _R("orbit-gslc", "Source data orbit information", _HEADING, _TRACK, _GSLC),
        _R("propar", "Source data processing parameters", _NO_SOURCE_PRODUCT, _NO_SOURCE_PRODUCT),
        _R("imgatt-sar", "Source data image attributes", _NO_SLANT_RANGE, _tags("APERTURA_OUTLINE_WGS84")),
        _R("sencal-sar", "Sensor calibration", None, _CALIBRATED),
        _R("perfind", "Performance indicators", _NOISE, _SIDELOBES),
        _R("polcalm", "Polarimetric calibration matrices", None, _inapplicable("a pair has a single polarisation")),
        _R("farotan", "Mean Faraday rotation angle", None, _UNDER_IONOSPHERE),
        _R("ionind", "Ionosphere indicator", None, _UNDER_IONOSPHERE),
    ),
    *_section(
        "product metadata",
        _R("daccess-prod", "Product data access", _product_access, _NOT_RETRIEVABLE),
        _R("auxdat-sar", "Auxiliary data", None, _DEM),
        _R("samspa", "Product sample spacing", _when(lambda _: True, "GeoTIFF: pixel size", ""), None),
        _R("enl", "Product equivalent number of looks", None, _looks, _NRB),
        _R("resol", "Product resolution", None, _WIDTHS),
        _R("spekfil", "Product filtering", _tags("APERTURA_SPECKLE_FILTER"), None, _NRB),
        _R("geobbox", "Product bounding box", _when(lambda _: True, "GeoTIFF: bounds", ""), None),
        _R("geoarea-sar", "Product geographical extent", _tags("APERTURA_OUTLINE_WGS84"), None),
        _R("imgsize", "Product image size", _when(lambda _: True, "GeoTIFF: width and height", ""), None),
        _R("pixcoco", "Product pixel coordinate convention", _tags("AREA_OR_POINT"), None),
        _R("crs-sar", "Product coordinate reference system", _CRS, None),
        _R("reorbit-nrb-pol", "Reference orbit", None, _NO_REFERENCE_ORBIT, _NRB),
        _R("rulvec", "Radar unit look vector", _tags("APERTURA_LOOK_VECTOR_ECEF"), None, _GSLC),
        _R("slarass", "Slant range sensor to surface", _tags("APERTURA_RANGE_M"), None, _GSLC),
        _R("reorbit-gslc", "Reference orbit", None, _NO_REFERENCE_ORBIT, _GSLC),
        _R("catpha", "Atmospheric phase correction", _atmosphere, None, _GSLC),
        _R("ionpha", "Ionospheric phase correction", _UNDER_IONOSPHERE, None, _GSLC),
    ),
    *_section(
        "per-pixel metadata",
        _R("memare-sar", "Metadata machine readability", _READABLE, _STANDARD),
        _R("damaski", "Data mask image", _MASK, _SHADOW),
        _R("piscata", "Scattering area image", None, _with_dem("scattering_area.tif", "β⁰/γ⁰", f"{_GAMMA0}; ")),
        _R("ploinca", "Local incident angle image", _LOCAL_ANGLE, None, _NRB),
        _R("ploinca", "Local incident angle image", None, _LOCAL_ANGLE, _GSLC),
        _R("pelinca", "Ellipsoidal incident angle image", None, _LEVEL_ANGLE, _NRB),
        _R("pelinca", "Ellipsoidal incident angle image", _LEVEL_ANGLE, None, _GSLC),
        _R("pinopow", "Noise power image", None, _NOISE),
        _R("gasiri", "Gamma-to-sigma ratio image", None, _with_dem("gamma_sigma_ratio.tif", "σ⁰/γ⁰", f"{_GAMMA0}; ")),
        _R("pacqidm", "Acquisition ID image", _inapplicable("the image is not a mosaic of flights"), None),
        _R("pidem", "Per-pixel DEM", None, _HEIGHTS),
        _R("radulov-gslc", "Radar unit look vector grid image", None, _CENTRE_ONLY, _GSLC),
        _R("slarassi-gslc", "Slant range sensor to surface image", None, _CENTRE_ONLY, _GSLC),
        _R("pinphun", "InSAR phase uncertainty image", None, _never("interferograms have height_std.tif"), _GSLC),
        _R("atphaci", "Atmospheric phase correction image", None, _never("applied to each path, not written"), _GSLC),
        _R("piopha", "Ionospheric phase correction image", None, _UNDER_IONOSPHERE, _GSLC),
    ),
    *_section(
        "radiometrically corrected measurements",
        _R("backsca-nrb", "Backscatter measurements", _gamma0("gamma0_power.tif"), None, _NRB),
        _R("backsca-gslc", "Backscatter measurements", _backscatter_gslc, _gamma0("gamma0_slc.tif"), _GSLC),
        _R(
            "scaconv",
            "Scaling conversion",
            _tags("APERTURA_QUANTITY", "APERTURA_UNIT", "APERTURA_REFERENCE"),
            _when(lambda files: files.main.dtype == "float32", "GeoTIFF: float32", "the raster is not float32"),
        ),
        _R("noiser", "Noise removal", _tags("APERTURA_NOISE_REMOVAL"), None),
        _R("radtalg-appl", "Radiometric terrain correction algorithm", _gamma0("gamma0_power.tif"), None, _NRB),
        _R("radtalg-min", "Radiometric terrain correction algorithm", None, _NO_DEM_RESOLUTION, _GSLC),
        _R("radacc-sar", "Radiometric accuracy", None, _never("no document with a DOI; see radiometry.json, std_db")),
        _R(
            "flapha",
            "Flattened phase",
            None,
            _inapplicable("the phase of slc.tif is flattened: tag APERTURA_PHASE"),
            _NRB,
        ),
    ),
    *_section(
        "geometric corrections",
        _R("geocalg", "Geometric correction algorithm", None, _never("no citable document is stated")),
        _R("cdem", "Digital elevation model", _DEM, _NO_DEM_RESOLUTION),
        _R("geomacc-sar", "Geometric accuracy", _geolocation, _never("no error measured at reflectors is stated")),
        _R("georacc", "Geometric refined accuracy", None, _refined),
        _R("gridconv", "Gridding convention", _GRID, _never("no document of the gridding convention is stated")),
    ),
)
"""Requirements of both specifications, in their order."""

_LEVELS = ("threshold", "goal")


# ---- Sheet ----------------------------------------------------------------------------------------------------------


def ceos_ard_sheet(files: ImageFiles, title: str) -> dict[str, Any]:
    """Assess all requirements on the files of an image; return the content of ceos_ard.json.

    Parameters
    ----------
    files
        Files of the image.
    title
        Name of the image.

    Returns
    -------
    dict
        `title`, `note`, `specifications`; `summary`: product type → 'threshold' or 'goal' → status → number;
        `requirements`: list of id, title, category, types, and for threshold and goal the status and the evidence.
    """
    rows: list[dict[str, Any]] = []
    for requirement in REQUIREMENTS:
        levels = {"threshold": requirement.threshold, "goal": requirement.goal}
        found = {level: assess(files)._asdict() for level, assess in levels.items() if assess is not None}
        heading = {"id": requirement.id, "title": requirement.title, "category": requirement.category}
        rows.append({**heading, "types": list(requirement.types), **found})

    def count(kind: str, level: str, status: Status) -> int:
        return sum(row[level]["status"] == status for row in rows if level in row and kind in row["types"])

    summary = {
        kind: {level: {status: count(kind, level, status) for status in _STATUSES} for level in _LEVELS}
        for kind in SPECIFICATIONS
    }
    specifications = {kind: dict(fields) for kind, fields in SPECIFICATIONS.items()}
    return {
        "title": title,
        "note": _NOTE,
        "specifications": specifications,
        "summary": summary,
        "requirements": rows,
    }


_STYLE = (
    "body{font:14px sans-serif;margin:2em;max-width:70em}table{border-collapse:collapse}"
    "td,th{border:1px solid #bbb;padding:.3em .5em;text-align:left;vertical-align:top}"
    ".met{background:#dff0d8}.not-met{background:#f7d9d5}.not-applicable{background:#eee}"
)


def ceos_ard_page(sheet: Mapping[str, Any]) -> str:
    """Return a sheet as an HTML page without external resources."""
    text = html.escape
    heads = ("product type", "level", *_STATUSES)
    lines = [
        "<!doctype html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>CEOS-ARD sheet: {text(sheet["title"])}</title>',
        f"<style>{_STYLE}</style></head><body>",
        f"<h1>CEOS-ARD sheet</h1><p>{text(sheet['title'])}</p><p>{text(sheet['note'])}</p><ul>",
    ]
    for kind in SPECIFICATIONS:
        fields = sheet["specifications"][kind]
        name = f"{fields['title']} ({kind}) {fields['version']}"
        lines.append(f'<li><a href="{text(fields["url"])}">{text(name)}</a></li>')
    lines.append("</ul><h2>Summary</h2><table><tr>" + "".join(f"<th>{head}</th>" for head in heads) + "</tr>")
    for kind, level in product(SPECIFICATIONS, _LEVELS):
        counts = sheet["summary"][kind][level]
        cells = "".join(f"<td>{value}</td>" for value in (kind, level, *map(counts.get, _STATUSES)))
        lines.append(f"<tr>{cells}</tr>")
    lines.append("</table><h2>Requirements</h2><table><tr><th>requirement</th><th>product types</th>")
    lines.append("<th>threshold</th><th>goal</th></tr>")
    category = None
    for row in sheet["requirements"]:
        if row["category"] != category:
            category = row["category"]
            lines.append(f'<tr><th colspan="4">{text(category)}</th></tr>')
        cells = f"<td>{text(row['title'])} ({row['id']})</td><td>{', '.join(row['types'])}</td>"
        for level in _LEVELS:
            if found := row.get(level):
                shade = found["status"].replace(" ", "-")
                cells += f'<td class="{shade}"><b>{found["status"]}</b>: {text(found["evidence"])}</td>'
            else:
                cells += "<td></td>"
        lines.append(f"<tr>{cells}</tr>")
    return "\n".join([*lines, "</table></body></html>", ""])
