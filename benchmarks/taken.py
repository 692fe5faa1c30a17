"""Quality of the planner's choice between engine native and engine tree: `python benchmarks/taken.py`.

Images of 256² to 1024² pixels, 256 to 8192 pulses, smooth tracks and tracks with white noise, for -40, -60 and -80 dB:
the cheapest setting of each engine, with the minimum of three CPU times of one thread for tables and sums, measured
alternately. The error is that of the tree's image relative to a more accurate image of engine native, over all pixels.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from job import Job, build
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.backprojection.engines import native, tree
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.job import Job as PlannedJob
from apertura.core.backprojection.job import Signal
from apertura.core.geometry.aperture import Aperture
from apertura.core.planning.planner import MARGIN_DB

AIMS_DB = (-40.0, -60.0, -80.0)
SLOWER = 1.05
"""Tolerated ratio of the times of tree and native if the tree is chosen."""


class Case(NamedTuple):
    """Parameters of an image, with white noise on its tracks."""

    size: int
    pulses: int
    jitter_m: float = 0.0
    bistatic: bool = True


CASES = (
    Case(256, 1024), Case(256, 8192), Case(512, 512), Case(512, 1024, bistatic=False), Case(512, 2048, 1e-4),
    Case(512, 2048, 1e-3), Case(1024, 256), Case(1024, 1024), Case(1024, 2048, 3e-4), Case(1024, 2048, 3e-3),
    Case(768, 1536, bistatic=False), Case(1024, 4096),
)  # fmt: skip


def main() -> None:
    """Measure and print the cases, and the number of chosen trees that are slower than native."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="*", type=int, help="sizes of images (default: all)")
    options = parser.parse_args()
    print("pixels × pulses, track noise | accuracy dB | chosen | tree s | native s | ratio | tree error, predicted dB")
    ratios: list[float] = []
    for case in CASES:
        if not options.sizes or case.size in options.sizes:
            ratios += measured(case)
    slow = sum(ratio > SLOWER for ratio in ratios)
    print(
        f"load {os.getloadavg()[0]:.1f}; the tree was chosen {len(ratios)} times, in {slow} cases more than 5 % slower "
        "than native"
    )


def measured(case: Case) -> Iterator[float]:
    """Print the rows of a case; yield the ratio of the times of tree and native where the tree is chosen."""
    job = _with_track_noise(build(case.size, case.pulses, bistatic=case.bistatic), case)
    planned = _planned(job)
    exact = native.form(native.prepare(job.profiles, oversampling=16), job.pixels, tolerance_rad=5e-5)
    for aim_db in AIMS_DB:
        settings = [_cheapest(engine, planned, case.pulses, aim_db - MARGIN_DB) for engine in (tree, native)]
        seconds, image = [np.inf, np.inf], exact
        for _ in range(3):
            for number, (engine, setting) in enumerate(zip((tree, native), settings, strict=True)):
                begin = time.process_time()
                formed = engine.form(
                    engine.prepare(job.profiles, **setting.options), job.pixels, **setting.form_options
                )
                seconds[number] = min(seconds[number], time.process_time() - begin)
                image = formed if engine is tree else image
        chosen = min(settings, key=lambda setting: setting.seconds + setting.table_seconds).engine
        error_db = 10 * np.log10((np.abs(image - exact) ** 2).sum() / (np.abs(exact) ** 2).sum())
        name = f"{case.size}² × {case.pulses}{'' if case.bistatic else ' mono'}, {1e3 * case.jitter_m:.1f} mm"
        times = f"{seconds[0]:.3f} | {seconds[1]:.3f} | {seconds[1] / seconds[0]:.2f}"
        print(f"{name} | {aim_db:.0f} | {chosen} | {times} | {error_db:.1f}, {settings[0].error_db:.1f}", flush=True)
        if chosen == "tree":
            yield seconds[0] / seconds[1]


def _with_track_noise(job: Job, case: Case) -> Job:
    """Return the job with noise on its tracks and unchanged echoes; only times and numerical errors are measured."""
    generator = np.random.default_rng(3)
    legs = (leg + case.jitter_m * generator.standard_normal(leg.shape) for leg in job.profiles.aperture.legs)
    tx, rx = legs if case.bistatic else (next(legs),) * 2
    return replace(job, profiles=replace(job.profiles, aperture=Aperture(tx, rx)))


def _planned(job: Job) -> PlannedJob:
    """Return the engines' planning input for a job."""
    profiles, pixels = job.profiles, job.pixels
    sampled, size = np.linspace(0, len(pixels) - 1, 9).astype(int), len(pixels)
    corners = {(top, left) for top in (0, max(0, size - 256)) for left in (0, max(0, size - 256))}
    patches: list[NDArray[np.float64]] = [pixels[top : top + 256, left : left + 256] for top, left in sorted(corners)]
    spacing_m = float(np.linalg.norm(pixels[0, 1] - pixels[0, 0]))
    signal = Signal(profiles.centre_frequency_hz, profiles.oversampling, profiles.step_m, profiles.samples.shape[1])
    return PlannedJob(
        profiles.aperture, pixels[np.ix_(sampled, sampled)], pixels.shape[:2], spacing_m, profiles.centre_frequency_hz,
        C / (profiles.step_m * profiles.oversampling), 4096, signal, frame="local", patches_m=tuple(patches),
    )  # fmt: skip


def _cheapest(engine: object, job: PlannedJob, pulses: int, target_db: float) -> Setting:
    """Return the cheapest setting with an error below a target."""
    settings: list[Setting] = list(engine.candidates(job, pulses=pulses, requested={}))  # type: ignore[attr-defined]
    exact = [setting for setting in settings if setting.error_db <= target_db]
    return min(exact, key=lambda setting: setting.seconds + setting.table_seconds)


if __name__ == "__main__":
    main()
