"""Exit of commands: one message and a defined exit status for errors, signals and exhausted resources."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

APERTURA = Path(sys.executable).parent / "apertura"


def run(*words, **options):
    return subprocess.run([APERTURA, *map(str, words)], text=True, capture_output=True, check=False, **options)


@pytest.mark.slow
def test_folder_without_campaign_is_one_line_and_status_2(tmp_path):
    done = run("check", tmp_path / "nowhere")
    assert done.returncode == 2
    assert done.stdout.count("\n") == 1
    done = run("plan", tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_every_problem_is_a_separate_line(tiny):
    (tiny / "raw/f01/uav1.sigmf-data").unlink()
    (tiny / "raw/codes.npy").write_bytes(b"x")
    done = run("check", tiny)
    assert done.returncode == 2
    assert [line.partition(": ")[0] for line in done.stdout.splitlines()] == [
        f"{tiny}/raw/f01/uav1.sigmf-data",
        f"{tiny}/raw/codes.npy",
    ]


@pytest.mark.slow
def test_closed_output_pipe_ends_a_command_silently(finished_tiny):
    """The exit status of `apertura summary | true` is 128 plus the number of SIGPIPE."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as closed:
        command = [APERTURA, "summary", str(finished_tiny.root)]
        done = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_full_disk_for_the_output_is_one_message(finished_tiny):
    with Path("/dev/full").open("w") as full:
        command = [APERTURA, "summary", str(finished_tiny.root)]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: output: No space left on device (ENOSPC)")
    assert done.stderr.count("\n") == 1


@pytest.mark.quick("15")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_signal_ends_a_step_with_a_message_and_status_130(tiny, number):
    code = "import time; from apertura import cli; cli.app = lambda: time.sleep(60); print('up', flush=True)"
    code += "; cli.main()"
    step = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert step.stdout.readline() == "up\n"
    time.sleep(0.2)
    step.send_signal(number)
    assert step.communicate(timeout=30)[1] == f"error: interrupted by {number.name}\n"
    assert step.returncode == 130


def test_internal_error_shows_a_traceback_with_status_1():
    code = "from apertura import cli; cli.app = lambda: 1 / 0; cli.main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "ZeroDivisionError" in done.stderr


def test_out_of_memory_is_one_message():
    code = "import numpy; from apertura import cli; cli.app = lambda: numpy.empty(1 << 50); cli.main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: out of memory")
    assert done.stderr.count("\n") == 1


@pytest.mark.quick("words0")
@pytest.mark.parametrize("words", [(), ("paper-part", "effects"), ("sweep", "stability", "--folder", "x"), ("--help",)])
def test_missing_study_distribution_is_one_message(words):
    """Only apertura is installed, and no other distribution provides commands."""
    code = (
        "import importlib.metadata as metadata, sys\n"
        "metadata.entry_points = lambda **_: ()\n"
        "from apertura.cli import main\n"
        "main()\n"
    )
    command = [sys.executable, "-c", code, "study", *words]
    done = subprocess.run(command, text=True, capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert "the studies are not installed" in done.stderr
    assert "pip install ./research" in done.stderr


@pytest.mark.slow
def test_study_commands_exist_if_their_distribution_is_installed():
    done = run("study", "--help")
    assert done.returncode == 0
    assert "paper-part" in done.stdout


@pytest.mark.slow
def test_study_reads_its_results_from_the_current_directory(tmp_path):
    done = run("study", "chart", "stability", "timing", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: results/study/stability/parts/timing.none.csv: ")
