"""One table tells every flag: all that code raises stands in it, and all that stands in it is raised where it says."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from apertura.common.flags import FLAGS
from apertura.common.flags.raised import Flags
from website.pages import PAGES

ROOT = Path(__file__).parents[1]
SOURCES = {path.relative_to(ROOT / "src/apertura").as_posix(): path for path in ROOT.glob("src/apertura/*/**/*.py")}
ELSEWHERE = ("flags/",)
"""Who tells of flags, or names outcomes that raise them, and raises none."""

HOLDERS = {"flags", "raised", "crossed", "lines", "said"}
"""Names under which code gathers flags."""


def names_of(node, constants):
    """Return the strings that a key or subscript may be; of one put together, its beginning with a star."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return {node.value}
    if isinstance(node, ast.JoinedStr) and isinstance(node.values[0], ast.Constant):
        return {node.values[0].value + "*"}
    return {constants[node.id]} if isinstance(node, ast.Name) and node.id in constants else set()


def tells_flags(function):
    """Whether what a function returns are flags: by its name, or by what it says that it returns."""
    said = (ast.get_docstring(function) or "").split("\n")[0].lower()
    texts = function.returns is not None and "dict[str, str]" in ast.unparse(function.returns)
    return texts and ("flag" in function.name or bool(re.search(r"\bflags?\b", said)))


def gathered(tree):
    """Yield every node that stands for flags: what is assigned to them, given as them or returned as them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and tells_flags(node):
            yield from (one for one in ast.walk(node) if isinstance(one, ast.Return) and one.value)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in {"Flags", "Flags.merged"}:
            yield from node.args
        elif isinstance(node, ast.keyword) and node.arg == "flags":
            yield node.value
        elif isinstance(node, ast.Dict):
            yield from (
                value
                for key, value in zip(node.keys, node.values, strict=True)
                if key and names_of(key, {}) == {"flags"}
            )
        elif isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(target, ast.Name) and target.id in HOLDERS for target in targets):
                yield node.value


def outermost(node):
    """Yield the dicts whose keys are flags: those an expression is made of, and none inside their values."""
    if isinstance(node, ast.Dict | ast.DictComp):
        yield node
        if isinstance(node, ast.Dict):  # {**more} goes on
            for key, value in zip(node.keys, node.values, strict=True):
                if key is None:
                    yield from outermost(value)
    elif not isinstance(node, ast.Call | ast.Subscript | ast.Lambda):
        for one in ast.iter_child_nodes(node):
            yield from outermost(one)


def raised_in(path):
    """Return the flags that a file raises."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    constants = {
        one.targets[0].id: one.value.value
        for one in tree.body
        if isinstance(one, ast.Assign) and isinstance(one.targets[0], ast.Name) and isinstance(one.value, ast.Constant)
    }
    found = set()
    for value in gathered(tree):
        for one in outermost(value):
            keys = one.keys if isinstance(one, ast.Dict) else [one.key]
            found |= {name for key in keys if key is not None for name in names_of(key, constants)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Subscript):
            holder = node.targets[0].value
            if (isinstance(holder, ast.Name) and holder.id in HOLDERS) or "flags" in ast.unparse(holder):
                found |= names_of(node.targets[0].slice, constants)
    return {name for name in found if name == name.lower()}


def known(name):
    return any(re.fullmatch(re.escape(name).replace(r"\*", r"\w+"), flag) for flag in FLAGS)


@cache
def raised():
    return {name: raised_in(path) for name, path in SOURCES.items() if not name.startswith(ELSEWHERE)}


def test_every_flag_that_code_raises_stands_in_the_table():
    unknown = {file: sorted(name for name in names if not known(name)) for file, names in raised().items()}
    assert {file: names for file, names in unknown.items() if names} == {}


def test_the_search_for_flags_finds_nearly_all_of_the_table():
    """It cannot see names that come from a table, those of logs, nor flags given on under another name."""
    found = set().union(*raised().values())
    unseen = {flag for flag in FLAGS if not any(re.fullmatch(one.replace("*", r"\w+"), flag) for one in found)}
    assert len(unseen) < len(FLAGS) / 8, sorted(unseen)


def test_every_flag_says_what_was_measured_what_it_means_and_what_to_do():
    for flag in FLAGS.values():
        for text in (flag.measured, flag.means, flag.look, flag.raised):
            assert text.strip()
            assert not set(text) & set("|`\n")


def test_every_flag_is_named_in_the_file_that_is_said_to_raise_it():
    lacking = [
        f"{file} has no {name}"
        for name, flag in FLAGS.items()
        for file in flag.raised.split(", ")
        if not re.search(rf'"{name}"|"{name.rpartition("_")[0]}_\{{', SOURCES[file].read_text(encoding="utf-8"))
    ]
    assert lacking == []


@pytest.mark.parametrize("name", PAGES)
def test_a_page_that_comes_from_the_code_is_as_it_would_be_written_now(name):
    assert (ROOT / name).read_text(encoding="utf-8") == PAGES[name](), "run: make pages"


def test_two_parts_that_raise_one_flag_both_have_their_say():
    """The union of dicts keeps the last line and loses the other without a word."""
    merged = Flags.merged({"clipped": "tx: 3 %"}, {"fix_lost": "9 pulses"}, {"clipped": "rx: 40 %"})
    assert merged == {"clipped": "tx: 3 %; rx: 40 %", "fix_lost": "9 pulses"}
    assert Flags.merged(merged, {"clipped": "rx: 40 %"}) == merged
    assert Flags.merged({"defocused": "2 dB"}, {"defocused": "2 dB; most likely time tags"}) == {
        "defocused": "2 dB; most likely time tags"
    }


def test_flags_are_brought_together_in_one_way_alone():
    other = re.compile(r"""\*\*[\w.()]*\bflags\b|\bflags["\]]* \|=? |\| [\w.]*\bflags\b|\bflags["\]]*\.update\(""")
    sources = [path for path in (ROOT / "src/apertura").rglob("*.py") if path.name != "raised.py"]
    assert len(sources) > 100
    assert [path.name for path in sources if other.search(path.read_text(encoding="utf-8"))] == []
