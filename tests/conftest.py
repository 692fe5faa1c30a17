"""Shared campaigns (real campaigns next to the repository, simulated campaigns) and markers of slow tests.

Nothing of apertura is imported before a test needs it: the process that only distributes tests also reads this file.
"""

import fcntl
import functools
import gc
import os
from dataclasses import replace
from fnmatch import fnmatchcase

import pytest
from _pytest.doctest import DoctestModule

# Arrays in tests are small, and a test has one core: idle BLAS threads took a third of the total time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# No file of a test needs to survive a power failure; tests of synchronisation replace the function themselves.
os.fsync = lambda _: None

# These files run in the environments of roc-validator and of QGIS.
collect_ignore = ["crate/contexts.py", "crate/profile", "in_qgis.py"]


COMPILING = {"apertura.core.imaging.backproject.backproject", "apertura.core.imaging.judgement.judge"}
"""Doctests that are marked slow because they start the compiler of numba."""


@pytest.hookimpl(wrapper=True)
def pytest_collect_file():
    """Collect no doctests from the tests, which would also import every program beside them."""
    return [collector for collector in (yield) if not isinstance(collector, DoctestModule)]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Mark rows of tests marked ``quick(*ids)`` as slow if their id matches none; an id may contain wildcards."""
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
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)  # short tests fill the gaps between long ones
    unmatched = [f"{function}[{row}]" for function, row in named.keys() - met]
    if unmatched and not any("::" in arg for arg in config.args):
        raise pytest.UsageError(f"marked quick, and no test: {', '.join(sorted(unmatched))}")


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Exclude imported modules and collected tests from garbage collection, since they stay alive until the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _command_tree():
    """Build the tree of commands once per process, not for each command line."""
    import typer.main

    typer.main.get_command = functools.cache(typer.main.get_command)


@pytest.fixture(scope="session")
def made_once(tmp_path_factory, worker_id):
    """Return a function that generates a shared folder in the first worker that requests it."""

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
    """Folder of real recordings, ../shared/data."""
    from folders import SHARED

    if not SHARED.is_dir():
        pytest.skip("real recordings not available: no ../shared/data next to the repository")
    return SHARED


@pytest.fixture(scope="session")
def _tiny(made_once):
    from apertura.simulation import ImageGrid, preset, simulate

    plan = replace(preset("demo", pulses=40), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    return made_once("tiny", lambda root: simulate(root, plan, seed=7))


@pytest.fixture
def tiny(_tiny, tmp_path):
    """A campaign folder of 40 pulses and 60 × 60 pixels, writable for the test."""
    from folders import copy_writable

    return copy_writable(_tiny, tmp_path / "campaign")


@pytest.fixture(scope="session")
def all_steps(made_once):
    """Return a function that runs all steps on a copy of a campaign folder, cached by name; read only."""
    from folders import copy_writable

    from apertura.campaign.folder import Campaign
    from apertura.run.process import process

    def made(name, source):
        return Campaign.load(made_once(name, lambda root: process(copy_writable(source, root))))

    return made


@pytest.fixture(scope="session")
def finished_tiny(_tiny, all_steps):
    """The tiny campaign with all its results; read only."""
    return all_steps("finished", _tiny)


@pytest.fixture(scope="session")
def run_by_snakemake(_tiny, made_once):
    """The tiny campaign run by `snakemake` itself, one process per step, each image in two jobs; read only."""
    from folders import copy_writable, finished, snakemake

    def run(root):
        code, output = finished(snakemake(copy_writable(_tiny, root), "all", "pages", "--set-scatter", "tiles=2"))
        assert code == 0, output

    return made_once("by_snakemake", run)


@pytest.fixture(scope="session")
def finished_sample(shared, all_steps, tmp_path_factory):
    """The independently generated campaign-sample with all its results; read only."""
    from folders import copy_writable, state

    campaign = copy_writable(shared / "campaign-sample", tmp_path_factory.mktemp("sample") / "campaign")
    state(campaign, "scene", atmosphere={"refractivity_n": 0.0})  # the generating model assumes vacuum
    return all_steps("sample", campaign)


def pytest_generate_tests(metafunc):
    """Run tests with `isa` on every instruction set of the compiled engine; only the default set is quick.

    Tests with `reader` run in this process; tests without rows also run with the reader in its own process (slow).
    """
    if "reader" in metafunc.fixturenames:
        has_rows = any(metafunc.definition.iter_markers("parametrize"))
        isolated = [] if has_rows else [pytest.param("isolated", marks=pytest.mark.slow)]
        metafunc.parametrize("reader", ["here", *isolated], indirect=True)
    if "isa" in metafunc.fixturenames:
        from apertura.core.backprojection.engines import native, native_binding

        selected = next(filter(native_binding.supports, native.INSTRUCTION_SETS), None)
        others = [pytest.param(isa, marks=pytest.mark.slow) for isa in native.INSTRUCTION_SETS if isa != selected]
        metafunc.parametrize("isa", [selected, *others] if selected else others, indirect=True)


@pytest.fixture
def isa(request, monkeypatch):
    """An instruction set that the compiled engine runs on."""
    from apertura.core.backprojection.engines import native_binding

    if not native_binding.supports(request.param):
        pytest.skip(f"this machine does not support {request.param}")
    monkeypatch.setenv("APERTURA_ISA", request.param)
    return request.param


@pytest.fixture
def toy(monkeypatch):
    """The engine of `toy_engine.py`, registered by one row of the engine table."""
    from apertura.core.backprojection.engines import ENGINES

    monkeypatch.setitem(ENGINES, "toy", "toy_engine")


@pytest.fixture
def reader(request, monkeypatch):
    """Run readers that may crash in this process (fast) or, if isolated, in a separate process as in a run."""
    if request.param == "here":
        from in_this_process import Processes

        from apertura.formats import isolated

        monkeypatch.setattr(isolated, "subprocess", Processes)
