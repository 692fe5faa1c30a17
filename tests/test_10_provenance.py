"""The code hash follows imports: it changes with what a stage can run and with nothing else."""

import json
import shutil
import subprocess
import sys
from types import SimpleNamespace

import pytest

from apertura.code_imports import PACKAGE, import_closure
from apertura.focus.engines import ENGINES
from apertura.provenance import Provenance, code_sha256, merged


@pytest.fixture
def copied(tmp_path):
    return shutil.copytree(PACKAGE, tmp_path / "apertura", ignore=shutil.ignore_patterns("__pycache__", "*.so"))


def changes(copied, file, *modules):
    before = code_sha256(*modules, package=copied)
    with (copied / file).open("a") as stream:
        stream.write("\n# edited\n")
    return code_sha256(*modules, package=copied) != before


def code_of(step):
    """What the workflow hashes: the step and, for the image, every engine that may form it."""
    return (f"apertura.steps.{step}", *(ENGINES.values() if step == "image" else ()))


@pytest.mark.parametrize(
    ("edited", "step", "reruns"),
    [
        ("focus/engines/numba.py", "image", True),
        ("focus/engines/numba.py", "echo", False),
        ("fusion/sums.py", "cube", True),
        ("fusion/sums.py", "image", False),
        ("echo/sidelink.py", "echo", True),
        ("echo/sidelink.py", "image", False),
        ("export/__init__.py", "export", True),
        ("export/cog.py", "export", True),
        ("export/cog.py", "cube", False),
        ("export/__init__.py", "cube", False),
        ("ingest/rtklib.py", "ingest", True),
        ("simulation/presets.py", "image", False),
        ("constants.py", "image", True),
        ("settings/nodes.py", "ingest", True),
        ("store/progress.py", "ingest", True),
        ("cli.py", "ingest", False),
    ],
)
def test_editing_a_module_changes_what_depends_on_it_and_nothing_else(copied, edited, step, reruns):
    assert changes(copied, edited, *code_of(step)) is reruns


@pytest.mark.parametrize(("step", "reruns"), [("image", True), ("echo", False)])
def test_compiling_other_sources_changes_what_runs_them(copied, step, reruns):
    digests = copied / "focus/engines/_backprojection.sha256"
    digests.write_text("of other sources")
    assert changes(copied, digests, *code_of(step)) is reruns


LOADED = """
import json, sys
import apertura.steps.image
ours = {name: module for name, module in sys.modules.items() if name.partition(".")[0] == "apertura"}
print(json.dumps([name for name, module in ours.items() if not hasattr(module, "__path__")]))
"""


@pytest.mark.slow
def test_every_module_that_an_import_loads_is_in_the_closure():
    shown = subprocess.run([sys.executable, "-c", LOADED], check=True, capture_output=True, text=True)
    loaded = set(json.loads(shown.stdout))
    assert {"apertura.store.stages", "apertura.focus.engines.reference", "apertura.geometry.geodesy"} <= loaded
    assert loaded <= set(import_closure(["apertura.steps.image"]))


def test_a_module_of_another_package_counts_with_what_it_imports_of_apertura(tmp_path, monkeypatch, copied):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "toy_format.py").write_text("import json\nfrom apertura.export import cog\n")
    assert "json" not in import_closure(["toy_format"], package=copied)
    assert changes(copied, "export/cog.py", "toy_format")
    assert changes(copied, "../toy_format.py", "toy_format")


def test_two_hashes_for_one_role_are_refused():
    with pytest.raises(ValueError, match="codes"):
        merged({"codes": "a"}, {"codes": "b"})


def stage(code, **runspec):
    return SimpleNamespace(attrs={"runspec": json.dumps(runspec), "inputs": {code: code}, "code_sha256": code})


def test_settings_of_one_line_join_and_those_of_several_lines_stay_apart():
    first, second = stage("1", node="a", window="hann"), stage("2", node="b")
    line = Provenance.of(["apertura.errors"], [first, second], settings={"engine": "native"})
    assert line.runspec == {"node": "b", "window": "hann", "engine": "native"}
    apart = Provenance.of(["apertura.errors"], {"a-a": first, "a-b": second})
    assert apart.runspec == {"a-a": {"node": "a", "window": "hann"}, "a-b": {"node": "b"}}
    assert apart.inputs == {"1": "1", "2": "2"}


def test_the_code_of_a_parent_changes_the_code_of_its_child():
    hashes = {Provenance.of(["apertura.errors"], [stage(code)]).code_sha256 for code in ("1", "2")}
    assert len(hashes) == 2
