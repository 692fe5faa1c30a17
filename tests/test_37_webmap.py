"""The map's server gives its own page and the listed files to this machine alone; the page brings no text to HTML."""

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
from apertura.views.webmap.server import FILES, SHELL, MapServer, page_files

ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "webmap"
CONTENT = bytes(range(250)) * 400
IMAGE = "f01/a-b/db.tif"
PAGE = {name: name.encode() for name in (*SHELL, *FILES)}


@pytest.fixture
def results(tmp_path):
    """A folder of results beside a secret, with links out of it and a pipe."""
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


@contextmanager
def serving(folder, files, page=PAGE):
    """Serve with a list of files as it is at each request, and a page of which each file holds its name."""
    with MapServer(folder, lambda: files, page=page, sha256_of=lambda name: sha256_file(folder / name)) as server:
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


def ask(server, target, method="GET", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=5)
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, target, headers={"Host": f"127.0.0.1:{server.server_port}", **headers})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


@pytest.mark.parametrize(
    ("asked", "first", "end"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=1000-1999", 1000, 2000),
        ("bytes=99990-", 99990, 100000),
        ("bytes=-7", 99993, 100000),
        ("bytes=-999999", 0, 100000),
        ("bytes=99999-200000", 99999, 100000),
    ],
)
def test_a_range_is_answered_with_those_bytes(server, asked, first, end):
    answer, body = ask(server, f"/{IMAGE}", Range=asked)
    assert answer.status == 206
    assert body == CONTENT[first:end]
    assert answer.headers["Content-Range"] == f"bytes {first}-{end - 1}/100000"
    assert answer.headers["Content-Type"] == "image/tiff"
    head, nothing = ask(server, f"/{IMAGE}", "HEAD", Range=asked)
    assert (head.status, head.headers["Content-Length"], nothing) == (206, str(end - first), b"")


@pytest.mark.parametrize("asked", ["bytes=100000-", "bytes=100000-100001", "bytes=-0"])
def test_a_range_beyond_the_file_is_refused(server, asked):
    answer, _ = ask(server, f"/{IMAGE}", Range=asked)
    assert answer.status == 416
    assert answer.headers["Content-Range"] == "bytes */100000"
    assert ask(server, "/empty", Range="bytes=0-")[0].status == 416


@pytest.mark.parametrize(
    "asked", ["bytes=5-2", "bytes=0-1,5-6", "lines=1-2", "bytes=a-b", "bytes=٣-٤".encode(), "bytes=-"]
)
def test_what_is_no_single_range_gets_the_whole_file(server, asked):
    answer, body = ask(server, f"/{IMAGE}", Range=asked)
    assert (answer.status, body) == (200, CONTENT)


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
def test_nothing_but_the_listed_files_is_reached_and_none_through_a_link(server, target):
    answer, body = ask(server, target or "/nothing")
    assert answer.status == 404
    assert b"secret" not in body


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{}", "127.0.0.1", "127.0.0.1:1", "127.0.0.1.evil:{}", ""]
)
def test_a_page_of_another_name_that_leads_here_is_refused(server, host):
    answer, body = ask(server, f"/{IMAGE}", Host=host.format(server.server_port))
    assert (answer.status, CONTENT[:9] in body) == (403, False)


def test_two_hosts_in_one_request_are_refused(server):
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=5) as plain:
        host = f"Host: 127.0.0.1:{server.server_port}\r\n"
        plain.sendall(f"GET /{IMAGE} HTTP/1.1\r\n{host}{host}\r\n".encode())
        assert b" 403 " in plain.recv(100)
    assert server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize("body", ["Content-Length: 24\r\n\r\n", "Transfer-Encoding: chunked\r\n\r\n18\r\n"])
def test_the_body_of_a_request_is_no_further_request(server, body):
    inner = f"GET /{IMAGE} HTTP/1.1\r\n\r\n"
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=5) as plain:
        plain.sendall(f"GET /empty HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n{body}{inner}".encode())
        answered = b"".join(iter(lambda: plain.recv(1 << 16), b""))  # until the server closes
    assert answered.startswith(b"HTTP/1.1 400 ")
    assert answered.count(b"HTTP/1.1 ") == 1


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "BREW"])
def test_a_map_is_only_read(server, method):
    answer, _ = ask(server, f"/{IMAGE}", method)
    assert (answer.status, answer.headers["Allow"]) == (405, "GET, HEAD")


@pytest.mark.parametrize(("host", "other"), [("127.0.0.1", "localhost"), ("localhost", "127.0.0.1")])
@pytest.mark.parametrize("target", ["/", "/map/index.html", f"/{IMAGE}", "/nothing", f"/{IMAGE}?sha256=0"])
def test_every_answer_forbids_the_browser_all_other_hosts(server, target, host, other):
    answer, _ = ask(server, target, Host=f"{host}:{server.server_port}")
    policy, ours = answer.headers["Content-Security-Policy"], f"http://{other}:{server.server_port}"
    assert policy.startswith("default-src 'none';")
    assert not re.search(r"http|\*|unsafe", policy.replace(f"{ours};", ""))
    if host == "localhost":
        assert {f"frame-src {ours}", "frame-ancestors 'none'"} <= set(policy.split("; "))
        assert answer.headers["Connection-Allowlist"] == f'(response-origin "{ours}")'
    else:
        kept = {f"frame-ancestors {ours}", "sandbox allow-scripts allow-same-origin allow-downloads"}
        assert kept <= set(policy.split("; "))
        assert answer.headers["Connection-Allowlist"] == "(response-origin)"
    assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert answer.headers["X-DNS-Prefetch-Control"] == "off"


def test_the_page_is_our_own_and_each_part_is_answered_under_its_own_name_alone(server):
    window = {"/": "shell.html", **{f"/{name}": name for name in SHELL}}
    page = {f"/map/{name}": name for name in FILES}
    for host, here, elsewhere in (("localhost", window, page), ("127.0.0.1", page, window)):
        for target, name in here.items():
            answer, body = ask(server, target, Host=f"{host}:{server.server_port}")
            assert (answer.status, body) == (200, name.encode())
        for target in (elsewhere.keys() - {"/"}) | {"/map/shell.html", "/index.html", "/map/other.js"}:
            assert ask(server, target, Host=f"{host}:{server.server_port}")[0].status == 404
    assert ask(server, f"/{IMAGE}", Host=f"localhost:{server.server_port}")[0].status == 404


@pytest.mark.parametrize(
    ("target", "wanted"), [("/", ""), ("/map/", ""), ("/map/index.html", "document"), (f"/{IMAGE}", "document")]
)
def test_what_a_reader_opens_beside_the_window_leads_to_it(server, target, wanted):
    answer, _ = ask(server, target, Sec_Fetch_Dest=wanted)
    assert (answer.status, answer.headers["Location"]) == (302, server.url)
    assert server.url == f"http://localhost:{server.server_port}/"


def test_a_file_that_is_not_the_one_that_was_meant_is_not_given(server, results):
    meant = sha256_file(results / IMAGE)
    for target in (f"/{IMAGE}?sha256={meant}", f"/{IMAGE}"):
        assert ask(server, target)[0].status == 200
    assert ask(server, f"/{IMAGE}?sha256={'0' * 64}")[0].status == 409
    (results / IMAGE).write_bytes(CONTENT[::-1])
    for target in (f"/{IMAGE}?sha256={meant}", f"/{IMAGE}?sha256={sha256_file(results / IMAGE)}", f"/{IMAGE}"):
        answer, body = ask(server, target)
        assert (answer.status, body) == (409, b"changed since the map was made: run the workflow again\n")


def test_a_reader_that_goes_leaves_the_server_silent_and_up(server, capfd):
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", server.server_port)) as plain:
            plain.sendall(f"GET /{IMAGE} HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode())
            plain.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # reset
    assert ask(server, f"/{IMAGE}")[0].status == 200
    assert capfd.readouterr().err == ""


def test_a_port_that_is_taken_is_one_message(server, results):
    with pytest.raises(CampaignError, match=r"apertura map: port \d+: Address already in use; expected a free port"):
        MapServer(results, dict, page={}, sha256_of=str, port=server.server_port)


def test_a_name_of_a_stranger_is_encoded_in_every_address():
    hostile = 'a"<b>#?&%2f é'
    layer = Layer(f"{hostile}.tif", "0f", "image", hostile, "dB", -50.0, 0.0)
    report = {"focus": {"verdict": hostile, "why": ""}, "numerical_error_db": -60, "flags": {}}
    entry = image_entry(hostile, "a-b", report, [layer])
    assert re.fullmatch(r"\.\./[\w%./-]+\.tif\?sha256=0f", entry["layers"][0]["url"], re.ASCII)
    grid = {"bounds_m": [0, 0, 1, 1], "spacing_m": 1.0, "shape": [1, 1]}
    document = map_document(hostile, grid=grid, crs={}, images=[entry], places=[], coverage_url=None)
    assert json.loads(json.dumps(document))["campaign"] == hostile
    assert named_files(document) == {f"{hostile}/a-b/{hostile}.tif": "0f"}


def test_a_document_names_no_file_without_its_hash_and_none_in_another_format():
    urls = ["../f01/a-b/db.tif", "https://x/y.tif?sha256=0f", "../f01/%ff.tif?sha256=0f"]
    document = {"images": [{"layers": [{"url": url} for url in urls]}], "coverage_url": "../coverage.geojson?sha256=0f"}
    assert named_files({"format": FORMAT, **document}) == {"coverage.geojson": "0f"}
    assert named_files({"format": FORMAT + 1}) == {}


def test_without_a_bundle_there_is_no_address_but_one_message_how_to_get_it(tmp_path):
    with pytest.raises(CampaignError, match=r"no map page, because pip install does not build it.*make webmap"):
        page_files(tmp_path)
    for name in PAGE:
        (tmp_path / name).write_text(name)
    assert page_files(tmp_path) == PAGE


def test_the_pages_code_writes_text_as_text():
    scripts = {path.name: path.read_text() for path in (SOURCES / "src").glob("*.js")}
    assert scripts.keys() >= {"app.js", "dom.js", "chart.js", "shell.js"}
    wrong = re.compile(
        r"innerHTML|outerHTML|insertAdjacent|document\.write|\beval\b|new Function|srcdoc|https?://(?!www\.w3\.org/2000/svg)"
    )
    assert {name: wrong.findall(text) for name, text in scripts.items() if wrong.search(text)} == {}


@pytest.mark.parametrize(
    ("file", "named"), [("index.html", ["data:,", "app.css", "app.js"]), ("shell.html", ["shell.css", "shell.js"])]
)
def test_the_page_names_no_other_host_and_holds_no_code(file, named):
    page = (SOURCES / "src" / file).read_text()
    assert re.findall(r"(?:src|href)=\"([^\"]*)\"", page) == named
    assert not re.search(r"<script(?! src=)|<style|\son\w+=|style=|https?:", page)


def test_the_locked_libraries_come_by_hash_and_name_no_registry():
    lock = (SOURCES / "package-lock.json").read_text()
    packages = json.loads(lock)["packages"]
    assert len(packages) > 20
    assert all(name == "" or one["integrity"].startswith("sha512-") for name, one in packages.items())
    assert '"resolved"' not in lock
