"""Write all generated files, pages of docs/ and the config template: `python -m website.pages`."""

from collections.abc import Callable
from pathlib import Path

from apertura.campaign.config.template import config_schema, config_template, flights_template
from website.api import api_page
from website.cli import cli_page
from website.flags import flags_page
from website.notebooks import notebook_pages
from website.sizing import sizing_page
from website.theory_tests import theory_tests_page

ROOT = Path(__file__).parents[1]

PAGES: dict[str, Callable[[], str]] = {
    "config/config.yaml": config_template,
    "config/flights.tsv": flights_template,
    "config/schema.json": config_schema,
    "docs/api.md": api_page,
    "docs/cli.md": cli_page,
    "docs/flags.md": flags_page,
    "docs/howto/sizing.md": sizing_page,
    "docs/theory/tests.md": theory_tests_page,
    **notebook_pages(),
}
"""File → function that returns the content of the file."""

if __name__ == "__main__":
    for name, page in PAGES.items():
        (ROOT / name).parent.mkdir(exist_ok=True)
        (ROOT / name).write_text(page(), encoding="utf-8")
