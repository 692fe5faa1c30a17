"""Output of runs: journal, progress bars, time left, failures; and the commands list, status and clean."""

import io
import json
import os
import re
import shutil
import subprocess
import tempfile
import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from folders import ROOT, copy_writable
from rich.console import Console

from apertura.campaign.folder import Campaign
from apertura.common.errors import CampaignError
from apertura.common.processes import hold, holder, keep_caches_writable
from apertura.common.progress import progress_path
from apertura.run.journal import JobRecord, JournalReader, RunRecord, a_step_was_killed, failures, note
from apertura.run.results import clean, print_list, states
from apertura.run.screen import Bar, Screen, bars, print_status, table
from apertura.run.time_left import StepProgress, TimeLeft
from apertura.workflow.resources import Resources

PLANNED = {"ingest": 2, "image": 2, "cube": 1, "all": 1, "total": 6}


def note_start(path, job, rule, *words, log=""):
    note(path, "begun", job=job, rule=rule, step=[rule, *words], log=log)


@pytest.fixture
def journal(tmp_path):
    """Write the journal of a run of five steps: one finished, one running."""
    path = tmp_path / "journal.jsonl"
    note(path, "start", cores=2)
    note(path, "planned", jobs=PLANNED)
    note_start(path, 1, "ingest", "f01", "uav1")
    note(path, "finished", job=1)
    note_start(path, 2, "image", "f01", "uav1-uav1")
    return path


def test_journal_lists_finished_running_and_waiting_steps(journal):
    run = JournalReader(journal).news()
    assert [job.name for job in run.finished] == ["ingest f01 uav1"]
    assert [job.name for job in run.running] == ["image f01 uav1-uav1"]
    assert run.waiting == {"ingest": 1, "image": 1, "cube": 1}
    assert (run.total, run.status, run.cores) == (5, None, 2)


def test_incomplete_line_of_the_journal_is_read_when_complete(journal):
    reader = JournalReader(journal)
    reader.news()
    line = json.dumps({"at": 5, "event": "finished", "job": 2}) + "\n"
    for part in (line[:9], line[9:]):
        assert len(reader.run.finished) == 1
        with journal.open("a") as stream:
            stream.write(part)
        reader.news()
    assert len(reader.run.finished) == 2


def test_retried_step_is_running_and_not_failed(journal):
    note(journal, "failed", job=2)
    assert len(JournalReader(journal).news().failed) == 1
    note_start(journal, 2, "image", "f01", "uav1-uav1")
    run = JournalReader(journal).news()
    assert not run.failed
    assert len(run.running) == 1


@pytest.mark.parametrize(
    "line",
    [
        "[]",
        "1",
        '{"event": "begun"}',
        '{"event": "planned", "at": 1, "jobs": []}',
        '{"event": "planned", "at": 1, "jobs": {"a": "b"}}',
        '{"event": "finished", "at": 1, "job": {}}',
        '{"event": "end", "at": null, "status": 0}',
        '{"event": "end", "at": NaN, "status": 0}',
        '{"event": "finished", "at": 1e300, "job": 2}',
        "[" * 5000,
        "\x00\xff",
    ],
)
def test_malformed_lines_of_the_journal_are_ignored(journal, line):
    before = JournalReader(journal).news()
    with journal.open("a") as stream:
        stream.write(line + "\n")
    assert JournalReader(journal).news() == before


def test_control_codes_in_step_names_are_escaped():
    assert JobRecord("a", ("image", "\x1b[31mf01"), "", 0.0).name == r"image \x1b[31mf01"


def expected_seconds(campaign, rule, *where):
    return Resources(campaign).expected_seconds(rule, *where)


def test_expected_time_grows_with_samples_and_pixels(finished_tiny):
    assert expected_seconds(finished_tiny, "image", "f01", "uav1-uav2") > expected_seconds(finished_tiny, "scene")
    assert expected_seconds(finished_tiny, "echo", "f01", "uav1-uav2") > expected_seconds(
        finished_tiny, "echo", "f01", "uav1-uav1"
    )


def timed(campaign, factor):
    """Return a run whose first image took `factor` times the expected time, and whose second is waiting."""
    seconds = factor * expected_seconds(campaign, "image", "f01", "uav1-uav1")
    done = JobRecord("image", ("image", "f01", "uav1-uav1"), "", 0.0, seconds)
    return RunRecord(planned={"image": 2}, jobs={1: done})


def test_time_left_scales_with_measured_times(finished_tiny):
    time_left = TimeLeft(finished_tiny, cores=2)
    once, tenfold = (time_left.left(timed(finished_tiny, factor), 0.0, {})[1] for factor in (1, 10))
    assert tenfold == pytest.approx(10 * once)


def test_time_left_is_unknown_before_the_first_timed_step(finished_tiny):
    job = JobRecord("image", ("image", "f01", "uav1-uav1"), "", 0.0)
    assert TimeLeft(finished_tiny, cores=2).left(RunRecord(planned={"image": 2}, jobs={1: job}), 1.0, {}) == (
        {1: None},
        None,
    )


SECONDS = {
    "ingest": 40.0,
    "scene": 0.8,
    "tracks": 1.0,
    "echo": 130.0,
    "profile": 60.0,
    "refine": 70.0,
    "layers": 4.0,
    "image": 110.0,
    "export": 8.0,
}
"""Times of steps of a long flight: those of scene and tracks are mainly start-up, those of layers and export are
writing of rasters.
"""


def estimated_and_true(campaign, expected, cores=2):
    """Return the estimated (or None) and true seconds left at each step end of a scripted run, and the timed rules."""
    time_left, run = TimeLeft(campaign, cores), RunRecord(planned=dict.fromkeys(SECONDS, 6))
    time_left._expected = lambda rule, _: expected[rule]
    waiting = [rule for rule in SECONDS for _ in range(6)]
    ends = [0.0] * cores
    for number, rule in enumerate(waiting):  # each step runs on the first free core
        core = ends.index(min(ends))
        run.jobs[number] = JobRecord(rule, (rule, "f01", f"p{number}"), "", ends[core])
        ends[core] += SECONDS[rule]
        run.jobs[number].ended_s = ends[core]
    estimates, all_jobs = [], run.jobs
    for now_s in sorted({job.ended_s for job in all_jobs.values()})[:-1]:
        run.jobs = {
            number: replace(job, ended_s=job.ended_s if job.ended_s <= now_s else None)
            for number, job in all_jobs.items()
            if job.begun_s <= now_s
        }
        estimates.append((time_left.left(run, now_s, {})[1], max(ends) - now_s, {job.rule for job in run.finished}))
    return estimates


@pytest.mark.parametrize("factor", [0.2, 1.0, 50.0])
def test_time_left_is_within_a_factor_of_two_or_unknown(finished_tiny, factor):
    """Expected times are wrong by a factor for images (limit: 0.2), and by one half for other steps."""
    expected = {rule: seconds * (factor if rule == "image" else 0.5) for rule, seconds in SECONDS.items()}
    estimates = estimated_and_true(finished_tiny, expected)
    known = [(left, true) for left, true, _ in estimates if left is not None]
    assert all(true / 2 <= left <= 2 * true for left, true in known)
    assert all(later <= 2 * sooner for (sooner, _), (later, _) in pairwise(known))
    assert all((left is not None) == ("image" in timed) for left, _, timed in estimates)


@pytest.mark.parametrize(("timed_rule", "is_known"), [("layers", True), ("image", False)])
def test_times_of_raster_jobs_are_transferable(finished_tiny, timed_rule, is_known):
    time_left, where = TimeLeft(finished_tiny, cores=1), ("f01", "uav1-uav1")
    time_left._expected = lambda rule, _: {"layers": 20.0, "image": 20.0, "export": 30.0}[rule]
    done = JobRecord(timed_rule, (timed_rule, *where), "", 0.0, 60.0)
    left_s = time_left.left(RunRecord(planned={timed_rule: 1, "export": 1}, jobs={1: done}), 60.0, {})[1]
    assert left_s == (pytest.approx(90.0) if is_known else None)


def test_share_of_tiles_takes_start_up_and_its_part_of_the_work(finished_tiny):
    time_left, shares = TimeLeft(finished_tiny, cores=0), (8, 80)
    runs = [
        RunRecord(
            planned={"tiles": 2 * count},
            jobs={1: JobRecord("tiles", ("tiles", "f01", "uav1-uav1", f"1-of-{count}"), "", 0.0)},
        )
        for count in shares
    ]
    few, many = (time_left._expects(run, "tiles", ("f01", "uav1-uav1")) for run in runs)
    assert few == pytest.approx((many[0], 10 * many[1]))


def test_time_left_is_unknown_before_the_first_image(finished_tiny):
    """An image may take 1000 times longer (double sum), also in several jobs or without progress reports."""
    started = JobRecord("image", ("image", "f01", "uav1-uav1"), "", 40.0)
    for waiting in (
        {"planned": {"scene": 9, "tracks": 9, "image": 1}},
        {"planned": {"scene": 9, "tracks": 9, "tiles": 1}},
    ):
        done = {n: JobRecord(rule, (rule, "f01"), "", 0.0, 0.4) for n, rule in enumerate(["scene", "tracks"])}
        assert TimeLeft(finished_tiny, cores=2).left(RunRecord(**waiting, jobs=done), 1.0, {})[1] is None
    run = RunRecord(planned={"scene": 9, "tracks": 9, "image": 1}, jobs=done | {7: started})
    assert TimeLeft(finished_tiny, cores=2).left(run, 400.0, {})[1] is None
    progress = {7: StepProgress("tiles", 10, 20, 40.0, 400.0)}
    assert TimeLeft(finished_tiny, cores=2).left(run, 400.0, progress)[1] >= 360


def test_overrunning_job_is_not_expected_to_end_soon(finished_tiny):
    done = JobRecord("cube", ("cube", "f01"), "", 0.0, 10.0)
    for now_s, left_s in ((11.0, 9.0), (19.0, 1.0), (50.0, 30.0)):
        run = RunRecord(planned={"cube": 2}, jobs={1: done, 2: replace(done, begun_s=10.0, ended_s=None)})
        assert TimeLeft(finished_tiny, cores=2).left(run, now_s, {})[1] == pytest.approx(left_s)


def test_shares_of_tiles_yield_the_time_left_of_the_image(finished_tiny):
    done = JobRecord("tiles", ("tiles", "f01", "uav1-uav1", "1-of-2"), "", 0.0, 30.0)
    assert TimeLeft(finished_tiny, cores=1).left(RunRecord(planned={"tiles": 1, "image": 1}, jobs={1: done}), 30.0, {})[
        1
    ]


def test_time_left_is_unknown_while_tiles_are_recomputed(finished_tiny):
    """Images took 60 s; one image has taken 95 s so far, and its tiles are being recomputed in parts."""
    done = JobRecord("image", ("image", "f01", "uav1-uav1"), "", 0.0, 60.0)
    run = RunRecord(planned={"image": 2}, jobs={1: done, 2: replace(done, begun_s=60.0, ended_s=None)})
    for parts, is_known in ((0, False), (1, False), (4, True)):
        progress = {2: StepProgress("parts of tiles", parts, 7, 125.0, 155.0)}
        of_jobs, total = TimeLeft(finished_tiny, cores=2).left(run, 155.0, progress)
        assert [left is not None for left in (of_jobs[2], total)] == [is_known, is_known]


def test_first_tiles_do_not_determine_the_time_left(finished_tiny):
    """After 30 s, one of 100 tiles is finished, because tables precede; an image takes 60 s, not 50 minutes."""
    done = JobRecord("image", ("image", "f01", "uav1-uav1"), "", 0.0, 60.0)
    run = RunRecord(planned={"image": 2}, jobs={1: done, 2: replace(done, begun_s=60.0, ended_s=None)})
    progress = {2: StepProgress("tiles", 1, 100, 60.0, 90.0)}
    assert TimeLeft(finished_tiny, cores=2).left(run, 90.0, progress)[1] == pytest.approx(30.0)


def test_unknown_arguments_of_a_step_are_not_searched_for(finished_tiny):
    for where in (("/", "**"), ("f01", "../../*"), ("f01", "uav1-uav1", "1-of-8", "more"), ()):
        assert 0 < expected_seconds(finished_tiny, "image", *where) < 10
    assert expected_seconds(finished_tiny, "image", "/", "**") < expected_seconds(
        finished_tiny, "image", "f01", "uav1-uav1"
    )


def report_progress(campaign, step, **report):
    path = campaign.result(*progress_path(step))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report))


def test_reported_progress_takes_precedence_over_expected_times(tmp_path, finished_tiny):
    campaign = Campaign.load(copy_writable(finished_tiny.root, tmp_path / "campaign"))
    now = time.time()
    job = JobRecord("image", ("image", "f01", "uav1-uav1"), "", now - 100)
    run = RunRecord(planned={"image": 1}, jobs={1: job})
    report_progress(campaign, job.step, what="tiles", done=10, total=40, since=now - 90, at=now)
    bar, total = bars(campaign, run, TimeLeft(campaign, cores=2))
    assert (bar.counts, bar.fraction) == ("10 of 40 tiles", 0.25)
    assert bar.left_s == pytest.approx(270, rel=0.01)
    assert total.left_s == pytest.approx(270, rel=0.01)


@pytest.mark.quick("report0", "report5")
@pytest.mark.parametrize(
    "report",
    [
        {"what": "tiles", "done": 10, "total": 40, "since": 5.0, "at": 9.0},  # of an earlier step
        {"what": "tiles", "done": 50, "total": 40, "since": 2e9, "at": 2e9},
        {"what": "tiles", "done": 0, "total": 0, "since": 2e9, "at": 2e9},
        {"what": "tiles", "done": 1, "total": 4, "since": 2e9, "at": 1e300},
        {"what": "tiles"},
        [],
    ],
)
def test_invalid_progress_report_is_ignored(tmp_path, finished_tiny, report):
    campaign = Campaign.load(copy_writable(finished_tiny.root, tmp_path / "campaign"))
    job = JobRecord("image", ("image", "f01", "uav1-uav1"), "", 1e9)
    path = campaign.result(*progress_path(job.step))
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(report))
    assert StepProgress.of(campaign, job) is None


def test_progress_outside_the_results_is_not_read(finished_tiny):
    assert StepProgress.of(finished_tiny, JobRecord("image", ("..", "..", "config", "x"), "", 0.0)) is None


class Terminal(io.StringIO):
    """A stream that is reported as a terminal."""

    def isatty(self):
        return True


def test_start_and_end_of_each_step_are_printed_without_a_terminal(finished_tiny, journal):
    stream, reader = io.StringIO(), JournalReader(journal)
    with Screen(finished_tiny, TimeLeft(finished_tiny, 2), stream=stream) as screen:
        screen.update(reader.news())
        note(journal, "failed", job=2)
        screen.update(reader.news())
        screen.update(reader.news())
    lines = [line.split("  ", 1)[1] for line in stream.getvalue().splitlines()]
    assert [line.split(":")[0] for line in lines] == [
        "started  ingest f01 uav1",
        "done     ingest f01 uav1",
        "started  image f01 uav1-uav1",
        "failed   image f01 uav1-uav1",
    ]
    assert "1 of 5 steps, time left unknown" in lines[1]
    assert "\x1b" not in stream.getvalue()


def test_events_between_two_updates_are_printed_in_order(finished_tiny):
    run, stream = RunRecord(planned={"ingest": 2, "scene": 1}), io.StringIO()
    run.jobs = {
        1: JobRecord("ingest", ("ingest", "f01", "uav1"), "", 10.0, 14.0),
        2: JobRecord("scene", ("scene",), "", 10.5, 12.0),
        3: JobRecord("ingest", ("ingest", "f01", "uav2"), "", 12.0),
    }
    with Screen(finished_tiny, TimeLeft(finished_tiny, 2), stream=stream) as screen:
        screen.update(run)
    lines = [re.sub(r"^\S+  |: .* s;|, (time|about) .*", "", line) for line in stream.getvalue().splitlines()]
    assert lines == [
        "started  ingest f01 uav1",
        "started  scene",
        "done     scene 1 of 3 steps",
        "started  ingest f01 uav2",
        "done     ingest f01 uav1 2 of 3 steps",
    ]


def test_terminal_shows_bars_and_the_cursor_is_restored(finished_tiny, journal, monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    stream = Terminal()
    screen = Screen(finished_tiny, TimeLeft(finished_tiny, 2), stream=stream)
    with pytest.raises(AttributeError), screen:  # any exception
        [screen.update(run) for run in (JournalReader(journal).news(), None)]
    printed = stream.getvalue()
    assert "━" in printed
    assert "1 of 5 steps" in printed
    assert printed.rfind("\x1b[?25h") > printed.rfind("\x1b[?25l")


def test_quiet_run_prints_nothing(finished_tiny, journal):
    stream = Terminal()
    with Screen(finished_tiny, TimeLeft(finished_tiny, 2), quiet=True, stream=stream) as screen:
        screen.update(JournalReader(journal).news())
        screen.ended(JournalReader(journal).news())
    assert not stream.getvalue()


@pytest.mark.parametrize("columns", [80, 120])
def test_bars_fit_the_terminal(columns):
    rows = [Bar(f"image {'f' * 30} uav1-uav{number}", "10 of 40 tiles", 0.25, 4000.0) for number in range(40)]
    console = Console(width=columns, file=io.StringIO(), force_terminal=True, color_system=None)
    console.print(table([*rows, Bar("3 of 43 steps", "", 0.1, 9000.0)]))
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= columns
    assert len(lines) == 12 + 2
    assert "and 28 more" in lines[-2]
    assert "about 2.5 h left" in lines[-1]


def failed(tmp_path, *logs):
    run = RunRecord()
    for number, text in enumerate(logs):
        (tmp_path / f"{number}.log").write_text(text)
        run.jobs[number] = JobRecord("echo", ("echo",), f"{number}.log", 0.0, 1.0, failed=True)
    return "\n".join(failures(tmp_path, run, tmp_path / "snakemake.log"))


def test_common_message_of_failed_steps_is_printed_once(tmp_path):
    message = failed(tmp_path, "reading\nerror: codes.npy: gone\n", "error: codes.npy: gone\n")
    assert message.count("codes.npy: gone") == 1
    assert message.startswith("error: codes.npy: gone\n")
    assert "0.log" in message
    assert "1.log" in message
    assert message.endswith("snakemake.log")


def test_internal_error_and_killed_step_are_distinguished(tmp_path):
    assert "internal error, please report this error" in failed(
        tmp_path, "Traceback (most recent call last):\nZeroDivisionError: by zero\n"
    )
    assert "the step was killed, possibly out of memory" in failed(tmp_path, "forming 10 of 20 tiles\n")


@pytest.mark.parametrize(("log", "killed"), [("forming 10 of 20 tiles\n", True), ("error: codes.npy: gone\n", False)])
def test_killed_step_is_recognised_by_its_log(tmp_path, log, killed):
    (tmp_path / "0.log").write_text(log)
    assert (
        a_step_was_killed(tmp_path, RunRecord(jobs={0: JobRecord("image", "image f01", "0.log", 0, failed=True)}))
        == killed
    )


def test_missing_executor_plugin_is_one_message(tmp_path):
    (tmp_path / "a.log").write_text(
        "usage: [-h]\nsnakemake: error: argument --executor/-e: invalid choice: 'slurm' (choose from 'local')\n"
    )
    message, _ = failures(tmp_path, RunRecord(), tmp_path / "a.log")
    assert message.startswith("error: executor 'slurm' is not installed. Install it with apertura: ")
    assert message.endswith("pip install snakemake-executor-plugin-slurm")


def test_caches_are_in_the_temporary_folder_without_writable_home(tmp_path, monkeypatch):
    (tmp_path / "home").write_text("a file, which cannot contain folders")
    monkeypatch.setattr(os, "environ", {"HOME": str(tmp_path / "home")})
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    keep_caches_writable()
    cache = Path(os.environ["XDG_CACHE_HOME"])
    assert (cache.parent, cache.stat().st_mode & 0o777) == (tmp_path, 0o700)
    assert os.environ["MPLCONFIGDIR"] == f"{cache}/matplotlib"
    cache.rename(tmp_path / "other")
    cache.symlink_to(tmp_path / "other")  # a link that another user may have created
    del os.environ["XDG_CACHE_HOME"]
    keep_caches_writable()
    assert Path(os.environ["XDG_CACHE_HOME"]) != cache


def test_caches_are_unchanged_with_a_writable_home(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "environ", {"HOME": str(tmp_path / "new" / "home")})
    keep_caches_writable()
    assert os.environ.keys() == {"HOME"}


def test_workflow_error_is_printed_if_no_step_failed(tmp_path):
    run = RunRecord(errors=["MissingRuleException:\nno rule for \x1b[31mx"])
    assert next(failures(tmp_path, run, tmp_path / "a.log")) == r"error: MissingRuleException: no rule for \x1b[31mx"


@pytest.fixture
def finished(finished_tiny, tmp_path):
    """Return a writable copy of a finished campaign."""
    return Campaign.load(copy_writable(finished_tiny.root, tmp_path / "finished"))


def files(root):
    return {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}


def test_clean_removes_all_results(finished, tiny, capsys):
    clean(finished, unfinished_only=False, agreed=True)
    assert files(finished.root) == files(tiny)
    assert not finished.results.exists()


def test_clean_keeps_and_reports_other_files(finished, capsys):
    for name in ("notes.txt", "f01/uav1-uav1/db.qgz", "f01/uav1-uav1/image.zarr/mine"):
        (finished.results / name).write_text("mine")
    clean(finished, unfinished_only=False, agreed=True)
    assert files(finished.results) - {".run.lock"} == {
        "notes.txt",
        "f01/uav1-uav1/db.qgz",
        "f01/uav1-uav1/image.zarr/mine",
    }
    line = "kept files that the workflow did not write: results/f01/uav1-uav1/db.qgz and 2 more"
    assert line in capsys.readouterr().out


def test_clean_of_unfinished_work_keeps_results(finished, capsys):
    wip = finished.results / "f01/uav1-uav1/image.zarr.wip"
    shutil.copytree(str(finished.results / "f01/uav1-uav1/image.zarr"), str(wip))
    before = files(finished.results)
    clean(finished, unfinished_only=True, agreed=True)
    assert {name for name in before - files(finished.results) if ".wip/" not in name} == set()
    assert not wip.exists()
    assert set(states(finished)["f01", "uav1-uav1"]["missing"]) == set()


def test_clean_is_refused_during_a_run_or_step(finished):
    before = files(finished.results)
    with hold(finished.root), pytest.raises(CampaignError, match="the campaign is locked by another run"):
        clean(finished, unfinished_only=False, agreed=True)
    from apertura.campaign.store import writing

    with (
        writing(finished.stage("echo", "f01", "uav1-uav1")),
        pytest.raises(CampaignError, match="a step is still writing"),
    ):
        clean(finished, unfinished_only=False, agreed=True)
    assert len(files(finished.results)) >= len(before) - 1  # except the manifest of the stage being written


def test_clean_without_confirmation_removes_nothing(finished, monkeypatch):
    before = files(finished.results)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(CampaignError, match="--yes"):
        clean(finished, unfinished_only=False, agreed=False)
    assert before <= files(finished.results)


@pytest.mark.quick("../raw/codes.npy", "out/secret")
@pytest.mark.parametrize("name", ["../../config/config.yaml", "../raw/codes.npy", "/etc/hostname", "out/secret"])
def test_clean_follows_no_path_or_link_outside_the_results(finished, tmp_path, name):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "secret").write_text("kept")
    Path(finished.results / "out").symlink_to(outside)
    (finished.results / "evil.manifest.json").write_text(json.dumps({"files": {name: "0"}}))
    clean(finished, unfinished_only=False, agreed=True)
    assert (finished.root / "config/config.yaml").is_file()
    assert (finished.root / "raw/codes.npy").is_file()
    assert (outside / "secret").is_file()


def test_list_prints_finished_outdated_and_missing_results(finished, capsys):
    (finished.results / "f01/uav1-uav1/image.manifest.json").unlink()
    state_of = states(finished)
    assert state_of["f01", "uav1"] == {"finished": ["raw", "track"], "stale": [], "missing": []}
    assert state_of["f01", "uav1-uav1"] == {
        "finished": ["echo", "profile", "layers"],
        "stale": ["export"],
        "missing": ["image"],
    }
    print_list(finished)
    printed = capsys.readouterr().out
    assert "uav1-uav2" in printed
    assert "in results" in printed


def test_status_prints_a_run_in_progress(finished, capsys):
    path = finished.result(".run", "journal.jsonl")
    path.parent.mkdir()
    note(path, "start", cores=2)
    note(path, "planned", jobs=PLANNED)
    note_start(path, 1, "image", "f01", "uav1-uav1")
    with hold(finished.root):
        print_status(finished)
    printed = capsys.readouterr().out
    assert f"a run is in progress: process {os.getpid()} on" in printed
    assert "image f01 uav1-uav1: " in printed
    assert "waiting: 2 ingest, 1 image, 1 cube" in printed
    print_status(finished)
    assert "was killed" in capsys.readouterr().out


def test_status_prints_the_reason_of_a_failure(finished, capsys):
    path = finished.result(".run", "journal.jsonl")
    path.parent.mkdir()
    (finished.results / "logs").mkdir()
    (finished.results / "logs/a.log").write_text("error: the log of uav1 is empty\n")
    note(path, "start", cores=2)
    note(path, "planned", jobs=PLANNED)
    note_start(path, 1, "image", "f01", "uav1-uav1", log="results/logs/a.log")
    note(path, "failed", job=1)
    note(path, "end", status=2)
    print_status(finished)
    printed = capsys.readouterr().out
    assert "failed with exit status 2" in printed
    assert printed.count("error: the log of uav1 is empty") == 1
    assert "results finished" in printed


def test_lock_holder_can_be_queried_while_a_run_starts(tmp_path):
    (tmp_path / "results").mkdir()
    assert holder(tmp_path) is None
    is_querying = True

    def query():
        while is_querying:
            holder(tmp_path)

    thread = threading.Thread(target=query)
    thread.start()
    try:
        for _ in range(200):
            hold(tmp_path).close()
    finally:
        is_querying = False
        thread.join()


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_demo_does_not_change_an_existing_folder(tmp_path):
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in (
        "requirements/uv.txt",
        "requirements/all.txt",
        "pyproject.toml",
        "research/pyproject.toml",
        ".venv/.installed",
        "demo/notes.txt",
    ):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    # Remove variables of an outer `make test VENV=...`, which would be inherited.
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
    command = ["make", "demo", "VENV=.venv"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "error: demo/ was not made by make demo" in done.stderr
    assert (tmp_path / "demo/notes.txt").read_text() == "mine"
