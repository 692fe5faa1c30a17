"""A reader that crashes, hangs or eats memory takes its own process with it and nothing else."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest
from folders import ROOT, complaint
from scipy.io import savemat

from apertura.common.lazy import Lazy
from apertura.formats.isolated import UnreadableError, read_isolated
from apertura.formats.reading import read_phase_history

PULSES, LINES = 6, 5


def history(path, **changes):
    """Write a small Gotcha structure; a field that is None is left out."""
    angle = np.linspace(0, 0.1, PULSES)
    fields = {
        "fp": np.exp(1j * np.arange(PULSES * LINES).reshape(LINES, PULSES)),
        "freq": np.linspace(9.3e9, 9.9e9, LINES),
        "x": 7000 * np.cos(angle),
        "y": 7000 * np.sin(angle),
        "z": np.full(PULSES, 7000.0),
        "r0": np.full(PULSES, 9899.5),
        **changes,
    }
    savemat(path, {"data": {name: value for name, value in fields.items() if value is not None}})
    return path


def read(*paths):
    return read_phase_history("afrl_mat", paths, pair="a-a")


def test_arrays_come_back_from_the_process_as_they_were(tmp_path):
    echo = read(history(tmp_path / "b.mat", z=np.full(PULSES, 7001.0)), history(tmp_path / "a.mat"))
    assert echo.transfer.shape == (2 * PULSES, LINES)
    np.testing.assert_array_equal(echo.tx_position.values[[0, -1], 2], [7000.0, 7001.0])  # in the order of names
    np.testing.assert_allclose(echo.transfer.values[1], np.exp(1j * (1 + PULSES * np.arange(LINES))), atol=1e-6)


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"fp": "text"}, "field data.fp is <U"),
        ({"x": "text"}, "field data.x is <U"),
        ({"z": np.zeros(0)}, "field data.z is float64 of shape"),
        ({"fp": np.zeros((0, 0))}, "field data.fp"),
        ({"r0": None}, "no field data.r0"),
        ({"y": np.zeros(PULSES + 1)}, "y 7"),
        ({"freq": np.full(LINES, 9e9)}, "do not increase in equal steps"),
        ({"freq": np.linspace(-9e9, -8e9, LINES)}, "do not increase in equal steps"),
        ({"x": np.full(PULSES, 1e300)}, "x reaches 1e+300"),
        ({"fp": np.full((LINES, PULSES), 1e200)}, "fp is not a number"),
        ({"freq": {"a": 1.0}}, "field data.freq is object"),
    ],
)
def test_a_field_that_is_not_what_it_should_be_is_named(tmp_path, changes, expected):
    path = history(tmp_path / "a.mat", **changes)
    message = complaint(lambda: read(path))
    assert message.startswith(str(path))
    assert expected in message


@pytest.mark.usefixtures("reader")
def test_a_second_file_at_other_frequencies_is_named(tmp_path):
    shifted = np.linspace(9.4e9, 10.0e9, LINES)
    paths = history(tmp_path / "a.mat"), history(tmp_path / "b.mat", freq=shifted)
    assert complaint(lambda: read(*paths)).startswith(f"{paths[1]}: frequencies differ from those of the first file")


@pytest.mark.usefixtures("reader")
def test_a_matlab_file_without_the_structure_is_refused(tmp_path):
    savemat(tmp_path / "a.mat", {"other": 1.0})
    assert "no structure data" in complaint(lambda: read(tmp_path / "a.mat"))
    (tmp_path / "b.mat").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(600))
    assert "not readable" in complaint(lambda: read(tmp_path / "b.mat"))


def test_a_reader_that_crashes_is_one_message_that_names_the_signal(tmp_path, monkeypatch):
    (tmp_path / "broken.py").write_text("import ctypes\n\ndef read(path):\n    ctypes.string_at(0)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "a.mat").write_bytes(b"x")
    with pytest.raises(UnreadableError, match="its reader was terminated by SIGSEGV") as caught:
        read_isolated(Lazy("broken").read, [tmp_path / "a.mat"])
    assert caught.value.path == tmp_path / "a.mat"


@pytest.mark.slow
def test_a_matlab_file_that_crashes_scipy_is_refused(tmp_path):
    """Found by the fuzzer; where scipy no longer dies of it, it says what is wrong, or the fields do."""
    for path in sorted((ROOT / "tests/attack/regressions/afrl.mat").glob("segv-*")):
        (tmp_path / "a.mat").write_bytes(path.read_bytes())
        assert complaint(lambda: read(tmp_path / "a.mat")).startswith(f"{tmp_path / 'a.mat'}: ")


def test_a_reader_that_never_ends_is_stopped(tmp_path):
    os.mkfifo(tmp_path / "a.mat")
    begun = time.monotonic()
    with pytest.raises(UnreadableError, match="exceeded the time limit of 1 s"):
        read_isolated(Lazy("builtins").open, [tmp_path / "a.mat"], seconds=1.0)
    assert time.monotonic() - begun < 3


def test_a_reader_that_asks_for_too_much_memory_is_refused(tmp_path):
    (tmp_path / "a.mat").touch()
    os.truncate(tmp_path / "a.mat", 3 << 30)
    with pytest.raises(UnreadableError, match="its reader ran out of memory"):
        read_isolated(Lazy("numpy").fromfile, [tmp_path / "a.mat"], memory_bytes=1 << 30)


@pytest.mark.usefixtures("reader")
def test_the_file_at_which_a_pass_ends_is_the_one_that_is_named(tmp_path):
    paths = [history(tmp_path / f"{name}.mat") for name in "abc"]
    paths[1].write_bytes(paths[1].read_bytes()[:300])
    assert complaint(lambda: read(*paths)).startswith(str(paths[1]))


@pytest.mark.slow
def test_a_module_that_lies_in_the_campaign_is_not_imported(tmp_path, monkeypatch):
    for name in ("numpy", "scipy", "json", "apertura"):
        (tmp_path / f"{name}.py").write_text("import pathlib\npathlib.Path('marker').touch()\n")
    path = history(tmp_path / "a.mat")
    monkeypatch.chdir(tmp_path)
    assert read(path).sizes["pulse"] == PULSES
    assert not (tmp_path / "marker").exists()


def test_the_process_imports_numpy_and_scipy_and_nothing_heavier():
    """Half a second of a step is spent here."""
    code = "import sys, apertura.formats.isolated, scipy.io"
    code += "\nimport apertura.formats.phase_histories.mat_fields; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-P", "-c", code], check=True, capture_output=True, text=True).stdout
    assert {"pandas", "xarray", "dask", "numba", "rasterio", "pydantic"}.isdisjoint(loaded.split())
