"""What a run shows of itself: its journal, bars, time left, why it failed; what is there, and what clean removes."""

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


def begun(path, job, rule, *words, log=""):
    note(path, "begun", job=job, rule=rule, step=[rule, *words], log=log)


@pytest.fixture
def journal(tmp_path):
    """A run of five steps, of which one is done and one under way."""
    path = tmp_path / "journal.jsonl"
    note(path, "start", cores=2)
    note(path, "planned", jobs=PLANNED)
    begun(path, 1, "ingest", "f01", "uav1")
    note(path, "finished", job=1)
    begun(path, 2, "image", "f01", "uav1-uav1")
    return path


def test_a_journal_tells_what_is_done_under_way_and_to_come(journal):
    run = JournalReader(journal).news()
    assert [job.name for job in run.finished] == ["ingest f01 uav1"]
    assert [job.name for job in run.running] == ["image f01 uav1-uav1"]
    assert run.waiting == {"ingest": 1, "image": 1, "cube": 1}
    assert (run.total, run.status, run.cores) == (5, None, 2)


def test_a_line_that_is_being_written_is_read_when_it_is_whole(journal):
    reader = JournalReader(journal)
    reader.news()
    line = json.dumps({"at": 5, "event": "finished", "job": 2}) + "\n"
    for part in (line[:9], line[9:]):
        assert len(reader.run.finished) == 1
        with journal.open("a") as stream:
            stream.write(part)
        reader.news()
    assert len(reader.run.finished) == 2


def test_a_step_that_is_tried_again_is_under_way_and_not_failed(journal):
    note(journal, "failed", job=2)
    assert len(JournalReader(journal).news().failed) == 1
    begun(journal, 2, "image", "f01", "uav1-uav1")
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
def test_a_journal_of_a_stranger_is_only_data(journal, line):
    before = JournalReader(journal).news()
    with journal.open("a") as stream:
        stream.write(line + "\n")
    assert JournalReader(journal).news() == before


def test_names_of_a_stranger_reach_the_terminal_without_control_codes():
    assert JobRecord("a", ("image", "\x1b[31mf01"), "", 0.0).name == r"image \x1b[31mf01"


def expected_seconds(campaign, rule, *where):
    return Resources(campaign).expected_seconds(rule, *where)


def test_more_samples_and_more_pixels_take_longer(finished_tiny):
    assert expected_seconds(finished_tiny, "image", "f01", "uav1-uav2") > expected_seconds(finished_tiny, "scene")
    assert expected_seconds(finished_tiny, "echo", "f01", "uav1-uav2") > expected_seconds(
        finished_tiny, "echo", "f01", "uav1-uav1"
    )


def timed(campaign, factor):
    """A run whose first image took so many times what was expected, and whose second is to come."""
    seconds = factor * expected_seconds(campaign, "image", "f01", "uav1-uav1")
    done = JobRecord("image", ("image", "f01", "uav1-uav1"), "", 0.0, seconds)
    return RunRecord(planned={"image": 2}, jobs={1: done})


def test_time_left_follows_what_has_been_measured(finished_tiny):
    time_left = TimeLeft(finished_tiny, cores=2)
    once, tenfold = (time_left.left(timed(finished_tiny, factor), 0.0, {})[1] for factor in (1, 10))
    assert tenfold == pytest.approx(10 * once)


def test_before_a_step_of_this_run_was_timed_nobody_knows_how_long_it_takes(finished_tiny):
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
"""What steps of a long flight take on some machine; scene and tracks are mostly start, layers and export of rasters."""


def told_and_true(campaign, expected, cores=2):
    """Return for each step of a scripted run that ends: told (or None) and true seconds left, rules timed by then."""
    time_left, run = TimeLeft(campaign, cores), RunRecord(planned=dict.fromkeys(SECONDS, 6))
    time_left._expected = lambda rule, _: expected[rule]
    waiting = [rule for rule in SECONDS for _ in range(6)]
    ends = [0.0] * cores
    for number, rule in enumerate(waiting):  # each on the core that is free first
        core = ends.index(min(ends))
        run.jobs[number] = JobRecord(rule, (rule, "f01", f"p{number}"), "", ends[core])
        ends[core] += SECONDS[rule]
        run.jobs[number].ended_s = ends[core]
    found, all_jobs = [], run.jobs
    for now_s in sorted({job.ended_s for job in all_jobs.values()})[:-1]:
        run.jobs = {
            number: replace(job, ended_s=job.ended_s if job.ended_s <= now_s else None)
            for number, job in all_jobs.items()
            if job.begun_s <= now_s
        }
        found.append((time_left.left(run, now_s, {})[1], max(ends) - now_s, {job.rule for job in run.finished}))
    return found


@pytest.mark.parametrize("wrong", [0.2, 1.0, 50.0])
def test_time_left_is_told_within_a_factor_of_two_or_not_at_all(finished_tiny, wrong):
    """Whatever images are thought to take, and others half of what they do; a fifth of the truth is the edge."""
    expected = {rule: seconds * (wrong if rule == "image" else 0.5) for rule, seconds in SECONDS.items()}
    found = told_and_true(finished_tiny, expected)
    told = [(left, true) for left, true, _ in found if left is not None]
    assert all(true / 2 <= left <= 2 * true for left, true in told)
    assert all(later <= 2 * sooner for (sooner, _), (later, _) in pairwise(told))
    assert all((left is not None) == ("image" in timed) for left, _, timed in found)


@pytest.mark.parametrize(("timed_rule", "told"), [("layers", True), ("image", False)])
def test_jobs_of_rasters_tell_how_long_others_take(finished_tiny, timed_rule, told):
    time_left, where = TimeLeft(finished_tiny, cores=1), ("f01", "uav1-uav1")
    time_left._expected = lambda rule, _: {"layers": 20.0, "image": 20.0, "export": 30.0}[rule]
    done = JobRecord(timed_rule, (timed_rule, *where), "", 0.0, 60.0)
    left_s = time_left.left(RunRecord(planned={timed_rule: 1, "export": 1}, jobs={1: done}), 60.0, {})[1]
    assert left_s == (pytest.approx(90.0) if told else None)


def test_a_share_of_an_images_tiles_takes_a_start_and_its_share_of_the_work(finished_tiny):
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


def test_nothing_is_told_before_an_image_was_formed_however_little_it_is_expected_to_take(finished_tiny):
    """By the double sum it takes thousandfold; so with shares of its tiles, and while it runs and tells nothing."""
    begun = JobRecord("image", ("image", "f01", "uav1-uav1"), "", 40.0)
    for to_come in (
        {"planned": {"scene": 9, "tracks": 9, "image": 1}},
        {"planned": {"scene": 9, "tracks": 9, "tiles": 1}},
    ):
        done = {n: JobRecord(rule, (rule, "f01"), "", 0.0, 0.4) for n, rule in enumerate(["scene", "tracks"])}
        assert TimeLeft(finished_tiny, cores=2).left(RunRecord(**to_come, jobs=done), 1.0, {})[1] is None
    run = RunRecord(planned={"scene": 9, "tracks": 9, "image": 1}, jobs=done | {7: begun})
    assert TimeLeft(finished_tiny, cores=2).left(run, 400.0, {})[1] is None
    paced = {7: StepProgress("tiles", 10, 20, 40.0, 400.0)}
    assert TimeLeft(finished_tiny, cores=2).left(run, 400.0, paced)[1] >= 360


def test_a_job_that_runs_over_what_was_expected_is_not_about_to_end(finished_tiny):
    done = JobRecord("cube", ("cube", "f01"), "", 0.0, 10.0)
    for now_s, left_s in ((11.0, 9.0), (19.0, 1.0), (50.0, 30.0)):
        run = RunRecord(planned={"cube": 2}, jobs={1: done, 2: replace(done, begun_s=10.0, ended_s=None)})
        assert TimeLeft(finished_tiny, cores=2).left(run, now_s, {})[1] == pytest.approx(left_s)


def test_shares_of_tiles_tell_how_long_the_image_takes_that_gathers_them(finished_tiny):
    done = JobRecord("tiles", ("tiles", "f01", "uav1-uav1", "1-of-2"), "", 0.0, 30.0)
    assert TimeLeft(finished_tiny, cores=1).left(RunRecord(planned={"tiles": 1, "image": 1}, jobs={1: done}), 30.0, {})[
        1
    ]


def test_nothing_is_told_while_tiles_of_an_image_are_formed_again(finished_tiny):
    """Images took 60 s; one runs for 95, and none of the parts is done that its tiles are formed in again."""
    done = JobRecord("image", ("image", "f01", "uav1-uav1"), "", 0.0, 60.0)
    run = RunRecord(planned={"image": 2}, jobs={1: done, 2: replace(done, begun_s=60.0, ended_s=None)})
    for parts, told in ((0, False), (1, False), (4, True)):
        paced = {2: StepProgress("parts of tiles", parts, 7, 125.0, 155.0)}
        of_jobs, whole = TimeLeft(finished_tiny, cores=2).left(run, 155.0, paced)
        assert [one is not None for one in (of_jobs[2], whole)] == [told, told]


def test_the_first_tiles_of_an_image_do_not_tell_how_long_it_takes_where_others_have_ended(finished_tiny):
    """After 30 s one of 100 tiles is done, for tables come first: an image took 60 s, not 50 minutes."""
    done = JobRecord("image", ("image", "f01", "uav1-uav1"), "", 0.0, 60.0)
    run = RunRecord(planned={"image": 2}, jobs={1: done, 2: replace(done, begun_s=60.0, ended_s=None)})
    paced = {2: StepProgress("tiles", 1, 100, 60.0, 90.0)}
    assert TimeLeft(finished_tiny, cores=2).left(run, 90.0, paced)[1] == pytest.approx(30.0)


def test_what_the_campaign_does_not_have_is_not_looked_for(finished_tiny):
    for where in (("/", "**"), ("f01", "../../*"), ("f01", "uav1-uav1", "1-of-8", "more"), ()):
        assert 0 < expected_seconds(finished_tiny, "image", *where) < 10
    assert expected_seconds(finished_tiny, "image", "/", "**") < expected_seconds(
        finished_tiny, "image", "f01", "uav1-uav1"
    )


def tell(campaign, step, **report):
    path = campaign.result(*progress_path(step))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report))


def test_a_step_that_tells_how_far_it_is_is_believed_over_what_was_expected(tmp_path, finished_tiny):
    campaign = Campaign.load(copy_writable(finished_tiny.root, tmp_path / "campaign"))
    now = time.time()
    job = JobRecord("image", ("image", "f01", "uav1-uav1"), "", now - 100)
    run = RunRecord(planned={"image": 1}, jobs={1: job})
    tell(campaign, job.step, what="tiles", done=10, total=40, since=now - 90, at=now)
    bar, whole = bars(campaign, run, TimeLeft(campaign, cores=2))
    assert (bar.counts, bar.fraction) == ("10 of 40 tiles", 0.25)
    assert bar.left_s == pytest.approx(270, rel=0.01)
    assert whole.left_s == pytest.approx(270, rel=0.01)


@pytest.mark.quick("report0", "report5")
@pytest.mark.parametrize(
    "report",
    [
        {"what": "tiles", "done": 10, "total": 40, "since": 5.0, "at": 9.0},  # of a step before
        {"what": "tiles", "done": 50, "total": 40, "since": 2e9, "at": 2e9},
        {"what": "tiles", "done": 0, "total": 0, "since": 2e9, "at": 2e9},
        {"what": "tiles", "done": 1, "total": 4, "since": 2e9, "at": 1e300},
        {"what": "tiles"},
        [],
    ],
)
def test_a_report_that_makes_no_sense_is_none(tmp_path, finished_tiny, report):
    campaign = Campaign.load(copy_writable(finished_tiny.root, tmp_path / "campaign"))
    job = JobRecord("image", ("image", "f01", "uav1-uav1"), "", 1e9)
    path = campaign.result(*progress_path(job.step))
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(report))
    assert StepProgress.of(campaign, job) is None


def test_a_step_that_names_another_folder_is_not_followed(finished_tiny):
    assert StepProgress.of(finished_tiny, JobRecord("image", ("..", "..", "config", "x"), "", 0.0)) is None


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self):
        return True


def test_without_a_terminal_each_step_has_a_line_when_it_begins_and_one_when_it_ends(finished_tiny, journal):
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


def test_what_happened_between_two_looks_is_told_in_its_order_and_counted_one_by_one(finished_tiny):
    run, stream = RunRecord(planned={"ingest": 2, "scene": 1}), io.StringIO()
    run.jobs = {
        1: JobRecord("ingest", ("ingest", "f01", "uav1"), "", 10.0, 14.0),
        2: JobRecord("scene", ("scene",), "", 10.5, 12.0),
        3: JobRecord("ingest", ("ingest", "f01", "uav2"), "", 12.0),
    }
    with Screen(finished_tiny, TimeLeft(finished_tiny, 2), stream=stream) as screen:
        screen.update(run)
    told = [re.sub(r"^\S+  |: .* s;|, (time|about) .*", "", line) for line in stream.getvalue().splitlines()]
    assert told == [
        "started  ingest f01 uav1",
        "started  scene",
        "done     scene 1 of 3 steps",
        "started  ingest f01 uav2",
        "done     ingest f01 uav1 2 of 3 steps",
    ]


def test_a_terminal_shows_bars_and_gets_its_cursor_back(finished_tiny, journal, monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    stream = Terminal()
    screen = Screen(finished_tiny, TimeLeft(finished_tiny, 2), stream=stream)
    with pytest.raises(AttributeError), screen:  # whatever ends it
        [screen.update(run) for run in (JournalReader(journal).news(), None)]
    said = stream.getvalue()
    assert "━" in said
    assert "1 of 5 steps" in said
    assert said.rfind("\x1b[?25h") > said.rfind("\x1b[?25l")


def test_a_quiet_run_shows_nothing(finished_tiny, journal):
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


def test_steps_that_fail_alike_say_it_once_with_every_log(tmp_path):
    told = failed(tmp_path, "reading\nerror: codes.npy: gone\n", "error: codes.npy: gone\n")
    assert told.count("codes.npy: gone") == 1
    assert told.startswith("error: codes.npy: gone\n")
    assert "0.log" in told
    assert "1.log" in told
    assert told.endswith("snakemake.log")


def test_a_defect_and_a_killed_step_are_told_apart(tmp_path):
    assert "internal error, please report it" in failed(
        tmp_path, "Traceback (most recent call last):\nZeroDivisionError: by zero\n"
    )
    assert "it was killed, possibly out of memory" in failed(tmp_path, "10 of 20 tiles to form\n")


@pytest.mark.parametrize(("said", "killed"), [("10 of 20 tiles to form\n", True), ("error: codes.npy: gone\n", False)])
def test_a_killed_step_is_known_by_its_log(tmp_path, said, killed):
    (tmp_path / "0.log").write_text(said)
    assert (
        a_step_was_killed(tmp_path, RunRecord(jobs={0: JobRecord("image", "image f01", "0.log", 0, failed=True)}))
        == killed
    )


def test_an_executor_without_its_plugin_is_one_message_with_what_to_install(tmp_path):
    (tmp_path / "a.log").write_text(
        "usage: [-h]\nsnakemake: error: argument --executor/-e: invalid choice: 'slurm' (choose from 'local')\n"
    )
    message, _ = failures(tmp_path, RunRecord(), tmp_path / "a.log")
    assert message.startswith("error: executor 'slurm' is not installed. Install it with apertura: ")
    assert message.endswith("pip install snakemake-executor-plugin-slurm")


def test_without_a_writable_home_caches_lie_in_the_temporary_folder(tmp_path, monkeypatch):
    (tmp_path / "home").write_text("a file: nothing can be made below it, by root neither")
    monkeypatch.setattr(os, "environ", {"HOME": str(tmp_path / "home")})
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    keep_caches_writable()
    cache = Path(os.environ["XDG_CACHE_HOME"])
    assert (cache.parent, cache.stat().st_mode & 0o777) == (tmp_path, 0o700)
    assert os.environ["MPLCONFIGDIR"] == f"{cache}/matplotlib"
    cache.rename(tmp_path / "other")
    cache.symlink_to(tmp_path / "other")  # as another user may have left it
    del os.environ["XDG_CACHE_HOME"]
    keep_caches_writable()
    assert Path(os.environ["XDG_CACHE_HOME"]) != cache


def test_with_a_writable_home_caches_stay_where_they_are(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "environ", {"HOME": str(tmp_path / "new" / "home")})
    keep_caches_writable()
    assert os.environ.keys() == {"HOME"}


def test_what_the_workflow_says_is_told_where_no_step_failed(tmp_path):
    run = RunRecord(errors=["MissingRuleException:\nno rule for \x1b[31mx"])
    assert next(failures(tmp_path, run, tmp_path / "a.log")) == r"error: MissingRuleException: no rule for \x1b[31mx"


@pytest.fixture
def finished(finished_tiny, tmp_path):
    """A finished campaign, to be spoilt at will."""
    return Campaign.load(copy_writable(finished_tiny.root, tmp_path / "finished"))


def files(root):
    return {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}


def test_clean_leaves_what_was_there_before_the_run(finished, tiny, capsys):
    clean(finished, unfinished_only=False, agreed=True)
    assert files(finished.root) == files(tiny)
    assert not finished.results.exists()


def test_clean_keeps_what_the_workflow_has_not_made_and_says_so(finished, capsys):
    for name in ("notes.txt", "f01/uav1-uav1/db.qgz", "f01/uav1-uav1/image.zarr/mine"):
        (finished.results / name).write_text("mine")
    clean(finished, unfinished_only=False, agreed=True)
    assert files(finished.results) - {".run.lock"} == {
        "notes.txt",
        "f01/uav1-uav1/db.qgz",
        "f01/uav1-uav1/image.zarr/mine",
    }
    assert "kept files not written by the workflow: results/f01/uav1-uav1/db.qgz and 2 more" in capsys.readouterr().out


def test_clean_of_unfinished_work_keeps_every_result(finished, capsys):
    wip = finished.results / "f01/uav1-uav1/image.zarr.wip"
    shutil.copytree(str(finished.results / "f01/uav1-uav1/image.zarr"), str(wip))
    before = files(finished.results)
    clean(finished, unfinished_only=True, agreed=True)
    assert {name for name in before - files(finished.results) if ".wip/" not in name} == set()
    assert not wip.exists()
    assert set(states(finished)["f01", "uav1-uav1"]["missing"]) == set()


def test_clean_waits_for_no_run_and_no_step(finished):
    before = files(finished.results)
    with hold(finished.root), pytest.raises(CampaignError, match="the campaign is locked by another run"):
        clean(finished, unfinished_only=False, agreed=True)
    from apertura.campaign.store import writing

    with (
        writing(finished.stage("echo", "f01", "uav1-uav1")),
        pytest.raises(CampaignError, match="a step is still writing"),
    ):
        clean(finished, unfinished_only=False, agreed=True)
    assert len(files(finished.results)) >= len(before) - 1  # the manifest of what is written again


def test_clean_asks_and_without_anyone_to_ask_removes_nothing(finished, monkeypatch):
    before = files(finished.results)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(CampaignError, match="--yes"):
        clean(finished, unfinished_only=False, agreed=False)
    assert before <= files(finished.results)


@pytest.mark.quick("../raw/codes.npy", "out/secret")
@pytest.mark.parametrize("name", ["../../config/config.yaml", "../raw/codes.npy", "/etc/hostname", "out/secret"])
def test_clean_follows_no_manifest_and_no_link_out_of_its_folder(finished, tmp_path, name):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "secret").write_text("kept")
    Path(finished.results / "out").symlink_to(outside)
    (finished.results / "evil.manifest.json").write_text(json.dumps({"files": {name: "0"}}))
    clean(finished, unfinished_only=False, agreed=True)
    assert (finished.root / "config/config.yaml").is_file()
    assert (finished.root / "raw/codes.npy").is_file()
    assert (outside / "secret").is_file()


def test_list_tells_what_is_finished_stale_and_missing(finished, capsys):
    (finished.results / "f01/uav1-uav1/image.manifest.json").unlink()
    found = states(finished)
    assert found["f01", "uav1"] == {"finished": ["raw", "track"], "stale": [], "missing": []}
    assert found["f01", "uav1-uav1"] == {
        "finished": ["echo", "profile", "layers"],
        "stale": ["export"],
        "missing": ["image"],
    }
    print_list(finished)
    said = capsys.readouterr().out
    assert "uav1-uav2" in said
    assert "in results" in said


def test_status_tells_from_another_terminal_what_a_run_does(finished, capsys):
    path = finished.result(".run", "journal.jsonl")
    path.parent.mkdir()
    note(path, "start", cores=2)
    note(path, "planned", jobs=PLANNED)
    begun(path, 1, "image", "f01", "uav1-uav1")
    with hold(finished.root):
        print_status(finished)
    said = capsys.readouterr().out
    assert f"a run is in progress: process {os.getpid()} on" in said
    assert "image f01 uav1-uav1: " in said
    assert "waiting: 2 ingest, 1 image, 1 cube" in said
    print_status(finished)
    assert "was killed" in capsys.readouterr().out


def test_status_after_a_failure_says_why(finished, capsys):
    path = finished.result(".run", "journal.jsonl")
    path.parent.mkdir()
    (finished.results / "logs").mkdir()
    (finished.results / "logs/a.log").write_text("error: the log of uav1 is empty\n")
    note(path, "start", cores=2)
    note(path, "planned", jobs=PLANNED)
    begun(path, 1, "image", "f01", "uav1-uav1", log="results/logs/a.log")
    note(path, "failed", job=1)
    note(path, "end", status=2)
    print_status(finished)
    said = capsys.readouterr().out
    assert "failed with exit status 2" in said
    assert said.count("error: the log of uav1 is empty") == 1
    assert "results finished" in said


def test_who_holds_a_campaign_may_be_asked_while_a_run_begins(tmp_path):
    (tmp_path / "results").mkdir()
    assert holder(tmp_path) is None
    asking = True

    def ask():
        while asking:
            holder(tmp_path)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        for _ in range(200):
            hold(tmp_path).close()
    finally:
        asking = False
        thread.join()


@pytest.mark.skipif(shutil.which("make") is None, reason="no make here")
def test_make_demo_leaves_a_folder_of_somebody_else_alone(tmp_path):
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
    # Said on the command line, what the make around this test was given (`make test VENV=...`) does not count here.
    own = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
    called = ["make", "demo", "VENV=.venv"]
    done = subprocess.run(called, cwd=tmp_path, env=own, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "error: demo/ was not made by make demo" in done.stderr
    assert (tmp_path / "demo/notes.txt").read_text() == "mine"
