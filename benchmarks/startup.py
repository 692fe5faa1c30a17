"""Start-up cost in CPU seconds: import, `--help`, the demo's pipeline, and each of its steps.

    python benchmarks/startup.py [CAMPAIGN]

CAMPAIGN, a folder simulated by `apertura simulate`, is copied; if it is omitted, the demo is simulated. The steps are
the commands printed by snakemake, repeated on the finished campaign: each time includes start, imports, opening of
files and the demo's small computation. Times are user and system time of a command and its children, the minimum of
three.
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
    """Run a command repeatedly; return its minimum CPU and wall-clock seconds, and its last output."""
    figures = []
    for _ in range(repeats):
        before, start_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        process = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
        after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - start_s
        if process.returncode:
            sys.exit(f"{' '.join(map(str, command))}\n{process.stdout}{process.stderr}")
        figures.append((after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, wall))
    return (*map(min, zip(*figures, strict=True)), process.stdout + process.stderr)


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
        show("apertura run demo, results up to date", *cpu_s(apertura, "run", str(demo), "--cores", "2", repeats=1)[:2])
        steps = re.findall(r"^\s*(?:Shell command: )?apertura (step .*?) > ", printed, re.MULTILINE)
        total = 0.0
        for step in sorted(set(steps), key=steps.index):
            cpu, wall, _ = cpu_s(apertura, *step.split(), cwd=demo)
            show(f"apertura {step}", cpu, wall)
            total += cpu
        show(f"sum of {len(set(steps))} steps", total, 0.0)


if __name__ == "__main__":
    main()
