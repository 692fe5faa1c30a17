"""The map in a browser: what it draws, tells and measures, and that nothing in it asks another host for anything."""

import io
import json
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from folders import ROOT, copy_writable, run_steps
from matplotlib.image import imread
from pyproj import Transformer

from apertura.campaign.folder import Campaign
from apertura.campaign.store import record_files
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
    pytest.mark.skipif(not CHROMIUM.exists(), reason="no /usr/bin/chromium: the page is not tried in a browser"),
    pytest.mark.skipif(not is_built(), reason="the page is not bundled: `make webmap` needs npm"),
]


@contextmanager
def serving(root, *options):
    """Run `apertura map` as a person would, and end it with Ctrl-C."""
    command = [APERTURA, "map", str(root), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield next(line.strip() for line in process.stdout if line.startswith("http"))  # after what is stale
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
    """Yield the map, in its frame, and what it should not do: errors, and requests to other hosts."""
    page = browser.new_page()
    page.set_viewport_size({"width": size[0], "height": size[1]})
    wrong = []
    page.on("console", lambda said: wrong.append(said.text) if said.type in {"error", "warning"} else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    window = address.partition("#")[0]
    ours = (window, window.replace("localhost", "127.0.0.1"), "data:", "blob:")
    page.on("request", lambda asked: None if asked.url.startswith(ours) else wrong.append(asked.url))
    page.goto(address)
    _, frame = page.frames
    frame.wait_for_url(lambda url: url.startswith(f"{ours[1]}map/index.html"))
    if drawn:
        frame.wait_for_selector("html[data-drawn]", timeout=20_000)
    try:
        yield frame, wrong
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


def until(frame, true):
    """Wait for what is true soon: what one page tells the other takes its time."""
    end = time.monotonic() + 5
    while not true() and time.monotonic() < end:
        frame.wait_for_timeout(20)
    assert true()


def pixels(frame):
    """Grey values of the map's picture, as the reader sees it, by a canvas of the test's own."""
    return np.asarray(imread(io.BytesIO(frame.locator("#view").screenshot()))[..., :3])


@pytest.mark.parametrize("size", [(1000, 700), (800, 600), (390, 844)])
def test_the_image_is_drawn_and_no_other_host_is_asked(browser, address, size):
    with shown(browser, f"{address}#over=", size=size) as (frame, wrong):
        frame.wait_for_timeout(300)
        seen = pixels(frame)
        assert wrong == []
        assert frame.locator("#notices").inner_text() == ""
        assert frame.evaluate("document.documentElement.scrollWidth <= innerWidth")
    rows, columns = seen.shape[:2]
    middle = seen[rows // 4 : 3 * rows // 4, columns // 4 : 3 * columns // 4]
    assert middle.max() > 0.9  # the peak is white
    assert middle.std() > 0.05


@pytest.mark.parametrize("image", ["f01/uav1-uav1&layer=db.tif", "f01/uav1-uav2&layer=db.tif", "f01/fused"])
def test_a_targets_coordinates_read_from_the_page_are_within_a_pixel_of_the_truth(browser, address, finished, image):
    truth = json.loads((finished.root / "truth.json").read_text())["targets"]
    spacing_m = finished.settings.scene.spacing_m
    with shown(browser, f"{address}#image={image}") as (frame, wrong):
        for number, target in enumerate(truth):
            row = frame.locator("#targets li", has_text=f"target {number}")
            row.locator("button").click()
            peak = row.locator(".peak[data-east]")
            peak.wait_for(timeout=10_000)
            found = [float(peak.get_attribute(f"data-{axis}")) for axis in ("east", "north")]
            assert found == pytest.approx((target["x"], target["y"]), abs=spacing_m / 4)
        frame.wait_for_timeout(500)  # the map has come to the last target
        box = frame.locator("#map").bounding_box()
        frame.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        frame.locator("#value", has_text="dB").wait_for(timeout=10_000)
        east, north = (float(word) for word in frame.inner_text("#place").split() if word[0].isdigit())
        latitude, longitude = (float(one.strip(" °NE")) for one in frame.inner_text("#geographic").split("°")[:2])
        assert wrong == []
    assert (east, north) == pytest.approx((truth[-1]["x"], truth[-1]["y"]), abs=spacing_m)
    to_wgs84 = Transformer.from_crs("EPSG:32632", "EPSG:4326")
    assert (latitude, longitude) == pytest.approx(to_wgs84.transform(east, north), abs=2e-8)


@pytest.mark.parametrize("number", [0, 3])
def test_a_target_is_drawn_where_it_is(browser, address, finished, number):
    target = json.loads((finished.root / "truth.json").read_text())["targets"][number]
    metres, spacing_m = 0.005, finished.settings.scene.spacing_m
    view = f"{target['x']},{target['y']},{metres}"
    with shown(browser, f"{address}#image=f01/uav1-uav1&layer=db.tif&over=&view={view}") as (frame, wrong):
        peak_db = float(frame.inner_text("#high-value").split()[0].replace("−", "-"))
    level = peak_db + 20 * np.log10(target["amplitude"]) - 6
    link = f"{address}#image=f01/uav1-uav1&layer=db.tif&over=&view={view}&stretch={level},{level + 0.1}"
    with shown(browser, link) as (frame, wrong):
        frame.wait_for_timeout(300)
        seen = pixels(frame).mean(axis=-1) > 0.99
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
    with shown(browser, f"{address}#{asked}") as (frame, wrong):
        frame.wait_for_selector("#plot path")
        assert frame.input_value("#image") == "f01/uav1-uav2"
        assert frame.input_value("#layer") == "incidence.tif"
        assert frame.inner_text("#low-value") == "40 deg"
        assert frame.is_checked("#overlays label:nth-child(1) input")
        assert not frame.is_checked("#overlays label:nth-child(2) input")
        again = frame.evaluate("location.hash")
        assert frame.page.url == address + again
        assert frame.page.title() == frame.title() == "tandem_demo · apertura map"
        assert wrong == []
    with shown(browser, address + again) as (frame, _):
        frame.wait_for_selector("#plot path")
        assert frame.evaluate("location.hash") == again
    with shown(browser, f"{address}#image=x&layer=../y&stretch=a,b&view=1,2,-3&line=1,2&over=__proto__") as (
        frame,
        wrong,
    ):
        assert frame.input_value("#layer") == "coherent_db.tif"
        assert wrong == []


def test_the_windows_address_shows_something_else_when_it_is_edited_and_goes_back(browser, address):
    with shown(browser, f"{address}#over=&colours=grey") as (frame, wrong):
        window = frame.page
        before, length = window.url, window.evaluate("history.length")
        frame.select_option("#colours", "inferno")
        until(frame, lambda: "colours=inferno" in window.url)
        window.evaluate("location.hash = location.hash.replace('colours=inferno', 'colours=viridis')")
        until(frame, lambda: frame.input_value("#colours") == "viridis")
        assert window.evaluate("history.length") == length + 1  # by the edit, and not by what the map tells
        window.go_back()
        until(frame, lambda: frame.input_value("#colours") == "inferno")
        assert window.url == before.replace("colours=grey", "colours=inferno")
        assert wrong == []


def test_tracks_outside_the_view_are_named_so_until_the_map_shows_them(browser, address):
    with shown(browser, address) as (frame, wrong):
        words = frame.locator("#overlays span").nth(1)
        until(frame, lambda: words.inner_text().strip() == "tracks (outside the view)")
        frame.click("#fit-tracks")
        until(frame, lambda: words.inner_text().strip() == "tracks")
        assert wrong == []


def test_the_window_takes_a_permalink_from_its_frame_alone_and_no_more_than_that(browser, address):
    with shown(browser, address) as (frame, _):
        window = frame.page
        frame.evaluate("parent.postMessage({ hash: '//evil.example/x?y', title: '<b>told</b>' }, '*')")
        until(frame, lambda: window.title() == "<b>told</b>")
        window.evaluate("postMessage({ hash: '#own', title: 'own' }, '*')")
        frame.wait_for_timeout(200)
        assert window.title() == "<b>told</b>"
        assert window.url == f"{address}#/evil.example/x?y"


def test_the_cross_section_is_drawn_by_two_clicks_and_saved(browser, address):
    with shown(browser, f"{address}#over=") as (frame, wrong):
        frame.click("#draw")
        box = frame.locator("#map").bounding_box()
        for share in (0.35, 0.65):
            frame.page.mouse.click(box["x"] + share * box["width"], box["y"] + box["height"] / 2)
        frame.wait_for_selector("#plot path.cut")
        with frame.page.expect_download() as download:
            frame.click("#csv")
        header, *rows = Path(download.value.path()).read_text().splitlines()
        assert wrong == []
    assert header == "distance_m,easting_m,northing_m,longitude_deg,latitude_deg,value_db"
    first, last = ([float(word) for word in row.split(",")] for row in (rows[0], rows[-1]))
    assert first[0] == 0
    assert last[0] == pytest.approx(last[1] - first[1], abs=0.05)
    assert len(rows) > 10


def test_the_map_is_moved_and_read_by_keys_alone(browser, address):
    with shown(browser, address) as (frame, wrong):
        frame.page.keyboard.press("Tab")
        until(frame, lambda: frame.evaluate("document.hasFocus() && document.activeElement.id") == "skip")
        frame.page.keyboard.press("Enter")  # to the map
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
        assert wrong == []


def test_text_of_strangers_stays_text(browser, finished, tmp_path):
    root = copy_writable(finished.root, tmp_path / "campaign")
    path = root / "results" / "map" / "map.json"
    found = json.loads(path.read_text())
    found["campaign"] = found["crs"]["name"] = HOSTILE
    found["notes"] = [HOSTILE]
    image = found["images"][0]
    image |= {"flight": HOSTILE, "image": HOSTILE, "verdict": HOSTILE, "reason": HOSTILE, "flags": {HOSTILE: HOSTILE}}
    image["layers"][0] |= {"title": HOSTILE, "unit": HOSTILE}
    found["places"] = [{"name": HOSTILE, "source": HOSTILE, "image": None, "x_m": 0.0, "y_m": 0.0}]
    path.write_text(json.dumps(found))
    record_files(path.with_name("map.manifest.json"), [path])
    with serving(root) as address, shown(browser, address) as (frame, wrong):
        frame.wait_for_timeout(300)
        assert frame.inner_text("#campaign") == HOSTILE
        assert frame.inner_text("#flags dt") == HOSTILE
        assert frame.locator("img, body script").count() == 0
        assert frame.title() == frame.page.title() == f"{HOSTILE} · apertura map"
        assert wrong == []


def test_an_image_that_changed_after_the_map_was_made_is_told_and_not_shown(browser, finished, tmp_path):
    root = copy_writable(finished.root, tmp_path / "campaign")
    path = root / "results" / "f01" / "fused" / "coherent_db.tif"
    path.with_name("noncoherent_db.tif").replace(path)
    with serving(root) as address, shown(browser, address, drawn=False) as (frame, _):
        frame.locator("#notices", has_text="changed since the map was made").wait_for(timeout=10_000)


def test_without_webgl_the_page_says_so_and_still_tells_values(tool, address):
    with browsing(tool, NO_GL) as browser, shown(browser, address) as (frame, wrong):
        assert "no WebGL" in frame.inner_text("#notices")
        frame.locator("#targets button").first.click()
        frame.wait_for_selector("#targets .peak[data-east]", timeout=10_000)
        assert wrong == []


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


class Listener(ThreadingHTTPServer):
    """A port of this machine, what connects to it or sends to it, and what is asked of it: an empty page."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Answer)
        self.connections, self.requests = [], []
        self.url = f"http://127.0.0.1:{self.server_port}/x"
        self.datagrams = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.datagrams.bind(("127.0.0.1", self.server_port))

    def verify_request(self, _, asker):
        self.connections.append(asker)
        return True

    def heard(self):
        with suppress(BlockingIOError):
            self.connections.append(self.datagrams.recv(9, socket.MSG_DONTWAIT))
        return self.connections

    def handle_error(self, *_):
        """Say nothing of whoever connects and asks for nothing."""


class Answer(BaseHTTPRequestHandler):
    timeout = 5

    def do_GET(self):
        self.server.requests.append(self.requestline)
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()

    do_POST = do_GET

    def log_message(self, *_):
        """Say nothing."""


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
    """Run code in a page as the page's own; whether it throws, or ends the page, is all the same."""
    from playwright.sync_api import Error

    with suppress(Error):
        frame.evaluate(f"(url) => {{ {ADD} {code}; }}", url)


@pytest.mark.parametrize("code", [pytest.param(code, id=name) for name, code in (NAVIGATIONS | REQUESTS).items()])
def test_nothing_in_the_map_reaches_another_server(browser, address, code):
    if int(browser.version.partition(".")[0]) < 152:
        pytest.skip("this Chromium knows no connection allowlist")
    with listening() as plain, listening() as other, browser.new_context() as context:
        page = context.new_page()
        page.goto(plain.url)
        attack(page.main_frame, code, other.url)
        until(page, other.heard)  # where nothing hinders it
    with listening() as other, browser.new_context() as context, shown(context, address) as (frame, _):
        window = frame.page
        until(frame, lambda: "#image=" in window.url)
        before = window.url
        attack(frame, code, other.url)
        window.wait_for_timeout(500)
        assert (other.heard(), other.requests) == ([], [])
        assert (window.url, context.pages) == (before, [window])


@pytest.fixture(scope="module")
def older(tool):
    """A browser that knows no connection allowlist."""
    with browsing(tool, (*SOFTWARE_GL, "--disable-features=ConnectionAllowlists")) as browser:
        yield browser


@pytest.mark.parametrize("code", [pytest.param(code, id=name) for name, code in NAVIGATIONS.items()])
def test_the_map_leads_nowhere_in_a_browser_that_knows_no_connection_allowlist(older, address, code):
    with listening() as other, older.new_context() as context, shown(context, address) as (frame, _):
        window = frame.page
        until(frame, lambda: "#image=" in window.url)
        before = window.url
        attack(frame, code, other.url)
        window.wait_for_timeout(500)
        assert other.requests == []
        assert (window.url, context.pages) == (before, [window])


def test_a_frame_without_a_place_on_earth_has_x_and_y_and_no_north(browser, shared, tmp_path):
    root = Path(shutil.copytree(ROOT / "examples/gotcha", tmp_path / "gotcha"))
    (root / "raw/pass1").mkdir(parents=True)
    for path in (shared / "gotcha_afrl").glob("*.mat"):
        shutil.copyfile(path, root / f"raw/pass1/aircraft.{path.name}")
    run_steps(root)
    with serving(root) as address, shown(browser, address) as (frame, wrong):
        frame.locator("#targets button").first.click()
        until(frame, lambda: "cm along x" in frame.inner_text("#targets"))
        words = frame.inner_text("body").split()
        assert wrong == []
    assert not {"E", "N", "east,", "north"} & set(words)
    assert words.count("from") >= 3  # colours from; from x, from y


def test_the_map_does_not_see_the_window_around_it(browser, address):
    with shown(browser, address) as (frame, _):
        seen = "try { parent.document.title } catch (error) { return error.name } return 'seen'"
        assert frame.evaluate(f"() => {{ {seen} }}") == "SecurityError"


def test_a_page_that_came_with_the_results_is_not_shown_and_its_address_leads_to_the_map(browser, finished, tmp_path):
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


def test_a_page_of_a_look_shows_what_came_since_and_keeps_what_the_reader_chose(browser, tmp_path, monkeypatch):
    """A campaign of which half the pulses are there, then all: the page changes without being loaded again."""
    monkeypatch.setattr(preview_pair, "AT_ONCE", 60)
    root = simulate(tmp_path / "campaign", preset("demo", pulses=120), seed=1)
    preview = Preview(Campaign.load(root), follow=True, every_s=1.0, end_after_s=1e6)
    for node in preview.nodes.values():
        node.read()
    assert all(pair.add_next(ended=True) for pair in preview.pairs)
    preview.show(ended=False, elapsed_s=1.0)
    with serving(root, "--preview") as address, shown(browser, address) as (frame, wrong):
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
        words = next(one["reason"] for one in changed["images"] if one["image"] == "uav1-uav2")
        assert words not in before
        until(frame, lambda: words in frame.locator("#verdict").text_content())
        assert frame.locator("#image").input_value() == "f01/uav1-uav2"
        assert float(frame.locator("#low").input_value()) == pytest.approx(float(low), abs=0.5)
        assert frame.locator("#notices").text_content() == ""
    assert wrong == []
