"""The results of one campaign on this machine alone: the files that are listed, by ranges of bytes, read only."""

import os
import stat
import sys
import webbrowser
from collections.abc import Callable, Collection
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import BinaryIO

from apertura.errors import CampaignError
from apertura.paths import inside
from apertura.signals import Interrupted
from apertura.webmap.requests import LOOPBACK, UnsatisfiableRangeError, asked_bytes, asked_file, is_own_host

PAGE = "map/index.html"
"""Where a browser begins."""

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "worker-src blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
}
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".geojson": "application/geo+json",
    ".tif": "image/tiff",
    ".png": "image/png",
}
_AT_ONCE = 1 << 16
_IDLE_S = 60.0


class MapServer(ThreadingHTTPServer):
    """A server of some files of a folder.

    Parameters
    ----------
    folder
        The results.
    files
        Names below it that are served, with slashes; no other is.
    sha256_of
        Gives the hash of a file as it is now; asked where a request says which one it means.
    port
        To listen on; 0 for a free one.

    Raises
    ------
    CampaignError
        If the port is taken or not allowed.

    Examples
    --------
    >>> with MapServer(Path("results"), ["map/index.html"], sha256_of=str) as server:
    ...     server.url.startswith("http://127.0.0.1:")
    True
    """

    daemon_threads = True

    def __init__(self, folder: Path, files: Collection[str], *, sha256_of: Callable[[str], str], port: int = 0) -> None:
        self.folder, self.files, self.sha256_of = folder, frozenset(files), sha256_of
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except OSError as error:
            raise CampaignError(
                f"port {port}: {error.strerror}", "apertura map", "a free port", "Choose another --port, or none."
            ) from error

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{LOOPBACK}:{self.server_port}/{PAGE}"

    def show(self, *, in_browser: bool = False) -> None:
        """Print the address, open it if that is wanted, and serve until a signal ends it."""
        with self, suppress(Interrupted):
            print(f"{self.url}\nCtrl-C ends it.", flush=True)
            if in_browser:
                webbrowser.open(self.url)
            self.serve_forever()

    def handle_error(self, request: object, client_address: object) -> None:  # noqa: ARG002
        """Say in one line what went wrong with a request, unless its reader has just gone."""
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

    def do_GET(self) -> None:
        self._answer()

    def do_HEAD(self) -> None:
        self._answer()

    def __getattr__(self, name: str) -> Callable[[], None]:
        """Return what answers every other method."""
        if name.startswith("do_"):
            return self._refuse
        raise AttributeError(name)

    def _refuse(self) -> None:
        self.close_connection = True  # what the request carries is not read
        self._say(HTTPStatus.METHOD_NOT_ALLOWED, "the map is only read", Allow="GET, HEAD")

    def _answer(self) -> None:
        if not is_own_host(self.headers.get_all("Host", []), self.server.server_port):
            self._say(HTTPStatus.FORBIDDEN, "this server has another name")
            return
        name, expected = asked_file(self.path)
        if name == "" and self.path == "/":
            self._say(HTTPStatus.FOUND, "the map", Location=f"/{PAGE}")
            return
        file = self._opened(name) if name in self.server.files else None
        if file is None:
            self._say(HTTPStatus.NOT_FOUND, "no product of this campaign")
            return
        with file:
            if expected is not None and not self._is(file, name, expected):
                self._say(HTTPStatus.CONFLICT, "changed since the map was made: run the workflow again")
                return
            self._send(file, name)

    def _opened(self, name: str) -> BinaryIO | None:
        """Return a file of the list; None if it is not there, or is reached through a link, or is no file."""
        with suppress(OSError, CampaignError):
            path = inside(self.server.folder, name, where="request")
            file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
            if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                return file
            file.close()
        return None

    def _is(self, file: BinaryIO, name: str, sha256: str) -> bool:
        """Return whether an open file has the hash; products are replaced as a whole, so it is asked of its path."""
        with suppress(OSError, CampaignError):
            same = self.server.sha256_of(name) == sha256
            return same and os.path.samestat(os.fstat(file.fileno()), (self.server.folder / name).stat())
        return False

    def _send(self, file: BinaryIO, name: str) -> None:
        size = os.fstat(file.fileno()).st_size
        try:
            part = asked_bytes(self.headers.get("Range"), size)
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
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002
        """Say nothing: a map asks for hundreds of ranges."""
