"""The page itself, as `make webmap` bundles it from `webmap/`; a page of one message where nobody bundled it."""

import hashlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

FILES = ("index.html", "app.js", "app.css")
"""Of the page; `index.html` first."""

DATA = "map.json"
"""What the page shows, beside it."""

BUILT = Path(__file__).parent / "page"
"""Where `webmap/build.mjs` writes: no part of the sources, but of the package that is installed."""

_NOT_BUILT = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>No map</title>
<p>This apertura was installed without its map: no <code>npm</code> was there to build it.
<p>Install Node.js 20 or newer, type <code>make webmap</code> in apertura's sources, then
<code>apertura run</code> again: nothing but the map is made.
"""


def page_files(built: Path = BUILT) -> Mapping[str, bytes]:
    """Return name → content of the page's files; without a bundle, an `index.html` that says how to get one.

    Parameters
    ----------
    built
        Where the bundle is.

    Examples
    --------
    >>> list(page_files(Path("nowhere")))
    ['index.html']
    """
    if not is_built(built):
        return {FILES[0]: _NOT_BUILT.encode()}
    return {name: (built / name).read_bytes() for name in FILES}


def is_built(built: Path = BUILT) -> bool:
    """Return whether the bundle is there."""
    return all((built / name).is_file() for name in FILES)


@cache
def page_sha256(built: Path = BUILT) -> str:
    """Return the hash of the page's files: another page is another map.

    Examples
    --------
    >>> len(page_sha256())
    64
    """
    digest = hashlib.sha256()
    for name, content in page_files(built).items():
        digest.update(f"{name}\0{hashlib.sha256(content).hexdigest()}\n".encode())
    return digest.hexdigest()
