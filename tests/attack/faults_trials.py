"""Trials: a step that is disturbed at one call, and the step again; what it left, what it said, what it made."""

import errno
import faulthandler
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from tests.attack.faults_campaign import STEPS, TARGETS
from tests.attack.faults_control import COUNT, KILL, Page, arm, disarm

ROOM = 1 << 30
PAGE = 4096

LIMIT_S = 30
"""A step takes a second; one that takes longer hangs."""


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit status, or minus the signal that killed it, and what it said."""

    status: int
    said: str

    @property
    def faults(self) -> list[str]:
        """What is wrong with how it told an error of the machine."""
        errors = re.findall(r"^error: .*", self.said, re.MULTILINE)
        wrong = [] if self.status == 2 else [f"exit status {self.status}"]
        wrong += [] if len(errors) == 1 else [f"{len(errors)} messages"]
        return wrong + (["a traceback"] if "Traceback" in self.said else [])


@dataclass
class Bench:
    """A campaign with its results before and after every step, undisturbed.

    Attributes
    ----------
    root
        The campaign; its results are those of the trial.
    page
        What shall happen to calls.
    before, after, calls
        Step → folder that holds the results before it; files after it; how many calls it made.
    """

    root: Path
    page: Page
    before: dict[str, Path] = field(default_factory=dict)
    after: dict[str, dict[str, bytes]] = field(default_factory=dict)
    calls: dict[str, int] = field(default_factory=dict)

    @property
    def results(self) -> Path:
        return self.root / "results"

    def prepare(self, targets: tuple[str, ...] = TARGETS) -> None:
        """Run every step up to the last of some once, undisturbed; keep what the trials of those need."""
        self.results.mkdir()
        for step in STEPS[: 1 + max(map(STEPS.index, targets))]:
            if step in targets:
                self.before[step] = self.root.parent / f"before {step}"
                shutil.copytree(self.results, self.before[step])
            arm(self.page, self.results, COUNT)
            ended = self.run(step, limit_s=10 * LIMIT_S)  # in a fresh clone it compiles first
            if ended.status:
                raise RuntimeError(f"{step} fails undisturbed:\n{ended.said}")
            self.calls[step], self.after[step] = self.page.count, files(self.results)

    def reset(self, step: str) -> None:
        """Bring the results back to what they were before a step; the folder itself may be a file system of its own."""
        self.results.mkdir(exist_ok=True)
        for path in self.results.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        shutil.copytree(self.before[step], self.results, dirs_exist_ok=True)

    def run(self, step: str, *, limit_s: float = LIMIT_S) -> Ended:
        """Run a step in a child of this process, which has imported everything, with what is on the page."""
        with tempfile.TemporaryFile() as said:
            child = os.fork()
            if not child:
                os.dup2(said.fileno(), 1)
                os.dup2(said.fileno(), 2)
                faulthandler.dump_traceback_later(limit_s, exit=True, file=2)
                os._exit(_command(["apertura", "step", *step.split(), "--campaign", str(self.root)]))
            _, status = os.waitpid(child, 0)
            disarm(self.page)
            said.seek(0)
            return Ended(os.waitstatus_to_exitcode(status), said.read().decode(errors="replace"))

    def half_written(self, step: str) -> list[str]:
        """Return files with a final name that are not what the undisturbed step leaves."""
        expected = self.after[step]
        there = {name: content for name, content in files(self.results).items() if ".wip/" not in name}
        return [f"{name} is half-written" for name, content in there.items() if expected.get(name) != content]

    def again(self, step: str) -> list[str]:
        """Run the step undisturbed; return what is wrong with what it makes."""
        ended = self.run(step)
        if ended.status:
            return [f"the next run ends with {ended.status}: {ended.said[-2000:]}"]
        made, expected = files(self.results), self.after[step]
        return [f"{name} differs" for name in sorted(made.keys() | expected) if made.get(name) != expected.get(name)]

    def killed(self, step: str, at: int) -> tuple[bool, list[str]]:
        """Kill a step at a call, run it again; return whether it was killed, and what is wrong."""
        self.reset(step)
        arm(self.page, self.results, KILL, at=at)
        ended = self.run(step)
        return ended.status == -9, self.half_written(step) + self.again(step)

    def failed(self, step: str, at: int, action: int, *, error: int, kinds: int) -> tuple[str, list[str]]:
        """Let a call of a step fail, run it again; return how it ended, and what is wrong."""
        self.reset(step)
        arm(self.page, self.results, action, at=at, error=error, kinds=kinds)
        ended = self.run(step)
        if not self.page.struck:
            return "not met", []
        how = "went on" if ended.status == 0 else "said so"
        wrong = ended.faults if ended.status else []
        wrong = [f"{', '.join(wrong)}:\n{ended.said[-3000:]}"] if wrong else []
        return how, wrong + self.half_written(step) + self.again(step)

    def full(self, step: str, share: float) -> tuple[int, list[str]]:
        """Run a step on a disk with room for a share of what it writes, then again with room; as `failed`.

        Returns the bytes that were free, and what is wrong.
        """
        grows = sum(map(len, self.after[step].values())) - sum(map(len, files(self.before[step]).values()))
        _mount(self.results, ROOM)
        try:
            self.reset(step)
            used = shutil.disk_usage(self.results).used
            free = int(share * grows) // PAGE * PAGE
            while True:
                _mount(self.results, used + free, again=True)
                ended = self.run(step)
                if ended.status or not free:
                    break
                free = free // 2 // PAGE * PAGE
                _mount(self.results, ROOM, again=True)
                self.reset(step)
            wrong = ended.faults
            if os.strerror(errno.ENOSPC) not in ended.said:
                wrong.append("the full disk is not named")
            wrong = [f"{', '.join(wrong)}:\n{ended.said[-3000:]}"] if wrong else []
            wrong += self.half_written(step)
            _mount(self.results, ROOM, again=True)
            return free, wrong + self.again(step)
        finally:
            subprocess.run(["umount", self.results], check=True)


def files(folder: Path) -> dict[str, bytes]:
    """Return path → bytes of what a run makes: all files but hidden ones and those in hidden folders.

    Left out are receipts of shares of tiles, which say how many tiles their run formed, fewer after a kill; and what a
    killed writer left in work in progress, which finishing it removes.
    """
    found = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        left = path.parent.name == "tiles" or (path.suffix == ".partial" and ".wip/" in name.as_posix())
        if path.is_file() and not left and not any(part.startswith(".") for part in name.parts):
            found[name.as_posix()] = path.read_bytes()
    return found


def _mount(folder: Path, size: int, *, again: bool = False) -> None:
    options = f"{'remount,' if again else ''}size={size}"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=True)


def _command(words: list[str]) -> int:
    """Return the exit status of a command line, as its process would have it."""
    from apertura.cli import main

    sys.argv = words
    try:
        main()
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    except BaseException:
        import traceback

        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0
