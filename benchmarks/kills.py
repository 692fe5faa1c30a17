"""Kill whole runs at random moments, resume each, and compare every product of the finished campaign.

    python benchmarks/kills.py [CAMPAIGN] [KILLS] [SEED]

Without a folder, or with '-', the campaign is a small simulated one: 48 x 48 pixels in nine tiles of two pairs. A run
gets SIGKILL after a random share of the time that an undisturbed run takes, with all that it has started or, three
times of ten, alone: then its steps live on beside the next run's. What resumes it is killed too, until KILLS (16) are
spent. Whenever a run gets through, its results are compared byte for byte with the undisturbed ones, logs, timings and
hidden files left out, and the next begins from nothing. Ends with an error where they differ.
"""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import yaml

APERTURA = Path(sys.executable).parent / "apertura"


def small(folder):
    """Simulate the campaign that is killed by default."""
    from apertura.simulation import ImageGrid, preset, simulate

    plan = replace(preset("demo", pulses=24), scene=ImageGrid("EPSG:32632", half_width_m=1.2, spacing_m=0.05))
    root = simulate(folder / "small", plan, seed=3)
    config = root / "config" / "config.yaml"
    config.write_text(config.read_text() + yaml.safe_dump({"processing": {"tile_px": 16}}))
    return root


def start(root):
    command = [APERTURA, "run", root, "--cores", "2"]
    with root.with_suffix(".log").open("w") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)


def finish(process, root):
    if process.wait():
        sys.exit(f"the run failed:\n{root.with_suffix('.log').read_text()}")


def products(root):
    """Return path → bytes of all results but logs, timings, and hidden files and folders."""
    results, found = root / "results", {}
    for path in results.rglob("*"):
        name = path.relative_to(results)
        hidden = any(part.startswith(".") for part in name.parts)
        if path.is_file() and not hidden and name.parts[0] not in {"logs", "benchmarks"}:
            found[name] = path.read_bytes()
    return found


def compare(root, expected):
    made = products(root)
    differ = sorted(str(path) for path in made.keys() | expected.keys() if made.get(path) != expected.get(path))
    if differ:
        sys.exit(f"{len(differ)} of {len(expected)} files differ: {', '.join(differ[:5])}")


def copy(campaign, root):
    shutil.copytree(campaign, root, ignore=shutil.ignore_patterns("results", ".snakemake"))
    return root


def killed(process, wait_s, root, *, alone):
    """Kill a run after some time, `alone` or with all that it has started; return whether it still ran."""
    try:
        process.wait(wait_s)
        return False
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        while others := [] if alone else steps_of(root):
            for number in others:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(number, signal.SIGKILL)
        return True


def steps_of(root):
    """Return the processes that work in a campaign folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state = (path / "stat").read_text().rpartition(")")[2].split()[0]
            if state != "Z" and (path / "cwd").readlink() == root.resolve():
                found.append(int(path.name))
    return found


def main():
    campaign, kills, seed = [*sys.argv[1:], *("-", "16", "1")[len(sys.argv) - 1 :]]
    moment, spent, through, began = random.Random(int(seed)), 0, 0, time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        campaign = small(Path(folder)) if campaign == "-" else Path(campaign)
        root = copy(campaign, Path(folder) / "campaign")
        first = time.perf_counter()
        finish(start(root), root)
        whole_s = time.perf_counter() - first
        expected = products(root)
        print(f"undisturbed: {len(expected)} files in {whole_s:.1f} s", flush=True)
        shutil.rmtree(root)
        while spent < int(kills):
            copy(campaign, root)
            while killed(
                process := start(root),
                wait_s := moment.uniform(0.1, 0.6) * whole_s,
                root,
                alone=(alone := moment.random() < 0.3),
            ):
                spent += 1
                what = "apertura run alone" if alone else "the run with all its steps"
                print(f"kill {spent} after {wait_s:.1f} s, {what}: {len(products(root))} files", flush=True)
                if spent == int(kills):
                    process = start(root)
                    break
            finish(process, root)
            compare(root, expected)
            through += 1
            print("resumed to identical bytes", flush=True)
            shutil.rmtree(root)
    seconds = time.perf_counter() - began
    print(f"{spent} kills of {through} runs, identical bytes after all; {seconds / max(1, spent):.1f} s a kill")


if __name__ == "__main__":
    main()
