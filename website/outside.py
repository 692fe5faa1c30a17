"""Hook of mkdocs: documents that lie beside docs/ are pages of the site, too, and links to them lead there."""

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
"""File of the repository → page."""

_ROOT = Path(__file__).parents[1]
_LINK = re.compile(r"\]\(([\w./-]+\.\w+)(#[\w-]+)?\)")


def on_files(files: Files, *, config: Any) -> Files:
    """Add the documents beside docs/."""
    for source, page in OUTSIDE.items():
        text = (_ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=_moved(text, source, page)))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Return a page of docs/ with its links to documents outside."""
    return _moved(markdown, f"docs/{page.file.src_uri}", page.file.src_uri)


def _moved(text: str, source: str, page: str) -> str:
    """Return the text of a file of the repository as that of a page of docs/, its links leading where they led."""

    def moved(found: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), found[1]))
        target = OUTSIDE.get(target, target.removeprefix("docs/"))
        return f"]({posixpath.relpath(target, posixpath.dirname(page) or '.')}{found[2] or ''})"

    return _LINK.sub(moved, text)
