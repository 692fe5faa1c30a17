"""snakemake with a journal: every job that begins, ends or fails as a line of JSON.

``python -m apertura.run.recorder`` is snakemake with one logger plugin more. Snakemake looks for plugins
among installed top-level packages only, and finds none that is editable; here it is handed over.
"""

import os
import sys
from logging import LogRecord
from pathlib import Path
from typing import Any

from snakemake.cli import main
from snakemake_interface_logger_plugins.base import LogHandlerBase
from snakemake_interface_logger_plugins.common import LogEvent
from snakemake_interface_logger_plugins.registry import LoggerPluginRegistry

from apertura.common.confined import ConfinedPath
from apertura.common.processes import CONFINED, confine_changes
from apertura.run.journal import JOURNAL, NAME, note, step_of


class LogHandler(LogHandlerBase):
    """Writes what snakemake says of jobs to the journal; its own output stays as it is."""

    writes_to_stream = False
    writes_to_file = False
    has_filter = True
    has_formatter = True
    needs_rulegraph = False

    def emit(self, record: LogRecord) -> None:
        """Write a line for each event that the journal keeps."""
        line = _line(getattr(record, "event", None), record.__dict__)
        if line is not None:
            event, told = line
            note(ConfinedPath.referenced(os.environ[JOURNAL]), event, **told)


def _line(event: LogEvent | None, said: dict[str, Any]) -> tuple[str, dict[str, Any]] | None:
    """Return what the journal keeps of an event of snakemake."""
    if event == LogEvent.RUN_INFO:
        return "planned", {"jobs": said["stats"]}
    if event == LogEvent.JOB_INFO:
        rule, wildcards = said["rule_name"], [*(said["wildcards"] or {}).values()]
        log = next(map(str, said["log"]), "")
        step = step_of(said["shellcmd"], rule, wildcards)
        return "begun", {"job": said["jobid"], "rule": rule, "step": step, "log": log}
    if event == LogEvent.JOB_FINISHED:
        return "finished", {"job": said["job_id"]}
    if event == LogEvent.JOB_ERROR:
        return "failed", {"job": said["jobid"]}
    if event == LogEvent.ERROR:
        return "said", {"message": said["msg"]}
    return None


def record() -> None:
    """Run snakemake with the arguments of this process."""
    LoggerPluginRegistry().register_plugin(f"snakemake_logger_plugin_{NAME}", sys.modules[__name__])
    sys.argv[0] = "snakemake"  # its messages begin with it
    if CONFINED in os.environ:
        journal = ConfinedPath.referenced(os.environ[JOURNAL])
        confine_changes(Path(os.environ.pop(CONFINED)), journal.parent.real())
    main()


if __name__ == "__main__":
    record()
