"""The map's server gives the listed files of one campaign to this machine alone; its page brings no text to HTML."""

import http.client
import json
import os
import re
import socket
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest

from apertura.errors import CampaignError
from apertura.provenance import sha256_file
from apertura.webmap.document import Layer, image_entry, map_document
from apertura.webmap.page import FILES, page_files, page_sha256
from apertura.webmap.server import PAGE, MapServer

ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "webmap"
CONTENT = bytes(range(250)) * 400
IMAGE = "f01/a-b/db.tif"


@pytest.fixture
def results(tmp_path):
    """A folder of results beside a secret, with links out of it and a pipe."""
    folder = tmp_path / "campaign" / "results"
    for name, content in ((IMAGE, CONTENT), (PAGE, b"<!doctype html>"), ("f01/a-b/unlisted.tif", b"x"), ("empty", b"")):
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
def serving(folder, files, sha256_of=None):
    with MapServer(folder, files, sha256_of=sha256_of or (lambda name: sha256_file(folder / name))) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def server(results):
    with serving(results, [IMAGE, PAGE, "empty", "link", "linked/key", "pipe", "gone.tif", "../secret/key"]) as running:
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


def test_one_name_of_this_machine_is_taken_and_two_hosts_are_not(server):
    assert ask(server, f"/{IMAGE}", Host=f"localhost:{server.server_port}")[0].status == 200
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=5) as plain:
        host = f"Host: 127.0.0.1:{server.server_port}\r\n"
        plain.sendall(f"GET /{IMAGE} HTTP/1.1\r\n{host}{host}\r\n".encode())
        assert b" 403 " in plain.recv(100)
    assert server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "BREW"])
def test_a_map_is_only_read(server, method):
    answer, _ = ask(server, f"/{IMAGE}", method)
    assert (answer.status, answer.headers["Allow"]) == (405, "GET, HEAD")


@pytest.mark.parametrize("target", ["/", f"/{IMAGE}", "/nothing", f"/{IMAGE}?sha256=0"])
def test_every_answer_forbids_the_browser_all_other_hosts(server, target):
    answer, _ = ask(server, target)
    policy = answer.headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none';")
    assert not re.search(r"http|\*|unsafe", policy)
    assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert answer.headers["X-Content-Type-Options"] == "nosniff"


def test_the_root_leads_to_the_page(server):
    answer, _ = ask(server, "/")
    assert (answer.status, answer.headers["Location"]) == (302, f"/{PAGE}")


def test_a_file_that_changed_after_the_map_was_made_is_not_shown_as_the_one_that_was_meant(server, results):
    meant = sha256_file(results / IMAGE)
    assert ask(server, f"/{IMAGE}?sha256={meant}")[0].status == 200
    (results / IMAGE).write_bytes(CONTENT[::-1])
    answer, body = ask(server, f"/{IMAGE}?sha256={meant}")
    assert (answer.status, body) == (409, b"changed since the map was made: run the workflow again\n")
    assert ask(server, f"/{IMAGE}")[0].status == 200


def test_a_reader_that_goes_leaves_the_server_silent_and_up(server, capfd):
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", server.server_port)) as plain:
            plain.sendall(f"GET /{IMAGE} HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode())
            plain.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # reset
    assert ask(server, f"/{IMAGE}")[0].status == 200
    assert capfd.readouterr().err == ""


def test_a_port_that_is_taken_is_one_message(server, results):
    with pytest.raises(CampaignError, match=r"apertura map: port \d+: Address already in use; expected a free port"):
        MapServer(results, [], sha256_of=str, port=server.server_port)


def test_a_name_of_a_stranger_is_encoded_in_every_address():
    hostile = 'a"<b>#?&%2f é'
    layer = Layer(f"{hostile}.tif", "0f", "image", hostile, "dB", -50.0, 0.0)
    report = {"focus": {"verdict": hostile, "why": ""}, "numerical_error_db": -60, "flags": {}}
    entry = image_entry(hostile, "a-b", report, [layer])
    assert re.fullmatch(r"\.\./[\w%./-]+\.tif\?sha256=0f", entry["layers"][0]["url"], re.ASCII)
    grid = {"bounds_m": [0, 0, 1, 1], "spacing_m": 1.0, "shape": [1, 1]}
    document = map_document(hostile, grid=grid, crs={}, images=[entry], places=[], coverage_url=None)
    assert json.loads(json.dumps(document))["campaign"] == hostile


def test_without_a_bundle_the_page_says_how_to_get_one(tmp_path):
    only = page_files(tmp_path)
    assert list(only) == ["index.html"]
    assert b"make webmap" in only["index.html"]
    assert b"<script" not in only["index.html"]


def test_another_bundle_is_another_page(tmp_path):
    for folder in ("one", "other"):
        (tmp_path / folder).mkdir()
        for name in FILES:
            (tmp_path / folder / name).write_text(folder if name == "app.js" else name)
    assert len({page_sha256(tmp_path / folder) for folder in ("one", "other", "none")}) == 3
    assert page_files(tmp_path / "one")["app.js"] == b"one"


def test_the_pages_code_writes_text_as_text():
    scripts = {path.name: path.read_text() for path in (SOURCES / "src").glob("*.js")}
    assert scripts.keys() >= {"app.js", "dom.js", "chart.js"}
    wrong = re.compile(
        r"innerHTML|outerHTML|insertAdjacent|document\.write|\beval\b|new Function|srcdoc|https?://(?!www\.w3\.org/2000/svg)"
    )
    assert {name: wrong.findall(text) for name, text in scripts.items() if wrong.search(text)} == {}


def test_the_page_names_no_other_host_and_holds_no_code():
    page = (SOURCES / "src" / "index.html").read_text()
    assert re.findall(r"(?:src|href)=\"([^\"]*)\"", page) == ["data:,", "app.css", "app.js"]
    assert not re.search(r"<script(?! src=)|<style|\son\w+=|style=|https?:", page)


def test_the_locked_libraries_come_by_hash_and_name_no_registry():
    lock = (SOURCES / "package-lock.json").read_text()
    packages = json.loads(lock)["packages"]
    assert len(packages) > 20
    assert all(name == "" or one["integrity"].startswith("sha512-") for name, one in packages.items())
    assert '"resolved"' not in lock
