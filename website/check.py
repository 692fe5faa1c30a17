"""What a built site must hold: every link leads somewhere, and no page asks another host for anything.

`python -m website.check build/site`
"""

import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

_LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "link": "href"}
"""Elements that a browser fetches by itself → the attribute that says from where."""


class Page(HTMLParser):
    """Links, anchors and what is loaded of one page."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.loaded: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep what a tag links to, loads and names."""
        given = dict(attrs)
        self.anchors |= {value for value in (given.get("id"), given.get("name")) if value}
        if tag == "a" and given.get("href"):
            self.links.append(given["href"] or "")
        if tag in _LOADED and given.get(_LOADED[tag]) and given.get("rel") != "canonical":
            self.loaded.append(given[_LOADED[tag]] or "")


def faults(site: Path) -> list[str]:
    """Return what is wrong with a built site, a line each."""
    pages = {path: Page() for path in site.resolve().rglob("*.html")}
    for path, page in pages.items():
        page.feed(path.read_text(encoding="utf-8"))
    found = [fault for path in sorted(pages) if path.name != "404.html" for fault in _faults(path, pages)]
    styles = [path for path in site.rglob("*.css") if "url(http" in path.read_text(encoding="utf-8").replace('"', "")]
    return [*found, *(f"{path}: loads from another host" for path in styles)]


def _faults(path: Path, pages: dict[Path, Page]) -> Iterator[str]:
    for link in [*pages[path].loaded, *pages[path].links]:
        parts = urlsplit(link)
        if parts.scheme in {"data", "mailto"} or (parts.netloc and link in pages[path].links):
            continue
        if parts.netloc:
            yield f"{path}: loads {link}"
            continue
        target = (path.parent / unquote(parts.path)).resolve() if parts.path else path.resolve()
        known = pages.get(target)
        if not target.is_file():
            yield f"{path}: {link} leads nowhere"
        elif parts.fragment and known and unquote(parts.fragment) not in known.anchors:
            yield f"{path}: {link}: no such heading"


if __name__ == "__main__":
    wrong = faults(Path(sys.argv[1]))
    print(*wrong, sep="\n", end="\n" if wrong else "")
    sys.exit(1 if wrong else 0)
