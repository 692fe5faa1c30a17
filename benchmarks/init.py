"""Loose files of five radars to first images with `apertura init`: questions, and position errors of targets.

`PYTHONPATH=tests python benchmarks/init.py [NAME …]` prints the table of docs/howto/from_files.md. Simulated campaigns
are taken apart into the files that a recorder and an autopilot write; the answers are the values that a user knows.
"""

import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from loose_files import epochs, int16_and_logs, truth, write_ulog

from apertura import simulation
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.check import problems
from apertura.core.echo.dechirp import FrequencySweep
from apertura.core.quality.bright_points import brightest_near
from apertura.core.quality.point_targets import find_peak
from apertura.run.process import process
from apertura.simulation.fmcw import FmcwFlight, write_fmcw_campaign
from apertura.simulation.waveform import PulseSpecification
from apertura.stages.cphd import cphd
from apertura.tools.init import Question, campaign_from_files

Loose = tuple[Path, np.ndarray, dict[str, str], dict[str, str]]
"""Folder of the files, true easting and northing of the targets, answers by the first key, options."""

SEARCH_M = 0.5
"""Radius about the true position within which the peak of a target is searched, metres."""


PREFIX = {"waveform.cyclic_prefix_s": "0.78125e-6"}
"""Cyclic prefix of the demo."""


def without_constants(plan: simulation.CampaignSpecification) -> simulation.CampaignSpecification:
    """Return a campaign without lever arms and path offsets, which no file contains."""
    nodes = {name: replace(node, lever_arms_m={}, path_offset_m={}) for name, node in plan.nodes.items()}
    return replace(plan, nodes=nodes)


def int16_ofdm(folder: Path) -> Loose:
    """OFDM, two nodes: int16 samples without header, NMEA log, CSV log, time tags, codes."""
    root = simulation.simulate(folder / "simulated", without_constants(simulation.preset("demo")), seed=1)
    answers = {"waveform.sample_rate_hz": "1.024e9 1.2e9", **PREFIX, "scene.height_m": "620 right"}
    return int16_and_logs(root, folder / "loose"), truth(root), answers, {}


def sigmf_swarm(folder: Path) -> Loose:
    """OFDM, four nodes: SigMF recordings, logs of RTKLIB and CSV, codes."""
    root = simulation.simulate(folder / "simulated", without_constants(simulation.preset("swarm")), seed=1)
    (root / "raw/codes.npy").rename(root / "raw/f01/codes.npy")
    return root / "raw/f01", truth(root), {**PREFIX, "scene.height_m": "620 right"}, {}


def sigmf_chirp(folder: Path) -> Loose:
    """Chirp of 200 MHz, one node: SigMF recording, CSV log, samples of the pulse."""
    plan = without_constants(simulation.preset("demo"))
    (flight,) = plan.flights
    flight = replace(flight, tracks={"uav1": flight.tracks["uav1"]})
    chirp = PulseSpecification("chirp", 1.3e9, 200e6, 2e-6, 1.5e-6, 256e6, 20.0)
    plan = replace(plan, waveform=chirp, nodes={"uav1": plan.nodes["uav1"]}, flights=(flight,))
    root = simulation.simulate(folder / "simulated", plan, seed=1)
    (root / "raw/pulse.npy").rename(root / "raw/f01/pulse.npy")
    return root / "raw/f01", truth(root), {"waveform.lead_s": "0", "scene.height_m": "620 right"}, {}


def fmcw_ulog(folder: Path) -> Loose:
    """FMCW, one node: array of beat signals, array of times, ULog."""
    targets = ((0.0, 0.0, 0.0), (-2.0, 2.0, 0.0), (2.5, -1.5, 0.0))
    flight = FmcwFlight(FrequencySweep(2.2e9, 400e6, 20e-6, 25e6), 100.0, 200, {"uav1": (0.0, -20.0, 10.0)}, targets)
    root, loose = write_fmcw_campaign(folder / "simulated", flight, waveform={}), folder / "loose"
    loose.mkdir()
    for suffix in (".npy", ".time.npy"):
        shutil.copyfile(root / f"raw/f01/uav1{suffix}", loose / f"drone_beat{suffix}")
    write_ulog(loose / "log_42.ulg", *epochs(Campaign.load(root), "uav1"))
    answers = {
        "waveform.start_hz": "2.2e9 400e6 20e-6",
        "waveform.sample_rate_hz": "25e6",
        "scene.height_m": f"{flight.origin[2]} left",
    }
    vacuum = {"scene.atmosphere": "{refractivity_n: 0.0}"}
    return loose, np.add(flight.origin[:2], np.array(targets)[:, :2]), answers, vacuum


def cphd_history(folder: Path) -> Loose:
    """Phase history of another processor: a CPHD file with positions."""
    root = simulation.simulate(folder / "simulated", without_constants(simulation.preset("paper", pulses=400)), seed=1)
    campaign = process(root, last="cube")
    (folder / "loose").mkdir()
    shutil.copyfile(str(cphd(campaign, "f01", "uav1-uav1")), folder / "loose/collect.cphd")
    return folder / "loose", truth(root), {"scene.height_m": "620 left"}, {}


RADARS: dict[str, Callable[[Path], Loose]] = {
    function.__name__: function for function in (int16_ofdm, sigmf_swarm, sigmf_chirp, fmcw_ulog, cphd_history)
}


def position_errors_m(campaign: Campaign, targets: np.ndarray) -> dict[str, list[float]]:
    """Return the distance of the peak next to each target inside the image from its true position, by pair."""
    errors: dict[str, list[float]] = {}
    for flight in campaign.image_flights:
        for pair in flight.pairs:
            stage = open_stage(campaign.stage("image", flight.name, pair), "image")
            pixels, x, y = stage.image.values, stage.x.values, stage.y.values
            spacing_m = float(x[1] - x[0])
            for east, north in targets:
                row, column = (y[0] - north) / spacing_m, (east - x[0]) / spacing_m
                if 0 <= row < len(y) - 1 and 0 <= column < len(x) - 1:
                    peak = find_peak(pixels, *brightest_near(pixels, row, column, SEARCH_M / spacing_m))
                    distance_m = spacing_m * float(np.hypot(peak.row - row, peak.column - column))
                    errors.setdefault(pair, []).append(distance_m)
    return errors


def main(names: list[str]) -> None:
    """Print a line per radar."""
    print("radar | questions | problems | targets | position error: median, largest, cm | init, run, s | grid")
    for name in names or list(RADARS):
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            loose, targets, answers, options = RADARS[name](folder)

            def ask(question: Question, problem: str, answers: dict[str, str] = answers) -> str:
                return "" if problem else answers.get(question.keys[0], "")

            start_s = time.perf_counter()
            made = campaign_from_files(folder / "made", [loose], settings=options, ask=ask)
            init_s = time.perf_counter() - start_s
            found = problems(made.folder)
            print(
                *made.lines,
                *map(str, found),
                (made.folder / "config/config.yaml").read_text(),
                sep="\n",
                file=sys.stderr,
            )
            start_s = time.perf_counter()
            campaign = process(made.folder, last="cube")
            run_s = time.perf_counter() - start_s
            errors = position_errors_m(campaign, targets)
            every = 100 * np.concatenate([*errors.values()])
            grid = open_stage(campaign.stage("image", "f01", campaign.image_flights[0].pairs[0]), "image").sizes
            print(
                f"{name} | {len(made.questions)} | {len(found)} | {every.size} "
                f"| {np.median(every):.1f}, {every.max():.1f} | {init_s:.1f}, {run_s:.1f} | {grid['x']} × {grid['y']}",
                flush=True,
            )
            print({pair: np.round(100 * np.array(row), 1).tolist() for pair, row in errors.items()}, file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1:])
