"""Steps as forks of one process that has imported what they need: what `apertura run` starts on this machine.

``python -m apertura.run.warm`` reads what to run, forks snakemake, with a journal, and then a process for
each step that snakemake's shell asks for; it has no thread of its own. Log, benchmark, variables, signals and exit
status of a step are those of the command in its rule, which plain snakemake and other machines start as it stands.
"""

import gc
import importlib
import json
import multiprocessing
import os
import pkgutil
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import IO, Any

from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError
from apertura.common.processes import ALGEBRA_THREADS, ENDING, SIGNALLED, TEMPORARY, die_with_parent, leave_status
from apertura.workflow.rules import RULES

NAME = "apertura.run.warm"
"""This module."""
AT_ONCE = "--at-once"
"""Argument: steps will be asked for, so import what they need without being asked."""

_BOTH = ("apertura.check", "apertura.workflow.jobs", "apertura.workflow.stale")
"""What snakemake imports, too."""

_LIBRARIES = (
    "dask.array",
    "email.policy",
    "ijson",
    "matplotlib.backends.backend_agg",
    "numba.core.caching",
    "PIL.PngImagePlugin",
    "scipy.fft",
    "scipy.interpolate",
    "scipy.ndimage",
    "scipy.optimize",
    "scipy.signal",
    "xarray",
    "zarr.storage",
)
"""What most steps import in functions."""

_COMMAND = re.compile(r"(?:set -euo pipefail; +)?apertura (step(?: [\w.-]+)+) > ([\w./-]+) 2>&1")
"""What snakemake hands to a shell for a step; any other command goes to a shell."""

_LONGEST = 1 << 17  # bytes of a request; the environment is most of it
_GRACE_S = 2.0
_fork = multiprocessing.get_context("fork").Process


@dataclass(frozen=True)
class Order:
    """What snakemake is to be run with, as JSON on standard input; nothing is run where that ends without it.

    Attributes
    ----------
    arguments
        Of snakemake.
    environment
        Variables beside those of this process.
    output
        File that all output goes to, as a reference of `ConfinedPath`.
    """

    arguments: Sequence[str]
    environment: Mapping[str, str]
    output: str

    def give(self, stream: IO[bytes]) -> None:
        """Write it, and close the stream."""
        with stream:
            stream.write(json.dumps(vars(self)).encode())


def main() -> int:
    """Run snakemake as ordered, and its steps; return its exit status."""
    os.environ[ALGEBRA_THREADS] = "1"  # else numpy starts threads when it is imported, and no fork is safe
    for number in ENDING:  # the whole group gets them: this process ends when the others have
        signal.signal(number, signal.SIG_IGN)
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for module in _BOTH:
        importlib.import_module(module)
    snakemake: BaseProcess | None = None
    for module in _modules() if AT_ONCE in sys.argv else ():  # while the campaign is checked
        if snakemake is None and select.select([sys.stdin], [], [], 0)[0]:
            snakemake = _begun(there)
        importlib.import_module(module)
    snakemake = snakemake or _begun(there)
    there.close()
    if AT_ONCE in sys.argv:
        _import()
    _serve(here, snakemake)
    return _status(snakemake)


def _begun(requests: socket.socket) -> BaseProcess:
    """Start snakemake as ordered."""
    said = sys.stdin.buffer.read()
    if not said:  # the campaign is not fit to run
        sys.exit(2)
    order = Order(**json.loads(said))
    os.environ.update(order.environment)
    _redirect(ConfinedPath.referenced(order.output))
    snakemake = _fork(target=_child, args=(_snakemake, requests, order.arguments))
    snakemake.start()
    return snakemake


def _serve(requests: socket.socket, snakemake: BaseProcess) -> None:
    """Fork a process for each request until snakemake has ended; tell what became of each."""
    running: dict[int, tuple[BaseProcess, socket.socket]] = {}
    while snakemake.exitcode is None:
        for ready in wait([requests, snakemake.sentinel, *running]):
            if ready is requests:
                step, answer = _asked(requests)
                if step:
                    running[step.sentinel] = step, answer
            elif ready in running:
                step, answer = running.pop(ready)
                step.join()
                _tell(answer, _status(step))
                answer.close()
        if not snakemake.is_alive():
            break
    for step, _ in running.values():  # snakemake was killed alone
        step.terminate()
    for step, _ in running.values():
        step.join(_GRACE_S)
        step.kill()


def _asked(requests: socket.socket) -> tuple[BaseProcess | None, Any]:
    """Start the step of a request; return it and where its end is told."""
    data, files, _, _ = socket.recv_fds(requests, _LONGEST, 1)
    if not data:  # snakemake has ended
        return None, None
    _import()
    answer = socket.socket(fileno=files[0])
    step = _fork(target=_child, args=(_step, json.loads(data), answer))
    step.start()
    _tell(answer, step.pid or 0)
    return step, answer


def _tell(answer: socket.socket, number: int) -> None:
    with suppress(OSError):  # nobody listens any more
        answer.send(str(number).encode())


def _status(process: BaseProcess) -> int:
    """Return the exit status of a process as a shell does."""
    process.join()
    code = process.exitcode or 0
    return code if code >= 0 else SIGNALLED - code


def _modules() -> Sequence[str]:
    steps = sorted({rule.module for rule in RULES.values() if not rule.on_demand})
    return *_LIBRARIES, *steps, "apertura.__main__", "apertura.cli"


def _import() -> None:
    """Import what steps need, once, and do what each of them would do first."""
    if gc.get_freeze_count():
        return
    for name in _modules():
        importlib.import_module(name)
    from numba.core.registry import cpu_target

    from apertura.common.provenance import code_sha256, software

    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
    software()
    code_sha256(*(rule.module for rule in RULES.values()))
    gc.collect()
    gc.freeze()  # what stands here is never looked at again: pages stay shared


def _redirect(file: ConfinedPath) -> None:
    """Have standard output and error go to a file."""
    output = file.descriptor(os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.close(output)


def _child(work: Callable[..., None], *arguments: Any) -> None:
    """Do some work in a process that ends with its parent, and upon signals."""
    die_with_parent(os.getppid())
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL)
    work(*arguments)


# ---- In the process of snakemake ------------------------------------------------------------------------------------


def _snakemake(requests: socket.socket, arguments: Sequence[str]) -> None:
    """Be snakemake with a journal, whose shell asks for steps."""
    sys.argv[1:] = arguments
    module: Any = importlib.import_module("snakemake.shell")  # of which the package has a class of that name
    module.sp = Shell(requests)
    importlib.import_module("apertura.run.recorder").record()


class Shell:
    """Stands for the module `subprocess` in snakemake's shell: steps are asked for, all else is started.

    Parameters
    ----------
    requests
        Where to ask.
    """

    def __init__(self, requests: socket.socket) -> None:
        self._requests = requests

    def __getattr__(self, name: str) -> Any:
        return getattr(subprocess, name)

    def Popen(self, command: str, **how: Any) -> Any:  # noqa: N802 - as subprocess calls it
        """Return the process of a command, as `subprocess.Popen` does; it begins no later than it is waited for."""
        found = _COMMAND.fullmatch(command)
        if found and how.get("stdout") != subprocess.PIPE:
            words, log = found[1].split(), found[2]
            asked = {"words": words, "log": log, "folder": str(Path.cwd()), "environment": dict(how["env"])}
            data = json.dumps(asked).encode()
            if len(data) < _LONGEST:
                return StepProcess(self._requests, data)
        return subprocess.Popen(command, **how)


class StepProcess:
    """A step that was asked for, as `subprocess.Popen` has a process.

    Parameters
    ----------
    requests
        Where to ask.
    asked
        What for.
    """

    def __init__(self, requests: socket.socket, asked: bytes) -> None:
        self._answer, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        socket.send_fds(requests, [asked], [theirs.fileno()])
        theirs.close()
        self.pid = self._told()

    def _told(self) -> int:
        said = self._answer.recv(32)
        if not said:
            raise OSError("the process that runs steps has ended")
        return int(said)

    def wait(self) -> int:
        """Let it begin; return its exit status when it has ended."""
        with self._answer:
            self._answer.send(b"go")  # not before: who measures it has to find it
            return self._told()

    def terminate(self) -> None:
        """Ask it to end."""
        os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """End it."""
        os.kill(self.pid, signal.SIGKILL)


# ---- In the process of a step ---------------------------------------------------------------------------------------


def _step(asked: Mapping[str, Any], answer: socket.socket) -> None:
    """Be the command of a step, as if a shell had started it."""
    with answer:
        if answer.recv(2) != b"go":
            sys.exit(SIGNALLED)
    own = {name: os.environ[name] for name in TEMPORARY if name in os.environ}
    os.environ.clear()
    os.environ.update({name: value for name, value in asked["environment"].items() if name not in TEMPORARY} | own)
    tempfile.tempdir = None  # the environment says where
    os.chdir(asked["folder"])
    try:
        _redirect(ConfinedPath.at(asked["folder"]) / asked["log"])
    except CampaignError as error:
        leave_status(2)
        sys.exit(f"error: {error}")
    sys.argv = ["apertura", *asked["words"]]
    pkgutil.resolve_name("apertura.__main__:main")()


if __name__ == "__main__":
    sys.exit(main())
