"""Lint of wording: first lines of docstrings, and words that are not standard terms, in code and documents.

`python -m website.wording` prints the locations to be rewritten, and fails if there are any. Only first words and
single words are checked; the clarity of a sentence requires a reader.
"""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
_SOURCES = ("src", "research", "benchmarks", "website", "workflow")
_DOCUMENTS = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "config/README.md", "docs", "examples")

OPENINGS = re.compile(r"(What|Whether|Who|How|Where|Return (how|what|whether|which|where|who|why))\b")
"""First words of a docstring that do not denote an object of the field."""

WORDS = {
    "nobody": "not configured",
    "somebody": "the user, another process",
    "told": "reported, given, configured",
    "untold": "undetectable, not reported",
    "asked": "requested",
    "vouch": "certify",
    "vouches": "certifies",
    "borne": "tolerated",
    "overtaken": "out of date",
    "anew": "again, recomputed",
    "by hand": "manually, configured",
    "in hand": "current",
    "opinions": "estimates",
    "wildest": "most extreme",
    "unlike chance": "statistically significant",
    "of ours": "internal",
}
"""Word → standard terms that replace it."""

NAMES = frozenset({"told", "untold", "asked", "nobody", "vague", "said", "wanted"})
"""Variable names that do not describe a value."""

_CODE = re.compile(r"`[^`]*`")
_WORD = re.compile(rf"(?<![\w-])({'|'.join(map(re.escape, WORDS))})(?![\w-])", re.IGNORECASE)


def faults_of_code(text: str) -> Iterator[tuple[int, str]]:
    """Check a module: yield line number and fault for docstrings, strings, comments and names.

    Examples
    --------
    >>> list(faults_of_code('"Whether a file is there."'))
    [(1, 'docstring opens with Whether')]
    >>> list(faults_of_code('# as it was told' + chr(10) + 'asked = 1'))
    [(2, 'name asked'), (1, 'told: reported, given, configured')]
    """
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            opening = OPENINGS.match(node.value.value.lstrip())
            if opening:
                yield node.lineno, f"docstring opens with {opening[0]}"
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in NAMES:
            yield node.lineno, f"name {node.id}"
        elif isinstance(node, ast.arg) and node.arg in NAMES:
            yield node.lineno, f"parameter {node.arg}"
    prose = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in prose:
            for number, line in enumerate(token.string.splitlines(), token.start[0]):
                yield from ((number, fault) for fault in _words(line))


def faults_of_document(text: str) -> Iterator[tuple[int, str]]:
    """Check a document in Markdown, except code: yield line number and fault.

    Examples
    --------
    >>> list(faults_of_document("Nobody said how well."))
    [(1, 'Nobody: not configured')]
    """
    fenced = False
    for number, line in enumerate(text.splitlines(), 1):
        fenced ^= line.lstrip().startswith("```")
        if not fenced and not line.startswith("    "):
            yield from ((number, fault) for fault in _words(_CODE.sub("", line)))


def _words(line: str) -> Iterator[str]:
    for word in _WORD.finditer(line):
        yield f"{word[0]}: {WORDS[word[0].lower()]}"


def main() -> None:
    """Print all faults as file:line: fault."""
    code = [path for folder in _SOURCES for path in sorted((ROOT / folder).rglob("*.py")) if path != Path(__file__)]
    documents = [path for name in _DOCUMENTS for path in [ROOT / name, *sorted((ROOT / name).rglob("*.md"))]]
    found = [
        f"{path.relative_to(ROOT)}:{line}: {fault}"
        for paths, check in ((code, faults_of_code), (documents, faults_of_document))
        for path in paths
        if path.is_file()
        for line, fault in check(path.read_text(encoding="utf-8"))
    ]
    sys.exit("\n".join([*found, f"{len(found)} locations to be rewritten"]) if found else 0)


if __name__ == "__main__":
    main()
