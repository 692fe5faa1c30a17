"""The report of a finished campaign: what it shows agrees with what its images say."""

import json

import numpy as np
import pytest
from docutils.core import publish_parts
from folders import complaint, copy_writable, edit_config

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_document, read_manifest
from apertura.views.report import PICTURES
from apertura.views.report.cuts_and_profiles import steadiness
from apertura.views.report.pictures import Shown, pictures, pictures_fused
from apertura.views.report.step import landing, page
from apertura.views.verify.products import read_tags

NAME = "`x`_ |y| .. raw:: html {{ 7*7 }} $\u00b5_\u03b1$ ../../etc 'a'"
"""All that a campaign's name may hold."""


@pytest.fixture(scope="module")
def reported(finished_tiny, tmp_path_factory):
    root = copy_writable(finished_tiny.root, tmp_path_factory.mktemp("report") / "campaign")
    edit_config(root, lambda document: document.update(campaign=NAME))
    campaign = Campaign.load(root)
    for pair in ("uav1-uav1", "uav1-uav2"):
        pictures(campaign, "f01", pair)
    pictures_fused(campaign, "f01")
    page(campaign, "f01")
    return campaign


@pytest.mark.slow
def test_every_picture_and_the_page_are_written_and_listed_with_what_they_are_made_from(reported):
    listed = read_manifest(reported.result("f01", "uav1-uav2", "pictures.manifest.json"))
    assert set(listed["files"]) == {f"pictures/{name}.png" for name in PICTURES}
    assert "results/f01/uav1/raw.manifest.json" in listed["sources"]
    listed = read_manifest(reported.result("f01", "page.manifest.json"))
    assert set(listed["files"]) == {"report.html"}
    assert {f"results/f01/{name}/pictures.manifest.json" for name in ("uav1-uav1", "fused")} <= listed["sources"].keys()
    listed = read_manifest(reported.result("f01", "fused", "pictures.manifest.json"))
    assert set(listed["files"]) == {"panels.png", "sum_cuts.png"}


@pytest.mark.slow
@pytest.mark.parametrize("manifest", ["uav1-uav2/pictures", "fused/pictures"])
def test_every_picture_says_what_it_was_made_from(reported, manifest):
    path = reported.result("f01", f"{manifest}.manifest.json")
    listed = read_manifest(path)
    for name in listed["files"]:
        if name.endswith(".png"):
            assert json.loads(read_tags(path.parent / name)["APERTURA_SOURCES"]) == listed["sources"]


@pytest.mark.slow
def test_the_page_holds_every_picture_every_decision_and_the_campaigns_name_as_text(reported):
    html = reported.result("f01", "report.html").read_text()
    report = reported.result("f01", "uav1-uav2", "image.json")
    assert html.count('src="data:image/png;base64,') == 2 * (len(PICTURES) + 1) + 2
    assert "http" not in html.replace("http-equiv", "")
    assert "{{ 7*7 }}" in html
    assert "{{ 49 }}" not in html
    for name in open_document(reported.result("f01", "assessment.json"))["pairs"]:
        assert f"<h2>Pair {name}</h2>" in html
    assert all(f"<td>{name.replace('_', ' ')}</td>" in html for name in _models(report))


def _models(path):
    return json.loads(path.read_text())["models"]


@pytest.mark.slow
def test_the_same_results_give_the_same_bytes(reported):
    path = reported.result("f01", "report.html")
    before = path.read_bytes()
    page(reported, "f01")
    assert path.read_bytes() == before


@pytest.mark.slow
def test_the_landing_text_is_no_markup_but_its_tables(reported):
    told = landing(reported)
    body = publish_parts(
        "\n\n".join([told["title"], told["asked"], told["verdicts"], told["decisions"]]), writer="html"
    )
    assert "system-message" not in body["body"]
    assert "<a " not in body["body"]
    assert "{{ 7*7 }}" in body["body"]
    assert body["body"].count("<table") == 3
    assert "f01 uav1-uav2" in body["body"]


@pytest.mark.slow
def test_the_brightest_target_adds_up_once_the_sidelink_took_the_clocks_out(reported):
    found = Shown(reported, "f01", "uav1-uav2").phasors()
    before, after = (steadiness(phasors) for phasors in found.values())
    assert before[1] < 0.4
    assert after[1] > 0.9
    assert list(Shown(reported, "f01", "uav1-uav1").phasors()) == ["as recorded, tracks from the logs"]


@pytest.mark.slow
def test_pulses_left_out_are_those_that_the_image_counts(reported):
    for pair in ("uav1-uav1", "uav1-uav2"):
        shown = Shown(reported, "f01", pair)
        record, counted = shown.record(), shown.echo.attrs["pulses"]
        assert (int(record.kept.sum()), int((~record.kept).sum())) == (counted["used"], counted["dropped"])
        np.testing.assert_allclose(record.time_s, record.sent_s[record.kept])


@pytest.mark.slow
def test_widths_of_the_cuts_are_those_that_the_image_states(reported):
    shown = Shown(reported, "f01", "uav1-uav2")
    stated = shown.image.attrs["quality"]["brightest"]
    for cut, name in zip(shown.cuts(), ("cross_range", "ground_range"), strict=True):
        assert cut.width_m == pytest.approx(stated[f"{name}_width_m"], abs=1e-4)
        assert cut.decibels[cut.decibels.size // 2] == 0


@pytest.mark.slow
def test_tracks_are_drawn_where_the_flight_was(reported):
    flown = Shown(reported, "f01", "uav1-uav2").geometry()
    west, south, east, north = flown.bounds_m
    assert set(flown.tracks_m) == {"transmitter", "receiver"}
    assert west < flown.target_m[0] < east
    assert south < flown.target_m[1] < north
    assert abs(flown.target_m[2] - flown.ground_m) < 1e-3
    heights = flown.tracks_m["transmitter"][:, 2] - flown.ground_m
    assert (heights > 2).all()
    assert (heights < 8).all()


@pytest.mark.slow
def test_a_picture_changed_by_hand_does_not_reach_the_page(reported):
    path = reported.result("f01", "uav1-uav1", "pictures", "cuts.png")
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + b"x")
    assert "the file has changed since it was written" in complaint(lambda: page(reported, "f01"))
    path.write_bytes(whole)
