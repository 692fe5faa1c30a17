"""Hook of mkdocs: typeset indices and powers in the Unicode equations of theory pages."""

import re
from typing import Any

_SKIPPED = re.compile(r"<(?P<tag>code|script|style)\b.*?</(?P=tag)>|<[^>]+>", re.S)
_INDENTED = re.compile(r'<div class="highlight"><pre><span></span><code>(.*?)</code></pre></div>', re.S)
_NUMBER = re.compile(r" {2,}\((\d+\w?)\)$", re.M)
_COLUMNS = re.compile(r"\S {3,}\S")
_PATHS = re.compile(r"^[\w/]+\.\w+ {2,}", re.M)

_WORD = r"3dB|[a-z0-9]+(?:,[a-z0-9]+)*|[A-Z]+|[α-ωΑ-Ω∞⊥]"
_OPERATORS = r"(?<=\bmean)|(?<=\bmax)|(?<=\bmin)|(?<=\bSNR)|(?<=∂)"
_INDEX = re.compile(  # of a letter, of a parenthesis or of an operator, but not of the last letter of a longer word
    rf"(?:(?<![A-Za-z]{{2}}[^\W\d_])(?<=[^\W\d_]|[)\u0303])|{_OPERATORS})([′'*]?)_(?:\{{([^{{}}]+)\}}|({_WORD}))"
)
_POWER = re.compile(
    r"(?<=[\w)|>\u0303\u0307])\^(?:\{([^{}]+)\}|\(((?:[^()]|\([^()]*\))+)\)|(−?[A-Za-z0-9]+(?:\.\d+)?))"
)


def on_page_content(html: str, *, page: Any, **_: Any) -> str:
    """Return the HTML of a page, with typeset equations for pages of the theory and the glossary."""
    return set_equations(html) if page.file.src_uri.startswith(("theory", "glossary")) else html


def set_equations(html: str) -> str:
    """Return HTML with x_n and x^n typeset as index and power, in indented blocks and running text but not in code.

    Examples
    --------
    >>> set_equations("<p>Σ_n w_{n+1} u^d of <code>w_n</code></p>")
    '<p>Σ<sub>n</sub> w<sub>n+1</sub> u<sup>d</sup> of <code>w_n</code></p>'
    """
    html = _INDENTED.sub(_equation, html)
    parts, position = [], 0
    for skipped in _SKIPPED.finditer(html):
        parts += [_typeset(html[position : skipped.start()]), skipped[0]]
        position = skipped.end()
    return "".join([*parts, _typeset(html[position:])])


def _equation(block: re.Match[str]) -> str:
    """Return an indented block as an equation, unless its columns indicate a table."""
    text = _NUMBER.sub(r'<span class="number">(\1)</span>', block[1].rstrip())
    is_table = sum(bool(_COLUMNS.search(line.strip())) for line in text.splitlines()) > 1 or _PATHS.match(block[1])
    return block[0] if is_table else f'<pre class="equation">{text}</pre>'


def _typeset(text: str) -> str:
    text = _INDEX.sub(lambda match: f"{match[1]}<sub>{match[2] or match[3]}</sub>", text)
    return _POWER.sub(lambda match: f"<sup>{match[1] or match[2] or match[3]}</sup>", text)
