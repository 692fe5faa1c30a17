"""Fork server of `apertura run`: steps are forks of a single process that has imported their modules.

``python -m apertura.run.fork_server`` reads an order, forks Snakemake with a journal, and then forks a process for each
step requested by the executor of Snakemake. The fork server has no threads. Log, benchmark, variables, signals and exit
status of a step are those of the shell command in its rule, which plain Snakemake and other machines run directly.
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
"""Name of this module."""
AT_ONCE = "--at-once"
"""Argument with which the modules of steps are imported immediately, because steps will be requested."""

_BOTH = ("apertura.check", "apertura.workflow.jobs", "apertura.workflow.stale")
"""Modules that are also imported in the process of Snakemake."""

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
"""Modules that most steps import within functions."""

_LONGEST = 1 << 16  # maximum size of a request, bytes
_GRACE_S = 2.0
_fork = multiprocessing.get_context("fork").Process


@dataclass(frozen=True)
class Order:
    """Order to run Snakemake, sent as JSON on standard input; without an order, nothing is run.

    Attributes
    ----------
    arguments
        Arguments of Snakemake.
    environment
        Environment variables in addition to those of this process.
    output
        File for all output, given as `ConfinedPath.reference`.
    """

    arguments: Sequence[str]
    environment: Mapping[str, str]
    output: str

    def give(self, stream: IO[bytes]) -> None:
        """Write the order, and close the stream."""
        with stream:
            stream.write(json.dumps(vars(self)).encode())


def main() -> int:
    """Run Snakemake as ordered, and its steps; return the exit status of Snakemake."""
    os.environ[ALGEBRA_THREADS] = "1"  # otherwise numpy starts threads on import, which makes forks unsafe
    for number in ENDING:  # signals are sent to the whole group: this process exits after the other processes
        signal.signal(number, signal.SIG_IGN)
    own_end, snakemake_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for module in _BOTH:
        importlib.import_module(module)
    snakemake: BaseProcess | None = None
    for module in _modules() if AT_ONCE in sys.argv else ():  # during the check of the campaign
        if snakemake is None and select.select([sys.stdin], [], [], 0)[0]:
            snakemake = _start_snakemake(snakemake_end)
        importlib.import_module(module)
    snakemake = snakemake or _start_snakemake(snakemake_end)
    snakemake_end.close()
    if AT_ONCE in sys.argv:
        _import()
    _serve(own_end, snakemake)
    return _status(snakemake)


def _start_snakemake(requests: socket.socket) -> BaseProcess:
    """Read the order and start Snakemake."""
    received = sys.stdin.buffer.read()
    if not received:  # the check found problems
        sys.exit(2)
    order = Order(**json.loads(received))
    os.environ.update(order.environment)
    _redirect(ConfinedPath.referenced(order.output))
    snakemake = _fork(target=_child, args=(os.getpid(), _snakemake, requests, order.arguments))
    snakemake.start()
    return snakemake


def _serve(requests: socket.socket, snakemake: BaseProcess) -> None:
    """Fork a process for each request until Snakemake has exited, and report the exit status of each process."""
    running: dict[int, tuple[BaseProcess, int]] = {}
    while snakemake.is_alive():
        for ready in wait([requests, snakemake.sentinel, *running]):
            if ready is requests and (received := requests.recv(_LONGEST)):
                _import()
                request = json.loads(received)
                process = _fork(target=_child, args=(os.getpid(), _step, request))
                process.start()
                running[process.sentinel] = process, request["job"]
            elif ready in running:
                step, job = running.pop(ready)
                with suppress(OSError):  # Snakemake has exited
                    requests.send(json.dumps([job, _status(step)]).encode())
    for step, _ in running.values():
        step.terminate()
    for step, _ in running.values():
        step.join(_GRACE_S)
        step.kill()


def _status(process: BaseProcess) -> int:
    """Return the exit status of a process according to the convention of shells."""
    process.join()
    code = process.exitcode or 0
    return code if code >= 0 else SIGNALLED - code


def _modules() -> Sequence[str]:
    steps = sorted({rule.module for rule in RULES.values() if not rule.on_demand})
    return *_LIBRARIES, *steps, "apertura.__main__", "apertura.cli"


def _import() -> None:
    """Import the modules of steps, once, and run the initialisation common to all steps."""
    if gc.get_freeze_count():
        return
    for name in _modules():
        importlib.import_module(name)
    import numpy as np

    from apertura.common.provenance import code_sha256, software
    from apertura.core.backprojection.engines.reference import polynomial

    zero = np.zeros((1, 1), np.complex128)
    polynomial(zero, zero)  # the first call of a compiled function initialises tables of numba, which takes 0.2 s
    software()
    code_sha256(*(rule.module for rule in RULES.values()))
    gc.collect()
    gc.freeze()  # existing objects are excluded from garbage collection, so that their pages stay shared


def _redirect(file: ConfinedPath) -> None:
    """Redirect standard output and error to a file."""
    output = file.descriptor(os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.close(output)


def _child(parent: int, work: Callable[..., None], *arguments: Any) -> None:
    """Run a function in a process that is terminated by signals, and when its parent exits."""
    die_with_parent(parent)
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL)
    work(*arguments)


# ---- In the process of Snakemake ------------------------------------------------------------------------------------


def _snakemake(requests: socket.socket, arguments: Sequence[str]) -> None:
    """Run Snakemake in this process, with a journal and with the executor that requests steps."""
    from snakemake_interface_executor_plugins.registry import ExecutorPluginRegistry

    executor = importlib.import_module("apertura.run.executor")
    ExecutorPluginRegistry().register_plugin(f"snakemake_executor_plugin_{PLUGIN}", executor)
    sys.argv[1:] = [f"--{PLUGIN}-requests={requests.fileno()}", *arguments]
    importlib.import_module("apertura.run.recorder").record()


# ---- In the process of a step ---------------------------------------------------------------------------------------


def _step(request: Mapping[str, Any]) -> None:
    """Run the command of a step in this process like a shell; write the benchmark if the command succeeds."""
    start_s = time.monotonic()
    os.environ.update(request["environment"])
    os.environ.pop(CONFINED, None)  # applies to Snakemake only
    os.chdir(request["folder"])
    sys.argv = ["apertura", *request["words"]]
    folder = ConfinedPath.at(request["folder"])
    try:
        _redirect(folder / request["log"])
        try:
            pkgutil.resolve_name("apertura.__main__:main")()
        except SystemExit as end:
            if end.code:
                raise
        if request["benchmark"]:
            (folder / request["benchmark"]).write_text(_benchmark(time.monotonic() - start_s), encoding="ascii")
    except CampaignError as error:
        leave_status(2)
        sys.exit(f"error: {error}")


def _benchmark(wall_s: float) -> str:
    """Return the resource usage of this process and its children in the format of Snakemake's benchmark table."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    cpu_s = sum(usage.ru_utime + usage.ru_stime for usage in usages)
    row = {
        "s": f"{wall_s:.2f}",
        "h:m:s": str(timedelta(seconds=int(wall_s))),
        "max_rss": f"{max(usage.ru_maxrss for usage in usages) / 1024:.2f}",  # MiB, of the largest process
        **dict.fromkeys(("max_vms", "max_uss", "max_pss"), "NA"),
        "io_in": f"{sum(usage.ru_inblock for usage in usages) / 2048:.2f}",  # blocks of 512 bytes as MiB
        "io_out": f"{sum(usage.ru_oublock for usage in usages) / 2048:.2f}",
        "mean_load": f"{100 * cpu_s / wall_s:.2f}",
        "cpu_time": f"{cpu_s:.2f}",
    }
    return "\t".join(row) + "\n" + "\t".join(row.values()) + "\n"


if __name__ == "__main__":
    sys.exit(main())
