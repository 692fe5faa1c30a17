"""Snakemake executor plugin `apertura`: requests steps from `apertura.run.fork_server`, which forks a process per step.

Jobs that are not steps are passed to Snakemake's local executor.
"""

import json
import re
import socket
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from snakemake_interface_executor_plugins.executors.base import AbstractExecutor, SubmittedJobInfo
from snakemake_interface_executor_plugins.registry import ExecutorPluginRegistry
from snakemake_interface_executor_plugins.settings import CommonSettings, ExecutorSettingsBase

common_settings = CommonSettings(non_local_exec=False, implies_no_shared_fs=False, job_deploy_sources=False)

_COMMAND = re.compile(r"apertura (step(?: [\w.-]+)+) > ([\w./-]+) 2>&1")
"""Shell command of a step."""

_THREADS = (
    "OMP_NUM_THREADS",
    "GOTO_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)
"""Environment variables for the number of threads of a job, which Snakemake sets for shell commands."""


@dataclass
class ExecutorSettings(ExecutorSettingsBase):  # type: ignore[misc]  # the interface has no types
    """Options of the executor."""

    requests: int | None = field(
        default=None, metadata={"help": "file descriptor of the socket for step requests", "type": int}
    )


class Executor(AbstractExecutor):  # type: ignore[misc]
    """Executor that requests steps from the fork server and reports their completion to Snakemake.

    Parameters
    ----------
    workflow, logger
        Workflow and logger of Snakemake.
    """

    def __init__(self, workflow: Any, logger: Any) -> None:
        super().__init__(workflow, logger)
        self._local = ExecutorPluginRegistry().get_plugin("local").executor(workflow, logger)
        self._requests = socket.socket(fileno=workflow.executor_settings.requests)
        self._running: dict[int, SubmittedJobInfo] = {}
        threading.Thread(target=self._report, daemon=True).start()

    def run_job(self, job: Any) -> None:
        """Start a job."""
        step = None if job.is_group() or job.is_shadow else _COMMAND.fullmatch(job.shellcmd or "")
        if not step:
            self._local.run_job(job)
            return
        self.workflow.async_run(job.prepare())
        self._running[job.jobid] = info = SubmittedJobInfo(job)
        self._local.report_job_submission(info)  # marks the results of the job as incomplete
        request = {
            "job": job.jobid,
            "words": step[1].split(),
            "folder": str(Path.cwd()),
            "log": step[2],
            "benchmark": str(job.benchmark or ""),
            "environment": dict.fromkeys(_THREADS, str(job.threads)),
        }
        self._requests.send(json.dumps(request).encode())

    def _report(self) -> None:
        """Report the completion of each step to Snakemake."""
        while reply := self._requests.recv(64):
            job, status = json.loads(reply)
            info = self._running.pop(job)
            if status:
                self.report_job_error(info, msg=f"exit status {status}")
            else:
                self.report_job_success(info)

    def shutdown(self) -> None:
        """Wait for jobs that are not steps; steps are terminated together with the Snakemake process."""
        self._local.shutdown()

    cancel = shutdown

    def handle_job_success(self, job: Any) -> None:
        """Do nothing, because the job has already been reported to Snakemake."""

    handle_job_error = handle_job_success
