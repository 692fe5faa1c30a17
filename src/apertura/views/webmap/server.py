"""The map of one campaign on this machine alone: the page, and products listed with their hashes; read only.

No policy of content keeps a page from leading its own window elsewhere. So the map is a frame of another origin: where
a frame may be led to is for the window around it to say, and a sandboxed frame leads no window and opens none. Browsers
that know connection allowlists (Chromium 152) hold to them for everything, name look-ups, early connections and WebRTC
too, which no other header of all these reaches.
"""

import os
import re
import sys
import time
import webbrowser
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from typing import IO

from apertura.campaign.digests import digest_of
from apertura.campaign.folder import Campaign
from apertura.campaign.store import manifest_of, open_listed, read_manifest
from apertura.common.confined import ConfinedPath
from apertura.common.documents import read_json, undamaged
from apertura.common.errors import CampaignError
from apertura.common.processes import Interrupted
from apertura.common.provenance import sha256_file
from apertura.formats.export import LOOK, MAP, product_files
from apertura.views.webmap.document import named_files, requested_file

LOOPBACK = "127.0.0.1"
"""The only address that is listened on, and the name under which the map and its data are answered."""

WINDOW = "localhost"
"""The name under which the window around the map is answered: to a browser, another origin."""

_RANGE = re.compile(r"bytes=(?:(\d{1,18})-(\d{1,18})?|-(\d{1,18}))", re.ASCII)


class UnsatisfiableRangeError(ValueError):
    """The requested range has no byte of the file."""


def own_host(hosts: list[str], port: int) -> str | None:
    """Return the host name of this server in a request; None for another that leads here (DNS rebinding).

    Parameters
    ----------
    hosts
        Every ``Host`` of the request.
    port
        Of the server.

    Examples
    --------
    >>> own_host(["Localhost:8000"], 8000), own_host(["evil.example:8000"], 8000), own_host([], 8000)
    ('localhost', None, None)
    """
    names = {f"{name}:{port}": name for name in (LOOPBACK, WINDOW)}
    return names.get(hosts[0].lower()) if len(hosts) == 1 else None


def requested_range(header: str | None, size: int) -> tuple[int, int] | None:
    """Return the first requested byte and the one after the last; None for the whole file.

    A header that is none, or asks for several ranges, asks for the whole file (RFC 9110, 14.2).

    Parameters
    ----------
    header
        ``Range`` of the request.
    size
        Bytes of the file.

    Raises
    ------
    UnsatisfiableRangeError
        If the range begins beyond the file.

    Examples
    --------
    >>> requested_range("bytes=10-19", 100), requested_range("bytes=90-", 95)
    ((10, 20), (90, 95))
    >>> requested_range("bytes=-5", 95), requested_range(None, 9)
    ((90, 95), None)
    """
    found = _RANGE.fullmatch(header.strip()) if header else None
    if found is None:
        return None
    first, last, suffix = (None if digits is None else int(digits) for digits in found.groups())
    if first is None:
        first, last = size - min(size, suffix or 0), size - 1
    elif last is not None and last < first:
        return None
    if first >= size:
        raise UnsatisfiableRangeError(f"bytes from {first} of {size}")
    return first, min(size, size if last is None else last + 1)


_OF_ALL = {
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-DNS-Prefetch-Control": "off",
    "Cache-Control": "no-cache",
}


def headers_of(port: int) -> Mapping[str, Mapping[str, str]]:
    """Return name of the server → what every answer under that name carries.

    Parameters
    ----------
    port
        Of the server.

    Examples
    --------
    >>> headers_of(8000)["localhost"]["Connection-Allowlist"]
    '(response-origin "http://127.0.0.1:8000")'
    """
    page, window = (f"http://{name}:{port}" for name in (LOOPBACK, WINDOW))
    of_window = (
        f"default-src 'none'; script-src 'self'; style-src 'self'; frame-src {page}; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    of_page = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
        f"worker-src blob:; base-uri 'none'; form-action 'none'; frame-ancestors {window}; "
        "sandbox allow-scripts allow-same-origin allow-downloads"
    )
    return {
        WINDOW: _OF_ALL | {"Content-Security-Policy": of_window, "Connection-Allowlist": f'(response-origin "{page}")'},
        LOOPBACK: _OF_ALL | {"Content-Security-Policy": of_page, "Connection-Allowlist": "(response-origin)"},
    }


SHELL = ("shell.html", "shell.js", "shell.css")
"""The window, of which the map is a frame; what is opened first."""

FILES = ("index.html", "app.js", "app.css")
"""The map; what is opened first."""

BUILT = Path(__file__).parent / "page"
"""Output folder of `webmap/build.mjs`: no part of the sources, but of the package that is installed."""


def page_files(built: Path = BUILT) -> Mapping[str, bytes]:
    """Return name → content of `SHELL` and `FILES`.

    Parameters
    ----------
    built
        Where the bundle is.

    Raises
    ------
    CampaignError
        If this installation has no bundle.
    """
    if not is_built(built):
        raise CampaignError(
            "this installation has no map page: pip install does not build it",
            "apertura map",
            f"the page that make webmap builds with Node.js 20 or newer, in {built}",
            "In apertura's sources, run make setup; or make webmap, then pip install . again.",
        )
    return {name: (built / name).read_bytes() for name in (*SHELL, *FILES)}


def is_built(built: Path = BUILT) -> bool:
    """Test whether the bundle is built."""
    return all((built / name).is_file() for name in (*SHELL, *FILES))


_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".geojson": "application/geo+json",
    ".tif": "image/tiff",
}
_AT_ONCE = 1 << 16
_WAIT_S = 0.2  # between looks for the first picture
_IDLE_S = 60.0


class MapServer(ThreadingHTTPServer):
    """A server of a page and of some files of a folder.

    Parameters
    ----------
    folder
        The results.
    files
        Gives the names below it that are served, with slashes, and the hash that each has to have; no other file is.
        Asked for every request; CampaignError where they are not known.
    page
        Of `apertura.views.webmap.server.page_files`.
    sha256_of
        Gives the hash of a file as it is now.
    port
        To listen on; 0 for a free one.

    Raises
    ------
    CampaignError
        If the port is taken or not allowed.

    Examples
    --------
    >>> with MapServer(Path("results"), dict, page={}, sha256_of=str) as server:
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
        port: int = 0,
    ) -> None:
        self.folder, self.files, self.sha256_of = ConfinedPath.at(folder), files, sha256_of
        self.pages = {
            WINDOW: {name: content for name, content in page.items() if name in SHELL},
            LOOPBACK: {f"map/{name}": content for name, content in page.items() if name in FILES},
        }
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except OSError as error:
            raise CampaignError(
                f"port {port}: {error.strerror}", "apertura map", "a free port", "Choose another --port, or none."
            ) from error
        self.url = f"http://{WINDOW}:{self.server_port}/"
        self.headers = headers_of(self.server_port)

    def show(self, *, in_browser: bool = False) -> None:
        """Print the address, open it if that is wanted, and serve until a signal ends it."""
        with self, suppress(Interrupted):
            print(f"{self.url}\nCtrl-C ends it.", flush=True)
            if in_browser:
                webbrowser.open(self.url)
            self.serve_forever()

    def handle_error(self, request: object, client_address: object) -> None:  # noqa: ARG002
        """Print the error of a request in one line, unless its reader has just gone."""
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
        """Return the handler of every other method."""
        if name.startswith("do_"):
            return self._refuse
        raise AttributeError(name)

    def _refuse(self) -> None:
        self.close_connection = True  # what the request carries is not read
        self._say(HTTPStatus.METHOD_NOT_ALLOWED, "the map is only read", Allow="GET, HEAD")

    def _answer(self) -> None:
        host = own_host(self.headers.get_all("Host", []), self.server.server_port)
        if host is None:
            self._say(HTTPStatus.FORBIDDEN, "this server has another name")
            return
        self.host = host
        if self.headers.get("Content-Length", "0").strip() != "0" or "Transfer-Encoding" in self.headers:
            self.close_connection = True  # a body is not read, and must not be taken for the next request
            self._say(HTTPStatus.BAD_REQUEST, "a request without a body")
            return
        opened = self.path in {"/", "/map/"} or self.headers.get("Sec-Fetch-Dest") == "document"
        if opened and host == LOOPBACK:  # by a reader, and not as the frame
            self._say(HTTPStatus.FOUND, "the map", Location=self.server.url)
            return
        name, expected = (SHELL[0], None) if self.path == "/" else requested_file(self.path)
        if name in self.server.pages[host]:
            self._send(BytesIO(self.server.pages[host][name]), name)
        elif host == LOOPBACK:
            self._answer_file(name, expected)
        else:
            self._say(HTTPStatus.NOT_FOUND, "only the window around the map")

    def _answer_file(self, name: str, expected: str | None) -> None:
        try:
            sha256 = self.server.files().get(name)
        except CampaignError as error:
            self._say(HTTPStatus.CONFLICT, str(error))
            return
        file = None if sha256 is None else self._opened(name)
        if file is None:
            self._say(HTTPStatus.NOT_FOUND, "no product of this campaign")
            return
        with file:
            if expected not in {None, sha256} or not self._is(file, name, sha256):
                self._say(HTTPStatus.CONFLICT, "changed since the map was made: run the workflow again")
                return
            self._send(file, name)

    def _opened(self, name: str) -> IO[bytes] | None:
        """Return a file of the list; None if it is not there, or is reached through a link, or is no file."""
        with suppress(OSError, CampaignError):
            return self.server.folder.named(name, where="request").open("rb")
        return None

    def _is(self, file: IO[bytes], name: str, sha256: str | None) -> bool:
        """Test whether an open file has the hash; it is computed by path, since products are replaced as a whole."""
        with suppress(OSError, CampaignError):
            same = self.server.sha256_of(name) == sha256
            return same and os.path.samestat(os.fstat(file.fileno()), (self.server.folder / name).stat())
        return False

    def _send(self, file: IO[bytes], name: str) -> None:
        size = file.seek(0, os.SEEK_END)
        try:
            part = requested_range(self.headers.get("Range"), size)
        except UnsatisfiableRangeError:
            self._say(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, "beyond the file", Content_Range=f"bytes */{size}")
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
        left = end - first
        while left and (block := file.read(min(left, _AT_ONCE))):
            self.wfile.write(block)
            left -= len(block)
        if left:  # cut short meanwhile: the reader must not take what comes next for the rest
            self.close_connection = True

    def _say(self, status: HTTPStatus, words: str, **headers: str) -> None:
        body = f"{words}\n".encode()
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
        """Log nothing: a map requests hundreds of ranges."""


def served_look(campaign: Campaign, *, port: int = 0) -> MapServer:
    """Return a server of what `apertura look` shows, once it does; parameters and errors as `served`."""
    folder = campaign.result(LOOK)
    path = folder / MAP
    if not path.is_file():
        print("waiting for the first picture of `apertura look`, in another terminal; Ctrl-C ends", flush=True)
    while not path.is_file():
        time.sleep(_WAIT_S)

    def files() -> Mapping[str, str]:
        document = read_json(path, expected="what apertura look writes", remedy="Run `apertura look CAMPAIGN` again.")
        with undamaged(path, expected="what apertura look writes", remedy="Run `apertura look CAMPAIGN` again."):
            return {**named_files(document), MAP: sha256_file(path)}

    return _serving(campaign, folder, files, port)


def served(campaign: Campaign, *, port: int = 0) -> MapServer:
    """Return a server of the campaign's map, of the products that it names and of nothing else.

    Parameters
    ----------
    campaign
        With results.
    port
        To listen on; 0 for a free one.

    Raises
    ------
    CampaignError
        If there is no map, it is not as it was written, or the port is taken.
    """
    return _serving(campaign, campaign.results, _listing(campaign), port)


def _serving(campaign: Campaign, folder: Path, files: Callable[[], Mapping[str, str]], port: int) -> MapServer:
    """Return a server of a folder of the campaign; raise CampaignError if its files are not known."""
    files()
    place = campaign.relative(folder)

    def sha256_of(name: str) -> str:
        return digest_of(campaign.root, f"{place}/{name}")

    return MapServer(folder, files, page=page_files(), sha256_of=sha256_of, port=port)


def _listing(campaign: Campaign) -> Callable[[], Mapping[str, str]]:
    """Return a function to the served files of the results → sha256: `map.json` by its manifest, and its layers.

    Both are read again when the manifest is another: the workflow ran meanwhile.
    """
    products = frozenset(product_files(campaign.images, campaign.coefficients))

    @lru_cache(maxsize=1)
    def listed(*_: int) -> Mapping[str, str]:
        path = campaign.result(MAP)
        manifest = manifest_of(path)
        document = open_listed(path, manifest)
        with undamaged(path, expected="the map of a finished campaign", remedy="Run the workflow again."):
            named = {name: sha256 for name, sha256 in named_files(document).items() if name in products}
        return {**named, MAP: read_manifest(manifest)["files"][path.name]}

    def listed_now() -> Mapping[str, str]:
        with suppress(OSError):
            state = manifest_of(campaign.result(MAP)).stat()
            return listed(state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
        return listed()

    return listed_now
