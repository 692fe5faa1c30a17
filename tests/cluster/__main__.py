"""A campaign on a real Slurm of two nodes: one job cancelled, one node drained, one killed.

    python -m tests.cluster [FOLDER]

Simulates the campaign, runs one copy locally and one on the cluster with ``profiles/slurm`` and disturbances, and
compares every product byte for byte. The copy on the cluster contains markers of every kind (`tests.attack.planted`),
and the run starts in it: no marker may fire. Without Slurm, the program prints the missing requirement and stops. Exits
with an error if the run fails, a marker fires or bytes differ.
"""

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import yaml

from tests.attack.planted import plant
from tests.cluster import slurm

ROOT = Path(__file__).parents[2]
APERTURA = Path(sys.executable).parent / "apertura"
RULES = ("tiles", "image")
"""Rules whose jobs last long enough to be disturbed while they run."""


def main() -> None:
    plugin = importlib.util.find_spec("snakemake_executor_plugin_slurm")
    reason = slurm.missing() or (None if plugin else "pip install 'apertura[slurm]'")
    if reason:
        print(f"no cluster test: {reason}")
        return
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda received, _: sys.exit(128 + received))  # so that the scratch folder is removed
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(sys.argv[1] if sys.argv[1:] else scratch)
        campaign = simulated(folder)
        expected = products(run_locally(Path(shutil.copytree(campaign, folder / "local"))))
        planted = plant(Path(shutil.copytree(campaign, folder / "cluster")))
        with slurm.running(folder / "slurm"), planted.fires() as fired:
            from_cluster = products(disturbed(planted.root, folder))
        report(folder / "slurm" / "jobs.log")
    took_s = time.perf_counter() - began
    busy = 100 * sum(os.times()[:4]) / took_s / (os.cpu_count() or 1)
    load = os.getloadavg()[2]
    print(f"total {took_s:.0f} s; CPU use without Slurm's jobs {busy:.0f} %, load {load:.1f}")
    if fired:
        sys.exit(f"{len(fired)} markers of the campaign folder fired: {', '.join(fired[:5])}")
    print(f"{len(planted.watched)} markers in the campaign folder, none fired", flush=True)
    differ = sorted(
        str(name) for name in from_cluster.keys() | expected.keys() if from_cluster.get(name) != expected.get(name)
    )
    if differ:
        sys.exit(f"{len(differ)} of {len(expected)} files differ: {', '.join(differ[:5])}")
    print(f"{len(from_cluster)} files, identical to those of the local run")


def simulated(folder: Path) -> Path:
    """Simulate a flight whose images take several seconds: double sum in many tiles."""
    from apertura.simulation import ImageGrid, preset, simulate

    plan = replace(preset("demo", pulses=60), scene=ImageGrid("EPSG:32632", half_width_m=6.0, spacing_m=0.03))
    root = simulate(folder / "campaign", plan, seed=3)
    config = root / "config" / "config.yaml"
    choices = {"processing": {"tile_px": 32, "engine": "reference"}}
    config.write_text(config.read_text(encoding="utf-8") + yaml.safe_dump(choices), encoding="utf-8")
    return root


def run_locally(root: Path) -> Path:
    began = time.perf_counter()
    subprocess.run([APERTURA, "run", root, "--cores", "2"], check=True, capture_output=True)
    print(f"on this machine: {time.perf_counter() - began:.0f} s", flush=True)
    return root


def disturbed(root: Path, folder: Path) -> Path:
    """Run a campaign on the cluster with a cancelled job, a drained node and a killed node."""
    began, log = time.perf_counter(), folder / "run.log"
    command = [APERTURA, "run", root, "--cores", "2", "--profile", ROOT / "profiles" / "slurm"]
    command += ["--set-scatter", "tiles=2", "--latency-wait", "5"]
    with log.open("w") as output:
        run = subprocess.Popen(command, cwd=root, stdout=output, stderr=subprocess.STDOUT)
    try:
        for disturb in (cancel_a_job, drain_a_node, kill_a_node):
            done = disturb(folder / "slurm", run.poll)
            print(f"{time.perf_counter() - began:4.0f} s: {done}", flush=True)
        status = run.wait(600)
    except BaseException:
        run.terminate()
        run.wait(60)
        sys.stderr.write(log.read_text())
        raise
    print(f"on the cluster: {time.perf_counter() - began:.0f} s, status {status}", flush=True)
    if status:
        sys.exit(log.read_text())
    return root


def cancel_a_job(_: Path, ended: Callable[[], int | None]) -> str:
    job, node = wait_for_job(ended)
    slurm.output_of("scancel", job)
    return f"job {job} on {node} cancelled"


def drain_a_node(_: Path, ended: Callable[[], int | None]) -> str:
    job, node = wait_for_job(ended)
    slurm.drain(node)
    slurm.wait_for("drained", lambda: slurm.state(node) == "drained", 120)
    slurm.resume(node)
    return f"{node} drained during job {job}, which finished, and resumed"


def kill_a_node(root: Path, ended: Callable[[], int | None]) -> str:
    job, node = wait_for_job(ended)
    slurm.kill(root, node)
    slurm.wait_for("down", lambda: slurm.state(node) == "down", 120)
    slurm.start(node)
    slurm.wait_for("up", lambda: slurm.state(node) in {"idle", "mixed", "allocated"})
    return f"{node} killed with job {job}, reported as down by the controller, and restarted"


def wait_for_job(ended: Callable[[], int | None]) -> tuple[str, str]:
    """Wait until a job of a long rule runs; return the job and its node."""
    found: dict[str, str] = {}

    def is_running() -> bool:
        if ended() is not None:
            raise RuntimeError("the run finished before it was disturbed")
        for rule in RULES:
            found.update(slurm.jobs(rule))
        return bool(found)

    slurm.wait_for("a job", is_running, 300)
    return next(iter(found.items()))


def products(root: Path) -> dict[Path, bytes]:
    """Return the contents of all results except logs, timings and hidden files and folders."""
    results = root / "results"
    files = [(path.relative_to(results), path) for path in results.rglob("*") if path.is_file()]
    kept = [(name, path) for name, path in files if name.parts[0] not in {"logs", "benchmarks"}]
    return {name: path.read_bytes() for name, path in kept if not any(part.startswith(".") for part in name.parts)}


def report(jobs: Path) -> None:
    """Print the number of jobs per final state."""
    ends: dict[str, int] = {}
    for line in jobs.read_text().splitlines():
        state = line.split("JobState=")[1].split()[0]
        ends[state] = ends.get(state, 0) + 1
    print("jobs of Slurm: " + ", ".join(f"{count} {state}" for state, count in sorted(ends.items())))


if __name__ == "__main__":
    main()
