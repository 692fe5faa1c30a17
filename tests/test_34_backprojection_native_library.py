"""The compiled library itself: instruction sets, layout of what is handed over, sanitizers."""

import os
import shutil
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
from scenes import without_library

from apertura.common.errors import CampaignError
from apertura.core.backprojection.engines import native, native_binding
from apertura.core.backprojection.engines.native_binding import KERNEL, TREE

pytestmark = pytest.mark.skipif(not native.available(), reason="apertura was installed without a compiler")


def test_an_unknown_instruction_set_is_refused(monkeypatch):
    monkeypatch.setenv("APERTURA_ISA", "sse9")
    with pytest.raises(ValueError, match="APERTURA_ISA: 'sse9'; expected one of avx512, avx2, portable"):
        native.instruction_set()


def test_without_the_compiled_library_the_engine_says_so(monkeypatch):
    without_library(monkeypatch)
    assert not native.available()
    with pytest.raises(RuntimeError, match="install a C\\+\\+ compiler"):
        native.instruction_set()


def test_python_predicts_with_the_constants_of_the_kernel():
    assert native_binding.kernel_constants() == pytest.approx(
        asdict(KERNEL) | {f"tree_{name}": value for name, value in asdict(TREE).items()}, rel=1e-6
    )


@pytest.mark.quick("int32_t*")
@pytest.mark.parametrize(
    ("was", "becomes", "named"),
    [
        ("pulses, padded, width, rows", "pulses, padded, rows, width", "ApertureJob.width"),
        ("int32_t wide_sum; ", "int64_t wide_sum; ", "ApertureJob.wide_sum"),
        ("double peak; ", "double peak, sum; ", "BeamJob"),
    ],
)
def test_a_library_of_another_layout_is_refused_by_the_name_of_the_field(was, becomes, named, tmp_path, monkeypatch):
    compiler = shutil.which("g++")
    if not compiler:
        pytest.skip("g++ is needed")
    shutil.copytree(Path(__file__).parents[1] / "native", tmp_path, dirs_exist_ok=True)
    job, contract = tmp_path / "job.hpp", tmp_path / "contract.cpp"
    assert was in job.read_text()
    job.write_text(job.read_text().replace(was, becomes))
    library = tmp_path / f"{named}.so"
    exports = 'extern "C" __attribute__((visibility("default"))) const char* apertura_isa(const char*) { return 0; }\n'
    contract.write_text(contract.read_text() + exports)
    subprocess.run([compiler, "-std=c++17", "-shared", "-fPIC", contract, "-o", library], check=True)
    monkeypatch.setenv("APERTURA_KERNEL", str(library))
    with pytest.raises(CampaignError, match=rf"{named}: .*; expected {named}: byte \d+, \d+ bytes") as refused:
        native.instruction_set()
    assert str(library) in str(refused.value)


def test_a_library_that_tells_no_layout_is_refused(tmp_path, monkeypatch):
    compiler = shutil.which("g++")
    if not compiler:
        pytest.skip("g++ is needed")
    library, source = tmp_path / "old.so", tmp_path / "old.cpp"
    source.write_text('extern "C" const char* apertura_form(const char* name) { return name; }\n')
    subprocess.run([compiler, "-shared", "-fPIC", source, "-o", library], check=True)
    monkeypatch.setenv("APERTURA_KERNEL", str(library))
    with pytest.raises(CampaignError, match=r"BeamJob\.axes: no such field; expected .* byte 0, 8 bytes"):
        native.instruction_set()


def test_no_environment_variable_means_the_best(monkeypatch):
    monkeypatch.delenv("APERTURA_ISA", raising=False)
    assert native.instruction_set() == next(filter(native_binding.supports, native.INSTRUCTION_SETS))
    assert "APERTURA_ISA" not in os.environ


@pytest.mark.slow
def test_the_kernel_is_clean_under_sanitizers(tmp_path):
    cmake, compiler = shutil.which("cmake"), shutil.which("g++")
    if not (cmake and compiler):
        pytest.skip("cmake and g++ are needed")
    root = Path(__file__).parents[1]
    subprocess.run([cmake, "-S", root, "-B", tmp_path, "-DAPERTURA_SANITIZE=ON"], check=True, capture_output=True)
    subprocess.run([cmake, "--build", tmp_path, "--parallel", "2"], check=True, capture_output=True)
    runtimes = [  # with the C++ one, or the sanitizer knows no throw of the libraries that Python loads later
        subprocess.run(
            [compiler, f"-print-file-name={name}"], check=True, capture_output=True, text=True
        ).stdout.strip()
        for name in ("libasan.so", "libstdc++.so")
    ]
    environment = {
        **os.environ,
        "APERTURA_KERNEL": str(tmp_path / "_backprojection.so"),
        "LD_PRELOAD": " ".join(runtimes),
        "ASAN_OPTIONS": "detect_leaks=0",  # Python's own
    }
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-m",
        "not slow",
        *(
            f"tests/test_34_backprojection_{name}.py"
            for name in ("native", "beams", "sector", "envelope", "contributions", "gradient", "tree")
        ),
    ]
    done = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
