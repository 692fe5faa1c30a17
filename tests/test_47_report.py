"""Report of a finished campaign: its plots and values agree with the images."""

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
"""Campaign name with markup characters of reStructuredText, HTML, Jinja and LaTeX."""


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
def test_plots_and_page_are_written_with_manifests(reported):
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
def test_every_plot_states_its_sources(reported, manifest):
    path = reported.result("f01", f"{manifest}.manifest.json")
    listed = read_manifest(path)
    for name in listed["files"]:
        if name.endswith(".png"):
            assert json.loads(read_tags(path.parent / name)["APERTURA_SOURCES"]) == listed["sources"]


@pytest.mark.slow
def test_page_contains_plots_decisions_and_the_name_as_text(reported):
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
def test_report_page_is_reproduced_byte_for_byte(reported):
    path = reported.result("f01", "report.html")
    before = path.read_bytes()
    page(reported, "f01")
    assert path.read_bytes() == before


@pytest.mark.slow
def test_landing_text_contains_no_markup_except_tables(reported):
    texts = landing(reported)
    body = publish_parts(
        "\n\n".join([texts["title"], texts["configuration"], texts["verdicts"], texts["decisions"]]), writer="html"
    )
    assert "system-message" not in body["body"]
    assert "<a " not in body["body"]
    assert "{{ 7*7 }}" in body["body"]
    assert body["body"].count("<table") == 3
    assert "f01 uav1-uav2" in body["body"]


@pytest.mark.slow
def test_sidelink_correction_makes_the_brightest_target_coherent(reported):
    phasors_of = Shown(reported, "f01", "uav1-uav2").phasors()
    before, after = (steadiness(phasors) for phasors in phasors_of.values())
    assert before[1] < 0.4
    assert after[1] > 0.9
    assert list(Shown(reported, "f01", "uav1-uav1").phasors()) == ["as recorded, with the logged tracks"]


@pytest.mark.slow
def test_excluded_pulses_are_those_counted_by_the_image(reported):
    for pair in ("uav1-uav1", "uav1-uav2"):
        shown = Shown(reported, "f01", pair)
        record, counted = shown.record(), shown.echo.attrs["pulses"]
        assert (int(record.kept.sum()), int((~record.kept).sum())) == (counted["used"], counted["dropped"])
        np.testing.assert_allclose(record.time_s, record.sent_s[record.kept])


@pytest.mark.slow
def test_widths_of_the_cuts_are_those_stated_by_the_image(reported):
    shown = Shown(reported, "f01", "uav1-uav2")
    stated = shown.image.attrs["quality"]["brightest"]
    for cut, name in zip(shown.cuts(), ("cross_range", "ground_range"), strict=True):
        assert cut.width_m == pytest.approx(stated[f"{name}_width_m"], abs=1e-4)
        assert cut.decibels[cut.decibels.size // 2] == 0


@pytest.mark.slow
def test_plotted_tracks_are_at_their_positions(reported):
    geometry = Shown(reported, "f01", "uav1-uav2").geometry()
    west, south, east, north = geometry.bounds_m
    assert set(geometry.tracks_m) == {"transmitter", "receiver"}
    assert west < geometry.target_m[0] < east
    assert south < geometry.target_m[1] < north
    assert abs(geometry.target_m[2] - geometry.ground_m) < 1e-3
    heights = geometry.tracks_m["transmitter"][:, 2] - geometry.ground_m
    assert (heights > 2).all()
    assert (heights < 8).all()


@pytest.mark.slow
def test_edited_plot_is_refused_by_the_page(reported):
    path = reported.result("f01", "uav1-uav1", "pictures", "cuts.png")
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + b"x")
    assert "the file has changed since it was written" in complaint(lambda: page(reported, "f01"))
    path.write_bytes(whole)
