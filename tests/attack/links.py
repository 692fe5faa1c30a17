"""Links, FIFOs, sockets, sparse files and folders in place of the files that commands write in a campaign folder.

The paths are recorded: every command runs once on a copy of a small campaign while the kernel (inotify) reports which
files and folders it creates, writes, renames, deletes and opens. Then one or several of these paths are replaced before
the command starts, or while it runs. A folder D of the user outside the campaign and the inputs of the campaign must
remain unchanged, and the command must end within the time limit, successfully or with one message::

    python -m tests.attack.links --commands list,status --most 20 --seed 3
    python -m tests.attack.links --while-running

The exit status is 1 if there is any fault.
"""

import argparse
import os
import random
import shutil
import socket
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from .link_commands import (
    COMMANDS,
    INPUTS,
    NAMES,
    SETTLED_S,
    Command,
    copy,
    differences,
    fingerprint,
    make_campaign,
    make_user_folder,
)
from .link_recording import CREATE, MOVED_TO, Ended, Recording, Runner, Watch, record

# ---- Planting -------------------------------------------------------------------------------------------------------

KINDS = {
    "link to folder": 6,
    "link to file": 4,
    "dangling link": 3,
    "link to its copy": 3,
    "link to raw": 2,
    "link to config": 1,
    "link to input": 2,
    "folder with links": 3,
    "fifo": 3,
    "socket": 1,
    "sparse": 2,
    "file": 1,
}
"""Kinds of planted objects → relative frequency."""


def plant(root: Path, path: str, kind: str, outside: Path) -> None:
    """Replace a path of a campaign by a link, a FIFO, a socket, a sparse file of 1 TB, a folder or a file."""
    target = root / path
    for above in list(target.relative_to(root).parents)[-2::-1]:
        if (root / above).is_symlink():  # planted earlier
            return
        if not (root / above).is_dir():
            _remove(root / above)
        (root / above).mkdir(exist_ok=True)
    if kind == "link to its copy" and os.path.lexists(target):
        target.rename(outside / "its-copy")
    _remove(target)
    if kind in _LINKS:
        target.symlink_to(_LINKS[kind](root, target, outside))
    else:
        _OTHERS[kind](target, outside)


def _its_copy(_: Path, __: Path, outside: Path) -> Path:
    return outside / ("its-copy" if (outside / "its-copy").exists() else "map")


def _file_of(_: Path, target: Path, outside: Path) -> Path:
    return outside / next((file for file in NAMES if file.endswith(target.suffix or ".txt")), NAMES[0])


_LINKS: dict[str, Callable[[Path, Path, Path], Path]] = {
    "link to folder": lambda _, __, outside: outside,
    "link to file": _file_of,
    "dangling link": lambda _, __, outside: outside / "steps" / "new",
    "link to its copy": _its_copy,
    "link to raw": lambda root, target, _: Path("../" * (len(target.relative_to(root).parts) - 1) + "raw"),
    "link to config": lambda root, _, __: root / "config",
    "link to input": lambda root, _, __: min((root / "raw").rglob("*.sigmf-meta")),
}
"""Kind of link → function of campaign, path and D that returns its target."""


def _folder_with_links(target: Path, outside: Path) -> None:
    target.mkdir()
    (target / ".lock").symlink_to(outside / "run.log")
    for name in {"linked", target.name.removeprefix(".").removesuffix(".wip")}:
        (target / name).symlink_to(outside)


def _sparse(target: Path, _: Path) -> None:
    target.touch()
    os.truncate(target, 1 << 40)


def _socket(target: Path, _: Path) -> None:
    """Create a socket file by its name in its folder, because addresses are limited to about 100 bytes."""
    before = Path.cwd()
    os.chdir(target.parent)
    try:
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(target.name[:100])
    finally:
        os.chdir(before)


_OTHERS: dict[str, Callable[[Path, Path], object]] = {
    "folder with links": _folder_with_links,
    "fifo": lambda target, _: os.mkfifo(target),
    "socket": _socket,
    "sparse": _sparse,
    "file": lambda target, _: target.write_text("not what is expected\n"),
}
"""Kind of other object → function of path and D that creates it."""


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@dataclass(frozen=True)
class Trial:
    """Kind and paths of the objects planted for one run of a command."""

    command: str
    kind: str
    paths: tuple[str, ...]


class Replacing:
    """Replacement of campaign paths by links to D while a command runs, upon events and at random times.

    Parameters
    ----------
    root, outside, aside
        Campaign, D, and a folder to which replaced objects are moved.
    paths
        Recorded paths.
    start_s
        Time of the first replacement, after the first call.
    rng
        Random generator.
    """

    def __init__(
        self, root: Path, outside: Path, aside: Path, paths: Sequence[str], start_s: float, rng: random.Random
    ) -> None:
        self._root, self._outside, self._aside, self._paths, self._rng = root, outside, aside, paths, rng
        self._watch, self._start_s, self._first_call_s = Watch(root), start_s, 0.0
        self.replaced: list[str] = []

    def work(self) -> None:
        """Replace a newly created path, or any path whose folder exists."""
        events = [path for path, mask in self._watch.read() if mask & (CREATE | MOVED_TO)]
        self._first_call_s = self._first_call_s or time.monotonic()
        if time.monotonic() - self._first_call_s < self._start_s or len(self.replaced) >= 40:
            return
        events = [path for path in events if path.split("/")[0] not in INPUTS]
        chosen = [self._rng.choice(events)] if events and self._rng.random() < 0.5 else []
        if self._rng.random() < 0.02:
            chosen.append(self._rng.choice(self._paths))
        for path in chosen:
            self._swap(path)

    def _swap(self, path: str) -> None:
        target = self._root / path
        if target.is_symlink() or self._is_linked(target.parent):
            return
        with suppress(OSError):
            link = self._aside / f"link{len(self.replaced)}"
            is_folder = target.is_dir()
            link.symlink_to(self._outside if is_folder or self._rng.random() < 0.7 else self._outside / "scene.json")
            if is_folder:
                target.rename(self._aside / f"was{len(self.replaced)}")
            link.rename(target)
            self.replaced.append(path)

    def _is_linked(self, folder: Path) -> bool:
        return not folder.is_dir() or folder.resolve() != folder

    def close(self) -> None:
        """Stop watching."""
        self._watch.close()


# ---- Trials of the review -------------------------------------------------------------------------------------------

ALL_WORK, ALL_LOCKS, ALL_HASHES = "every work folder", "every lock", "every work folder of hashes"
_LINKED_COMMANDS = (
    *("check", "summary", "report", "chart", "map", "plan", "verify", "preview", "run, finished", "reproduce"),
    *(name for name in COMMANDS if name.startswith("step ") and name.split()[1] not in ("bench", "whole-chart")),
)
_HASHED = ("list", "summary", "status", "check", "run, finished", "verify", "plan", "inspect")
_HASH = "results/.hashes/raw/f01/uav1.sigmf-data.json"
REVIEW: tuple[Trial, ...] = (
    *(Trial(name, "link to folder", (ALL_WORK,)) for name in _LINKED_COMMANDS),
    *(Trial(name, "link to folder", (ALL_HASHES,)) for name in _HASHED),
    *(Trial(name, "link to folder", (ALL_WORK,)) for name in ("bench", "bench --write", "step bench")),
    Trial("bench --write", "link to folder", ("config/.config.yaml.wip",)),
    Trial("bench", "link to folder", ("results/b01",)),
    Trial("bench", "link to folder", ("results/.hashes",)),
    Trial("bench", "link to folder", ("results",)),
    Trial("step bench", "link to file", ("results/b01/bench.json",)),
    *(Trial("clean", "link to folder", (f"results/{name}",)) for name in (".run", "logs", "benchmarks", "preview")),
    Trial("clean", "link to file", ("results/.run.lock",)),
    # Findings in addition to the 56 links, and findings that do not concern links.
    Trial("preview", "link to folder", ("results/preview/.status.json.wip",)),
    Trial("preview", "link to folder", ("results/preview/.index.html.wip",)),
    Trial("preview", "link to folder", ("results/preview/f01/uav1-uav1/.db.0.tif.wip",)),
    Trial("preview", "link to folder", ("results/preview/map",)),
    Trial("preview", "link to folder", ("results/preview/f01/uav1-uav1",)),
    Trial("list", "link to folder", ("results/.hashes",)),
    Trial("list", "link to folder", ("results/.hashes/raw/f01/.uav1.sigmf-data.json.wip",)),
    Trial("clean", "link to folder", ("results/.hashes",)),
    Trial("step image", "link to file", ("results/f01/uav1-uav2/.image.zarr.lock",)),
    Trial("step image", "link to file", (ALL_LOCKS,)),
    Trial("reflectors", "link to folder", (".calibration.json.wip",)),
    Trial("align", "link to folder", ("config/.clocks.tsv.wip",)),
    *(Trial(name, "fifo", (_HASH,)) for name in ("check", "list", "summary")),
    Trial("status", "fifo", ("results/.run.lock",)),
    Trial("check", "sparse", ("results/f01/uav1/track.manifest.json",)),
    Trial("check", "sparse", ("results/scene.json",)),
    Trial("list", "sparse", (_HASH,)),
)
"""The 56 links of the review of 2026 and its findings 6, 7 and 10."""


def _expanded(paths: Sequence[str], recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the paths of a trial, with placeholders such as `ALL_WORK` expanded."""
    if not {ALL_WORK, ALL_LOCKS, ALL_HASHES} & set(paths):
        return tuple(paths)
    written = {path for recording in recordings for path in recording.written}
    if ALL_LOCKS in paths:
        return tuple(sorted(path for path in written if path.endswith(".lock") and not path.endswith(".wip/.lock")))
    plain = {
        path
        for path in written
        if path.startswith("results/") and ".wip" not in path and ".zarr/" not in path and not path.endswith(".lock")
    }
    plain &= {path for path in plain if Path(path).suffix}
    work = {f"{path.rpartition('/')[0]}/.{path.rpartition('/')[2]}.wip" for path in plain}
    is_hashed = ALL_HASHES in paths
    work |= {path for path in written if path.endswith(".wip") and ".zarr/" not in path}
    return tuple(sorted(path for path in work if ("/.hashes/" in path) is is_hashed))


# ---- Trials ---------------------------------------------------------------------------------------------------------

D_CHANGED, HUNG, TRACEBACK, KILLED, REFUSED, WORKED = (
    "D or inputs changed",
    "hung",
    "traceback, several messages or none",
    "killed",
    "refused",
    "worked",
)
FAULTS = (D_CHANGED, HUNG, TRACEBACK, KILLED)


def _weight(path: str) -> float:
    """Return the relative frequency of a path: arrays and Snakemake's folder have many similar paths."""
    return 0.05 if ".zarr/" in path else 0.2 if path.startswith(".snakemake/") else 1.0


@dataclass
class Outcome:
    """Result of a trial: columns of the table that count it, and description."""

    trial: Trial
    columns: tuple[str, ...]
    text: str

    @property
    def is_fault(self) -> bool:
        """Return True if any column is a fault."""
        return bool(set(self.columns) & set(FAULTS))


class Harness:
    """Campaigns, recordings and trials in a scratch folder.

    Parameters
    ----------
    folder
        Empty folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "tmp").mkdir(exist_ok=True)
        self.runner = Runner(folder)
        self.recordings: dict[str, Recording] = {}
        self._waiting: dict[str, deque[tuple[Path, float]]] = {}
        self._used: Path | None = None
        self._copies = 0

    def record(self, names: Sequence[str]) -> None:
        """Record the paths that commands use."""
        for name in names:
            root = self._fresh(COMMANDS[name])
            self.recordings[name] = recording = record(self.runner, COMMANDS[name], root)
            counts = f"{len(recording.written):5} written {len(recording.opened):5} opened {recording.random:5} random"
            print(f"recorded {name:22}{counts} {recording.seconds:6.1f} s, status {recording.status}", file=sys.stderr)

    def _fresh(self, command: Command) -> Path:
        """Return a copy of a campaign, old enough for its hashes to be cached; remove the previous copy."""
        if self._used:
            shutil.rmtree(self._used, ignore_errors=True)
        if not (self.folder / command.campaign).exists():
            make_campaign(self.folder, command.campaign)
        name = command.campaign + "-finished" * command.finished
        waiting = self._waiting.setdefault(name, deque())
        while len(waiting) < 4:
            self._copies += 1
            waiting.append((copy(self.folder / name, self.folder / f"copy{self._copies}"), time.time()))
        self._used, created_s = waiting.popleft()
        time.sleep(max(0.0, created_s + SETTLED_S - time.time()))
        return self._used

    def trials(self, name: str, most: int, kinds: Sequence[str], rng: random.Random) -> list[Trial]:
        """Return the trials of the review for a command and random trials, preferably with the paths of the command."""
        own = self.recordings[name]
        campaign = COMMANDS[name].campaign
        same = [self.recordings[other] for other in self.recordings if COMMANDS[other].campaign == campaign]
        others = sorted({path for recording in same for path in recording.written})
        arguments = set(COMMANDS[name].words.split())  # links given as arguments may be followed
        tiers = [[path for path in tier if path not in arguments] for tier in (own.written, own.opened, others)]
        tiers = [tier for tier in tiers if tier]
        weights = [{0: 0.55, 1: 0.25, 2: 0.2}[place] for place in range(len(tiers))]
        fixed = [
            replace(trial, paths=_expanded(trial.paths, same))
            for trial in REVIEW
            if trial.command == name and trial.kind in kinds
        ]
        chosen: dict[Trial, None] = {}
        tries = 0
        number = most if own.seconds < 3 else max(2, round(most * 3 / own.seconds))
        while tiers and len(chosen) < number and tries < 20 * number:
            tries += 1
            tier = rng.choices(tiers, weights)[0]
            path = rng.choices(tier, [_weight(path) for path in tier])[0]
            kind = rng.choices(kinds, [KINDS[kind] for kind in kinds])[0]
            chosen[Trial(name, kind, (path,))] = None
        return [*fixed, *(trial for trial in chosen if trial not in fixed)]

    def attempt(self, trial: Trial) -> Outcome:
        """Plant objects, run the command, and compare D and the inputs with their earlier state."""
        command = COMMANDS[trial.command]
        root, outside = self._fresh(command), make_user_folder(self.folder / "user")
        for path in trial.paths:
            plant(root, path, trial.kind, outside)
        ended, changes = self._compared(trial.command, root, outside, trial.paths, None)
        return self._judged(trial, ended, changes)

    def attempt_while_running(self, name: str, rng: random.Random) -> Outcome:
        """Start a command and replace paths by links to D while it runs."""
        command, own = COMMANDS[name], self.recordings[name]
        root, outside = self._fresh(command), make_user_folder(self.folder / "user")
        aside = self.folder / "aside"
        _remove(aside)
        aside.mkdir()
        paths = [path for path in own.written if path.split("/")[0] not in INPUTS] or ["results/f01"]
        replacing = Replacing(root, outside, aside, paths, rng.uniform(0, own.seconds), rng)
        try:
            ended, changes = self._compared(name, root, outside, (), replacing.work)
        finally:
            replacing.close()
        return self._judged(Trial(name, "while running", tuple(replacing.replaced)), ended, changes)

    def _compared(
        self, name: str, root: Path, outside: Path, planted: Sequence[str], meanwhile: Callable[[], object] | None
    ) -> tuple[Ended, str]:
        """Run a command; return its end, and the changes of D and of the inputs."""
        command = COMMANDS[name]
        watched = [outside, *(root / top for top in INPUTS)]
        before = fingerprint(*watched)
        limit_s = 10 + self.recordings[name].seconds
        ended = self.runner.run(command, root, limit_s, meanwhile)
        after = fingerprint(*watched)
        own = [*command.writes, *planted]
        allowed = {str(root / path) for path in own} | {str((root / path).parent) for path in own}
        allowed -= {str(outside)}
        for entries in (before, after):
            for path in allowed:
                entries.pop(path, None)
        return ended, differences(before, after, self.folder)

    def _judged(self, trial: Trial, ended: Ended, changes: str) -> Outcome:
        """Return the outcome of a trial."""
        messages = [line for line in ended.message.splitlines() if line.startswith("error:")]
        last = (ended.message.strip() or ended.printed.strip()).splitlines()[-1:]
        columns, text = [], []
        if changes:
            columns.append(D_CHANGED)
            text.append(changes)
        if ended.status is None:
            columns.append(HUNG)
            text.append(f"killed by the harness after {ended.seconds:.0f} s")
        elif ended.status < 0:
            columns.append(KILLED)
            text.append(f"signal {-ended.status}")
        elif "Traceback (most recent" in ended.message or len(messages) > 1 or (ended.status and not last):
            columns.append(TRACEBACK)
            text += [f"status {ended.status}", f"{len(messages)} messages", *last]
        elif ended.status and ended.status != self.recordings[trial.command].status:
            columns.append(REFUSED)
            text += last
        else:
            columns.append(WORKED)
        return Outcome(trial, tuple(columns), "; ".join(text)[:400])


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a table of the counts per command, and a line per fault."""
    columns = (*FAULTS, REFUSED, WORKED)
    rows: list[tuple[str, ...]] = [("command", "planted", *columns)]
    for name in dict.fromkeys(outcome.trial.command for outcome in outcomes):
        of_command = [outcome for outcome in outcomes if outcome.trial.command == name]
        counts = [sum(column in outcome.columns for outcome in of_command) for column in columns]
        rows.append((name, str(len(of_command)), *map(str, counts)))
    rows.append(("all", *(str(sum(int(row[at]) for row in rows[1:])) for at in range(1, len(rows[0])))))
    widths = [max(len(row[at]) for row in rows) for at in range(len(rows[0]))]
    lines = [" | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    for outcome in filter(lambda outcome: outcome.is_fault, outcomes):
        trial = outcome.trial
        paths = ", ".join(trial.paths[:2]) + f" and {len(trial.paths) - 2} more" * (len(trial.paths) > 2)
        kind = ", ".join(column for column in outcome.columns if column in FAULTS)
        lines.append(f"{kind}: {trial.command}: {trial.kind}: {paths}: {outcome.text}")
    return "\n".join(lines)


def trials_of(
    folder: Path, names: Sequence[str], *, kinds: Sequence[str], seed: int, most: int, while_running: bool
) -> list[Outcome]:
    """Write the campaigns to an empty folder, record the commands, and return the outcome of every trial."""
    harness = Harness(folder)
    outcomes: list[Outcome] = []
    try:
        harness.record(list(dict.fromkeys(["run", *names])))
        for name in names:
            rng = random.Random(f"{seed} {name}")
            if while_running:
                number = most if harness.recordings[name].seconds < 3 else max(2, most // 3)
                outcomes += [harness.attempt_while_running(name, rng) for _ in range(number)]
            else:
                outcomes += [harness.attempt(trial) for trial in harness.trials(name, most, kinds, rng)]
            done = [outcome for outcome in outcomes if outcome.trial.command == name]
            print(
                f"{name}: faults in {sum(outcome.is_fault for outcome in done)} of {len(done)} trials", file=sys.stderr
            )
    finally:
        harness.runner.close()
    return outcomes


def main() -> int:
    """Run the harness with the options of the command line; return 1 if there is any fault."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--commands", help="names, separated by commas (default: all): " + ", ".join(COMMANDS))
    parser.add_argument("--kinds", help="kinds, separated by commas (default: all): " + ", ".join(KINDS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--most", type=int, default=12, help="random trials per command, in addition to those of the review"
    )
    parser.add_argument("--while-running", action="store_true", help="replace paths while the commands run")
    options = parser.parse_args()
    names = options.commands.split(",") if options.commands else [name for name in COMMANDS if "whole" not in name]
    kinds = options.kinds.split(",") if options.kinds else list(KINDS)
    with tempfile.TemporaryDirectory(prefix="links-") as folder:
        choices = {"kinds": kinds, "seed": options.seed, "most": options.most, "while_running": options.while_running}
        outcomes = trials_of(Path(folder).resolve(), names, **choices)
    print(table(outcomes))
    return int(any(outcome.is_fault for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
