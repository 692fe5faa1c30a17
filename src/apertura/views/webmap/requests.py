"""What a request asks for, before any file is touched: which host, which file, which bytes."""

import re
from urllib.parse import parse_qs, unquote, urlsplit

LOOPBACK = "127.0.0.1"
"""The only address that is listened on, and the name under which the map and its data are answered."""

WINDOW = "localhost"
"""The name under which the window around the map is answered: to a browser, another origin."""

_RANGE = re.compile(r"bytes=(?:(\d{1,18})-(\d{1,18})?|-(\d{1,18}))", re.ASCII)


class UnsatisfiableRangeError(ValueError):
    """No byte of the file is asked for."""


def own_host(hosts: list[str], port: int) -> str | None:
    """Return which name of this server a request says; None for another that leads here (DNS rebinding).

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


def asked_file(target: str) -> tuple[str, str | None]:
    """Return the file that a request names and the hash it expects, if any; '' is no name of a file.

    Parameters
    ----------
    target
        As it stands in the request, percent-encoded.

    Examples
    --------
    >>> asked_file("/f01/a-b/db.tif?sha256=0f"), asked_file("http://x/y"), asked_file("/%ff")
    (('f01/a-b/db.tif', '0f'), ('', None), ('', None))
    """
    try:
        if not target.startswith("/"):
            return "", None
        split = urlsplit(target)
        name = unquote(split.path[1:], errors="strict")
        return name, parse_qs(split.query).get("sha256", [None])[-1]
    except ValueError:
        return "", None


def asked_bytes(header: str | None, size: int) -> tuple[int, int] | None:
    """Return the first byte asked for and the one after the last; None for the whole file.

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
    >>> asked_bytes("bytes=10-19", 100), asked_bytes("bytes=90-", 95), asked_bytes("bytes=-5", 95), asked_bytes(None, 9)
    ((10, 20), (90, 95), (90, 95), None)
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
