"""`python tests/snakemake_jobs.py OPTIONS`: snakemake, printing every planned job as a line of JSON.

For a rule with a message, Snakemake prints the message instead of inputs and outputs; a logger plugin receives all.
"""

import json
import sys

from snakemake.cli import main
from snakemake_interface_logger_plugins.base import LogHandlerBase
from snakemake_interface_logger_plugins.common import LogEvent
from snakemake_interface_logger_plugins.registry import LoggerPluginRegistry


class LogHandler(LogHandlerBase):
    """Logger plugin that prints jobs, and error messages unchanged."""

    writes_to_stream = True
    writes_to_file = False
    has_filter = True
    has_formatter = True
    needs_rulegraph = False

    def emit(self, record):
        event = getattr(record, "event", None)
        if event == LogEvent.JOB_INFO:
            job = {"rule": record.rule_name, "wildcards": dict(record.wildcards or {})}
            print(json.dumps({**job, "input": list(record.input or []), "output": list(record.output or [])}))
        elif event in {None, LogEvent.ERROR}:
            print(getattr(record, "msg", ""), file=sys.stderr)


if __name__ == "__main__":
    LoggerPluginRegistry().register_plugin("snakemake_logger_plugin_jobs", sys.modules[__name__])
    sys.argv += ["--logger", "jobs"]
    main()
