"""What a run said of its time left, against what was left: `python benchmarks/time_left.py CAMPAIGN OUT.png`.

Runs `apertura run CAMPAIGN` from its raw files (existing results are removed), takes the time of every line that tells
a time left, and draws told against true; rows stand beside the picture in a .csv, and a summary on the screen: wall and
CPU seconds, the peak of the largest process, and the worst factor between told and true while 10 s or more are left.
"""

import csv
import re
import resource
import subprocess
import sys
import time
from pathlib import Path

import matplotlib

matplotlib.use("agg")
from matplotlib import pyplot as plt

_UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0}
_LEFT = re.compile(r"about ([\d.]+) (s|min|h) left$")
_LEAST_S = 10.0
"""Seconds left below which a run rounds to seconds: no factor is told."""


def main() -> None:
    """Run, measure, draw."""
    campaign, picture = Path(sys.argv[1]), Path(sys.argv[2])
    apertura = Path(sys.executable).with_name("apertura")
    if (campaign / "results").exists():
        subprocess.run([apertura, "clean", campaign, "--yes"], check=True, stdout=subprocess.DEVNULL)
    began = time.perf_counter()
    rows, unknown = [], 0.0
    with subprocess.Popen([apertura, "run", campaign, "--cores", "2"], text=True, stderr=subprocess.PIPE) as run:
        for line in run.stderr or ():
            now = time.perf_counter() - began
            told = _LEFT.search(line.rstrip())
            if told:
                rows.append((now, float(told[1]) * _UNITS[told[2]], line.split("  ")[2].split(":")[0].strip()))
            elif "time left unknown" in line:
                unknown = now
    whole = time.perf_counter() - began
    if run.returncode:
        raise SystemExit(f"the run ended with {run.returncode}")
    with picture.with_suffix(".csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["after_s", "told_s", "true_s", "step"])
        table.writerows([f"{now:.1f}", f"{told:.0f}", f"{whole - now:.1f}", step] for now, told, step in rows)
    draw(rows, whole, picture)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    factors = [max(told / (whole - now), (whole - now) / told) for now, told, _ in rows if whole - now >= _LEAST_S]
    print(f"wall {whole:.1f} s, CPU {used.ru_utime + used.ru_stime:.1f} s, peak {used.ru_maxrss / 1024:.0f} MB")
    print(f"unknown until {unknown:.1f} s, {len(rows)} times told; told / true or its inverse at most", end=" ")
    print(f"{max(factors):.1f}" if factors else "-")


def draw(rows: list[tuple[float, float, str]], whole: float, picture: Path) -> None:
    """Draw what was told and what was true against the time since the run began, both in seconds."""
    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    axes.plot([0, whole], [whole, 0], color="0.5", label="true")
    axes.fill_between([0, whole], [2 * whole, 0], [whole / 2, 0], color="0.9", label="within a factor of 2")
    axes.plot([now for now, _, _ in rows], [told for _, told, _ in rows], "o", ms=4, label="told")
    axes.set(xlabel="since the run began (s)", ylabel="time left (s)", xlim=(0, whole), ylim=(0, None))
    axes.legend()
    figure.savefig(picture, dpi=120)


if __name__ == "__main__":
    main()
