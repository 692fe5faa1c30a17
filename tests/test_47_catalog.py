"""STAC catalog and RO-Crate of a finished campaign: files, hashes, jobs, software and out-of-date results."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import pystac
import pytest
import rasterio
from folders import contents, copy_writable
from rasterio.warp import transform_bounds
from rocrate.rocrate import ROCrate

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, read_manifest
from apertura.common.attribution import Attribution
from apertura.common.errors import CampaignError
from apertura.common.provenance import lock_sha256, sha256_file, software
from apertura.formats.catalog import CATALOG, CRATE
from apertura.formats.catalog.crate import CrateRun, Listed, crate_document
from apertura.formats.catalog.validation import stac_problems
from apertura.stages import assess, cube, export
from apertura.stages.ro_crate import ro_crate
from apertura.stages.stac import stac
from apertura.views.verify.chain import changed_files
from apertura.workflow.lineage import on_demand, places_of, result_of, results_of
from apertura.workflow.rules import RESULTS

ROOT = Path(__file__).parents[1]


@pytest.fixture
def finished(finished_tiny, tmp_path):
    """Return a writable copy of the tiny campaign with all its results."""
    return copy_writable(finished_tiny.root, tmp_path / "campaign")


@pytest.fixture(scope="module")
def crate_entities(finished_tiny):
    """Return the entities of the crate by identifier."""
    document = json.loads((finished_tiny.results / CRATE).read_text())
    entities = {entity["@id"]: entity for entity in document["@graph"]}
    assert len(entities) == len(document["@graph"])
    return entities


def ids(references):
    return [reference["@id"] for reference in ([references] if isinstance(references, dict) else references)]


def change_byte(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_every_image_has_an_item_with_existing_files(finished_tiny):
    assert stac_problems(finished_tiny.results / "stac") == []
    items = list(pystac.Catalog.from_file(str(finished_tiny.results / "stac" / CATALOG)).get_items(recursive=True))
    assert sorted(item.id for item in items) == ["f01-coherent", "f01-noncoherent", "f01-uav1-uav1", "f01-uav1-uav2"]
    assets = [asset for item in items for asset in item.assets.values()]
    assert len(assets) > 30
    for asset in assets:
        path = Path(asset.get_absolute_href()).resolve()
        assert asset.extra_fields["file:checksum"] == "1220" + sha256_file(path)
        assert asset.extra_fields["file:size"] == path.stat().st_size
    files = {Path(asset.href).name for item in items if item.id == "f01-coherent" for asset in [*item.assets.values()]}
    assert not [name for name in files if name.startswith("noncoherent")]


def test_item_has_the_footprint_of_its_raster(finished_tiny):
    item = pystac.Item.from_file(str(finished_tiny.results / "stac/images/f01/uav1-uav2.json"))
    with rasterio.open(str(finished_tiny.result("f01", "uav1-uav2", "db.tif"))) as raster:
        assert item.properties["proj:code"] == str(raster.crs)
        assert item.properties["proj:transform"] == list(raster.transform)[:6]
        assert item.properties["proj:shape"] == list(raster.shape)
        assert item.properties["proj:bbox"] == pytest.approx(list(raster.bounds), abs=1e-6)
        assert item.properties["sar:observation_direction"] == "right"
        assert 0 < item.properties["view:incidence_angle"] < 90
        assert item.bbox == pytest.approx(transform_bounds(raster.crs, "OGC:CRS84", *raster.bounds), abs=2e-7)


def test_item_states_time_and_band_of_the_recording(finished_tiny):
    item = pystac.Item.from_file(str(finished_tiny.results / "stac/images/f01/uav1-uav2.json"))
    meta = json.loads((finished_tiny.root / "raw/f01/uav1.sigmf-meta").read_text())
    first = pystac.utils.str_to_datetime(meta["captures"][0]["core:datetime"])
    last = pystac.utils.str_to_datetime(meta["captures"][-1]["core:datetime"])
    assert first <= item.common_metadata.start_datetime <= item.datetime <= item.common_metadata.end_datetime <= last
    waveform = finished_tiny.settings.waveform
    band_hz = waveform.subcarriers * waveform.subcarrier_spacing_hz
    assert item.properties["sar:bandwidth"] == pytest.approx(band_hz / 1e9)
    middle_hz = waveform.carrier_hz + band_hz / 2  # subcarrier N/2, to which profiles are referenced
    assert item.properties["sar:center_frequency"] == pytest.approx(middle_hz / 1e9)


def test_crate_lists_every_result_file_with_hash_and_size(finished_tiny, crate_entities):
    expected = {}
    for name, result in results_of(finished_tiny):
        if name != "ro_crate" and not on_demand(finished_tiny, result.manifest):
            manifest = finished_tiny.root / result.manifest
            paths = [manifest, *(manifest.parent / file for file in read_manifest(manifest)["files"])]
            expected |= {path.relative_to(finished_tiny.results).as_posix(): path for path in paths}
    files = {unquote(name): entity for name, entity in crate_entities.items() if "File" in entity["@type"]}
    assert set(files) == set(expected) | {name for name in files if name.startswith("workflow/")}
    for name, path in expected.items():
        assert files[name]["sha256"] == sha256_file(path)
        assert files[name]["contentSize"] == str(path.stat().st_size)
    loose = {unquote(part) for part in ids(crate_entities["./"]["hasPart"])}
    stores = [entity for entity in crate_entities.values() if entity["@id"].endswith(".zarr/")]
    inner = {unquote(part) for store in stores for part in ids(store["hasPart"])}
    assert set(files) <= loose | inner


def test_crate_lists_recordings_and_config_with_their_hashes(finished_tiny, crate_entities):
    inputs = {name.removeprefix("#input/"): one for name, one in crate_entities.items() if name.startswith("#input/")}
    raw_files = [path.relative_to(finished_tiny.root).as_posix() for path in (finished_tiny.root / "raw").rglob("*.*")]
    assert set(inputs) == {*raw_files, "config/config.yaml", "config/flights.tsv", "truth.json"}
    assert all(one["sha256"] == sha256_file(finished_tiny.root / name) for name, one in inputs.items())


def test_job_states_command_parameters_code_sources_and_results(crate_entities, finished_tiny):
    job = crate_entities["#job/image/f01/uav1-uav2"]
    assert job["name"] == "apertura step image f01 uav1-uav2"
    tool = crate_entities[job["instrument"]["@id"]]
    assert tool["identifier"] == f"sha256:{result_of(finished_tiny, 'image', 'f01', 'uav1-uav2').code_sha256}"
    assert {"f01/uav1-uav2/profile.manifest.json", "f01/refined_track.manifest.json"} < set(ids(job["object"]))
    settings = [crate_entities[name] for name in ids(job["object"]) if name.startswith("#setting/")]
    assert {setting["name"]: setting["value"] for setting in settings}["accuracy_db"] == "auto"
    assert ids(job["result"]) == ["f01/uav1-uav2/image.zarr/", "f01/uav1-uav2/image.manifest.json"]
    assert "#input/raw/f01/uav2.sigmf-data" in ids(crate_entities["#job/ingest/f01/uav2"]["object"])
    assert all(
        crate_entities[one]
        for action in crate_entities.values()
        if "Action" in str(action["@type"])
        for one in ids(action["object"])
    )


def test_crate_contains_environment_lock_and_code(crate_entities):
    versions = {one["name"]: one["version"] for name, one in crate_entities.items() if name.startswith("#software/")}
    assert versions == software()
    assert {"python", "gdal", "proj", "numpy"} < set(versions)
    assert crate_entities["#lock"]["value"] == lock_sha256()
    assert ids(crate_entities["#job/cube"]["environment"]) == ["#lock"]
    assert ids(crate_entities["#control/cube"]["object"]) == ["#job/cube"]


def test_crate_reports_products_of_other_code_or_settings(finished):
    manifest = finished / "results/f01/uav1-uav2/layers.manifest.json"
    document = json.loads(manifest.read_text())
    manifest.write_text(json.dumps({**document, "code": "0" * 64, "settings": "1" * 64}))
    ro_crate(Campaign.load(finished))
    graph = json.loads((finished / "results" / CRATE).read_text())["@graph"]
    described = {one["@id"]: one["description"] for one in graph if one["@id"].startswith("#job/")}
    description = described["#job/layers/f01/uav1-uav2"]
    installed = result_of(Campaign.load(finished), "layers", "f01", "uav1-uav2").code_sha256
    assert f"written by code that differs from the installed code of sha256 {installed}" in description
    assert f"written with other settings, of sha256 {'1' * 64}" in description
    assert "results/f01/uav1-uav2/layers.manifest.json" in described["#job/coverage"]
    assert described["#job/echo/f01/uav1-uav2"] == "Up to date with the current code and settings."


@pytest.mark.quick("results/f01/uav1-uav1/db.tif", "raw/f01/uav2.sigmf-data")
@pytest.mark.parametrize(
    "name",
    [
        "results/f01/uav1-uav1/db.tif",
        "results/f01/uav1-uav1/image.zarr/image/c/0/0",
        "results/f01/uav1-uav1/echo.manifest.json",
        "results/stac/images/f01/coherent.json",
        "results/workflow/Snakefile",
        "raw/f01/uav2.sigmf-data",
        "config/flights.tsv",
    ],
)
def test_changed_or_missing_file_is_reported(finished, name):
    assert changed_files(finished / "results") == {}
    change_byte(finished / name)
    assert changed_files(finished / "results") == {name.removeprefix("results/"): "changed"}
    (finished / name).unlink()
    assert changed_files(finished / "results") == {name.removeprefix("results/"): "missing"}
    assert bool(changed_files(finished / "results", inputs=False)) == name.startswith("results/")


@pytest.mark.parametrize(
    "name", ["../config/config.yaml", "%2E%2E/config/config.yaml", "/etc/passwd", "a%00b", "#input/../x"]
)
def test_crate_with_paths_outside_its_folder_is_refused(finished, name):
    path = finished / "results" / CRATE
    document = json.loads(path.read_text())
    document["@graph"].append({"@id": name, "@type": "File", "sha256": "0"})
    path.write_text(json.dumps(document))
    with pytest.raises(CampaignError, match=re.escape(CRATE)):
        changed_files(finished / "results")


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"@graph": [{"sha256": 1}]}', '{"@graph": 3}'])
def test_damaged_crate_is_one_message(finished, text):
    (finished / "results" / CRATE).write_text(text)
    with pytest.raises(CampaignError, match="damaged"):
        changed_files(finished / "results")


def test_catalog_and_crate_do_not_depend_on_the_folder(finished_tiny, finished):
    names = ("stac/", "workflow/", CRATE)
    campaign = Campaign.load(finished)
    shutil.rmtree(finished / "results/stac")
    stac(campaign)
    ro_crate(campaign)
    written, expected = contents(finished / "results"), contents(finished_tiny.results)
    compared = [name for name in expected if name.startswith(names)]
    assert len(compared) > 10
    assert [name for name in compared if written.get(name) != expected[name]] == []


@pytest.mark.slow
def test_hostile_campaign_name_is_plain_text(finished):
    name = "../../x $(id) %2F {0} 'quoted'"
    config = finished / "config" / "config.yaml"
    config.write_text(re.sub("(?m)^campaign:.*$", lambda _: f"campaign: {json.dumps(name)}", config.read_text()))
    campaign = Campaign.load(finished)
    before = set(contents(finished))
    stac(campaign)
    ro_crate(campaign)
    assert set(contents(finished)) == before
    graph = {one["@id"]: one for one in json.loads((finished / "results" / CRATE).read_text())["@graph"]}
    assert graph["./"]["name"] == name
    assert stac_problems(finished / "results" / "stac") == []


def test_crate_is_read_by_the_rocrate_library(finished_tiny):
    crate = ROCrate(finished_tiny.results)
    assert crate.mainEntity.id == "workflow/Snakefile"
    actions = [action for action in crate.root_dataset["mentions"] if action.type == "CreateAction"]
    assert {action["instrument"].type for action in actions if action.id != "#run"} == {"SoftwareApplication"}


def test_jobs_are_the_rules_of_the_workflow(finished_tiny):
    text = "\n".join(path.read_text() for path in (ROOT / "workflow" / "rules").glob("*.smk"))
    found = re.findall(r'(?s)\nrule (\w+):.*?shell:\s+"apertura (step [^"]+?)(?: --threads| >)', "\n" + text)
    rules = {rule: re.sub(r"{wildcards\.(\w+)}", r"\1", command) for rule, command in found}
    for name, where, _ in places_of(finished_tiny):
        rule = RESULTS[name]
        assert len(where) == len(rule.of.wildcards)
        if name not in {"speed_accuracy", "whole", "report"}:
            assert rule.command_line(rule.of.wildcards) == f"apertura {rules[rule.name]}"


def test_how_to_prints_what_it_shows(finished, monkeypatch, capsys):
    monkeypatch.chdir(finished.parent)
    page = (ROOT / "docs/howto/catalog.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", page, flags=re.DOTALL)
    assert len(blocks) == 3
    names = {}
    for code, printed in blocks:
        exec(compile(code, "catalog.md", "exec"), names)
        output, expected = capsys.readouterr().out, printed.partition("    ...\n")[0]
        assert output.startswith(expected)


def test_frequency_is_equal_in_all_products(finished_tiny):
    item = pystac.Item.from_file(str(finished_tiny.results / "stac/images/f01/uav1-uav2.json"))
    report = json.loads((finished_tiny.result("f01", "uav1-uav2", "image.json")).read_text())
    cube = open_stage(finished_tiny.stage("cube"), "cube")
    centre_hz = float(cube.centre_frequency.sel(flight="f01", pair="uav1-uav2"))
    profile = open_stage(finished_tiny.stage("profile", "f01", "uav1-uav2"), "profile")
    assert item.properties["sar:center_frequency"] == round(centre_hz / 1e9, 9)
    assert report["view"]["centre_hz"] == centre_hz == profile.attrs["centre_frequency_hz"]


@pytest.mark.slow
def test_verdict_is_equal_in_all_products(finished, monkeypatch):
    """For a focused pair with a wrong code, no product reports the image, or a sum that contains it, as focused."""
    line = [("uav1-uav2", "wrong_code", "another code")]
    monkeypatch.setattr("apertura.stages.assess.wrong_codes", lambda _: line)
    campaign = Campaign.load(finished)
    assess.assess(campaign, "f01")
    cube.cube(campaign)
    for name, raster, item, verdict in (
        ("uav1-uav1", "db.tif", "f01-uav1-uav1", "focused"),
        ("uav1-uav2", "db.tif", "f01-uav1-uav2", "inconclusive"),
        ("fused", "coherent_db.tif", "f01-coherent", "inconclusive"),
    ):
        export.export(campaign, "f01", name)
        stac(campaign)
        report = json.loads(campaign.result("f01", name, "image.json").read_text())
        items = pystac.Catalog.from_file(str(finished / "results/stac" / CATALOG)).get_items(recursive=True)
        with rasterio.open(str(campaign.result("f01", name, raster))) as opened:
            tags = json.loads(opened.tags()["APERTURA_FOCUS"])
        assert report["focus"]["verdict"] == tags["verdict"] == verdict
        assert next(one for one in items if one.id == item).properties["apertura:verdict"] == verdict
        if name != "fused":
            stated = open_stage(campaign.stage("cube"), "cube").verdict.sel(flight="f01", pair=name)
            assert str(stated.values) == verdict


def test_crate_states_creators_institution_licence_and_doi_if_configured():
    rules = [Listed("workflow/Snakefile", "2" * 64, 10)]
    versions = {"apertura": "1", "snakemake": "9"}
    run = CrateRun("tandem", "2025-05-14T09:30:00Z", versions, "3" * 64, [], [], rules)
    creators = [{"name": "A. Nother", "orcid": "0000-0002-1825-0097", "affiliation": "An Institute"}, {"name": "B"}]
    stated = {"creators": creators, "institution": "An Institute", "doi": "10.5281/zenodo.1", "title": "Harbour"}
    for options, licence in (({}, "#licence"), ({"licence": "CC-BY-4.0"}, "https://spdx.org/licenses/CC-BY-4.0")):
        document = crate_document(replace(run, attribution=Attribution(**stated, **options)))
        entities = {entity["@id"]: entity for entity in document["@graph"]}
        assert entities["./"]["license"] == {"@id": licence}
        assert entities["./"]["identifier"] == "https://doi.org/10.5281/zenodo.1"
        assert (entities["./"]["name"], entities["./"]["alternateName"]) == ("Harbour", "tandem")
        first, second = (entities[identifier] for identifier in ids(entities["./"]["author"]))
        assert (first["@id"], first["name"]) == ("https://orcid.org/0000-0002-1825-0097", "A. Nother")
        assert entities[first["affiliation"]["@id"]] == entities[entities["./"]["publisher"]["@id"]]
        assert (second["name"], "affiliation" in second) == ("B", False)
        assert licence in entities
