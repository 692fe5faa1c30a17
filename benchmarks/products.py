"""Peak memory and run time of the steps that write products, on a synthetic campaign of any size.

    python -m benchmarks.products export --side 16384  files of one pair
    python -m benchmarks.products cube --side 8192     the cube, then the files of the sums

A small simulated campaign is processed up to its images; then its grid is enlarged and its images are replaced by
speckle, with a fifth of the tiles not illuminated by any pulse. Each step runs in a separate process.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from apertura.campaign.folder import Campaign
from apertura.campaign.store import create, finish, open_array, open_stage, save_document, writing
from apertura.run.process import process
from apertura.simulation import ImageGrid, preset, simulate
from apertura.stages.scene import settled_scene

TILE = 256
LIT = 0.8


def prepare(root: Path, side: int, pairs: int | None) -> Campaign:
    """Write the campaign, with speckle of side × side pixels for the first pairs, or for all."""
    plan = replace(preset("demo", pulses=60), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    start = plan.flights[0].tracks["uav2"].start_m
    third = replace(plan.flights[0].tracks["uav2"], start_m=(start[0] - 3.0, start[1] - 3.6, start[2]))
    over = replace(plan.flights[0], tracks={**plan.flights[0].tracks, "uav3": third})
    nodes = {**plan.nodes, "uav3": plan.nodes["uav2"]}
    campaign = process(simulate(root, replace(plan, nodes=nodes, flights=(over,)), seed=7), last="assess")
    (flight,) = campaign.image_flights
    settled = json.loads(campaign.result("scene.json").read_text())
    settled["grid"]["shape"] = [side, side]
    save_document(campaign.result("scene.json"), settled)
    for number, pair in enumerate(flight.pairs[:pairs]):
        enlarge(campaign, flight.name, pair, number)
    return campaign


def enlarge(campaign: Campaign, flight: str, pair: str, seed: int, lit: float = LIT) -> None:
    """Replace the image of a pair by speckle on the enlarged grid."""
    folder, grid = campaign.stage("image", flight, pair), settled_scene(campaign).grid
    small = open_stage(folder, "image")
    missing = np.broadcast_to(np.complex64(complex(np.nan, np.nan)), grid.shape)
    large = xr.Dataset({"image": (("y", "x"), missing, small.image.attrs)}, coords=grid.coordinates, attrs=small.attrs)
    rng = np.random.default_rng(seed)
    peak = small.attrs["quality"]["brightest"]["amplitude"]
    folder.remove()
    with writing(folder) as wip:
        create(wip, large, {"image": (TILE, TILE)})
        array = open_array(wip, "image")
        for window in grid.tiles(TILE):
            if rng.random() < lit:
                array[window] = peak * 0.1 * rng.standard_normal((TILE, 2 * TILE), np.float32).view(np.complex64)
        finish(wip, folder)


def measured(root: Path, *step: str) -> None:
    """Run a step in a separate process and print its wall-clock time."""
    start_s = time.perf_counter()
    subprocess.run([sys.executable, "-m", __spec__.name, "--measure", str(root), *step], check=True)
    print(f"{' '.join(step)}: {time.perf_counter() - start_s:.1f} s wall-clock time", flush=True)


def run_step(root: str, *step: str) -> None:
    """Run a step in this process; print its peak memory and CPU seconds."""
    from apertura.cli import app

    app(["step", *step, "--campaign", root], standalone_mode=False)
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = used.ru_utime + used.ru_stime
    print(f"{' '.join(step)}: peak {used.ru_maxrss / 2**20:.2f} GiB, {seconds:.1f} CPU s", flush=True)


def main() -> None:
    """Prepare a campaign and measure the requested steps."""
    if sys.argv[1:2] == ["--measure"]:
        run_step(*sys.argv[2:])
        return
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("step", choices=["export", "cube"])
    parser.add_argument("--side", type=int, default=16384)
    parser.add_argument("--folder", type=Path, default=Path("/tmp/apertura-products"))
    options = parser.parse_args()
    shutil.rmtree(options.folder, ignore_errors=True)
    campaign = prepare(options.folder, options.side, 1 if options.step == "export" else None)
    (flight,) = campaign.image_flights
    if options.step == "export":
        for step in ("layers", "export"):
            measured(options.folder, step, flight.name, flight.pairs[0])
        return
    measured(options.folder, "cube")
    for pair in flight.pairs:
        measured(options.folder, "layers", flight.name, pair)
    measured(options.folder, "export", flight.name, "fused")


if __name__ == "__main__":
    main()
