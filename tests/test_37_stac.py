"""Images as STAC items: validation against the shipped schemas."""

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pystac
import pytest
from pyproj import CRS, Proj
from pystac.validation.stac_validator import JsonSchemaSTACValidator
from rasterio import Affine

from apertura.common.attribution import Attribution
from apertura.common.errors import CampaignError
from apertura.formats.catalog import CATALOG
from apertura.formats.catalog.stac import (
    EXTENSIONS,
    AcquisitionTime,
    Image,
    asset_of,
    catalog_files,
    instant,
    item_of,
    projection,
    read_facts,
    true_azimuth_deg,
)
from apertura.formats.catalog.validation import document_problem, stac_problems
from apertura.formats.export.cog import write_slc

START = datetime(2025, 5, 14, 9, 30, tzinfo=UTC)
ACQUISITION = AcquisitionTime(START, START + timedelta(seconds=15), 1.4e9, 4e8)
SQUARE = {"type": "Polygon", "coordinates": [[[9, 48], [9.1, 48], [9.1, 48.1], [9, 48.1], [9, 48]]]}
TRANSFORM = Affine(0.5, 0, 500000, 0, -0.5, 100)
WKT = CRS("EPSG:32632").to_wkt()
DIGEST = "ab" * 32
HOSTILE = '<script>alert("x")</script> ../../etc \u202e\n"}'


def facts():
    return {
        **projection(WKT, (4, 6), TRANSFORM[:6]),
        "sar:instrument_mode": "bistatic",
        "product:type": "SLC",
        "view:incidence_angle": 45.0,
        "processing:level": "L1",
        "processing:lineage": "apertura step export f01 a-b",
        "processing:version": "1",
        "processing:software": {"apertura": "1", "python": "3", "gdal": "3", "proj": "9"},
    }


@pytest.fixture(scope="module")
def slc(tmp_path_factory):
    path = tmp_path_factory.mktemp("slc") / "slc.tif"
    tags = {"APERTURA_INPUTS": json.dumps({"raw/codes.npy": DIGEST})}
    write_slc(path, np.ones((4, 6), "c8"), transform=TRANSFORM, crs=WKT, tags=tags, title="a")
    return path


def image(slc, name="a-b", **changes):
    asset = asset_of(slc, f"../../../f01/{name}/slc.tif", sha256=DIGEST, facts=read_facts(slc))
    inputs = {"raw/codes.npy": DIGEST}
    return Image(**{
        "flight": "f01", "name": name, "title": "a scene", "geometry": SQUARE, "acquisition": ACQUISITION,
        "properties": facts(), "assets": {"slc": asset}, "inputs": inputs, **changes,
    })  # fmt: skip


def item(slc, **changes):
    return item_of(image(slc, **changes), "../../../..").to_dict()


def test_bands_and_inputs_are_read_from_a_raster(slc):
    raster_facts = read_facts(slc)
    assert raster_facts.bands == [
        {
            "name": "slc",
            "description": "amplitude of the focused scene, complex, phase flattened, with spatial carrier",
            "data_type": "cfloat32",
            "raster:sampling": "area",
            "raster:spatial_resolution": 0.5,
            "raster:bits_per_sample": 64,
            "nodata": "nan",
            "unit": "1",
        }
    ]
    assert raster_facts.inputs == {"raw/codes.npy": DIGEST}


def test_file_that_is_no_geotiff_is_refused(tmp_path):
    path = tmp_path / "db.tif"
    path.write_text("no raster")
    with pytest.raises(CampaignError, match=r"db\.tif: cannot be read as GeoTIFF; expected a GeoTIFF of the workflow"):
        read_facts(path)


def test_item_declares_and_conforms_to_every_extension(slc):
    document = item(slc)
    assert sorted([*document["stac_extensions"], EXTENSIONS["sci"], EXTENSIONS["insar"]]) == sorted(EXTENSIONS.values())
    assert document_problem(document) is None


COMPARED = {"reference": ("f01", "a-b"), "secondary": ("f02", "a-b")}
INSAR = {
    "insar:perpendicular_baseline": 0.7,
    "insar:temporal_baseline": 2.0,
    "insar:height_of_ambiguity": 3.9,
    "insar:reference_datetime": "2025-05-14T09:30:00Z",
    "insar:secondary_datetime": "2025-05-16T09:30:00Z",
}


def test_interferogram_links_to_both_images(slc, tmp_path):
    both = image(slc, "two", flight="interferometry", properties={**facts(), **INSAR}, compared=COMPARED)
    folder = written(tmp_path, [image(slc), image(slc, flight="f02"), both])
    assert stac_problems(folder) == []
    items = {entry.id: entry for entry in pystac.Catalog.from_file(folder / CATALOG).get_items(recursive=True)}
    for relation, (flight, name) in COMPARED.items():
        (link,) = items["interferometry-two"].get_links(relation)
        assert link.get_absolute_href() == items[f"{flight}-{name}"].self_href


@pytest.mark.parametrize("field", [name for name in INSAR if "ambiguity" not in name])
def test_interferogram_without_baselines_or_dates_is_refused(slc, field):
    document = item(slc, properties={**facts(), **INSAR}, compared=COMPARED)
    assert document_problem(document) is None
    del document["properties"][field]
    assert document_problem(document)


DEFECTS = {
    "sar: unknown band letter": lambda item: item["properties"].update({"sar:frequency_band": "Q"}),
    "sar: no mode": lambda item: item["properties"].pop("sar:instrument_mode"),
    "sar: unknown observation direction": lambda item: item["properties"].update(
        {"sar:observation_direction": "front"}
    ),
    "sar: deprecated product type": lambda item: item["properties"].update({"sar:product_type": "SLC"}),
    "product: no type": lambda item: item["properties"].pop("product:type"),
    "view: angle below ground": lambda item: item["properties"].update({"view:incidence_angle": 91.0}),
    "projection: half a shape": lambda item: item["properties"].update({"proj:shape": [4]}),
    "projection: no transform": lambda item: item["properties"].pop("proj:transform"),
    "processing: no lineage": lambda item: item["properties"].pop("processing:lineage"),
    "processing: unnamed GDAL": lambda item: item["properties"]["processing:software"].pop("gdal"),
    "file: sha256 of 31 bytes": lambda item: item["assets"]["slc"].update({"file:checksum": "1220" + "ab" * 31}),
    "file: no size": lambda item: item["assets"]["slc"].pop("file:size"),
    "file: input by md5": lambda item: item["links"][0].update({"file:checksum": "d50110" + "ab" * 16}),
    "raster: no bands": lambda item: item["assets"]["slc"].pop("bands"),
    "raster: unknown data type": lambda item: item["assets"]["slc"]["bands"][0].update({"data_type": "complex"}),
    "core: no geometry": lambda item: item.pop("geometry"),
    "core: code without footprint": lambda item: item.update({"geometry": None}),
    "core: no time": lambda item: item["properties"].update({"datetime": "yesterday"}),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_invalid_item_is_refused(slc, name):
    document = item(slc)
    DEFECTS[name](document)
    assert document_problem(document)


def test_extension_without_a_shipped_schema_is_refused(slc):
    document = item(slc)
    document["stac_extensions"].append("https://example.com/schema.json")
    assert document_problem(document) == "the schema of https://example.com/schema.json is not available"


def written(folder, images, campaign="tandem"):
    for name, document in catalog_files(campaign, images, Attribution()).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(document))
    return folder


def test_pystac_finds_every_item_and_file_of_the_catalog(slc, tmp_path):
    fused = image(slc, "coherent", made_from=["a-b"])
    folder = written(tmp_path / "results" / "stac", [fused, image(slc)])
    assert stac_problems(folder) == []
    catalog = pystac.Catalog.from_file(folder / CATALOG)
    items = {entry.id: entry for entry in catalog.get_items(recursive=True)}
    assert sorted(items) == ["f01-a-b", "f01-coherent"]
    assert items["f01-a-b"].assets["slc"].get_absolute_href() == str(tmp_path / "results/f01/a-b/slc.tif")
    links = [link for link in items["f01-coherent"].links if link.rel == "derived_from"]
    assert links[0].get_absolute_href() == str(tmp_path / "raw" / "codes.npy")
    assert links[0].extra_fields["file:checksum"] == "1220" + DIGEST
    assert links[1].get_absolute_href() == items["f01-a-b"].self_href


def test_links_are_relative_and_no_file_links_to_itself(slc, tmp_path):
    files = catalog_files("tandem", [image(slc)], Attribution())
    hrefs = [link["href"] for document in files.values() for link in document["links"]]
    assert all(href.startswith(".") for href in hrefs)
    assert not [link for document in files.values() for link in document["links"] if link["rel"] == "self"]


def test_missing_or_edited_items_of_a_catalog_are_reported(slc, tmp_path):
    folder = written(tmp_path, [image(slc), image(slc, "coherent")])
    (folder / "images/f01/a-b.json").unlink()
    path = folder / "images/f01/coherent.json"
    path.write_text(path.read_text().replace('"sar:frequency_band": "L"', '"sar:frequency_band": "l"'))
    problems = sorted(stac_problems(folder))
    assert problems[0] == "images/f01/a-b.json: no such file"
    assert problems[1].startswith("images/f01/coherent.json: properties/sar:frequency_band: 'l' is not one of")


def test_link_out_of_the_catalog_is_not_followed(slc, tmp_path):
    folder = written(tmp_path / "stac", [image(slc)])
    path = folder / "collection.json"
    document = json.loads(path.read_text())
    document["links"].append({"rel": "item", "href": "../../secret.json"})
    path.write_text(json.dumps(document))
    assert stac_problems(folder) == ["../../secret.json: path '../../secret.json' leads out of the campaign folder"]


def test_local_campaign_has_items_without_geometry_and_no_collection(slc, tmp_path):
    local = CRS.from_wkt('LOCAL_CS["yard",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]').to_wkt()
    properties = {**facts(), **projection(local, (4, 6), TRANSFORM[:6])}
    folder = written(tmp_path, [image(slc, geometry=None, properties=properties)])
    assert stac_problems(folder) == []
    (entry,) = pystac.Catalog.from_file(folder / CATALOG).get_items(recursive=True)
    assert entry.geometry is None
    assert entry.bbox is None
    assert entry.properties["proj:code"] is None
    assert entry.collection_id is None
    assert not (folder / "collection.json").exists()


@pytest.mark.parametrize(
    ("ghz", "band"), [(0.15, None), (0.25, "P"), (0.7, "P"), (1.0, "L"), (39.9, "Ka"), (77.0, None)]
)
def test_frequency_band_letter_follows_the_table_of_the_extension(slc, ghz, band):
    """The bands are those of the extension, with P from 0.25 to 1 GHz; the letter is optional."""
    document = item(slc, acquisition=AcquisitionTime(START, START, 1e9 * ghz, 1e8))
    assert document["properties"]["sar:center_frequency"] == ghz
    assert document["properties"].get("sar:frequency_band") == band
    assert EXTENSIONS["sar"] in document["stac_extensions"]
    assert document_problem(document) is None


STATED = Attribution(
    title="Harbour in May",
    creators=[{"name": "A. Nother", "orcid": "0000-0002-1825-0097", "affiliation": "An Institute"}],
    institution="An Institute",
    licence="CC-BY-4.0",
    platform="hexacopter",
    instrument="L-band radar",
    doi="10.5281/zenodo.1",
)
CITATION = "A. Nother (2025): Harbour in May. An Institute. https://doi.org/10.5281/zenodo.1"
PRODUCERS = [
    {"name": "An Institute", "roles": ["producer", "processor"]},
    {
        "name": "A. Nother (ORCID 0000-0002-1825-0097, An Institute)",
        "roles": ["producer"],
        "url": "https://orcid.org/0000-0002-1825-0097",
    },
]


def test_attribution_is_written_to_the_collection_and_to_every_item(slc):
    files = catalog_files("tandem", [image(slc)], STATED)
    collection, entry = files["collection.json"], files["images/f01/a-b.json"]
    for document in (collection, entry):
        assert document_problem(document) is None
        fields = document if document is collection else document["properties"]
        assert fields["license"] == "CC-BY-4.0"
        assert (fields["sci:doi"], fields["sci:citation"]) == ("10.5281/zenodo.1", CITATION)
        assert sorted(map(str, fields["providers"])) == sorted(map(str, PRODUCERS))
        assert EXTENSIONS["sci"] in document["stac_extensions"]
    assert entry["properties"]["platform"] == "hexacopter"
    assert entry["properties"]["instruments"] == ["L-band radar"]
    assert {"rel": "cite-as", "href": "https://doi.org/10.5281/zenodo.1"} in collection["links"]


def test_attribution_that_is_not_stated_leaves_no_field(slc):
    files = catalog_files("tandem", [image(slc)], Attribution())
    assert files["collection.json"]["license"] == "other"
    absent = {"license", "providers", "platform", "instruments", "processing:facility"}
    properties = files["images/f01/a-b.json"]["properties"]
    assert not [name for name in properties if name in absent or name.startswith("sci:")]


@pytest.mark.parametrize("stated", [Attribution(), STATED])
def test_catalog_conforms_to_the_published_schemas(slc, stated):
    """The schemas in tests/stac are those of github.com/stac-extensions, in the versions that the items name."""
    official = JsonSchemaSTACValidator()
    for path in (Path(__file__).parent / "stac").glob("*.json"):
        schema = json.loads(path.read_text())
        official.schema_cache[schema["$id"].removesuffix("#")] = schema
    assert set(EXTENSIONS.values()) - {EXTENSIONS["insar"]} <= official.schema_cache.keys()
    for document in catalog_files("tandem", [image(slc)], stated).values():
        kind = pystac.STACObjectType(document["type"])
        official.validate(document, kind, "1.1.0", document.get("stac_extensions", []))
    document["properties"]["sar:bandwidth"] = "wide"
    with pytest.raises(pystac.STACValidationError):
        official.validate(document, kind, "1.1.0", document["stac_extensions"])


def test_view_azimuth_is_referred_to_true_north():
    """Meridian convergence of a transverse Mercator projection at longitude λ from its meridian: λ sin φ."""
    point = 640000.0, 5300000.0
    longitude, latitude = Proj("EPSG:32632")(*point, inverse=True)
    convergence_deg = (longitude - 9) * np.sin(np.radians(latitude))
    assert convergence_deg > 1
    for grid_deg in (0.0, 130.0, 359.5):
        assert true_azimuth_deg("EPSG:32632", point, grid_deg) == pytest.approx(
            (grid_deg + convergence_deg) % 360, abs=2e-3
        )
    assert true_azimuth_deg("EPSG:32632", point, None) is None
    assert true_azimuth_deg('LOCAL_CS["yard",UNIT["metre",1]]', point, 10.0) is None


def test_recording_without_a_clock_is_marked(slc):
    counted = AcquisitionTime(instant(0), instant(10**9), 9.6e9, 6e8)
    assert item(slc, acquisition=counted)["properties"]["apertura:clock"].startswith("none:")
    assert "apertura:clock" not in item(slc)["properties"]


def test_untrusted_names_are_escaped_and_links_encoded(slc, tmp_path):
    inputs = {'raw/a b#?"<x>.npy': DIGEST}
    folder = written(tmp_path, [image(slc, title=HOSTILE, inputs=inputs)], campaign=HOSTILE)
    assert stac_problems(folder) == []
    document = json.loads((folder / "images/f01/a-b.json").read_text())
    assert document["properties"]["title"] == HOSTILE
    assert document["links"][0]["href"] == "../../../../raw/a%20b%23%3F%22%3Cx%3E.npy"
    assert sorted(path.name for path in tmp_path.rglob("*.json")) == ["a-b.json", CATALOG, "collection.json"]


def test_catalog_does_not_depend_on_the_order_of_images(slc):
    images = [image(slc), image(slc, "coherent", made_from=["a-b"])]
    assert json.dumps(catalog_files("tandem", images, Attribution())) == json.dumps(
        catalog_files("tandem", images[::-1], Attribution())
    )
