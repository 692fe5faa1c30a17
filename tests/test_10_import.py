"""Importing apertura loads few modules, and its public names are resolved from their defining modules."""

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


def test_command_line_loads_no_library_of_a_step():
    assert not HEAVY & loaded_by("import apertura.cli")
    assert "typer" in loaded_by("import apertura.cli")


def test_reading_a_config_loads_no_arrays():
    assert not (HEAVY - {"pydantic"}) & loaded_by("import apertura.campaign.folder")


@pytest.mark.slow
def test_step_over_level_terrain_loads_no_compiler_or_transforms():
    """Importing either library takes a tenth of a second per job."""
    heavy = {"numba", "scipy.fft", "scipy.ndimage", "scipy.special"}
    loaded_by(f"import sys, apertura.stages.layers\nassert not {heavy} & set(sys.modules)")


def test_every_public_name_is_documented_and_listed():
    for name in apertura.__all__:
        assert getattr(apertura, name).__doc__, name
        assert getattr(apertura, name) is vars(apertura)[name]
    assert {name for name in dir(apertura) if not name.startswith("_")} <= set(apertura.__all__)
    assert set(apertura.__all__) <= set(dir(apertura))


def test_unknown_public_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="'backprojekt'"):
        _ = apertura.backprojekt


def test_public_names_do_not_enter_the_code_hash_of_a_stage():
    """Stages import the version from the package; their hash must nevertheless not depend on every public module."""
    assert code_sha256("apertura") == code_sha256()
    assert code_sha256("apertura.common.contracts") != code_sha256()


def test_printed_version_matches_the_package():
    source = Path(apertura.__file__).read_text(encoding="utf-8")
    assert re.search(r'^__version__ = "(.+)"$', source, re.MULTILINE)[1] == apertura.__version__
    for words in (["--version"],):
        command = [sys.executable, "-c", "from apertura.cli import main; main()", *words]
        printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert printed == f"{apertura.__version__}\n"
