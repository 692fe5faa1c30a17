"""Stripmap imaging: cost per pixel against the length of the flight, and memory of a long flight.

    python benchmarks/stripmap.py
    python benchmarks/stripmap.py --pulses 300000 --pixels 4096

The first command images a strip of constant width from flights of 0.25 to 2 km with a pulse every 2 cm, and a small
scene from the longest flight; it prints CPU seconds of planning and of tiles, and the error relative to the double sum
over pulses and subcarriers at random pixels, all with the same integration. The second command writes echo and profiles
of a flight to disk, then forms, certifies and measures the image in the same way as the step, in a separate process,
and prints its peak memory.
"""

import argparse
import contextlib
import io
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beam, Beams, gaussian_cut
from apertura.core.antenna.illumination import illuminate
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.tiles import compute_tiles
from apertura.core.echo.compression import centre_frequency
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.certify import certified, measures
from apertura.core.imaging.focus_check import focus_report
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.job import imaging_job
from apertura.core.imaging.range_profiles import RangeWindow, Rows, range_compress
from apertura.core.planning.planner import make_plan
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, GroundModels
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers

FLAT = FlatGround(0.0)
SPEED_M, HEIGHT_M = 0.02, 40.0
NEAR_M, WIDTH_M, SPACING_M = 60.0, 40.0, 0.25
SUBCARRIERS, BAND_HZ, CARRIER_HZ = 256, 200e6, 1.2e9
AT_ONCE = 4096


class Flight:
    """Point targets every 25 m along a straight flight, with echoes simulated on access."""

    def __init__(self, pulses: int, step_m: float, width_m: float, subcarriers: int, band_hz: float):
        along = (np.arange(pulses) - pulses / 2) * step_m
        track = np.stack([along, 0 * along, np.full(pulses, HEIGHT_M)], -1)
        self.aperture, self.shape, self.ndim = Aperture(track, track), (pulses, subcarriers), 2
        self.frequency_hz = CARRIER_HZ + band_hz / subcarriers * np.arange(subcarriers)
        generator, count = np.random.default_rng(0), int(pulses * step_m / 25)
        east = np.sort(generator.uniform(along[0], along[-1], count))
        self.targets_m = np.stack([east, NEAR_M + width_m * generator.random(count), 0 * east], -1)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, pulses: slice) -> NDArray[np.complex64]:
        aperture = self.aperture[pulses]
        east, reach = aperture.tx_m[:, 0], 200.0
        near_m = self.targets_m[np.abs(self.targets_m[:, 0] - east.mean()) < reach]
        return transfer(Scatterers(near_m, np.ones(len(near_m))), aperture, self.frequency_hz, spreading=False)

    @property
    def history(self) -> PhaseHistory:
        """Phase history of the whole flight, simulated on access."""
        weight = np.hanning(self.shape[1]) / np.hanning(self.shape[1]).sum()
        return PhaseHistory(self, self.frequency_hz, weight, np.zeros(len(self)), self.aperture)  # type: ignore[arg-type]


def compress_into(history: PhaseHistory, window: RangeWindow, grid: SceneGrid, into: Any) -> None:
    """Range-compress a flight block by block into an array."""
    for first in range(0, len(history), AT_ONCE):
        block = slice(first, min(first + AT_ONCE, len(history)))
        part = RangeWindow(
            window.start_m[block],
            window.samples,
            window.step_m,
            window.unambiguous,
            window.farthest_m[block],
            window.wave_speed_m_s,
        )
        into[block] = range_compress(history[block], grid, FLAT, window=part).samples


def _profiles(samples: Any, start_m: Any, step_m: float, unambiguous: int, history: PhaseHistory) -> Profiles:
    frequency = history.frequency_hz
    over = unambiguous / len(frequency)
    return Profiles(samples, start_m, step_m, centre_frequency(frequency), over, history.aperture)


def formed(flight: Flight, grid: SceneGrid, *, integration: Any = "auto") -> dict[str, Any]:
    """Form an image; return its cost and its error."""
    history, ground = flight.history, GroundModels.of(FLAT, None, grid)
    start_s = time.process_time()
    job = imaging_job(flight.aperture, flight.frequency_hz, history.weight, grid, ground, integration=integration)
    plan = make_plan(job, accuracy_db=-60.0)
    window = RangeWindow.of(
        flight.aperture, grid, FLAT, flight.frequency_hz, beams=job.beams, wave_speed_m_s=history.wave_speed_m_s
    )
    planned = time.process_time()
    samples = np.empty((len(flight), window.samples), np.complex64)
    compress_into(history, window, grid, samples)
    profiles = _profiles(samples, window.start_m, window.step_m, window.unambiguous, history)
    formation = Formation(history, profiles, grid, plan, 256)
    image = np.zeros(grid.shape, np.complex64)
    tiles_start_s = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        compute_tiles(formation.image, formation.windows, image, threads=1)
    tiles_s = time.process_time() - tiles_start_s
    with contextlib.redirect_stdout(io.StringIO()):
        certificate = certified(formation, image, accuracy_db=-60.0, threads=1)
    summed = job.pixels * len(flight) * job.share
    return {
        "length_km": round(float(np.ptp(flight.aperture.tx_m[:, 0])) / 1000, 2),
        "pulses": len(flight),
        "pulses_per_pixel": plan.integration.report.get("pulses_per_pixel", {}).get("median", len(flight)),
        "pixels": job.pixels,
        "samples": window.samples,
        "idle_pulses": int((~window.contributing).sum()),
        "plan_s": round(planned - start_s, 2),
        "tiles_s": round(tiles_s, 2),
        "us_per_pixel": round(1e6 * tiles_s / job.pixels, 3),
        "ns_per_pixel_pulse": round(1e9 * tiles_s / summed, 3),
        "error_db": certificate["numerical_error_estimate_db"],
        "recomputed": len(certificate["recomputed"]),
        "flags": ",".join(plan.flags),
    }


def lengths() -> None:
    """Print a row per length of a flight past a strip, then a row of the longest flight past a small scene."""
    warm = Flight(3000, SPEED_M, WIDTH_M, SUBCARRIERS, BAND_HZ)
    formed(warm, SceneGrid("local", -8.0, NEAR_M + WIDTH_M, SPACING_M, (160, 64)))
    for flown_m, length in ((250, 250.0), (500, 500.0), (1000, 1000.0), (2000, 2000.0), (2000, 64.0)):
        flight = Flight(int(flown_m / SPEED_M), SPEED_M, WIDTH_M, SUBCARRIERS, BAND_HZ)
        columns = int(length / SPACING_M)
        grid = SceneGrid("local", -length / 2, NEAR_M + WIDTH_M, SPACING_M, (int(WIDTH_M / SPACING_M), columns))
        print(formed(flight, grid), flush=True)


def long_flight(pulses: int, pixels: int, folder: Path) -> None:
    """Write echo and profiles of a flight over the centre line of a square scene; antenna beams limit the swath."""
    grid, flight, beams = _long(pulses, pixels)
    history = flight.history
    inputs = flight.aperture, flight.frequency_hz, history.weight
    job = imaging_job(*inputs, grid, GroundModels.of(FLAT, None, grid), beams=beams)
    window = RangeWindow.of(
        flight.aperture, grid, FLAT, flight.frequency_hz, beams=job.beams, wave_speed_m_s=history.wave_speed_m_s
    )
    import zarr

    group = zarr.open_group(folder / "flight.zarr", mode="w")
    profile, transfer = (
        group.create_array(
            name, shape=(pulses, size), chunks=(1024, size), dtype="complex64", dimension_names=["pulse", name + "_at"]
        )
        for name, size in (("profile", window.samples), ("transfer", flight.shape[1]))
    )
    for first in range(0, pulses, AT_ONCE):
        transfer[first : first + AT_ONCE] = flight[first : first + AT_ONCE]
    echo = xr.open_zarr(folder / "flight.zarr", consolidated=False, chunks=None)
    compress_into(replace(history, transfer=Rows(echo.transfer)), window, grid, profile)  # type: ignore[arg-type]
    np.savez(folder / "window.npz", start=window.start_m, step=window.step_m, over=window.unambiguous)
    print(f"{window.samples} samples, {int((~window.contributing).sum())} pulses do not contribute to the image")


def _long(pulses: int, pixels: int) -> tuple[SceneGrid, Flight, Beams]:
    side_m = 0.5 * pixels
    flight = Flight(pulses, 1.1 * side_m / pulses, 200.0, 512, 100e6)
    grid = SceneGrid("local", -side_m / 2, side_m / 2, 0.5, (pixels, pixels))
    down = np.radians(20.0)  # depression angle of the boresight, to the north
    ahead, up = [0.0, np.cos(down), -np.sin(down)], [0.0, np.sin(down), np.cos(down)]
    axes = np.broadcast_to(np.array([ahead, [1.0, 0.0, 0.0], up]), (pulses, 3, 3))
    wide, narrow = (gaussian_cut(width, cutoff_db=-10.0, limit_rad=1.5) for width in (60.0, 12.0))
    beam = Beam(axes, *wide, *narrow)
    return grid, flight, Beams(beam, beam)


def imaged(pulses: int, pixels: int, folder: Path) -> None:
    """Form, certify and measure the image of the flight written by `long_flight`, in the same way as the step."""
    import zarr

    start_s, wall_start_s = time.process_time(), time.perf_counter()
    grid, flight, beams = _long(pulses, pixels)
    stage = xr.open_zarr(folder / "flight.zarr", consolidated=False, chunks=None)
    window = np.load(folder / "window.npz")
    history = replace(flight.history, transfer=Rows(stage.transfer))  # type: ignore[arg-type]
    ground = GroundModels.of(FLAT, None, grid)
    job = imaging_job(flight.aperture, flight.frequency_hz, history.weight, grid, ground, beams=beams)
    lit = illuminate(job.beams, job.aperture, job.points_m) if job.beams else None
    plan = make_plan(replace(job, illumination=lit, threads=2, memory_bytes=8 << 30), accuracy_db=-60.0)
    planned = time.process_time()
    places = window["start"], float(window["step"]), int(window["over"])
    profiles = _profiles(Rows(stage.profile), *places, history)
    formation = Formation(history, profiles, grid, plan, 256)
    target = zarr.open_array(folder / "image.zarr", mode="w", shape=grid.shape, chunks=(256, 256), dtype="complex64")
    compute_tiles(formation.image, formation.windows, target, threads=2)
    print(_peak("tiles"), f"{time.process_time() - planned:.1f} CPU s")
    certificate = certified(formation, target, accuracy_db=-60.0, threads=2)
    print(_peak("certificate"), certificate["numerical_error_db"])
    measures(formation, target), focus_report(formation, target)
    tiles = f"{len(formation.windows)} of {len(formation.tiles)} tiles"
    report = plan.integration.report if plan.integration else {}
    print(plan.setting.line, plan.setting.pulse_blocks, "blocks;", tiles, report, dict(plan.flags))
    print(f"planned {plan.memory_bytes / 2**30:.2f} GiB, {plan.predicted_seconds:.0f} s")
    print(_peak("focus"), f"{time.process_time() - start_s:.1f} CPU s, {time.perf_counter() - wall_start_s:.1f} s")


def _peak(stage: str) -> str:
    return f"{stage}: peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB"


def main() -> None:
    """Run the requested measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pulses", type=int, default=0)
    parser.add_argument("--pixels", type=int, default=4096)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    if not options.pulses:
        lengths()
    elif options.folder:
        imaged(options.pulses, options.pixels, options.folder)
    else:
        with tempfile.TemporaryDirectory() as folder:
            long_flight(options.pulses, options.pixels, Path(folder))
            subprocess.run([sys.executable, __file__, *sys.argv[1:], "--folder", folder], check=True)


if __name__ == "__main__":
    main()
