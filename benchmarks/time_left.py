"""Accuracy of the remaining time that a run reports: `python benchmarks/time_left.py CAMPAIGN OUT.png`.

Runs `apertura run CAMPAIGN` from its raw files (existing results are removed), records the time of every line that
reports a remaining time, and draws reported against true remaining times. The rows are written to a .csv next to the
plot. A summary is printed: wall-clock and CPU seconds, peak memory of the largest process, and the largest factor
between reported and true times while at least 10 s remain.
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
"""Remaining seconds below which reported times are rounded to seconds, so that no factor is computed."""


def main() -> None:
    """Run the campaign, measure and draw."""
    campaign, picture = Path(sys.argv[1]), Path(sys.argv[2])
    apertura = Path(sys.executable).with_name("apertura")
    if (campaign / "results").exists():
        subprocess.run([apertura, "clean", campaign, "--yes"], check=True, stdout=subprocess.DEVNULL)
    start_s = time.perf_counter()
    rows, unknown_until_s = [], 0.0
    with subprocess.Popen([apertura, "run", campaign, "--cores", "2"], text=True, stderr=subprocess.PIPE) as run:
        for line in run.stderr or ():
            now = time.perf_counter() - start_s
            match = _LEFT.search(line.rstrip())
            if match:
                rows.append((now, float(match[1]) * _UNITS[match[2]], line.split("  ")[2].split(":")[0].strip()))
            elif "time left unknown" in line:
                unknown_until_s = now
    whole = time.perf_counter() - start_s
    if run.returncode:
        raise SystemExit(f"the run failed with exit status {run.returncode}")
    with picture.with_suffix(".csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["after_s", "reported_s", "true_s", "step"])
        table.writerows([f"{now:.1f}", f"{reported:.0f}", f"{whole - now:.1f}", step] for now, reported, step in rows)
    draw(rows, whole, picture)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    factors = [
        max(reported / (whole - now), (whole - now) / reported) for now, reported, _ in rows if whole - now >= _LEAST_S
    ]
    print(f"wall {whole:.1f} s, CPU {used.ru_utime + used.ru_stime:.1f} s, peak {used.ru_maxrss / 1024:.0f} MB")
    largest = f"{max(factors):.1f}" if factors else "-"
    print(
        f"unknown until {unknown_until_s:.1f} s, {len(rows)} reports; largest factor between reported and true time: "
        f"{largest}"
    )


def draw(rows: list[tuple[float, float, str]], whole: float, picture: Path) -> None:
    """Draw reported and true remaining times against the time since the start of the run, in seconds."""
    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    axes.plot([0, whole], [whole, 0], color="0.5", label="true")
    axes.fill_between([0, whole], [2 * whole, 0], [whole / 2, 0], color="0.9", label="within a factor of 2")
    axes.plot([now for now, _, _ in rows], [reported for _, reported, _ in rows], "o", ms=4, label="reported")
    axes.set(xlabel="time since start (s)", ylabel="remaining time (s)", xlim=(0, whole), ylim=(0, None))
    axes.legend()
    figure.savefig(picture, dpi=120)


if __name__ == "__main__":
    main()
