"""Disturb every step of the pipeline at its calls to the system; each must resume to the bytes of an undisturbed run.

    python -m tests.attack.faults --kills 300 --errors 50 --full 10

Kills are spread evenly over the calls that a step makes below results/; errors are EIO, ENOSPC, EDQUOT, EROFS and
halves of writes; full disks are file systems in memory of little size. Prints a table; ends with an error where a file
is half-written, a message is none or not the only one, or the next run's bytes differ.
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
    ("EIO of a write", FAIL, errno.EIO, WRITE),
    ("disk full from a write on", FAIL_ON, errno.ENOSPC, WRITE | OPEN | MKDIR),
    ("half a write", SHORT, errno.EIO, WRITE),
    ("quota at a write", FAIL_ON, errno.EDQUOT, WRITE),
    ("EIO of an fsync", FAIL, errno.EIO, FSYNC),
    ("read-only from an open on", FAIL_ON, errno.EROFS, OPEN | MKDIR | RENAME),
    ("EIO of a rename", FAIL, errno.EIO, RENAME),
    ("too large a file", FAIL_ON, errno.EFBIG, WRITE | TRUNCATE),
)
"""What is called, what happens, its number, at which calls."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--errors", type=int, default=50)
    parser.add_argument("--full", type=int, default=10)
    parser.add_argument("--steps", nargs="*", default=TARGETS, help="such as 'image f01 uav1-uav2'")
    asked = parser.parse_args()
    if ENVIRONMENT in os.environ:
        raise SystemExit(_campaign_of_faults(asked))
    if compiler() is None:
        raise SystemExit("no C compiler: calls cannot be made to fail")
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tests.attack.faults", *sys.argv[1:]]
        inside = ["unshare", "--mount"] if may_mount() else []
        raise SystemExit(subprocess.run([*inside, *command], env=build(Path(folder)), check=False).returncode)


def may_mount() -> bool:
    """Return whether this user may mount file systems that nobody else sees."""
    command = ["unshare", "--mount", "mount", "-t", "tmpfs", "tmpfs", tempfile.gettempdir()]
    return (
        shutil.which("unshare") is not None
        and subprocess.run(command, capture_output=True, check=False).returncode == 0
    )


def _campaign_of_faults(asked: argparse.Namespace) -> int:
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
        bench, began = Bench(make_campaign(Path(folder).resolve()), shared_page()), time.perf_counter()
        bench.prepare(tuple(asked.steps))
        print(f"undisturbed: {sum(bench.calls.values())} calls in {time.perf_counter() - began:.1f} s", flush=True)
        mounts = may_mount()
        table = Table()
        for step, count in _shares(asked.kills, asked.steps):
            _kill(bench, step, count, table)
        for step, count in _shares(asked.errors, asked.steps):
            _fail(bench, step, count, table)
        for step, count in _shares(asked.full if mounts else 0, tuple(asked.steps)[::-1]):
            for number in range(count):
                free, wrong = bench.full(step, (number + 0.4) / count)
                table.add(step, "full", f"{free // 1024} KiB free", wrong)
        if asked.full and not mounts:
            print("no full disks: this user may not mount")
        return table.print(time.perf_counter() - began)


def _kill(bench: Bench, step: str, count: int, table: "Table") -> None:
    for number in range(count):
        at = 1 + (2 * number + 1) * (bench.calls[step] - 1) // (2 * count)
        killed, wrong = bench.killed(step, at)
        table.add(step, "kill" if killed or wrong else "not met", f"killed at call {at}", wrong)


def _fail(bench: Bench, step: str, count: int, table: "Table") -> None:
    kinds = islice(cycle(ERRORS), table.counts["asked"], None)
    for number, (name, action, error, calls) in zip(range(count), kinds, strict=False):
        table.counts["asked"] += 1
        share, how, wrong = (number + 0.5) / count, "not met", []
        for at in _places(share, bench.calls[step]):
            how, wrong = bench.failed(step, at, action, error=error, kinds=calls)
            if how != "not met":
                break
        table.add(step, "error" if how != "not met" else how, f"{name}, at {at} of its calls: {how}", wrong)


def _places(share: float, calls: int) -> Iterator[int]:
    """Yield a place among the calls, then earlier ones: of some kinds a step makes few."""
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
    """What was tried of each step, and what was wrong."""

    def __init__(self) -> None:
        self.counts: Counter[object] = Counter()
        self.wrong: list[str] = []

    def add(self, step: str, kind: str, what: str, wrong: list[str]) -> None:
        self.counts[step, kind] += 1
        self.wrong += wrong[:1]
        if wrong:
            print(f"WRONG {step}, {what}:", *wrong, sep="\n", flush=True)
        if "went on" in what:
            print(f"{step}, {what}", flush=True)

    def print(self, seconds: float) -> int:
        """Print all of it; return an exit status."""
        print(f"{'step':28} {'kills':>6} {'errors':>6} {'full':>6} {'not met':>8}")
        kinds = ("kill", "error", "full", "not met")
        for step in dict.fromkeys(key[0] for key in self.counts if isinstance(key, tuple)):
            print(
                f"{step:28}",
                *(f"{self.counts[step, kind]:{width}}" for kind, width in zip(kinds, (6, 6, 6, 8), strict=True)),
            )
        sums = [sum(n for key, n in self.counts.items() if isinstance(key, tuple) and key[1] == kind) for kind in kinds]
        print(f"{'all':28} {sums[0]:6} {sums[1]:6} {sums[2]:6} {sums[3]:8}")
        print(f"{len(self.wrong)} wrong of {sum(sums[:3])} in {seconds:.0f} s", flush=True)
        return int(bool(self.wrong))


if __name__ == "__main__":
    main()
