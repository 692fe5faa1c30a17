"""Importing apertura is cheap, and its public names come from where they are defined."""

import ctypes
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import apertura
from apertura.common.provenance import code_sha256

HEAVY = {"dask", "matplotlib", "numba", "numpy", "pandas", "pydantic", "pyproj", "rasterio", "scipy", "xarray", "zarr"}


def loaded_by(statement):
    listing = "import json, sys; print(json.dumps(sorted({name.split('.')[0] for name in sys.modules})))"
    output = subprocess.run(
        [sys.executable, "-c", f"{statement}\n{listing}"], capture_output=True, text=True, check=True
    ).stdout
    return set(json.loads(output.splitlines()[-1]))


def test_importing_apertura_loads_no_library():
    assert loaded_by("import apertura") - loaded_by("pass") - sys.stdlib_module_names == {"apertura"}


def test_the_command_line_loads_no_library_of_a_step():
    assert not HEAVY & loaded_by("import apertura.views.cli")
    assert "typer" in loaded_by("import apertura.views.cli")


def test_reading_a_config_loads_no_arrays():
    assert not (HEAVY - {"pydantic"}) & loaded_by("import apertura.pipeline.campaign")


_ARRAYS = """
import resource, threading
def arrays():
    for _ in range(50):
        [bytearray(1 << 20) for _ in range(8)]
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
worker = threading.Thread(target=arrays)
worker.start()
worker.join()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="not the C library of GNU")
def test_a_command_fills_the_memory_of_arrays_again_and_takes_no_other():
    """Else the kernel clears the 2048 pages of 8 MB each time: a fault each."""
    command = "import sys\nfrom apertura.__main__ import main\nsys.argv[1:] = ['--version']"
    run = f"{command}\ntry:\n    main()\nexcept SystemExit:\n    pass"
    faults = []
    for begun in ("pass", run):
        ended = subprocess.run([sys.executable, "-c", begun + _ARRAYS], capture_output=True, text=True, check=True)
        faults.append(int(ended.stdout.splitlines()[-1]))
    assert faults[0] > 25 * 2048
    assert faults[1] < 3 * 2048


def test_every_public_name_is_documented_and_listed():
    for name in apertura.__all__:
        assert getattr(apertura, name).__doc__, name
        assert getattr(apertura, name) is vars(apertura)[name]
    assert {name for name in dir(apertura) if not name.startswith("_")} <= set(apertura.__all__)
    assert set(apertura.__all__) <= set(dir(apertura))


def test_a_name_that_is_not_public_is_an_attribute_error():
    with pytest.raises(AttributeError, match="'backprojekt'"):
        _ = apertura.backprojekt


def test_the_public_names_are_no_code_of_a_stage():
    """Stages import the version from there; that must not tie their hash to every module that is public."""
    assert code_sha256("apertura") == code_sha256()
    assert code_sha256("apertura.common.contracts") != code_sha256()


def test_the_version_is_printed_and_is_what_the_build_reads():
    source = Path(apertura.__file__).read_text(encoding="utf-8")
    assert re.search(r'^__version__ = "(.+)"$', source, re.MULTILINE)[1] == apertura.__version__
    for words in (["--version"],):
        command = [sys.executable, "-c", "from apertura.views.cli import main; main()", *words]
        printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert printed == f"{apertura.__version__}\n"
