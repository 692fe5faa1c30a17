"""What the map of a finished campaign says is what its files hold."""

import json
import re
import threading
import urllib.request

import pytest
import rasterio
from folders import copy_writable
from pyproj import Transformer

from apertura.campaign import Campaign
from apertura.errors import CampaignError
from apertura.export import exports_in, product_files
from apertura.load.map_server import served
from apertura.provenance import sha256_file
from apertura.steps.webmap import webmap
from apertura.webmap.page import page_files


@pytest.fixture
def finished(finished_tiny, tmp_path):
    return Campaign.load(copy_writable(finished_tiny.root, tmp_path / "campaign"))


def document(campaign):
    return json.loads((campaign.results / "map" / "map.json").read_text())


def test_every_image_of_the_campaign_can_be_chosen_with_each_real_raster(finished_tiny):
    images = {
        (one["flight"], one["image"]): [layer["file"] for layer in one["layers"]]
        for one in document(finished_tiny)["images"]
    }
    layers = [row.file for row in exports_in("layers") if row.file.endswith(".tif")]
    assert images == {
        ("f01", "fused"): ["coherent_db.tif", "noncoherent_db.tif"],
        ("f01", "uav1-uav1"): ["db.tif", *layers],
        ("f01", "uav1-uav2"): ["db.tif", *layers],
    }


def test_every_address_leads_to_the_file_that_was_looked_at(finished_tiny):
    found = document(finished_tiny)
    addresses = [layer["url"] for image in found["images"] for layer in image["layers"]] + [found["coverage_url"]]
    for address in addresses:
        name, digest = re.fullmatch(r"\.\./([\w./-]+)\?sha256=([0-9a-f]{64})", address).groups()
        assert sha256_file(finished_tiny.results / name) == digest
        assert name in set(product_files({"f01": ("uav1-uav1", "uav1-uav2")}))


def test_an_image_is_stretched_from_its_noise_floor_to_its_peak(finished_tiny):
    for image in document(finished_tiny)["images"]:
        layer = image["layers"][0]
        with rasterio.open(finished_tiny.results / image["flight"] / image["image"] / layer["file"]) as raster:
            peak_db = float(raster.read(1).max())
        report = json.loads((finished_tiny.results / image["flight"] / image["image"] / "image.json").read_text())
        assert layer["kind"] == "image"
        assert layer["high"] == pytest.approx(peak_db, abs=1.0)  # the peak lies between the pixels
        assert layer["high"] - layer["low"] == pytest.approx(-report["noise_floor_db"], abs=0.02)


def test_the_control_places_are_projs(finished_tiny):
    crs = document(finished_tiny)["crs"]
    assert (crs["code"], crs["local"], crs["name"]) == ("EPSG:32632", False, "WGS 84 / UTM zone 32N")
    to_wgs84 = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    short = Transformer.from_crs(crs["proj4"], "EPSG:4326", always_xy=True)
    assert len(crs["control"]) == 9
    for x, y, longitude, latitude in crs["control"]:
        assert to_wgs84.transform(x, y) == pytest.approx((longitude, latitude), abs=1e-9)
        assert short.transform(x, y) == pytest.approx((longitude, latitude), abs=1e-9)


def test_targets_are_those_of_the_truth_in_their_order_then_what_each_image_found(finished_tiny):
    truth = json.loads((finished_tiny.root / "truth.json").read_text())["targets"]
    places = document(finished_tiny)["places"]
    known = [one for one in places if one["source"] == "truth"]
    assert [(one["name"], one["x_m"], one["y_m"]) for one in known] == [
        (f"target {number}", target["x"], target["y"]) for number, target in enumerate(truth)
    ]
    assert {one["image"] for one in places if one["name"] == "brightest"} == {
        f"f01/{image}" for image in ("fused", "uav1-uav1", "uav1-uav2")
    }


def test_the_same_results_give_the_same_bytes(finished):
    before = {path.name: path.read_bytes() for path in (finished.results / "map").iterdir()}
    webmap(finished)
    assert {path.name: path.read_bytes() for path in (finished.results / "map").iterdir()} == before


@pytest.mark.parametrize(
    "truth", ["no json", '{"targets": [{"x": "<img>"}]}', '{"targets": 3}', '{"crs": "local", "targets": []}']
)
def test_a_damaged_truth_is_a_note_on_the_map_and_no_failure(finished, truth):
    (finished.root / "truth.json").write_text(truth)
    webmap(finished)
    found = document(finished)
    assert [note[:31] for note in found["notes"]] == ["No targets are listed: truth.js"]
    assert {one["source"] for one in found["places"]} == {"found"}


def test_an_image_that_is_not_as_it_was_written_is_not_shown(finished):
    path = finished.results / "f01" / "uav1-uav1" / "incidence.tif"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(
        CampaignError, match=r"incidence\.tif: not as it was written; expected what layers\.manifest\.json"
    ):
        webmap(finished)


def test_without_a_bundle_the_map_is_a_page_that_says_so(finished, monkeypatch, tmp_path):
    monkeypatch.setattr("apertura.steps.webmap.page_files", lambda: page_files(tmp_path / "nowhere"))
    assert [path.name for path in webmap(finished)] == ["map.json", "index.html"]
    assert "make webmap" in (finished.results / "map" / "index.html").read_text()


def test_a_campaign_without_a_map_is_one_message(tiny):
    with pytest.raises(CampaignError, match=r"map/index\.html: no such file; expected the map of a finished campaign"):
        served(Campaign.load(tiny))


def test_the_products_are_served_and_neither_what_they_are_made_from_nor_the_config(finished_tiny):
    with served(finished_tiny) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            base = server.url.removesuffix("map/index.html")
            layer = document(finished_tiny)["images"][0]["layers"][0]
            with urllib.request.urlopen(f"{base}map/{layer['url']}".replace("map/../", "")) as answer:
                assert answer.read() == (finished_tiny.results / "f01/fused/coherent_db.tif").read_bytes()
            for name in ("scene.json", "cube.manifest.json", "f01/uav1/raw.manifest.json", "config/config.yaml"):
                with pytest.raises(urllib.error.HTTPError, match="404"):
                    urllib.request.urlopen(base + name)
        finally:
            server.shutdown()
            thread.join()
