"""The map of one campaign on this machine alone: our page, and files that are listed with their hashes; read only."""

import os
import stat
import sys
import webbrowser
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from apertura.common.errors import CampaignError
from apertura.common.paths import inside
from apertura.common.processes import Interrupted
from apertura.views.webmap.page import FILES, SHELL
from apertura.views.webmap.policy import headers_of
from apertura.views.webmap.requests import LOOPBACK, WINDOW, UnsatisfiableRangeError, asked_bytes, asked_file, own_host

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".geojson": "application/geo+json",
    ".tif": "image/tiff",
}
_AT_ONCE = 1 << 16
_IDLE_S = 60.0


class MapServer(ThreadingHTTPServer):
    """A server of a page and of some files of a folder.

    Parameters
    ----------
    folder
        The results.
    files
        Gives the names below it that are served, with slashes, and the hash that each has to have; no other file is.
        Asked for every request; CampaignError where nobody knows.
    page
        Of `apertura.views.webmap.page.page_files`.
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
        self.folder, self.files, self.sha256_of = folder, files, sha256_of
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
    host = LOOPBACK

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
        host = own_host(self.headers.get_all("Host", []), self.server.server_port)
        if host is None:
            self._say(HTTPStatus.FORBIDDEN, "this server has another name")
            return
        self.host = host
        opened = self.path in {"/", "/map/"} or self.headers.get("Sec-Fetch-Dest") == "document"
        if opened and host == LOOPBACK:  # by a reader, and not as the frame
            self._say(HTTPStatus.FOUND, "the map", Location=self.server.url)
            return
        name, expected = (SHELL[0], None) if self.path == "/" else asked_file(self.path)
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

    def _opened(self, name: str) -> BinaryIO | None:
        """Return a file of the list; None if it is not there, or is reached through a link, or is no file."""
        with suppress(OSError, CampaignError):
            path = inside(self.server.folder, name, where="request")
            file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
            if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                return file
            file.close()
        return None

    def _is(self, file: BinaryIO, name: str, sha256: str | None) -> bool:
        """Return whether an open file has the hash; products are replaced as a whole, so it is asked of its path."""
        with suppress(OSError, CampaignError):
            same = self.server.sha256_of(name) == sha256
            return same and os.path.samestat(os.fstat(file.fileno()), (self.server.folder / name).stat())
        return False

    def _send(self, file: BinaryIO, name: str) -> None:
        size = file.seek(0, os.SEEK_END)
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
        for name, value in self.server.headers[self.host].items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002
        """Say nothing: a map asks for hundreds of ranges."""
