"""Hook of mkdocs: equations are Unicode text in the sources and in the code; a page sets their indices and powers."""

import re
from typing import Any

_SKIPPED = re.compile(r"<(?P<tag>code|script|style)\b.*?</(?P=tag)>|<[^>]+>", re.S)
_INDENTED = re.compile(r'<div class="highlight"><pre><span></span><code>(.*?)</code></pre></div>', re.S)
_NUMBER = re.compile(r" {2,}\((\d+\w?)\)$", re.M)
_COLUMNS = re.compile(r"\S {3,}\S")
_PATHS = re.compile(r"^[\w/]+\.\w+ {2,}", re.M)

_WORD = r"3dB|[a-z0-9]+(?:,[a-z0-9]+)*|[A-Z]+|[α-ωΑ-Ω∞⊥]"
_OPERATORS = r"(?<=\bmean)|(?<=\bmax)|(?<=\bmin)|(?<=\bSNR)|(?<=∂)"
_INDEX = re.compile(  # of a letter, what is in parentheses, or an operator; the last letter of another word is none
    rf"(?:(?<![A-Za-z]{{2}}[^\W\d_])(?<=[^\W\d_]|[)\u0303])|{_OPERATORS})([′'*]?)_(?:\{{([^{{}}]+)\}}|({_WORD}))"
)
_POWER = re.compile(
    r"(?<=[\w)|>\u0303\u0307])\^(?:\{([^{}]+)\}|\(((?:[^()]|\([^()]*\))+)\)|(−?[A-Za-z0-9]+(?:\.\d+)?))"
)


def on_page_content(html: str, *, page: Any, **_: Any) -> str:
    """Return the HTML of a page, that of a page of theory with its equations set."""
    return set_equations(html) if page.file.src_uri.startswith(("theory", "glossary")) else html


def set_equations(html: str) -> str:
    """Return HTML with x_n and x^n set as index and power, in indented blocks and in prose, not in code.

    Examples
    --------
    >>> set_equations("<p>Σ_n w_{n+1} u^d of <code>w_n</code></p>")
    '<p>Σ<sub>n</sub> w<sub>n+1</sub> u<sup>d</sup> of <code>w_n</code></p>'
    """
    html = _INDENTED.sub(_equation, html)
    kept, at = [], 0
    for skipped in _SKIPPED.finditer(html):
        kept += [_set(html[at : skipped.start()]), skipped[0]]
        at = skipped.end()
    return "".join([*kept, _set(html[at:])])


def _equation(found: re.Match[str]) -> str:
    """Return an indented block as an equation, unless its columns say that it is a table."""
    text = _NUMBER.sub(r'<span class="number">(\1)</span>', found[1].rstrip())
    table = sum(bool(_COLUMNS.search(line.strip())) for line in text.splitlines()) > 1 or _PATHS.match(found[1])
    return found[0] if table else f'<pre class="equation">{text}</pre>'


def _set(text: str) -> str:
    text = _INDEX.sub(lambda found: f"{found[1]}<sub>{found[2] or found[3]}</sub>", text)
    return _POWER.sub(lambda found: f"<sup>{found[1] or found[2] or found[3]}</sup>", text)
