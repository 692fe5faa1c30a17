"""The workflow as users run it: repeated runs, killed runs, signals, changed inputs, messages and exit status."""

import contextlib
import os
import shutil
import signal
import time
from pathlib import Path

import pytest
import yaml
from folders import apertura, copy_writable, finished, snakemake

from apertura.campaign.folder import Campaign
from apertura.common.processes import hold
from apertura.workflow.stale import stale_results


def contents(root):
    """Return every product and chunk, except logs, timings and Snakemake's records."""
    results = root / "results"
    files = {path.relative_to(results): path for path in sorted(results.rglob("*")) if path.is_file()}
    return {
        name.as_posix(): path.read_bytes()
        for name, path in files.items()
        if name.parts[0] != "logs" and path.suffix != ".tsv" and not name.parts[0].startswith(".")
    }


TO_IMAGES = ("--until", "image")
"""Option for runs that are killed and resumed; later products are derived from the images."""


def configure_many_tiles(root):
    """Configure more tiles, so that imaging takes a few seconds."""
    path = root / "config" / "config.yaml"
    document = yaml.safe_load(path.read_text())
    document["scene"]["spacing_m"] = 0.01
    document["processing"] = {"tile_px": 64, "engine": "numba"}
    path.write_text(yaml.safe_dump(document))


@pytest.mark.slow
def test_campaign_name_with_wildcards_is_text(tiny):
    path = tiny / "config" / "config.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"campaign": "{{7*7}} {config} {flight} %s"}))
    code, output = finished(snakemake(tiny, "-n", "all", "pages", "phase_history", "whole_chart"))
    assert code == 0, output
    assert "Job stats" in output


@pytest.mark.slow
def test_changed_setting_reruns_only_dependent_steps(run_by_snakemake, tmp_path):
    root = Path(shutil.copytree(run_by_snakemake, tmp_path / "campaign"))  # keeps modification times
    code, output = finished(snakemake(root, "-n", "--set-scatter", "tiles=2"))
    assert code == 0
    assert "Nothing to be done" in output
    path = root / "config" / "config.yaml"
    path.write_text(path.read_text() + "processing:\n  window: none\n")
    code, output = finished(snakemake(root, "-n", "--set-scatter", "tiles=2"))
    assert code == 0
    planned = {line.split()[0] for line in output.split("Job stats:")[1].split("total")[0].splitlines()[3:] if line}
    assert planned == {
        "all",
        "assess",
        "coverage",
        "cube",
        "export",
        "export_fused",
        "image",
        "layers",
        "map",
        "mosaic",
        "profile",
        "refine",
        "ro_crate",
        "stac",
        "tiles",
        "tracks",
    }


def tiles(root):
    chunks = (root / "results" / "f01").glob("*/image.zarr.wip/image/c/*/*")
    return [path for path in chunks if path.suffix != ".partial"]


def lines_of(folder, pattern):
    return [line for path in folder.glob(pattern) for line in path.read_text().splitlines()]


def wait_for_tiles(root, process, count=5, timeout=120):
    deadline_s = time.monotonic() + timeout
    while len(tiles(root)) < count:
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline_s, "no tiles"
        time.sleep(0.02)
    return len(tiles(root))


@pytest.fixture(scope="session")
def uninterrupted(_tiny, made_once):
    """Return the contents of results up to the images of an uninterrupted run."""

    def run(root):
        configure_many_tiles(copy_writable(_tiny, root))
        code, output = finished(apertura("run", root, *TO_IMAGES))
        assert code == 0, output

    return contents(made_once("uninterrupted", run))


@pytest.mark.slow
@pytest.mark.parametrize("whole_group", [True, False], ids=["process group", "snakemake alone"])
def test_killed_run_resumes_from_its_tiles_with_identical_results(tiny, uninterrupted, whole_group):
    configure_many_tiles(tiny)
    process = snakemake(tiny, *TO_IMAGES, start_new_session=True)
    finished_tiles = wait_for_tiles(tiny, process)
    if whole_group:
        os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()
    process.stdout.close()
    code, output = finished(apertura("run", tiny, *TO_IMAGES))
    assert code == 0, output
    log = lines_of(tiny / "results" / "logs" / "f01", "*.image.log")
    formed_again = sum(int(line.split()[1]) for line in log if line.startswith("forming "))
    assert formed_again <= 2 * 100 - finished_tiles
    assert contents(tiny) == uninterrupted
    assert not list((tiny / "results").rglob("*.wip"))


@pytest.mark.slow
def test_killed_run_with_scattered_tiles_gives_identical_results(tiny, uninterrupted):
    configure_many_tiles(tiny)
    process = snakemake(tiny, *TO_IMAGES, "--set-scatter", "tiles=3", start_new_session=True)
    finished_tiles = wait_for_tiles(tiny, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    receipt = tiny / "results/f01/uav1-uav1/tiles/1-of-3.json"  # receipt of a group of tiles finished before the kill
    receipt.parent.mkdir(exist_ok=True)
    receipt.write_text("{}")
    code, output = finished(apertura("run", tiny, *TO_IMAGES, "--set-scatter", "tiles=4"))
    assert code == 0, output
    logs = tiny / "results" / "logs" / "f01"
    by_shares, by_image = (
        sum(int(line.split()[1]) for line in lines_of(logs, pattern) if line.startswith("forming "))
        for pattern in ("*.tiles.*-of-4.log", "*.image.log")
    )
    assert 0 < by_shares <= 2 * 100 - finished_tiles
    assert by_image == 0
    assert contents(tiny) == uninterrupted
    assert not list((tiny / "results").rglob("*.wip"))


@pytest.mark.slow
def test_invalid_campaign_ends_with_a_message(tiny):
    (tiny / "raw" / "f01" / "uav2.sigmf-data").unlink()
    code, output = finished(snakemake(tiny))
    assert code != 0
    assert "raw/f01/uav2.sigmf-data: no such file; expected the recording of node uav2" in output
    assert "Traceback" not in output
    assert not (tiny / "results").exists()


@pytest.mark.slow
def test_message_of_a_failing_step_is_printed_by_the_run(tiny):
    path = tiny / "raw" / "f01" / "uav1.sigmf-data"
    data = bytearray(path.read_bytes())
    data[4000] ^= 1
    path.write_bytes(data)
    code, output = finished(snakemake(tiny))
    assert code != 0
    assert "uav1.sigmf-data: sha512" in output
    assert "Traceback" not in output


@pytest.mark.slow
def test_errors_in_headers_end_a_run_before_any_step(tiny):
    path = tiny / "raw" / "f01" / "uav1.sigmf-data"
    path.write_bytes(path.read_bytes()[:-4000])
    for run in (snakemake(tiny), apertura("run", tiny)):
        code, output = finished(run)
        assert code != 0
        assert "raw/f01/uav1.sigmf-meta: capture" in output
        assert "Traceback" not in output
    assert code == 2
    assert not (tiny / "results").exists()


def append_keeping_times(path):
    """Change the content of a file and keep its times, like `rsync -a` and `cp -p`."""
    before = path.stat()
    path.write_text(path.read_text() + "\n")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.slow
@pytest.mark.parametrize("program", ["snakemake", "apertura"])
def test_changed_input_with_kept_time_reruns_dependent_steps(finished_tiny, tmp_path, program):
    """Without Snakemake's records, out-of-date results are found by hashes alone.

    Images of a flight depend on all its pairs, through track refinement; profiles do not.
    """
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")

    def run(*options):
        return finished(snakemake(root, *options) if program == "snakemake" else apertura("run", root, *options))

    code, output = run("-n")
    assert code == 0
    assert "Nothing to be done" in output
    append_keeping_times(root / "raw/f01/uav2.track.pos")
    profile_time = (root / "results/f01/uav1-uav1/profile.zarr/zarr.json").stat().st_mtime_ns
    code, output = run()
    assert code == 0, output
    assert "results/f01/uav2/track.manifest.json: out of date, raw/f01/uav2.track.pos has changed" in output
    assert (root / "results/f01/uav1-uav1/profile.zarr/zarr.json").stat().st_mtime_ns == profile_time
    assert stale_results(Campaign.load(root)) == {}
    assert "Nothing to be done" in run("-n")[1]


@pytest.mark.slow
def test_clock_set_back_by_a_day_does_not_rerun_steps(finished_tiny, tmp_path):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    tomorrow = time.time() + 86400
    for path in (root / "results").rglob("*"):
        os.utime(path, (tomorrow, tomorrow))
    path = root / "config" / "config.yaml"
    path.write_text(path.read_text() + "processing:\n  window: none\n")
    code, output = finished(apertura("run", root))
    assert code == 0, output
    assert stale_results(Campaign.load(root)) == {}
    assert "Nothing to be done" in finished(apertura("run", root, "-n"))[1]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_signal_ends_a_run_and_its_steps_within_five_seconds(tiny, number):
    configure_many_tiles(tiny)
    run = apertura("run", tiny, "--cores", 2)
    wait_for_tiles(tiny, run, count=2)
    start_s = time.monotonic()
    run.send_signal(number)
    output = run.communicate(timeout=60)[0]
    assert time.monotonic() - start_s < 5
    assert run.returncode == 130
    assert f"interrupted by {number.name}" in output
    running = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()]
    assert not [line for line in running if str(tiny).encode() in line]
    hold(tiny).close()


def state_and_parent(pid):
    state, parent = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:2]
    return state, int(parent)


def descendants(pid):
    """Return the process IDs of the descendants of a process with their command lines."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, parent = state_and_parent(path.parent.name)
            if state != "Z":
                parents[int(path.parent.name)] = parent
    tree = {pid}
    while more := {child for child, parent in parents.items() if parent in tree} - tree:
        tree |= more
    return {number: Path(f"/proc/{number}/cmdline").read_bytes() for number in sorted(tree - {pid})}


def is_alive(pid):
    try:
        return state_and_parent(pid)[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.parametrize("killed", ["the run", "fork server", "snakemake"])
def test_steps_end_with_the_run_whichever_process_is_killed(tiny, uninterrupted, killed):
    configure_many_tiles(tiny)
    run = apertura("run", tiny, "--cores", 2, *TO_IMAGES)  # without the target, other steps may start first
    wait_for_tiles(tiny, run, count=2)
    processes = descendants(run.pid)
    assert all(b"apertura.run.fork_server" in command for command in processes.values())
    fork_server, snakemake_itself, *steps = processes
    assert steps
    for number in (snakemake_itself, *steps):
        with contextlib.suppress(OSError):  # a step may have finished
            assert state_and_parent(number)[1] == fork_server  # there is no process of Snakemake in between
    os.kill({"the run": run.pid, "snakemake": snakemake_itself}.get(killed, fork_server), signal.SIGKILL)
    code, output = finished(run, timeout=60)
    assert code == (-signal.SIGKILL if killed == "the run" else 1)
    message = "error: the run was terminated by SIGKILL, possibly out of memory. Run again"
    assert (message in output, output.count("error:")) == ((False, 0) if killed == "the run" else (True, 1))
    deadline_s = time.monotonic() + 10
    while any(map(is_alive, processes)):
        assert time.monotonic() < deadline_s, "a step is still running"
        time.sleep(0.05)
    hold(tiny).close()
    code, output = finished(apertura("run", tiny, *TO_IMAGES))
    assert code == 0, output
    assert contents(tiny) == uninterrupted


@pytest.mark.slow
def test_killed_step_ends_the_run_with_status_1(tiny):
    configure_many_tiles(tiny)
    run = apertura("run", tiny, "--cores", 2, *TO_IMAGES)
    wait_for_tiles(tiny, run, count=2)
    os.kill(list(descendants(run.pid))[-1], signal.SIGSEGV)
    code, output = finished(run, timeout=60)
    assert (code, output.count("error:")) == (1, 1)
    assert "a step exited without a message" in output


@pytest.mark.slow
def test_run_prints_each_step_and_a_summary_of_the_images(tiny, tmp_path):
    code, output = finished(apertura("run", tiny, "-n"))
    assert code == 0
    assert output.startswith("23 steps to run: ")
    assert output.count("\n") == 1
    assert not (tiny / "results/.run").exists()
    elsewhere = {"cwd": tmp_path, "env": {**os.environ, "PATH": "/usr/bin:/bin"}}  # without an active environment
    code, output = finished(apertura("run", tiny, **elsewhere))
    assert code == 0, output
    assert (tiny / "results" / "f01" / "fused" / "coherent_db.tif").is_file()
    cells_of = [line.split("  ") for line in output.splitlines()]
    for word, count in (("started", 23), ("done", 23), ("failed", 0)):
        assert sum(len(cells) > 2 and cells[1].strip() == word for cells in cells_of) == count
    assert "23 steps done in " in output
    timed = list((tiny / "results/benchmarks").rglob("*.tsv"))
    logs = {path.with_suffix("") for path in (tiny / "results/logs").rglob("*.log")}
    assert len(timed) == 23
    assert {
        tiny / "results/logs" / path.relative_to(tiny / "results/benchmarks").with_suffix("") for path in timed
    } < logs
    rows = [dict(zip(*(line.split("\t") for line in path.read_text().splitlines()), strict=True)) for path in timed]
    assert all(float(row[column]) > 0 for row in rows for column in ("s", "max_rss", "cpu_time"))
    assert "f01 uav1-uav2" in output
    assert "results/f01/fused/coherent_db.tif" in output
    assert "\x1b" not in output
    assert "Building DAG" not in output
    assert "Building DAG" in (tiny / "results/logs/snakemake.log").read_text()
    code, output = finished(apertura("run", tiny, "-q"))
    assert code == 0
    assert output.startswith("main files")
    assert "Building DAG" in finished(apertura("run", tiny, "-v"))[1]
    assert "Building DAG" in finished(apertura("run", tiny, "-n", "-v"))[1]
    assert "digraph" in finished(apertura("run", tiny, "--forceall", "--dag"))[1]
    assert "succeeded" in finished(apertura("status", tiny))[1]
    assert not list((tiny / "results/.run").rglob("*.json"))


@pytest.mark.slow
def test_unknown_option_of_snakemake_is_one_message(tiny):
    code, output = finished(apertura("run", tiny, "--no-such-option"))
    assert code == 2
    assert "error: snakemake: error: unrecognized arguments: --no-such-option\n" in output
    assert "recorder" not in output


@pytest.mark.slow
def test_second_run_is_refused_with_the_lock_holder(tiny):
    configure_many_tiles(tiny)
    run = apertura("run", tiny, "--cores", 2)
    wait_for_tiles(tiny, run, count=1)
    for second in (apertura("run", tiny), snakemake(tiny)):
        code, output = finished(second)
        assert code != 0
        assert "the campaign is locked by another run: process" in output
        assert "Traceback" not in output
    assert "Building DAG" in finished(snakemake(tiny, "-n"))[1]
    run.terminate()
    run.communicate(timeout=60)


@pytest.mark.slow
def test_campaign_error_found_by_a_step_ends_a_run_with_status_2(tiny):
    path = tiny / "raw" / "f01" / "uav1.sigmf-data"
    data = bytearray(path.read_bytes())
    data[4000] ^= 1
    path.write_bytes(data)
    code, output = finished(apertura("run", tiny))
    assert code == 2, output
    assert output.count("uav1.sigmf-data: sha512") == 1
    assert "log of the step: " in output
    assert "results/logs/f01/uav1.ingest.log" in output
    assert "results/logs/snakemake.log" in output
    assert "Traceback" not in output
