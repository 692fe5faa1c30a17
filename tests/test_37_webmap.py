"""Map server: it serves its page and listed files to the local machine only, and the page inserts no text as HTML."""

import http.client
import json
import os
import re
import socket
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest

from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.views.webmap.document import FORMAT, Layer, image_entry, map_document, named_files
from apertura.views.webmap.server import FILES, SHELL, MapServer, Tiles, page_files

ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "webmap"
CONTENT = bytes(range(250)) * 400
IMAGE = "f01/a-b/db.tif"
PAGE = {name: name.encode() for name in (*SHELL, *FILES)}


@pytest.fixture
def results(tmp_path):
    """Create a folder of results next to a secret file, with links out of the folder and a pipe."""
    folder = tmp_path / "campaign" / "results"
    planted = [(f"map/{name}", b"planted") for name in PAGE]
    for name, content in ((IMAGE, CONTENT), ("f01/a-b/unlisted.tif", b"x"), ("empty", b""), *planted):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    secret = tmp_path / "secret"
    secret.mkdir()
    (secret / "key").write_text("secret")
    (folder / "link").symlink_to(secret / "key")
    (folder / "linked").symlink_to(secret)
    os.mkfifo(folder / "pipe")
    return folder


def overlay(name, parameters):
    """Return name and parameters of a request for an overlay; refuse the colours 'x'."""
    if parameters.get("colours") == "x":
        raise CampaignError("colours x", name, "a colour scale", "Choose another.")
    return json.dumps([name, parameters]).encode()


@contextmanager
def serving(folder, files, tiles=None):
    """Run a server with a list of files, a page whose files contain their own names, and overlays likewise."""
    with MapServer(
        folder,
        lambda: files,
        page=PAGE,
        sha256_of=lambda name: sha256_file(folder / name),
        overlay=overlay,
        tiles=tiles,
    ) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def server(results):
    files = {name: sha256_file(results / name) for name in (IMAGE, "empty", "link", "linked/key")}
    with serving(results, {**files, "../secret/key": files["link"], "pipe": "", "gone.tif": ""}) as running:
        yield running


def request(server, target, method="GET", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=5)
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, target, headers={"Host": f"127.0.0.1:{server.server_port}", **headers})
    response = connection.getresponse()
    body = response.read()
    connection.close()
    return response, body


@pytest.mark.parametrize(
    ("byte_range", "first", "end"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=1000-1999", 1000, 2000),
        ("bytes=99990-", 99990, 100000),
        ("bytes=-7", 99993, 100000),
        ("bytes=-999999", 0, 100000),
        ("bytes=99999-200000", 99999, 100000),
    ],
)
def test_byte_range_is_returned(server, byte_range, first, end):
    response, body = request(server, f"/{IMAGE}", Range=byte_range)
    assert response.status == 206
    assert body == CONTENT[first:end]
    assert response.headers["Content-Range"] == f"bytes {first}-{end - 1}/100000"
    assert response.headers["Content-Type"] == "image/tiff"
    head, head_body = request(server, f"/{IMAGE}", "HEAD", Range=byte_range)
    assert (head.status, head.headers["Content-Length"], head_body) == (206, str(end - first), b"")


@pytest.mark.parametrize("byte_range", ["bytes=100000-", "bytes=100000-100001", "bytes=-0"])
def test_byte_range_beyond_the_file_is_refused(server, byte_range):
    response, _ = request(server, f"/{IMAGE}", Range=byte_range)
    assert response.status == 416
    assert response.headers["Content-Range"] == "bytes */100000"
    assert request(server, "/empty", Range="bytes=0-")[0].status == 416


@pytest.mark.parametrize(
    "byte_range", ["bytes=5-2", "bytes=0-1,5-6", "lines=1-2", "bytes=a-b", "bytes=٣-٤".encode(), "bytes=-"]
)
def test_invalid_or_multiple_ranges_return_the_whole_file(server, byte_range):
    response, body = request(server, f"/{IMAGE}", Range=byte_range)
    assert (response.status, body) == (200, CONTENT)


@pytest.mark.parametrize(
    "target",
    [
        "/f01/a-b/unlisted.tif",
        "/../secret/key",
        "/%2e%2e/secret/key",
        "/..%2fsecret%2fkey",
        "/link",
        "/linked/key",
        "/pipe",
        "/gone.tif",
        "/f01/a-b",
        "/f01/a-b/",
        f"/./{IMAGE}",
        f"http://127.0.0.1/{IMAGE}",
        f"/{IMAGE}%00",
        "/%ff",
        "*",
        "",
    ],
)
def test_only_listed_files_are_served_and_none_through_a_link(server, target):
    response, body = request(server, target or "/nothing")
    assert response.status == 404
    assert b"secret" not in body


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{}", "127.0.0.1", "127.0.0.1:1", "127.0.0.1.evil:{}", ""]
)
def test_request_with_a_foreign_host_is_refused(server, host):
    response, body = request(server, f"/{IMAGE}", Host=host.format(server.server_port))
    assert (response.status, CONTENT[:9] in body) == (403, False)


def test_request_with_two_hosts_is_refused(server):
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=5) as plain:
        host = f"Host: 127.0.0.1:{server.server_port}\r\n"
        plain.sendall(f"GET /{IMAGE} HTTP/1.1\r\n{host}{host}\r\n".encode())
        assert b" 403 " in plain.recv(100)
    assert server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize("body", ["Content-Length: 24\r\n\r\n", "Transfer-Encoding: chunked\r\n\r\n18\r\n"])
def test_request_body_is_not_parsed_as_a_request(server, body):
    inner = f"GET /{IMAGE} HTTP/1.1\r\n\r\n"
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=5) as plain:
        plain.sendall(f"GET /empty HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n{body}{inner}".encode())
        received = b"".join(iter(lambda: plain.recv(1 << 16), b""))  # until the server closes
    assert received.startswith(b"HTTP/1.1 400 ")
    assert received.count(b"HTTP/1.1 ") == 1


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "BREW"])
def test_only_get_and_head_are_allowed(server, method):
    response, _ = request(server, f"/{IMAGE}", method)
    assert (response.status, response.headers["Allow"]) == (405, "GET, HEAD")


def test_overlay_is_made_of_a_verified_raster(server, results):
    sha256 = sha256_file(results / IMAGE)
    response, body = request(server, f"/f01/a-b/db.kmz?sha256={sha256}&low=-40&high=0")
    assert (response.status, response.headers["Content-Type"]) == (200, "application/vnd.google-earth.kmz")
    assert json.loads(body) == [IMAGE, {"sha256": sha256, "low": "-40", "high": "0"}]
    assert request(server, f"/f01/a-b/db.kmz?sha256={'0' * 64}")[0].status == 409
    response, body = request(server, f"/f01/a-b/db.kmz?sha256={sha256}&colours=x")
    assert (response.status, body) == (400, b"f01/a-b/db.tif: colours x; expected a colour scale. Choose another.\n")
    for target in ("/f01/a-b/unlisted.kmz", "/../secret/key.kmz", "/link.kmz", "/empty.kmz", "/.kmz"):
        assert request(server, target)[0].status == 404
    (results / IMAGE).write_bytes(CONTENT[::-1])
    assert request(server, "/f01/a-b/db.kmz")[0].status == 409


TILES = Tiles("https://tiles.example:8443/{z}/{x}/{y}.png?key=1", "© Example")


def test_tiles_admit_their_host_for_pictures_only(results):
    with serving(results, {}) as server:
        plain = request(server, "/map/index.html")[0].headers
        assert request(server, "/map/tiles.json")[1] == b"null"
    with serving(results, {}, TILES) as server:
        response, body = request(server, "/map/tiles.json")
        window = request(server, "/", Host=f"localhost:{server.server_port}")[0].headers
    assert json.loads(body) == {"url": TILES.url, "attribution": "© Example", "deepest_zoom": 19}
    before, after = (
        dict(part.split(" ", 1) for part in headers["Content-Security-Policy"].split("; "))
        for headers in (plain, response.headers)
    )
    changed = {name: after[name] for name in after if name != "frame-ancestors" and after[name] != before[name]}
    assert changed == {"img-src": "'self' data: blob: https://tiles.example:8443"}
    assert response.headers["Connection-Allowlist"] == '(response-origin "https://tiles.example:8443")'
    assert not any("tiles.example" in value for value in window.values())


@pytest.mark.parametrize(
    "url",
    [
        "https://{s}.tiles.example/{z}/{x}/{y}.png",
        "https://tiles.example/{z}/{x}.png",
        "https://tiles.example/{z}/{x}/{x}.png",
        "https://tiles.example/{z}/{x}/{y}/{a-c}.png",
        "https://tiles.example; script-src */{z}/{x}/{y}.png",
        'https://tiles.example"/{z}/{x}/{y}.png',
        "https://user@tiles.example/{z}/{x}/{y}.png",
        "https://*/{z}/{x}/{y}.png",
        "//tiles.example/{z}/{x}/{y}.png",
        "javascript:{z}{x}{y}",
        "https://tiles.exämple/{z}/{x}/{y}.png",
        "https://{z}/{x}/{y}.png",
        "",
    ],
)
def test_tiles_of_several_hosts_or_none_are_refused(url):
    with pytest.raises(CampaignError, match="expected the address of tiles on one host"):
        Tiles(url, "© Example")


def test_tiles_require_an_attribution():
    with pytest.raises(CampaignError, match=r"tiles without attribution; .* Add --tiles-attribution"):
        Tiles(TILES.url, " ")


@pytest.mark.parametrize(("host", "other"), [("127.0.0.1", "localhost"), ("localhost", "127.0.0.1")])
@pytest.mark.parametrize("target", ["/", "/map/index.html", f"/{IMAGE}", "/nothing", f"/{IMAGE}?sha256=0"])
def test_every_response_forbids_other_hosts(server, target, host, other):
    response, _ = request(server, target, Host=f"{host}:{server.server_port}")
    policy, other_origin = response.headers["Content-Security-Policy"], f"http://{other}:{server.server_port}"
    assert policy.startswith("default-src 'none';")
    assert not re.search(r"http|\*|unsafe", policy.replace(f"{other_origin};", ""))
    if host == "localhost":
        assert {f"frame-src {other_origin}", "frame-ancestors 'none'"} <= set(policy.split("; "))
        assert response.headers["Connection-Allowlist"] == f'(response-origin "{other_origin}")'
    else:
        required = {f"frame-ancestors {other_origin}", "sandbox allow-scripts allow-same-origin allow-downloads"}
        assert required <= set(policy.split("; "))
        assert response.headers["Connection-Allowlist"] == "(response-origin)"
    assert response.headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert response.headers["X-Content-Type-Options"] == "nosniff"
    assert response.headers["X-DNS-Prefetch-Control"] == "off"


def test_page_files_are_served_only_from_their_own_origin(server):
    window = {"/": "shell.html", **{f"/{name}": name for name in SHELL}}
    page = {f"/map/{name}": name for name in FILES}
    for host, own, foreign in (("localhost", window, page), ("127.0.0.1", page, window)):
        for target, name in own.items():
            response, body = request(server, target, Host=f"{host}:{server.server_port}")
            assert (response.status, body) == (200, name.encode())
        for target in (foreign.keys() - {"/"}) | {"/map/shell.html", "/index.html", "/map/other.js"}:
            assert request(server, target, Host=f"{host}:{server.server_port}")[0].status == 404
    assert request(server, f"/{IMAGE}", Host=f"localhost:{server.server_port}")[0].status == 404


@pytest.mark.parametrize(
    ("target", "destination"), [("/", ""), ("/map/", ""), ("/map/index.html", "document"), (f"/{IMAGE}", "document")]
)
def test_direct_navigation_is_redirected_to_the_map_window(server, target, destination):
    response, _ = request(server, target, Sec_Fetch_Dest=destination)
    assert (response.status, response.headers["Location"]) == (302, server.url)
    assert server.url == f"http://localhost:{server.server_port}/"


def test_file_with_another_hash_is_not_served(server, results):
    expected_sha256 = sha256_file(results / IMAGE)
    for target in (f"/{IMAGE}?sha256={expected_sha256}", f"/{IMAGE}"):
        assert request(server, target)[0].status == 200
    assert request(server, f"/{IMAGE}?sha256={'0' * 64}")[0].status == 409
    (results / IMAGE).write_bytes(CONTENT[::-1])
    for target in (
        f"/{IMAGE}?sha256={expected_sha256}",
        f"/{IMAGE}?sha256={sha256_file(results / IMAGE)}",
        f"/{IMAGE}",
    ):
        response, body = request(server, target)
        message = b"the file was changed after the map was made: run the workflow again\n"
        assert (response.status, body) == (409, message)


def test_connection_reset_leaves_the_server_running_without_output(server, capfd):
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", server.server_port)) as plain:
            plain.sendall(f"GET /{IMAGE} HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode())
            plain.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # reset
    assert request(server, f"/{IMAGE}")[0].status == 200
    assert capfd.readouterr().err == ""


def test_port_in_use_is_reported(server, results):
    with pytest.raises(CampaignError, match=r"apertura map: port \d+: Address already in use; expected a free port"):
        MapServer(results, dict, page={}, sha256_of=str, overlay=overlay, port=server.server_port)


def test_untrusted_names_are_encoded_in_urls():
    name = 'a"<b>#?&%2f é'
    layer = Layer(f"{name}.tif", "0f", "image", name, "dB", -50.0, 0.0)
    report = {"focus": {"verdict": name, "reason": ""}, "numerical_error_db": -60, "flags": {}}
    entry = image_entry(name, "a-b", report, [layer], {"TIFFTAG_COPYRIGHT": name})
    assert re.fullmatch(r"\.\./[\w%./-]+\.tif\?sha256=0f", entry["layers"][0]["url"], re.ASCII)
    grid = {"bounds_m": [0, 0, 1, 1], "spacing_m": 1.0, "shape": [1, 1]}
    document = map_document(name, grid=grid, crs={}, images=[entry], places=[], coverage_url=None)
    assert json.loads(json.dumps(document))["campaign"] == name
    assert named_files(document) == {f"{name}/a-b/{name}.tif": "0f"}


def test_only_hashed_files_of_the_current_format_are_listed():
    urls = ["../f01/a-b/db.tif", "https://x/y.tif?sha256=0f", "../f01/%ff.tif?sha256=0f"]
    document = {"images": [{"layers": [{"url": url} for url in urls]}], "coverage_url": "../coverage.geojson?sha256=0f"}
    assert named_files({"format": FORMAT, **document}) == {"coverage.geojson": "0f"}
    assert named_files({"format": FORMAT + 1}) == {}


def test_missing_map_page_is_reported_with_a_remedy(tmp_path):
    with pytest.raises(CampaignError, match=r"no map page: the page was not built in the sources.*make webmap"):
        page_files(tmp_path)
    for name in PAGE:
        (tmp_path / name).write_text(name)
    assert page_files(tmp_path) == PAGE


def test_page_scripts_do_not_insert_html():
    scripts = {path.name: path.read_text() for path in (SOURCES / "src").glob("*.js")}
    assert scripts.keys() >= {"app.js", "dom.js", "chart.js", "shell.js"}
    unsafe = re.compile(
        r"innerHTML|outerHTML|insertAdjacent|document\.write|\beval\b|new Function|srcdoc|https?://(?!www\.w3\.org/2000/svg)"
    )
    assert {name: unsafe.findall(text) for name, text in scripts.items() if unsafe.search(text)} == {}


@pytest.mark.parametrize(
    ("file", "references"), [("index.html", ["data:,", "app.css", "app.js"]), ("shell.html", ["shell.css", "shell.js"])]
)
def test_page_refers_to_no_other_host_and_contains_no_inline_code(file, references):
    page = (SOURCES / "src" / file).read_text()
    assert re.findall(r"(?:src|href)=\"([^\"]*)\"", page) == references
    assert not re.search(r"<script(?! src=)|<style|\son\w+=|style=|https?:", page)


def test_locked_libraries_have_hashes_and_no_registry():
    lock = (SOURCES / "package-lock.json").read_text()
    packages = json.loads(lock)["packages"]
    assert len(packages) > 20
    assert all(name == "" or package["integrity"].startswith("sha512-") for name, package in packages.items())
    assert '"resolved"' not in lock
