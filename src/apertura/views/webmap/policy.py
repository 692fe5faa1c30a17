"""What a browser may do with an answer: ask this server, and nobody else for anything.

No policy of content keeps a page from leading its own window elsewhere. So the map is a frame of another origin: where
a frame may be led to is for the window around it to say, and a sandboxed frame leads no window and opens none. Browsers
that know connection allowlists (Chromium 152) hold to them for everything, name look-ups, early connections and WebRTC
too, which no other header of all these reaches.
"""

from collections.abc import Mapping

from apertura.views.webmap.requests import LOOPBACK, WINDOW

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
