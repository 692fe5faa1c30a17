"""Write the pages of docs/ that come from the code: `python -m website.pages`."""

from collections.abc import Callable
from pathlib import Path

from website.api import api_page
from website.cli import cli_page
from website.flags import flags_page

ROOT = Path(__file__).parents[1]

PAGES: dict[str, Callable[[], str]] = {
    "docs/api.md": api_page,
    "docs/cli.md": cli_page,
    "docs/flags.md": flags_page,
}
"""File → what it must hold."""

if __name__ == "__main__":
    for name, page in PAGES.items():
        (ROOT / name).write_text(page(), encoding="utf-8")
