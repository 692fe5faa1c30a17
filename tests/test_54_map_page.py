"""The map in a browser: rendering, coordinates, permalinks, keyboard use, and isolation from other hosts."""

import io
import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import zipfile
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from folders import ROOT, copy_writable
from matplotlib.image import imread, imsave
from pyproj import Transformer

from apertura.campaign.folder import Campaign
from apertura.campaign.store import record_files
from apertura.run.process import process
from apertura.simulation import preset, simulate
from apertura.tools.preview import pair as preview_pair
from apertura.tools.preview.follow import Preview
from apertura.views.webmap.server import is_built

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
    pytest.mark.skipif(not CHROMIUM.exists(), reason="/usr/bin/chromium is not installed"),
    pytest.mark.skipif(not is_built(), reason="the page is not bundled: `make webmap` needs npm"),
]


@contextmanager
def serving(root, *options):
    """Run `apertura map`, yield its address, and stop it with Ctrl-C."""
    command = [APERTURA, "map", str(root), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield next(
                line.strip() for line in process.stdout if line.startswith("http")
            )  # after notes on out-of-date results
        finally:
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (0, "")


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
def shown(browser, address, *, size=(1000, 700), drawn=True, also=()):
    """Yield the frame of the map and a list of its console errors and requests to hosts other than those of `also`."""
    page = browser.new_page()
    page.set_viewport_size({"width": size[0], "height": size[1]})
    errors_and_requests = []
    page.on(
        "console", lambda entry: errors_and_requests.append(entry.text) if entry.type in {"error", "warning"} else None
    )
    page.on("pageerror", lambda error: errors_and_requests.append(str(error)))
    window = address.partition("#")[0]
    allowed = (window, window.replace("localhost", "127.0.0.1"), "data:", "blob:", *also)
    page.on(
        "request", lambda request: None if request.url.startswith(allowed) else errors_and_requests.append(request.url)
    )
    page.goto(address)
    _, frame = page.frames
    frame.wait_for_url(lambda url: url.startswith(f"{allowed[1]}map/index.html"))
    if drawn:
        frame.wait_for_selector("html[data-drawn]", timeout=20_000)
    try:
        yield frame, errors_and_requests
    finally:
        page.close()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Run the demo of 300 pulses, which resolves all targets."""
    return process(simulate(tmp_path_factory.mktemp("map") / "campaign", preset("demo"), seed=1))


@pytest.fixture(scope="module")
def address(finished):
    with serving(finished.root) as address:
        yield address


@pytest.fixture(scope="module")
def browser(tool):
    with browsing(tool, SOFTWARE_GL) as browser:
        yield browser


def until(frame, condition):
    """Wait up to 5 s for a condition: messages between window and frame take time."""
    end = time.monotonic() + 5
    while not condition() and time.monotonic() < end:
        frame.wait_for_timeout(20)
    assert condition()


def pixels(frame):
    """Return the rendered pixels of the map from a screenshot."""
    return np.asarray(imread(io.BytesIO(frame.locator("#view").screenshot()))[..., :3])


@pytest.mark.parametrize("size", [(1000, 700), (800, 600), (390, 844)])
def test_image_is_drawn_without_requests_to_other_hosts(browser, address, size):
    with shown(browser, f"{address}#over=", size=size) as (frame, errors_and_requests):
        frame.wait_for_timeout(300)
        rendered = pixels(frame)
        assert errors_and_requests == []
        assert frame.locator("#notices").inner_text() == ""
        assert frame.evaluate("document.documentElement.scrollWidth <= innerWidth")
    rows, columns = rendered.shape[:2]
    middle = rendered[rows // 4 : 3 * rows // 4, columns // 4 : 3 * columns // 4]
    assert middle.max() > 0.9  # the peak is white
    assert middle.std() > 0.05


@pytest.mark.parametrize("image", ["f01/uav1-uav1&layer=db.tif", "f01/uav1-uav2&layer=db.tif", "f01/fused"])
def test_displayed_target_coordinates_are_within_a_pixel(browser, address, finished, image):
    truth = json.loads((finished.root / "truth.json").read_text())["targets"]
    spacing_m = finished.settings.scene.spacing_m
    with shown(browser, f"{address}#image={image}") as (frame, errors_and_requests):
        for number, target in enumerate(truth):
            row = frame.locator("#targets li", has_text=f"target {number}")
            row.locator("button").click()
            peak = row.locator(".peak[data-east]")
            peak.wait_for(timeout=10_000)
            position = [float(peak.get_attribute(f"data-{axis}")) for axis in ("east", "north")]
            assert position == pytest.approx((target["x"], target["y"]), abs=spacing_m / 4)
        frame.wait_for_timeout(500)  # the map has moved to the last target
        box = frame.locator("#map").bounding_box()
        frame.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        frame.locator("#value", has_text="dB").wait_for(timeout=10_000)
        east, north = (float(word) for word in frame.inner_text("#place").split() if word[0].isdigit())
        latitude, longitude = (float(angle.strip(" °NE")) for angle in frame.inner_text("#geographic").split("°")[:2])
        assert errors_and_requests == []
    assert (east, north) == pytest.approx((truth[-1]["x"], truth[-1]["y"]), abs=spacing_m)
    to_wgs84 = Transformer.from_crs("EPSG:32632", "EPSG:4326")
    assert (latitude, longitude) == pytest.approx(to_wgs84.transform(east, north), abs=2e-8)


@pytest.mark.parametrize("number", [0, 3])
def test_target_is_drawn_at_its_position(browser, address, finished, number):
    target = json.loads((finished.root / "truth.json").read_text())["targets"][number]
    metres, spacing_m = 0.005, finished.settings.scene.spacing_m
    view = f"{target['x']},{target['y']},{metres}"
    with shown(browser, f"{address}#image=f01/uav1-uav1&layer=db.tif&over=&view={view}") as (
        frame,
        errors_and_requests,
    ):
        peak_db = float(frame.inner_text("#high-value").split()[0].replace("−", "-"))
    level = peak_db + 20 * np.log10(target["amplitude"]) - 6
    link = f"{address}#image=f01/uav1-uav1&layer=db.tif&over=&view={view}&stretch={level},{level + 0.1}"
    with shown(browser, link) as (frame, errors_and_requests):
        frame.wait_for_timeout(300)
        is_bright = pixels(frame).mean(axis=-1) > 0.99
        assert errors_and_requests == []
    rows, columns = np.nonzero(is_bright)
    middle = [(size - 1) / 2 for size in is_bright.shape]
    near = np.hypot(rows - middle[0], columns - middle[1]) * metres < 0.5
    assert near.sum() > 1000
    error_m = np.array([rows[near].mean() - middle[0], columns[near].mean() - middle[1]]) * metres
    assert np.abs(error_m).max() < spacing_m / 2, error_m


def test_permalink_restores_the_view_and_an_invalid_one_is_ignored(browser, address, finished):
    west, south, east, north = finished.settings.scene.bounds_m
    middle = (west + east) / 2, (south + north) / 2
    line = f"{middle[0] - 1},{middle[1]},{middle[0] + 1},{middle[1]}"
    link = (
        f"image=f01/uav1-uav2&layer=incidence.tif&stretch=40,60&over=mask&view={middle[0]},{middle[1]},0.01&line={line}"
    )
    with shown(browser, f"{address}#{link}") as (frame, errors_and_requests):
        frame.wait_for_selector("#plot path")
        assert frame.input_value("#image") == "f01/uav1-uav2"
        assert frame.input_value("#layer") == "incidence.tif"
        assert frame.inner_text("#low-value") == "40 deg"
        assert frame.is_checked("#overlays label:nth-child(1) input")
        assert not frame.is_checked("#overlays label:nth-child(2) input")
        again = frame.evaluate("location.hash")
        assert frame.page.url == address + again
        assert frame.page.title() == frame.title() == "tandem_demo · apertura map"
        assert errors_and_requests == []
    with shown(browser, address + again) as (frame, _):
        frame.wait_for_selector("#plot path")
        assert frame.evaluate("location.hash") == again
    with shown(browser, f"{address}#image=x&layer=../y&stretch=a,b&view=1,2,-3&line=1,2&over=__proto__") as (
        frame,
        errors_and_requests,
    ):
        assert frame.input_value("#layer") == "coherent_db.tif"
        assert errors_and_requests == []


def test_edited_address_and_back_button_change_the_view(browser, address):
    with shown(browser, f"{address}#over=&colours=grey") as (frame, errors_and_requests):
        window = frame.page
        before, length = window.url, window.evaluate("history.length")
        frame.select_option("#colours", "inferno")
        until(frame, lambda: "colours=inferno" in window.url)
        window.evaluate("location.hash = location.hash.replace('colours=inferno', 'colours=viridis')")
        until(frame, lambda: frame.input_value("#colours") == "viridis")
        assert window.evaluate("history.length") == length + 1  # by the edit, not by map messages
        window.go_back()
        until(frame, lambda: frame.input_value("#colours") == "inferno")
        assert window.url == before.replace("colours=grey", "colours=inferno")
        assert errors_and_requests == []


def test_tracks_outside_the_view_are_labelled(browser, address):
    with shown(browser, address) as (frame, errors_and_requests):
        words = frame.locator("#overlays span").nth(1)
        until(frame, lambda: words.inner_text().strip() == "tracks (outside the view)")
        frame.click("#fit-tracks")
        until(frame, lambda: words.inner_text().strip() == "tracks")
        assert errors_and_requests == []


def test_window_accepts_permalinks_from_its_frame_only(browser, address):
    with shown(browser, address) as (frame, _):
        window = frame.page
        frame.evaluate("parent.postMessage({ hash: '//evil.example/x?y', title: '<b>told</b>' }, '*')")
        until(frame, lambda: window.title() == "<b>told</b>")
        window.evaluate("postMessage({ hash: '#own', title: 'own' }, '*')")
        frame.wait_for_timeout(200)
        assert window.title() == "<b>told</b>"
        assert window.url == f"{address}#/evil.example/x?y"


def test_cross_section_is_drawn_by_two_clicks_and_saved(browser, address):
    with shown(browser, f"{address}#over=") as (frame, errors_and_requests):
        frame.click("#draw")
        box = frame.locator("#map").bounding_box()
        for share in (0.35, 0.65):
            frame.page.mouse.click(box["x"] + share * box["width"], box["y"] + box["height"] / 2)
        frame.wait_for_selector("#plot path.cut")
        with frame.page.expect_download() as download:
            frame.click("#csv")
        header, *rows = Path(download.value.path()).read_text().splitlines()
        assert errors_and_requests == []
    assert header == "distance_m,easting_m,northing_m,longitude_deg,latitude_deg,value_db"
    first, last = ([float(word) for word in row.split(",")] for row in (rows[0], rows[-1]))
    assert first[0] == 0
    assert last[0] == pytest.approx(last[1] - first[1], abs=0.05)
    assert len(rows) > 10


def test_map_is_operated_by_keyboard(browser, address):
    with shown(browser, address) as (frame, errors_and_requests):
        frame.page.keyboard.press("Tab")
        until(frame, lambda: frame.evaluate("document.hasFocus() && document.activeElement.id") == "skip")
        frame.page.keyboard.press("Enter")  # skip to the map
        until(frame, lambda: frame.evaluate("document.activeElement.id") == "map")
        before = frame.evaluate("location.hash")
        frame.page.keyboard.press("ArrowRight")
        frame.page.keyboard.press("+")
        frame.locator("#value", has_text="dB").wait_for(timeout=10_000)
        assert frame.is_visible("#cross")
        assert frame.evaluate("location.hash") != before
        frame.focus("#low")
        frame.page.keyboard.press("ArrowRight")
        assert frame.inner_text("#low-value") == frame.inner_text("#ramp-low")
        assert errors_and_requests == []


def test_hostile_text_is_displayed_as_text(browser, finished, tmp_path):
    root = copy_writable(finished.root, tmp_path / "campaign")
    path = root / "results" / "map" / "map.json"
    map_document = json.loads(path.read_text())
    map_document["campaign"] = map_document["crs"]["name"] = HOSTILE
    map_document["notes"] = [HOSTILE]
    image = map_document["images"][0]
    image |= {"flight": HOSTILE, "image": HOSTILE, "verdict": HOSTILE, "reason": HOSTILE, "flags": {HOSTILE: HOSTILE}}
    image["layers"][0] |= {"title": HOSTILE, "unit": HOSTILE}
    map_document["places"] = [{"name": HOSTILE, "source": HOSTILE, "image": None, "x_m": 0.0, "y_m": 0.0}]
    path.write_text(json.dumps(map_document))
    record_files(path.with_name("map.manifest.json"), [path])
    with serving(root) as address, shown(browser, address) as (frame, errors_and_requests):
        frame.wait_for_timeout(300)
        assert frame.inner_text("#campaign") == HOSTILE
        assert frame.inner_text("#flags dt") == HOSTILE
        assert frame.locator("img, body script").count() == 0
        assert frame.title() == frame.page.title() == f"{HOSTILE} · apertura map"
        assert errors_and_requests == []


def test_image_changed_after_the_map_is_not_shown(browser, finished, tmp_path):
    root = copy_writable(finished.root, tmp_path / "campaign")
    path = root / "results" / "f01" / "fused" / "coherent_db.tif"
    path.with_name("noncoherent_db.tif").replace(path)
    with serving(root) as address, shown(browser, address, drawn=False) as (frame, _):
        frame.locator("#notices", has_text="changed after the map was made").wait_for(timeout=10_000)


def test_page_without_webgl_still_displays_values(tool, address):
    with browsing(tool, NO_GL) as browser, shown(browser, address) as (frame, errors_and_requests):
        assert "no WebGL" in frame.inner_text("#notices")
        frame.locator("#targets button").first.click()
        frame.wait_for_selector("#targets .peak[data-east]", timeout=10_000)
        assert errors_and_requests == []


NAVIGATIONS = {
    "location": "location = url",
    "top": "top.location = url",
    "parent": "parent.location = url",
    "window": "open(url)",
    "link": "add('a', { href: url }).click()",
    "link to top": "add('a', { href: url, target: '_top' }).click()",
    "link to a new window": "add('a', { href: url, target: '_blank' }).click()",
    "download": "add('a', { href: url, download: 'x' }).click()",
    "meta": "add('meta', { httpEquiv: 'refresh', content: `0;url=${url}` })",
    "form": "add('form', { action: url, method: 'post' }).submit()",
    "form to top": "add('form', { action: url, target: '_top' }).submit()",
}
REQUESTS = {
    "fetch": "fetch(url, { mode: 'no-cors' }).catch(() => {})",
    "XMLHttpRequest": "const asked = new XMLHttpRequest(); asked.open('GET', url); asked.send()",
    "image": "new Image().src = url",
    "WebSocket": "new WebSocket(url.replace('http', 'ws'))",
    "EventSource": "new EventSource(url)",
    "beacon": "navigator.sendBeacon(url, 'x')",
    "ping": "add('a', { href: '#x', ping: url }).click()",
    "prefetch": "add('link', { rel: 'prefetch', href: url })",
    "preload": "add('link', { rel: 'preload', as: 'image', href: url })",
    "stylesheet": "add('link', { rel: 'stylesheet', href: url })",
    "style": "add('link', { rel: 'stylesheet', href: `data:text/css,@import '${url}'` })",
    "script": "add('script', { src: url })",
    "frame": "add('iframe', { src: url })",
    "frame that is led": "add('iframe', {}).contentWindow.location = url",
    "video": "add('video', { src: url })",
    "worker": "new Worker(URL.createObjectURL(new Blob([`importScripts('${url}')`])))",
    "WebRTC": "const urls = url.replace(/http:..(.*).x/, 'stun:$1');"
    "const peer = new RTCPeerConnection({ iceServers: [{ urls }] }); peer.createDataChannel('x');"
    "peer.createOffer().then((offer) => peer.setLocalDescription(offer))",
}
ADD = "const add = (name, with_) => document.body.appendChild(Object.assign(document.createElement(name), with_));"


COMPARED = "image=f01/uav1-uav1&layer=db.tif&right=f01/uav1-uav2&right_layer=db.tif&colours=grey&over="


def halves(frame):
    """Return the parts of a view left and right of its middle, without divider and captions."""
    frame.wait_for_timeout(400)
    rendered = pixels(frame).mean(axis=-1)
    middle = rendered.shape[1] // 2
    return rendered[150:-80, : middle - 60], rendered[150:-80, middle + 60 :]


def test_divider_separates_two_images(browser, address):
    alone = []
    for image in ("f01/uav1-uav1", "f01/uav1-uav2"):
        with shown(browser, f"{address}#image={image}&layer=db.tif&colours=grey&stretch=-15,32&over=") as (frame, _):
            alone.append(halves(frame))
    assert np.abs(alone[0][0] - alone[1][0]).max() > 0.3
    with shown(browser, f"{address}#{COMPARED}&stretch=-15,32&divider=0.5") as (frame, errors_and_requests):
        left, right = halves(frame)
        np.testing.assert_allclose(left, alone[0][0], atol=0.01)
        np.testing.assert_allclose(right, alone[1][1], atol=0.01)
        assert frame.inner_text("#right-ramp-low") == frame.inner_text("#ramp-low") == "−15 dB"
        frame.focus("#low")
        frame.page.keyboard.press("PageUp")
        assert frame.inner_text("#right-ramp-low") == frame.inner_text("#ramp-low") != "−15 dB"
        frame.select_option("#right", "f01/fused")  # relative to the peak: another quantity in dB, with its own scale
        assert frame.inner_text("#right-ramp-high") == "0.0 dB"
        frame.select_option("#right", "f01/uav1-uav2")
        frame.select_option("#right-layer", "incidence.tif")
        assert frame.inner_text("#right-ramp-low").endswith("deg")
        box = frame.locator("#map").bounding_box()
        frame.page.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 2)
        until(frame, lambda: re.fullmatch(r"left · .* dB +right · .* deg", frame.inner_text("#value")))
        assert errors_and_requests == []


def test_divider_is_a_slider_for_mouse_touch_and_keyboard(browser, address):
    with browser.new_context(has_touch=True) as context, shown(context, f"{address}#{COMPARED}") as (frame, problems):
        divider, page = frame.locator("#divider"), frame.page
        view = frame.locator("#view").bounding_box()

        def share():
            return float(divider.get_attribute("aria-valuenow")) / 100

        def at(position):
            return view["x"] + position * view["width"], view["y"] + view["height"] * 0.7

        assert (divider.get_attribute("role"), share()) == ("slider", 0.5)
        page.mouse.move(*at(0.5))
        page.mouse.down()
        page.mouse.move(*at(0.25), steps=4)
        page.mouse.up()
        assert share() == pytest.approx(0.25, abs=0.011)
        until(frame, lambda: "divider=0.25" in page.url)
        touch = context.new_cdp_session(page)
        for kind, position in (("touchStart", 0.25), ("touchMove", 0.5), ("touchMove", 0.8), ("touchEnd", None)):
            points = [] if position is None else [dict(zip("xy", at(position), strict=True))]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        until(frame, lambda: abs(share() - 0.8) < 0.011)
        divider.focus()
        for key, expected in (("Home", 0), ("ArrowRight", 0.01), ("PageUp", 0.11), ("ArrowLeft", 0.1), ("End", 1)):
            page.keyboard.press(key)
            assert share() == pytest.approx(expected)
        assert divider.get_attribute("aria-valuetext") == "100 % f01 · uav1-uav1 · db, 0 % f01 · uav1-uav2 · db"
        frame.select_option("#right", "")
        assert divider.is_hidden()
        until(frame, lambda: "divider" not in page.url)
        assert problems == []


def downloaded(frame, button):
    """Click a button; return name and content of the file that the page saves."""
    with frame.page.expect_download() as download:
        frame.click(button)
    return download.value.suggested_filename, Path(download.value.path()).read_bytes()


def test_exported_picture_contains_the_view_and_the_flags(browser, address, finished, tmp_path):
    root = copy_writable(finished.root, tmp_path / "campaign")
    path = root / "results" / "map" / "map.json"
    map_document = json.loads(path.read_text())
    long = {f"flag_{number}": "A measured value exceeds its limit. " * 8 for number in range(3)}
    map_document["images"][0] |= {"verdict": "defocused", "flags": long, "licence": "CC-BY-4.0"}
    path.write_text(json.dumps(map_document))
    record_files(path.with_name("map.manifest.json"), [path])
    with shown(browser, f"{address}#over=") as (frame, _):
        name, plain = downloaded(frame, "#png")
        view = frame.locator("#map").bounding_box()
        on_screen = pixels(frame)
    assert name == "f01_fused_coherent_db.png"
    with serving(root) as other, shown(browser, f"{other}#over=") as (frame, errors_and_requests):
        _, flagged = downloaded(frame, "#png")
        assert errors_and_requests == []
    plain, flagged = (imread(io.BytesIO(content))[..., :3] for content in (plain, flagged))
    assert plain.shape[1] == flagged.shape[1] == view["width"] + 32
    is_red = (flagged[..., 0] > 0.6) & (flagged[..., 1:].max(axis=-1) < 0.3)
    red_rows = np.flatnonzero(is_red.any(axis=1))
    assert (np.diff(red_rows) > 20).sum() == 2  # three names of flags in red, with their texts between
    assert not ((plain[..., 0] > 0.6) & (plain[..., 1:].max(axis=-1) < 0.3)).any()
    assert flagged.shape[0] > plain.shape[0] + 3 * 2 * 16
    height = int(view["height"])
    start = next(row for row in range(80) if (plain[row, 200:600] < 0.2).all())  # first row of the map
    picture = plain[start : start + height, 16:-16]
    middle = slice(80, height - 60), slice(100, -100)
    first = round(view["y"]) - int(view["y"])  # row of the screenshot that shows the first row of the map
    np.testing.assert_allclose(picture[middle], on_screen[first:][:height][middle], atol=0.02)


def test_exported_picture_of_a_comparison_names_both_images(browser, address):
    with shown(browser, f"{address}#{COMPARED}") as (frame, errors_and_requests):
        name, content = downloaded(frame, "#png")
        assert errors_and_requests == []
    assert name == "f01_uav1-uav1_db_and_f01_uav1-uav2_db.png"
    assert content[1:4] == b"PNG"


def test_kmz_has_the_colour_scale_of_the_page(browser, address):
    with shown(browser, f"{address}#image=f01/uav1-uav2&layer=db.tif&colours=inferno&stretch=0,20") as (
        frame,
        problems,
    ):
        name, content = downloaded(frame, "#kmz")
        assert problems == []
    assert name == "f01_uav1-uav2_db.kmz"
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert "f01 · uav1-uav2 · echo power" in archive.read("doc.kml").decode()
        picture = imread(io.BytesIO(archive.read("image.png")))
    brightest = picture.reshape(-1, 4)[picture[..., :3].sum(axis=-1).argmax()]
    assert brightest[0] > brightest[2] + 0.2  # not grey


class TileAnswer(BaseHTTPRequestHandler):
    """Tiles of Web Mercator: red north-east, green north-west, blue south of a place; with CORS headers."""

    def do_GET(self):
        zoom, column, row = (int(part) for part in re.findall(r"\d+", self.path)[:3])
        longitude, latitude = self.server.place
        lines, samples = np.mgrid[0:256, 0:256] + 0.5
        size = 256 * 2**zoom
        is_east = (256 * column + samples) / size > longitude / 360 + 0.5
        mercator = np.arctanh(np.sin(np.radians(latitude))) / (2 * np.pi)
        is_north = (256 * row + lines) / size < 0.5 - mercator
        colours = np.stack([is_north & is_east, is_north & ~is_east, ~is_north], axis=-1) * np.uint8(255)
        file = io.BytesIO()
        imsave(file, colours.astype("u1"), format="png")
        self.server.requests.append((self.headers["Referer"], zoom))
        self.send_response(200)
        self.send_header("Content-Type", "image/png")
        self.send_header("Access-Control-Allow-Origin", "*")
        self.end_headers()
        self.wfile.write(file.getvalue())

    def log_message(self, *_):
        """Print nothing."""


@contextmanager
def tiles_of(place):
    with ThreadingHTTPServer(("127.0.0.1", 0), TileAnswer) as server:
        server.place, server.requests = place, []
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server, f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def test_background_tiles_are_reprojected_and_no_other_host_is_contacted(browser, finished):
    """Two lines of latitude and longitude cross at a corner of the scene; on the map they are at the same point."""
    west, _, _, north = finished.settings.scene.bounds_m
    place = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform(west - 2, north + 2)
    view = f"over=&view={west - 2},{north + 2},0.02"
    with tiles_of(place) as (tiles, host), listening() as foreign:
        options = (
            "--tiles",
            f"{host}/{{z}}/{{x}}/{{y}}.png",
            "--tiles-attribution",
            "© <b>Example</b>",
            "--tiles-zoom",
            "22",
        )
        with (
            serving(finished.root, *options) as address,
            shown(browser, f"{address}#{view}", also=[host]) as (frame, problems),
        ):
            until(frame, lambda: tiles.requests)
            frame.wait_for_timeout(1500)
            rendered = pixels(frame)
            assert frame.inner_text("#attribution") == "© <b>Example</b>"
            name, picture = downloaded(frame, "#png")
            assert (name, problems) == ("f01_fused_coherent_db.png", [])
            assert {referrer for referrer, _ in tiles.requests} == {address.replace("localhost", "127.0.0.1")}
            assert max(zoom for _, zoom in tiles.requests) <= 22
            for code in REQUESTS.values():
                attack(frame, code, foreign.url)
            before = len(tiles.requests)
            for name in ("fetch", "XMLHttpRequest", "beacon", "script", "frame", "WebSocket"):
                attack(frame, REQUESTS[name], f"{host}/1/1/1.png")
            frame.wait_for_timeout(500)
            assert (foreign.received(), foreign.requests, len(tiles.requests)) == ([], [], before)
    exported = imread(io.BytesIO(picture))
    assert ((exported[..., 0] > 0.9) & (exported[..., 1:3].max(axis=-1) < 0.1)).sum() > 1000
    red, green, blue = (rendered[..., band] > 0.9 for band in range(3))
    dark = rendered.max(axis=-1) < 0.9
    rows, columns = (size // 2 for size in rendered.shape[:2])
    near = slice(rows - 80, rows + 80), slice(columns - 80, columns + 80)
    red, green, blue = (band[near] & ~dark[near] for band in (red, green, blue))
    angle = np.radians(0.71)  # convergence, by which the parallel is inclined
    down, right = np.mgrid[-80:80, -80:80] + 0.5
    is_north = down + right * np.tan(angle) < 0
    is_east = right - down * np.tan(angle) > 0
    clear = (np.abs(down + right * np.tan(angle)) > 3) & (np.abs(right - down * np.tan(angle)) > 3)
    for drawn, expected in ((blue, ~is_north), (red, is_north & is_east), (green, is_north & ~is_east)):
        assert (drawn == expected)[clear].mean() > 0.99


class Listener(ThreadingHTTPServer):
    """Local server of an empty page that records connections, datagrams and requests."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Answer)
        self.connections, self.requests = [], []
        self.url = f"http://127.0.0.1:{self.server_port}/x"
        self.datagrams = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.datagrams.bind(("127.0.0.1", self.server_port))

    def verify_request(self, _, client):
        self.connections.append(client)
        return True

    def received(self):
        with suppress(BlockingIOError):
            self.connections.append(self.datagrams.recv(9, socket.MSG_DONTWAIT))
        return self.connections

    def handle_error(self, *_):
        """Ignore clients that connect without a request."""


class Answer(BaseHTTPRequestHandler):
    timeout = 5

    def do_GET(self):
        self.server.requests.append(self.requestline)
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()

    do_POST = do_GET

    def log_message(self, *_):
        """Print nothing."""


@contextmanager
def listening():
    with Listener() as listener:
        thread = threading.Thread(target=listener.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield listener
        finally:
            listener.shutdown()
            thread.join()
            listener.datagrams.close()


def attack(frame, code, url):
    """Run code in a page as its own script; ignore exceptions and a closed page."""
    from playwright.sync_api import Error

    with suppress(Error):
        frame.evaluate(f"(url) => {{ {ADD} {code}; }}", url)


@pytest.mark.parametrize("code", [pytest.param(code, id=name) for name, code in (NAVIGATIONS | REQUESTS).items()])
def test_scripts_in_the_map_reach_no_other_server(browser, address, code):
    if int(browser.version.partition(".")[0]) < 152:
        pytest.skip("this Chromium does not support connection allowlists")
    with listening() as plain, listening() as other, browser.new_context() as context:
        page = context.new_page()
        page.goto(plain.url)
        attack(page.main_frame, code, other.url)
        until(page, other.received)  # control: reached without the map's restrictions
    with listening() as other, browser.new_context() as context, shown(context, address) as (frame, _):
        window = frame.page
        until(frame, lambda: "#image=" in window.url)
        before = window.url
        attack(frame, code, other.url)
        window.wait_for_timeout(500)
        assert (other.received(), other.requests) == ([], [])
        assert (window.url, context.pages) == (before, [window])


@pytest.fixture(scope="module")
def browser_without_allowlist(tool):
    """Start a browser without support of connection allowlists."""
    with browsing(tool, (*SOFTWARE_GL, "--disable-features=ConnectionAllowlists")) as browser:
        yield browser


@pytest.mark.parametrize("code", [pytest.param(code, id=name) for name, code in NAVIGATIONS.items()])
def test_map_cannot_navigate_without_connection_allowlist(browser_without_allowlist, address, code):
    with (
        listening() as other,
        browser_without_allowlist.new_context() as context,
        shown(context, address) as (frame, _),
    ):
        window = frame.page
        until(frame, lambda: "#image=" in window.url)
        before = window.url
        attack(frame, code, other.url)
        window.wait_for_timeout(500)
        assert other.requests == []
        assert (window.url, context.pages) == (before, [window])


def test_local_frame_is_labelled_with_x_and_y(browser, shared, tmp_path):
    root = Path(shutil.copytree(ROOT / "examples/gotcha", tmp_path / "gotcha"))
    (root / "raw/pass1").mkdir(parents=True)
    for path in (shared / "gotcha_afrl").glob("*.mat"):
        shutil.copyfile(path, root / f"raw/pass1/aircraft.{path.name}")
    process(root)
    with serving(root) as address, shown(browser, address) as (frame, errors_and_requests):
        frame.locator("#targets button").first.click()
        until(frame, lambda: "cm along x" in frame.inner_text("#targets"))
        words = frame.inner_text("body").split()
        assert errors_and_requests == []
    assert not {"E", "N", "east,", "north"} & set(words)
    assert words.count("from") >= 3  # colours from; from x, from y


def test_map_cannot_read_the_window_that_contains_it(browser, address):
    with shown(browser, address) as (frame, _):
        script = "try { parent.document.title } catch (error) { return error.name } return 'seen'"
        assert frame.evaluate(f"() => {{ {script} }}") == "SecurityError"


def test_page_in_the_results_is_not_shown(browser, finished, tmp_path):
    root = copy_writable(finished.root, tmp_path / "campaign")
    for name in ("index.html", "shell.html", "app.js", "shell.js", "app.css"):
        (root / "results" / "map" / name).write_text("document.title='hacked'")
    with serving(root) as address:
        page = browser.new_page()
        page.goto(f"{address.replace('localhost', '127.0.0.1')}map/index.html#colours=inferno")
        page.frame_locator("iframe").locator("html[data-drawn]").wait_for(state="attached", timeout=20_000)
        until(page, lambda: page.url.startswith(f"{address}#image=") and "colours=inferno" in page.url)
        assert page.title() == "tandem_demo · apertura map"
        page.close()


def test_preview_page_updates_and_keeps_the_selection(browser, tmp_path, monkeypatch):
    """The page shows the first half of the pulses, then all; it is updated without a reload."""
    monkeypatch.setattr(preview_pair, "AT_ONCE", 60)
    root = simulate(tmp_path / "campaign", preset("demo", pulses=120), seed=1)
    preview = Preview(Campaign.load(root), follow=True, every_s=1.0, end_after_s=1e6)
    for node in preview.nodes.values():
        node.read()
    assert all(pair.add_next(ended=True) for pair in preview.pairs)
    preview.show(ended=False, elapsed_s=1.0)
    with serving(root, "--preview") as address, shown(browser, address) as (frame, errors_and_requests):
        frame.locator("#image").select_option("f01/uav1-uav2")
        frame.locator("#low").fill(str(float(frame.locator("#low").get_attribute("min"))))
        low = frame.locator("#low").input_value()
        while any(pair.add_next(ended=True) for pair in preview.pairs):
            pass
        before = frame.locator("#verdict").text_content()
        document = root / "results/preview/map/map.json"
        preview.show(ended=True, elapsed_s=1.0)
        changed = json.loads(document.read_text())
        assert changed["again_s"] is None
        reason = next(image["reason"] for image in changed["images"] if image["image"] == "uav1-uav2")
        assert reason not in before
        until(frame, lambda: reason in frame.locator("#verdict").text_content())
        assert frame.locator("#image").input_value() == "f01/uav1-uav2"
        assert float(frame.locator("#low").input_value()) == pytest.approx(float(low), abs=0.5)
        assert frame.locator("#notices").text_content() == ""
    assert errors_and_requests == []
