"""The command line as people type it: a folder or the one in hand, one message and one exit status for each mistake."""

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
def typed(monkeypatch, capsys):
    """Type a command, in a folder if one is given; return its exit status, output and complaint."""

    def run(*words, folder=None):
        if folder is not None:
            monkeypatch.chdir(str(folder))
        monkeypatch.setattr(sys, "argv", ["apertura", *map(str, words)])
        monkeypatch.setattr(processes, "_left", [])
        here = Path.cwd()
        try:
            cli.main()
            status = 0
        except SystemExit as ended:
            status = ended.code or 0
        finally:
            os.chdir(here)
        said = capsys.readouterr()
        return status, said.out, said.err

    return run


@pytest.mark.parametrize("words", ["check", "plan", "summary", "list", "status", "run -n", "score"])
def test_the_folder_in_hand_is_the_campaign(finished_tiny, typed, words):
    status, out, err = typed(*words.split(), folder=finished_tiny.root)
    assert (status, err) == (0, "")
    assert out or words == "check"


WRONG = [
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


@pytest.mark.parametrize("words", WRONG)
def test_a_mistake_in_the_command_line_is_one_message_and_exit_status_2(typed, tmp_path, words):
    """In a folder that is no campaign."""
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "config.yaml").write_text("campaign: x\n")
    status, out, err = typed(*words.split(), folder=tmp_path)
    assert status == 2
    assert "Traceback" not in out + err
    complaint = out if words.startswith(("check ", "step")) and not err else err
    assert complaint.count("\n") == 1 or "Usage: " in complaint or "─ Error ─" in complaint
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config"]


def test_help_names_what_the_documents_use_and_hides_what_rules_use(typed):
    status, out, _ = typed("run", "--help")
    assert status == 0
    for option in ("--until", "--dry-run", "-n", "--set-scatter", "--profile", "--quiet"):
        assert option in out
    status, out, _ = typed("--help")
    listed = {line.split()[1] for line in out.splitlines() if line.startswith("│ ") and line[2] != " "}
    assert {"run", "check", "verify", "inspect"} <= listed
    assert not {"step", "study", "check-crate"} & listed
    assert typed("step", "--help")[0] == 0


def test_options_of_run_reach_snakemake(monkeypatch, typed, tiny):
    given = []
    monkeypatch.setattr("apertura.run.driver.run_workflow", lambda *words, **_: given.append(words[2:]) or 0)
    typed("run", "--until", "export", "-n", "--set-scatter", "tiles=4", "--profile", "profiles/slurm", folder=tiny)
    typed("run", tiny, "phase_history", "-np", "--batch=all=1/3")
    typed("run", "--until", "echo", "scene", "terrain", tiny)
    typed("run", tiny, "-U", "echo", "scene")
    assert given == [
        ("-n", "--until", "export", "--profile", "profiles/slurm", "--set-scatter", "tiles=4"),
        ("phase_history", "-p", "--batch", "all=1/3", "-n"),
        ("--until", "echo", "scene", "terrain"),
        ("--until", "echo", "scene"),
    ]


WRONG_RUNS = {
    "--set-scatter tile=3": "tiles=N, N >= 1",
    "--set-scatter tiles=0": "tiles=N, N >= 1",
    "--set-scat=tiles=0": "tiles=N, N >= 1",
    "--until imag": "ingest, bench, echo",
    "cphd": "cphd: a step that runs only if its result is requested",
    "results/f01/uav2-uav2/echo.manifest.json": "one of fused, tracks, uav1, uav1-uav1, uav1-uav2, uav2",
    "results/f01/uav9/track.manifest.json": "f01 has no uav9",
    "results/f09/uav1-uav1/echo.manifest.json": "no flight 'f09'",
}


@pytest.mark.parametrize("words", WRONG_RUNS)
def test_what_snakemake_would_ignore_or_make_of_no_flight_is_refused(typed, tiny, words):
    status, out, err = typed("run", tiny, *words.split(), "-n")
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert WRONG_RUNS[words] in err
    assert not (tiny / "results").exists()


@pytest.mark.slow
def test_a_step_named_as_a_target_is_the_last_step(typed, tiny):
    status, out, err = typed("run", tiny, "echo", "-n")
    assert (status, err) == (0, "")
    assert out.endswith("2 echo\n")


@pytest.mark.slow
def test_a_last_step_that_another_one_needs_is_no_error(typed, tiny):
    alone = typed("run", tiny, "--until", "image", "-n")
    assert alone[0] == 0
    assert "2 image" in alone[1]
    for words in ("echo image", "image echo ingest", "tiles image", "image tiles"):
        assert typed("run", tiny, "--until", *words.split(), "-n") == alone
    assert "1 scene, 2 echo" in typed("run", tiny, "--until", "echo", "scene", "-n")[1]


@pytest.mark.slow
def test_after_a_part_of_the_workflow_a_run_says_what_is_finished_and_what_is_missing(finished_tiny, tmp_path, typed):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    state(root, "processing", engine="numba")
    status, out, err = typed("run", root, "--cores", 1, "--until", "image")
    assert status == 0, err
    told = r"^\d+ results finished, \d+ results stale, \d+ results missing: `apertura run` computes the rest$"
    assert re.search(told, out, re.MULTILINE)
    assert "error" not in err
    assert typed("summary", root)[0] == 2  # no image is there


def test_an_image_that_was_overtaken_is_not_finished_although_its_report_is_there(finished_tiny, tmp_path, typed):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    (root / "results/f01/uav1-uav2/export.manifest.json").unlink()  # as a run does that does not come to it
    assert not is_finished(Campaign.load(root))
    status, out, _ = typed("summary", root)
    assert status == 0
    assert "missing or out of date: f01 uav1-uav2; `apertura run` computes" in " ".join(out.split())


@pytest.mark.quick("samples-summary", "samples-verify -q")
@pytest.mark.parametrize("words", ["check", "summary", "list", "status", "score", "verify -q", "run -n"])
@pytest.mark.parametrize("lost", ["samples", "all"])
def test_results_are_read_where_their_recordings_are_not(finished_tiny, tmp_path, typed, words, lost):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    for path in list((root / "raw").rglob("*.sigmf-data" if lost == "samples" else "*.*")):
        path.unlink()
    command, *options = words.split()
    status, out, err = typed(command, root, *options)
    makes = lost == "all" and command in {"check", "run"}  # which read logs and codes
    assert status == (1 if command == "verify" else 2 if makes else 0), out + err
    if command == "verify":
        assert re.findall(r"^(\w+) +(\S+sigmf-data):", out, re.MULTILINE) == [("missing", name) for name in SAMPLES]
        assert "changed" not in out
    elif command in {"check", "summary", "list"} and not makes:
        assert "missing recordings, not compared with results: raw/f01/uav1.sigmf-" in out


@pytest.mark.parametrize("node", ["uav2", "uav9"])
def test_a_node_that_sends_nothing_is_not_aligned(typed, tiny, node):
    status, _, err = typed("align", tiny, "f01", node)
    assert status == 2
    assert f"{node} does not transmit and receive in f01" in err
    assert "--until echo" in typed("align", tiny, "f01", "uav1")[2]


def test_a_summary_says_how_many_results_a_setting_has_overtaken(finished_tiny, tmp_path, typed):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    assert "out of date" not in typed("summary", root)[1]
    state(root, "scene", height_m=finished_tiny.settings.scene.height_m + 0.5)
    last = typed("summary", root)[1].splitlines()[-1]
    assert re.fullmatch(r"\d+ results are out of date: `apertura run` recomputes them", last)


@pytest.mark.quick("True")
@pytest.mark.parametrize("settled", [True, False])
def test_a_reflector_is_given_in_the_zone_that_auto_stands_for(finished_tiny, tmp_path, settled):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    grid = settled_scene(finished_tiny).grid
    xmin, ymin, xmax, ymax = grid.bounds_m
    point = ((xmin + xmax) / 2, (ymin + ymax) / 2, finished_tiny.settings.scene.height_m)
    expected = align(finished_tiny, "f01", "uav1", point=point, search_s=0.01)[1]
    state(root, "scene", crs="auto", bounds_m="auto")
    if not settled:
        (root / "results/scene.manifest.json").unlink()
    assert align(Campaign.load(root), "f01", "uav1", point=point, search_s=0.01)[1] == expected


def test_a_summary_shows_what_is_there_and_names_what_is_missing(finished_tiny, tiny, typed, monkeypatch):
    flight, pair = "f01", finished_tiny.image_flights[0].pairs[0]
    source, target = (one / "results" / flight / pair for one in (finished_tiny.root, tiny))
    target.mkdir(parents=True)
    for name in ("image.json", "export.manifest.json"):
        (target / name).write_bytes((source / name).read_bytes())
    status, out, err = typed("summary", tiny)
    assert (status, err) == (0, "")
    assert f"{flight} {pair}" in out
    assert f"missing or out of date: f01 uav1-uav2, f01 {FUSED}; `apertura run` computes" in " ".join(out.split())


def test_a_summary_of_nothing_says_what_to_run(tiny, typed):
    status, _, err = typed("summary", tiny)
    assert status == 2
    assert "Run the workflow first" in err


def test_a_plan_says_what_it_was_made_from(tiny, finished_tiny, typed):
    before, after = (typed("plan", root)[1] for root in (tiny, finished_tiny.root))
    assert "Planned from the flight logs alone" in before
    assert "Planned from the flight logs alone" not in after


@pytest.mark.parametrize(
    ("kind", "nodes"), [("ofdm", ["uav1", "uav2"]), ("fmcw", ["uav1"]), ("phase_history", ["uav1"])]
)
def test_init_writes_the_nodes_that_its_kind_has(tmp_path, typed, kind, nodes):
    assert typed("init", "new", "--kind", kind, folder=tmp_path)[0] == 0
    config = yaml.safe_load((tmp_path / "new/config/config.yaml").read_text())
    assert list(config["nodes"]) == nodes
    assert (tmp_path / "new/config/flights.tsv").read_text().splitlines()[1].split("\t") == [
        "f01", "image", "uav1", ",".join(nodes)
    ]  # fmt: skip
