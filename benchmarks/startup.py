"""CPU seconds before anything is computed: importing, `--help`, the demo's pipeline, and each of its steps alone.

    python benchmarks/startup.py [CAMPAIGN]

CAMPAIGN, made by `apertura simulate`, is copied; without it the demo is simulated. Steps are the commands that
snakemake prints, run once more on the finished campaign: each figure is start, imports, opening and the demo's small
computation. User and system time of the command and its children, the least of three.
"""

import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

BIN = Path(sys.executable).parent
REPEATS = 3


def cpu_s(*command, cwd=None, repeats=REPEATS):
    """Return the least CPU and wall seconds of a command, and what it printed last."""
    figures = []
    for _ in range(repeats):
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
        after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - began
        if done.returncode:
            sys.exit(f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}")
        figures.append((after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, wall))
    return (*map(min, zip(*figures, strict=True)), done.stdout + done.stderr)


def show(name, cpu, wall):
    print(f"{name:<58}{cpu:>8.2f}{wall:>8.2f}", flush=True)


def main():
    apertura = str(BIN / "apertura")
    print(f"{'':<58}{'CPU s':>8}{'wall s':>8}")
    show("python -c 'import apertura'", *cpu_s(sys.executable, "-c", "import apertura")[:2])
    show("apertura --help", *cpu_s(apertura, "--help")[:2])
    with tempfile.TemporaryDirectory() as folder:
        demo = Path(folder) / "demo"
        if sys.argv[1:]:
            shutil.copytree(sys.argv[1], demo)
        else:
            cpu_s(apertura, "simulate", str(demo), repeats=1)
        cpu, wall, printed = cpu_s(apertura, "run", str(demo), "--cores", "2", repeats=1)
        show("apertura run demo --cores 2", cpu, wall)
        show("the same, nothing to do", *cpu_s(apertura, "run", str(demo), "--cores", "2", repeats=1)[:2])
        steps = re.findall(r"^\s*(?:Shell command: )?apertura (step .*?) > ", printed, re.MULTILINE)
        total = 0.0
        for step in sorted(set(steps), key=steps.index):
            cpu, wall, _ = cpu_s(apertura, *step.split(), cwd=demo)
            show(f"apertura {step}", cpu, wall)
            total += cpu
        show(f"{len(set(steps))} steps together", total, 0.0)


if __name__ == "__main__":
    main()
