"""The code hash follows imports: it changes with what a stage can run and with nothing else."""

import shutil
import sys
from pathlib import Path

import pytest

from apertura import provenance

PACKAGE = Path(provenance.__file__).parent


@pytest.fixture
def copied(tmp_path, monkeypatch):
    shutil.copytree(PACKAGE, tmp_path / "apertura", ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    monkeypatch.setattr(provenance, "_PACKAGE", tmp_path / "apertura")
    return tmp_path / "apertura"


def touched(copied, file, module):
    provenance._imports.cache_clear()
    before = provenance.code_sha256(module)
    with (copied / file).open("a") as stream:
        stream.write("\n# edited\n")
    return provenance.code_sha256(module) != before


@pytest.mark.parametrize(
    ("edited", "step", "reruns"),
    [
        ("focus/engines/numba.py", "image", True),
        ("focus/engines/numba.py", "echo", False),
        ("fusion/sums.py", "cube", True),
        ("fusion/sums.py", "image", False),
        ("echo/sidelink.py", "echo", True),
        ("echo/sidelink.py", "image", False),
        ("export/cog.py", "export", True),
        ("export/cog.py", "cube", False),
        ("ingest/rtklib.py", "ingest", True),
        ("simulation/presets.py", "image", False),
        ("constants.py", "image", True),
        ("settings/nodes.py", "ingest", True),
        ("store/locks.py", "ingest", True),
        ("cli.py", "ingest", False),
    ],
)
def test_editing_a_module_changes_what_depends_on_it_and_nothing_else(copied, edited, step, reruns):
    assert touched(copied, edited, f"apertura.steps.{step}") is reruns


@pytest.mark.parametrize(("step", "reruns"), [("image", True), ("echo", False)])
def test_compiling_other_sources_changes_what_runs_them(copied, step, reruns):
    digests = copied / "focus/engines/_backprojection.sha256"
    digests.write_text("of other sources")
    assert touched(copied, digests, f"apertura.steps.{step}") is reruns


def test_every_step_stands_on_modules_that_were_found():
    closure = provenance._closure(["apertura.steps.image"])
    loaded = {name for name in closure if name in sys.modules}
    assert {"apertura.store", "apertura.focus.engines.reference", "apertura.geometry.geodesy"} <= set(closure)
    assert loaded <= set(closure)


def test_two_hashes_for_one_role_are_refused():
    with pytest.raises(ValueError, match="codes"):
        provenance.merged({"codes": "a"}, {"codes": "b"})
