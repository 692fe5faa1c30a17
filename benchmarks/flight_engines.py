"""Run time and error of several engines on a whole flight: minutes of one thread, error relative to the double sum.

``python benchmarks/flight_engines.py WORK/flight_10min --engines native tree`` images one pair of a campaign with its
echo, profile and tracks, as computed by `flight.py WORK --minutes 10 --only ingest echo scene profile refine`; three
minutes give the same image. With ``--every 8``, one tile in eight is formed, and times, including those of tables, are
multiplied by eight. Errors are RMS at random pixels relative to the RMS of the imaged tiles; the fractions of pixels ×
pulses by path variant are printed.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import contextlib
import io
import time
from pathlib import Path

import numpy as np

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.contracts import Window
from apertura.core.backprojection.engines import ENGINES, load_engine
from apertura.core.backprojection.tiles import compute_tiles
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.range_profiles import profiles_of
from apertura.core.planning.planner import make_plan
from apertura.core.quality.error_check import random_pixels
from apertura.stages.pair import open_pair
from apertura.stages.planning import job_of
from apertura.stages.refine import open_refined
from apertura.stages.scene import open_scene

FLIGHT = "f01"


def main() -> None:
    """Form the images, compare them with the double sum and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", type=Path)
    parser.add_argument("--pair", default="uav1-uav2")
    parser.add_argument("--engines", nargs="+", default=["native", "tree"])
    parser.add_argument("--aims", type=float, nargs="+", default=[-60.0], help="requested accuracies, dB")
    parser.add_argument("--every", type=int, default=1, help="decimation of tiles")
    parser.add_argument("--checks", type=int, default=600)
    options = parser.parse_args()
    for name in set(options.engines) - {name for name in ENGINES if load_engine(name).available()}:
        print(f"{name} skipped: unknown to this version, or not built on this machine")
    engines = [name for name in options.engines if name in ENGINES and load_engine(name).available()]
    begin = time.process_time()
    forms = formations(Campaign.load(options.campaign), options.pair, engines, options.aims)
    print(f"opened and planned {len(forms)} images in {time.process_time() - begin:.0f} CPU s")
    windows = chosen(forms[0], options.every)
    pixels = random_pixels(windows, options.checks, np.random.default_rng(7))
    exact = forms[0].exact(pixels)
    print(f"{len(windows)} of {len(forms[0].windows)} tiles, {len(forms[0].profiles)} pulses", end=", ")
    print(f"load {os.getloadavg()[0]:.1f}")
    for formation in forms:
        image = np.zeros(formation.grid.shape, np.complex64)
        begin, wall = time.process_time(), time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()):
            compute_tiles(formation.image, windows, image, threads=1)
        spent, wall = time.process_time() - begin, time.perf_counter() - wall
        # Pixels that no pulse illuminates are NaN in the image and zero in the double sum.
        error = np.nan_to_num(image[*pixels.T]) - exact
        power = np.mean([np.mean(np.abs(np.nan_to_num(image[window])) ** 2) for window in windows])
        error_db = 10 * np.log10(np.mean(np.abs(error) ** 2) / power)
        shares = ", ".join(
            f"{count / formation.variant_counts.total():.0%} {variant}"
            for variant, count in formation.variant_counts.items()
        )
        whole = spent * len(formation.windows) / len(windows)
        line = f"{formation.plan.setting.line}, {formation.plan.accuracy_db:.0f} dB requested"
        print(
            f"{line}: {whole / 60:.2f} CPU min ({spent:.1f} s measured, {wall:.1f} s wall), error {error_db:.1f} dB. "
            f"{shares}",
            flush=True,
        )


def formations(campaign: Campaign, pair: str, engines: list[str], aims_db: list[float]) -> list[Formation]:
    """Return the image formations with each engine and accuracy."""
    echo, profile = (open_stage(campaign.stage(stage, FLIGHT, pair), stage) for stage in ("echo", "profile"))
    scene, track = open_scene(campaign), open_refined(campaign, FLIGHT)
    opened = track.pair(open_pair(campaign, FLIGHT, pair, echo=echo))
    profiles = track.profiles(opened, profiles_of(profile, lazy=True))
    job = job_of(campaign, opened, scene)
    plans = [
        make_plan(job, accuracy_db=aim_db, overrides={"engine": engine}) for engine in engines for aim_db in aims_db
    ]
    return [
        Formation(opened.history, profiles, scene.grid, plan, campaign.settings.processing.tile_px) for plan in plans
    ]


def chosen(formation: Formation, every: int) -> list[Window]:
    """Select one tile in `every`, spread over the image."""
    side = formation.side_px
    return [
        window for window in formation.windows if (window[0].start // side + 5 * (window[1].start // side)) % every == 0
    ]


if __name__ == "__main__":
    main()
