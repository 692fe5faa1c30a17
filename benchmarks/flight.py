"""Run time and peak memory of each step of a whole flight, compared with the time to read, hash and transform its data.

``python benchmarks/flight.py WORK --minutes 1 3 10`` simulates `--preset flight` of each length into WORK unless it
exists (13 GB for ten minutes), runs every step separately, prints a table, and draws the CPU seconds per step into
WORK/flight_<minutes>min.png (docs/howto/long_flights.md).
"""

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import matplotlib
import numpy as np
from scipy import fft

matplotlib.use("agg")
from matplotlib import pyplot as plt

from apertura.campaign.folder import Campaign
from apertura.formats.reading import open_recording
from apertura.simulation import preset, simulate
from apertura.workflow.lineage import places
from apertura.workflow.rules import RESULTS

PRF_HZ = 500
FLIGHT = "f01"
FRONT = ("ingest", "echo", "profile")
_AT_ONCE = 64


def main() -> None:
    """Run the requested flights and steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--minutes", type=float, nargs="+", default=[1, 3, 10])
    parser.add_argument("--only", nargs="*", default=[], help="steps, such as echo image")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    for minutes in options.minutes:
        root = options.work / f"flight_{minutes:g}min"
        if not root.exists():
            simulate(root, preset("flight", pulses=round(60 * minutes * PRF_HZ)))
        shutil.rmtree(root / "results/.hashes", ignore_errors=True)  # forces the hashing of recordings
        selected = [step for step in steps(root) if not options.only or step[0] in options.only]
        show(root, minutes, [measured(root, step, options.threads) for step in selected])


def steps(root: Path) -> list[tuple[str, ...]]:
    """Return the steps of a campaign in order, as arguments of `apertura step`."""
    campaign = Campaign.load(root)
    rules = {rule.name: rule for rule in RESULTS.values() if not rule.on_demand}
    return [(rule.command, *where, *rule.last_words) for rule in rules.values() for where in places(campaign, rule)]


def measured(root: Path, step: tuple[str, ...], threads: int) -> dict[str, object]:
    """Run one step in a separate process; return its run time and memory."""
    if step[0] == "image":  # forces the recomputation of tiles
        shutil.rmtree(root / "results" / step[1] / step[2] / "image.zarr", ignore_errors=True)
    command = [str(Path(sys.executable).with_name("apertura")), "step", *step, "--campaign", str(root)]
    command += ["--threads", str(threads)] * (step[0] in {"image", "layers"})
    start_s = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} failed")
    return {
        "step": " ".join(step),
        "wall_s": time.perf_counter() - start_s,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss / 1024,
        "load": os.getloadavg()[0],
    }


def plain(root: Path) -> dict[str, float]:
    """Return the bytes recorded, and CPU seconds to read and hash them, and for one FFT per capture and channel."""
    campaign, costs = Campaign.load(root), {"bytes": 0.0, "read_s": 0.0, "hash_s": 0.0, "fft_s": 0.0}
    waveform = campaign.settings.waveform
    length = round(waveform.sample_rate_hz / waveform.subcarrier_spacing_hz)
    for node in campaign.flight(FLIGHT).nodes:
        recording = open_recording(campaign.recording_files(FLIGHT, node))
        start, samples = recording.captures.start, recording.samples
        costs["bytes"] += len(samples) * samples.sample_bytes
        for first in range(0, len(start), _AT_ONCE):
            start_s = time.process_time()
            iq = samples.captures(start[first : first + _AT_ONCE], recording.captures.length)
            costs["read_s"] += time.process_time() - start_s
            if first % (16 * _AT_ONCE) == 0:  # one block in sixteen is measured
                block = np.ascontiguousarray(np.moveaxis(iq, 2, 0)[:, :, :length], np.float32)
                symbols = block.view(np.complex64)[..., 0]
                start_s = time.process_time()
                fft.fft(symbols, axis=-1)
                costs["fft_s"] += 16 * (time.process_time() - start_s)
                start_s = time.process_time()
                hashlib.sha256(np.ascontiguousarray(iq))
                costs["hash_s"] += 16 * (time.process_time() - start_s)
    return costs


def show(root: Path, minutes: float, rows: list[dict[str, object]]) -> None:
    """Print a table, and write it next to the campaign."""
    bare = plain(root)
    front = sum(float(row["cpu_s"]) for row in rows if str(row["step"]).split()[0] in FRONT)
    print(f"\n{minutes:g} min, {bare['bytes'] / 1e9:.1f} GB recorded")
    print(f"{'step':28}{'wall s':>9}{'CPU s':>9}{'peak MB':>9}{'load':>7}")
    for row in rows:
        print(f"{row['step']:28}{row['wall_s']:9.1f}{row['cpu_s']:9.1f}{row['peak_mb']:9.0f}{row['load']:7.1f}")
    total = {key: sum(float(row[key]) for row in rows) for key in ("wall_s", "cpu_s")}
    print(f"{'sum of all steps':28}{total['wall_s']:9.1f}{total['cpu_s']:9.1f}")
    floor = {name: value for name, value in bare.items() if name != "bytes"}
    print(
        "reference " + ", ".join(f"{name.removesuffix('_s')} {value:.1f}" for name, value in floor.items()) + " CPU s"
    )
    if front:
        rate = bare["bytes"] / front / 1e6
        print(f"{', '.join(FRONT)}: {front:.1f} CPU s, {rate:.0f} MB/s per core, ", end="")
        print(f"{front / sum(floor.values()):.1f} × the time of one read, hash and FFT of every capture")
    draw(root.with_suffix(".png"), minutes, rows, floor)
    report = {"minutes": minutes, "plain": bare, "steps": rows}
    (root.parent / f"{root.name}.json").write_text(json.dumps(report, indent=1))


def draw(picture: Path, minutes: float, rows: list[dict[str, object]], floor: dict[str, float]) -> None:
    """Draw CPU seconds by step, divided into jobs; below, the reference for reading, hashing and FFTs."""
    names = list(dict.fromkeys(str(row["step"]).split()[0] for row in rows))
    figure, axes = plt.subplots(figsize=(6.4, 0.3 * len(names) + 1.6), layout="constrained")
    for name in names:
        left = 0.0
        for row in (row for row in rows if str(row["step"]).split()[0] == name):
            axes.barh(name, float(row["cpu_s"]), left=left, color="tab:blue", edgecolor="white")
            left += float(row["cpu_s"])
        axes.text(left, name, f" {left:.0f}", va="center")
    left = 0.0
    for part, seconds in floor.items():
        axes.barh("(reference)", seconds, left=left, color="0.6", edgecolor="white", label=part)
        left += seconds
    axes.text(left, "(reference)", " one read, hash and FFT of every capture", va="center")
    axes.invert_yaxis()
    axes.set(xlabel="CPU seconds", title=f"{minutes:g} minutes of flight")
    figure.savefig(picture, dpi=120)


if __name__ == "__main__":
    main()
