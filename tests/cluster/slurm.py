"""A Slurm of two nodes on this machine, from Debian's packages: start, query, disturb and stop it."""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

CONF = Path("/etc/slurm/slurm.conf")  # the only path that srun within a job reads
OURS = "# Written by tests/cluster"
NODES = ("node1", "node2")
_PROGRAMS = ("slurmctld", "slurmd", "srun", "sbatch", "squeue", "munged")
_PACKAGES = "slurmctld slurmd slurm-client munge"


def missing() -> str | None:
    """Return the reason that prevents Slurm from running on this machine, and the remedy; None if there is none."""
    if any(shutil.which(program) is None for program in _PROGRAMS):
        return f"Slurm is not installed: apt-get install --no-install-recommends {_PACKAGES}"
    if os.geteuid():
        return f"{CONF} must be writable: run this program as root in a container"
    if CONF.is_file() and not CONF.read_text(encoding="utf-8").startswith(OURS):
        return f"{CONF} belongs to another Slurm: remove it if this machine is not part of a cluster"
    return None


def output_of(*command: str) -> str:
    """Return the output of a command."""
    return subprocess.run(command, text=True, capture_output=True, check=True).stdout.strip()


def wait_for(what: str, happened: Callable[[], object], timeout_s: float = 60.0) -> None:
    """Wait until a condition holds; raise `TimeoutError` after a time limit."""
    deadline_s = time.monotonic() + timeout_s
    while not happened():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"{what}: not within {timeout_s:.0f} s")
        time.sleep(0.2)


@contextmanager
def running(root: Path) -> Iterator[None]:
    """Run a Slurm with its files in a folder."""
    for folder in ("ctld", "log", *(f"spool/{node}" for node in NODES)):
        (root / folder).mkdir(parents=True, exist_ok=True)
    munged = _munge()
    template = Path(__file__).with_name("slurm.conf.in").read_text(encoding="utf-8")
    host = output_of("hostname", "-s")
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20 // 2 - 256
    settings = {"ROOT": str(root), "HOST": host, "CPUS": str(os.cpu_count()), "MEM": str(memory)}
    for name, value in settings.items():
        template = template.replace(f"@{name}@", value)
    CONF.parent.mkdir(exist_ok=True)
    CONF.write_text(template, encoding="utf-8")

    def end() -> None:
        for node in NODES:
            with suppress(subprocess.CalledProcessError):  # the controller may have stopped
                kill(root, node)
        _end(root / "slurmctld.pid", signal.SIGTERM)
        if munged:
            _end(Path("/run/munge/munged.pid"), signal.SIGTERM)
        CONF.unlink(missing_ok=True)

    with _at_the_end(end):
        output_of("slurmctld", "-i")
        for node in NODES:
            start(node)
        wait_for("both nodes idle", lambda: all(state(node) == "idle" for node in NODES))
        yield


@contextmanager
def _at_the_end(end: Callable[[], None]) -> Iterator[None]:
    """Call `end` in a separate process when the body or this process has ended, even if it was killed."""
    read_end, write_end = os.pipe()  # closed with this process; child processes do not inherit it
    watcher = os.fork()
    if not watcher:
        try:
            os.setsid()  # not terminated by Ctrl-C or `make`
            for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
                signal.signal(number, signal.SIG_IGN)
            os.close(write_end)
            os.read(read_end, 1)
            end()
        finally:
            os._exit(0)
    os.close(read_end)
    try:
        yield
    finally:
        os.close(write_end)
        os.waitpid(watcher, 0)


def _munge() -> bool:
    """Start munge if it is not running; return True if it was started."""

    def works() -> bool:
        return subprocess.run("munge -n | unmunge", shell=True, capture_output=True, check=False).returncode == 0

    if not works():
        Path("/run/munge").mkdir(exist_ok=True)
        shutil.chown("/run/munge", "munge", "munge")
        output_of("su", "-s", "/bin/sh", "munge", "-c", "/usr/sbin/munged")
        wait_for("munge", works)
        return True
    return False


def start(node: str) -> None:
    """Start the daemon of a node."""
    output_of("slurmd", "-N", node)


def kill(root: Path, node: str) -> None:
    """Kill a node with SIGKILL: its daemons and all processes of its jobs."""
    _end(root / f"slurmd.{node}.pid", signal.SIGKILL)
    jobs = output_of("squeue", "-h", "-t", "running", "-w", node, "-o", "%A").split()
    for job in [f"slurmstepd: [{job}." for job in jobs] + [f"SLURM_JOB_ID={job}\0" for job in jobs]:
        for path in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if job.encode() in (path / "cmdline").read_bytes() + (path / "environ").read_bytes():
                    os.kill(int(path.name), signal.SIGKILL)


def state(node: str) -> str:
    """Return the state of a node, such as idle, mixed, drained, down."""
    return output_of("sinfo", "-h", "-n", node, "-o", "%T").rstrip("*")


def drain(node: str) -> None:
    """Drain a node, so that it accepts no further jobs."""
    output_of("scontrol", "update", f"nodename={node}", "state=drain", "reason=test")


def resume(node: str) -> None:
    """Resume a drained node."""
    output_of("scontrol", "update", f"nodename={node}", "state=resume")


def jobs(rule: str) -> dict[str, str]:
    """Return job → node of the running jobs of a rule or a group of rules."""
    lines = output_of("squeue", "-h", "-t", "running", "-o", "%A %N %k").splitlines()
    rows = (line.split(" ", 2) for line in lines)
    return {job: node for job, node, comment in rows if comment.startswith((f"rule_{rule}", f"group_{rule}"))}


def _end(pid_file: Path, number: signal.Signals) -> None:
    with suppress(OSError, ValueError):
        os.kill(int(pid_file.read_text(encoding="ascii")), number)
