"""Run time of the image quality checks: `python benchmarks/measures.py [--size 2048] [--pulses 4096] [--repeats 3]`.

Five targets and noise are imaged tile by tile into zarr, as planned by the workflow; the time of image formation is
compared with those of the certificate, the brightest target, the focus check and the agreement with another image. All
measurements are repeated.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import contextlib
import io
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import zarr
from rich.console import Console
from rich.table import Table

from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.backprojection.tiles import compute_tiles
from apertura.core.echo.compression import window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.certify import certified, measures
from apertura.core.imaging.focus_check import focus_report
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.job import imaging_job
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.planning.planner import make_plan
from apertura.core.quality.agreement import agreement
from apertura.core.quality.bright_points import BrightPoint
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, GroundModels
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers

BANDWIDTH_HZ, CENTRE_HZ, SPACING_M, TILE = 409.6e6, 1.2e9, 0.1, 256


def formation(size: int, pulses: int, subcarriers: int) -> Formation:
    """Return the formation of an image: a straight flight next to the grid, 25 dB SNR per pulse and subcarrier."""
    generator, half = np.random.default_rng(1), size * SPACING_M / 2
    along = np.linspace(-half / 4, half / 4, pulses)
    track = np.stack([along, np.full(pulses, -half - 60.0), np.full(pulses, 60.0)], -1)
    flown = Aperture(track, track)
    frequency = CENTRE_HZ + BANDWIDTH_HZ * (np.arange(subcarriers) / subcarriers - 0.5)
    places = np.array(
        [[x, y, 0.0] for x, y in half * np.array([(0, 0), (-0.5, 0.2), (0.4, 0.5), (0.3, -0.6), (-0.6, -0.4)])]
    )
    echoes = transfer(Scatterers(places, np.ones(len(places))), flown, frequency, spreading=False)
    for part in np.array_split(echoes, 32):
        part.real += 0.05 * generator.standard_normal(part.shape, np.float32)
        part.imag += 0.05 * generator.standard_normal(part.shape, np.float32)
    weight = window_weights("hann", subcarriers)
    history = PhaseHistory(echoes, frequency, weight, np.zeros(pulses), flown)
    grid, ground = SceneGrid("local", -half, half, SPACING_M, (size, size)), FlatGround(0.0)
    job = imaging_job(flown, frequency, weight, grid, GroundModels.of(ground, None, grid))
    plan = make_plan(job, accuracy_db=-60.0)
    return Formation(history, range_compress(history, grid, ground), grid, plan, TILE)


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Run a function; return its CPU seconds and its result."""
    begin = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        result = work()
    return time.process_time() - begin, result


def main() -> None:
    """Measure and print the run times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("size", 2048), ("pulses", 4096), ("subcarriers", 1024), ("repeats", 3)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    formed, rows = formation(options.size, options.pulses, options.subcarriers), []
    for _ in range(options.repeats):
        with tempfile.TemporaryDirectory() as folder:
            target = zarr.create_array(folder, shape=formed.grid.shape, chunks=(TILE, TILE), dtype="complex64")
            rows.append(_round(formed, target))
    seconds = np.array(rows)
    table = Table(title=f"{formed.plan.setting.line}, load {os.getloadavg()[0]:.1f}")
    for heading in ("check", "CPU seconds", "spread", "fraction of imaging"):
        table.add_column(heading)
    names = ("image", "certificate", "brightest target", "focus", "agreement")
    for name, column in zip(names, seconds.T, strict=True):
        share = column.mean() / seconds[:, 0].mean()
        table.add_row(name, f"{column.mean():.2f}", f"{np.ptp(column):.2f}", f"{100 * share:.0f} %")
    checks_share = seconds[:, 3:].sum(axis=1).mean() / seconds[:, 0].mean()
    Console().print(table, f"focus and agreement: {100 * checks_share:.0f} % of imaging")


def _round(formed: Formation, target: Any) -> list[float]:
    report: dict[str, Any] = {}

    def focus() -> None:
        report.update(focus_report(formed, target))

    def agree() -> Any:
        rows, columns = formed.grid.pixel_of(*([one[axis] for one in report["points"]] for axis in ("x_m", "y_m")))
        points = [BrightPoint(float(r), float(c), 1.0) for r, c in zip(rows, columns, strict=True)]
        spectrum = np.array(report["spectrum_cycles2_m2"])
        images = target, target
        return agreement(images, (points,) * 2, spacing_m=SPACING_M, cell_m=report["cell_m"], spectrum=spectrum)

    works = (
        lambda: compute_tiles(formed.image, formed.windows, target, threads=1),
        lambda: certified(formed, target, accuracy_db=-60.0, threads=1),
        lambda: measures(formed, target),
        focus,
        agree,
    )
    return [timed(work)[0] for work in works]


if __name__ == "__main__":
    main()
