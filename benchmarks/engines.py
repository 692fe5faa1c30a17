"""Run times of all engines on one job, measured in alternating rounds: `make bench`, or `python benchmarks/engines.py`.

Times are medians over rounds of the process's CPU time, because other load extends the wall-clock time; each round runs
all contestants, so that a slow period affects all of them. For two threads, the CPU time of the busier thread is
reported, which equals the wall-clock time of an idle machine. Tables are a separate row; fastsar compresses within its
call, so that its compression is timed separately and subtracted. Prints a table and updates its rows in
benchmarks/latest.json.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import importlib.util
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from job import CENTRE_HZ, SPACING_HZ, SUBCARRIERS, Job, build, error_db, spectra, turned
from latest import replace_rows

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.backprojection.engines import native, native_binding, numba
from apertura.core.echo.compression import compress, window_weights


@dataclass
class Contestant:
    """One row: the call, its result and its run times."""

    name: str
    geometry: str
    run: Callable[[], Any]
    job: Job | None = None
    clock: Callable[[], float] = time.process_time
    every: int = 1  # rounds per run; more than 1 for slow contestants
    isa: str = ""
    less: "Contestant | None" = None  # contestant whose time is subtracted
    exact: np.ndarray | None = None  # exact result, for results other than images
    seconds: list[float] = field(default_factory=list)
    image: Any = None

    def go(self) -> None:
        """Run once and record the time."""
        os.environ["APERTURA_ISA"] = self.isa
        begin = self.clock()
        self.image = self.run()
        self.seconds.append(self.clock() - begin)

    def median(self) -> float:
        """Return the median time in seconds, minus the median time of `less`."""
        return statistics.median(self.seconds) - (self.less.median() if self.less else 0.0)

    def error_db(self) -> float | None:
        """Return the RMS error of the result: at random pixels of an image, or of the whole array."""
        if self.exact is not None:
            return float(20 * np.log10(np.linalg.norm(self.image - self.exact) / np.linalg.norm(self.exact)))
        return None if self.job is None else error_db(self.job, self.image)


def native_contestants(jobs: dict[str, Job]) -> list[Contestant]:
    """Return the compiled engine in each instruction set and geometry."""
    flat = jobs["bistatic"]
    contestants = [
        Contestant(f"native {isa}", "bistatic", formation_call(flat), flat, isa=isa, every=1 + (isa == "portable"))
        for isa in filter(native_binding.supports, native.INSTRUCTION_SETS)
    ]
    fast, linear = contestants[0].isa, {"oversampling": 10, "degree": 1}
    contestants += [
        Contestant(f"native {fast}", name, formation_call(job), job, isa=fast)
        for name, job in jobs.items()
        if job is not flat
    ]
    contestants.append(
        Contestant(f"native {fast}, lines 10x", "bistatic", formation_call(flat, **linear), flat, isa=fast)
    )
    contestants.append(compression_contestant(flat))
    contestants.append(Contestant("tables", "bistatic", lambda: native.prepare(flat.profiles), isa=fast))
    pair = TwoThreads(flat)
    contestants.append(Contestant(f"native {fast}, two threads", "bistatic", pair, flat, pair.clock, isa=fast))
    return contestants


def compression_contestant(job: Job) -> Contestant:
    """Return the range compression of the job's transfer functions to the swath of its profiles."""
    profiles, number = job.profiles, np.arange(SUBCARRIERS) - SUBCARRIERS // 2
    frequency, count = CENTRE_HZ + SPACING_HZ * (number + 0.5), profiles.samples.shape[1]
    path = profiles.start_m[:, None] + profiles.step_m * np.arange(count)
    # The job's profiles are referenced to the exact band centre, half a subcarrier below f_mid.
    exact = profiles.samples * np.exp(-1j * np.pi * SPACING_HZ * path / SPEED_OF_LIGHT_M_S)
    history, options = spectra(job, np.zeros(len(path))), {"weight": window_weights("none", SUBCARRIERS)}
    options |= {"reference_delay_s": np.zeros(len(path)), "start_m": profiles.start_m, "count": count}
    return Contestant(
        "range compression", "bistatic", lambda: compress(history, frequency, **options), every=2, exact=exact
    )


def formation_call(job: Job, **options: int) -> Callable[[], Any]:
    """Return a call that forms the whole image from precomputed tables."""
    tables = native.prepare(job.profiles, **options)
    return lambda: native.form(tables, job.pixels)


class TwoThreads:
    """Formation of both image halves in two threads; its clock is the CPU time of the busier thread."""

    def __init__(self, job: Job) -> None:
        self.tables, self.tiles = native.prepare(job.profiles), np.array_split(job.pixels, 2)
        self.pool, self.spent = ThreadPoolExecutor(2), 0.0

    def half(self, tile: np.ndarray) -> tuple[np.ndarray, float]:
        begin = time.thread_time()
        image = native.form(self.tables, tile)
        return image, time.thread_time() - begin

    def __call__(self) -> np.ndarray:
        images, seconds = zip(*self.pool.map(self.half, self.tiles), strict=True)
        self.spent += max(seconds)
        return np.concatenate(images)

    def clock(self) -> float:
        return self.spent


def numba_contestant(job: Job) -> Contestant:
    """Return the numba engine, which interpolates profiles."""
    tables = numba.prepare(job.profiles)
    return Contestant("numba", "bistatic", lambda: numba.form(tables, job.pixels), job, every=4)


def fastsar_contestants(job: Job, mono: Job) -> list[Contestant]:
    """Return the bistatic backprojection of points and the exact monostatic image formation of fastsar."""
    import fastsar
    from fastsar import bp

    fmin_hz = CENTRE_HZ - SPACING_HZ * (SUBCARRIERS - 1) / 2
    tx, rx, mean, middle = centred(job)
    history, points = spectra(job, 2 * mean), job.pixels - middle
    points_less = Contestant("fastsar compression", "bistatic", compression(bp, history, 8), every=4)
    contestants = [points_less]

    def form_points() -> np.ndarray:
        options = {"rcv": rx, "ref": mean, "backend": "cpu", "window": False}
        return fastsar.backproject(history, tx, fmin_hz, SPACING_HZ, points, **options)

    contestants.append(Contestant("fastsar backproject", "bistatic", form_points, job, every=4, less=points_less))
    antenna, _, distance, origin = centred(mono)
    echoes, (rows, columns) = spectra(mono, 2 * distance), mono.pixels.shape[:2]
    centre = mono.pixels[rows // 2, columns // 2] - origin
    options = {"backend": "cpu", "window": False, "ref": distance, "center": centre}
    exact = fastsar.ExactFormer(antenna, fmin_hz, SPACING_HZ, SUBCARRIERS, columns, rows, 0.05, 0.05, **options)
    former_less = Contestant("fastsar compression", "monostatic", compression(bp, echoes, 8), every=4)
    cubic = Contestant("fastsar exact cubic", "monostatic", lambda: exact(echoes).T, mono, every=2, less=former_less)
    return [*contestants, former_less, cubic]


def centred(job: Job) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return antenna positions relative to the scene centre, their mean distance from the centre, and the centre."""
    middle = job.pixels.mean((0, 1))
    tx, rx = (leg - middle for leg in job.profiles.aperture.legs)
    return tx, rx, (np.linalg.norm(tx, axis=1) + np.linalg.norm(rx, axis=1)) / 2, middle


def compression(bp: Any, history: np.ndarray, upsample: int) -> Callable[[], None]:
    """Return a call of fastsar's range compression with its chunk size."""
    length = upsample * history.shape[1]

    def run() -> None:
        for first in range(0, len(history), 256):
            bp.range_compress(history[first : first + 256], length)

    return run


def rows(contestants: list[Contestant]) -> list[dict[str, object]]:
    """Return the results, one dict per contestant."""
    best = contestants[0].median()
    table = []
    for one in contestants:
        seconds = one.median()
        cores = 2 if isinstance(one.run, TwoThreads) else 1
        work = None if one.job is None else one.job.pixels[..., 0].size * len(one.job.profiles.samples) / cores
        table.append(
            {
                "name": one.name,
                "geometry": one.geometry,
                "seconds": round(seconds, 4),
                "pixel_pulses_per_s_per_core": None if work is None else float(f"{work / seconds:.3g}"),
                "error_db": None if (error := one.error_db()) is None else round(error, 1),
                "ratio_to_native": round(seconds / best, 3),
                "rounds": len(one.seconds),
            }
        )
    return table


def main() -> None:
    """Run all contestants alternately, print and save the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--pulses", type=int, default=1024)
    options = parser.parse_args()
    flat = build(options.size, options.pulses)
    mono = build(options.size, options.pulses, bistatic=False)
    jobs = {"bistatic": flat, "monostatic": mono, "bistatic, turned 30°": turned(flat, 30)}
    for name, surface in (("bistatic, DEM", "natural"), ("bistatic, harsh DEM", "harsh")):
        jobs[name] = build(options.size, options.pulses, surface=surface)
    contestants = native_contestants(jobs)
    contestants.append(numba_contestant(flat))
    if importlib.util.find_spec("fastsar"):
        contestants += fastsar_contestants(flat, mono)
    for round_number in range(options.rounds):
        for one in contestants:
            if round_number % one.every == 0:
                one.go()
    # The first run of each contestant is a warm-up.
    table = rows([replace(one, seconds=one.seconds[min(1, len(one.seconds) - 1) :]) for one in contestants])
    for row in table:
        rate, error = row["pixel_pulses_per_s_per_core"], row["error_db"]
        line = (
            f"{row['name']:<28}{row['geometry']:<22}{1e3 * row['seconds']:>10.1f} ms{row['ratio_to_native']:>10.2f} x"
        )
        line += " " * 17 if rate is None else f"{rate:>12.3g} pp/s"
        print(line + ("" if error is None else f"{error:>8.1f} dB"))
    replace_rows(table, lambda row: "group" not in row)


if __name__ == "__main__":
    main()
