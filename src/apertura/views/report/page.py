"""What the report is written in: one HTML file that needs nothing else, and reStructuredText for Snakemake's report."""

import base64
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape

_STYLE = """
@page { size: A4; margin: 18mm 20mm; }
body { font: 10.5pt/1.45 Georgia, 'DejaVu Serif', serif; color: #111; }
body { max-width: 170mm; margin: 12mm auto; padding: 0 4mm; }
h1, h2, h3 { font-family: 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif; line-height: 1.2; break-after: avoid; }
h1 { font-size: 17pt; } h2 { font-size: 13pt; margin-top: 9mm; } h3 { font-size: 11pt; }
p { text-align: left; hyphens: auto; overflow-wrap: anywhere; }
figure { margin: 5mm 0; break-inside: avoid; }
figure img { display: block; max-width: 100%; max-height: 190mm; margin: 0 auto; }
figcaption, caption { font-size: 9pt; color: #333; text-align: left; padding: 1.5mm 0; }
table { border-collapse: collapse; width: 100%; font-size: 8.5pt; margin: 4mm 0; }
caption { caption-side: top; }
thead { display: table-header-group; }
tr { break-inside: avoid; }
th { text-align: left; border-bottom: 0.4mm solid #333; padding: 0.8mm 1.5mm; }
td { vertical-align: top; border-bottom: 0.1mm solid #bbb; padding: 0.8mm 1.5mm; overflow-wrap: anywhere; }
td:first-child { min-width: 22mm; }
td.number { white-space: nowrap; }
.wide { overflow-x: auto; }
@media print { body { margin: 0; padding: 0; max-width: none; } h2 { break-before: auto; } }
"""
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True)
class Heading:
    """A heading of level 1 to 3."""

    level: int
    text: str

    @property
    def html(self) -> str:
        """As HTML, escaped."""
        return f"<h{self.level}>{escape(self.text)}</h{self.level}>"


@dataclass(frozen=True)
class Paragraph:
    """Sentences."""

    text: str

    @property
    def html(self) -> str:
        """As HTML, escaped."""
        return f"<p>{escape(self.text)}</p>"


@dataclass(frozen=True)
class Table:
    """A table of text with a caption above it."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def html(self) -> str:
        """As HTML, escaped."""
        head = "".join(f"<th>{escape(cell)}</th>" for cell in self.head)
        rows = "".join(f"<tr>{''.join(map(_cell, row))}</tr>\n" for row in self.rows)
        caption = f"<caption>{escape(self.caption)}</caption>"
        table = f"<table>{caption}<thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody></table>"
        return f'<div class="wide">{table}</div>'


_NUMBERS = re.compile(r"[-−+±\d.,e\s/%]+")  # a cell of numbers alone, which break between lines only where told


def _cell(text: str) -> str:
    kind = ' class="number"' if _NUMBERS.fullmatch(text) else ""
    return f"<td{kind}>{escape(text).replace(chr(10), '<br>')}</td>"


@dataclass(frozen=True)
class Picture:
    """A PNG with a caption below it.

    Attributes
    ----------
    png
        The whole file.
    caption
        What it shows.
    """

    png: bytes
    caption: str

    @property
    def html(self) -> str:
        """As HTML, the picture inside."""
        source = base64.b64encode(self.png).decode("ascii")
        caption = escape(self.caption)
        picture = f'<img alt="{caption}" src="data:image/png;base64,{source}">'
        return f"<figure>{picture}<figcaption>{caption}</figcaption></figure>"


Block = Heading | Paragraph | Table | Picture


def _numbered(blocks: Iterable[Block]) -> Iterator[Block]:
    """Yield blocks with their pictures and tables counted."""
    count = dict.fromkeys((Picture, Table), 0)
    for block in blocks:
        if isinstance(block, Picture | Table):
            count[type(block)] += 1
            kind = "Figure" if isinstance(block, Picture) else "Table"
            yield replace(block, caption=f"{kind} {count[type(block)]}. {block.caption}")
        else:
            yield block


def page(title: str, blocks: Iterable[Block]) -> str:
    """Return blocks as one HTML document.

    Parameters
    ----------
    title
        Of the document.
    blocks
        One below the other.

    Notes
    -----
    All text is escaped; a policy in the page forbids scripts and requests, whatever stood in it.

    Examples
    --------
    >>> "<p>a &lt; b</p>" in page("one", [Paragraph("a < b")])
    True
    """
    body = "\n".join(block.html for block in _numbered(blocks))
    policy = f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n{policy}\n<title>{escape(title)}</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def rst_text(text: str) -> str:
    r"""Return text as reStructuredText shows it, letter by letter, on one line.

    Parameters
    ----------
    text
        Any text, also an untrusted one.

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
