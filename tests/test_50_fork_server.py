"""Fork server of steps: the executor sends exactly the jobs that are plain step commands to the server."""

import csv
import json
import queue
import socket
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from snakemake.benchmark import BenchmarkRecord

from apertura.run.executor import Executor
from apertura.run.fork_server import _benchmark

STEP = "apertura step image f01 uav1-uav2 --threads 2 > results/logs/f01/uav1-uav2.image.log 2>&1"


class Workflow(SimpleNamespace):
    """Stub of Snakemake's workflow for an executor, which records the ends of jobs."""

    def __init__(self, requests):
        self.ends = queue.Queue()
        super().__init__(
            dag=None,
            main_snakefile="Snakefile",
            executor_settings=SimpleNamespace(requests=requests.detach()),
            execution_settings=SimpleNamespace(use_threads=False, keep_incomplete=False),
            resource_settings=SimpleNamespace(cores=2),
            async_run=lambda *_, **__: None,
            scheduler=SimpleNamespace(
                submit_callback=lambda *_, **__: None,
                finish_callback=lambda job: self.ends.put((job.jobid, "finished")),
                error_callback=lambda job: self.ends.put((job.jobid, "failed")),
            ),
        )


def job(command, jobid=1, **attributes):
    return SimpleNamespace(
        **{"is_shadow": False, "benchmark": "results/benchmarks/f01/uav1-uav2.image.tsv", **attributes},
        jobid=jobid,
        shellcmd=command,
        threads=2,
        is_group=lambda: False,
        prepare=lambda: None,
        register=lambda *_, **__: None,
        log_error=lambda *_, **__: None,
    )


@pytest.fixture
def executor_and_server():
    """Return an executor and the server end of its socket."""
    client, server = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with server:
        server.settimeout(10)
        yield Executor(Workflow(client), None), server


def test_steps_are_requested_with_their_arguments_and_results(executor_and_server):
    executor, server = executor_and_server
    executor.run_job(job(STEP))
    executor.run_job(job(STEP, jobid=2))
    step, second = (json.loads(server.recv(1 << 16)) for _ in range(2))
    assert second == {**step, "job": 2}
    assert set(step.pop("environment").values()) == {"2"}
    assert step == {
        "job": 1,
        "words": ["step", "image", "f01", "uav1-uav2", "--threads", "2"],
        "log": "results/logs/f01/uav1-uav2.image.log",
        "benchmark": "results/benchmarks/f01/uav1-uav2.image.tsv",
        "folder": str(Path.cwd()),
    }
    for end in (b"[2, 130]", b"[1, 0]"):
        server.send(end)
    assert [executor.workflow.ends.get(timeout=10) for _ in range(2)] == [(2, "failed"), (1, "finished")]


@pytest.mark.parametrize(
    ("command", "attributes"),
    [
        (None, {}),
        ("apertura summary 2> /dev/null || true", {}),
        ("source activate env; apertura step scene > a.log 2>&1", {}),
        ("apertura step scene; touch x > a.log 2>&1", {}),
        ("apertura step echo f01 $(touch x) > a.log 2>&1", {}),
        ("apertura step echo 'f01' > a.log 2>&1", {}),
        ("apertura step scene > a.log 2>&1 && touch x", {}),
        ("apertura step scene > a b.log 2>&1", {}),
        (STEP, {"is_shadow": True}),
    ],
)
def test_other_jobs_are_run_by_snakemakes_executor(executor_and_server, monkeypatch, command, attributes):
    executor, server = executor_and_server
    local_jobs = []
    monkeypatch.setattr(executor._local, "run_job", local_jobs.append)
    other = job(command, **attributes)
    executor.run_job(other)
    assert local_jobs == [other]
    server.setblocking(False)
    with pytest.raises(BlockingIOError):
        server.recv(1)


def test_benchmark_has_the_columns_of_snakemake():
    header, row = csv.reader(_benchmark(90061.5).splitlines(), delimiter="\t")
    assert header == BenchmarkRecord.get_header()
    benchmark = dict(zip(header, row, strict=True))
    assert (benchmark["s"], benchmark["h:m:s"], benchmark["max_pss"]) == ("90061.50", "1 day, 1:01:01", "NA")
    assert float(benchmark["max_rss"]) > 10  # MiB, of this process
    assert 0 < float(benchmark["cpu_time"]) <= time.process_time() + 60
