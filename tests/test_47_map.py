"""What the map of a finished campaign says is what its files hold."""

import json
import re
import threading
import urllib.error
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import pytest
import rasterio
from folders import copy_writable
from pyproj import Transformer

from apertura.campaign.folder import Campaign
from apertura.campaign.store import record_files
from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.formats.export import exports_in, product_files
from apertura.views.webmap.document import webmap
from apertura.views.webmap.server import FILES, SHELL, served


@pytest.fixture
def finished(finished_tiny, tmp_path):
    return Campaign.load(copy_writable(finished_tiny.root, tmp_path / "campaign"))


@contextmanager
def serving(campaign):
    """Serve a campaign's map; yield what asks for a file under the name of the data: status and body."""
    with served(campaign) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()

        def ask(name):
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{server.server_port}/{name}") as answer:
                    return answer.status, answer.read()
            except urllib.error.HTTPError as answer:
                return answer.code, answer.read()

        try:
            yield ask
        finally:
            server.shutdown()
            thread.join()


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
        assert name in set(product_files(finished_tiny.images))


def test_an_image_is_stretched_from_its_noise_floor_to_its_peak(finished_tiny):
    for image in document(finished_tiny)["images"]:
        layer = image["layers"][0]
        with rasterio.open(str(finished_tiny.results / image["flight"] / image["image"] / layer["file"])) as raster:
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


@pytest.mark.quick("no json", '{"crs*')
@pytest.mark.parametrize(
    "truth", ["no json", '{"targets": [{"x": "<img>"}]}', '{"targets": 3}', '{"crs": "local", "targets": []}']
)
def test_a_damaged_truth_is_a_note_on_the_map_and_no_failure(finished, truth):
    (finished.root / "truth.json").write_text(truth)
    webmap(finished)
    found = document(finished)
    assert [note[:41] for note in found["notes"]] == ["No simulated targets are listed: truth.js"]
    assert {one["source"] for one in found["places"]} == {"found"}


def test_an_image_that_is_not_as_it_was_written_is_not_shown(finished):
    path = finished.results / "f01" / "uav1-uav1" / "incidence.tif"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(
        CampaignError,
        match=r"incidence\.tif: the file has changed since it was written; .* listed in layers\.manifest\.json",
    ):
        webmap(finished)


@pytest.fixture
def bundled(monkeypatch):
    """A page of which each file holds its name, as if it had been bundled."""
    monkeypatch.setattr(
        "apertura.views.webmap.server.page_files", lambda: {name: name.encode() for name in (*SHELL, *FILES)}
    )


def tampered(campaign):
    """Change one number of `map.json`, and nothing else of the campaign."""
    found = document(campaign)
    found["images"][0]["error_db"] -= 1
    (campaign.results / "map" / "map.json").write_text(json.dumps(found))


def test_the_results_hold_what_is_shown_and_no_page(finished_tiny):
    assert {path.name for path in (finished_tiny.results / "map").iterdir()} == {"map.json", "map.manifest.json"}


def test_a_campaign_without_a_map_is_one_message(tiny):
    with pytest.raises(CampaignError, match=r"map/map\.json: no such file; expected a finished campaign"):
        served(Campaign.load(tiny))


def test_what_the_map_names_is_served_and_nothing_else(finished_tiny):
    found = document(finished_tiny)
    layers = [layer for image in found["images"] for layer in image["layers"]]
    with serving(finished_tiny) as ask:
        for url in (*(layer["url"] for layer in layers), found["coverage_url"]):
            name = url.removeprefix("../").partition("?")[0]
            there = (200, (finished_tiny.results / name).read_bytes())
            assert ask(url.removeprefix("../")) == ask(name) == there
        assert ask("map/map.json") == (200, (finished_tiny.results / "map/map.json").read_bytes())
        others = (
            "scene.json",
            "map/map.manifest.json",
            "f01/uav1/raw.manifest.json",
            "config/config.yaml",
            "coverage.png",
        )
        for name in (*others, "f01/uav1-uav1/slc.tif", "f01/uav1-uav1/db.qml", "f01/uav1-uav1/image.json"):
            assert ask(name)[0] == 404


@pytest.mark.usefixtures("bundled")
def test_a_page_that_came_with_the_results_is_not_served(finished):
    folder = finished.results / "map"
    planted = [folder / name for name in (*SHELL, *FILES, "other.js")]
    for path in planted:
        path.write_text("planted")
    record_files(folder / "map.manifest.json", [folder / "map.json", *planted])
    with serving(finished) as ask:
        assert {name: ask(f"map/{name}") for name in FILES} == {name: (200, name.encode()) for name in FILES}
        assert {ask(f"map/{name}")[0] for name in (*SHELL, "other.js")} == {404}


def test_a_map_that_is_not_as_it_was_written_is_one_message_at_the_start(finished):
    tampered(finished)
    with pytest.raises(
        CampaignError,
        match=r"map/map\.json: the file has changed since it was written; .* listed in map\.manifest\.json",
    ):
        served(finished)
    (finished.results / "map" / "map.manifest.json").write_text("{")
    with pytest.raises(CampaignError, match=r"map\.manifest\.json: damaged"):
        served(finished)


def test_a_map_that_names_other_files_than_products_does_not_reach_them(finished):
    found = document(finished)
    for layer, name in zip(found["images"][0]["layers"], ("scene.json", "../config/config.yaml"), strict=True):
        layer["url"] = f"../{name}?sha256={sha256_file(Path(finished.results) / name)}"
    path = finished.results / "map" / "map.json"
    path.write_text(json.dumps(found))
    record_files(path.with_name("map.manifest.json"), [path])
    with serving(finished) as ask:
        assert ask("map/map.json")[0] == 200
        assert {ask(name)[0] for name in ("scene.json", "../config/config.yaml", "%2e%2e/config/config.yaml")} == {404}


@pytest.mark.parametrize("images", [None, [{"layers": [{"url": 3}]}], [{"layers": [{}]}], "x"])
def test_a_map_of_another_kind_is_one_message(finished, images):
    path = finished.results / "map" / "map.json"
    path.write_text(json.dumps({**document(finished), "images": images}))
    record_files(path.with_name("map.manifest.json"), [path])
    with pytest.raises(CampaignError, match=r"map\.json: damaged"):
        served(finished)


def test_a_run_beside_the_server_is_taken_up_and_what_is_unfinished_or_changed_is_not_given(finished):
    layer = document(finished)["images"][1]["layers"][0]
    raster = finished.results / "f01" / "uav1-uav1" / "db.tif"
    manifest = finished.results / "map" / "map.manifest.json"
    as_written = manifest.read_bytes()
    with serving(finished) as ask:
        tampered(finished)
        assert ask("map/map.json") == (409, b"changed since the map was made: run the workflow again\n")
        manifest.unlink()
        status, said = ask("map/map.json")
        assert (status, said.count(b"\n")) == (409, 1)
        assert b"map.manifest.json: no such file" in said
        manifest.write_bytes(as_written)
        assert ask("f01/uav1-uav1/db.tif")[0] == 409  # the map beside it is none that a manifest lists
        webmap(finished)
        assert ask("f01/uav1-uav1/db.tif") == (200, raster.read_bytes())
        raster.write_bytes((finished.results / "f01/uav1-uav2/db.tif").read_bytes())
        assert ask("f01/uav1-uav1/db.tif")[0] == 409
        found = document(finished)
        found["images"][1]["layers"][0]["url"] = layer["url"].replace(layer["sha256"], sha256_file(raster))
        (finished.results / "map" / "map.json").write_text(json.dumps(found))
        record_files(manifest, [finished.results / "map" / "map.json"])
        assert ask("f01/uav1-uav1/db.tif") == (200, raster.read_bytes())
        assert ask("map/map.json")[0] == 200
