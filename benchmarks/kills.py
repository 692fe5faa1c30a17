"""Kill whole runs at random moments, resume each, and compare every product of the finished campaign.

    python benchmarks/kills.py [CAMPAIGN] [KILLS] [SEED]

Without a folder, or with '-', the campaign is a small simulated one: 48 x 48 pixels in nine tiles, two pairs. A run
receives SIGKILL after a random fraction of the duration of an undisturbed run, together with all processes that the run
has started. In three of ten cases, these processes are not killed: the steps of the run then continue in parallel with
the steps of the next run. Resumed runs are also killed until the number of KILLS (16) is reached. When a run finishes,
its results are compared byte for byte with the undisturbed results, without logs, timings and hidden files, and the
next run starts from the beginning. Exits with an error if results differ.
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
    """Simulate the default campaign."""
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
    """Read all results as path → bytes, without logs, timings, and hidden files and folders."""
    results, contents = root / "results", {}
    for path in results.rglob("*"):
        name = path.relative_to(results)
        hidden = any(part.startswith(".") for part in name.parts)
        if path.is_file() and not hidden and name.parts[0] not in {"logs", "benchmarks"}:
            contents[name] = path.read_bytes()
    return contents


def compare(root, expected):
    actual = products(root)
    differ = sorted(str(path) for path in actual.keys() | expected.keys() if actual.get(path) != expected.get(path))
    if differ:
        sys.exit(f"{len(differ)} of {len(expected)} files differ: {', '.join(differ[:5])}")


def copy(campaign, root):
    shutil.copytree(campaign, root, ignore=shutil.ignore_patterns("results", ".snakemake"))
    return root


def killed(process, wait_s, root, *, alone):
    """Kill a run after `wait_s`, `alone` or with all its child processes; return True if it was still running."""
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
    """Return the IDs of the processes that work in a campaign folder."""
    numbers = []
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state = (path / "stat").read_text().rpartition(")")[2].split()[0]
            if state != "Z" and (path / "cwd").readlink() == root.resolve():
                numbers.append(int(path.name))
    return numbers


def main():
    campaign, kills, seed = [*sys.argv[1:], *("-", "16", "1")[len(sys.argv) - 1 :]]
    generator, spent, finished, start_s = random.Random(int(seed)), 0, 0, time.perf_counter()
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
                wait_s := generator.uniform(0.1, 0.6) * whole_s,
                root,
                alone=(alone := generator.random() < 0.3),
            ):
                spent += 1
                target = "apertura run without its steps" if alone else "apertura run with all its steps"
                print(f"kill {spent} after {wait_s:.1f} s, {target}: {len(products(root))} files", flush=True)
                if spent == int(kills):
                    process = start(root)
                    break
            finish(process, root)
            compare(root, expected)
            finished += 1
            print("resumed: results are identical", flush=True)
            shutil.rmtree(root)
    seconds = time.perf_counter() - start_s
    print(f"{spent} kills of {finished} runs, all results identical; {seconds / max(1, spent):.1f} s per kill")


if __name__ == "__main__":
    main()
