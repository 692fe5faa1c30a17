"""Text for reStructuredText, in which snakemake's report opens: nothing that it holds is taken for markup."""

import re
from collections.abc import Sequence


def rst_text(text: str) -> str:
    r"""Return text as reStructuredText shows it, letter by letter, on one line.

    Parameters
    ----------
    text
        Anything, also what a stranger wrote.

    Examples
    --------
    >>> rst_text("a *b* `c`_ |d| {{ e }}")
    'a \\*b\\* \\`c\\`\\_ \\|d\\| \\{\\{ e \\}\\}'
    >>> rst_text(".. raw:: html\n\n   <b>")
    '\\.\\. raw\\:\\: html \\<b\\>'
    """
    line = " ".join(text.split())
    return re.sub(r"([^\w\s]|_)", r"\\\1", line)


def rst_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    r"""Return a table of text as the directive ``list-table``.

    Examples
    --------
    >>> print(rst_table(["image", "flags"], [["a-b", "none"]]))
    .. list-table::
       :header-rows: 1
    <BLANKLINE>
       * - image
         - flags
       * - a\-b
         - none
    """
    lines = [".. list-table::", "   :header-rows: 1", ""]
    for row in (head, *rows):
        for place, cell in enumerate(row):
            lines.append(f"   {'*' if place == 0 else ' '} - {rst_text(cell)}".rstrip())
    return "\n".join(lines)
