"""CEOS-ARD sheet: the rows are those of the specifications, and a requirement is met only if its item is present."""

import json
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from rasterio import Affine

from apertura.common.confined import ConfinedPath
from apertura.formats.catalog.ceos_ard import (
    PAGE,
    REQUIREMENTS,
    SHEET,
    SPECIFICATIONS,
    ImageFiles,
    ceos_ard_page,
    ceos_ard_sheet,
)
from apertura.formats.export.cog import write_power, write_slc
from apertura.formats.export.db import write_db
from apertura.formats.export.layers import write_incidence, write_mask, write_nesz
from apertura.formats.export.radiometry import TAG, of_coefficient

PUBLISHED = json.loads((Path(__file__).parent / "ceos_ard.json").read_text())
"""Identifiers and levels of the requirements, from github.com/ceos-org/ceos-ard (the specifications' own order)."""

TAGS = {
    "APERTURA_ACQUISITION_START": "2025-05-14T09:30:00Z",
    "APERTURA_ACQUISITION_END": "2025-05-14T09:30:20Z",
    "APERTURA_FLIGHTS": "f01",
    "APERTURA_PAIRS": "a-a",
    "APERTURA_MODE": "monostatic",
    "APERTURA_FREQUENCY_BAND": "X",
    "APERTURA_CENTRE_FREQUENCY_HZ": "9.6e9",
    "APERTURA_POLARISATION": "VV",
    "APERTURA_LOOK_SIDE": "right",
    "APERTURA_LOOK_VECTOR_ECEF": "0 0 -1",
    "APERTURA_HEADING_DEG": "40.0",
    "APERTURA_RANGE_M": "50.0",
    "APERTURA_INPUTS": "{}",
    "APERTURA_PLATFORM": "hexacopter",
    "APERTURA_INSTRUMENT": "X-band radar",
    "APERTURA_INSTITUTION": "An Institute",
    "APERTURA_DOI": "10.5281/zenodo.1",
    "APERTURA_GEOLOCATION_UNCERTAINTY_M": "0.5",
    "APERTURA_GEOLOCATION_METHOD": "predicted by the error budget",
}
REPORT = {
    "positions": {"tx": {"stated_by": "log"}},
    "terrain": {"dem": "dem.tif", "geoid": None, "datum": "ellipsoid"},
    "brightest": {"cross_range_pslr_db": -13.3, "ground_range_width_m": 0.4},
    "atmosphere": {"source": "standard atmosphere"},
    "autofocus": {"accepted": True, "method": "tracks"},
    "cross_sections": {"constant_db": -30.0},
}


GRID = {"transform": Affine(0.5, 0, 500000.0, 0, -0.5, 100), "crs": "EPSG:32632"}
IMAGE, REAL = np.ones((4, 6), np.complex64), np.ones((4, 6), np.float32)


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    """Write the files of a calibrated image with a DEM."""
    folder = tmp_path_factory.mktemp("complete")
    gamma0 = {TAG: json.dumps(of_coefficient("gamma0", std_db=0.5, polarisation="VV"))}
    noise = {TAG: json.dumps(of_coefficient("sigma0", std_db=0.5, noise="alone"))}
    for name, write, pixels, radiometry in (
        ("slc.tif", write_slc, IMAGE, {}),
        ("mask.tif", write_mask, REAL.astype(np.uint8), {}),
        ("incidence.tif", write_incidence, REAL, {}),
        ("nesz.tif", write_nesz, REAL, noise),
        ("gamma0_power.tif", write_power, IMAGE, gamma0),
        ("gamma0_slc.tif", write_slc, IMAGE, gamma0),
        ("scattering_area.tif", write_incidence, REAL, {}),
        ("ellipsoidal_incidence.tif", write_incidence, REAL, {}),
        ("gamma_sigma_ratio.tif", write_incidence, REAL, {}),
        ("multilook_gamma0_power.tif", write_incidence, REAL, {}),
    ):
        write(folder / name, pixels, tags=radiometry, **GRID)
    (folder / "echo.zarr").mkdir()
    return folder


@pytest.fixture
def folder_of(complete, tmp_path):
    """Return a function that copies the files, except the files and tags in `without`, with another georeference."""

    def copied(*without, **georeference):
        (tmp_path / "results/terrain.zarr").mkdir(parents=True, exist_ok=True)
        folder = ConfinedPath.at(tmp_path).named(f"results/f01/{len([*tmp_path.glob('results/*/*')])}", where=tmp_path)
        shutil.copytree(complete, str(folder), ignore=shutil.ignore_patterns(*without))
        tags = {name: value for name, value in TAGS.items() if name not in without}
        tags |= {TAG: json.dumps({"one_is": "an echo"})}
        write_db(folder / "db.tif", IMAGE, tags=tags, **(GRID | georeference))
        return folder

    return copied


def statuses(folder, report=REPORT):
    """Return (id, product type, level) → status."""
    sheet = ceos_ard_sheet(ImageFiles(folder, report), "an image")
    return {
        (row["id"], kind, level): row[level]["status"]
        for row in sheet["requirements"]
        for kind in row["types"]
        for level in ("threshold", "goal")
        if level in row
    }


@pytest.mark.parametrize("kind", SPECIFICATIONS)
def test_rows_are_those_of_the_specification_in_its_order(kind):
    published = PUBLISHED[kind]
    assert SPECIFICATIONS[kind]["version"] == published["version"]
    rows = [row for row in REQUIREMENTS if kind in row.types]
    assert [row.id for row in rows] == [name for name, _ in published["requirements"]]
    for row, (name, levels) in zip(rows, published["requirements"], strict=True):
        if levels != ["image"]:  # the specifications state for each type whether these images are required
            assessed = [level for level in ("goal", "threshold") if getattr(row, level) is not None]
            assert assessed == levels, name


MISSING = {
    "mask.tif": {("damaski", "threshold"), ("damaski", "goal")},
    "incidence.tif": {("ploinca", "threshold"), ("ploinca", "goal")},
    "nesz.tif": {("perfind", "threshold"), ("pinopow", "goal")},
    "gamma0_power.tif": {("backsca-nrb", "threshold"), ("radtalg-appl", "threshold")},
    "gamma0_slc.tif": {("backsca-gslc", "threshold"), ("backsca-gslc", "goal")},
    "scattering_area.tif": {("piscata", "goal")},
    "ellipsoidal_incidence.tif": {("pelinca", "goal"), ("pelinca", "threshold")},
    "gamma_sigma_ratio.tif": {("gasiri", "goal")},
    "multilook_gamma0_power.tif": {("enl", "goal")},
    "APERTURA_POLARISATION": {
        ("acqpar", "threshold"),
        ("backsca-nrb", "threshold"),
        ("radtalg-appl", "threshold"),
        ("backsca-gslc", "threshold"),
        ("backsca-gslc", "goal"),
    },
    "APERTURA_PLATFORM": {("instru-sar", "threshold")},
    "APERTURA_DOI": {("daccess-src", "threshold")},
    "APERTURA_ACQUISITION_START": {("time-sar", "threshold"), ("time-sar", "goal"), ("time-src", "threshold")},
    "APERTURA_LOOK_VECTOR_ECEF": {("rulvec", "threshold")},
    "APERTURA_RANGE_M": {("slarass", "threshold")},
}


@pytest.mark.parametrize("item", MISSING)
def test_requirement_is_met_only_with_its_item(folder_of, item):
    """Removing one file or tag changes exactly its requirements from met to not met."""
    complete, incomplete = statuses(folder_of()), statuses(folder_of(item))
    changed = {key for key, status in incomplete.items() if status != complete[key]}
    assert {(name, level) for name, _, level in changed} == MISSING[item]
    assert {complete[key] for key in changed} == {"met"}
    assert {incomplete[key] for key in changed} == {"not met"}


def test_flat_terrain_is_not_terrain_flattened(folder_of):
    flat = statuses(folder_of(), REPORT | {"terrain": None})
    for name in ("backsca-nrb", "radtalg-appl", "cdem"):
        assert flat[name, "NRB", "threshold"] == "not met"
    assert flat["ploinca", "NRB", "threshold"] == "not met"  # the specification requires a DEM-based angle
    assert flat["pelinca", "GSLC", "threshold"] == "met"  # over level terrain, the same raster is the other angle


def test_local_frame_has_no_crs_and_no_extent(folder_of):
    local = statuses(folder_of(crs='LOCAL_CS["yard",UNIT["metre",1]]'))
    for name in ("crs-sar", "geoarea-sar", "gridconv"):
        assert local[name, "NRB", "threshold"] == "not met"


def test_grid_off_the_pixel_size_is_reported(folder_of):
    assert statuses(folder_of())["gridconv", "NRB", "threshold"] == "met"
    shifted = folder_of(transform=Affine(0.5, 0, 500000.2, 0, -0.5, 100))
    assert statuses(shifted)["gridconv", "NRB", "threshold"] == "not met"


def test_predicted_accuracy_is_not_counted_as_measured(folder_of):
    sheet = ceos_ard_sheet(ImageFiles(folder_of(), REPORT), "an image")
    (row,) = (row for row in sheet["requirements"] if row["id"] == "geomacc-sar")
    assert row["threshold"]["status"] == "not met"
    assert row["threshold"]["evidence"].startswith("0.5 m is predicted by the error budget")


class _Cells(HTMLParser):
    """Text of the table cells of a page, and addresses of loaded resources."""

    def __init__(self):
        super().__init__()
        self.cells, self.loaded = [], []

    def handle_starttag(self, tag, attributes):
        self.loaded += [value for name, value in attributes if name == "src" or tag in {"link", "script"}]
        self.cells += [""] if tag in {"td", "th"} else []

    def handle_data(self, data):
        if self.cells:
            self.cells[-1] += data


def test_page_shows_every_finding_and_escapes_names(folder_of):
    sheet = ceos_ard_sheet(ImageFiles(folder_of(), REPORT), "<script>a</script>")
    page = ceos_ard_page(sheet)
    assert "<script>" not in page
    parser = _Cells()
    parser.feed(page)
    assert parser.loaded == []
    for row in sheet["requirements"]:
        for level in {"threshold", "goal"} & row.keys():
            assert f"{row[level]['status']}: {row[level]['evidence']}" in [cell.strip() for cell in parser.cells]


@pytest.mark.parametrize("image", ["uav1-uav1", "uav1-uav2", "fused"])
def test_sheet_of_a_campaign_agrees_with_its_files(finished_tiny, image):
    folder = finished_tiny.results / "f01" / image
    sheet = json.loads((folder / SHEET).read_text())
    assert (folder / PAGE).read_text() == ceos_ard_page(sheet)
    report = json.loads((folder / "image.json").read_text())
    assert sheet == ceos_ard_sheet(ImageFiles(folder, report), sheet["title"])
    found = statuses(folder, report)
    expected = "not met" if image == "fused" else "met"  # layers belong to pairs
    assert found["damaski", "NRB", "threshold"] == expected
    assert found["perfind", "NRB", "threshold"] == "not met"  # no radio is configured
    for kind, levels in sheet["summary"].items():
        for level, counts in levels.items():
            rows = [row for row in sheet["requirements"] if kind in row["types"] and level in row]
            assert counts == {status: sum(row[level]["status"] == status for row in rows) for status in counts}
            assert sum(counts.values()) == len(rows)
