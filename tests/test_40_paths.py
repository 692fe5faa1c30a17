"""Nothing leaves the campaign folder: neither by a name, nor through a link, nor by what a name does elsewhere."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from folders import copy_writable, require_files

from apertura.campaign.config.config import validated
from apertura.campaign.folder import Campaign
from apertura.check import problems
from apertura.check.examination import Examination
from apertura.check.files import check_links
from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.core.geometry.geodesy import local_crs
from apertura.stages import ingest
from apertura.workflow import rule_inputs
from apertura.workflow.jobs import Jobs
from apertura.workflow.lineage import results_of


def edit(root, key, value, *, load=True):
    path = root / "config" / "config.yaml"
    document = yaml.safe_load(path.read_text())
    section = document
    *way, last = key.split(".")
    for name in way:
        section = section[name]
    section[last] = value
    path.write_text(yaml.safe_dump(document))
    return Campaign.load(root) if load else None


@pytest.mark.parametrize(
    "name", ["../codes.npy", "raw/../../codes.npy", "/etc/passwd", "raw\\codes.npy", "raw/\x1b[2J"]
)
@pytest.mark.parametrize("key", ["waveform.codes", "scene.dem", "scene.geoid"])
def test_a_name_that_leaves_the_folder_is_refused_with_its_key(tiny, key, name):
    (tiny.parent / "codes.npy").write_bytes((tiny / "raw/codes.npy").read_bytes())
    if key == "scene.dem":
        edit(tiny, "scene.dem_datum", "ellipsoid", load=False)
    with pytest.raises(CampaignError, match=rf"config\.yaml: {key}: path .*inside the campaign folder") as refused:
        require_files(edit(tiny, key, name))
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(
    "file", ["raw/f01/uav1.track.csv", "raw/f01/uav1.sigmf-data", "raw/codes.npy", "config/config.yaml", "raw/f01"]
)
def test_an_input_that_is_a_link_is_refused(tiny, tmp_path, file):
    path, elsewhere = tiny / file, tmp_path / "elsewhere"
    shutil.move(path, elsewhere)
    path.symlink_to(elsewhere)
    with pytest.raises(CampaignError, match="a symbolic link"):
        require_files(Campaign.load(tiny))


def test_a_campaign_folder_may_itself_be_reached_through_a_link(tiny, tmp_path):
    (tmp_path / "link").symlink_to(tiny)
    require_files(Campaign.load(tmp_path / "link"))


def test_nothing_is_written_or_deleted_through_linked_results(tiny, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "f01/uav1/raw.zarr").mkdir(parents=True)
    (tiny / "results").symlink_to(elsewhere)
    campaign = Campaign.load(tiny)
    with pytest.raises(CampaignError, match="a symbolic link"):
        ingest.ingest(campaign, "f01", "uav1")
    assert [path.name for path in elsewhere.rglob("*")] == ["f01", "uav1", "raw.zarr"]
    assert len(list(check_links(Examination(campaign)))) == 1


@pytest.mark.parametrize("name", ["f01", "f01/uav1-uav1/image.zarr.wip/image/c", "logs", "f01/uav1-uav1/mask.tif"])
def test_a_link_anywhere_below_the_results_is_named(tiny, tmp_path, name):
    path = tiny / "results" / name
    path.parent.mkdir(parents=True)
    path.symlink_to(tmp_path)
    assert [str(found.where) for found in check_links(Examination(Campaign.load(tiny)))] == [str(path)]


def test_results_without_links_are_let_be(finished_tiny):
    assert list(check_links(Examination(finished_tiny))) == []


@pytest.mark.parametrize(
    "name",
    ["scene.json", "cube.manifest.json", "Fused", "cube.zarr", "x.ZARR", "a.tif", "raw.zarr.wip", "logs", "x" * 65],
)
def test_a_flight_named_as_a_file_of_the_results_is_refused(tiny, name):
    path = tiny / "config" / "flights.tsv"
    path.write_text(path.read_text().replace("f01", name))
    with pytest.raises(CampaignError, match=r"flights\.tsv: line 2: name"):
        Campaign.load(tiny)


@pytest.mark.parametrize(
    "name", ['a"],b', "<script>", "\x1b[31mred", "two\nlines", "", "x" * 121, "back\\slash", "a & b"]
)
def test_a_campaign_name_that_wkt_html_or_a_terminal_would_read_is_refused(tiny, name):
    document = yaml.safe_load((tiny / "config/config.yaml").read_text()) | {"campaign": name}
    with pytest.raises(CampaignError, match="campaign") as refused:
        validated(document, where="config.yaml")
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("name", ["Bodensee, Süd (2. Flug)", "it's", "日本", "a/b"])
def test_other_names_stay_as_they_are(name):
    assert name in local_crs(name)


def test_a_copy_of_the_results_elsewhere_is_no_link(finished_tiny, tmp_path):
    assert list(check_links(Examination(Campaign.load(copy_writable(finished_tiny.root, tmp_path / "copy"))))) == []


def test_what_lies_outside_the_folder_is_not_opened_by_a_check(tiny):
    (tiny.parent / "codes.npy").write_bytes(b"no codes at all")
    path = tiny / "config" / "config.yaml"
    document = yaml.safe_load(path.read_text())
    document["waveform"]["codes"] = "../codes.npy"
    path.write_text(yaml.safe_dump(document))
    (line,) = map(str, problems(tiny))
    assert "waveform.codes: path '../codes.npy' leads out of the campaign folder" in line


# Recordings that are kept elsewhere


@pytest.fixture
def elsewhere(tiny, tmp_path):
    """The folder of the recordings of `tiny`, outside of it, as its config states."""
    shutil.move(tiny / "raw", tmp_path / "archive")
    edit(tiny, "raw_root", str(tmp_path / "archive"), load=False)
    return tmp_path / "archive"


def test_recordings_are_read_where_raw_root_says_and_keep_their_names(tiny, elsewhere):
    assert problems(tiny, without=["disk", "memory"]) == []
    campaign = Campaign.load(tiny)
    ingest.ingest(campaign, "f01", "uav1")
    recorded = json.loads((tiny / "results/f01/uav1/raw.manifest.json").read_text())["sources"]
    assert recorded["raw/f01/uav1.sigmf-data"] == sha256_file(elsewhere / "f01/uav1.sigmf-data")
    assert not (tiny / "raw").exists()
    wildcards = SimpleNamespace(flight="f01", node="uav1")
    listed = Jobs(replace(campaign, root=Path())).files(rule_inputs.recording)(wildcards)
    assert str(elsewhere / "f01/uav1.sigmf-data") in listed  # as Snakemake looks for it


def test_where_recordings_lie_changes_no_result(tiny, tmp_path):
    before = [result.settings_sha256 for _, result in results_of(Campaign.load(tiny))]
    shutil.move(tiny / "raw", tmp_path / "archive")
    moved = edit(tiny, "raw_root", str(tmp_path / "archive"))
    assert [result.settings_sha256 for _, result in results_of(moved)] == before


def test_a_missing_file_of_raw_root_is_named_where_it_should_be(tiny, elsewhere):
    (elsewhere / "f01/uav2.sigmf-data").unlink()
    found = [str(one) for one in problems(tiny, without=["disk", "memory"])]
    assert [line for line in found if line.startswith(f"{elsewhere}/f01/uav2.sigmf-data: no such file")]


def test_a_link_in_raw_root_is_refused_and_its_own_path_may_be_one(tiny, elsewhere, tmp_path):
    (tmp_path / "link").symlink_to(elsewhere)
    edit(tiny, "raw_root", str(tmp_path / "link"), load=False)
    assert problems(tiny, without=["disk", "memory"]) == []
    shutil.move(elsewhere / "codes.npy", tmp_path / "codes.npy")
    (elsewhere / "codes.npy").symlink_to(tmp_path / "codes.npy")
    assert any("codes.npy: a symbolic link" in str(one) for one in problems(tiny, without=["disk", "memory"]))


@pytest.mark.parametrize(
    ("stated", "found"),
    [("/proc/nowhere", "is not a folder"), ("raw", "must be the absolute path"), ("/a/../b", "without")],
)
def test_a_raw_root_that_is_no_folder_is_one_message(tiny, stated, found):
    edit(tiny, "raw_root", stated, load=False)
    assert any(found in str(one) and "raw_root" in str(one) for one in problems(tiny))


def test_recordings_in_two_places_are_refused(tiny, tmp_path):
    shutil.copytree(tiny / "raw", tmp_path / "archive")
    edit(tiny, "raw_root", str(tmp_path / "archive"), load=False)
    assert any("raw/ contains files" in str(one) for one in problems(tiny))
