"""Check a built site: all links must have a target, and no page may load resources from another host.

`python -m website.check build/site`
"""

import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

_LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "link": "href"}
"""HTML element whose resource a browser loads automatically → attribute that contains the URL."""


class Page(HTMLParser):
    """Links, anchors and loaded resources of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.loaded: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect links, loaded resources and anchors of a tag."""
        values = dict(attrs)
        self.anchors |= {value for value in (values.get("id"), values.get("name")) if value}
        if tag == "a" and values.get("href"):
            self.links.append(values["href"] or "")
        if tag in _LOADED and values.get(_LOADED[tag]) and values.get("rel") != "canonical":
            self.loaded.append(values[_LOADED[tag]] or "")


def faults(site: Path) -> list[str]:
    """Return a line for each broken link or external resource of a built site."""
    pages = {path: Page() for path in site.resolve().rglob("*.html")}
    for path, page in pages.items():
        page.feed(path.read_text(encoding="utf-8"))
    broken = [fault for path in sorted(pages) if path.name != "404.html" for fault in _faults(path, pages)]
    styles = [path for path in site.rglob("*.css") if "url(http" in path.read_text(encoding="utf-8").replace('"', "")]
    return [*broken, *(f"{path}: loads a resource from another host" for path in styles)]


def _faults(path: Path, pages: dict[Path, Page]) -> Iterator[str]:
    for link in [*pages[path].loaded, *pages[path].links]:
        parts = urlsplit(link)
        if parts.scheme in {"data", "mailto"} or (parts.netloc and link in pages[path].links):
            continue
        if parts.netloc:
            yield f"{path}: loads {link} from another host"
            continue
        target = (path.parent / unquote(parts.path)).resolve() if parts.path else path.resolve()
        target_page = pages.get(target)
        if not target.is_file():
            yield f"{path}: {link}: target does not exist"
        elif parts.fragment and target_page and unquote(parts.fragment) not in target_page.anchors:
            yield f"{path}: {link}: heading does not exist"


if __name__ == "__main__":
    lines = faults(Path(sys.argv[1]))
    print(*lines, sep="\n", end="\n" if lines else "")
    sys.exit(1 if lines else 0)
