"""Nothing stale: results say what they were made from, and another file, setting or code is told by its hash."""

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
    """The tiny campaign with all its results, to be spoilt at will."""
    return copy_writable(finished_tiny.root, tmp_path / "finished")


def edit(root, change):
    path = root / "config" / "config.yaml"
    document = yaml.safe_load(path.read_text())
    change(document)
    path.write_text(yaml.safe_dump(document))
    return Campaign.load(root)


def replace_keeping_times(path, data):
    """What `rsync -a` and `cp -p` do: other bytes, the old time of modification."""
    before = path.stat()
    beside = path.with_name("beside")
    beside.write_bytes(data)
    os.utime(beside, ns=(before.st_atime_ns, before.st_mtime_ns))
    beside.replace(path)
    assert path.stat().st_mtime_ns == before.st_mtime_ns


def names(stale):
    """Which results, without their places."""
    return {Path(manifest).name.partition(".")[0] for manifest in stale}


def test_every_result_records_what_it_was_made_from_and_none_is_stale(finished_tiny):
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
def test_a_log_replaced_under_its_old_time_is_noticed_with_all_that_stands_on_it(finished):
    campaign, path = Campaign.load(finished), finished / LOG
    data = path.read_bytes()
    replace_keeping_times(path, data.replace(b"8", b"9", 1))
    found = stale_results(campaign)
    assert found["results/f01/uav2/track.manifest.json"] == f"{LOG} has changed"
    assert "results/f01/uav1-uav2/echo.manifest.json" in found
    assert "results/f01/uav1-uav1/echo.manifest.json" not in found
    assert "results/f01/uav1-uav1/export.manifest.json" in found  # through the assessment
    assert list(stale_lines(found)) == [
        f"results/f01/uav2/track.manifest.json: out of date, {LOG} has changed",
        f"{len(found) - 1} dependent results out of date as well",
    ]
    replace_keeping_times(path, data)
    assert stale_results(campaign) == {}


def test_samples_replaced_under_their_old_time_and_size_are_noticed_although_their_hash_is_kept(finished):
    campaign, path = Campaign.load(finished), finished / "raw/f01/uav1.sigmf-data"
    os.utime(path, (1e9, 1e9))
    data = bytearray(path.read_bytes())
    data[1000] ^= 1
    assert stale_results(campaign) == {}
    replace_keeping_times(path, data)
    assert "results/f01/uav1/raw.manifest.json" in stale_results(campaign)


def test_a_hash_is_taken_once_per_state_of_a_file_and_again_when_asked(tmp_path, monkeypatch):
    path = tmp_path / "raw.bin"
    path.write_bytes(bytes(100_000))
    monkeypatch.setattr("apertura.campaign.digests._SETTLED_S", -1.0)
    first, kept = digest_of(tmp_path, "raw.bin"), tmp_path / "results/.hashes/raw.bin.json"
    forged = json.loads(kept.read_text()) | {"sha256": "0" * 64}
    kept.write_text(json.dumps(forged))
    assert digest_of(tmp_path, "raw.bin") == "0" * 64
    assert digest_of(tmp_path, "raw.bin", paranoid=True) == first
    assert digest_of(tmp_path, "raw.bin") == first
    kept.write_text('{"state": 3}')
    assert digest_of(tmp_path, "raw.bin") == first


def test_a_file_that_has_just_been_written_is_hashed_each_time(tmp_path):
    """It may change again within one tick of the clock, and no time would tell."""
    (tmp_path / "raw.bin").write_bytes(bytes(100_000))
    digest_of(tmp_path, "raw.bin")
    assert not (tmp_path / "results").exists()


def test_what_changes_while_it_is_read_is_no_source(tmp_path):
    path = tmp_path / "raw.bin"
    path.write_bytes(bytes(10))
    sources = Sources.of(tmp_path, ["raw.bin"])
    assert set(sources.unchanged()) == {"raw.bin"}
    path.write_bytes(bytes(11))
    with pytest.raises(CampaignError, match=r"raw\.bin: the file changed while it was read"):
        sources.unchanged()


@pytest.mark.slow
def test_results_copied_with_other_times_and_inodes_are_not_stale(finished, tmp_path):
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
def test_a_setting_makes_stale_what_it_matters_to(finished, change, expected, spared):
    found = names(stale_results(edit(finished, change)))
    assert expected <= found
    assert not spared & found


def test_other_code_makes_stale_what_it_makes(finished, monkeypatch):
    def other(campaign, result, *where):
        return ("apertura.common.constants",) if result == "profile" else modules_of(campaign, result, *where)

    monkeypatch.setattr("apertura.workflow.lineage.modules_of", other)
    found = stale_results(Campaign.load(finished))
    assert found["results/f01/uav1-uav1/profile.manifest.json"] == "its code has changed"
    assert not {"raw", "track", "echo", "scene"} & names(found)


def test_a_result_without_its_source_or_with_a_damaged_manifest_is_stale(finished):
    campaign = Campaign.load(finished)
    (finished / "results/f01/uav1/track.manifest.json").unlink()
    (finished / "results/cube.manifest.json").write_text("{")
    found = stale_results(campaign)
    assert "results/f01/uav1/track.manifest.json is missing" in found["results/f01/uav1-uav1/echo.manifest.json"]
    assert found["results/cube.manifest.json"].startswith("its manifest is damaged")


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
def test_a_product_of_which_one_byte_differs_is_named(finished, file, manifest):
    path = finished / "results" / file
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert list(damaged_results(Campaign.load(finished))) == [f"results/{manifest}.manifest.json"]


@pytest.mark.quick("edited-f01/uav1-uav1/db.tif", "gone-scene.json")
@pytest.mark.parametrize(
    "file", ["f01/uav1-uav1/db.tif", "f01/fused/image.json", "f01/uav1-uav1/mask.tif", "coverage.png", "scene.json"]
)
@pytest.mark.parametrize("how", ["edited", "gone"])
def test_a_product_or_document_that_is_edited_or_gone_is_made_again(finished, file, how):
    path = finished / "results" / file
    if how == "gone":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-1] + b"x")
    found = stale_results(Campaign.load(finished))
    reason = "is missing" if how == "gone" else "has changed since it was written"
    assert [reason for reason in found.values() if reason] == [f"{path.name} {reason}"]


@pytest.mark.quick("0")
@pytest.mark.parametrize("before", [0, 1])
def test_what_was_edited_by_hand_is_kept_beside_what_is_made_again(finished, before, capsys):
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


def test_a_stage_of_which_a_chunk_is_gone_is_made_again(finished):
    shutil.rmtree(finished / "results/f01/uav1-uav1/echo.zarr/path_removed")
    found = stale_results(Campaign.load(finished))
    assert found["results/f01/uav1-uav1/echo.manifest.json"].endswith(" is missing")


def test_products_without_their_manifest_are_stale_and_their_report_is_not_believed(finished):
    for path in finished.rglob("*.manifest.json"):
        path.unlink()
    campaign = Campaign.load(finished)
    assert names(stale_results(campaign)) == {"export", "layers", "tracks", "coverage", "map", "stac", "ro_crate"}
    with pytest.raises(CampaignError, match=r"export\.manifest\.json: no such file"):
        print_summary(campaign)


def test_a_report_that_was_edited_is_not_believed(finished):
    path = finished / "results/f01/fused/image.json"
    path.write_text(path.read_text().replace("focused", "perfect"))
    with pytest.raises(
        CampaignError,
        match=r"image\.json: the file has changed since it was written; expected the file listed in export\.manifest",
    ):
        print_summary(Campaign.load(finished))


@pytest.mark.parametrize("file", ["scene.json", "f01/assessment.json"])
def test_a_damaged_document_is_not_read(finished, file):
    path = finished / "results" / file
    path.write_text(path.read_text().replace("1", "2", 1))
    from apertura.stages.agreement import assessment_of
    from apertura.stages.scene import settled_scene

    campaign = Campaign.load(finished)
    with pytest.raises(CampaignError, match=r"1 file differs from the manifest, first .*Delete .*manifest\.json"):
        (settled_scene(campaign), assessment_of(campaign, "f01"))


def test_a_campaign_is_held_by_one_run_and_free_when_it_ends(tmp_path):
    with hold(tmp_path), pytest.raises(CampaignError, match=f"locked by another run: process {os.getpid()}"):
        hold(tmp_path)
    hold(tmp_path).close()


def test_results_moved_into_another_folder_are_not_stale(finished, tmp_path):
    shutil.move(finished, tmp_path / "moved")
    assert stale_results(Campaign.load(tmp_path / "moved")) == {}


# ---- Recordings that lie elsewhere, and what was kept of them -------------------------------------------------------

SAMPLES = ["raw/f01/uav1.sigmf-data", "raw/f01/uav2.sigmf-data"]
TOLD = "expected the recording of node uav2 in flight f01, to recompute results/f01/uav1-uav2/image.manifest.json"


def archive(root):
    for name in SAMPLES:
        (root / name).unlink()
    return Campaign.load(root)


def test_recordings_that_lie_elsewhere_overtake_nothing_and_nothing_is_wrong(finished):
    campaign = archive(finished)
    assert stale_results(campaign) == {}
    assert (absent_files(campaign), wanted_files(campaign, {})) == (SAMPLES, {})
    assert list(absent_lines(campaign)) == [f"missing recordings, not compared with results: {SAMPLES[0]} and 1 more"]
    assert problems(finished, without=["memory"]) == []
    assert Resources(campaign).work("f01", None, "uav1").pulses == 40


def test_a_check_compares_results_with_their_inputs_once(finished_tiny, monkeypatch):
    compared = []
    monkeypatch.setattr("apertura.workflow.stale._reasons", lambda _, result, *__, **___: compared.append(result) or ())
    assert print_findings(finished_tiny.root.real()) == 0
    manifests = [result.manifest for result in compared]
    assert len(manifests) == len(set(manifests)) > 10


def test_results_are_told_from_stale_ones_where_all_of_raw_was_left_behind(finished):
    shutil.rmtree(finished / "raw")
    campaign = Campaign.load(finished)
    assert stale_results(campaign) == {}
    assert {*SAMPLES, LOG, "raw/f01/uav1.track.csv", "raw/codes.npy"} < set(absent_files(campaign))


@pytest.mark.slow
def test_an_image_is_made_again_of_what_was_kept_of_a_recording_and_of_nothing_else(finished):
    campaign = Campaign.load(finished)
    for pair in ("uav1-uav1", "uav1-uav2"):
        transfer.transfer(campaign, "f01", pair)
    archive(finished)
    campaign = state(finished, "processing", engine="numba")
    assert "image" in names(stale_results(campaign))
    assert (wanted_files(campaign, stale_results(campaign)), problems(finished, without=["memory"])) == ({}, [])
    (finished / "results/f01/uav1-uav2/transfer.manifest.json").unlink()
    assert wanted_files(campaign, stale_results(campaign)) == {SAMPLES[1]: "results/f01/uav1-uav2/image.manifest.json"}
    (told,) = map(str, problems(finished, without=["memory"]))
    assert TOLD in told
    assert "processing: {keep: [echo]}" in told


def test_what_is_kept_overtakes_no_other_result_whether_it_is_asked_for_or_no_longer(finished):
    campaign, kept = Campaign.load(finished), "results/f01/uav1-uav2/transfer.manifest.json"
    assert on_demand(campaign, kept)
    campaign = state(finished, "processing", keep=["echo"])
    assert names(stale_results(campaign)) == {"ro_crate"}  # which lists it, and the config
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
def test_a_plan_follows_the_config_and_not_results_that_are_out_of_date(tiny, capsys):
    """A finished grid with an automatic CRS: after an edit of the spacing the plan is of the new one, and says so."""
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
    assert "1 result out of date (results/scene.manifest.json): plan from the config" in printed
    assert "pixels of 0.2 m" in " ".join(printed.split())
