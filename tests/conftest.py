"""Shared campaigns: the real ones beside the repository, and small simulated ones made once a run. What is slow.

Nothing of apertura is imported before a test needs it: the process that only hands out tests reads this file, too.
"""

import fcntl
import gc
import os
from dataclasses import replace
from fnmatch import fnmatchcase

import pytest

# Arrays here are small, and a test has one core: threads of BLAS that wait for work took a third of all time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# They run in other environments: of roc-validator, of QGIS.
collect_ignore = ["crate/contexts.py", "crate/profile", "in_qgis.py"]


COMPILING = {"apertura.core.imaging.backproject.backproject", "apertura.core.imaging.judgement.judge"}
"""Doctests that are slow: the compiler of numba starts for them."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Of tests that are marked ``quick(*ids)``, rows of other ids are slow; an id may hold stars."""
    named, met = {}, set()
    for item in items:
        if item.name in COMPILING:
            item.add_marker(pytest.mark.slow)
        marker = item.get_closest_marker("quick")
        if marker:
            function, row = item.nodeid.partition("[")[0], item.callspec.id
            named |= {(function, quick): item for quick in marker.args}
            matching = [(function, quick) for quick in marker.args if fnmatchcase(row, quick)]
            met.update(matching)
            if not matching:
                item.add_marker(pytest.mark.slow)
    gone = [f"{function}[{row}]" for function, row in named.keys() - met]
    if gone and not any("::" in arg for arg in config.args):
        raise pytest.UsageError(f"marked quick, and no test: {', '.join(sorted(gone))}")


def pytest_collection_finish():
    """What was imported stays: no search for garbage needs to look at it again."""
    gc.freeze()


@pytest.fixture(scope="session")
def made_once(tmp_path_factory, worker_id):
    """A folder that is made by the first worker that asks for it, and read by all."""

    def made(name, make):
        base = tmp_path_factory.getbasetemp()
        base = base if worker_id == "master" else base.parent
        with (base / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (base / f"{name}.made").exists():
                make(base / name / "campaign")
                (base / f"{name}.made").touch()
        return base / name / "campaign"

    return made


@pytest.fixture(scope="session")
def shared():
    """../shared/data, where it exists."""
    from folders import SHARED

    if not SHARED.is_dir():
        pytest.skip("real recordings are not here: no ../shared/data beside the repository")
    return SHARED


@pytest.fixture(scope="session")
def _tiny(made_once):
    from apertura.simulation import ImageGrid, preset, simulate

    plan = replace(preset("demo", pulses=40), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    return made_once("tiny", lambda root: simulate(root, plan, seed=7))


@pytest.fixture
def tiny(_tiny, tmp_path):
    """A campaign folder of 40 pulses and 60 × 60 pixels, to be spoilt at will."""
    from folders import copy_writable

    return copy_writable(_tiny, tmp_path / "campaign")


@pytest.fixture(scope="session")
def all_steps(made_once):
    """A copy of a campaign folder with all its results, by the name of what is made; read only."""
    from folders import copy_writable, run_steps

    from apertura.campaign.folder import Campaign

    def made(name, source):
        return Campaign.load(made_once(name, lambda root: run_steps(copy_writable(source, root))))

    return made


@pytest.fixture(scope="session")
def finished_tiny(_tiny, all_steps):
    """The tiny campaign with all its results; read only."""
    return all_steps("finished", _tiny)


@pytest.fixture(scope="session")
def run_by_snakemake(_tiny, made_once):
    """The tiny campaign as `snakemake` itself runs it, each step a process, images in two jobs each; read only."""
    from folders import copy_writable, finished, snakemake

    def run(root):
        code, output = finished(snakemake(copy_writable(_tiny, root), "all", "pages", "--set-scatter", "tiles=2"))
        assert code == 0, output

    return made_once("by_snakemake", run)


@pytest.fixture(scope="session")
def finished_sample(shared, all_steps, tmp_path_factory):
    """The independently made campaign-sample with all its results; read only."""
    from folders import copy_writable, state

    campaign = copy_writable(shared / "campaign-sample", tmp_path_factory.mktemp("sample") / "campaign")
    state(campaign, "scene", atmosphere={"refractivity_n": 0.0})  # which the model that made it flies in
    return all_steps("sample", campaign)


def pytest_generate_tests(metafunc):
    """Tests with `isa` run on every instruction set of the compiled engine; the one that is taken here is quick."""
    if "isa" in metafunc.fixturenames:
        from apertura.core.backprojection.engines import native, native_binding

        taken = next(filter(native_binding.supports, native.INSTRUCTION_SETS), None)
        others = [pytest.param(isa, marks=pytest.mark.slow) for isa in native.INSTRUCTION_SETS if isa != taken]
        metafunc.parametrize("isa", [taken, *others] if taken else others, indirect=True)


@pytest.fixture
def isa(request, monkeypatch):
    """An instruction set that the compiled engine runs on."""
    from apertura.core.backprojection.engines import native_binding

    if not native_binding.supports(request.param):
        pytest.skip(f"this machine has no {request.param}")
    monkeypatch.setenv("APERTURA_ISA", request.param)
    return request.param


@pytest.fixture
def toy(monkeypatch):
    """The engine of `toy_engine.py`, known by its one row."""
    from apertura.core.backprojection.engines import ENGINES

    monkeypatch.setitem(ENGINES, "toy", "toy_engine")


@pytest.fixture(params=["here", pytest.param("isolated", marks=pytest.mark.slow)])
def reader(request, monkeypatch):
    """What reads files that may crash their reader: this process, at once; by `make test-slow` one of its own, too."""
    if request.param == "here":
        from in_this_process import Processes

        from apertura.formats import isolated

        monkeypatch.setattr(isolated, "subprocess", Processes)
