"""Commands of the link harness, their campaigns, and a folder of the user outside the campaigns."""

import hashlib
import importlib
import json
import os
import shutil
import stat
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

# ---- Commands -------------------------------------------------------------------------------------------------------

SAMPLE, PAIR, BENCH = "sample", "pair", "bench"
"""Campaigns: one with every step; one with two flights, an interferogram, a stack and a reflector; and one with a bench
recording.
"""


@dataclass(frozen=True)
class Command:
    """A command line and its campaign.

    Attributes
    ----------
    words
        Arguments of `apertura`, in the campaign folder.
    campaign
        Name of the campaign.
    finished
        True if the campaign has results.
    is_cold
        True if a new interpreter runs the command instead of a fork that has imported the package.
    writes
        Paths among the inputs that the command may create or change.
    """

    words: str
    campaign: str = SAMPLE
    finished: bool = True
    is_cold: bool = False
    writes: tuple[str, ...] = ()


_STEPS = (
    *("assess f01", "calibrate c01", "chart f01 uav1-uav1 --seconds 1", "coverage", "cphd f01 uav1-uav2", "cube"),
    *("echo f01 uav1-uav2", "export f01 fused", "image f01 uav1-uav2", "ingest f01 uav1", "layers f01 uav1-uav2"),
    *("map", "mosaic", "pictures f01 uav1-uav2", "pictures-fused f01", "profile f01 uav1-uav2", "refine f01"),
    *("ro-crate", "scene", "stac", "terrain", "tiles f01 uav1-uav2 1-of-2", "tracks f01", "transfer f01 uav1-uav2"),
)
COMMANDS: dict[str, Command] = {
    "list": Command("list ."),
    "status": Command("status ."),
    "summary": Command("summary ."),
    "check": Command("check ."),
    "check --products": Command("check . --products"),
    "check --paranoid": Command("check . --paranoid"),
    "plan": Command("plan ."),
    "verify": Command("verify ."),
    "verify --crate": Command("verify . --crate"),
    "diff": Command("diff results/f01/uav1-uav1/db.tif results/f01/uav1-uav2/db.tif"),
    "inspect": Command("inspect . --plot plot.png"),
    "score": Command("score ."),
    "compare": Command("compare plan.yaml ."),
    "design": Command("design plan.yaml design"),
    "init": Command("init new"),
    "preview": Command("preview ."),
    "preview --follow": Command("preview . --follow --every 1 --end-after 1 --no-run"),
    "map": Command("map ."),
    "clean": Command("clean . --yes"),
    "clean --wip": Command("clean . --yes --wip"),
    "run": Command("run . --cores 2", finished=False, is_cold=True),
    "run, finished": Command("run . --cores 2", is_cold=True),
    "run --until": Command("run . --cores 2 --until scene", finished=False, is_cold=True),
    "run -n": Command("run . -n", is_cold=True),
    "report": Command("report .", is_cold=True),
    "chart": Command("chart .", is_cold=True),
    "reproduce": Command("reproduce results/f01/uav1-uav1/db.tif", is_cold=True),
    **{f"step {words.split()[0]}": Command(f"step {words}") for words in _STEPS},
    "step interferogram": Command("step interferogram two", PAIR),
    "step stack-image": Command("step stack-image f02", PAIR),
    "step stack": Command("step stack", PAIR),
    "step change": Command("step change f02", PAIR),
    "export stack": Command("export stack .", PAIR),
    "publish": Command("publish . memory://bucket"),
    "reflectors": Command("reflectors .", PAIR),
    "align": Command("align . f01 uav1 --point {point} --search-s 0.05 --write", PAIR, writes=("config/clocks.tsv",)),
    "bench": Command("bench .", BENCH, finished=False),
    "bench --write": Command("bench . --write", BENCH, writes=("config/config.yaml",)),
    "step bench": Command("step bench b01", BENCH),
    "step whole-chart": Command("step whole-chart --repeats 1"),
}
"""Commands by name. `whole-chart` takes a minute and runs only if it is given by name."""

SETTLED_S = 2.2
"""Minimum age of a file, in seconds, for its hash to be cached."""

INPUTS = ("config", "raw", "dem.tif", "truth.json", "plan.yaml")

# ---- Campaigns and the folder of the user ---------------------------------------------------------------------------


def program() -> str:
    """Return the program `apertura` next to this interpreter."""
    return str(Path(sys.executable).parent / "apertura")


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of commands: folder for temporary files, and message lines without line breaks."""
    own = {"TMPDIR": str(folder / "tmp"), "COLUMNS": "1000", "TERM": "dumb", "OPENBLAS_NUM_THREADS": "1"}
    return {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", **own}


def make_campaign(folder: Path, name: str) -> None:
    """Write a campaign ``<name>`` with its inputs only, and a copy ``<name>-finished`` with results."""
    from apertura.simulation import ImageGrid, Straight, preset, simulate

    root = folder / name
    if name == SAMPLE:
        simulated = importlib.import_module(f"{__package__}.faults_campaign").make_campaign(folder / "make")
        (simulated / "plan.yaml").write_text(json.dumps(_plan(simulated)))
        simulated.rename(root)
    elif name == PAIR:
        demo = replace(preset("demo", pulses=40), scene=ImageGrid("EPSG:32632", 1.6, spacing_m=0.05))
        first = demo.flights[0]
        lines = {node: track for node, track in first.tracks.items() if isinstance(track, Straight)}
        raised = {node: replace(at, start_m=(*at.start_m[:2], at.start_m[2] + 0.3)) for node, at in lines.items()}
        second = replace(first, name="f02", tracks=raised, start_utc="2025-05-14T11:00:00")
        simulate(root, replace(demo, flights=(first, second)))
        ball = {"name": "ball", "kind": "sphere", "size_m": [0.5], "position_m": first_target(root), "std_m": 0.02}
        _edit(root, "scene", reflectors=[ball])
        _edit(root, "interferometry", pairs={"two": ["f01/uav1-uav1", "f02/uav1-uav1"]})
        _edit(root, "stack", reference="f01", flights=["f02"], pair="uav1-uav1")
    else:
        lab = preset("paper-lab", pulses=60)
        simulate(root, replace(lab, flights=(replace(lab.flights[0], name="b01", kind="bench"),)))
        _edit(root, "bench", sidelink_m=1.0)  # The measured path then differs, so that `--write` changes the config.
    finished = copy(root, folder / f"{name}-finished")
    words = [program(), "run", str(finished), "--cores", "2", "--quiet"]
    subprocess.run(words, check=name != BENCH, capture_output=True, env=environment(folder))


def _plan(root: Path) -> dict[str, Any]:
    """Return a flight plan for the radar and the scene of a campaign."""
    import yaml

    config = yaml.safe_load((root / "config" / "config.yaml").read_text())
    west, south, east, _ = config["scene"]["bounds_m"]
    line = {"kind": "line", "start_m": [west, south - 30], "end_m": [east, south - 30], "height_m": 30, "speed_m_s": 1}
    flight = {"transmitter": "uav1", "receivers": ["uav1"], "tracks": {"uav1": line}}
    waveform = {name: value for name, value in config["waveform"].items() if name != "codes"}
    scene = {name: value for name, value in config["scene"].items() if not name.startswith("dem")}
    nodes = {"uav1": {"attitude": "log"}}
    return {"campaign": "plan", "waveform": waveform, "nodes": nodes, "scene": scene, "flights": {"f01": flight}}


def _edit(root: Path, section: str, **keys: Any) -> None:
    import yaml

    path = root / "config" / "config.yaml"
    document = yaml.safe_load(path.read_text())
    document.setdefault(section, {}).update(keys)
    path.write_text(yaml.safe_dump(document))


def first_target(root: Path) -> list[float]:
    target = json.loads((root / "truth.json").read_text())["targets"][0]
    return [target[key] for key in ("x", "y", "height_m")]


def copy(source: Path, target: Path) -> Path:
    """Copy a folder with its times and without hard links; return the copy."""
    subprocess.run(["cp", "-a", "--reflink=auto", "--", source, target], check=True)
    return target


NAMES = ("notes.txt", "run.log", "scene.json", "status.json", "image.manifest.json", "db.tif", "db.0.tif", "a.tsv")
FOLDERS = ("", "f01", "f01/uav1-uav1", "f01/uav1", "raw", "raw/f01", "steps", "map", "image.zarr/image/c")


def make_user_folder(folder: Path) -> Path:
    """Write D: files and subfolders with the names of campaign results."""
    shutil.rmtree(folder, ignore_errors=True)
    for name in FOLDERS:
        (folder / name).mkdir(parents=True, exist_ok=True)
        for file in NAMES:
            (folder / name / file).write_text(f"{file} of the user\n")
    return folder


def fingerprint(*paths: Path) -> dict[str, tuple[object, ...]]:
    """Return type, mode, inode, size, time and content of all files and folders."""
    entries: dict[str, tuple[object, ...]] = {}
    for top in paths:
        below = [Path(folder, name) for folder, *names in os.walk(top) for name in (*names[0], *names[1])]
        for path in (top, *below) if os.path.lexists(top) else ():
            status = path.lstat()
            is_file = stat.S_ISREG(status.st_mode)
            content = hashlib.sha256(path.read_bytes()).hexdigest() if is_file else ""
            entries[str(path)] = (status.st_mode, status.st_ino, status.st_size, status.st_mtime_ns, content)
    return entries


def differences(before: dict[str, tuple[object, ...]], after: dict[str, tuple[object, ...]], top: Path) -> str:
    """Return the differences between two fingerprints as one line, empty if there are none."""
    sets = {
        "missing": before.keys() - after.keys(),
        "new": after.keys() - before.keys(),
        "changed": {name for name in before.keys() & after.keys() if before[name] != after[name]},
    }
    parts = [
        f"{len(names)} {state} ({', '.join(os.path.relpath(name, top) for name in sorted(names)[:3])})"
        for state, names in sets.items()
        if names
    ]
    return "; ".join(parts)
