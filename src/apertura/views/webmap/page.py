"""The page itself, as `make webmap` bundles it from `webmap/`; a page of one message where nobody bundled it."""

from collections.abc import Mapping
from pathlib import Path

SHELL = ("shell.html", "shell.js", "shell.css")
"""The window, of which the map is a frame; what is opened first."""

FILES = ("index.html", "app.js", "app.css")
"""The map; what is opened first."""

BUILT = Path(__file__).parent / "page"
"""Where `webmap/build.mjs` writes: no part of the sources, but of the package that is installed."""

_NOT_BUILT = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>No map</title>
<p>This apertura was installed without its map: no <code>npm</code> was there to build it.
<p>Install Node.js 20 or newer, type <code>make webmap</code> in apertura's sources, then
<code>apertura map</code> again.
"""


def page_files(built: Path = BUILT) -> Mapping[str, bytes]:
    """Return name → content of `SHELL` and `FILES`; without a bundle, a `shell.html` that says how to get one.

    Parameters
    ----------
    built
        Where the bundle is.

    Examples
    --------
    >>> list(page_files(Path("nowhere")))
    ['shell.html']
    """
    if not is_built(built):
        return {SHELL[0]: _NOT_BUILT.encode()}
    return {name: (built / name).read_bytes() for name in (*SHELL, *FILES)}


def is_built(built: Path = BUILT) -> bool:
    """Return whether the bundle is there."""
    return all((built / name).is_file() for name in (*SHELL, *FILES))
