"""The map in a browser: what it draws, tells and measures, and that it asks no other host for anything."""

import io
import json
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from folders import copy_writable, run_steps
from matplotlib.image import imread
from pyproj import Transformer

from apertura.simulation import preset, simulate
from apertura.webmap.page import is_built

APERTURA = Path(sys.executable).parent / "apertura"
CHROMIUM = Path("/usr/bin/chromium")
HOSTILE = "\"><img src=x onerror=document.title='hacked'><script>document.title='hacked'</script>"
SOFTWARE_GL = (
    *("--no-sandbox", "--no-first-run", "--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
)
NO_GL = ("--no-sandbox", "--disable-gpu", "--disable-3d-apis")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CHROMIUM.exists(), reason="no /usr/bin/chromium: the page is not tried in a browser"),
    pytest.mark.skipif(not is_built(), reason="the page is not bundled: `make webmap` needs npm"),
]


@contextmanager
def serving(root):
    """Run `apertura map` as a person would, and end it with Ctrl-C."""
    command = [APERTURA, "map", root]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process.stdout.readline().strip()
        finally:
            process.send_signal(signal.SIGINT)
            _, complaints = process.communicate(timeout=20)
    assert (process.returncode, complaints) == (0, "")


@pytest.fixture(scope="module")
def tool():
    with pytest.importorskip("playwright.sync_api").sync_playwright() as tool:
        yield tool


@contextmanager
def browsing(tool, arguments):
    browser = tool.chromium.launch(executable_path=CHROMIUM, headless=True, args=list(arguments))
    try:
        yield browser
    finally:
        browser.close()


@contextmanager
def shown(browser, address, *, size=(1000, 700), drawn=True):
    """Yield the page and what it should not do: errors, and requests to other hosts."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    wrong = []
    page.on("console", lambda said: wrong.append(said.text) if said.type in {"error", "warning"} else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    ours = (address.partition("/map/")[0], "data:", "blob:")
    page.on("request", lambda asked: None if asked.url.startswith(ours) else wrong.append(asked.url))
    page.goto(address)
    if drawn:
        page.wait_for_selector("html[data-drawn]", timeout=20_000)
    try:
        yield page, wrong
    finally:
        page.close()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The demo of 300 pulses, whose targets do not blur into each other."""
    return run_steps(simulate(tmp_path_factory.mktemp("map") / "campaign", preset("demo"), seed=1))


@pytest.fixture(scope="module")
def address(finished):
    with serving(finished.root) as address:
        yield address


@pytest.fixture(scope="module")
def browser(tool):
    with browsing(tool, SOFTWARE_GL) as browser:
        yield browser


def pixels(page):
    """Grey values of the map's picture, as the reader sees it, by a canvas of the test's own."""
    return np.asarray(imread(io.BytesIO(page.locator("#view").screenshot()))[..., :3])


@pytest.mark.parametrize("size", [(1000, 700), (800, 600), (390, 844)])
def test_the_image_is_drawn_and_no_other_host_is_asked(browser, address, size):
    with shown(browser, f"{address}#over=", size=size) as (page, wrong):
        page.wait_for_timeout(300)
        seen = pixels(page)
        assert wrong == []
        assert page.locator("#notices").inner_text() == ""
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    rows, columns = seen.shape[:2]
    middle = seen[rows // 4 : 3 * rows // 4, columns // 4 : 3 * columns // 4]
    assert middle.max() > 0.9  # the peak is white
    assert middle.std() > 0.05


@pytest.mark.parametrize("image", ["f01/uav1-uav1&layer=db.tif", "f01/uav1-uav2&layer=db.tif", "f01/fused"])
def test_a_targets_coordinates_read_from_the_page_are_within_a_pixel_of_the_truth(browser, address, finished, image):
    truth = json.loads((finished.root / "truth.json").read_text())["targets"]
    spacing_m = finished.settings.scene.spacing_m
    with shown(browser, f"{address}#image={image}") as (page, wrong):
        for number, target in enumerate(truth):
            row = page.locator("#targets li", has_text=f"target {number}")
            row.locator("button").click()
            peak = row.locator(".peak[data-east]")
            peak.wait_for(timeout=10_000)
            found = [float(peak.get_attribute(f"data-{axis}")) for axis in ("east", "north")]
            assert found == pytest.approx((target["x"], target["y"]), abs=spacing_m / 4)
        page.wait_for_timeout(500)  # the map has come to the last target
        box = page.locator("#map").bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.locator("#value", has_text="dB").wait_for(timeout=10_000)
        east, north = (float(word) for word in page.inner_text("#place").split() if word[0].isdigit())
        latitude, longitude = (float(one.strip(" °NE")) for one in page.inner_text("#geographic").split("°")[:2])
        assert wrong == []
    assert (east, north) == pytest.approx((truth[-1]["x"], truth[-1]["y"]), abs=spacing_m)
    to_wgs84 = Transformer.from_crs("EPSG:32632", "EPSG:4326")
    assert (latitude, longitude) == pytest.approx(to_wgs84.transform(east, north), abs=2e-8)


@pytest.mark.parametrize("number", [0, 3])
def test_a_target_is_drawn_where_it_is(browser, address, finished, number):
    target = json.loads((finished.root / "truth.json").read_text())["targets"][number]
    metres, spacing_m = 0.005, finished.settings.scene.spacing_m
    view = f"{target['x']},{target['y']},{metres}"
    with shown(browser, f"{address}#image=f01/uav1-uav1&layer=db.tif&over=&view={view}") as (page, wrong):
        peak_db = float(page.inner_text("#high-value").split()[0].replace("−", "-"))
    level = peak_db + 20 * np.log10(target["amplitude"]) - 6
    link = f"{address}#image=f01/uav1-uav1&layer=db.tif&over=&view={view}&stretch={level},{level + 0.1}"
    with shown(browser, link) as (page, wrong):
        page.wait_for_timeout(300)
        seen = pixels(page).mean(axis=-1) > 0.99
        assert wrong == []
    rows, columns = np.nonzero(seen)
    middle = [(size - 1) / 2 for size in seen.shape]
    near = np.hypot(rows - middle[0], columns - middle[1]) * metres < 0.5
    assert near.sum() > 1000
    off = np.array([rows[near].mean() - middle[0], columns[near].mean() - middle[1]]) * metres
    assert np.abs(off).max() < spacing_m / 2, off


def test_a_link_shows_what_it_was_taken_from_and_a_wrong_one_shows_the_map(browser, address, finished):
    west, south, east, north = finished.settings.scene.bounds_m
    middle = (west + east) / 2, (south + north) / 2
    line = f"{middle[0] - 1},{middle[1]},{middle[0] + 1},{middle[1]}"
    asked = (
        f"image=f01/uav1-uav2&layer=incidence.tif&stretch=40,60&over=mask&view={middle[0]},{middle[1]},0.01&line={line}"
    )
    with shown(browser, f"{address}#{asked}") as (page, wrong):
        page.wait_for_selector("#plot path")
        assert page.input_value("#image") == "f01/uav1-uav2"
        assert page.input_value("#layer") == "incidence.tif"
        assert page.inner_text("#low-value") == "40 deg"
        assert page.is_checked("#overlays label:nth-child(1) input")
        assert not page.is_checked("#overlays label:nth-child(2) input")
        again = page.evaluate("location.hash")
        assert wrong == []
    with shown(browser, address + again) as (page, _):
        page.wait_for_selector("#plot path")
        assert page.evaluate("location.hash") == again
    with shown(browser, f"{address}#image=x&layer=../y&stretch=a,b&view=1,2,-3&line=1,2&over=__proto__") as (
        page,
        wrong,
    ):
        assert page.input_value("#layer") == "coherent_db.tif"
        assert wrong == []


def test_the_cross_section_is_drawn_by_two_clicks_and_saved(browser, address):
    with shown(browser, f"{address}#over=") as (page, wrong):
        page.click("#draw")
        box = page.locator("#map").bounding_box()
        for share in (0.35, 0.65):
            page.mouse.click(box["x"] + share * box["width"], box["y"] + box["height"] / 2)
        page.wait_for_selector("#plot path.cut")
        with page.expect_download() as download:
            page.click("#csv")
        header, *rows = Path(download.value.path()).read_text().splitlines()
        assert wrong == []
    assert header == "distance_m,easting_m,northing_m,longitude_deg,latitude_deg,value_db"
    first, last = ([float(word) for word in row.split(",")] for row in (rows[0], rows[-1]))
    assert first[0] == 0
    assert last[0] == pytest.approx(last[1] - first[1], abs=0.05)
    assert len(rows) > 10


def test_the_map_is_moved_and_read_by_keys_alone(browser, address):
    with shown(browser, address) as (page, wrong):
        page.keyboard.press("Tab")
        page.keyboard.press("Enter")  # to the map
        assert page.evaluate("document.activeElement.id") == "map"
        before = page.evaluate("location.hash")
        page.keyboard.press("ArrowRight")
        page.keyboard.press("+")
        page.locator("#value", has_text="dB").wait_for(timeout=10_000)
        assert page.is_visible("#cross")
        assert page.evaluate("location.hash") != before
        page.focus("#low")
        page.keyboard.press("ArrowRight")
        assert page.inner_text("#low-value") == page.inner_text("#ramp-low")
        assert wrong == []


def test_text_of_strangers_stays_text(browser, finished, tmp_path):
    root = copy_writable(finished.root, tmp_path / "campaign")
    path = root / "results" / "map" / "map.json"
    found = json.loads(path.read_text())
    found["campaign"] = found["crs"]["name"] = HOSTILE
    found["notes"] = [HOSTILE]
    image = found["images"][0]
    image |= {"flight": HOSTILE, "image": HOSTILE, "verdict": HOSTILE, "why": HOSTILE, "flags": {HOSTILE: HOSTILE}}
    image["layers"][0] |= {"title": HOSTILE, "unit": HOSTILE}
    found["places"] = [{"name": HOSTILE, "source": HOSTILE, "image": None, "x_m": 0.0, "y_m": 0.0}]
    path.write_text(json.dumps(found))
    with serving(root) as address, shown(browser, address) as (page, wrong):
        page.wait_for_timeout(300)
        assert page.inner_text("#campaign") == HOSTILE
        assert page.inner_text("#flags dt") == HOSTILE
        assert page.locator("img, body script").count() == 0
        assert page.title() != "hacked"
        assert wrong == []


def test_an_image_that_changed_after_the_map_was_made_is_told_and_not_shown(browser, finished, tmp_path):
    root = copy_writable(finished.root, tmp_path / "campaign")
    path = root / "results" / "f01" / "fused" / "coherent_db.tif"
    path.with_name("noncoherent_db.tif").replace(path)
    with serving(root) as address, shown(browser, address, drawn=False) as (page, _):
        page.locator("#notices", has_text="changed since the map was made").wait_for(timeout=10_000)


def test_a_page_opened_as_a_file_says_how_to_open_it(browser, finished):
    with shown(browser, (finished.results / "map" / "index.html").as_uri(), drawn=False) as (page, _):
        page.locator("#notices", has_text="apertura map CAMPAIGN").wait_for(timeout=5_000)


def test_without_webgl_the_page_says_so_and_still_tells_values(tool, address):
    with browsing(tool, NO_GL) as browser, shown(browser, address) as (page, wrong):
        assert "no WebGL" in page.inner_text("#notices")
        page.locator("#targets button").first.click()
        page.wait_for_selector("#targets .peak[data-east]", timeout=10_000)
        assert wrong == []
