"""Driver of the workflow: check a campaign folder, run Snakemake in a process group, and stop it with all its steps."""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Literal

from apertura.campaign.config.section import RESERVED_NAMES
from apertura.campaign.folder import Campaign
from apertura.check import print_problems
from apertura.common.code_imports import PACKAGE
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError, number_of
from apertura.common.paths import check_shell_name, shipped
from apertura.common.processes import (
    CONFINED,
    INTERRUPTED,
    SIGNALLED,
    STATUS_FILE,
    die_with_parent,
    given,
    hold,
    isolate,
)
from apertura.common.progress import RUN
from apertura.run.fork_server import AT_ONCE, Order
from apertura.run.fork_server import NAME as SERVER
from apertura.run.journal import JOURNAL, NAME, RECORDER, JournalReader, a_step_was_killed, failures, note
from apertura.run.screen import NOTHING, Screen, listed
from apertura.run.time_left import TimeLeft
from apertura.workflow.lineage import on_demand, results_of
from apertura.workflow.rules import RULES
from apertura.workflow.stale import absent_lines, any_is_missing, forms_results, stale_lines, stale_results

Show = Literal["errors", "steps", "snakemake"]

_GRACE_S = 3.0
_LOOK_S, _REST = 0.2, 20  # polling interval; minimum ratio of idle to polling time, because 10^5 jobs take long to poll
_COUNTERS = Path("/proc/vmstat")
_ELSEWHERE = ("memory", "plan")
"""Checks that concern this machine, omitted if steps run on other machines."""
_HOLDS_CODE = ("--profile", "--workflow-profile", "--configfiles", "--snakefile", "--jobscript", "--js")
"""Options whose values are files from which Snakemake executes code; Snakemake accepts abbreviations of options."""
_HOLDS_NONE = ("--config", "--jobs")
_PICKLED = "--trust-io-cache"
"""Option with which Snakemake reads the state of files from a pickle in the working directory."""
_SHORT = re.compile(r"(-[hntkfFlSDvpa]*s)(.*)")
"""Short options that take no value, ending in `-s` (`--snakefile`), and the value of `-s` if no space precedes it."""
_PROFILE = "SNAKEMAKE_PROFILE"
"""Environment variable: default profile of Snakemake."""
_DRY_RUN = re.compile(r"-n|-np|--dry-?run")
_SCATTER = "--set-scatter"
_DEPLOYS = ("--sd", "--so", "--use-c", "--use-s", "--use-a", "--conda")
"""Prefixes of options with which Snakemake installs software in any folder; its file access is then not confined."""
_BY_SHELL = (*_DEPLOYS, "--cac", "--be")
"""Prefixes of options that apply to shell commands: software deployment, caching, extended benchmarks."""
UNTIL = ("--until", "-U")
_TARGETS = ("all", "pages", "phase_history")
"""Rules of the workflow that only collect the results of other rules."""
_LOG = "snakemake.log"


@dataclass(frozen=True)
class _Files:
    """Files of a run: journal, status and log."""

    journal: ConfinedPath
    status: ConfinedPath
    log: ConfinedPath
    confined: str = ""
    """Campaign folder to which file changes by Snakemake are confined; empty if changes are not confined."""

    @classmethod
    def of(cls, campaign: Campaign, *, confined: bool) -> "_Files":
        """Create the files of a run that computes results; files of an earlier run are removed."""
        folder, log = campaign.result(RUN), campaign.result("logs", _LOG)
        folder.remove()
        folder.mkdir(parents=True)
        log.parent.mkdir(parents=True, exist_ok=True)
        own = campaign.result(RUN, "journal.jsonl"), campaign.result(RUN, "status"), log
        return cls(*own, str(campaign.root) if confined else "")

    @classmethod
    def temporary(cls, folder: str, *, confined: Path | None) -> "_Files":
        """Return the files of a run that computes no results, in a temporary folder."""
        own = ConfinedPath.at(folder)
        return cls(own / "journal.jsonl", own / "status", own / _LOG, str(confined or ""))

    @property
    def environment(self) -> dict[str, str]:
        """Environment of Snakemake and its steps; PATH includes the command `apertura`, which the rules call."""
        isolate()
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
        files = {STATUS_FILE: self.status.reference(), JOURNAL: self.journal.reference()}
        return {**os.environ, "PATH": path, **files, **({CONFINED: self.confined} if self.confined else {})}

    def status_of(self, status: int) -> int:
        """Return the exit status: 1 after a signal, 2 if steps failed without internal error, otherwise Snakemake's."""
        if _ended_by(status):
            return 1
        reported = self.status.read_text(encoding="utf-8").split() if self.status.is_file() else []
        return 2 if status == 1 and "1" not in reported else status


def run_workflow(root: Path, cores: int, *arguments: str, paranoid: bool = False, show: Show = "steps") -> int:
    """Run the workflow on a campaign folder; return its exit status.

    Parameters
    ----------
    root
        The campaign folder.
    cores
        Number of cores to use.
    *arguments
        Further options and targets of Snakemake.
    paranoid
        Hash all sources again, including those with an unchanged size and modification time.
    show
        'errors': only errors; 'steps': a line per step, with progress bars on a terminal; 'snakemake': full output of
        Snakemake.

    Returns
    -------
    int
        0 for success, 2 for a problem of the campaign or the machine, 130 after an interrupt, 1 for an internal error.

    Raises
    ------
    CampaignError
        If the campaign cannot be run, or is locked by another run.
    """
    elsewhere = _runs_elsewhere(arguments)
    options = _steps_as_until(code_from_outside(root, arguments))
    _check_values(options)
    if _PROFILE in os.environ:
        os.environ[_PROFILE] = _absolute(root, _PROFILE, os.environ[_PROFILE])
    if elsewhere:
        check_shell_name(root.absolute())
    forms = forms_results(["", *arguments])
    with _ahead(root) if forms and not elsewhere else nullcontext() as server:
        if print_problems(root, without=_ELSEWHERE if elsewhere else (), stream=sys.stderr):
            return 2
        root = root.absolute()
        campaign = Campaign.load(root)
        _check_targets(campaign, options)
        if forms:
            hold(root).close()
        stale = stale_results(campaign, paranoid=paranoid)
        if show == "steps":
            for line in (*absent_lines(campaign), *stale_lines(stale)):
                print(line, file=sys.stderr, flush=True)
        outdated = [manifest for manifest in stale if not on_demand(campaign, manifest)]
        forced = ["--forcerun", *outdated] if outdated else []  # also effective in a dry run
        forks = server and not any(argument.startswith(_BY_SHELL) for argument in arguments)
        executor = ["--executor", NAME] if forks else []
        words = _words(root, cores, [*executor, *_without_inner_steps(campaign, options), *forced])
        if forms:
            deploys = any(argument.startswith(_DEPLOYS) for argument in arguments)
            files = _Files.of(campaign, confined=not (elsewhere or deploys))
            at_once = 0 if elsewhere else cores
            note(files.journal, "start", cores=at_once)
            screen = Screen(campaign, TimeLeft(campaign, at_once), quiet=show != "steps")
            return _formed(root, words, files, screen, server, verbose=show == "snakemake")
    with tempfile.TemporaryDirectory() as scratch:
        dry = any(map(_DRY_RUN.fullmatch, arguments))
        files = _Files.temporary(scratch, confined=root if dry and not elsewhere else None)
        if show == "errors" or (dry and show == "steps"):
            return _examined(root, words, files, report=dry)
        return files.status_of(_watched(_started([RECORDER, *words], files.environment)))


@contextmanager
def _ahead(root: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """Start the fork server, which imports modules during the check of the campaign; stop the server on exit."""
    isolate()
    at_once = []
    with suppress(CampaignError):  # reported by the check
        at_once = [AT_ONCE] if any_is_missing(Campaign.load(root)) else []
    process = _started([SERVER, *at_once], os.environ, stdin=subprocess.PIPE)
    try:
        yield process
    finally:
        with process:  # closes the standard input of the process if it is still open
            process.kill()


def _formed(
    root: Path,
    words: Sequence[str],
    files: "_Files",
    screen: Screen,
    server: "subprocess.Popen[bytes] | None",
    *,
    verbose: bool,
) -> int:
    """Run Snakemake, in the waiting fork server if there is one, and display the progress recorded in the journal."""
    reader, killed, status, ended = JournalReader(files.journal), _killed_for_memory(), INTERRUPTED, 0
    try:
        with files.log.open("wb") as output, files.log.open("rb") as log, screen:

            def look() -> None:
                screen.update(reader.news())
                if verbose:
                    print(log.read().decode("utf-8", "replace"), end="", file=sys.stderr, flush=True)

            if server and server.stdin:
                Order(words, files.environment, files.log.reference()).give(server.stdin)
            ended = _watched(server or _started([RECORDER, *words], files.environment, output=output), look)
            status = files.status_of(ended)
            look()
            if status == 2 and a_step_was_killed(root, reader.run):
                status = 1
    finally:
        note(files.journal, "end", status=status)
    killed = _killed_for_memory() - killed
    if status and not (by := _ended_by(ended)):
        _report(*failures(root, reader.run, files.log))
    elif status and not killed:
        _report(f"error: the run was terminated by {by}, possibly out of memory. Run again to resume.")
    if status and killed:
        message = f"out of memory: the kernel killed {killed} processes of this machine or job during the run"
        _report(f"error: {message}. Provide more memory, or use fewer --cores, and run again to resume.")
    if not status:
        screen.ended(reader.run)
    return status


def _examined(root: Path, words: Sequence[str], files: "_Files", *, report: bool) -> int:
    """Run Snakemake without computing results; with `report`, print a summary of the planned steps."""
    with files.log.open("wb") as output:
        status = files.status_of(_watched(_started([RECORDER, *words], files.environment, output=output)))
    run = JournalReader(files.journal).news()
    if status:
        _report(*failures(root, run, files.log))
    elif report:
        print(f"{number_of(run.total, 'step')} to run: {listed(run.planned)}" if run.planned else NOTHING)
    return status


def _report(*lines: str) -> None:
    print(*lines, sep="\n", file=sys.stderr, flush=True)


def _words(root: Path, cores: int, arguments: Sequence[str]) -> list[str]:
    """Return the arguments of Snakemake."""
    folder = shipped()
    own = ["--snakefile", str(folder / "Snakefile"), "--directory", str(root), "--logger", NAME]
    own += ["--workflow-profile", str(folder / "profiles" / "default"), "--cores", str(cores)]
    return [*own, *arguments]


def _ended_by(status: int) -> str:
    """Return the signal that terminated a process, given the exit status of the process or a shell.

    The name is empty if the process exited, or was interrupted by SIGINT.
    """
    number = -status if status < 0 else status - SIGNALLED
    return signal.Signals(number).name if status != INTERRUPTED and number in set(signal.Signals) else ""


def _killed_for_memory() -> int:
    """Return the number of processes that the kernel has killed for lack of memory since boot; 0 if not available."""
    try:
        counters = dict(line.split() for line in _COUNTERS.read_text(encoding="ascii").splitlines())
        return int(counters.get("oom_kill", 0))
    except (OSError, ValueError):
        return 0


def code_from_outside(root: Path, arguments: Sequence[str]) -> list[str]:
    """Make paths of files that contain code for Snakemake absolute, and reject files in the campaign folder.

    Snakemake is started in a different folder than the caller. Profiles and configurations may contain Python (YTE).

    Parameters
    ----------
    root
        The campaign folder.
    arguments
        Options and targets.

    Raises
    ------
    CampaignError
        If such a file lies in the campaign folder, or is reached through the campaign folder.

    Examples
    --------
    >>> options = code_from_outside(Path("campaign"), ["-n", "--profile=profiles/slurm"])
    >>> options[:2], Path(options[2]) == shipped() / "profiles" / "slurm"
    (['-n', '--profile'], True)
    """
    words = [word for argument in arguments for word in apart(argument)]
    option = ""
    for at, word in enumerate(words):
        if word.startswith("-"):
            option = word
            _refuse_pickled(option)
        elif _holds_code(option):
            words[at] = _absolute(root, option, word)
    return words


def apart(argument: str) -> list[str]:
    """Split an option and its value if both are written as one word.

    Examples
    --------
    >>> apart("--profile=mine"), apart("-np"), apart("-nsmine")
    (['--profile', 'mine'], ['-np'], ['-ns', 'mine'])
    """
    short = _SHORT.fullmatch(argument)
    if short:
        return [word for word in short.groups() if word]
    return argument.split("=", 1) if argument.startswith("--") else [argument]


def _values(options: Sequence[str], *names: str) -> Iterator[int]:
    """Yield the indices of the values of an option, which may be abbreviated."""
    option = ""
    for at, word in enumerate(options):
        if word.startswith("-"):
            option = word
        elif option in names or (len(option) > len("--set-") and any(name.startswith(option) for name in names)):
            yield at


def _steps_as_until(options: Sequence[str]) -> list[str]:
    """Convert steps named as targets to options --until, because Snakemake accepts no target rules with wildcards.

    Examples
    --------
    >>> _steps_as_until(["tracks", "-n"]), _steps_as_until(["-n", "--until", "echo"])
    (['--until', 'tracks', '-n'], ['-n', '--until', 'echo'])
    """
    leading = next((at for at, word in enumerate(options) if word.startswith("-")), len(options))
    steps = [word for word in options[:leading] if word in RULES and RULES[word].of.wildcards]
    for step in steps:
        if RULES[step].on_demand:
            raise CampaignError(
                f"{step}: a step that only runs if its result is requested",
                "apertura run",
                f"a target ({', '.join(_TARGETS)}), or a file of the results",
                "Request the file, or the target that collects the file.",
            )
    others = [word for word in options[:leading] if word not in steps]
    rest = list(options[leading:])
    if not steps:
        return [*others, *rest]
    if UNTIL[0] in rest:
        at = rest.index(UNTIL[0]) + 1
        return [*others, *rest[:at], *steps, *rest[at:]]
    return [*others, UNTIL[0], *steps, *rest]


def _check_values(options: Sequence[str]) -> None:
    """Raise CampaignError for invalid numbers of jobs or step names, which Snakemake ignores or reports unclearly."""
    for shares in (options[at] for at in _values(options, _SCATTER)):
        if not re.fullmatch(r"tiles=0*[1-9][0-9]*", shares):
            raise CampaignError(
                f"{_SCATTER} {shares}",
                "apertura run",
                "tiles=N, N >= 1",
                "Set the number of jobs per image.",
            )
    for step in (options[at] for at in _values(options, *UNTIL)):
        if step not in (*RULES, *_TARGETS) and "/" not in step:  # files are accepted, too
            raise CampaignError(
                f"{UNTIL[0]} {step}", "apertura run", f"a step: {', '.join(RULES)}", "Correct the name of the step."
            )


def _check_targets(campaign: Campaign, options: Sequence[str]) -> None:
    """Raise CampaignError for result files of an unknown flight, pair or node, even if the files match a rule."""
    requested = [path for path in map(PurePosixPath, options) if path.parts[:1] == ("results",) and len(path.parts) > 3]
    requested = [path for path in requested if path.parts[1] not in RESERVED_NAMES]
    known = [PurePosixPath(result.manifest).parts for _, result in results_of(campaign)] if requested else []
    for path in requested:
        flight, name = campaign.flight(path.parts[1]).name, path.parts[2]
        own = sorted({parts[2] for parts in known if parts[1] == flight and len(parts) > 3})
        if name not in own:
            raise CampaignError(
                f"{path}: {flight} has no {name}", "apertura run", f"one of {', '.join(own)}", "Correct the name."
            )


def _without_inner_steps(campaign: Campaign, options: Sequence[str]) -> list[str]:
    """Return the options without --until steps on which other --until steps depend.

    Snakemake fails if both steps are given.
    """
    indices = [at for at in _values(options, *UNTIL) if options[at] in RULES]
    if len(indices) < 2:
        return list(options)
    results = list(results_of(campaign))
    sources = {result.manifest: result.sources for _, result in results}

    def outputs(step: str) -> set[str]:
        return {result.manifest for name, result in results if name == RULES[step].result}

    def needed(step: str) -> set[str]:
        visited = set() if RULES[step].shares else outputs(step)  # a step for part of a result does not complete it
        pending = [source for manifest in outputs(step) for source in sources[manifest]]
        while pending:
            manifest = pending.pop()
            if manifest in sources and manifest not in visited:
                visited.add(manifest)
                pending += sources[manifest]
        return visited

    kept = list(indices)
    for at in indices:
        others = [options[other] for other in kept if other != at]
        if others and outputs(options[at]) <= set().union(*map(needed, others)):
            kept.remove(at)
    return [word for at, word in enumerate(options) if at in kept or at not in indices]


def _holds_code(option: str) -> bool:
    """Return True if the value of an option (which may be abbreviated) is a file from which Snakemake executes code."""
    if not option.startswith("--"):
        return _SHORT.fullmatch(option) is not None
    return option not in ("--", *_HOLDS_NONE) and any(name.startswith(option) for name in _HOLDS_CODE)


def _refuse_pickled(option: str) -> None:
    if len(option) > len("--t") and _PICKLED.startswith(option):
        raise CampaignError(
            f"{option}: Snakemake would read a pickle in the campaign folder, which may execute code",
            "apertura run",
            "options for which the campaign folder is only read as data",
            "Omit this option.",
        )


def _absolute(root: Path, option: str, name: str) -> str:
    """Return the absolute path of a shipped profile or a file of the caller; return any other name unchanged."""
    ours, theirs = shipped() / name, given(Path(name))
    if name.startswith("profiles/") and ours.exists():
        return str(ours)
    if not theirs.exists():
        return name
    # A link in the campaign folder is also rejected, because the creator of the folder controls its target.
    typed = Path(os.path.normpath(theirs))
    if any(path.resolve().is_relative_to(root.resolve()) for path in (theirs, typed, *typed.parents)):
        raise CampaignError(
            f"{option} {name} lies in the campaign folder",
            "apertura run",
            "a file outside the campaign folder, because Snakemake executes its code, but campaign folders are data",
            "Inspect the file. If you trust the file, copy it to a folder outside the campaign folder.",
        )
    return str(theirs)


def _runs_elsewhere(arguments: Sequence[str]) -> bool:
    """Return True if steps run on other machines."""
    named = any(argument.startswith(("--exec", "--prof", "--wo", "-e")) for argument in arguments)
    return named or _PROFILE in os.environ


def _started(
    words: Sequence[str], environment: Mapping[str, str], *, stdin: int | None = None, output: IO[bytes] | None = None
) -> "subprocess.Popen[bytes]":
    """Start a module with its arguments in a new process group, which includes all descendants of the process."""
    return subprocess.Popen(
        [sys.executable, "-P", "-m", *words],
        cwd=PACKAGE,  # never the campaign folder: see `apertura.common.processes`
        env=environment,
        stdin=stdin,
        stdout=output,
        stderr=output,
        start_new_session=True,
        preexec_fn=partial(die_with_parent, os.getpid()),  # noqa: PLW1509 - this process has no other threads
    )


def _watched(process: "subprocess.Popen[bytes]", look: Callable[[], None] = lambda: None) -> int:
    """Wait for a process and call `look` regularly; after a signal, terminate its process group within seconds."""
    try:
        while process.poll() is None:
            start_s = time.monotonic()
            look()
            time.sleep(max(_LOOK_S, _REST * (time.monotonic() - start_s)))
    except BaseException:
        _end(process)
        raise
    return process.returncode


def _end(process: "subprocess.Popen[bytes]") -> None:
    os.killpg(process.pid, signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        process.wait(_GRACE_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)  # also kills steps that outlive Snakemake; completed work is kept
    process.wait()
