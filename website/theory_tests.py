"""docs/theory/tests.md, from the table of the tests that check each section and equation of docs/theory."""

import tomllib
from pathlib import Path

TESTS: dict[str, dict[str, dict[str, list[str]]]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
)
"""Page of docs/theory, without suffix → heading → equations, or "" → names of tests, and files of tests."""

_HEAD = """# Equations and their tests

The tests that check each section of the theory, by equation where a section numbers its equations. One test alone:
`.venv/bin/python -m pytest tests -k NAME`. Written by `make pages` from `website/theory_tests.toml`.
"""


def theory_tests_page() -> str:
    """Return docs/theory/tests.md."""
    lines = [_HEAD]
    for page, sections in TESTS.items():
        title, *headings = sections
        lines += [
            f"## [{title}]({'../' * (page == 'theory')}{page}.md)\n",
            "| section | eq. | tests |",
            "|---|---|---|",
        ]
        for heading, checked in sections.items():
            for equations, tests in checked.items():
                lines.append(f"| {heading} | {equations} | {'<br>'.join(f'`{test}`' for test in tests)} |")
        untested = [heading for heading in headings if not sections[heading]]
        lines.append(f"\nWithout a test of its own: {'; '.join(untested)}.\n" if untested else "")
    return "\n".join(lines)
