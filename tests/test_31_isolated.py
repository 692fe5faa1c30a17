"""Isolated readers: a crash, hang or memory exhaustion ends only the reader's process."""

import gc
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from folders import ROOT, complaint
from scipy.io import savemat

from apertura.common.lazy import Lazy
from apertura.formats.isolated import UnreadableError, read_isolated
from apertura.formats.phase_histories import mat_fields
from apertura.formats.reading import read_phase_history

PULSES, LINES = 6, 5


def history(path, **changes):
    """Write a small Gotcha structure; a field that is None is omitted."""
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


def test_arrays_are_returned_from_the_process_unchanged(tmp_path):
    others = np.exp(-1j * np.arange(1, 1 + PULSES * LINES).reshape(LINES, PULSES))
    echo = read(history(tmp_path / "b.mat", fp=others, z=np.full(PULSES, 7001.0)), history(tmp_path / "a.mat"))
    assert echo.transfer.shape == (2 * PULSES, LINES)
    np.testing.assert_array_equal(echo.tx_position.values[[0, -1], 2], [7000.0, 7001.0])  # in order of file names
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
def test_invalid_field_is_named(tmp_path, changes, expected):
    path = history(tmp_path / "a.mat", **changes)
    message = complaint(lambda: read(path))
    assert message.startswith(str(path))
    assert expected in message


@pytest.mark.usefixtures("reader")
def test_second_file_at_other_frequencies_is_named(tmp_path):
    shifted = np.linspace(9.4e9, 10.0e9, LINES)
    paths = history(tmp_path / "a.mat"), history(tmp_path / "b.mat", freq=shifted)
    assert complaint(lambda: read(*paths)).startswith(f"{paths[1]}: frequencies differ from those of the first file")


@pytest.mark.usefixtures("reader")
def test_matlab_file_without_the_structure_is_rejected(tmp_path):
    savemat(tmp_path / "a.mat", {"other": 1.0})
    assert "no structure data" in complaint(lambda: read(tmp_path / "a.mat"))
    (tmp_path / "b.mat").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(600))
    assert "not readable" in complaint(lambda: read(tmp_path / "b.mat"))


def test_crash_of_a_reader_is_one_message_with_the_signal(tmp_path, monkeypatch):
    (tmp_path / "broken.py").write_text("import ctypes\n\ndef read(path):\n    ctypes.string_at(0)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "a.mat").write_bytes(b"x")
    with pytest.raises(UnreadableError, match="its reader was terminated by SIGSEGV") as caught:
        read_isolated(Lazy("broken").read, [tmp_path / "a.mat"])
    assert caught.value.path == tmp_path / "a.mat"


@pytest.mark.slow
def test_matlab_file_that_crashes_scipy_is_rejected(tmp_path):
    """The file was found by the fuzzer; versions of scipy that do not crash report an error or invalid fields."""
    for path in sorted((ROOT / "tests/attack/regressions/afrl.mat").glob("segv-*")):
        (tmp_path / "a.mat").write_bytes(path.read_bytes())
        assert complaint(lambda: read(tmp_path / "a.mat")).startswith(f"{tmp_path / 'a.mat'}: ")


@pytest.mark.slow
def test_reader_that_hangs_is_stopped(tmp_path):
    os.mkfifo(tmp_path / "a.mat")
    start_s = time.monotonic()
    with pytest.raises(UnreadableError, match="exceeded the time limit of 1 s"):
        read_isolated(Lazy("builtins").open, [tmp_path / "a.mat"], seconds=1.0)
    assert time.monotonic() - start_s < 3


def test_reader_that_exceeds_the_memory_limit_is_stopped(tmp_path):
    (tmp_path / "a.mat").touch()
    os.truncate(tmp_path / "a.mat", 3 << 30)
    with pytest.raises(UnreadableError, match="its reader ran out of memory"):
        read_isolated(Lazy("numpy").fromfile, [tmp_path / "a.mat"], memory_bytes=1 << 30)


@pytest.mark.slow
def test_arrays_of_many_files_may_exceed_the_memory_limit_of_one(tmp_path, monkeypatch):
    (tmp_path / "large.py").write_text("import numpy\n\ndef read(path):\n    return {'a': numpy.ones(20_000_000)}\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    paths = [tmp_path / name for name in "abcd"]
    for path in paths:
        path.touch()
    files = read_isolated(Lazy("large").read, paths, memory_bytes=1 << 29)
    assert [fields["a"][-1] for fields in files] == [1.0] * 4


@pytest.mark.usefixtures("reader")
def test_arrays_of_all_files_are_one_mapping(tmp_path):
    """A flight may have more files than a process may hold open."""
    paths = [history(tmp_path / f"{name}.mat") for name in "abcdef"]
    gc.collect()  # arrays of other tests
    before = sum(1 for _ in Path("/proc/self/fd").iterdir())
    files = read_isolated(mat_fields.read_fields, paths)
    assert sum(1 for _ in Path("/proc/self/fd").iterdir()) == before + 1
    for fields in files:
        np.testing.assert_allclose(fields["z"].ravel(), np.full(PULSES, 7000.0))
        np.testing.assert_allclose(fields["fp"][:, 1], np.exp(1j * (1 + PULSES * np.arange(LINES))))
        assert not fields["fp"].flags.writeable


@pytest.mark.usefixtures("reader")
def test_unreadable_file_among_several_is_named(tmp_path):
    paths = [history(tmp_path / f"{name}.mat") for name in "abc"]
    paths[1].write_bytes(paths[1].read_bytes()[:300])
    assert complaint(lambda: read(*paths)).startswith(str(paths[1]))


@pytest.mark.slow
def test_modules_in_the_campaign_are_not_imported(tmp_path, monkeypatch):
    for name in ("numpy", "scipy", "json", "apertura"):
        (tmp_path / f"{name}.py").write_text("import pathlib\npathlib.Path('marker').touch()\n")
    path = history(tmp_path / "a.mat")
    monkeypatch.chdir(tmp_path)
    assert read(path).sizes["pulse"] == PULSES
    assert not (tmp_path / "marker").exists()


def test_reader_process_imports_no_heavy_libraries():
    """The imports would add half a second to a step."""
    code = "import sys, apertura.formats.isolated, scipy.io"
    code += "\nimport apertura.formats.phase_histories.mat_fields; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-P", "-c", code], check=True, capture_output=True, text=True).stdout
    assert {"pandas", "xarray", "dask", "numba", "rasterio", "pydantic"}.isdisjoint(loaded.split())
