"""What the process that steps are forks of is asked for: steps, by their whole command, and nothing else."""

import json
import os
import socket
import subprocess
import threading
from pathlib import Path

import pytest

from apertura.run.warm import Shell

STEP = "set -euo pipefail;  apertura step image f01 uav1-uav2 --threads 2 > results/logs/f01/uav1-uav2.image.log 2>&1"


@pytest.fixture
def ends():
    """Both ends of where steps are asked for."""
    with (pair := socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET))[0], pair[1]:
        yield pair


def test_a_step_is_asked_for_with_its_words_log_folder_and_environment_and_ends_with_its_status(ends):
    asked, begun = {}, []

    def serve():
        data, (file,), _, _ = socket.recv_fds(ends[1], 1 << 17, 1)
        asked.update(json.loads(data))
        with socket.socket(fileno=file) as answer:
            answer.send(b"4711")
            begun.append(answer.recv(2))
            answer.send(b"130")

    server = threading.Thread(target=serve)
    server.start()
    step = Shell(ends[0]).Popen(STEP, shell=True, env={"OPENBLAS_NUM_THREADS": "2"})
    assert step.pid == 4711
    assert begun == []  # whoever measures the process has to find it
    assert step.wait() == 130
    server.join()
    assert begun == [b"go"]
    assert asked == {
        "words": ["step", "image", "f01", "uav1-uav2", "--threads", "2"],
        "log": "results/logs/f01/uav1-uav2.image.log",
        "folder": str(Path.cwd()),
        "environment": {"OPENBLAS_NUM_THREADS": "2"},
    }


def test_a_process_that_has_ended_is_told_and_not_waited_for(ends):
    threading.Thread(target=lambda: os.close(socket.recv_fds(ends[1], 1 << 17, 1)[1][0])).start()
    with pytest.raises(OSError, match="has ended"):
        Shell(ends[0]).Popen(STEP, shell=True, env={})


@pytest.mark.parametrize(
    "command",
    [
        "set -euo pipefail;  apertura summary 2> /dev/null || true",
        "source activate env; set -euo pipefail;  apertura step scene > a.log 2>&1",
        "set -euo pipefail;  apertura step scene; touch x > a.log 2>&1",
        "set -euo pipefail;  apertura step echo f01 $(touch x) > a.log 2>&1",
        "set -euo pipefail;  apertura step echo 'f01' > a.log 2>&1",
        "set -euo pipefail;  apertura step scene > a.log 2>&1 && touch x",
        "set -euo pipefail;  apertura step scene > a b.log 2>&1",
    ],
)
def test_any_other_command_goes_to_a_shell_as_it_stands(ends, monkeypatch, command):
    started = []
    monkeypatch.setattr(subprocess, "Popen", lambda words, **how: started.append((words, how)))
    Shell(ends[0]).Popen(command, shell=True, env={})
    assert started == [(command, {"shell": True, "env": {}})]
    ends[1].setblocking(False)
    with pytest.raises(BlockingIOError):
        ends[1].recv(1)


def test_a_step_whose_output_snakemake_wants_to_read_goes_to_a_shell(ends):
    with Shell(ends[0]).Popen("exit 3", shell=True, stdout=subprocess.PIPE, env=os.environ) as process:
        assert process.wait() == 3
