"""Snakemake with a journal: each start, end or failure of a job is recorded as a line of JSON.

``python -m apertura.run.recorder`` runs Snakemake with an additional logger plugin. The plugin is registered
explicitly, because Snakemake finds plugins only in installed top-level packages, not in editable installations.
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
    """Log handler that writes job events of Snakemake to the journal; the output of Snakemake is unchanged."""

    writes_to_stream = False
    writes_to_file = False
    has_filter = True
    has_formatter = True
    needs_rulegraph = False

    def emit(self, record: LogRecord) -> None:
        """Write a line for each event recorded in the journal."""
        line = _line(getattr(record, "event", None), record.__dict__)
        if line is not None:
            event, values = line
            note(ConfinedPath.referenced(os.environ[JOURNAL]), event, **values)


def _line(event: LogEvent | None, record: dict[str, Any]) -> tuple[str, dict[str, Any]] | None:
    """Convert an event of Snakemake to name and values of a journal line; None if the event is not recorded."""
    if event == LogEvent.RUN_INFO:
        return "planned", {"jobs": record["stats"]}
    if event == LogEvent.JOB_INFO:
        rule, wildcards = record["rule_name"], [*(record["wildcards"] or {}).values()]
        log = next(map(str, record["log"]), "")
        step = step_of(record["shellcmd"], rule, wildcards)
        return "begun", {"job": record["jobid"], "rule": rule, "step": step, "log": log}
    if event == LogEvent.JOB_FINISHED:
        return "finished", {"job": record["job_id"]}
    if event == LogEvent.JOB_ERROR:
        return "failed", {"job": record["jobid"]}
    if event == LogEvent.ERROR:
        return "said", {"message": record["msg"]}
    return None


def record() -> None:
    """Run Snakemake with the arguments of this process."""
    LoggerPluginRegistry().register_plugin(f"snakemake_logger_plugin_{NAME}", sys.modules[__name__])
    sys.argv[0] = "snakemake"  # prefix of Snakemake's messages
    if CONFINED in os.environ:
        journal = ConfinedPath.referenced(os.environ[JOURNAL])
        confine_changes(Path(os.environ.pop(CONFINED)), journal.parent.real())
    main()


if __name__ == "__main__":
    record()
