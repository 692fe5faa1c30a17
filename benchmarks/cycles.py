"""Processor cycles of the compiled engine per pixel and pulse, compared with other builds and with another kernel.

Jobs are bistatic with flat terrain, on one core; the contestants run alternately. `--other PATH` is a shared library
with a function `bp_perm2` that takes the same tables (pulse, coefficient, cell), float32, phase centres (3, pulse), a
plane grid and a polynomial of the carrier phase in (1, u, u², …), alternately cosine and sine. Its input consists of
the tables of the engine, computed from profiles that all start at the same path. Image sides must be multiples of 16
pixels, pulses of 8. `--kernel PATH` is another build of the engine; repeat the option for more. The clock frequency is
measured between runs by a chain of dependent multiplications and additions, with a latency of 3 + 1 cycles on x86 cores
of the last ten years. Times are medians of the process's CPU time.

    python benchmarks/cycles.py --other build/kern3.so --kernel build/before.so
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import argparse
import ctypes
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numba as nb
import numpy as np
from job import CENTRE_HZ, Job, build, echoes, error_db

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.backprojection.engines import native, native_binding
from apertura.core.backprojection.engines.range_interpolation import Tables

STEPS, CYCLES_PER_STEP = 2_000_000, 4


@nb.njit
def chain(steps: int, x: int) -> int:
    """Return the last of `steps` dependent numbers; each is a square, so that no compiler merges two steps."""
    for _ in range(steps):
        x = x * x + 1442695040888963407
    return x


def hertz() -> float:
    """Measure the current clock frequency, cycles per second of CPU time."""
    begin = time.process_time()
    chain(STEPS, os.getpid())
    return STEPS * CYCLES_PER_STEP / (time.process_time() - begin)


def of_one_start(job: Job) -> Job:
    """Return the job with all profiles starting at their smallest start path."""
    profiles = job.profiles
    start, step = profiles.start_m.min(), profiles.step_m
    length = profiles.samples.shape[1] + int(np.ceil((profiles.start_m.max() - start) / step))
    starts = np.full(len(profiles.samples), start)
    legs = profiles.aperture.legs
    samples = echoes(*legs, job.scatterers, job.amplitude, starts[:, None] + step * np.arange(length))
    return replace(job, profiles=replace(profiles, samples=samples, start_m=starts))


def engine(job: Job, tables: Tables, kernel: str, isa: str) -> Callable[[], np.ndarray]:
    """Return a call of the engine; `kernel` is "" for the installed build."""

    def run() -> np.ndarray:
        os.environ["APERTURA_ISA"] = isa
        os.environ["APERTURA_KERNEL"] = kernel
        return native.form(tables, job.pixels)

    return run


def fits(path: Path) -> bool:
    """Return True if a build of the engine has the interface of the installed one; otherwise, print the reason."""
    os.environ["APERTURA_KERNEL"] = str(path.resolve())
    try:
        native_binding.library()
    except (CampaignError, RuntimeError, OSError) as reason:
        print(f"{path.name} skipped: {reason}")
        return False
    return True


def other(path: Path, job: Job, tables: Tables) -> Callable[[], np.ndarray]:
    """Return a call of `bp_perm2` of another library; the x axis of that function is along the rows of the image."""
    function = ctypes.CDLL(str(path)).bp_perm2
    function.restype = None
    pulses, _, width = tables.cells.shape
    corner, side = job.pixels[0, 0], len(job.pixels)
    c, s = tables.phase_coefficients[:4], tables.phase_coefficients[4:8]
    phase = np.array([c[0], s[0], c[1], s[1], c[2], s[2], c[3]], np.float32)
    # The function uses half of the total path, so that its cells are half as long.
    per_metre, shift = 2 / tables.cell_m, -tables.first_path_m[0] / tables.cell_m
    real, whole, wide = ctypes.c_double, ctypes.c_int, ctypes.c_long

    def at(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    def run() -> np.ndarray:
        parts = np.zeros((2, side, side), np.float32)
        function(
            at(tables.cells), wide(width), whole(pulses), at(tables.transmitter_m), at(tables.receiver_m),
            real(corner[2]), real(corner[0]), real(corner[1]), real(job.pixels[0, 1, 0] - corner[0]),
            whole(side), whole(side), real(per_metre), real(shift), at(phase), at(parts[0]), at(parts[1]), whole(64),
        )  # fmt: skip
        return (parts[0] + 1j * parts[1]).T.astype(np.complex64)

    return run


def compare(size: int, options: argparse.Namespace) -> None:
    """Print one row per contestant for an image of size × size."""
    os.environ["APERTURA_KERNEL"] = ""  # the installed build computes the tables
    job = of_one_start(build(size, options.pulses))
    tables = native.prepare(job.profiles, oversampling=options.oversampling)
    contestants = {"native": engine(job, tables, "", options.isa)}
    contestants |= {
        f"native of {path.name}": engine(job, tables, str(path.resolve()), options.isa) for path in options.kernel
    }
    if options.other is not None:
        contestants[options.other.name] = other(options.other, job, tables)
    spent: dict[str, list[float]] = {name: [] for name in contestants}
    images, frequency = {}, []
    for _ in range(options.rounds):
        for name, run in contestants.items():
            begin = time.process_time()
            images[name] = run()
            spent[name].append(time.process_time() - begin)
            frequency.append(hertz())
    clock, work = statistics.median(frequency[1:]), size * size * options.pulses
    phase_rad = 2 * np.pi * CENTRE_HZ / SPEED_OF_LIGHT_M_S * tables.cell_m
    print(
        f"{size}² × {options.pulses}, {options.oversampling} cells of {phase_rad:.2f} rad per c/B, "
        f"{clock / 1e9:.2f} GHz"
    )
    first = statistics.median(spent["native"][1:])
    for name, seconds in spent.items():
        median = statistics.median(seconds[1:])
        row = f"{name:<24}{1e3 * median:>9.1f} ms (minimum {1e3 * min(seconds[1:]):.1f}){work / median:>10.3g} pp/s"
        row += f"{median * clock / work:>8.3f} cycles/pp{error_db(job, images[name]):>8.1f} dB"
        print(f"{row}   time relative to native {median / first:.3f}")


def main() -> None:
    """Compare the contestants on each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--other", type=Path, help="shared library with bp_perm2")
    parser.add_argument("--kernel", type=Path, action="append", default=[], help="another build of the engine")
    parser.add_argument("--isa", default=native_binding.instruction_set(), choices=native_binding.INSTRUCTION_SETS)
    parser.add_argument("--sizes", type=int, nargs="+", default=[512, 1024])
    parser.add_argument("--pulses", type=int, default=1024)
    parser.add_argument("--oversampling", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=16)
    options = parser.parse_args()
    if any(size % 16 for size in options.sizes) or options.pulses % 8:
        parser.error("sizes must be multiples of 16, pulses of 8")
    if options.other is None:
        print("no other kernel is compared (option --other)")
    options.kernel = [path for path in options.kernel if fits(path)]
    chain(1, 1)
    for size in options.sizes:
        compare(size, options)


if __name__ == "__main__":
    main()
