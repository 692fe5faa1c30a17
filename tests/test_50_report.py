"""`apertura report` end to end, and its file in a browser without a net."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from folders import copy_writable, edit_config

from apertura.views.verify.chain import print_verified

CHROMIUM = Path("/usr/bin/chromium")
NAME = "`x`_ |y| .. raw:: html {{ 7*7 }} $z$ ../../etc 'a'"


def apertura(*arguments):
    return subprocess.run(
        [Path(sys.executable).with_name("apertura"), *arguments],
        env={**os.environ, "http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"},
        text=True,
        capture_output=True,
        check=False,
    )


@pytest.fixture(scope="module")
def written(_tiny, tmp_path_factory):
    root = copy_writable(_tiny, tmp_path_factory.mktemp("report") / "campaign")
    edit_config(root, lambda document: document.update(campaign=NAME))
    done = apertura("report", root, "--cores", "2")
    assert done.returncode == 0, done.stderr
    return root, done.stdout


@pytest.mark.slow
def test_one_command_writes_the_report_and_a_page_of_every_flight(written):
    root, said = written
    assert said.splitlines()[-2:] == [str(root / "results" / "report.html"), str(root / "results/f01/report.html")]
    assert not list((root / "results").glob(".report*"))
    text = (root / "results" / "report.html").read_text()
    assert text.count("results/f01/uav1-uav2/pictures/phase.png") > 0
    assert str(root) not in text
    (root / "results" / "report.html").write_text("mine")
    done = apertura("report", root, "--cores", "2")
    assert done.returncode == 0, done.stderr
    assert (root / "results" / "report.edited.html").read_text() == "mine"
    assert print_verified(root, quiet=True) == 0


@pytest.mark.slow
def test_a_report_on_results_that_are_stale_is_written_and_listed(written, tmp_path):
    root = copy_writable(written[0], tmp_path / "campaign")
    edit_config(root, lambda document: document.setdefault("processing", {}).update(window="none"))
    done = apertura("report", root, "--cores", "2")
    assert done.returncode == 0, done.stderr
    assert print_verified(root, quiet=True) == 0


@pytest.mark.slow
def test_the_report_opens_without_a_net_and_shows_names_as_text(written):
    if not CHROMIUM.is_file():
        pytest.skip("no /usr/bin/chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright")
    root, _ = written
    asked, errors = [], []
    with playwright.sync_playwright() as browsers:
        browser = browsers.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        sheet = browser.new_page(viewport={"width": 1500, "height": 1000})
        sheet.on("request", lambda request: asked.append(request.url))
        sheet.on("pageerror", lambda error: errors.append(str(error)))
        sheet.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
        sheet.goto((root / "results" / "report.html").as_uri())
        sheet.wait_for_selector("text=Image quality")
        landing = sheet.inner_text("body")
        top = sheet.locator("h1", has_text="7*7").bounding_box()
        links = sheet.locator(".prose a").count()
        sheet.get_by_text("f01", exact=True).first.click()
        sheet.wait_for_selector("text=results section, to be printed")
        menu = sheet.inner_text("body")
        sheet.goto((root / "results" / "f01" / "report.html").as_uri())
        page = sheet.inner_text("h1")
        widths = sheet.eval_on_selector_all("img", "all => all.map(one => one.naturalWidth)")
        browser.close()
    assert NAME in landing
    assert "uav1-uav2" in landing
    assert top["y"] > 0  # nothing of it lies above the screen
    assert links == 0
    assert menu.count("range profiles") == 2
    assert page == f"{NAME}, flight f01"
    assert len(widths) == 16
    assert min(widths) > 500
    assert errors == []
    assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []
