"""Hook of mkdocs: add documents outside docs/ to the site as pages, and redirect links to these documents."""

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

OUTSIDE = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "config/README.md": "config.md",
}
"""File of the repository → page of the site."""

_ROOT = Path(__file__).parents[1]
_LINK = re.compile(r"\]\(([\w./-]+\.\w+)(#[\w-]+)?\)")


def on_files(files: Files, *, config: Any) -> Files:
    """Add the documents outside docs/ to the files of the site."""
    for source, page in OUTSIDE.items():
        text = (_ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=_with_links_of(text, source, page)))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Return a page of docs/ with redirected links to documents outside docs/."""
    return _with_links_of(markdown, f"docs/{page.file.src_uri}", page.file.src_uri)


def _with_links_of(text: str, source: str, page: str) -> str:
    """Return the text of a repository file with relative links adapted to the location of the page on the site."""

    def adapted(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), link[1]))
        target = OUTSIDE.get(target, target.removeprefix("docs/"))
        return f"]({posixpath.relpath(target, posixpath.dirname(page) or '.')}{link[2] or ''})"

    return _LINK.sub(adapted, text)
