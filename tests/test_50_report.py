"""`apertura report` from end to end, and its page in a browser without network access."""

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
def test_report_command_writes_the_report_and_a_page_per_flight(written):
    root, printed = written
    assert printed.splitlines()[-2:] == [str(root / "results" / "report.html"), str(root / "results/f01/report.html")]
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
def test_report_on_outdated_results_is_written_and_verified(written, tmp_path):
    root = copy_writable(written[0], tmp_path / "campaign")
    edit_config(root, lambda document: document.setdefault("processing", {}).update(window="none"))
    done = apertura("report", root, "--cores", "2")
    assert done.returncode == 0, done.stderr
    assert print_verified(root, quiet=True) == 0


@pytest.mark.slow
def test_report_opens_offline_and_shows_names_as_text(written):
    if not CHROMIUM.is_file():
        pytest.skip("no /usr/bin/chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright")
    root, _ = written
    requests, errors = [], []
    with playwright.sync_playwright() as browsers:
        browser = browsers.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        browser_page = browser.new_page(viewport={"width": 1500, "height": 1000})
        browser_page.on("request", lambda request: requests.append(request.url))
        browser_page.on("pageerror", lambda error: errors.append(str(error)))
        browser_page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        browser_page.goto((root / "results" / "report.html").as_uri())
        browser_page.wait_for_selector("text=Image quality")
        landing = browser_page.inner_text("body")
        top = browser_page.locator("h1", has_text="7*7").bounding_box()
        links = browser_page.locator(".prose a").count()
        browser_page.get_by_text("f01", exact=True).first.click()
        browser_page.wait_for_selector("text=results section, to be printed")
        menu = browser_page.inner_text("body")
        browser_page.goto((root / "results" / "f01" / "report.html").as_uri())
        page = browser_page.inner_text("h1")
        widths = browser_page.eval_on_selector_all("img", "all => all.map(one => one.naturalWidth)")
        browser.close()
    assert NAME in landing
    assert "uav1-uav2" in landing
    assert top["y"] > 0  # the heading is not above the viewport
    assert links == 0
    assert menu.count("range profiles") == 2
    assert page == f"{NAME}, flight f01"
    assert len(widths) == 16
    assert min(widths) > 500
    assert errors == []
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []
