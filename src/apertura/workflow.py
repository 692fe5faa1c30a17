"""The workflow on a campaign folder: checked first, run by one process group, and ended with all its steps."""

import ctypes
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from apertura.campaign import Campaign
from apertura.check import print_problems
from apertura.check.stale import forms_results, stale_results
from apertura.lineage import STUDY
from apertura.lock import hold
from apertura.signals import STATUS_FILE

_GRACE_S = 3.0
_LIBC = ctypes.CDLL(None)
_COUNTERS = Path("/proc/vmstat")
_ELSEWHERE = ("memory",)
"""Checks of this machine, of no use where steps run on others."""


def run_workflow(root: Path, cores: int, *arguments: str, paranoid: bool = False) -> int:
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

    Returns
    -------
    int
        0; 2 where the campaign or the machine has to be seen to, 130 after a signal, and 1 for a defect.

    Raises
    ------
    CampaignError
        If the campaign is not fit to run, or another run holds it.
    """
    if print_problems(root, without=_ELSEWHERE if _runs_elsewhere(arguments) else (), stream=sys.stderr):
        return 2
    campaign = Campaign.load(root)
    if forms_results(["", *arguments]):
        hold(root).close()
    stale = stale_results(campaign, paranoid=paranoid)
    overtaken = [manifest for manifest in stale if not manifest.startswith(f"results/{STUDY}/")]
    forced = ["--forcerun", *overtaken] if overtaken else []  # in time for a dry run; the workflow says why
    folder, root = _workflow_folder(), root.absolute()
    command = [
        sys.executable,
        "-P",
        "-m",
        "snakemake",
        "--snakefile",
        str(folder / "Snakefile"),
        "--directory",
        str(root),
    ]
    command += ["--workflow-profile", str(folder / "profiles" / "default"), "--cores", str(cores)]
    command += [*profiles_found(arguments), *forced]
    here = Path(sys.executable).parent  # rules call `apertura`, which need not be on the caller's PATH
    path = f"{here}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
    with tempfile.TemporaryDirectory() as scratch:
        said = Path(scratch) / "status"
        killed = _killed_for_memory()
        status = _supervised(command, {**os.environ, "PATH": path, STATUS_FILE: str(said)})
        told = set(said.read_text(encoding="utf-8").split()) if said.is_file() else set()
        killed = _killed_for_memory() - killed
    if status and killed:
        message = (
            f"out of memory: meanwhile the kernel has ended {killed} processes of this machine or job for lack of it"
        )
        print(
            f"error: {message}. Give the run more memory, or fewer --cores; it goes on where it was.", file=sys.stderr
        )
    return 2 if status == 1 and "1" not in told else status


def _killed_for_memory() -> int:
    """Return how many processes the kernel has ended for lack of memory since it started; 0 where it does not say."""
    try:
        counters = dict(line.split() for line in _COUNTERS.read_text(encoding="ascii").splitlines())
        return int(counters.get("oom_kill", 0))
    except (OSError, ValueError):
        return 0


def profiles_found(arguments: Sequence[str]) -> list[str]:
    """Return options of snakemake with the profile's whole path: it lies here or beside the workflow, or is a name.

    Snakemake is started in another folder than the caller's.

    Examples
    --------
    >>> [Path(word).is_dir() for word in profiles_found(["-n", "--profile=profiles/slurm"])]
    [False, False, True]
    """
    found = [word for one in arguments for word in (one.split("=", 1) if one.startswith("--profile=") else [one])]
    for at, word in enumerate(found[1:], 1):
        whole = (place / word for place in (Path.cwd(), _workflow_folder()) if found[at - 1] == "--profile")
        found[at] = next((str(path) for path in whole if path.exists()), word)
    return found


def _runs_elsewhere(arguments: Sequence[str]) -> bool:
    """Return whether steps run on other machines than this one."""
    return any(argument.startswith(("--executor", "--profile", "-e")) for argument in arguments)


def _supervised(command: Sequence[str], environment: dict[str, str]) -> int:
    """Run a command and all that it starts in a process group of its own; a signal ends the group within seconds."""
    process = subprocess.Popen(
        command,
        cwd=Path(__file__).parent,  # never the campaign's: see `leave_working_folder`
        env=environment,
        start_new_session=True,
        preexec_fn=_die_with_parent,  # noqa: PLW1509 - this process has no other threads
    )
    try:
        return process.wait()
    except BaseException:
        _end(process)
        raise


def _die_with_parent() -> None:
    """Ask the kernel (prctl, PR_SET_PDEATHSIG) to end snakemake with this run, also where that is killed outright."""
    _LIBC.prctl(1, signal.SIGKILL)


def _end(process: "subprocess.Popen[bytes]") -> None:
    os.killpg(process.pid, signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        process.wait(_GRACE_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)  # steps that outlive snakemake, too: work in progress survives it
    process.wait()


def _workflow_folder() -> Path:
    """Return where the root Snakefile lies: inside the installed package, or beside its sources."""
    package = Path(__file__).parent
    return next(root for root in (package / "_workflow", package.parents[1]) if (root / "Snakefile").is_file())
