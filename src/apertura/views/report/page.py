"""Markup of reports: self-contained HTML, and reStructuredText for Snakemake's report."""

import base64
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{{ title }}</title>
<style>
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
</style>
</head>
<body>
{% for block in blocks -%}
{% if block.level is defined -%}
<h{{ block.level }}>{{ block.text }}</h{{ block.level }}>
{% elif block.rows is defined -%}
{% set count.tables = count.tables + 1 -%}
<div class="wide"><table><caption>Table {{ count.tables }}. {{ block.caption }}</caption>
<thead><tr>{% for cell in block.head %}<th>{{ cell }}</th>{% endfor %}</tr></thead>
<tbody>{% for row in block.rows %}<tr>{% for cell in row -%}
<td{% if is_number(cell) %} class="number"{% endif %}>{{ cell.split("\n") | join("<br>" | safe) }}</td>
{%- endfor %}</tr>
{% endfor %}</tbody></table></div>
{% elif block.png is defined -%}
{% set count.figures = count.figures + 1 -%}
{% set caption = "Figure %d. %s" % (count.figures, block.caption) -%}
<figure><img alt="{{ caption }}" src="data:image/png;base64,{{ base64(block.png).decode() }}">
<figcaption>{{ caption }}</figcaption></figure>
{% else -%}
<p>{{ block.text }}</p>
{% endif -%}
{% endfor -%}
</body>
</html>
"""
_NUMBERS = re.compile(r"[-−+±\d.,e\s/%]+")  # a numeric cell, whose lines are broken only at explicit newlines


@dataclass(frozen=True)
class Heading:
    """A heading of level 1 to 3."""

    level: int
    text: str


@dataclass(frozen=True)
class Paragraph:
    """A paragraph of text."""

    text: str


@dataclass(frozen=True)
class Table:
    """A table of text with a caption above the table."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Picture:
    """Contents of a PNG file with a caption below the image."""

    png: bytes
    caption: str


Block = Heading | Paragraph | Table | Picture


def page(title: str, blocks: Iterable[Block]) -> str:
    """Render blocks as one HTML document with numbered tables and figures.

    Parameters
    ----------
    title
        Title of the document.
    blocks
        Blocks from top to bottom.

    Notes
    -----
    All text is escaped, and a content security policy in the page forbids scripts and requests.

    Examples
    --------
    >>> "<p>a &lt; b</p>" in page("one", [Paragraph("a < b")])
    True
    """
    from jinja2 import Environment
    from jinja2.utils import Namespace

    template = Environment(autoescape=True, keep_trailing_newline=True).from_string(_PAGE)
    count = Namespace(tables=0, figures=0)
    return template.render(
        title=title, blocks=blocks, count=count, is_number=_NUMBERS.fullmatch, base64=base64.b64encode
    )


def rst_text(text: str) -> str:
    r"""Escape text so that reStructuredText renders it literally, on one line.

    Parameters
    ----------
    text
        Any text, including untrusted text.

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
    r"""Render a table of text as the directive ``list-table``.

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
        for column, cell in enumerate(row):
            lines.append(f"   {'*' if column == 0 else ' '} - {rst_text(cell)}".rstrip())
    return "\n".join(lines)
