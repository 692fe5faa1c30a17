"""Inject faults into system calls of every pipeline step; the next run must give the bytes of an undisturbed run.

    python -m tests.attack.faults --kills 300 --errors 50 --full 10

Kills are distributed evenly over the calls that a step makes below results/. Errors are EIO, ENOSPC, EDQUOT, EROFS and
partial writes. Full disks are small file systems in memory. Prints a table; exits with an error if a file is
incomplete, a step prints no message or more than one, or the bytes of the next run differ.
"""

import argparse
import errno
import importlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from itertools import cycle, islice
from pathlib import Path

from apertura.workflow.rules import RULES
from tests.attack.faults_campaign import TARGETS, make_campaign
from tests.attack.faults_control import (
    ENVIRONMENT,
    FAIL,
    FAIL_ON,
    FSYNC,
    MKDIR,
    OPEN,
    RENAME,
    SHORT,
    TRUNCATE,
    WRITE,
    build,
    compiler,
    shared_page,
)
from tests.attack.faults_trials import Bench

ERRORS = (
    ("EIO at a write", FAIL, errno.EIO, WRITE),
    ("disk full since a write", FAIL_ON, errno.ENOSPC, WRITE | OPEN | MKDIR),
    ("partial write", SHORT, errno.EIO, WRITE),
    ("quota at a write", FAIL_ON, errno.EDQUOT, WRITE),
    ("EIO at an fsync", FAIL, errno.EIO, FSYNC),
    ("read-only since an open", FAIL_ON, errno.EROFS, OPEN | MKDIR | RENAME),
    ("EIO at a rename", FAIL, errno.EIO, RENAME),
    ("file too large", FAIL_ON, errno.EFBIG, WRITE | TRUNCATE),
)
"""Faults: name, action, error number and kinds of calls."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--errors", type=int, default=50)
    parser.add_argument("--full", type=int, default=10)
    parser.add_argument("--steps", nargs="*", default=TARGETS, help="such as 'image f01 uav1-uav2'")
    arguments = parser.parse_args()
    if ENVIRONMENT in os.environ:
        raise SystemExit(_campaign_of_faults(arguments))
    if compiler() is None:
        raise SystemExit("no C compiler found: system calls cannot be intercepted")
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tests.attack.faults", *sys.argv[1:]]
        inside = ["unshare", "--mount"] if may_mount() else []
        raise SystemExit(subprocess.run([*inside, *command], env=build(Path(folder)), check=False).returncode)


def may_mount() -> bool:
    """Return True if this user may mount file systems in a private namespace."""
    command = ["unshare", "--mount", "mount", "-t", "tmpfs", "tmpfs", tempfile.gettempdir()]
    return (
        shutil.which("unshare") is not None
        and subprocess.run(command, capture_output=True, check=False).returncode == 0
    )


def _campaign_of_faults(arguments: argparse.Namespace) -> int:
    for module in (
        "apertura.cli",
        "matplotlib.pyplot",
        "rasterio",
        "zarr",
        "xarray",
        "scipy.signal",
        "dask.array",
    ):
        importlib.import_module(module)
    for rule in RULES.values():
        if rule.step:
            importlib.import_module(rule.module)
    with tempfile.TemporaryDirectory() as folder:
        bench, start_s = Bench(make_campaign(Path(folder).resolve()), shared_page()), time.perf_counter()
        bench.prepare(tuple(arguments.steps))
        print(f"undisturbed: {sum(bench.calls.values())} calls in {time.perf_counter() - start_s:.1f} s", flush=True)
        mounts = may_mount()
        table = Table()
        for step, count in _shares(arguments.kills, arguments.steps):
            _kill(bench, step, count, table)
        for step, count in _shares(arguments.errors, arguments.steps):
            _fail(bench, step, count, table)
        for step, count in _shares(arguments.full if mounts else 0, tuple(arguments.steps)[::-1]):
            for number in range(count):
                free, wrong = bench.full(step, (number + 0.4) / count)
                table.add(step, "full", f"{free // 1024} KiB free", wrong)
        if arguments.full and not mounts:
            print("no trials with full disks: this user may not mount file systems")
        return table.print(time.perf_counter() - start_s)


def _kill(bench: Bench, step: str, count: int, table: "Table") -> None:
    for number in range(count):
        at = 1 + (2 * number + 1) * (bench.calls[step] - 1) // (2 * count)
        killed, wrong = bench.killed(step, at)
        table.add(step, "kill" if killed or wrong else "not reached", f"killed at call {at}", wrong)


def _fail(bench: Bench, step: str, count: int, table: "Table") -> None:
    kinds = islice(cycle(ERRORS), table.counts["errors started"], None)
    for number, (name, action, error, calls) in zip(range(count), kinds, strict=False):
        table.counts["errors started"] += 1
        share, outcome, wrong = (number + 0.5) / count, "not reached", []
        for at in _earlier_calls(share, bench.calls[step]):
            outcome, wrong = bench.failed(step, at, action, error=error, kinds=calls)
            if outcome != "not reached":
                break
        table.add(step, "error" if outcome != "not reached" else outcome, f"{name}, at call {at}: {outcome}", wrong)


def _earlier_calls(share: float, calls: int) -> Iterator[int]:
    """Yield the number of a call and then of earlier calls, because a step makes few calls of some kinds."""
    at = max(1, int(share * calls))
    while at > 1:
        yield at
        at //= 2
    yield 1


def _shares(total: int, steps: tuple[str, ...]) -> Iterator[tuple[str, int]]:
    for place, step in enumerate(steps):
        count = total * (place + 1) // len(steps) - total * place // len(steps)
        if count:
            yield step, count


class Table:
    """Numbers of trials per step, and their failures."""

    def __init__(self) -> None:
        self.counts: Counter[object] = Counter()
        self.wrong: list[str] = []

    def add(self, step: str, kind: str, what: str, wrong: list[str]) -> None:
        self.counts[step, kind] += 1
        self.wrong += wrong[:1]
        if wrong:
            print(f"FAILED {step}, {what}:", *wrong, sep="\n", flush=True)
        if "continued" in what:
            print(f"{step}, {what}", flush=True)

    def print(self, seconds: float) -> int:
        """Print the table; return an exit status."""
        print(f"{'step':28} {'kills':>6} {'errors':>6} {'full':>6} {'not reached':>12}")
        kinds = ("kill", "error", "full", "not reached")
        for step in dict.fromkeys(key[0] for key in self.counts if isinstance(key, tuple)):
            print(
                f"{step:28}",
                *(f"{self.counts[step, kind]:{width}}" for kind, width in zip(kinds, (6, 6, 6, 12), strict=True)),
            )
        sums = [sum(n for key, n in self.counts.items() if isinstance(key, tuple) and key[1] == kind) for kind in kinds]
        print(f"{'all':28} {sums[0]:6} {sums[1]:6} {sums[2]:6} {sums[3]:12}")
        print(f"{len(self.wrong)} failures in {sum(sums[:3])} trials, {seconds:.0f} s", flush=True)
        return int(bool(self.wrong))


if __name__ == "__main__":
    main()
