"""References in the documentation exist: files, tests, commands, dotted names and keys of the config."""

import json
import pkgutil
import re
import tomllib
from functools import cache
from pathlib import Path

from apertura.workflow.rules import RESULTS
from website.theory_tests import TESTS

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(
    [*ROOT.glob("docs/**/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "config/README.md"]
)
CODE = sorted([*ROOT.glob("src/**/*.py"), *ROOT.glob("research/**/*.py")])
PLACES = (ROOT, ROOT / "src/apertura")
SOURCES = ("src", "research", "native", "tests", "workflow", "benchmarks")

_FILE = re.compile(r"(?<![\w/<>.*-])((?:[\w.*-]+/)*[\w*-]+\.(?:py|hpp|cpp|smk|md|toml|yml|rst))\b(?![\w/])")
_FOLDER = re.compile(
    r"(?<![\w/<>.-])((?:src|research|docs|tests|native|workflow|benchmarks|profiles|requirements)/[\w./*-]*)"
)
_LINK = re.compile(r"\]\(([^)#:]+)\)")
_TEST = re.compile(r"\btest_\w+(?![\w*]|\.py)")
_DOTTED = re.compile(r"`((?:apertura|ap)\.[\w.]+(?::\w+)?)(?:\([^`]*)?`")
_COMMAND = re.compile(r"\bapertura (step |study )?([a-z]+(?:-[a-z]+)*)\b")
_KEY = re.compile(r"`((?:waveform|nodes|scene|processing|calibration)\.(?!py|json)[\w.<>]+)`")

_CITED = re.compile(r"(docs/[\w/]+\.md)((?:[,;]? (?:and )?(?:eqs?\. [\w]+|\"[^\"]+\"))+)")

_NAME_IN_FILE = re.compile(r"`(\w+)` (?:of `\w+` )?in `([\w/.]+\.(?:py|hpp|cpp|smk))`")

ENTRY_POINTS = {"apertura.exports", "apertura.commands"}
"""Groups of entry points, which look like names of modules."""


@cache
def text_of(path):
    return path.read_text(encoding="utf-8")


@cache
def anywhere(name):
    return any(any((ROOT / folder).rglob(name)) for folder in SOURCES)


def exists(name, document):
    """Return True if a path exists below the root, src/apertura or the document's folder, or a bare name anywhere."""
    if any(any(place.glob(name.rstrip("/"))) for place in (*PLACES, document.parent)):
        return True
    return "/" not in name and anywhere(name)


def missing(lacking_in, documents=DOCUMENTS):
    """Return document → missing references, for documents with missing references."""
    assert len(documents) > 20
    lacking = {document.relative_to(ROOT).as_posix(): sorted(lacking_in(document)) for document in documents}
    return {document: names for document, names in lacking.items() if names}


def test_files_named_in_documents_exist():
    def lacking(document):
        text = text_of(document)
        named = {*_FILE.findall(text), *(name for name in _FOLDER.findall(text) if "." not in Path(name).name)}
        yield from (name for name in named if not exists(name, document))
        yield from (link for link in _LINK.findall(text) if not (document.parent / link).exists())

    assert missing(lacking) == {}


def test_tests_cited_in_documents_exist():
    defined = set(re.findall(r"^\s*def (test_\w+)", "\n".join(map(text_of, ROOT.glob("tests/*.py"))), re.M))
    assert missing(lambda document: set(_TEST.findall(text_of(document))) - defined) == {}


def test_table_of_tests_has_every_section_of_the_theory():
    for page, sections in TESTS.items():
        text = text_of(ROOT / ("docs/theory.md" if page == "theory" else f"docs/theory/{page}.md"))
        assert re.findall(r"^##? (.+)", text, re.M) == list(sections), page
        for equations in {label for checked in sections.values() for label in checked} - {""}:
            for label in equations.split(", "):
                assert re.search(rf"\({label}\)|eqs?\. {label}\b", text), f"{page}, eq. {label}"
    assert {path.stem for path in ROOT.glob("docs/theory/*.md")} == {*TESTS, "tests"} - {"theory"}


def test_theory_names_no_test_in_running_text():
    theory = [ROOT / "docs/theory.md", *ROOT.glob("docs/theory/*.md")]
    assert [path.name for path in theory if re.search(r"\btest_\w", text_of(path))] == ["tests.md"]


def test_identifiers_quoted_in_theory_and_glossary_exist():
    files = [
        ROOT / "config/schema.json",
        *(ROOT / "native").glob("*.?pp"),
        *CODE,
        *ROOT.glob("tests/*.py"),
    ]
    code = set(re.findall(r"\w+", "\n".join(map(text_of, files))))

    def lacking(document):
        quoted = re.findall(r"`([^`\n]+)`", text_of(document))
        words = [re.findall(r"[A-Za-z]\w*", name) for name in quoted if not re.search(r"[/*{]|\.\w+$", name)]
        return {word for names in words for word in names if re.search(r"_|[a-z][A-Z]", word)} - code

    assert missing(lacking, [*ROOT.glob("docs/theory/*.md"), *ROOT.glob("docs/[glt]*.md")]) == {}


def resolves(name):
    try:
        return pkgutil.resolve_name(re.sub(r"^ap\.", "apertura.", name)) is not None
    except (ImportError, AttributeError):
        return False


def test_dotted_names_in_documents_resolve():
    def lacking(document):
        return (name for name in set(_DOTTED.findall(text_of(document))) - ENTRY_POINTS if not resolves(name))

    assert missing(lacking) == {}


def test_commands_in_documents_exist():
    from typer.main import get_command

    from apertura.cli import app

    root = get_command(app)
    commands = {name: root.get_command(None, name) for name in root.list_commands(None)}

    def lacking(document):
        shown = re.findall(r"`([^`\n]*)`|^(?:    |\$ )(.*)$", text_of(document), re.M)
        for group, command in _COMMAND.findall("\n".join("".join(pair) for pair in shown)):
            known = commands[group.strip()].commands if group else commands
            if command not in known:
                yield f"apertura {group}{command}"

    assert missing(lacking) == {}


def test_config_keys_in_documents_exist():
    schema = json.loads(text_of(ROOT / "config/schema.json"))
    parts = [schema, *schema["$defs"].values()]
    keys = {key for part in parts for key in part.get("properties", {})} | {"native", "numba", "cuda", "reference"}

    def lacking(document):
        config, *_ = text_of(document).split("\n## image.json")  # without image.json, whose keys are not config keys
        named = {word for key in _KEY.findall(config) for word in key.split(".")}
        return {word for word in named if not word.startswith("<")} - keys

    assert missing(lacking) == {}


def test_names_that_documents_locate_in_files_exist():
    def lacking(document):
        for name, file in _NAME_IN_FILE.findall(text_of(document)):
            path = next(place / file for place in PLACES if (place / file).is_file())
            if not re.search(rf"\b{name}\b", text_of(path)):
                yield f"{file} has no {name}"

    assert missing(lacking) == {}


def test_headings_and_equations_cited_in_code_exist():
    cited = 0
    for source in [*CODE, *ROOT.glob("native/*.?pp"), *ROOT.glob("tests/*.py")]:
        for document, citation in _CITED.findall(re.sub(r"\s+(?:// )?", " ", text_of(source))):
            text = text_of(ROOT / document)
            for heading in re.findall(r"\"([^\"]+)\"", citation):
                assert re.search(rf"^(#+ (\d\. )?|\*\*){re.escape(heading)}\b", text, re.M), (
                    f"{source}: {document}, {heading}"
                )
                cited += 1
            for number in re.findall(r"eqs?\. (\w+)", citation):
                assert re.search(rf"\({number}\)|eqs?\. {number}\b|to {number}\)", text), (
                    f"{source}: {document}, eq. {number}"
                )
                cited += 1
    assert cited > 50


def test_documented_layers_match_the_import_contract():
    contracts = tomllib.loads(text_of(ROOT / "pyproject.toml"))["tool"]["importlinter"]["contracts"]
    checked = [set(re.findall(r"apertura\.([a-z]+)", layer)) for layer in contracts[0]["layers"]]
    table = text_of(ROOT / "CONTRIBUTING.md").partition("| layer of")[2]
    rows = re.findall(r"^\| (`[^|]*/`) \| ([^|]*)\|", table, re.M)[: len(checked) - 3]
    assert [set(re.findall(r"`(\w+)/`", layer)) for layer, _ in rows] == [names for names in checked if names - {"cli"}]
    for names, (_, packages) in zip([names for names in checked if names - {"cli"}], rows, strict=True):
        for package in re.findall(r"`(\w+)/`", packages):
            assert any((ROOT / "src/apertura" / layer / package).is_dir() for layer in names), package


def test_data_flow_page_has_every_stage_with_rule_and_module():
    text, drawn = text_of(ROOT / "docs/dataflow.md"), text_of(ROOT / "docs/assets/dataflow.svg")
    rows = [re.findall(r"`([^`]+)`", row) for row in re.findall(r"^\| (`.*)", text.partition("## Stages")[2], re.M)]
    documented = {row[0]: row[1:] for row in rows}
    assert documented.keys() == RESULTS.keys()
    for result, words in documented.items():
        rule = RESULTS[result]
        assert {rule.name, rule.module.removeprefix("apertura.stages.")} <= set(words), result
    boxes = set(re.findall(r'class="stage"[^>]*>(\w+)<', drawn))
    assert {name for name, rule in RESULTS.items() if not rule.on_demand} - {"bench"} <= boxes <= RESULTS.keys()


def test_every_dependency_has_a_documented_reason():
    settings = tomllib.loads(text_of(ROOT / "pyproject.toml"))
    project = settings["project"]
    listed = [*project["dependencies"], *settings["dependency-groups"]["dev"]]
    listed += [requirement for extra in project["optional-dependencies"].values() for requirement in extra]
    reasons = text_of(ROOT / "docs/decisions.md").partition("## Dependencies")[2]
    names = {re.match(r"[\w-]+", requirement)[0] for requirement in listed}
    assert {name for name in names if not re.search(rf"(?<![\w-]){name}(?![\w-])", reasons)} == set()
