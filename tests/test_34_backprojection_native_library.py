"""Compiled library: instruction sets, memory layout of the arguments, sanitizers."""

import os
import platform
import re
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


@pytest.mark.skipif(platform.machine() != "x86_64", reason="other processors have one instruction set")
def test_instruction_sets_are_those_that_the_kernel_of_linux_reports():
    """Linux lists the sets of the processor whose registers it saves."""
    flags = set(re.search(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.M)[1].split())
    avx2 = {"avx2", "fma"}
    needs = {"avx512": avx2 | {"avx512f", "avx512dq", "avx512bw", "avx512vl"}, "avx2": avx2, "portable": set()}
    for isa in native.INSTRUCTION_SETS:
        assert native_binding.supports(isa) == (needs[isa] <= flags), isa


def test_missing_library_is_reported_with_a_remedy(monkeypatch):
    without_library(monkeypatch)
    assert not native.available()
    with pytest.raises(RuntimeError, match="install a C\\+\\+ compiler"):
        native.instruction_set()


def test_python_uses_the_constants_of_the_kernel():
    assert native_binding.kernel_constants() == pytest.approx(
        asdict(KERNEL) | {f"tree_{name}": value for name, value in asdict(TREE).items()}, rel=1e-6
    )


@pytest.mark.quick("int32_t*")
@pytest.mark.parametrize(
    ("declaration", "changed", "field"),
    [
        ("pulses, padded, width, rows", "pulses, padded, rows, width", "ApertureJob.width"),
        ("int32_t wide_sum; ", "int64_t wide_sum; ", "ApertureJob.wide_sum"),
        ("double peak; ", "double peak, sum; ", "BeamJob"),
    ],
)
def test_library_of_another_layout_is_refused_with_the_field_name(declaration, changed, field, tmp_path, monkeypatch):
    compiler = shutil.which("g++")
    if not compiler:
        pytest.skip("g++ is needed")
    shutil.copytree(Path(__file__).parents[1] / "native", tmp_path, dirs_exist_ok=True)
    job, contract = tmp_path / "job.hpp", tmp_path / "contract.cpp"
    assert declaration in job.read_text()
    job.write_text(job.read_text().replace(declaration, changed))
    library = tmp_path / f"{field}.so"
    exports = 'extern "C" __attribute__((visibility("default"))) const char* apertura_isa(const char*) { return 0; }\n'
    contract.write_text(contract.read_text() + exports)
    subprocess.run([compiler, "-std=c++17", "-shared", "-fPIC", contract, "-o", library], check=True)
    monkeypatch.setenv("APERTURA_KERNEL", str(library))
    with pytest.raises(CampaignError, match=rf"{field}: .*; expected {field}: byte \d+, \d+ bytes") as refused:
        native.instruction_set()
    assert str(library) in str(refused.value)


def test_library_without_layout_table_is_refused(tmp_path, monkeypatch):
    compiler = shutil.which("g++")
    if not compiler:
        pytest.skip("g++ is needed")
    library, source = tmp_path / "old.so", tmp_path / "old.cpp"
    source.write_text('extern "C" const char* apertura_form(const char* name) { return name; }\n')
    subprocess.run([compiler, "-shared", "-fPIC", source, "-o", library], check=True)
    monkeypatch.setenv("APERTURA_KERNEL", str(library))
    with pytest.raises(CampaignError, match=r"BeamJob\.axes: no such field; expected .* byte 0, 8 bytes"):
        native.instruction_set()


def test_default_is_the_best_instruction_set(monkeypatch):
    monkeypatch.delenv("APERTURA_ISA", raising=False)
    assert native.instruction_set() == next(filter(native_binding.supports, native.INSTRUCTION_SETS))
    assert "APERTURA_ISA" not in os.environ


@pytest.mark.slow
def test_kernel_passes_under_sanitizers(tmp_path):
    cmake, compiler = shutil.which("cmake"), shutil.which("g++")
    if not (cmake and compiler):
        pytest.skip("cmake and g++ are needed")
    root = Path(__file__).parents[1]
    subprocess.run([cmake, "-S", root, "-B", tmp_path, "-DAPERTURA_SANITIZE=ON"], check=True, capture_output=True)
    subprocess.run([cmake, "--build", tmp_path, "--parallel", "2"], check=True, capture_output=True)
    runtimes = [  # with libstdc++; otherwise, the sanitizer misses exceptions of libraries that Python loads later
        subprocess.run(
            [compiler, f"-print-file-name={name}"], check=True, capture_output=True, text=True
        ).stdout.strip()
        for name in ("libasan.so", "libstdc++.so")
    ]
    environment = {
        **os.environ,
        "APERTURA_KERNEL": str(tmp_path / "_backprojection.so"),
        "LD_PRELOAD": " ".join(runtimes),
        "ASAN_OPTIONS": "detect_leaks=0",  # ignores leaks of Python
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
    run = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]
