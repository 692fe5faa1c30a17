"""Rate and peak memory of a large image: 8192 × 8192 UTM pixels from 4096 pulses: `python benchmarks/size.py`.

The image is formed tile by tile into zarr. The peak memory is that of the process. The rate is compared with the rate
of the kernel on tiles spread over the same image, with the same number of threads, for each block of pulses. Samples
are random, because time and memory do not depend on the samples. Prints the results and writes benchmarks/size.json.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import json
import resource
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import zarr

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.backprojection.engines import PATCH_PX, native
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.engines.range_interpolation import Tables
from apertura.core.backprojection.inputs import Profiles
from apertura.core.backprojection.tiles import compute_tiles, image_array
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import ecef_from_projected
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround

BANDWIDTH_HZ, CENTRE_HZ, SPACING_M, TILE = 409.6e6, 1.2e9, 0.1, 512


def profiles(grid: SceneGrid, pulses: int, height_m: float = 400.0) -> Profiles:
    """Return random samples over the swath of a straight flight along one side of the grid."""
    generator = np.random.default_rng(1)
    west, south, east, north = grid.bounds_m
    along = np.linspace(south, north, pulses)
    tx = ecef_from_projected(grid.crs, np.full(pulses, west - 200.0), along, np.full(pulses, height_m))
    rx = tx + 5 * (tx[-1] - tx[0]) / np.linalg.norm(tx[-1] - tx[0])
    step_m = C / BANDWIDTH_HZ / 2
    y, x = np.meshgrid(np.linspace(south, north, 33), (west, east))
    edge = ecef_from_projected(grid.crs, x.ravel(), y.ravel(), np.zeros(x.size))
    nearest = np.hypot(200.0, height_m) * 2 - 20
    farthest = max(np.linalg.norm(edge - antenna, axis=1).max() for antenna in (tx[0], tx[-1])) * 2 + 20
    shape = (pulses, int((farthest - nearest) / step_m))
    samples = np.empty(shape, np.complex64)
    for part in np.array_split(samples, 32):
        part.real, part.imag = generator.standard_normal((2, *part.shape), np.float32)
    return Profiles(samples, np.full(pulses, nearest), step_m, CENTRE_HZ, 2.0, Aperture(tx, rx))


def kernel_seconds(tables: Tables, grid: SceneGrid, threads: int) -> float:
    """Return the kernel's time in seconds for the whole image, extrapolated from tiles on its diagonal."""
    corners = np.linspace(0, grid.shape[0] - TILE, 2 * threads).astype(int) // PATCH_PX * PATCH_PX
    tiles = [grid[c : c + TILE, c : c + TILE].positions(0.0) for c in corners]
    begin = time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda pixels: native.form(tables, pixels), tiles))
    return (time.perf_counter() - begin) * grid.shape[0] * grid.shape[1] / (TILE * TILE * len(tiles))


def image_seconds(profiles: Profiles, grid: SceneGrid, *, blocks: int, threads: int) -> tuple[float, float]:
    """Return the seconds to form the image into zarr, including tables and positions, and the seconds of the kernel."""
    kernel_s = sum(
        kernel_seconds(native.prepare(profiles[part]), grid, threads) for part in profiles.aperture.blocks(blocks)
    )
    with tempfile.TemporaryDirectory() as folder:
        array = zarr.create_array(folder, shape=grid.shape, chunks=(TILE, TILE), dtype="complex64")
        begin = time.perf_counter()
        setting = Setting("native", {}, {}, -60.0, 1.0, pulse_blocks=blocks)
        image = image_array(profiles, setting, grid, FlatGround(0.0), side_px=TILE)
        compute_tiles(image, list(grid.tiles(TILE)), array, threads=threads)
        return time.perf_counter() - begin, kernel_s


def main() -> None:
    """Form the image once, print and save the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=8192)
    parser.add_argument("--pulses", type=int, default=4096)
    parser.add_argument("--blocks", type=int, default=2, help="pulse blocks; the tables of one block are in memory")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    grid = SceneGrid("EPSG:32632", 5e5, 5.3e6, SPACING_M, (options.size, options.size))
    history = profiles(grid, options.pulses)
    spent_s, kernel_s = image_seconds(history, grid, blocks=options.blocks, threads=options.threads)
    rate = options.size**2 * options.pulses / spent_s / options.threads
    measured = {
        "pixels": options.size**2,
        "pulses": options.pulses,
        "threads": options.threads,
        "seconds": round(spent_s, 1),
        "kernel_seconds": round(kernel_s, 1),
        "ratio_to_kernel": round(spent_s / kernel_s, 3),
        "pixel_pulses_per_s_per_core": float(f"{rate:.3g}"),
        "peak_memory_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
    }
    print(json.dumps(measured, indent=1))
    Path(__file__).with_name("size.json").write_text(json.dumps(measured, indent=1) + "\n")


if __name__ == "__main__":
    main()
