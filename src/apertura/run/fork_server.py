"""Steps as forks of one process that has imported what they need: what `apertura run` starts on this machine.

``python -m apertura.run.fork_server`` reads what to run, forks snakemake, with a journal, and then a process for
each step that its executor asks for; it has no thread of its own. Log, benchmark, variables, signals and exit
status of a step are those of the command in its rule, which plain snakemake and other machines start as it stands.
"""

import gc
import importlib
import json
import multiprocessing
import os
import pkgutil
import resource
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import IO, Any

from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError
from apertura.common.processes import ALGEBRA_THREADS, CONFINED, ENDING, SIGNALLED, die_with_parent, leave_status
from apertura.run.journal import NAME as PLUGIN
from apertura.workflow.rules import RULES

NAME = "apertura.run.fork_server"
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
    "numba",
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

_LONGEST = 1 << 16  # bytes of a request
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
    snakemake = _fork(target=_child, args=(os.getpid(), _snakemake, requests, order.arguments))
    snakemake.start()
    return snakemake


def _serve(requests: socket.socket, snakemake: BaseProcess) -> None:
    """Fork a process for each request until snakemake has ended; tell what became of each."""
    running: dict[int, tuple[BaseProcess, int]] = {}
    while snakemake.is_alive():
        for ready in wait([requests, snakemake.sentinel, *running]):
            if ready is requests and (said := requests.recv(_LONGEST)):
                _import()
                asked = json.loads(said)
                begun = _fork(target=_child, args=(os.getpid(), _step, asked))
                begun.start()
                running[begun.sentinel] = begun, asked["job"]
            elif ready in running:
                step, job = running.pop(ready)
                with suppress(OSError):  # snakemake has ended
                    requests.send(json.dumps([job, _status(step)]).encode())
    for step, _ in running.values():
        step.terminate()
    for step, _ in running.values():
        step.join(_GRACE_S)
        step.kill()


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
    import numpy as np

    from apertura.common.provenance import code_sha256, software
    from apertura.core.backprojection.engines.reference import polynomial

    zero = np.zeros((1, 1), np.complex128)
    polynomial(zero, zero)  # the first call of compiled Python in a process fills numba's tables, in 0.2 s
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


def _child(parent: int, work: Callable[..., None], *arguments: Any) -> None:
    """Do some work in a process that ends with its parent, and upon signals."""
    die_with_parent(parent)
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL)
    work(*arguments)


# ---- In the process of snakemake ------------------------------------------------------------------------------------


def _snakemake(requests: socket.socket, arguments: Sequence[str]) -> None:
    """Be snakemake with a journal, whose executor asks for steps."""
    from snakemake_interface_executor_plugins.registry import ExecutorPluginRegistry

    executor = importlib.import_module("apertura.run.executor")
    ExecutorPluginRegistry().register_plugin(f"snakemake_executor_plugin_{PLUGIN}", executor)
    sys.argv[1:] = [f"--{PLUGIN}-requests={requests.fileno()}", *arguments]
    importlib.import_module("apertura.run.recorder").record()


# ---- In the process of a step ---------------------------------------------------------------------------------------


def _step(asked: Mapping[str, Any]) -> None:
    """Be the command of a step, as if a shell had started it; write what it took where it ends well."""
    began_s = time.monotonic()
    os.environ.update(asked["environment"])
    os.environ.pop(CONFINED, None)  # said to snakemake
    os.chdir(asked["folder"])
    sys.argv = ["apertura", *asked["words"]]
    folder = ConfinedPath.at(asked["folder"])
    try:
        _redirect(folder / asked["log"])
        try:
            pkgutil.resolve_name("apertura.__main__:main")()
        except SystemExit as ended:
            if ended.code:
                raise
        if asked["benchmark"]:
            (folder / asked["benchmark"]).write_text(_benchmark(time.monotonic() - began_s), encoding="ascii")
    except CampaignError as error:
        leave_status(2)
        sys.exit(f"error: {error}")


def _benchmark(wall_s: float) -> str:
    """Return what this process and those that it waited for took, as Snakemake's table of a job."""
    used = [resource.getrusage(whose) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    cpu_s = sum(one.ru_utime + one.ru_stime for one in used)
    row = {
        "s": f"{wall_s:.2f}",
        "h:m:s": str(timedelta(seconds=int(wall_s))),
        "max_rss": f"{max(one.ru_maxrss for one in used) / 1024:.2f}",  # MiB, of the largest process
        **dict.fromkeys(("max_vms", "max_uss", "max_pss"), "NA"),
        "io_in": f"{sum(one.ru_inblock for one in used) / 2048:.2f}",  # blocks of 512 bytes as MiB
        "io_out": f"{sum(one.ru_oublock for one in used) / 2048:.2f}",
        "mean_load": f"{100 * cpu_s / wall_s:.2f}",
        "cpu_time": f"{cpu_s:.2f}",
    }
    return "\t".join(row) + "\n" + "\t".join(row.values()) + "\n"


if __name__ == "__main__":
    sys.exit(main())
