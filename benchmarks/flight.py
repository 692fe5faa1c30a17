"""A whole flight, step by step: wall and CPU seconds, peak memory, and rates beside a plain read, hash and FFT.

``python benchmarks/flight.py WORK --minutes 1 3 10`` simulates `--preset flight` of each length into WORK where it is
not there yet (13 GB for ten minutes), runs every step alone, prints a table, and draws where the CPU seconds went into
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
    """Run what the command line asks for."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("work", type=Path)
    asked.add_argument("--minutes", type=float, nargs="+", default=[1, 3, 10])
    asked.add_argument("--only", nargs="*", default=[], help="steps, such as echo image")
    asked.add_argument("--threads", type=int, default=1)
    given = asked.parse_args()
    for minutes in given.minutes:
        root = given.work / f"flight_{minutes:g}min"
        if not root.exists():
            simulate(root, preset("flight", pulses=round(60 * minutes * PRF_HZ)))
        shutil.rmtree(root / "results/.hashes", ignore_errors=True)  # else recordings are not hashed again
        rows = [measured(root, step, given.threads) for step in steps(root) if not given.only or step[0] in given.only]
        show(root, minutes, rows)


def steps(root: Path) -> list[tuple[str, ...]]:
    """Return the steps of a campaign in order, as `apertura step` takes them."""
    campaign = Campaign.load(root)
    rules = {rule.name: rule for rule in RESULTS.values() if not rule.on_demand}
    return [(rule.command, *where, *rule.last_words) for rule in rules.values() for where in places(campaign, rule)]


def measured(root: Path, step: tuple[str, ...], threads: int) -> dict[str, object]:
    """Run one step in a process of its own; return what it took."""
    if step[0] == "image":  # else its tiles are kept
        shutil.rmtree(root / "results" / step[1] / step[2] / "image.zarr", ignore_errors=True)
    command = [str(Path(sys.executable).with_name("apertura")), "step", *step, "--campaign", str(root)]
    command += ["--threads", str(threads)] * (step[0] in {"image", "layers"})
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} failed")
    return {
        "step": " ".join(step),
        "wall_s": time.perf_counter() - began,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss / 1024,
        "load": os.getloadavg()[0],
    }


def plain(root: Path) -> dict[str, float]:
    """Return bytes recorded, and CPU seconds to read and to hash them, and of one FFT per capture and channel."""
    campaign, found = Campaign.load(root), {"bytes": 0.0, "read_s": 0.0, "hash_s": 0.0, "fft_s": 0.0}
    waveform = campaign.settings.waveform
    length = round(waveform.sample_rate_hz / waveform.subcarrier_spacing_hz)
    for node in campaign.flight(FLIGHT).nodes:
        recording = open_recording(campaign.recording_files(FLIGHT, node))
        start, samples = recording.captures.start, recording.samples
        found["bytes"] += len(samples) * samples.sample_bytes
        for first in range(0, len(start), _AT_ONCE):
            began = time.process_time()
            iq = samples.captures(start[first : first + _AT_ONCE], recording.captures.length)
            found["read_s"] += time.process_time() - began
            if first % (16 * _AT_ONCE) == 0:  # of one block in sixteen
                some = np.ascontiguousarray(np.moveaxis(iq, 2, 0)[:, :, :length], np.float32).view(np.complex64)[..., 0]
                began = time.process_time()
                fft.fft(some, axis=-1)
                found["fft_s"] += 16 * (time.process_time() - began)
                began = time.process_time()
                hashlib.sha256(np.ascontiguousarray(iq))
                found["hash_s"] += 16 * (time.process_time() - began)
    return found


def show(root: Path, minutes: float, rows: list[dict[str, object]]) -> None:
    """Print a table, and write it beside the campaign."""
    bare = plain(root)
    front = sum(float(row["cpu_s"]) for row in rows if str(row["step"]).split()[0] in FRONT)
    print(f"\n{minutes:g} min, {bare['bytes'] / 1e9:.1f} GB recorded")
    print(f"{'step':28}{'wall s':>9}{'CPU s':>9}{'peak MB':>9}{'load':>7}")
    for row in rows:
        print(f"{row['step']:28}{row['wall_s']:9.1f}{row['cpu_s']:9.1f}{row['peak_mb']:9.0f}{row['load']:7.1f}")
    total = {key: sum(float(row[key]) for row in rows) for key in ("wall_s", "cpu_s")}
    print(f"{'all, one by one':28}{total['wall_s']:9.1f}{total['cpu_s']:9.1f}")
    floor = {name: value for name, value in bare.items() if name != "bytes"}
    print("plain " + ", ".join(f"{name.removesuffix('_s')} {value:.1f}" for name, value in floor.items()) + " CPU s")
    if front:
        print(f"front half {front:.1f} CPU s: {bare['bytes'] / front / 1e6:.0f} MB/s per core, ", end="")
        print(f"{front / sum(floor.values()):.1f} × one read, one hash and one FFT of every capture")
    draw(root.with_suffix(".png"), minutes, rows, floor)
    report = {"minutes": minutes, "plain": bare, "steps": rows}
    (root.parent / f"{root.name}.json").write_text(json.dumps(report, indent=1))


def draw(picture: Path, minutes: float, rows: list[dict[str, object]], floor: dict[str, float]) -> None:
    """Draw CPU seconds by step, the jobs of a step side by side; below, what reading, hashing and FFTs alone take."""
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
        axes.barh("(floor)", seconds, left=left, color="0.6", edgecolor="white", label=part)
        left += seconds
    axes.text(left, "(floor)", " one read, hash and FFT of every capture", va="center")
    axes.invert_yaxis()
    axes.set(xlabel="CPU seconds", title=f"{minutes:g} minutes of flight")
    figure.savefig(picture, dpi=120)


if __name__ == "__main__":
    main()
