"""What stands for `subprocess` where a module of apertura runs by ``python -m``: it then runs here, without a start."""

import runpy
import subprocess
import sys
import warnings
from contextlib import redirect_stderr
from io import StringIO
from unittest.mock import patch


class Processes:
    """`subprocess`, but for the process."""

    DEVNULL, TimeoutExpired = subprocess.DEVNULL, subprocess.TimeoutExpired

    @staticmethod
    def run(command, **_):
        """Run ``python … -m module words`` in this process; limits that it sets itself are not set."""
        words, said, status = command[command.index("-m") + 1 :], StringIO(), 0
        with patch.object(sys, "argv", words), patch("resource.setrlimit"), redirect_stderr(said):
            try:
                with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # it is imported already
                    runpy.run_module(words[0], run_name="__main__")
            except SystemExit as end:
                status = int(end.code or 0)
        return subprocess.CompletedProcess(command, status, b"", said.getvalue().encode())
