"""Shared campaigns: the real ones beside the repository, and small simulated ones made once a session."""

from dataclasses import replace

import pytest
from folders import SHARED, copy_writable, run_steps
from in_this_process import Processes

from apertura.focus.engines import ENGINES, native, native_binding
from apertura.ingest import isolated
from apertura.simulation import ImageGrid, preset, simulate

# They run in other environments: of roc-validator, of QGIS.
collect_ignore = ["crate/contexts.py", "crate/profile", "in_qgis.py"]


@pytest.fixture(scope="session")
def shared():
    """../shared/data, where it exists."""
    if not SHARED.is_dir():
        pytest.skip("real recordings are not here: no ../shared/data beside the repository")
    return SHARED


@pytest.fixture(scope="session")
def _tiny(tmp_path_factory):
    plan = replace(preset("demo", pulses=40), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    return simulate(tmp_path_factory.mktemp("tiny") / "campaign", plan, seed=7)


@pytest.fixture
def tiny(_tiny, tmp_path):
    """A campaign folder of 40 pulses and 60 × 60 pixels, to be spoilt at will."""
    return copy_writable(_tiny, tmp_path / "campaign")


@pytest.fixture(scope="session")
def finished_tiny(_tiny, tmp_path_factory):
    """The tiny campaign with all its results; read only."""
    return run_steps(copy_writable(_tiny, tmp_path_factory.mktemp("finished") / "campaign"))


@pytest.fixture(scope="session")
def finished_sample(shared, tmp_path_factory):
    """The independently made campaign-sample with all its results; read only."""
    return run_steps(copy_writable(shared / "campaign-sample", tmp_path_factory.mktemp("sample") / "campaign"))


@pytest.fixture(params=native.INSTRUCTION_SETS)
def isa(request, monkeypatch):
    """Each instruction set of the compiled engine that this machine runs, in turn."""
    if not native_binding.runs(request.param):
        pytest.skip(f"this machine has no {request.param}")
    monkeypatch.setenv("APERTURA_ISA", request.param)
    return request.param


@pytest.fixture
def toy(monkeypatch):
    """The engine of `toy_engine.py`, known by its one row."""
    monkeypatch.setitem(ENGINES, "toy", "toy_engine")


@pytest.fixture(params=["here", pytest.param("isolated", marks=pytest.mark.slow)])
def reader(request, monkeypatch):
    """What reads files that may crash their reader: this process, at once; by `make test-slow` one of its own, too."""
    if request.param == "here":
        monkeypatch.setattr(isolated, "subprocess", Processes)
