"""Campaign folders are data: planted code and foreign files are neither executed nor opened by any command."""

import json
import os
import pickle
import shlex
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import google_crc32c
import pytest
import yaml
from attack.planted import SNAKEMAKES_OWN, Code, hostile_texts, plant
from folders import copy_writable, edit_config, write_plane
from typer.main import get_command

from apertura.campaign.config.template import config_schema
from apertura.campaign.store.chunks import array_of
from apertura.cli import app
from apertura.common.errors import CampaignError
from apertura.common.processes import SAFE_PATH
from apertura.run.driver import code_from_outside
from apertura.run.process import process

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
BATCH_SYSTEM = ROOT / "tests" / "attack" / "batch_system"
PLAIN_PATH = f"{BIN}{os.pathsep}/usr/bin{os.pathsep}/bin{os.pathsep}."
"""Search path of a user with the current directory as its last entry."""

TYPED = {
    "align": "align . f01 uav1 --point 500000 5300000 500",
    "chart": "chart . -n",
    "check": "check .",
    "clean": "clean . --yes",
    "compare": "compare plan.yaml .",
    "design": "design plan.yaml design",
    "diff": "diff results/f01/uav1-uav1/db.tif results/f01/uav1-uav2/db.tif",
    "export stack": "export stack .",
    "export time-series": "export time-series results",
    "init": "init new",
    "inspect": "inspect .",
    "list": "list",
    "preview": "preview .",
    "map": "map .",
    "payload": "payload .",
    "plan": "plan .",
    "publish": "publish . memory://bucket",
    "reflectors": "reflectors .",
    "report": "report .",
    "reproduce": "reproduce results/f01/uav1-uav1/db.tif",
    "run": "run . --cores 2",
    "score": "score .",
    "simulate": "simulate simulated",
    "status": "status",
    "summary": "summary",
    "verify": "verify results/f01/fused/coherent_db.tif",
    "step assess": "step assess f01",
    "step calibrate": "step calibrate f01",
    "step change": "step change f01",
    "step chart": "step chart f01 uav1-uav1 --seconds 1",
    "step cphd": "step cphd f01 uav1-uav2",
    "step echo": "step echo f01 uav1-uav2",
    "step export": "step export f01 fused",
    "step image": "step image f01 uav1-uav2",
    "step ingest": "step ingest f01 uav1",
    "step interferogram": "step interferogram none",
    "step layers": "step layers f01 uav1-uav2",
    "step page": "step page f01",
    "step payload": "step payload f01",
    "step pictures": "step pictures f01 uav1-uav2",
    "step pictures-fused": "step pictures-fused f01",
    "step profile": "step profile f01 uav1-uav2",
    "step refine": "step refine f01",
    "step stack-image": "step stack-image f01",
    "step tiles": "step tiles f01 uav1-uav2 1-of-2",
    "step tracks": "step tracks f01",
    "step transfer": "step transfer f01 uav1-uav2",
    "step whole-chart": "step whole-chart --repeats 1",
    "study autofocus-picture": "study autofocus-picture none",
    "study chart": "study chart stability none",
    "study paper-figure": "study paper-figure scene",
    "study paper-part": "study paper-part parameters",
    "study summary": "study summary none",
    "study sweep": "study sweep stability none",
}
"""Command → command line in the campaign folder, if it has arguments."""

MAY_REFUSE = {
    *("align", "bench", "export stack", "export time-series", "payload", "reflectors", "step bench", "step calibrate"),
    *("step change", "step interferogram", "step page", "step payload", "step stack", "step stack-image"),
}
"""Commands whose requirements the tested campaign does not meet."""

WORKFLOW_COMMANDS = {
    "apertura, in the campaign": ("{bin}/apertura run . --cores 2", "{campaign}"),
    "apertura, tiles by several jobs": (
        "{bin}/apertura run . --cores 2 --set-scatter tiles=2 --until image",
        "{campaign}",
    ),
    "snakemake, from the sources": ("{bin}/snakemake --directory {campaign} --cores 2 {part}", "{root}"),
    "snakemake, from elsewhere": (
        "{bin}/snakemake --snakefile {root}/Snakefile --directory {campaign} -c 2 {part}",
        None,
    ),
    "Slurm, in the campaign": ("{bin}/apertura run . --profile profiles/slurm --cores 2 {soon} {part}", "{campaign}"),
    "a batch system that hands on no environment": (
        "{bin}/apertura run . --executor cluster-generic --cluster-generic-submit-cmd "
        "'env -i PATH={bin}:/usr/bin:/bin sh' --jobs 2 --cores 2 --seconds-between-status-checks 1 {part}",
        "{campaign}",
    ),
}
"""Workflow runs, one of them up to the last product: name → command and working directory.

The others end after the first steps: each start of a step is the same, and each step alone is among the commands above.
"""

PART = "--until ingest"
SOON = (
    "--set-scatter tiles=1 --latency-wait 2 --slurm-init-seconds-before-status-checks 1 "
    "--seconds-between-status-checks 1"
)


def slow(*cases):
    return [pytest.param(case, marks=pytest.mark.slow) for case in cases]


def all_commands():
    """Yield every command of the command line."""
    root = get_command(app)
    commands = {name: root.get_command(None, name) for name in root.list_commands(None)}
    for name, command in commands.items():
        yield from (f"{name} {one}" for one in command.commands) if hasattr(command, "commands") else [name]


def start(words, folder, **environment):
    return subprocess.Popen(
        words,
        cwd=folder,
        env={**os.environ, "PATH": PLAIN_PATH, **environment},
        text=True,
        errors="replace",
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def run(words, folder, **environment):
    """Run a command; return its exit status and output."""
    process = start(words, folder, **environment)
    printed, output = process.communicate(timeout=500)
    return process.returncode, printed + output


def one_message(status, output):
    assert status == 2, output
    assert "Traceback" not in output
    assert len(output.strip().splitlines()) < 12, output
    return output


@pytest.fixture(scope="session")
def _on_a_plane(_tiny, tmp_path_factory):
    root = copy_writable(_tiny, tmp_path_factory.mktemp("plane") / "campaign")
    write_plane(root, slope=0.0)
    edit_config(root, lambda config: config["scene"].update(dem="dem.tif", dem_datum="ellipsoid"))
    return root


@pytest.fixture(scope="session")
def _finished(_on_a_plane, tmp_path_factory):
    root = process(copy_writable(_on_a_plane, tmp_path_factory.mktemp("finished_plane") / "campaign")).root
    (root / "plan.yaml").write_text(yaml.safe_dump(plan_of(root)))
    return root


def plan_of(root):
    """Return a flight plan with the radar and scene of a campaign and a straight line next to the scene."""
    config = yaml.safe_load((root / "config/config.yaml").read_text())
    west, south, east, _ = config["scene"]["bounds_m"]
    line = {"kind": "line", "start_m": [west, south - 30], "end_m": [east, south - 30], "height_m": 30, "speed_m_s": 1}
    flight = {"transmitter": "uav1", "receivers": ["uav1"], "tracks": {"uav1": line}}
    waveform = {name: value for name, value in config["waveform"].items() if name != "codes"}
    scene = {name: value for name, value in config["scene"].items() if not name.startswith("dem")}
    nodes = {"uav1": {"attitude": "log"}}
    return {"campaign": "plane", "waveform": waveform, "nodes": nodes, "scene": scene, "flights": {"f01": flight}}


@pytest.fixture
def unfinished(_on_a_plane, tmp_path):
    return copy_writable(_on_a_plane, tmp_path / "campaign")


@pytest.fixture
def finished(_finished, tmp_path):
    return copy_writable(_finished, tmp_path / "campaign")


@pytest.mark.slow
def test_executed_or_opened_marker_is_detected(unfinished, monkeypatch):
    """The detection is checked with Python started in the folder, and with a file read outside the folder."""
    monkeypatch.delenv(SAFE_PATH, raising=False)  # set by earlier tests in this process
    planted = plant(unfinished)
    with planted.fires() as fired:
        subprocess.run([sys.executable, "-c", "import yaml"], cwd=unfinished, check=False)
        subprocess.run([sys.executable, "-P", "-c", "import yaml"], cwd=unfinished, check=True)
        (planted.outside / "init").read_bytes()
        (unfinished / "matplotlibrc").read_bytes()
    assert {"ran yaml.py", "opened outside/init", "opened campaign/matplotlibrc"} <= set(fired)
    assert "ran numpy.py" not in fired


def test_every_command_is_tested():
    assert set(TYPED) | MAY_REFUSE <= set(all_commands())


@pytest.mark.slow
@pytest.mark.parametrize("command", list(all_commands()))
def test_command_in_a_finished_campaign_executes_no_planted_code(finished, command):
    planted = plant(finished)
    words = [str(BIN / "apertura"), *shlex.split(TYPED.get(command, command))]
    with planted.fires() as fired:
        if command == "map":
            status, output = request_map(words, finished)
        else:
            status, output = run(words, finished)
    assert fired == []
    assert "Traceback" not in output
    allowed = {0, 2} if command in MAY_REFUSE or command.startswith("study") else {1} if command == "diff" else {0}
    assert status in allowed, output


def request_map(words, folder):
    """Start the map server, request everything that a browser requests, and stop the server."""
    process = start(words, folder)
    address = process.stdout.readline().strip()
    answers = []
    base = address.replace("localhost", "127.0.0.1").partition("/map/")[0].rstrip("/")
    for name in ("", "map/", "map/index.html", "map/app.js", "map/app.css", "map/map.json", "map/shell.js", "yaml.py"):
        for host in (base, base.replace("127.0.0.1", "localhost")):
            try:
                with urllib.request.urlopen(f"{host}/{name}") as answer:
                    answers.append(answer.read())
            except urllib.error.HTTPError as error:
                answers.append(error.read())
    process.send_signal(signal.SIGINT)
    output = "".join(process.communicate(timeout=20))
    assert not any(b"evil.example" in answer or b"os.O_CREAT" in answer for answer in answers)
    return process.returncode, output


@pytest.mark.slow
@pytest.mark.parametrize("start_from", WORKFLOW_COMMANDS)
def test_workflow_executes_no_planted_code(unfinished, tmp_path, start_from):
    planted, jobs = plant(unfinished), tmp_path / "jobs"
    jobs.mkdir()
    command, folder = WORKFLOW_COMMANDS[start_from]
    names = {"bin": BIN, "root": ROOT, "campaign": unfinished, "soon": SOON, "part": PART}
    folder = tmp_path if folder is None else folder.format(**names)
    path = f"{BATCH_SYSTEM}{os.pathsep}{PLAIN_PATH}"
    with planted.fires() as fired:
        status, output = run(shlex.split(command.format(**names)), folder, PATH=path, BATCH_JOBS=str(jobs))
    assert fired == []
    assert status == 0, output
    last_files = {"{part}": "f01/uav2/raw.manifest.json", "image": "f01/uav1-uav2/image.manifest.json"}
    last = next(
        (file for end, file in last_files.items() if WORKFLOW_COMMANDS[start_from][0].endswith(end)),
        "f01/fused/coherent_db.tif",
    )
    assert (unfinished / "results" / last).is_file()
    assert ("Slurm" in start_from) is any(jobs.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(
    "start_from", ["apertura, in the campaign", "snakemake, from the sources", "Slurm, in the campaign"]
)
def test_python_modules_in_snakemakes_folder_are_refused(unfinished, tmp_path, start_from):
    planted, jobs = plant(unfinished, in_snakemakes_own=True), tmp_path / "jobs"
    jobs.mkdir()
    command, folder = WORKFLOW_COMMANDS[start_from]
    names = {"bin": BIN, "root": ROOT, "campaign": unfinished, "soon": SOON, "part": PART}
    path = f"{BATCH_SYSTEM}{os.pathsep}{PLAIN_PATH}"
    with planted.fires() as fired:
        status, output = run(
            shlex.split(command.format(**names)), folder.format(**names), PATH=path, BATCH_JOBS=str(jobs)
        )
    assert fired == []
    assert status != 0
    assert f"{SNAKEMAKES_OWN}: Python modules in a folder of Snakemake" in output.replace("\n", " ")
    assert not any(jobs.iterdir())


OPTIONS_INTO_THE_FOLDER = (
    "--profile profiles/own",
    "--profile {linked}",
    "--profile=./profiles/slurm",
    "--profile {campaign}/profiles/slurm",
    "--prof {campaign}/profiles/slurm",
    "--profile {campaign}/../campaign/profiles/slurm/config.yaml",
    "--workflow-profile {campaign}/profiles/default",
    "--workflow-profile=profiles/none",
    "--configfile {campaign}/config.yaml",
    "--snakefile Snakefile",
    "-s {campaign}/Snakefile",
    "-s{campaign}/Snakefile",
    "-ns{campaign}/Snakefile",
    "-ns {campaign}/Snakefile",
    "--sn {campaign}/Snakefile",
    "--pro {campaign}/profiles/slurm",
    "--wo={campaign}/profiles/slurm",
    "--jobscript {campaign}/bash",
    "--jobsc {campaign}/bash",
    "--profile leads_out/slurm",
    "--profile {campaign}/none/../leads_out/slurm",
)
"""Options of Snakemake, in all their spellings, with paths into the campaign folder."""


@pytest.mark.slow
def test_profile_in_the_campaign_folder_is_refused(unfinished, tmp_path, monkeypatch):
    plant(unfinished)
    linked = tmp_path / "linked"
    linked.symlink_to(unfinished / "profiles" / "slurm")
    shutil.copytree(unfinished / "profiles", tmp_path / "profiles")
    (unfinished / "leads_out").symlink_to(tmp_path / "profiles")
    monkeypatch.chdir(unfinished)

    def is_refused(words):
        try:
            code_from_outside(unfinished, shlex.split(words.format(campaign=unfinished, linked=linked)))
        except CampaignError as problem:
            return "lies in the campaign folder" in str(problem)
        return False

    assert [words for words in OPTIONS_INTO_THE_FOLDER if not is_refused(words)] == []


@pytest.mark.slow
def test_refused_profile_is_not_executed(unfinished):
    planted = plant(unfinished)
    with planted.fires() as fired:
        output = one_message(*run([BIN / "apertura", "run", ".", "-n", "--profile", "profiles/own"], unfinished))
    assert fired == []
    assert "lies in the campaign folder" in output


@pytest.mark.slow
def test_profile_from_the_environment_is_refused(unfinished):
    planted = plant(unfinished)
    with planted.fires() as fired:
        output = one_message(
            *run([BIN / "apertura", "run", ".", "-n"], unfinished, SNAKEMAKE_PROFILE="./profiles/slurm")
        )
    assert fired == []
    assert "SNAKEMAKE_PROFILE ./profiles/slurm lies in the campaign folder" in output


@pytest.mark.slow
@pytest.mark.parametrize("option", ["--trust-io-cache", *slow("--tr")])
def test_pickled_cache_of_snakemake_is_not_read(unfinished, option):
    planted, cache = plant(unfinished), unfinished / ".snakemake" / "iocache"
    cache.mkdir(parents=True, exist_ok=True)
    (cache / "latest.pkl").write_bytes(pickle.dumps(Code(planted.code("iocache"))))
    with planted.fires() as fired:
        output = one_message(*run([BIN / "apertura", "run", ".", "-n", option], unfinished))
    assert fired == []
    assert "would read a pickle in the campaign folder" in output


@pytest.mark.slow
def test_short_option_of_snakemake_is_passed_unchanged(unfinished):
    _, output = run([BIN / "apertura", "run", ".", "-s/review/quiet"], unfinished)
    assert "/review/quiet" in output


@pytest.mark.slow
def test_existing_target_keeps_its_name(finished):
    target = "results/f01/uav1-uav1/export.manifest.json"
    for words in ([target, "-n"], ["-n", "--", target]):
        status, output = run([BIN / "apertura", "run", ".", *words], finished)
        assert status == 0, output


@pytest.mark.slow
def test_shipped_profiles_take_precedence(unfinished, tmp_path):
    planted, own = plant(unfinished), tmp_path / "elsewhere" / "mine"
    own.mkdir(parents=True)
    (own / "config.yaml").write_text("printshellcmds: true\n")
    for folder, profile in ((unfinished, "profiles/default"), (own.parent, "mine"), (tmp_path, "elsewhere/mine")):
        with planted.fires() as fired:
            status, output = run([BIN / "apertura", "run", unfinished, "-n", "--profile", profile], folder)
        assert (status, fired) == (0, []), output


@pytest.mark.slow
def test_path_with_shell_syntax_is_refused_for_batch_systems(unfinished, tmp_path):
    jobs, root = tmp_path / "jobs", unfinished.rename(tmp_path / "$(touch ran)`touch ran`")
    jobs.mkdir()
    path = f"{BATCH_SYSTEM}{os.pathsep}{PLAIN_PATH}"
    for words in (
        [BIN / "apertura", "run", ".", "--profile", "profiles/slurm"],
        [
            BIN / "snakemake",
            "--snakefile",
            ROOT / "Snakefile",
            "--directory",
            root,
            "--profile",
            ROOT / "profiles/slurm",
        ],
    ):
        folder = root if "run" in words else tmp_path
        status, output = run([*words, "--cores", "1"], folder, PATH=path, BATCH_JOBS=str(jobs))
        assert status != 0
        assert "a path with '$'" in output
    assert not any(jobs.iterdir())
    assert not [*tmp_path.rglob("ran")]
    assert run([BIN / "apertura", "run", ".", "-n"], root)[0] == 0


def text_keys():
    """Return the paths of all config keys with free text."""
    schema = json.loads(config_schema())
    paths = {}

    def walk(node, path):
        if "$ref" in node:
            node = schema["$defs"][node["$ref"].rpartition("/")[2]]
        for kind in ("anyOf", "oneOf", "allOf"):
            for one in node.get(kind, []):
                walk(one, path)
        if node.get("type") == "string" and not node.keys() & {"enum", "const"}:
            paths[path] = None
        for name, one in node.get("properties", {}).items():
            walk(one, (*path, name))
        for name, one in (("*", node.get("additionalProperties")), (0, node.get("items"))):
            if isinstance(one, dict):
                walk(one, (*path, name))
        for one in node.get("prefixItems", []):
            walk(one, (*path, 0))

    walk(schema, ())
    return list(paths)


def with_text(config, path, text):
    """Return a config with a text at a key path; free names are those of the campaign, or x."""
    document = section = yaml.safe_load(yaml.safe_dump(config))
    if path[:2] == ("waveform", "codes") and len(path) > 2:
        document["waveform"]["codes"] = {"source": "sidelink", "constellation": "qpsk"}
    path = [
        "uav1" if (at, name) == (1, "*") and path[0] == "nodes" else "x" if name == "*" else name
        for at, name in enumerate(path)
    ]
    for name, following in zip(path, [*path[1:], None], strict=True):
        if following is None:
            value = text
        elif following == 0:
            value = []
        else:
            value = {}
        if isinstance(section, list):
            section.append(value)
            section = section[-1]
        elif following is None:
            section[name] = text
        else:
            section = section.setdefault(name, value)
    return document


ANY_TEXT = {
    ("campaign",),
    ("metadata", "title"),
    ("metadata", "creators", 0, "name"),
    ("metadata", "creators", 0, "affiliation"),
    ("metadata", "institution"),
    ("metadata", "licence"),
    ("metadata", "platform"),
    ("metadata", "instrument"),
    ("nodes", "*", "log", "columns", "*"),
    ("nodes", "*", "log", "start_utc"),
    ("nodes", "*", "log", "body"),
    ("processing", "scheduler"),
}
"""Keys that accept any text: titles, options of other log formats, and settings that require an environment
variable.
"""

IN_ONE_PROCESS = """
import sys, traceback, yaml
from pathlib import Path
from apertura.common.processes import leave_working_folder
leave_working_folder()
from apertura.check import as_line, problems
root = Path(sys.argv[1])
for path in sorted(Path(sys.argv[2]).iterdir()):
    (root / "config/config.yaml").write_bytes(path.read_bytes())
    try:
        lines = [as_line(problem) for problem in problems(root)]
        print(path.name, "PASSED" if not lines else f"{len(lines)} problems", flush=True)
    except Exception:
        print(path.name, "TRACEBACK", traceback.format_exc().splitlines()[-1], flush=True)
"""


def checked(root, documents, scratch):
    """Check a campaign with each of several configs; return the outcome of each and the error output."""
    scratch.mkdir()
    for number, document in enumerate(documents):
        (scratch / f"{number:04d}").write_text(yaml.safe_dump(document))
    done = subprocess.run(
        [sys.executable, "-P", "-c", IN_ONE_PROCESS, root, scratch],
        cwd=root,
        text=True,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [line.partition(" ")[2] for line in done.stdout.splitlines()], done.stderr


@pytest.mark.slow
def test_config_texts_do_not_lead_libraries_outside_the_folder(unfinished, tmp_path):
    planted = plant(unfinished)
    (unfinished / "linked").symlink_to(planted.outside)
    config = yaml.safe_load((unfinished / "config/config.yaml").read_text())
    cases = [(path, name) for path in text_keys() for name in hostile_texts(planted)]
    texts = hostile_texts(planted)
    with planted.fires() as fired:
        outcomes, errors = checked(
            unfinished, [with_text(config, path, texts[name]) for path, name in cases], tmp_path / "configs"
        )
    assert len(outcomes) == len(cases) > 300
    assert fired == []
    assert [(case, line) for case, line in zip(cases, outcomes, strict=True) if "TRACEBACK" in line] == []
    assert "Warning" not in errors
    passed = {case for case, line in zip(cases, outcomes, strict=True) if line == "PASSED"}
    assert {path for path, _ in passed} <= ANY_TEXT


@pytest.mark.slow
def test_hostile_title_is_harmless_in_every_product(unfinished):
    planted = plant(unfinished)
    texts = hostile_texts(planted)
    edit_config(unfinished, lambda config: config.update(campaign=texts["format"].replace("&", "")[:110]))
    with planted.fires() as fired:
        status, output = run([BIN / "apertura", "run", ".", "--cores", "2"], unfinished)
    assert fired == []
    assert status in {0, 2}, output


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["PROJ nadgrids", *slow("PROJ init", "PROJ geoidgrids", "PROJ text", "a code of PROJ")]
)
def test_crs_other_than_authority_and_code_is_one_message(unfinished, name):
    planted = plant(unfinished)
    edit_config(unfinished, lambda config: config["scene"].update(crs=hostile_texts(planted)[name]))
    with planted.fires() as fired:
        output = one_message(*run([BIN / "apertura", "check", "."], unfinished))
    assert fired == []
    assert "scene" in output


@pytest.mark.slow
@pytest.mark.parametrize("linked", ["chunk", "config", "raw", "log", "results", "records"])
def test_link_out_of_the_folder_is_refused_and_its_target_not_opened(finished, tmp_path, linked):
    planted = plant(finished)
    path = {
        "config": finished / "config" / "config.yaml",
        "raw": finished / "raw" / "f01",
        "log": next((finished / "raw" / "f01").glob("uav1.track.*")),
        "results": finished / "results" / "f01",
        "records": finished / ".snakemake",
        "chunk": finished / "results/f01/uav1-uav1/image.zarr/image/c/0/0",
    }[linked]
    shutil.move(path, planted.outside / "moved")
    path.symlink_to(planted.outside / "moved")
    with planted.fires() as fired:
        for words in (["check", "."], ["run", ".", "-n"], ["step", "image", "f01", "uav1-uav1"]):
            status, output = run([BIN / "apertura", *words], finished)
            assert "Traceback" not in output
            assert status == 2 or "step" in words, output
    assert fired == []


@pytest.mark.slow
@pytest.mark.parametrize("start_from", ["apertura, in the campaign", "snakemake, from the sources"])
@pytest.mark.parametrize(
    "line",
    [
        "__use_yte__: true\n__definitions__:\n  - {code!r}\n",
        "x: !!python/object/apply:os.system ['{shell}']\n",
        "?__import__('os').system('{shell}'): 1\n",
    ],
    ids=["yte", "python tag", "yte key"],
)
def test_code_in_the_config_is_refused(unfinished, start_from, line):
    planted = plant(unfinished)
    path = unfinished / "config" / "config.yaml"
    path.write_text(line.format(code=planted.code("config"), shell=planted.shell("config")) + path.read_text())
    command, folder = WORKFLOW_COMMANDS[start_from]
    names = {"bin": BIN, "root": ROOT, "campaign": unfinished, "part": ""}
    with planted.fires() as fired:
        status, output = run([*shlex.split(command.format(**names)), "-n"], folder.format(**names))
    assert fired == []
    assert status != 0
    assert "config/config.yaml" in output
    assert "Traceback" not in output


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["version 2", "codec"])
def test_stage_with_pickled_chunks_is_not_opened(finished, kind):
    """The forged stage has valid checksums; zarr version 2 stores objects as pickles, and codecs may execute code."""
    planted, folder = plant(finished), finished / "results/f01/uav1-uav1/image.zarr"
    chunk = pickle.dumps(Code(planted.code("pickle")))
    if kind == "codec":
        document = json.loads((folder / "image/zarr.json").read_text())
        document["codecs"] = [{"name": "numcodecs.pickle", "configuration": {}}]
        (folder / "image/zarr.json").write_text(json.dumps(document))
        (folder / "image/c/0/0").write_bytes(chunk + google_crc32c.value(chunk).to_bytes(4, "little"))
    else:
        shutil.rmtree(folder / "image")
        (folder / "zarr.json").unlink()
        layout = {"zarr_format": 2, "shape": [1], "chunks": [1], "dtype": "|O", "fill_value": None, "order": "C"}
        layout |= {"compressor": None, "filters": [{"id": "pickle", "protocol": 5}]}
        for name, document in ((".zgroup", {"zarr_format": 2}), ("image/.zarray", layout)):
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(with_checksum(json.dumps(document)))
        (folder / "image/0").write_bytes(chunk + google_crc32c.value(chunk).to_bytes(4, "little"))
    with planted.fires() as fired, pytest.raises((CampaignError, FileNotFoundError, KeyError)):
        array_of(folder, "image", "r")[...]
    assert fired == []


def with_checksum(text):
    """Return a JSON document that ends with its own CRC-32C: white space makes the checksum four blanks.

    CRC-32C is linear: a tab in place of a blank changes the checksum by a fixed pattern; Gaussian elimination selects
    the tabs.
    """
    blanks, whole = 64, int.from_bytes(b"    ", "little")
    plain = text.encode() + b" " * blanks
    tabbed = [plain[: len(text) + at] + b"\t" + plain[len(text) + at + 1 :] for at in range(blanks)]
    left, rows = google_crc32c.value(plain) ^ whole, []
    for at, one in enumerate(tabbed):
        pattern, chosen = google_crc32c.value(one) ^ google_crc32c.value(plain), 1 << at
        for known, of_known in rows:
            if pattern ^ known < pattern:
                pattern, chosen = pattern ^ known, chosen ^ of_known
        if pattern:
            rows = sorted([*rows, (pattern, chosen)], reverse=True)
    tabs = 0
    for known, of_known in rows:
        if left ^ known < left:
            left, tabs = left ^ known, tabs ^ of_known
    assert left == 0
    document = bytearray(plain)
    for at in range(blanks):
        if tabs >> at & 1:
            document[len(text) + at] = ord("\t")
    assert google_crc32c.value(bytes(document)) == whole
    return document.decode() + "    "


HARMLESS = {
    "COLUMNS": ["x", "-1"],
    "DASK_SCHEDULER": ["nosuch"],
    "DASK_SCHEDULER_ADDRESS": ["tcp://127.0.0.1:9"],
    "GDAL_DATA": ["/nowhere"],
    "HOME": ["/proc/nowhere"],
    "LC_ALL": ["C", "nosuch"],
    "MPLBACKEND": ["nosuch"],
    "MPLCONFIGDIR": ["/proc/nowhere"],
    "OMP_NUM_THREADS": ["x"],
    "PATH": ["", "/nowhere"],
    "PYTHONIOENCODING": ["ascii", "latin-1:strict"],
    "TMPDIR": ["/nowhere"],
    "TZ": ["nosuch/zone"],
    "ZARR_ARRAY__ORDER": ["F", "Q"],
}
"""Environment variables → values that do not affect a step; all are set at once."""

REFUSED = {
    "step pictures f01 uav1-uav2": {
        "APERTURA_ISA": ["z80"],
        "APERTURA_KERNEL": ["/etc/passwd", "/nowhere/_backprojection.so", "_backprojection.so"],
        "PROJ_DATA": ["/nowhere"],
    },
    "run . -n": {"PATH": ["", "/nowhere"], "SNAKEMAKE_PROFILE": ["nosuch"]},
    "plan .": {"APERTURA_KERNEL": ["_backprojection.so"]},
}
"""Command → environment variables that the command needs → values that the command refuses."""


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("words", ["step pictures f01 uav1-uav2", "run . -n", "plan ."])
def test_irrelevant_environment_variables_have_no_effect(finished, words, number):
    names = HARMLESS if words.startswith("step") else HARMLESS.keys() - {"PATH"}
    status, output = run([BIN / "apertura", *words.split()], finished, **{n: HARMLESS[n][-number] for n in names})
    assert status == 0, output
    assert "Traceback" not in output


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "name", "value"),
    [(words, name, value) for words, of in REFUSED.items() for name, values in of.items() for value in values],
)
def test_invalid_environment_variable_is_one_message(finished, name, value, words):
    status, output = run([BIN / "apertura", *words.split()], finished, **{name: value})
    assert status == 2, output
    assert "Traceback" not in output
    assert len(output.strip().splitlines()) < 6, output
    assert name != "APERTURA_KERNEL" or name in output


@pytest.mark.slow
def test_zarr_environment_variable_does_not_change_stages(unfinished, tmp_path):
    other = copy_writable(unfinished, tmp_path / "other")
    for root, order in ((unfinished, "C"), (other, "F")):
        for words in ("step ingest f01 uav1", "step ingest f01 uav2", "step echo f01 uav1-uav2"):
            status, output = run([BIN / "apertura", *words.split()], root, ZARR_ARRAY__ORDER=order)
            assert status == 0, output
    files = sorted(path.relative_to(other) for path in (other / "results").rglob("*.zarr/**/*") if path.is_file())
    assert len(files) > 20
    assert [name for name in files if (other / name).read_bytes() != (unfinished / name).read_bytes()] == []


def test_deleted_working_folder_is_one_message(tmp_path):
    folder = tmp_path / "gone"
    folder.mkdir()
    process = subprocess.run(
        ["sh", "-c", f"rmdir {folder}; exec {BIN}/apertura check x"],
        cwd=folder,
        text=True,
        capture_output=True,
        check=False,
    )
    assert (process.returncode, process.stderr) == (
        2,
        "error: the working directory: No such file or directory. Go to a folder that exists.\n",
    )
