"""Read-only HTTP server for the map of a campaign on this machine: the page, and products verified by their hashes.

A content security policy does not prevent a page from navigating its window to another site. The map is therefore a
frame of a different origin: the policy of the outer window restricts the navigation of the frame, and a sandboxed frame
can neither navigate the outer window nor open a new window. Browsers that support connection allowlists (Chromium 152)
apply these to all connections, including name look-ups, early connections and WebRTC, which the other headers do not
cover.
"""

import json
import os
import re
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from typing import IO, Any
from urllib.parse import parse_qsl, urlsplit

from apertura.campaign.digests import digest_of
from apertura.campaign.folder import Campaign
from apertura.campaign.store import manifest_of, read_manifest
from apertura.common.confined import ConfinedPath
from apertura.common.documents import read_json, undamaged
from apertura.common.errors import CampaignError
from apertura.common.processes import Interrupted
from apertura.common.provenance import sha256_file
from apertura.formats.export import MAP, PREVIEW, exports_in, product_files
from apertura.views.webmap.document import listed_document, named_files, requested_file
from apertura.views.webmap.kmz import overlay_of
from apertura.workflow.rules import INTERFEROMETRY

LOOPBACK = "127.0.0.1"
"""The only address on which the server listens; also the host name of the map and its data."""

WINDOW = "localhost"
"""Host name of the window around the map, which is a different origin for a browser."""

_RANGE = re.compile(r"bytes=(?:(\d{1,18})-(\d{1,18})?|-(\d{1,18}))", re.ASCII)


_TILES = re.compile(r"(https?://[A-Za-z0-9.-]+(?::\d{1,5})?)/[^\s\"'<>\\{}]+", re.ASCII)
_DEEPEST_ZOOM = 19  # of most public services; nearer views show these tiles enlarged


@dataclass(frozen=True)
class Tiles:
    """Background tiles of the map in the Web Mercator projection, from the only other host that the page contacts.

    Attributes
    ----------
    url
        Address of a tile, with ``{z}``, ``{x}`` and ``{y}`` (or ``{-y}``) for zoom level, column and row.
    attribution
        Text that names the source of the tiles on the map and in exported pictures.
    deepest_zoom
        Highest zoom level of the service.

    Raises
    ------
    CampaignError
        If the address is not that of tiles on a single host, or if the attribution is missing.

    Examples
    --------
    >>> Tiles("https://tiles.example/{z}/{x}/{y}.png", "© Example").origin
    'https://tiles.example'
    """

    url: str
    attribution: str
    deepest_zoom: int = _DEEPEST_ZOOM

    def __post_init__(self) -> None:
        fields = [field.replace("-", "") for field in re.findall(r"\{(?:z|x|-?y)\}", self.url)]
        path_only = re.sub(r"\{(z|x|-?y)\}", "()", self.url)  # parentheses are not allowed in a host name
        if _TILES.fullmatch(path_only) is None or sorted(fields) != ["{x}", "{y}", "{z}"]:
            raise CampaignError(
                f"tiles {self.url!r}",
                "apertura map --tiles",
                "the address of tiles on one host, for example https://tiles.example/{z}/{x}/{y}.png",
                "Copy the address from the documentation of the tile service, with one host name instead of {s}.",
            )
        if not self.attribution.strip():
            raise CampaignError(
                "tiles without attribution",
                "apertura map --tiles",
                "the text that the tile service requires on a map",
                'Add --tiles-attribution "© …".',
            )

    @property
    def origin(self) -> str:
        """Scheme, host and port of the tile service."""
        split = urlsplit(self.url)
        return f"{split.scheme}://{split.netloc}".lower()


class UnsatisfiableRangeError(ValueError):
    """Requested range that contains no byte of the file."""


def own_host(hosts: list[str], port: int) -> str | None:
    """Return the host name of this server as given in a request; None for any other name (DNS rebinding).

    Parameters
    ----------
    hosts
        All ``Host`` headers of the request.
    port
        Port of the server.

    Examples
    --------
    >>> own_host(["Localhost:8000"], 8000), own_host(["evil.example:8000"], 8000), own_host([], 8000)
    ('localhost', None, None)
    """
    names = {f"{name}:{port}": name for name in (LOOPBACK, WINDOW)}
    return names.get(hosts[0].lower()) if len(hosts) == 1 else None


def requested_range(header: str | None, size: int) -> tuple[int, int] | None:
    """Return the requested range as offsets of the first byte and of the byte after the last; None for the whole file.

    A header that is invalid or contains several ranges is ignored, i.e. the whole file is sent (RFC 9110, 14.2).

    Parameters
    ----------
    header
        ``Range`` header of the request.
    size
        File size in bytes.

    Raises
    ------
    UnsatisfiableRangeError
        If the range starts beyond the end of the file.

    Examples
    --------
    >>> requested_range("bytes=10-19", 100), requested_range("bytes=90-", 95)
    ((10, 20), (90, 95))
    >>> requested_range("bytes=-5", 95), requested_range(None, 9)
    ((90, 95), None)
    """
    match = _RANGE.fullmatch(header.strip()) if header else None
    if match is None:
        return None
    first, last, suffix = (None if digits is None else int(digits) for digits in match.groups())
    if first is None:
        first, last = size - min(size, suffix or 0), size - 1
    elif last is not None and last < first:
        return None
    if first >= size:
        raise UnsatisfiableRangeError(f"range starts at byte {first} of a file of {size} bytes")
    return first, min(size, size if last is None else last + 1)


_COMMON_HEADERS = {
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-DNS-Prefetch-Control": "off",
    "Cache-Control": "no-cache",
}


def headers_of(port: int, tiles: Tiles | None = None) -> Mapping[str, Mapping[str, str]]:
    """Return host name → headers of all responses to requests under that name.

    Parameters
    ----------
    port
        Port of the server.
    tiles
        Background tiles; without them, the map may connect to this server only.

    Examples
    --------
    >>> headers_of(8000)["localhost"]["Connection-Allowlist"]
    '(response-origin "http://127.0.0.1:8000")'
    """
    page, window = (f"http://{name}:{port}" for name in (LOOPBACK, WINDOW))
    window_policy = (
        f"default-src 'none'; script-src 'self'; style-src 'self'; frame-src {page}; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    images = "'self' data: blob:" + (f" {tiles.origin}" if tiles else "")
    allowed = "(response-origin" + (f' "{tiles.origin}")' if tiles else ")")
    page_policy = (
        f"default-src 'none'; script-src 'self'; style-src 'self'; img-src {images}; connect-src 'self'; "
        f"worker-src blob:; base-uri 'none'; form-action 'none'; frame-ancestors {window}; "
        "sandbox allow-scripts allow-same-origin allow-downloads"
    )
    return {
        WINDOW: _COMMON_HEADERS
        | {"Content-Security-Policy": window_policy, "Connection-Allowlist": f'(response-origin "{page}")'},
        LOOPBACK: _COMMON_HEADERS | {"Content-Security-Policy": page_policy, "Connection-Allowlist": allowed},
    }


SHELL = ("shell.html", "shell.js", "shell.css")
"""Files of the window that contains the map as a frame; the start page is the first."""

FILES = ("index.html", "app.js", "app.css")
"""Files of the map; the page is the first."""

BUILT = Path(__file__).parent / "page"
"""Output folder of `webmap/build.mjs`, which is part of the installed package but not of the sources."""


def page_files(built: Path = BUILT) -> Mapping[str, bytes]:
    """Return name → content of `SHELL` and `FILES`.

    Parameters
    ----------
    built
        Folder of the bundle.

    Raises
    ------
    CampaignError
        If this installation has no bundle.
    """
    if not is_built(built):
        raise CampaignError(
            "this installation has no map page: the page was not built in the sources that it was installed from",
            "apertura map",
            f"the page in {built}; wheels and source distributions of apertura contain it, clones do not",
            "Run `make webmap` (Node.js 20 or newer) in the sources and then, unless the installation is editable, "
            "`pip install .` again; or install a wheel or a source distribution.",
        )
    return {name: (built / name).read_bytes() for name in (*SHELL, *FILES)}


def is_built(built: Path = BUILT) -> bool:
    """Return True if the bundle is complete."""
    return all((built / name).is_file() for name in (*SHELL, *FILES))


_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".geojson": "application/geo+json",
    ".tif": "image/tiff",
    ".kmz": "application/vnd.google-earth.kmz",
}
_BLOCK_BYTES = 1 << 16
_WAIT_S = 0.2  # interval between checks for the first image
_IDLE_S = 60.0


class MapServer(ThreadingHTTPServer):
    """HTTP server for a page and for a list of files in a folder.

    Parameters
    ----------
    folder
        The results folder.
    files
        Function that returns the served files, path relative to the folder (with slashes) → required hash; no other
        file is served. The function is called for each request and raises CampaignError if the list cannot be read.
    page
        Files returned by `apertura.views.webmap.server.page_files`.
    sha256_of
        Function that returns the current hash of a file.
    overlay
        Function that returns the KMZ of a served raster; its arguments are the file and the parameters of the request.
    tiles
        Background tiles of the map.
    port
        Port to listen on; 0 for any free port.

    Raises
    ------
    CampaignError
        If the port is in use or not permitted.

    Examples
    --------
    >>> with MapServer(Path("results"), dict, page={}, sha256_of=str, overlay=lambda *_: b"") as server:
    ...     server.url.startswith("http://localhost:")
    True
    """

    daemon_threads = True

    def __init__(
        self,
        folder: Path,
        files: Callable[[], Mapping[str, str]],
        *,
        page: Mapping[str, bytes],
        sha256_of: Callable[[str], str],
        overlay: Callable[[str, Mapping[str, str]], bytes],
        tiles: Tiles | None = None,
        port: int = 0,
    ) -> None:
        self.folder, self.files, self.sha256_of = ConfinedPath.at(folder), files, sha256_of
        self.overlay, self.overlay_lock = overlay, threading.Lock()
        self.pages = {
            WINDOW: {name: content for name, content in page.items() if name in SHELL},
            LOOPBACK: {
                **{f"map/{name}": content for name, content in page.items() if name in FILES},
                "map/tiles.json": json.dumps(tiles and asdict(tiles)).encode(),
            },
        }
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except OSError as error:
            raise CampaignError(
                f"port {port}: {error.strerror}",
                "apertura map",
                "a free port",
                "Choose another --port, or omit the option.",
            ) from error
        self.url = f"http://{WINDOW}:{self.server_port}/"
        self.headers = headers_of(self.server_port, tiles)

    def show(self, *, in_browser: bool = False) -> None:
        """Print the URL, open it in a browser if requested, and serve until interrupted."""
        with self, suppress(Interrupted):
            print(f"{self.url}\nPress Ctrl-C to stop the server.", flush=True)
            if in_browser:
                webbrowser.open(self.url)
            self.serve_forever()

    def handle_error(self, request: object, client_address: object) -> None:  # noqa: ARG002
        """Print the error of a request in one line, unless the client closed the connection."""
        error = sys.exception()
        if not isinstance(error, ConnectionError | TimeoutError):
            print(f"error: a request failed: {error}", file=sys.stderr)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "apertura", ""
    timeout = _IDLE_S
    error_content_type = "text/plain; charset=utf-8"
    error_message_format = "%(code)d %(message)s\n"
    server: MapServer
    host = LOOPBACK

    def do_GET(self) -> None:
        self._answer()

    def do_HEAD(self) -> None:
        self._answer()

    def __getattr__(self, name: str) -> Callable[[], None]:
        """Return the handler that refuses the request for all other methods."""
        if name.startswith("do_"):
            return self._refuse
        raise AttributeError(name)

    def _refuse(self) -> None:
        self.close_connection = True  # the body of the request is not read
        self._respond(HTTPStatus.METHOD_NOT_ALLOWED, "the map is read-only", Allow="GET, HEAD")

    def _answer(self) -> None:
        host = own_host(self.headers.get_all("Host", []), self.server.server_port)
        if host is None:
            self._respond(HTTPStatus.FORBIDDEN, "the requested host name is not a name of this server")
            return
        self.host = host
        if self.headers.get("Content-Length", "0").strip() != "0" or "Transfer-Encoding" in self.headers:
            self.close_connection = True  # an unread body must not be parsed as the next request
            self._respond(HTTPStatus.BAD_REQUEST, "requests must not have a body")
            return
        is_top_level = self.path in {"/", "/map/"} or self.headers.get("Sec-Fetch-Dest") == "document"
        if is_top_level and host == LOOPBACK:  # opened directly instead of in the frame
            self._respond(HTTPStatus.FOUND, "the map", Location=self.server.url)
            return
        name, expected = (SHELL[0], None) if self.path == "/" else requested_file(self.path)
        if name in self.server.pages[host]:
            self._send(BytesIO(self.server.pages[host][name]), name)
        elif host == LOOPBACK:
            self._answer_file(name, expected)
        else:
            self._respond(HTTPStatus.NOT_FOUND, "only the window around the map is served under this host name")

    def _answer_file(self, name: str, expected: str | None) -> None:
        source = f"{name.removesuffix('.kmz')}.tif" if name.endswith(".kmz") else name
        try:
            sha256 = self.server.files().get(source)
        except CampaignError as error:
            self._respond(HTTPStatus.CONFLICT, str(error))
            return
        file = None if sha256 is None else self._opened(source)
        if file is None:
            self._respond(HTTPStatus.NOT_FOUND, "not a product of this campaign")
            return
        with file:
            if expected not in {None, sha256} or not self._has_hash(file, source, sha256):
                self._respond(
                    HTTPStatus.CONFLICT, "the file was changed after the map was made: run the workflow again"
                )
                return
            if source == name:
                self._send(file, name)
                return
        try:
            with self.server.overlay_lock:  # one at a time, because each needs several copies of the raster in memory
                content = self.server.overlay(source, dict(parse_qsl(urlsplit(self.path).query)))
        except CampaignError as error:
            self._respond(HTTPStatus.BAD_REQUEST, str(error))
            return
        self._send(BytesIO(content), name)

    def _opened(self, name: str) -> IO[bytes] | None:
        """Open a listed file; None if it is missing, behind a symbolic link, or not a regular file."""
        with suppress(OSError, CampaignError):
            return self.server.folder.named(name, where="request").open("rb")
        return None

    def _has_hash(self, file: IO[bytes], name: str, sha256: str | None) -> bool:
        """Return True if an open file has the given hash, which is computed by path (files are replaced atomically)."""
        with suppress(OSError, CampaignError):
            same = self.server.sha256_of(name) == sha256
            return same and os.path.samestat(os.fstat(file.fileno()), (self.server.folder / name).stat())
        return False

    def _send(self, file: IO[bytes], name: str) -> None:
        size = file.seek(0, os.SEEK_END)
        try:
            part = requested_range(self.headers.get("Range"), size)
        except UnsatisfiableRangeError:
            status = HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE
            self._respond(status, "range beyond the end of the file", Content_Range=f"bytes */{size}")
            return
        first, end = part or (0, size)
        self.send_response(HTTPStatus.PARTIAL_CONTENT if part else HTTPStatus.OK)
        self.send_header("Content-Type", _TYPES.get(Path(name).suffix, "application/octet-stream"))
        self.send_header("Content-Length", str(end - first))
        self.send_header("Accept-Ranges", "bytes")
        if part:
            self.send_header("Content-Range", f"bytes {first}-{end - 1}/{size}")
        self.end_headers()
        if self.command == "HEAD":
            return
        file.seek(first)
        remaining = end - first
        while remaining and (block := file.read(min(remaining, _BLOCK_BYTES))):
            self.wfile.write(block)
            remaining -= len(block)
        if remaining:  # file truncated meanwhile: the client must not parse the next response as the rest of the file
            self.close_connection = True

    def _respond(self, status: HTTPStatus, message: str, **headers: str) -> None:
        body = f"{message}\n".encode()
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Type", self.error_content_type)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def end_headers(self) -> None:
        for name, value in self.server.headers[self.host].items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002
        """Log nothing, because a map requests hundreds of ranges."""


def served_look(campaign: Campaign, *, tiles: Tiles | None = None, port: int = 0) -> MapServer:
    """Wait for the first image of `apertura preview`, and return a server for its images; parameters as in `served`."""
    folder = campaign.result(PREVIEW)
    path = folder / MAP
    if not path.is_file():
        print(
            "waiting for the first image of `apertura preview`, run in another terminal; press Ctrl-C to stop",
            flush=True,
        )
    while not path.is_file():
        time.sleep(_WAIT_S)
    expected, remedy = "a document of `apertura preview`", "Run `apertura preview CAMPAIGN` again."

    def document() -> Mapping[str, Any]:
        return read_json(path, expected=expected, remedy=remedy)

    def files() -> Mapping[str, str]:
        with undamaged(path, expected=expected, remedy=remedy):
            return {**named_files(document()), MAP: sha256_file(path)}

    return _serving(campaign, folder, files, document, tiles=tiles, port=port)


def served(campaign: Campaign, *, tiles: Tiles | None = None, port: int = 0) -> MapServer:
    """Return a server for the campaign's map and the products listed in it.

    Parameters
    ----------
    campaign
        A campaign with results.
    tiles
        Background tiles of the map.
    port
        Port to listen on; 0 for any free port.

    Raises
    ------
    CampaignError
        If the map is missing or was modified, if the port is in use, or if a local frame is given background tiles.
    """
    return _serving(
        campaign, campaign.results, _listing(campaign), lambda: listed_document(campaign), tiles=tiles, port=port
    )


def _serving(
    campaign: Campaign,
    folder: Path,
    files: Callable[[], Mapping[str, str]],
    document: Callable[[], Mapping[str, Any]],
    *,
    tiles: Tiles | None,
    port: int,
) -> MapServer:
    """Return a server for a folder of the campaign; raise CampaignError if the list of served files cannot be read."""
    files()
    if tiles and document()["crs"]["local"]:
        raise CampaignError(
            "background tiles for a local frame",
            "apertura map --tiles",
            "a campaign with geographic positions",
            "Omit --tiles.",
        )
    prefix = campaign.relative(folder)

    def sha256_of(name: str) -> str:
        return digest_of(campaign.root, f"{prefix}/{name}")

    def overlay(name: str, parameters: Mapping[str, str]) -> bytes:
        with undamaged(folder / MAP, expected="a map document", remedy="Run the workflow again."):
            return overlay_of(folder, document(), name, parameters)

    page = page_files()
    return MapServer(folder, files, page=page, sha256_of=sha256_of, overlay=overlay, tiles=tiles, port=port)


def _listing(campaign: Campaign) -> Callable[[], Mapping[str, str]]:
    """Return a function that lists the served results, file → SHA-256: `map.json` and the layers named in `map.json`.

    `map.json` and its manifest are read again if the manifest changed, which indicates a new run of the workflow.
    """
    pairs, rows = campaign.settings.interferometry.pairs, list(exports_in("interferogram"))
    products = {f"{INTERFEROMETRY}/{name}/{row.file}" for name in pairs for row in rows}
    products |= set(product_files(campaign.images, campaign.coefficients))

    @lru_cache(maxsize=1)
    def listed(*_: int) -> Mapping[str, str]:
        path = campaign.result(MAP)
        document = listed_document(campaign)
        with undamaged(path, expected="the map of a finished campaign", remedy="Run the workflow again."):
            named = {name: sha256 for name, sha256 in named_files(document).items() if name in products}
        return {**named, MAP: read_manifest(manifest_of(path))["files"][path.name]}

    def listed_now() -> Mapping[str, str]:
        with suppress(OSError):
            state = manifest_of(campaign.result(MAP)).stat()
            return listed(state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
        return listed()

    return listed_now
