"""Map of a finished campaign: its document agrees with the files, and the server serves only these files."""

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
    """Serve the map of a campaign; yield a function that requests a file and returns status and body."""
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


def test_map_lists_every_image_with_its_real_rasters(finished_tiny):
    images = {
        (image["flight"], image["image"]): [layer["file"] for layer in image["layers"]]
        for image in document(finished_tiny)["images"]
    }
    layers = [row.file for row in exports_in("layers") if row.file.endswith(".tif")]
    assert images == {
        ("f01", "fused"): ["coherent_db.tif", "noncoherent_db.tif"],
        ("f01", "uav1-uav1"): ["db.tif", *layers],
        ("f01", "uav1-uav2"): ["db.tif", *layers],
    }


def test_every_url_has_the_hash_of_its_file(finished_tiny):
    found = document(finished_tiny)
    addresses = [layer["url"] for image in found["images"] for layer in image["layers"]] + [found["coverage_url"]]
    for address in addresses:
        name, digest = re.fullmatch(r"\.\./([\w./-]+)\?sha256=([0-9a-f]{64})", address).groups()
        assert sha256_file(finished_tiny.results / name) == digest
        assert name in set(product_files(finished_tiny.images))


def test_image_is_stretched_from_noise_floor_to_peak(finished_tiny):
    for image in document(finished_tiny)["images"]:
        layer = image["layers"][0]
        with rasterio.open(str(finished_tiny.results / image["flight"] / image["image"] / layer["file"])) as raster:
            peak_db = float(raster.read(1).max())
        report = json.loads((finished_tiny.results / image["flight"] / image["image"] / "image.json").read_text())
        assert layer["kind"] == "image"
        assert layer["high"] == pytest.approx(peak_db, abs=1.0)  # the peak lies between pixels
        assert layer["high"] - layer["low"] == pytest.approx(-report["noise_floor_db"], abs=0.02)


def test_control_points_agree_with_proj(finished_tiny):
    crs = document(finished_tiny)["crs"]
    assert (crs["code"], crs["local"], crs["name"]) == ("EPSG:32632", False, "WGS 84 / UTM zone 32N")
    to_wgs84 = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    by_proj_string = Transformer.from_crs(crs["proj4"], "EPSG:4326", always_xy=True)
    assert len(crs["control"]) == 9
    for x, y, longitude, latitude in crs["control"]:
        assert to_wgs84.transform(x, y) == pytest.approx((longitude, latitude), abs=1e-9)
        assert by_proj_string.transform(x, y) == pytest.approx((longitude, latitude), abs=1e-9)


def test_places_are_the_simulated_targets_and_image_peaks(finished_tiny):
    truth = json.loads((finished_tiny.root / "truth.json").read_text())["targets"]
    places = document(finished_tiny)["places"]
    targets = [place for place in places if place["source"] == "truth"]
    assert [(place["name"], place["x_m"], place["y_m"]) for place in targets] == [
        (f"target {number}", target["x"], target["y"]) for number, target in enumerate(truth)
    ]
    assert {place["image"] for place in places if place["name"] == "brightest"} == {
        f"f01/{image}" for image in ("fused", "uav1-uav1", "uav1-uav2")
    }


def test_map_is_reproduced_byte_for_byte(finished):
    before = {path.name: path.read_bytes() for path in (finished.results / "map").iterdir()}
    webmap(finished)
    assert {path.name: path.read_bytes() for path in (finished.results / "map").iterdir()} == before


@pytest.mark.quick("no json", '{"crs*')
@pytest.mark.parametrize(
    "truth", ["no json", '{"targets": [{"x": "<img>"}]}', '{"targets": 3}', '{"crs": "local", "targets": []}']
)
def test_damaged_truth_is_a_note_and_no_failure(finished, truth):
    (finished.root / "truth.json").write_text(truth)
    webmap(finished)
    map_document = document(finished)
    assert [note[:41] for note in map_document["notes"]] == ["No simulated targets are listed: truth.js"]
    assert {place["source"] for place in map_document["places"]} == {"found"}


def test_image_changed_since_it_was_written_is_refused(finished):
    path = finished.results / "f01" / "uav1-uav1" / "incidence.tif"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(
        CampaignError,
        match=r"incidence\.tif: the file has changed since it was written; .* listed in layers\.manifest\.json",
    ):
        webmap(finished)


@pytest.fixture
def bundled(monkeypatch):
    """Replace the bundled page by files that contain their own names."""
    monkeypatch.setattr(
        "apertura.views.webmap.server.page_files", lambda: {name: name.encode() for name in (*SHELL, *FILES)}
    )


def tamper(campaign):
    """Change one number of `map.json` without updating its manifest."""
    map_document = document(campaign)
    map_document["images"][0]["error_db"] -= 1
    (campaign.results / "map" / "map.json").write_text(json.dumps(map_document))


def test_results_contain_the_map_document_and_no_page(finished_tiny):
    assert {path.name for path in (finished_tiny.results / "map").iterdir()} == {"map.json", "map.manifest.json"}


def test_campaign_without_a_map_is_one_message(tiny):
    with pytest.raises(CampaignError, match=r"map/map\.json: no such file; expected a finished campaign"):
        served(Campaign.load(tiny))


def test_only_files_listed_in_the_map_are_served(finished_tiny):
    found = document(finished_tiny)
    layers = [layer for image in found["images"] for layer in image["layers"]]
    with serving(finished_tiny) as ask:
        for url in (*(layer["url"] for layer in layers), found["coverage_url"]):
            name = url.removeprefix("../").partition("?")[0]
            expected = (200, (finished_tiny.results / name).read_bytes())
            assert ask(url.removeprefix("../")) == ask(name) == expected
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
def test_page_in_the_results_folder_is_not_served(finished):
    folder = finished.results / "map"
    planted = [folder / name for name in (*SHELL, *FILES, "other.js")]
    for path in planted:
        path.write_text("planted")
    record_files(folder / "map.manifest.json", [folder / "map.json", *planted])
    with serving(finished) as ask:
        assert {name: ask(f"map/{name}") for name in FILES} == {name: (200, name.encode()) for name in FILES}
        assert {ask(f"map/{name}")[0] for name in (*SHELL, "other.js")} == {404}


def test_changed_map_is_refused_at_the_start(finished):
    tamper(finished)
    with pytest.raises(
        CampaignError,
        match=r"map/map\.json: the file has changed since it was written; .* listed in map\.manifest\.json",
    ):
        served(finished)
    (finished.results / "map" / "map.manifest.json").write_text("{")
    with pytest.raises(CampaignError, match=r"map\.manifest\.json: damaged"):
        served(finished)


def test_map_with_urls_of_other_files_does_not_serve_them(finished):
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
def test_malformed_map_is_one_message(finished, images):
    path = finished.results / "map" / "map.json"
    path.write_text(json.dumps({**document(finished), "images": images}))
    record_files(path.with_name("map.manifest.json"), [path])
    with pytest.raises(CampaignError, match=r"map\.json: damaged"):
        served(finished)


def test_server_follows_a_concurrent_run_and_refuses_changed_files(finished):
    layer = document(finished)["images"][1]["layers"][0]
    raster = finished.results / "f01" / "uav1-uav1" / "db.tif"
    manifest = finished.results / "map" / "map.manifest.json"
    as_written = manifest.read_bytes()
    with serving(finished) as ask:
        tamper(finished)
        message = b"the file was changed after the map was made: run the workflow again\n"
        assert ask("map/map.json") == (409, message)
        manifest.unlink()
        status, body = ask("map/map.json")
        assert (status, body.count(b"\n")) == (409, 1)
        assert b"map.manifest.json: no such file" in body
        manifest.write_bytes(as_written)
        assert ask("f01/uav1-uav1/db.tif")[0] == 409  # the manifest does not list the tampered map
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
