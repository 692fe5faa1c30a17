"""Page docs/theory/tests.md, generated from the table of tests for each section and equation of docs/theory."""

import tomllib
from pathlib import Path

TESTS: dict[str, dict[str, dict[str, list[str]]]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
)
"""Page of docs/theory, without file extension → heading → equation numbers or "" → names of tests and test files."""

_HEADER = """# Equations and their tests

Tests for each section of the theory, and for each equation in sections with numbered equations. To run a single test,
use `.venv/bin/python -m pytest tests -k NAME`. This page is generated from `website/theory_tests.toml` by `make pages`.
"""


def theory_tests_page() -> str:
    """Return the text of docs/theory/tests.md."""
    lines = [_HEADER]
    for page, sections in TESTS.items():
        title, *headings = sections
        lines += [
            f"## [{title}]({'../' * (page == 'theory')}{page}.md)\n",
            "| section | eq. | tests |",
            "|---|---|---|",
        ]
        for heading, by_equation in sections.items():
            for equations, tests in by_equation.items():
                lines.append(f"| {heading} | {equations} | {'<br>'.join(f'`{test}`' for test in tests)} |")
        untested = [heading for heading in headings if not sections[heading]]
        lines.append(f"\nSections without a separate test: {'; '.join(untested)}.\n" if untested else "")
    return "\n".join(lines)
