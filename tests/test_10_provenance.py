"""The code hash follows imports: the hash changes only with the code that a stage can run."""

import ast
import hashlib
import json
import shutil
import subprocess
import sys
from types import EllipsisType, SimpleNamespace

import numpy as np
import pytest

from apertura.common.code_imports import PACKAGE, import_closure, without_description
from apertura.common.provenance import Provenance, code_sha256, hashes_of_file, merged
from apertura.core.backprojection.engines import ENGINES
from apertura.formats.export import export_modules

RUN = {"image": ENGINES.values(), "export": export_modules("pair")}


@pytest.fixture(scope="module")
def copied(tmp_path_factory):
    folder = tmp_path_factory.mktemp("copied") / "apertura"
    return shutil.copytree(PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__", "*.so"))


def changes(copied, file, *modules):
    """Return True if the code hash of modules changes with an edit of a file; the edit is reverted."""
    path = copied / file
    before, text = code_sha256(*modules, package=copied), path.read_bytes()
    path.write_bytes(text + b"\nEDITED = 1\n")
    after = code_sha256(*modules, package=copied)
    path.write_bytes(text)
    return after != before


@pytest.mark.parametrize(
    ("edited", "step", "reruns"),
    [
        ("core/backprojection/engines/numba.py", "image", True),
        ("core/backprojection/engines/numba.py", "echo", False),
        ("core/combination.py", "cube", True),
        ("core/combination.py", "image", False),
        ("core/echo/sidelink.py", "echo", True),
        ("core/echo/sidelink.py", "image", True),  # the check of its samples recomputes some samples
        ("core/echo/calibration.py", "image", False),
        ("formats/export/__init__.py", "export", True),
        ("formats/export/cog.py", "export", True),
        ("formats/export/cog.py", "cube", False),
        ("formats/export/__init__.py", "cube", False),
        ("formats/tracks/rtklib.py", "ingest", False),
        ("simulation/presets.py", "image", False),
        ("common/constants.py", "image", True),
        ("campaign/config/nodes.py", "ingest", True),
        ("campaign/store/progress.py", "ingest", True),
        ("common/errors.py", "image", False),
        ("formats/names.py", "ingest", True),
        ("formats/tracks/px4_ulog.py", "ingest", False),
        ("cli.py", "ingest", False),
    ],
)
def test_editing_a_module_changes_only_hashes_that_depend_on_it(copied, edited, step, reruns):
    assert changes(copied, edited, f"apertura.stages.{step}", *RUN.get(step, ())) is reruns


@pytest.mark.parametrize(("step", "reruns"), [("image", True), ("echo", False)])
def test_compiling_other_sources_changes_the_hash(copied, step, reruns):
    digests = copied / "core/backprojection/engines/_backprojection.sha256"
    digests.write_text("of other sources")
    assert changes(copied, digests, f"apertura.stages.{step}", *RUN.get(step, ())) is reruns


LOADED = """
import json, sys
from apertura.common.code_imports import WITHOUT_EFFECT
for name in WITHOUT_EFFECT:
    __import__(name)
before = set(sys.modules)
import apertura.stages.image
ours = {name: module for name, module in sys.modules.items() if name.partition(".")[0] == "apertura"}
print(json.dumps([name for name, module in ours.items() if name not in before and not hasattr(module, "__path__")]))
"""


@pytest.mark.slow
def test_import_closure_has_every_loaded_module():
    listing = subprocess.run([sys.executable, "-c", LOADED], check=True, capture_output=True, text=True)
    loaded = set(json.loads(listing.stdout))
    assert {
        "apertura.campaign.store.progress",
        "apertura.core.backprojection.tiles",
        "apertura.core.geometry.aperture",
    } <= loaded
    assert loaded <= set(import_closure(["apertura.stages.image"]))


def test_closure_of_a_foreign_module_includes_its_apertura_imports(monkeypatch, copied):
    monkeypatch.syspath_prepend(copied.parent)
    (copied.parent / "toy_format.py").write_text("import json\nfrom apertura.formats.export import cog\n")
    assert "json" not in import_closure(["toy_format"], package=copied)
    assert changes(copied, "formats/export/cog.py", "toy_format")
    assert changes(copied, "../toy_format.py", "toy_format")


def as_run(source):
    """Return the syntax tree of a source without docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        for field in ("body", "orelse", "finalbody"):
            if isinstance(statements := getattr(node, field, None), list):
                setattr(node, field, [statement for statement in statements if not is_docstring(statement)])
    return ast.dump(tree)


def is_docstring(statement):
    value = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str | EllipsisType)


@pytest.mark.quick("common")
@pytest.mark.parametrize(
    "layer", sorted(path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name[0] != "_")
)
def test_removing_descriptions_keeps_the_code(layer):
    for path in PACKAGE.joinpath(layer).rglob("*.py"):
        source = path.read_text()
        assert as_run(without_description(source)) == as_run(source), path


def test_string_value_is_part_of_the_code():
    first, second = (without_description(f'page = (\n    """{text}\n\n# {text}"""\n)\n') for text in "ab")
    assert first != second


def test_two_hashes_for_one_role_are_rejected():
    with pytest.raises(ValueError, match="codes"):
        merged({"codes": "a"}, {"codes": "b"})


def stage(code, **runspec):
    return SimpleNamespace(attrs={"runspec": json.dumps(runspec), "inputs": {code: code}, "code_sha256": code})


def test_settings_of_one_lineage_merge_and_of_several_stay_separate():
    first, second = stage("1", node="a", window="hann"), stage("2", node="b")
    line = Provenance.of(["apertura.common.errors"], [first, second], settings={"engine": "native"})
    assert line.runspec == {"node": "b", "window": "hann", "engine": "native"}
    separate = Provenance.of(["apertura.common.errors"], {"a-a": first, "a-b": second})
    assert separate.runspec == {"a-a": {"node": "a", "window": "hann"}, "a-b": {"node": "b"}}
    assert separate.inputs == {"1": "1", "2": "2"}


def test_code_hash_of_a_parent_changes_that_of_its_child():
    hashes = {Provenance.of(["apertura.common.errors"], [stage(code)]).code_sha256 for code in ("1", "2")}
    assert len(hashes) == 2


@pytest.mark.parametrize("size", [0, 1, 4 << 20, (4 << 20) + 1, 8 << 20, (13 << 20) + 7])
def test_both_hashes_of_a_file_match_its_bytes(tmp_path, size):
    """The file has no, part of one or several blocks; a buffer is reused only after both hashes have processed it."""
    content = np.random.default_rng(size).bytes(size)
    (tmp_path / "samples").write_bytes(content)
    expected = {name: hashlib.new(name, content).hexdigest() for name in ("sha256", "sha512")}
    assert hashes_of_file(tmp_path / "samples", ["sha256", "sha512"]) == expected
