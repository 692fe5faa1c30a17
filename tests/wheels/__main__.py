"""Install the wheels of `make wheel` in fresh environments, and simulate, run and show a campaign with each.

    python -m tests.wheels            # x86-64: every Python that exists, the pure wheel and the source distribution
    python -m tests.wheels --emulate  # aarch64 under qemu, compared with the image of this machine

No compiler, make, npm or git is on the PATH of an environment. Prints seconds and megabytes, and ends with status 1 at
the first failure. Folders are below ``build/wheel-test``.
"""

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Sequence
from pathlib import Path

from apertura.core.backprojection.engines import native_binding
from tests.wheels import aarch64

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "build" / "wheel-test"
VERSIONS = ("3.11", "3.12", "3.13")
PROGRAMS = ("sh", "bash")
"""All programs on the PATH of an environment besides its own: Snakemake starts a shell."""

MISSING_KERNEL = "no compiled kernel is installed"


def pythons() -> dict[str, Path]:
    """Return version → interpreter of the Pythons on PATH and in pyenv."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = {}
    for version in VERSIONS:
        installed = sorted(pyenv.glob(f"{version}.*/bin/python3"))
        if path := installed[-1] if installed else shutil.which(f"python{version}"):
            found[version] = Path(path)
    return found


def timed(command: Sequence[str | Path], environment: dict[str, str], log: Path) -> float:
    """Run a command with its output in a log file; return the wall-clock time, seconds."""
    begin = time.monotonic()
    with log.open("w") as output:
        done = subprocess.run(command, check=False, env=environment, stdout=output, stderr=subprocess.STDOUT)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}: status {done.returncode}\n{log.read_text()[-3000:]}")
    return time.monotonic() - begin


def shows_map(apertura: Path, campaign: Path, environment: dict[str, str]) -> int:
    """Start `apertura map`, fetch the script of the map and end the server; return the size of the script in bytes."""
    server = subprocess.Popen(
        [apertura, "map", campaign], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        text = ""
        while not (port := re.search(r"http://[^/\s]+:(\d+)", text)):
            line = server.stdout.readline()
            if not line:
                sys.exit(f"apertura map ended: {text}")
            text += line
        with urllib.request.urlopen(f"http://127.0.0.1:{port[1]}/map/app.js", timeout=30) as answer:
            return len(answer.read())
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(30)


def fresh(name: str, python: Path, wheel: Path, *, has_kernel: bool) -> None:
    """Install one file in a new environment and use it; print times and sizes."""
    folder = FOLDER / name
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "bin").mkdir(parents=True)
    for program in PROGRAMS:
        (folder / "bin" / program).symlink_to(shutil.which(program))
    venv, campaign = folder / "venv", folder / "campaign"
    environment = {"PATH": f"{venv}/bin:{folder}/bin", "HOME": str(folder)}
    environment |= {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "SSL_"))}
    subprocess.run([python, "-m", "venv", venv], check=True)
    install_s = timed([venv / "bin" / "pip", "install", wheel], environment, folder / "pip.log")
    used_mb = sum(path.stat().st_size for path in venv.rglob("*") if not path.is_symlink()) / 1e6
    apertura = venv / "bin" / "apertura"
    if has_kernel:
        simulate_s = timed([apertura, "simulate", campaign], environment, folder / "simulate.log")
    else:
        simulate_s = 0.0
        shutil.copytree(ROOT / ".test", campaign, ignore=shutil.ignore_patterns("results", ".snakemake"))
    run_s = timed([apertura, "run", campaign], environment, folder / "run.log")
    stated = MISSING_KERNEL in (folder / "run.log").read_text()
    if stated == has_kernel:
        sys.exit(f"{name}: the summary {'reports' if stated else 'does not report'} a missing kernel")
    reports = [json.loads(path.read_text()) for path in campaign.glob("results/*/*-*/image.json")]
    used = sorted({f"{report['engine']} ({report['instruction_set']})" for report in reports})
    if has_kernel and {report["instruction_set"] for report in reports} != {native_binding.instruction_set()}:
        sys.exit(f"{name}: images formed by {', '.join(used)}; this machine has {native_binding.instruction_set()}")
    script = shows_map(apertura, campaign, environment)
    print(
        f"{name:<14} pip install {install_s:.0f} s, {used_mb:.0f} MB; simulate {simulate_s:.0f} s; run {run_s:.0f} s, "
        f"{', '.join(used)}; "
        f"map: script of {script} bytes",
        flush=True,
    )
    shutil.rmtree(venv)


def only(pattern: str) -> Path:
    """Return the one file in dist that matches a pattern."""
    found = list((ROOT / "dist").glob(pattern))
    if len(found) != 1:
        sys.exit(f"dist/{pattern}: {len(found)} files; expected one, made by `make wheel`")
    return found[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--emulate", action="store_true", help="test the aarch64 wheel under qemu")
    if parser.parse_args().emulate:
        aarch64.test(FOLDER, only("*_2_17_aarch64.whl"))
        return
    wheel = only("*_2_17_x86_64.whl")
    for version, python in pythons().items():
        fresh(f"python{version}", python, wheel, has_kernel=True)
    python = next(iter(pythons().values()))
    fresh("pure", python, only("*-py3-none-any.whl"), has_kernel=False)
    fresh("sdist", python, only("*.tar.gz"), has_kernel=False)


if __name__ == "__main__":
    main()
