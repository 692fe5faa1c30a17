"""The workflow on a campaign folder: checked first, run by one process group, and ended with all its steps."""

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
_LOOK_S, _REST = 0.2, 20  # looking at 10^5 jobs takes time: at most a twentieth of one core
_COUNTERS = Path("/proc/vmstat")
_ELSEWHERE = ("memory", "plan")
"""Checks of this machine, of no use where steps run on others."""
_HOLDS_CODE = ("--profile", "--workflow-profile", "--configfiles", "--snakefile", "--jobscript", "--js")
"""Options of snakemake that name files which it takes code from; it knows them by their beginnings, too."""
_HOLDS_NONE = ("--config", "--jobs")
_PICKLED = "--trust-io-cache"
"""Option of snakemake: read what it knows of the folder's files from a pickle in that folder."""
_SHORT = re.compile(r"(-[hntkfFlSDvpa]*s)(.*)")
"""Short options that take no value, `-s`, which is `--snakefile`, and its value where it is written without a space."""
_PROFILE = "SNAKEMAKE_PROFILE"
"""Environment variable: the profile where the command line names none."""
_DRY_RUN = re.compile(r"-n|-np|--dry-?run")
_SCATTER = "--set-scatter"
_DEPLOYS = ("--sd", "--so", "--use-c", "--use-s", "--use-a", "--conda")
"""Beginnings of options with which Snakemake installs software, wherever that is kept: its changes are not confined."""
_BY_SHELL = (*_DEPLOYS, "--cac", "--be")
"""Beginnings of options that concern commands of shells: software, caching between workflows, extended benchmarks."""
UNTIL = ("--until", "-U")
_TARGETS = ("all", "pages", "phase_history")
"""Rules of the workflow that only gather results of others."""
_LOG = "snakemake.log"


@dataclass(frozen=True)
class _Files:
    """What a run keeps of itself."""

    journal: ConfinedPath
    status: ConfinedPath
    log: ConfinedPath
    confined: str = ""
    """Folder of the campaign to which Snakemake's changes are confined, if they are."""

    @classmethod
    def of(cls, campaign: Campaign, *, confined: bool) -> "_Files":
        """Return those of a run that forms results; what one before left is removed."""
        folder, log = campaign.result(RUN), campaign.result("logs", _LOG)
        folder.remove()
        folder.mkdir(parents=True)
        log.parent.mkdir(parents=True, exist_ok=True)
        own = campaign.result(RUN, "journal.jsonl"), campaign.result(RUN, "status"), log
        return cls(*own, str(campaign.root) if confined else "")

    @classmethod
    def apart(cls, folder: str, *, confined: Path | None) -> "_Files":
        """Return those of a run that forms nothing."""
        own = ConfinedPath.at(folder)
        return cls(own / "journal.jsonl", own / "status", own / _LOG, str(confined or ""))

    @property
    def environment(self) -> dict[str, str]:
        """What snakemake and its steps are told; rules call `apertura`, which need not be on the caller's PATH."""
        isolate()
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
        files = {STATUS_FILE: self.status.reference(), JOURNAL: self.journal.reference()}
        return {**os.environ, "PATH": path, **files, **({CONFINED: self.confined} if self.confined else {})}

    def status_of(self, status: int) -> int:
        """Return snakemake's exit status, 2 where no step has ended with a defect, or 1 where a signal has ended it."""
        if _ended_by(status):
            return 1
        told = self.status.read_text(encoding="utf-8").split() if self.status.is_file() else []
        return 2 if status == 1 and "1" not in told else status


def run_workflow(root: Path, cores: int, *arguments: str, paranoid: bool = False, show: Show = "steps") -> int:
    """Run the workflow on a campaign folder; return its exit status.

    Parameters
    ----------
    root
        The campaign folder.
    cores
        To use.
    *arguments
        Further options and targets of snakemake.
    paranoid
        Read every source again, also those whose state is known.
    show
        Errors alone; a line for each step, with bars on a terminal; or all that snakemake says.

    Returns
    -------
    int
        0; 2 where the campaign or the machine has to be seen to, 130 after a signal, and 1 for a defect.

    Raises
    ------
    CampaignError
        If the campaign is not fit to run, or another run holds it.
    """
    elsewhere = _runs_elsewhere(arguments)
    options = _steps_as_until(code_from_outside(root, arguments))
    _check_values(options)
    if _PROFILE in os.environ:
        os.environ[_PROFILE] = _whole(root, _PROFILE, os.environ[_PROFILE])
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
        overtaken = [manifest for manifest in stale if not on_demand(campaign, manifest)]
        forced = ["--forcerun", *overtaken] if overtaken else []  # in time for a dry run; the workflow says why
        forks = server and not any(argument.startswith(_BY_SHELL) for argument in arguments)
        executor = ["--executor", NAME] if forks else []
        words = _words(root, cores, [*executor, *_without_inner_steps(campaign, options), *forced])
        if forms:
            deploys = any(argument.startswith(_DEPLOYS) for argument in arguments)
            files = _Files.of(campaign, confined=not (elsewhere or deploys))
            at_once = 0 if elsewhere else cores
            note(files.journal, "start", cores=at_once)
            screen = Screen(campaign, TimeLeft(campaign, at_once), quiet=show != "steps")
            return _formed(root, words, files, screen, server, aloud=show == "snakemake")
    with tempfile.TemporaryDirectory() as scratch:
        dry = any(map(_DRY_RUN.fullmatch, arguments))
        files = _Files.apart(scratch, confined=root if dry and not elsewhere else None)
        if show == "errors" or (dry and show == "steps"):
            return _looked_at(root, words, files, told=dry)
        return files.status_of(_watched(_started([RECORDER, *words], files.environment)))


@contextmanager
def _ahead(root: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """Start the process that steps are forks of, which imports while the campaign is checked; end it in any case."""
    isolate()
    at_once = []
    with suppress(CampaignError):  # the check tells it
        at_once = [AT_ONCE] if any_is_missing(Campaign.load(root)) else []
    process = _started([SERVER, *at_once], os.environ, stdin=subprocess.PIPE)
    try:
        yield process
    finally:
        with process:  # closes what nothing was written to
            process.kill()


def _formed(
    root: Path,
    words: Sequence[str],
    files: "_Files",
    screen: Screen,
    server: "subprocess.Popen[bytes] | None",
    *,
    aloud: bool,
) -> int:
    """Run snakemake, by the process that waits for its order if any, and show what its journal tells."""
    reader, killed, status, ended = JournalReader(files.journal), _killed_for_memory(), INTERRUPTED, 0
    try:
        with files.log.open("wb") as output, files.log.open("rb") as said, screen:

            def look() -> None:
                screen.update(reader.news())
                if aloud:
                    print(said.read().decode("utf-8", "replace"), end="", file=sys.stderr, flush=True)

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
        _say(*failures(root, reader.run, files.log))
    elif status and not killed:
        _say(f"error: {by} has ended the process of the run, perhaps for lack of memory. Run again: it goes on there.")
    if status and killed:
        message = (
            f"out of memory: meanwhile the kernel has ended {killed} processes of this machine or job for lack of it"
        )
        _say(f"error: {message}. Give the run more memory, or fewer --cores; it goes on where it was.")
    if not status:
        screen.ended(reader.run)
    return status


def _looked_at(root: Path, words: Sequence[str], files: "_Files", *, told: bool) -> int:
    """Have snakemake look at the workflow, and say briefly what a run would do where that is to be `told`."""
    with files.log.open("wb") as output:
        status = files.status_of(_watched(_started([RECORDER, *words], files.environment, output=output)))
    run = JournalReader(files.journal).news()
    if status:
        _say(*failures(root, run, files.log))
    elif told:
        print(f"{number_of(run.total, 'step')} to do: {listed(run.planned)}" if run.planned else NOTHING)
    return status


def _say(*lines: str) -> None:
    print(*lines, sep="\n", file=sys.stderr, flush=True)


def _words(root: Path, cores: int, arguments: Sequence[str]) -> list[str]:
    """Return the arguments of snakemake."""
    folder = shipped()
    own = ["--snakefile", str(folder / "Snakefile"), "--directory", str(root), "--logger", NAME]
    own += ["--workflow-profile", str(folder / "profiles" / "default"), "--cores", str(cores)]
    return [*own, *arguments]


def _ended_by(status: int) -> str:
    """Return the signal that has ended a process, by its status or a shell's; empty: it ended itself, or by Ctrl-C."""
    number = -status if status < 0 else status - SIGNALLED
    return signal.Signals(number).name if status != INTERRUPTED and number in set(signal.Signals) else ""


def _killed_for_memory() -> int:
    """Return how many processes the kernel has ended for lack of memory since it started; 0 where it does not say."""
    try:
        counters = dict(line.split() for line in _COUNTERS.read_text(encoding="ascii").splitlines())
        return int(counters.get("oom_kill", 0))
    except (OSError, ValueError):
        return 0


def code_from_outside(root: Path, arguments: Sequence[str]) -> list[str]:
    """Return options of snakemake with the whole paths of files that it takes code from, none of them in the campaign.

    Snakemake is started in another folder than the caller's. A profile, as a config, may hold Python (YTE).

    Parameters
    ----------
    root
        The campaign folder.
    arguments
        Options and targets.

    Raises
    ------
    CampaignError
        If such a file lies in the campaign folder, or is reached through it.

    Examples
    --------
    >>> options = code_from_outside(Path("campaign"), ["-n", "--profile=profiles/slurm"])
    >>> options[:2], Path(options[2]) == shipped() / "profiles" / "slurm"
    (['-n', '--profile'], True)
    """
    found = [word for one in arguments for word in apart(one)]
    option = ""
    for at, word in enumerate(found):
        if word.startswith("-"):
            option = word
            _refuse_pickled(option)
        elif _holds_code(option):
            found[at] = _whole(root, option, word)
    return found


def apart(argument: str) -> list[str]:
    """Return an option and its value, where they are written as one word.

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
    """Yield where the values of an option stand, which snakemake knows by its beginning, too."""
    option = ""
    for at, word in enumerate(options):
        if word.startswith("-"):
            option = word
        elif option in names or (len(option) > len("--set-") and any(name.startswith(option) for name in names)):
            yield at


def _steps_as_until(options: Sequence[str]) -> list[str]:
    """Return options with steps named as targets turned into last steps, as Snakemake takes no rule with wildcards.

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
                f"{step}: a step that runs only where its result is requested",
                "apertura run",
                f"a target of {', '.join(_TARGETS)}, or a file of the results",
                "Name the file, or the target that gathers it.",
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
    """Refuse shares and names of steps that snakemake ignores, or explains by its own rules."""
    for shares in (options[at] for at in _values(options, _SCATTER)):
        if not re.fullmatch(r"tiles=0*[1-9][0-9]*", shares):
            raise CampaignError(
                f"{_SCATTER} {shares}",
                "apertura run",
                "tiles=N, N >= 1",
                "Give the number of jobs that form each image.",
            )
    for step in (options[at] for at in _values(options, *UNTIL)):
        if step not in (*RULES, *_TARGETS) and "/" not in step:  # a file may be named, too
            raise CampaignError(
                f"{UNTIL[0]} {step}", "apertura run", f"a step: {', '.join(RULES)}", "Correct the name of the step."
            )


def _check_targets(campaign: Campaign, options: Sequence[str]) -> None:
    """Refuse files in the results of a flight, pair or node that is not there: rules would make some of them."""
    asked = [path for path in map(PurePosixPath, options) if path.parts[:1] == ("results",) and len(path.parts) > 3]
    asked = [path for path in asked if path.parts[1] not in RESERVED_NAMES]
    made = [PurePosixPath(result.manifest).parts for _, result in results_of(campaign)] if asked else []
    for path in asked:
        flight, name = campaign.flight(path.parts[1]).name, path.parts[2]
        own = sorted({parts[2] for parts in made if parts[1] == flight and len(parts) > 3})
        if name not in own:
            raise CampaignError(
                f"{path}: {flight} has no {name}", "apertura run", f"one of {', '.join(own)}", "Correct the name."
            )


def _without_inner_steps(campaign: Campaign, options: Sequence[str]) -> list[str]:
    """Return the options without last steps that other last steps need: Snakemake ends in an error over both."""
    places = [at for at in _values(options, *UNTIL) if options[at] in RULES]
    if len(places) < 2:
        return list(options)
    results = list(results_of(campaign))
    sources = {result.manifest: result.sources for _, result in results}

    def made(step: str) -> set[str]:
        return {result.manifest for name, result in results if name == RULES[step].result}

    def needed(step: str) -> set[str]:
        found = set() if RULES[step].shares else made(step)  # a share alone does not complete its result
        left = [source for one in made(step) for source in sources[one]]
        while left:
            one = left.pop()
            if one in sources and one not in found:
                found.add(one)
                left += sources[one]
        return found

    kept = list(places)
    for at in places:
        others = [options[other] for other in kept if other != at]
        if others and made(options[at]) <= set().union(*map(needed, others)):
            kept.remove(at)
    return [word for at, word in enumerate(options) if at in kept or at not in places]


def _holds_code(option: str) -> bool:
    """Return whether the value of an option, perhaps abbreviated, is a file that snakemake takes code from."""
    if not option.startswith("--"):
        return _SHORT.fullmatch(option) is not None
    return option not in ("--", *_HOLDS_NONE) and any(name.startswith(option) for name in _HOLDS_CODE)


def _refuse_pickled(option: str) -> None:
    if len(option) > len("--t") and _PICKLED.startswith(option):
        raise CampaignError(
            f"{option}: Snakemake then reads a pickle of the campaign folder, which may hold code",
            "apertura run",
            "options that take data alone from the folder",
            "Leave it out.",
        )


def _whole(root: Path, option: str, name: str) -> str:
    """Return a path whole, what is shipped before what lies where the caller is; a name that is neither as it is."""
    ours, theirs = shipped() / name, given(Path(name))
    if name.startswith("profiles/") and ours.exists():
        return str(ours)
    if not theirs.exists():
        return name
    typed = Path(os.path.normpath(theirs))  # through a link in the folder, too: who makes that says where it leads
    if any(way.resolve().is_relative_to(root.resolve()) for way in (theirs, typed, *typed.parents)):
        raise CampaignError(
            f"{option} {name} lies in the campaign folder",
            "apertura run",
            "a file of your own: Snakemake runs code that it holds, and a campaign folder brings data",
            "Read it, and copy it out of the campaign folder if you trust it.",
        )
    return str(theirs)


def _runs_elsewhere(arguments: Sequence[str]) -> bool:
    """Return whether steps run on other machines than this one."""
    named = any(argument.startswith(("--exec", "--prof", "--wo", "-e")) for argument in arguments)
    return named or _PROFILE in os.environ


def _started(
    words: Sequence[str], environment: Mapping[str, str], *, stdin: int | None = None, output: IO[bytes] | None = None
) -> "subprocess.Popen[bytes]":
    """Start a module with its arguments, in a process group of its own that all which it starts is in, too."""
    return subprocess.Popen(
        [sys.executable, "-P", "-m", *words],
        cwd=PACKAGE,  # never the campaign's: see `apertura.common.processes`
        env=environment,
        stdin=stdin,
        stdout=output,
        stderr=output,
        start_new_session=True,
        preexec_fn=partial(die_with_parent, os.getpid()),  # noqa: PLW1509 - this process has no other threads
    )


def _watched(process: "subprocess.Popen[bytes]", look: Callable[[], None] = lambda: None) -> int:
    """Wait for a process, and look at what it does; a signal ends its group within seconds."""
    try:
        while process.poll() is None:
            began_s = time.monotonic()
            look()
            time.sleep(max(_LOOK_S, _REST * (time.monotonic() - began_s)))
    except BaseException:
        _end(process)
        raise
    return process.returncode


def _end(process: "subprocess.Popen[bytes]") -> None:
    os.killpg(process.pid, signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        process.wait(_GRACE_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)  # steps that outlive snakemake, too: work in progress survives it
    process.wait()
