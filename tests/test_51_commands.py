"""The command line: campaign folder argument, current directory, one message and exit status for each error."""

import os
import re
import sys
from pathlib import Path

import pytest
import yaml
from folders import copy_writable, state

from apertura import cli
from apertura.campaign.config import FUSED
from apertura.campaign.folder import Campaign
from apertura.common import processes
from apertura.stages.scene import settled_scene
from apertura.tools.align import align
from apertura.views.summary import is_finished

SAMPLES = ["raw/f01/uav1.sigmf-data", "raw/f01/uav2.sigmf-data"]


@pytest.fixture
def run_command(monkeypatch, capsys):
    """Return a function that runs a command, optionally in a folder: exit status, output and error output."""

    def run(*words, folder=None):
        if folder is not None:
            monkeypatch.chdir(str(folder))
        monkeypatch.setattr(sys, "argv", ["apertura", *map(str, words)])
        monkeypatch.setattr(processes, "_left", [])
        working_folder = Path.cwd()
        try:
            cli.main()
            status = 0
        except SystemExit as ended:
            status = ended.code or 0
        finally:
            os.chdir(working_folder)
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    return run


@pytest.mark.quick("plan", "list", "status")
@pytest.mark.parametrize("words", ["check", "plan", "summary", "list", "status", "run -n", "score"])
def test_default_campaign_is_the_current_directory(finished_tiny, run_command, words):
    status, out, err = run_command(*words.split(), folder=finished_tiny.root)
    assert (status, err) == (0, "")
    assert out or words == "check"


INVALID_COMMANDS = [
    "chek", "run nowhere", "check nowhere", "plan nowhere", "summary nowhere", "score nowhere",
    "list nowhere",     "status nowhere", "clean nowhere --yes", "report nowhere", "map nowhere",
    "chart nowhere", "reflectors nowhere",     "align nowhere f01 uav1", "align f01", "align a b c d",
    "align . f01 uav9", "verify nowhere", "verify --crate nowhere",     "verify --crate", "reproduce nowhere",
    "diff nowhere", "diff nowhere nowhere", "inspect nowhere", "inspect",     "init", "init new --kind radar",
    "init config/..", "simulate", "simulate a b c",
    "simulate new --preset none",     "simulate --print-spec none", "run --cores 0", "run --cores many",
    "run --until", "map --port 99999", "plan --threads 0",     "run export", "align . f01 uav1 --point 1 2",
    "align . f01 uav1 --search-s -1", "check --product", "step", "step nothing",     "step image f01",
    "step image f01 uav1-uav9", "check-crate .", "design nowhere",
    "design", "compare nowhere", "init new --from nowhere", "simulate new --seed -1",
    "simulate config/config.yaml/new", "init config/config.yaml/new", "simulate /proc/new", "init /proc/new",
]  # fmt: skip


@pytest.mark.parametrize("words", INVALID_COMMANDS)
def test_invalid_command_is_one_message_and_status_2(run_command, tmp_path, words):
    """Commands run in a folder without a valid campaign."""
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "config.yaml").write_text("campaign: x\n")
    status, out, err = run_command(*words.split(), folder=tmp_path)
    assert status == 2
    assert "Traceback" not in out + err
    complaint = out if words.startswith(("check ", "step")) and not err else err
    assert complaint.count("\n") == 1 or "Usage: " in complaint or "─ Error ─" in complaint
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config"]


def test_help_lists_user_commands_and_hides_internal_ones(run_command):
    status, out, _ = run_command("run", "--help")
    assert status == 0
    for option in ("--until", "--dry-run", "-n", "--set-scatter", "--profile", "--quiet"):
        assert option in out
    status, out, _ = run_command("--help")
    listed = {line.split()[1] for line in out.splitlines() if line.startswith("│ ") and line[2] != " "}
    assert {"run", "check", "verify", "inspect"} <= listed
    assert not {"step", "study", "check-crate"} & listed
    assert run_command("step", "--help")[0] == 0


def test_options_of_run_reach_snakemake(monkeypatch, run_command, tiny):
    calls = []
    monkeypatch.setattr("apertura.run.driver.run_workflow", lambda *words, **_: calls.append(words[2:]) or 0)
    run_command(
        "run", "--until", "export", "-n", "--set-scatter", "tiles=4", "--profile", "profiles/slurm", folder=tiny
    )
    run_command("run", tiny, "phase_history", "-np", "--batch=all=1/3")
    run_command("run", "--until", "echo", "scene", "terrain", tiny)
    run_command("run", tiny, "-U", "echo", "scene")
    assert calls == [
        ("-n", "--until", "export", "--profile", "profiles/slurm", "--set-scatter", "tiles=4"),
        ("phase_history", "-p", "--batch", "all=1/3", "-n"),
        ("--until", "echo", "scene", "terrain"),
        ("--until", "echo", "scene"),
    ]


INVALID_RUNS = {
    "--set-scatter tile=3": "tiles=N, N >= 1",
    "--set-scatter tiles=0": "tiles=N, N >= 1",
    "--set-scat=tiles=0": "tiles=N, N >= 1",
    "--until imag": "ingest, bench, echo",
    "cphd": "cphd: a step that only runs if its result is requested",
    "results/f01/uav2-uav2/echo.manifest.json": "one of fused, tracks, uav1, uav1-uav1, uav1-uav2, uav2",
    "results/f01/uav9/track.manifest.json": "f01 has no uav9",
    "results/f09/uav1-uav1/echo.manifest.json": "no flight 'f09'",
}


@pytest.mark.parametrize("words", INVALID_RUNS)
def test_invalid_targets_and_options_of_run_are_refused(run_command, tiny, words):
    status, out, err = run_command("run", tiny, *words.split(), "-n")
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert INVALID_RUNS[words] in err
    assert not (tiny / "results").exists()


@pytest.mark.slow
def test_step_given_as_target_is_the_last_step(run_command, tiny):
    status, out, err = run_command("run", tiny, "echo", "-n")
    assert (status, err) == (0, "")
    assert out.endswith("2 echo\n")


@pytest.mark.slow
def test_redundant_last_steps_are_accepted(run_command, tiny):
    alone = run_command("run", tiny, "--until", "image", "-n")
    assert alone[0] == 0
    assert "2 image" in alone[1]
    for words in ("echo image", "image echo ingest", "tiles image", "image tiles"):
        assert run_command("run", tiny, "--until", *words.split(), "-n") == alone
    assert "1 scene, 2 echo" in run_command("run", tiny, "--until", "echo", "scene", "-n")[1]


@pytest.mark.slow
def test_partial_run_reports_finished_and_missing_results(finished_tiny, tmp_path, run_command):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    state(root, "processing", engine="numba")
    status, out, err = run_command("run", root, "--cores", 1, "--until", "image")
    assert status == 0, err
    counts = r"^\d+ results finished, \d+ results out of date, \d+ results missing"
    assert re.search(f"{counts}: `apertura run` computes the remaining results$", out, re.MULTILINE)
    assert "error" not in err
    assert run_command("summary", root)[0] == 2  # no image exists


def test_outdated_image_with_a_report_is_not_finished(finished_tiny, tmp_path, run_command):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    (root / "results/f01/uav1-uav2/export.manifest.json").unlink()  # as after a run that did not reach this step
    assert not is_finished(Campaign.load(root))
    status, out, _ = run_command("summary", root)
    assert status == 0
    assert "missing or out of date: f01 uav1-uav2; `apertura run` computes" in " ".join(out.split())


@pytest.mark.quick("samples-summary", "samples-verify -q")
@pytest.mark.parametrize("words", ["check", "summary", "list", "status", "score", "verify -q", "run -n"])
@pytest.mark.parametrize("missing", ["samples", "all"])
def test_commands_read_results_without_recordings(finished_tiny, tmp_path, run_command, words, missing):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    for path in list((root / "raw").rglob("*.sigmf-data" if missing == "samples" else "*.*")):
        path.unlink()
    command, *options = words.split()
    status, out, err = run_command(command, root, *options)
    needs_raw = missing == "all" and command in {"check", "run"}  # these commands read logs and codes
    assert status == (1 if command == "verify" else 2 if needs_raw else 0), out + err
    if command == "verify":
        assert re.findall(r"^(\w+) +(\S+sigmf-data):", out, re.MULTILINE) == [("missing", name) for name in SAMPLES]
        assert "changed" not in out
    elif command in {"check", "summary", "list"} and not needs_raw:
        assert "recordings are missing and not compared with results: raw/f01/uav1.sigmf-" in out


@pytest.mark.parametrize("node", ["uav2", "uav9"])
def test_node_that_does_not_transmit_is_not_aligned(run_command, tiny, node):
    status, _, err = run_command("align", tiny, "f01", node)
    assert status == 2
    assert f"{node} does not both transmit and receive in f01" in err
    assert "--until echo" in run_command("align", tiny, "f01", "uav1")[2]


@pytest.mark.slow
def test_summary_reports_the_number_of_outdated_results(finished_tiny, tmp_path, run_command):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    assert "out of date" not in run_command("summary", root)[1]
    state(root, "scene", height_m=finished_tiny.settings.scene.height_m + 0.5)
    last = run_command("summary", root)[1].splitlines()[-1]
    assert re.fullmatch(r"\d+ results are out of date: `apertura run` recomputes them", last)


@pytest.mark.slow
@pytest.mark.parametrize("has_scene", [True, False])
def test_reflector_position_is_in_the_automatic_crs(finished_tiny, tmp_path, has_scene):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    grid = settled_scene(finished_tiny).grid
    xmin, ymin, xmax, ymax = grid.bounds_m
    point = ((xmin + xmax) / 2, (ymin + ymax) / 2, finished_tiny.settings.scene.height_m)
    expected = align(finished_tiny, "f01", "uav1", point=point, search_s=0.01)[1]
    state(root, "scene", crs="auto", bounds_m="auto")
    if not has_scene:
        (root / "results/scene.manifest.json").unlink()
    assert align(Campaign.load(root), "f01", "uav1", point=point, search_s=0.01)[1] == expected


def test_summary_shows_finished_and_names_missing_images(finished_tiny, tiny, run_command, monkeypatch):
    flight, pair = "f01", finished_tiny.image_flights[0].pairs[0]
    source, target = (one / "results" / flight / pair for one in (finished_tiny.root, tiny))
    target.mkdir(parents=True)
    for name in ("image.json", "export.manifest.json"):
        (target / name).write_bytes((source / name).read_bytes())
    status, out, err = run_command("summary", tiny)
    assert (status, err) == (0, "")
    assert f"{flight} {pair}" in out
    assert f"missing or out of date: f01 uav1-uav2, f01 {FUSED}; `apertura run` computes" in " ".join(out.split())


def test_summary_without_results_names_the_command_to_run(tiny, run_command):
    status, _, err = run_command("summary", tiny)
    assert status == 2
    assert "Run the workflow first" in err


@pytest.mark.slow
def test_plan_states_its_inputs(tiny, finished_tiny, run_command):
    before, after = (run_command("plan", root)[1] for root in (tiny, finished_tiny.root))
    assert "This plan is based on the flight logs alone" in before
    assert "This plan is based on the flight logs alone" not in after


@pytest.mark.parametrize(
    ("kind", "nodes"), [("ofdm", ["uav1", "uav2"]), ("fmcw", ["uav1"]), ("phase_history", ["uav1"])]
)
def test_init_writes_the_nodes_of_its_waveform_kind(tmp_path, run_command, kind, nodes):
    assert run_command("init", "new", "--kind", kind, folder=tmp_path)[0] == 0
    config = yaml.safe_load((tmp_path / "new/config/config.yaml").read_text())
    assert list(config["nodes"]) == nodes
    assert (tmp_path / "new/config/flights.tsv").read_text().splitlines()[1].split("\t") == [
        "f01", "image", "uav1", ",".join(nodes)
    ]  # fmt: skip
