"""Out-of-date results: manifests record inputs, and changed files, settings or code are found by hashes."""

import json
import os
import shutil
from pathlib import Path

import pytest
import yaml
from folders import copy_writable, state

from apertura.campaign.digests import Sources, digest_of
from apertura.campaign.folder import Campaign
from apertura.check import print_findings, problems
from apertura.common.errors import CampaignError
from apertura.common.processes import hold
from apertura.stages import echo, ingest, scene, transfer
from apertura.stages.scene import expected_scene
from apertura.views.plan import first_flight, print_plan
from apertura.views.summary import print_summary
from apertura.workflow.lineage import modules_of, on_demand, results_of
from apertura.workflow.resources import Resources
from apertura.workflow.rules import RESULTS
from apertura.workflow.stale import (
    absent_files,
    absent_lines,
    any_is_missing,
    damaged_results,
    make_again,
    stale_lines,
    stale_results,
    wanted_files,
    without_outdated,
)

LOG = "raw/f01/uav2.track.pos"


@pytest.fixture
def finished(finished_tiny, tmp_path):
    """Return a writable copy of the tiny campaign with all its results."""
    return copy_writable(finished_tiny.root, tmp_path / "finished")


def edit(root, change):
    path = root / "config" / "config.yaml"
    document = yaml.safe_load(path.read_text())
    change(document)
    path.write_text(yaml.safe_dump(document))
    return Campaign.load(root)


def replace_keeping_times(path, data):
    """Replace the content of a file and keep its modification time, like `rsync -a` and `cp -p`."""
    before = path.stat()
    temporary = path.with_name("temporary")
    temporary.write_bytes(data)
    os.utime(temporary, ns=(before.st_atime_ns, before.st_mtime_ns))
    temporary.replace(path)
    assert path.stat().st_mtime_ns == before.st_mtime_ns


def names(stale):
    """Return the names of results, without flight and pair."""
    return {Path(manifest).name.partition(".")[0] for manifest in stale}


def test_results_record_their_inputs_and_are_up_to_date(finished_tiny):
    results = list(results_of(finished_tiny))
    assert len(results) == 23 + 4 + 9
    for name, result in results:
        if RESULTS[name].on_demand:
            continue
        recorded = json.loads((finished_tiny.root / result.manifest).read_text())
        assert set(recorded) == {"files", "sources", "settings", "code"}
        assert set(recorded["sources"]) == set(result.sources)
        assert recorded["files"]
    assert stale_results(finished_tiny) == {}


@pytest.mark.slow
def test_changed_log_with_kept_time_outdates_all_dependent_results(finished):
    campaign, path = Campaign.load(finished), finished / LOG
    data = path.read_bytes()
    replace_keeping_times(path, data.replace(b"8", b"9", 1))
    outdated = stale_results(campaign)
    assert outdated["results/f01/uav2/track.manifest.json"] == f"{LOG} has changed"
    assert "results/f01/uav1-uav2/echo.manifest.json" in outdated
    assert "results/f01/uav1-uav1/echo.manifest.json" not in outdated
    assert "results/f01/uav1-uav1/export.manifest.json" in outdated  # through the assessment
    assert list(stale_lines(outdated)) == [
        f"results/f01/uav2/track.manifest.json: out of date, {LOG} has changed",
        f"{len(outdated) - 1} dependent results also out of date",
    ]
    replace_keeping_times(path, data)
    assert stale_results(campaign) == {}


@pytest.mark.slow
def test_changed_samples_with_kept_time_and_size_are_noticed(finished):
    campaign, path = Campaign.load(finished), finished / "raw/f01/uav1.sigmf-data"
    os.utime(path, (1e9, 1e9))
    data = bytearray(path.read_bytes())
    data[1000] ^= 1
    assert stale_results(campaign) == {}
    replace_keeping_times(path, data)
    assert "results/f01/uav1/raw.manifest.json" in stale_results(campaign)


def test_hash_is_cached_per_file_state_and_recomputed_on_request(tmp_path, monkeypatch):
    path = tmp_path / "raw.bin"
    path.write_bytes(bytes(100_000))
    monkeypatch.setattr("apertura.campaign.digests._SETTLED_S", -1.0)
    first, cached = digest_of(tmp_path, "raw.bin"), tmp_path / "results/.hashes/raw.bin.json"
    forged = json.loads(cached.read_text()) | {"sha256": "0" * 64}
    cached.write_text(json.dumps(forged))
    assert digest_of(tmp_path, "raw.bin") == "0" * 64
    assert digest_of(tmp_path, "raw.bin", paranoid=True) == first
    assert digest_of(tmp_path, "raw.bin") == first
    cached.write_text('{"state": 3}')
    assert digest_of(tmp_path, "raw.bin") == first


def test_hash_of_a_recently_written_file_is_not_cached(tmp_path):
    """The file may change again within one tick of the clock, which leaves its modification time unchanged."""
    (tmp_path / "raw.bin").write_bytes(bytes(100_000))
    digest_of(tmp_path, "raw.bin")
    assert not (tmp_path / "results").exists()


def test_file_changed_while_read_is_an_error(tmp_path):
    path = tmp_path / "raw.bin"
    path.write_bytes(bytes(10))
    sources = Sources.of(tmp_path, ["raw.bin"])
    assert set(sources.unchanged()) == {"raw.bin"}
    path.write_bytes(bytes(11))
    with pytest.raises(CampaignError, match=r"raw\.bin: the file changed while it was read"):
        sources.unchanged()


@pytest.mark.slow
def test_copied_results_with_other_times_are_up_to_date(finished, tmp_path):
    copied = copy_writable(finished, tmp_path / "copied")
    for path in copied.rglob("*"):
        os.utime(path, (2e9, 2e9) if path.stat().st_ino % 2 else (1e9, 1e9))
    assert stale_results(Campaign.load(copied)) == {}
    assert damaged_results(Campaign.load(copied)) == {}


@pytest.mark.quick("window")
@pytest.mark.parametrize(
    ("change", "expected", "spared"),
    [
        (lambda document: document.update(campaign="other"), {"scene", "export", "layers"}, {"raw", "track", "echo"}),
        (lambda document: document.update(processing={"window": "none"}), {"profile", "image"}, {"echo", "scene"}),
        (lambda document: document["nodes"]["uav2"].update(time_tag_std_s=1e-3), {"echo"}, {"raw", "track"}),
    ],
    ids=["name", "window", "node"],
)
def test_setting_outdates_only_the_results_that_depend_on_it(finished, change, expected, spared):
    outdated = names(stale_results(edit(finished, change)))
    assert expected <= outdated
    assert not spared & outdated


def test_changed_code_outdates_its_results(finished, monkeypatch):
    def other(campaign, result, *where):
        return ("apertura.common.constants",) if result == "profile" else modules_of(campaign, result, *where)

    monkeypatch.setattr("apertura.workflow.lineage.modules_of", other)
    outdated = stale_results(Campaign.load(finished))
    assert outdated["results/f01/uav1-uav1/profile.manifest.json"] == "the code has changed"
    assert not {"raw", "track", "echo", "scene"} & names(outdated)


@pytest.mark.slow
def test_missing_source_or_damaged_manifest_outdates_a_result(finished):
    campaign = Campaign.load(finished)
    (finished / "results/f01/uav1/track.manifest.json").unlink()
    (finished / "results/cube.manifest.json").write_text("{")
    outdated = stale_results(campaign)
    assert "results/f01/uav1/track.manifest.json is missing" in outdated["results/f01/uav1-uav1/echo.manifest.json"]
    assert outdated["results/cube.manifest.json"].startswith("the manifest is damaged")


@pytest.mark.quick("f01/uav1-uav1/db.tif*", "cube*")
@pytest.mark.parametrize(
    ("file", "manifest"),
    [
        ("f01/uav1-uav1/db.tif", "f01/uav1-uav1/export"),
        ("f01/fused/quicklook.png", "f01/fused/export"),
        ("f01/fused/image.json", "f01/fused/export"),
        ("f01/uav1-uav1/mask.tif", "f01/uav1-uav1/layers"),
        ("coverage.geojson", "coverage"),
        ("map/map.json", "map/map"),
        ("scene.json", "scene"),
        ("f01/assessment.json", "f01/assessment"),
        ("cube.zarr/zarr.json", "cube"),
    ],
)
def test_product_with_one_changed_byte_is_reported(finished, file, manifest):
    path = finished / "results" / file
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert list(damaged_results(Campaign.load(finished))) == [f"results/{manifest}.manifest.json"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "file", ["f01/uav1-uav1/db.tif", "f01/fused/image.json", "f01/uav1-uav1/mask.tif", "coverage.png", "scene.json"]
)
@pytest.mark.parametrize("how", ["edited", "gone"])
def test_edited_or_missing_product_is_out_of_date(finished, file, how):
    path = finished / "results" / file
    if how == "gone":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-1] + b"x")
    outdated = stale_results(Campaign.load(finished))
    reason = "is missing" if how == "gone" else "has changed since it was written"
    assert [reason for reason in outdated.values() if reason] == [f"{path.name} {reason}"]


@pytest.mark.slow
@pytest.mark.parametrize("before", [0, 1])
def test_edited_product_is_kept_under_another_name(finished, before, capsys):
    folder = finished / "results/f01/uav1-uav1"
    for number in range(before):
        (folder / "db.edited.qml").write_text(f"mine {number}")
    (folder / "db.qml").write_text("styled by hand")
    campaign = Campaign.load(finished)
    make_again(campaign, stale_results(campaign), remove=True)
    kept = "db.edited-1.qml" if before else "db.edited.qml"
    assert (folder / kept).read_text() == "styled by hand"
    assert not (folder / "db.qml").exists()
    assert (folder / "db.tif").is_file()
    assert f"kept as results/f01/uav1-uav1/{kept}" in capsys.readouterr().err


@pytest.mark.slow
def test_stage_with_a_missing_array_is_out_of_date(finished):
    shutil.rmtree(finished / "results/f01/uav1-uav1/echo.zarr/path_removed")
    outdated = stale_results(Campaign.load(finished))
    assert outdated["results/f01/uav1-uav1/echo.manifest.json"].endswith(" is missing")


def test_products_without_manifest_are_out_of_date_and_not_summarised(finished):
    for path in finished.rglob("*.manifest.json"):
        path.unlink()
    campaign = Campaign.load(finished)
    assert names(stale_results(campaign)) == {"export", "layers", "tracks", "coverage", "map", "stac", "ro_crate"}
    with pytest.raises(CampaignError, match=r"export\.manifest\.json: no such file"):
        print_summary(campaign)


def test_edited_report_is_refused(finished):
    path = finished / "results/f01/fused/image.json"
    path.write_text(path.read_text().replace("focused", "perfect"))
    with pytest.raises(
        CampaignError,
        match=r"image\.json: the file has changed since it was written; expected the file listed in export\.manifest",
    ):
        print_summary(Campaign.load(finished))


@pytest.mark.parametrize("file", ["scene.json", "f01/assessment.json"])
def test_damaged_document_is_refused(finished, file):
    path = finished / "results" / file
    path.write_text(path.read_text().replace("1", "2", 1))
    from apertura.stages.agreement import assessment_of
    from apertura.stages.scene import settled_scene

    campaign = Campaign.load(finished)
    with pytest.raises(CampaignError, match=r"1 file differs from the manifest; the first .*Delete .*manifest\.json"):
        (settled_scene(campaign), assessment_of(campaign, "f01"))


def test_campaign_is_locked_during_a_run(tmp_path):
    with hold(tmp_path), pytest.raises(CampaignError, match=f"locked by another run: process {os.getpid()}"):
        hold(tmp_path)
    hold(tmp_path).close()


def test_moved_results_are_up_to_date(finished, tmp_path):
    shutil.move(finished, tmp_path / "moved")
    assert stale_results(Campaign.load(tmp_path / "moved")) == {}


# ---- Archived recordings and kept transfer functions ----------------------------------------------------------------

SAMPLES = ["raw/f01/uav1.sigmf-data", "raw/f01/uav2.sigmf-data"]
REMEDY = "expected the recording of node uav2 in flight f01, to recompute results/f01/uav1-uav2/image.manifest.json"


def archive(root):
    for name in SAMPLES:
        (root / name).unlink()
    return Campaign.load(root)


@pytest.mark.slow
def test_archived_recordings_leave_results_up_to_date(finished):
    campaign = archive(finished)
    assert stale_results(campaign) == {}
    assert (absent_files(campaign), wanted_files(campaign, {})) == (SAMPLES, {})
    line = f"recordings are missing and not compared with results: {SAMPLES[0]} and 1 more"
    assert list(absent_lines(campaign)) == [line]
    assert problems(finished, without=["memory"]) == []
    assert Resources(campaign).work("f01", None, "uav1").pulses == 40


def test_check_compares_each_result_with_its_inputs_once(finished_tiny, monkeypatch):
    compared = []
    monkeypatch.setattr("apertura.workflow.stale._reasons", lambda _, result, *__, **___: compared.append(result) or ())
    assert print_findings(finished_tiny.root.real()) == 0
    manifests = [result.manifest for result in compared]
    assert len(manifests) == len(set(manifests)) > 10


@pytest.mark.slow
def test_results_are_up_to_date_without_any_raw_file(finished):
    shutil.rmtree(finished / "raw")
    campaign = Campaign.load(finished)
    assert stale_results(campaign) == {}
    assert {*SAMPLES, LOG, "raw/f01/uav1.track.csv", "raw/codes.npy"} < set(absent_files(campaign))


@pytest.mark.slow
def test_image_is_recomputed_only_from_a_kept_transfer_function(finished):
    campaign = Campaign.load(finished)
    for pair in ("uav1-uav1", "uav1-uav2"):
        transfer.transfer(campaign, "f01", pair)
    archive(finished)
    campaign = state(finished, "processing", engine="numba")
    assert "image" in names(stale_results(campaign))
    assert (wanted_files(campaign, stale_results(campaign)), problems(finished, without=["memory"])) == ({}, [])
    (finished / "results/f01/uav1-uav2/transfer.manifest.json").unlink()
    assert wanted_files(campaign, stale_results(campaign)) == {SAMPLES[1]: "results/f01/uav1-uav2/image.manifest.json"}
    (problem,) = map(str, problems(finished, without=["memory"]))
    assert REMEDY in problem
    assert "processing: {keep: [echo]}" in problem


@pytest.mark.slow
def test_kept_transfer_function_outdates_only_the_crate(finished):
    campaign, kept = Campaign.load(finished), "results/f01/uav1-uav2/transfer.manifest.json"
    assert on_demand(campaign, kept)
    campaign = state(finished, "processing", keep=["echo"])
    assert names(stale_results(campaign)) == {"ro_crate"}  # which lists the kept files and the config
    assert not on_demand(campaign, kept)
    assert any_is_missing(campaign)
    for pair in ("uav1-uav1", "uav1-uav2"):
        transfer.transfer(campaign, "f01", pair)
    assert not any_is_missing(campaign)
    campaign = state(finished, "processing", keep=[])
    assert names(stale_results(campaign)) == {"ro_crate"}
    assert (finished / kept).is_file()


def planned_spacing_m(campaign):
    return expected_scene(without_outdated(campaign), lambda: first_flight(campaign)).grid.spacing_m


@pytest.mark.slow
def test_plan_follows_the_config_and_not_outdated_results(tiny, capsys):
    """With an automatic CRS and a finished grid, the plan uses and reports a changed spacing."""
    campaign = state(tiny, "scene", crs="auto")
    for node in ("uav1", "uav2"):
        ingest.ingest(campaign, "f01", node)
    for pair in ("uav1-uav1", "uav1-uav2"):
        echo.echo(campaign, "f01", pair)
    scene.scene(campaign)
    assert planned_spacing_m(campaign) == 0.1
    print_plan(campaign)
    assert "out of date" not in capsys.readouterr().out
    edited = state(tiny, "scene", spacing_m=0.2)
    assert planned_spacing_m(edited) == 0.2
    print_plan(edited)
    printed = capsys.readouterr().out
    assert "1 result out of date (results/scene.manifest.json): the plan is based on the config" in printed
    assert "pixels of 0.2 m" in " ".join(printed.split())
