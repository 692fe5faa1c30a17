"""A whole flight, step by step: wall and CPU seconds, peak memory, and rates beside a plain read and a plain FFT.

``python benchmarks/flight.py WORK --minutes 1 3 10`` simulates `--preset flight` of each length into WORK where it is
not there yet (13 GB for ten minutes), runs every step alone, and prints a table (docs/howto/long_flights.md).
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from scipy import fft

from apertura.formats.reading import open_recording
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.lineage import results_of
from apertura.simulation import preset, simulate

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
        rows = [measured(root, step, given.threads) for step in steps(root) if not given.only or step[0] in given.only]
        show(root, minutes, rows)


def steps(root: Path) -> list[tuple[str, ...]]:
    """Return the steps of a campaign in order, as `apertura step` takes them."""
    campaign, found = Campaign.load(root), []
    for name, result in results_of(campaign):
        where = Path(result.manifest).parts[1:-1]
        step = {
            "raw": "ingest",
            "track": "",
            "assessment": "assess",
            "refined_track": "refine",
            "calibration": "calibrate",
            "fused": "export",
        }
        step |= {"refined_track": "refine", "speed_accuracy": "", "whole": ""}
        if step.get(name, name):
            found.append((step.get(name, name), *where))
    return [one if one[0] not in {"scene", "cube", "terrain", "coverage", "map"} else one[:1] for one in found]


def measured(root: Path, step: tuple[str, ...], threads: int) -> dict[str, object]:
    """Run one step in a process of its own; return what it took."""
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
    """Return bytes recorded, and CPU seconds that reading them and one FFT per capture and channel take."""
    campaign, found = Campaign.load(root), {"bytes": 0.0, "read_s": 0.0, "fft_s": 0.0}
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
    return found


def show(root: Path, minutes: float, rows: list[dict[str, object]]) -> None:
    """Print a table, and write it beside the campaign."""
    bare = plain(root)
    front = sum(float(row["cpu_s"]) for row in rows if str(row["step"]).split()[0] in FRONT)
    print(f"\n{minutes:g} min, {bare['bytes'] / 1e9:.1f} GB recorded")
    print(f"{'step':28}{'wall s':>9}{'CPU s':>9}{'peak MB':>9}{'load':>7}")
    for row in rows:
        print(f"{row['step']:28}{row['wall_s']:9.1f}{row['cpu_s']:9.1f}{row['peak_mb']:9.0f}{row['load']:7.1f}")
    print(f"plain read {bare['read_s']:.1f} CPU s, plain FFT {bare['fft_s']:.1f} CPU s")
    if front:
        print(f"front half {front:.1f} CPU s: {bare['bytes'] / front / 1e6:.0f} MB/s per core, ", end="")
        print(f"{front / (bare['read_s'] + bare['fft_s']):.1f} × reading and one FFT of every capture")
    report = {"minutes": minutes, "plain": bare, "steps": rows}
    (root.parent / f"{root.name}.json").write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
