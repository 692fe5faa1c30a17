"""roc-validator in a separate environment, because its requirements differ from those of apertura."""

import json
import subprocess
import sys
import tempfile
from importlib.resources import files
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
ENVIRONMENT = ROOT / "build" / "roc"
PYTHON = ENVIRONMENT / "bin" / "python"
LOCK = ROOT / "requirements" / "roc.txt"
PROFILE = "apertura-run-crate-1.0"
"""Name of the profile in folder `profile`: Provenance Run Crate 0.5 and hashes of all files."""


def make_environment() -> None:
    """Install the validator if its lock file has changed; raise `subprocess.CalledProcessError` on failure."""
    mark = ENVIRONMENT / ".lock"
    if mark.is_file() and mark.read_bytes() == LOCK.read_bytes():
        return
    uv = Path(sys.executable).with_name("uv")
    for command in (
        [sys.executable, "-m", "venv", "--clear", ENVIRONMENT],
        [uv, "pip", "sync", "--quiet", "--python", PYTHON, "--require-hashes", LOCK],
    ):
        subprocess.run(command, check=True, capture_output=True, text=True)
    mark.write_bytes(LOCK.read_bytes())


def issues(results: Path, *, profile: str = PROFILE) -> list[str]:
    """Return the issues that the validator reports for the crate in a results folder, one line each."""
    with tempfile.TemporaryDirectory() as scratch:
        cache, report = Path(scratch) / "cache", Path(scratch) / "report.json"
        context = files("rocrate") / "data" / "ro-crate.jsonld"
        subprocess.run([PYTHON, HERE / "contexts.py", cache, str(context)], check=True, capture_output=True)
        options = ["--offline", "--cache-path", cache, "--extra-profiles-path", HERE, "-p", profile, "-l", "required"]
        output = ["--verbose", "--no-paging", "-f", "json", "-o", report]
        command = [PYTHON.with_name("rocrate-validator"), "-y", "validate", *options, *output, results.absolute()]
        done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=scratch)
        if not report.is_file():
            raise RuntimeError(f"roc-validator wrote no report: {done.stderr[-2000:] or done.stdout[-2000:]}")
        document = json.loads(report.read_text(encoding="utf-8"))
    found = [f"{issue['check']['identifier']}: {issue['message']}" for issue in document["issues"]]
    return found if document["passed"] or found else ["the crate does not pass, without an issue reported"]
