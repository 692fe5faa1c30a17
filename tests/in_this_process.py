"""Replacement for `subprocess` in modules that run ``python -m``: the module runs in this process."""

import runpy
import subprocess
import sys
import warnings
from contextlib import redirect_stderr
from io import StringIO
from unittest.mock import patch


class Processes:
    """`subprocess` without the process."""

    DEVNULL, TimeoutExpired = subprocess.DEVNULL, subprocess.TimeoutExpired

    @staticmethod
    def run(command, **_):
        """Run ``python … -m module words`` in this process, without the resource limits that the module sets."""
        words, stderr, status = command[command.index("-m") + 1 :], StringIO(), 0
        with patch.object(sys, "argv", words), patch("resource.setrlimit"), redirect_stderr(stderr):
            try:
                with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # already imported
                    runpy.run_module(words[0], run_name="__main__")
            except SystemExit as end:
                status = int(end.code or 0)
        return subprocess.CompletedProcess(command, status, b"", stderr.getvalue().encode())
