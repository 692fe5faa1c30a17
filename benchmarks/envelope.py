"""Error of the compiled engine from 30 m to 10 km: `python benchmarks/envelope.py` writes benchmarks/envelope.csv.

Bistatic, 409.6 MHz bandwidth, aperture equal to the range; spacing from an eighth of a wavelength to 1 m, carrier 0.4
to 10 GHz. The grid has 40 × 40 pixels (complete and partial patches) about a point at the range; the reference is the
double sum.
"""

import csv
from pathlib import Path

import numpy as np
from job import GUARD, Job, exact, response, total_path

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.backprojection.engines import native
from apertura.core.backprojection.inputs import Profiles
from apertura.core.geometry.aperture import Aperture

RANGES_M = (30.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0)
CARRIERS_HZ = (0.4e9, 1.2e9, 3.5e9, 10e9)
COLUMNS = ("carrier_hz", "range_m", "spacing_m", "error_db", "tables_error_db", "shared", "own", "exact", "skipped")
STEP_M = C / 409.6e6 / 2


def patch(range_m: float, carrier_hz: float, spacing_m: float, *, pulses: int = 48, size: int = 40) -> Job:
    """Return a job with the echoes of twenty points among `size` × `size` pixels, at an elevation angle of 30°."""
    generator = np.random.default_rng(1)
    along = np.linspace(-0.5, 0.5, pulses)[:, None] * range_m
    wobble = 0.01 * range_m**0.5 * np.cumsum(generator.standard_normal((2, pulses, 3)), 1) / pulses**0.5
    tx = np.hstack([0 * along, along, 0 * along + 0.5 * range_m]) + wobble[0]
    rx = np.hstack([0 * along - 0.05 * range_m, 0.9 * along + 0.1 * range_m, 0 * along + 0.6 * range_m]) + wobble[1]
    step = spacing_m * (np.arange(size) - (size - 1) / 2)
    x, y = np.meshgrid(step + 0.866 * range_m, step)
    pixels = np.stack([x, y, 0 * x], -1)
    flat = pixels.reshape(-1, 3)
    points = flat[generator.integers(0, len(flat), 20)] + spacing_m * generator.uniform(-0.5, 0.5, (20, 3)) * [1, 1, 0]
    amplitude = generator.standard_normal(20) + 1j * generator.standard_normal(20)
    paths = total_path(tx, rx, flat)
    start = paths.min(1) - GUARD * STEP_M
    at = start[:, None] + STEP_M * np.arange(int((paths.max(1) - start).max() / STEP_M) + GUARD)
    samples = np.zeros(at.shape, complex)
    for place, gain in zip(points, amplitude, strict=True):
        path = total_path(tx, rx, place[None])
        samples += gain * np.exp(-2j * np.pi * carrier_hz / C * path) * response(at - path)
    return Job(
        Profiles(samples.astype(np.complex64), start, STEP_M, carrier_hz, 2.0, Aperture(tx, rx)),
        pixels,
        points,
        amplitude,
    )


def measure(job: Job, **options: float) -> tuple[float, float, list[float]]:
    """Return the RMS error over all pixels, the error of the tables (dB), and the fractions of the path variants."""
    tables, counts = native.prepare(job.profiles), np.zeros(4, np.int64)
    image = native.form(tables, job.pixels, counts=counts, **options).ravel()
    truth = exact(job, job.pixels.reshape(-1, 3), carrier_hz=job.profiles.centre_frequency_hz)
    error = np.sum(np.abs(image - truth) ** 2) / np.sum(np.abs(truth) ** 2)
    return float(10 * np.log10(error)), tables.error_db, (counts / counts.sum()).round(3).tolist()


def main() -> None:
    """Measure all settings, save the table and print its worst rows."""
    rows = []
    for carrier_hz in CARRIERS_HZ:
        for range_m in RANGES_M:
            for spacing_m in sorted({C / carrier_hz / 8, C / carrier_hz / 2, 0.1, 0.3, 1.0}):
                error_db, tables_db, shares = measure(patch(range_m, carrier_hz, spacing_m))
                rows.append(
                    [carrier_hz, range_m, round(spacing_m, 5), round(error_db, 1), round(tables_db, 1), *shares]
                )
    with Path(__file__).with_name("envelope.csv").open("w", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(COLUMNS)
        table.writerows(rows)
    print(f"{len(rows)} settings, {sum(row[3] <= -60 for row in rows)} with an error of -60 dB or less; the worst:")
    for row in sorted(rows, key=lambda row: -row[3])[:12]:
        print(*row)


if __name__ == "__main__":
    main()
