"""Rate and error of engine cuda: `python benchmarks/gpu.py [--size 4096] [--pulses 4096] [--rounds 5]`.

Wall-clock times include the transfer of pixels to the device and of the image to the host; they are medians over rounds
that run all rows alternately, without the first round, which compiles kernels. Rates count pixels × pulses with a
non-zero weight; errors are measured at random pixels against the exact image of job.py. For comparison, published rates
of other programs, on their devices and jobs, are printed. Without a device, the exit status is 1.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from job import Job, build, error_db

from apertura.core.antenna.beam import Beam, Beams, gaussian_cut
from apertura.core.backprojection.engines import cuda
from apertura.core.geometry.sector import Sector

PUBLISHED = (
    (
        225e9,
        "torchbp, RTX 3090 Ti, polar grid; Readme.md of github.com/Ttl/torchbp",
    ),
    (68e9, "fastsar, L4, exact, cubic, -67 dB; docs/performance.md of github.com/saulpingerman/FastSAR"),
)
"""Published rates, pixels × pulses per second, and their sources."""


@dataclass
class Row:
    """One row: the job, the call and its run times."""

    name: str
    job: Job
    run: Callable[[], Any]
    beams: Beams | None = None
    seconds: list[float] = field(default_factory=list)
    image: Any = None

    def go(self) -> None:
        """Run once and record the time."""
        begin = time.perf_counter()
        self.image = self.run()
        self.seconds.append(time.perf_counter() - begin)

    @property
    def kept(self) -> list[float]:
        """Times in seconds without the first round, unless it is the only one."""
        return self.seconds[min(1, len(self.seconds) - 1) :]


def weights(job: Job) -> dict[str, Beams]:
    """Return a sector of a tenth of the flight, beams of 40° by 60° directed at the scene centre, and both."""
    flown = job.profiles.aperture
    sector, middle = Sector.of(flown, chord_m=1.5, centre=0.0, half=0.08), job.pixels.reshape(-1, 3).mean(axis=0)
    cuts = gaussian_cut(40.0, cutoff_db=-20, limit_rad=np.pi), gaussian_cut(60.0, cutoff_db=-20, limit_rad=np.pi / 2)
    antennas = []
    for leg in flown.legs:
        ahead = (middle - leg) / np.linalg.norm(middle - leg, axis=1, keepdims=True)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        antennas.append(Beam(np.stack([ahead, right, np.cross(ahead, right)], axis=1), *cuts[0], *cuts[1]))
    return {"sector": Beams(sector=sector), "beams": Beams(*antennas), "sector and beams": Beams(*antennas, sector)}


def rows(size: int, pulses: int) -> list[Row]:
    """Return the timed rows: geometries and surfaces by the series, exact paths only, weights, and tables only."""
    few = partial(build, size, pulses, count=16)  # the profiles take longer than the measurement
    flat, mono, rough = few(), few(bistatic=False), few(surface="natural")
    weighed = [(f"bistatic, {name}", flat, {"beams": beams}) for name, beams in weights(flat).items()]
    timed = []
    for name, job, options in (
        ("bistatic", flat, {}),
        ("monostatic", mono, {}),
        ("bistatic, DEM", rough, {}),
        ("bistatic, float64 paths", flat, {"tolerance_rad": 1e-12}),
        *weighed,
    ):
        run = partial(cuda.form, cuda.prepare(job.profiles), job.pixels, **options)
        timed.append(Row(name, job, run, options.get("beams")))
    patch = flat.pixels[:16, :16]
    timed.append(Row("tables and a patch", flat, lambda: cuda.form(cuda.prepare(flat.profiles), patch)))
    return timed


def share(row: Row) -> float:
    """Return the fraction of pixels × pulses with a non-zero weight, to which the rate refers."""
    if row.beams is None:
        return 1.0
    coarse = row.job.pixels[:: max(1, row.job.pixels.shape[0] // 9), :: max(1, row.job.pixels.shape[1] // 9)]
    return float((row.beams.weight(row.job.profiles.aperture, coarse.reshape(-1, 3)) != 0).mean())


def main() -> int:
    """Measure and print the rows; return 1 without a device."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("size", 4096), ("pulses", 4096), ("rounds", 5)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    if not cuda.available():
        print("no CUDA device found: nothing measured (docs/howto/gpu.md)")
        return 1
    print(f"{cuda.instruction_set()}; {options.size}² pixels, {options.pulses} pulses, {options.rounds} rounds")
    timed = rows(options.size, options.pulses)
    for _ in range(options.rounds):
        for row in timed:
            row.go()
    for row in timed:
        seconds, spread = statistics.median(row.kept), max(row.kept) / min(row.kept)
        line = f"{row.name:<26}{seconds:>9.3f} s  first {row.seconds[0]:.2f} s  spread {spread:.2f}"
        if row.image.shape == row.job.pixels.shape[:2]:
            weighted_share = share(row)
            rate = weighted_share * np.prod(row.image.shape) * options.pulses / seconds
            ratios = ", ".join(f"{rate / theirs:.2f} of {who.split(',')[0]}" for theirs, who in PUBLISHED)
            error = error_db(row.job, row.image, beams=row.beams)
            line += f"{rate:>11.3g} pixel·pulses/s of {100 * weighted_share:.0f} %{error:>7.1f} dB  {ratios}"
        print(line)
    for rate, who in PUBLISHED:
        print(f"published: {rate:.3g}/s, {who}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
