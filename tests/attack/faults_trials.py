"""Trials of fault injection: run a step with a fault at one call, rerun it, and check files and messages."""

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
"""Time limit of a step, seconds; a step takes about 1 s."""


@dataclass(frozen=True)
class Ended:
    """End of a command: exit status, or the negative number of the signal that killed it, and output."""

    status: int
    output: str

    @property
    def faults(self) -> list[str]:
        """Deviations from the required end: a single message and exit status 2."""
        errors = re.findall(r"^error: .*", self.output, re.MULTILINE)
        wrong = [] if self.status == 2 else [f"exit status {self.status}"]
        wrong += [] if len(errors) == 1 else [f"{len(errors)} messages"]
        return wrong + (["a traceback"] if "Traceback" in self.output else [])


@dataclass
class Bench:
    """A campaign with the results of undisturbed runs before and after every step.

    Attributes
    ----------
    root
        Campaign folder; its results are those of the current trial.
    page
        Settings of fault injection.
    before, after, calls
        Per step: folder with the results before the step, files after the step, and number of calls of the step.
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
        """Run all steps up to the last target once without faults; keep results for the trials of the targets."""
        self.results.mkdir()
        for step in STEPS[: 1 + max(map(STEPS.index, targets))]:
            if step in targets:
                self.before[step] = self.root.parent / f"before {step}"
                shutil.copytree(self.results, self.before[step])
            arm(self.page, self.results, COUNT)
            ended = self.run(step, limit_s=10 * LIMIT_S)  # the first run in a fresh clone compiles
            if ended.status:
                raise RuntimeError(f"{step} fails undisturbed:\n{ended.output}")
            self.calls[step], self.after[step] = self.page.count, files(self.results)

    def reset(self, step: str) -> None:
        """Restore the results before a step; the results folder itself is kept, because it may be a mount point."""
        self.results.mkdir(exist_ok=True)
        for path in self.results.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        shutil.copytree(self.before[step], self.results, dirs_exist_ok=True)

    def run(self, step: str, *, limit_s: float = LIMIT_S) -> Ended:
        """Run a step in a fork of this process, which has imported all modules, with the settings of the page."""
        with tempfile.TemporaryFile() as output:
            child = os.fork()
            if not child:
                os.dup2(output.fileno(), 1)
                os.dup2(output.fileno(), 2)
                faulthandler.dump_traceback_later(limit_s, exit=True, file=2)
                os._exit(_command(["apertura", "step", *step.split(), "--campaign", str(self.root)]))
            _, status = os.waitpid(child, 0)
            disarm(self.page)
            output.seek(0)
            return Ended(os.waitstatus_to_exitcode(status), output.read().decode(errors="replace"))

    def half_written(self, step: str) -> list[str]:
        """Return files with a final name that differ from those of the undisturbed step."""
        expected = self.after[step]
        finals = {name: content for name, content in files(self.results).items() if ".wip/" not in name}
        return [f"{name} is incomplete" for name, content in finals.items() if expected.get(name) != content]

    def again(self, step: str) -> list[str]:
        """Run the step without faults; return the differences of its results."""
        ended = self.run(step)
        if ended.status:
            return [f"the next run ends with {ended.status}: {ended.output[-2000:]}"]
        written, expected = files(self.results), self.after[step]
        return [
            f"{name} differs" for name in sorted(written.keys() | expected) if written.get(name) != expected.get(name)
        ]

    def killed(self, step: str, at: int) -> tuple[bool, list[str]]:
        """Kill a step at a call and rerun the step; return True if it was killed, and the failures."""
        self.reset(step)
        arm(self.page, self.results, KILL, at=at)
        ended = self.run(step)
        return ended.status == -9, self.half_written(step) + self.again(step)

    def failed(self, step: str, at: int, action: int, *, error: int, kinds: int) -> tuple[str, list[str]]:
        """Let a call of a step fail and rerun the step; return the outcome and the failures."""
        self.reset(step)
        arm(self.page, self.results, action, at=at, error=error, kinds=kinds)
        ended = self.run(step)
        if not self.page.struck:
            return "not reached", []
        outcome = "continued" if ended.status == 0 else "reported"
        wrong = ended.faults if ended.status else []
        wrong = [f"{', '.join(wrong)}:\n{ended.output[-3000:]}"] if wrong else []
        return outcome, wrong + self.half_written(step) + self.again(step)

    def full(self, step: str, share: float) -> tuple[int, list[str]]:
        """Run a step on a disk with space for a fraction of its output, and rerun the step with enough space.

        Returns the free space in bytes and the failures.
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
            if os.strerror(errno.ENOSPC) not in ended.output:
                wrong.append("the message does not name the full disk")
            wrong = [f"{', '.join(wrong)}:\n{ended.output[-3000:]}"] if wrong else []
            wrong += self.half_written(step)
            _mount(self.results, ROOM, again=True)
            return free, wrong + self.again(step)
        finally:
            subprocess.run(["umount", self.results], check=True)


def files(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files by path, except hidden files and folders.

    Two kinds of files are also excluded: receipts of tile jobs, which contain the number of tiles formed (smaller after
    a kill), and partial files of a killed writer in unfinished stages, which are removed when the stage is finished.
    """
    contents = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        is_excluded = path.parent.name == "tiles" or (path.suffix == ".partial" and ".wip/" in name.as_posix())
        if path.is_file() and not is_excluded and not any(part.startswith(".") for part in name.parts):
            contents[name.as_posix()] = path.read_bytes()
    return contents


def _mount(folder: Path, size: int, *, again: bool = False) -> None:
    options = f"{'remount,' if again else ''}size={size}"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=True)


def _command(words: list[str]) -> int:
    """Run a command line in this process and return its exit status."""
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
