"""What the documents name is there: files, tests, commands, dotted names and keys of the config."""

import json
import pkgutil
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted([*ROOT.glob("docs/**/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "config/README.md"])
GUIDE = ROOT / "docs/finding_your_way.md"
PLACES = (ROOT, ROOT / "src/apertura", ROOT / "docs")

_FILE = re.compile(r"(?<![\w/<>.*-])((?:[\w.*-]+/)*[\w*-]+\.(?:py|hpp|cpp|smk|md|toml|yml|rst))\b(?![\w/])")
_FOLDER = re.compile(r"(?<![\w/<>.-])((?:src|docs|tests|native|workflow|benchmarks|profiles|requirements)/[\w./-]*)")
_LINK = re.compile(r"\]\(([^)#:]+)\)")
_TEST = re.compile(r"\btest_\w+(?!\.py|\w)")
_DOTTED = re.compile(r"`((?:apertura|ap)\.[\w.]+(?::\w+)?)(?:\([^`]*)?`")
_COMMAND = re.compile(r"\bapertura (step |study )?([a-z]+(?:-[a-z]+)*)\b")
_KEY = re.compile(r"`((?:waveform|nodes|scene|processing|calibration)\.[\w.<>]+)`")

ENTRY_POINTS = {"apertura.exports"}
"""Groups of entry points: names, but not of modules."""

parametrized = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())


def text_of(document):
    return document.read_text(encoding="utf-8")


def is_there(name, document):
    return any(any(place.glob(name.rstrip("/"))) for place in (*PLACES, document.parent))


@parametrized
def test_every_file_that_a_document_names_is_there(document):
    text = text_of(document)
    named = {*_FILE.findall(text), *(name for name in _FOLDER.findall(text) if "." not in Path(name).name)}
    assert [name for name in sorted(named) if not is_there(name, document)] == []
    assert [link for link in _LINK.findall(text) if not (document.parent / link).exists()] == []


@parametrized
def test_every_test_that_a_document_cites_exists(document):
    written = set(re.findall(r"^\s*def (test_\w+)", "\n".join(map(text_of, ROOT.glob("tests/*.py"))), re.M))
    assert sorted(set(_TEST.findall(text_of(document))) - written) == []


@parametrized
def test_every_dotted_name_in_a_document_resolves(document):
    for name in sorted(set(_DOTTED.findall(text_of(document))) - ENTRY_POINTS):
        assert pkgutil.resolve_name(re.sub(r"^ap\.", "apertura.", name)) is not None


@parametrized
def test_every_command_that_a_document_gives_exists(document):
    from typer.main import get_command

    from apertura.cli import app

    commands = get_command(app).commands
    shown = re.findall(r"`([^`\n]*)`|^(?:    |\$ )(.*)$", text_of(document), re.M)
    for group, command in _COMMAND.findall("\n".join("".join(pair) for pair in shown)):
        known = commands[group.strip()].commands if group else commands
        assert command in known, f"apertura {group}{command}"


@parametrized
def test_every_key_of_the_config_that_a_document_names_exists(document):
    schema = json.loads((ROOT / "config/schema.json").read_text(encoding="utf-8"))
    parts = [schema, *schema["$defs"].values()]
    keys = {key for part in parts for key in part.get("properties", {})} | {"native", "numba", "reference"}
    named = {word for key in _KEY.findall(text_of(document)) for word in key.split(".") if not word.startswith("<")}
    assert sorted(named - keys) == []


def test_every_name_in_the_guide_stands_in_the_file_beside_it():
    rows = re.findall(r"^\| (.+\?) \| `([^`]+)` \|(.*)\|$", text_of(GUIDE), re.M)
    assert len(rows) >= 20
    for question, file, names in rows:
        for name in re.findall(r"`([\w.]+)`", names):
            assert re.search(rf"\b{re.escape(name)}\b", text_of(ROOT / file)), f"{question} {file} has no {name}"
