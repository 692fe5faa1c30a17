"""docs/howto/your_own_recording.md: its code runs on plain files of a simulated flight and images the target."""

import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

from apertura.formats.reading import open_recording, read_track
from apertura.simulation import ImageGrid, preset, simulate

HOWTO = Path(__file__).parents[1] / "docs/howto/your_own_recording.md"


def plain_files(folder):
    """Write the input files of the how-to and return the position of the brightest target."""
    plan = replace(preset("demo", pulses=60), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    simulated = simulate(folder / "simulated", plan, seed=7)
    for node in ("uav1", "uav2"):
        stem = simulated / "raw/f01" / node
        (stem.with_suffix(".sigmf-data")).rename(folder / f"{node}.iq")
        tags = [
            capture["core:datetime"][:-1]
            for capture in json.loads(stem.with_suffix(".sigmf-meta").read_text())["captures"]
        ]
        (folder / f"{node}_tags.txt").write_text("\n".join(tags) + "\n")
    shutil.copy(simulated / "raw/f01/uav2.track.pos", folder / "uav2_solution.pos")
    shutil.copy(simulated / "raw/codes.npy", folder / "codes.npy")
    rows = [line.split(",") for line in (simulated / "raw/f01/uav1.track.csv").read_text().splitlines()[1:]]
    seconds = (
        np.array([row[0][:-1] for row in rows], "datetime64[us]") - np.datetime64("2025-05-14T09:30")
    ) / np.timedelta64(1, "s")
    lines = [f"{second:.6f} {' '.join(row[1:])}" for second, row in zip(seconds, rows, strict=True)]
    (folder / "uav1_log.txt").write_text("\n".join(lines) + "\n")
    target = json.loads((simulated / "truth.json").read_text())["targets"][0]
    shutil.rmtree(simulated)
    return target


def run_commands(block):
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for line in block.splitlines():
        command = line.removeprefix("$ ").split()
        done = subprocess.run(command, env={**os.environ, "PATH": path}, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_code_blocks_of_the_how_to_run_and_image_the_target(tmp_path, monkeypatch):
    target = plain_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    names, text = {}, HOWTO.read_text(encoding="utf-8")
    script = re.search(r"^```python\n(.*?)^```\n", text, re.M | re.S)[1]
    assert sum(bool(line.strip()) for line in script.splitlines()) <= 25
    for block in re.finditer(r"^```(python|console)\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", text, re.M | re.S):
        printed = StringIO()
        if block[1] == "console":
            run_commands(block[2])
            continue
        with redirect_stdout(printed):
            exec(compile("\n" * text.count("\n", 0, block.start()) + block[2], str(HOWTO), "exec"), names)
        assert printed.getvalue() == (block[3] or "")
    assert np.hypot(float(names["peak"].x) - target["x"], float(names["peak"].y) - target["y"]) < 0.1


def test_written_campaign_equals_the_recorded_files(tmp_path, monkeypatch):
    """Samples and time tags are exactly equal, attitude to 1e-4°."""
    plain_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    names, text = {}, HOWTO.read_text(encoding="utf-8")
    exec(re.search(r"^```python\n(.*?)^```\n", text, re.M | re.S)[1], names)
    raw = tmp_path / "my_campaign/raw/f01"
    opened = open_recording((raw / "uav2.sigmf-meta", raw / "uav2.sigmf-data"))
    recorded = np.fromfile("uav2.iq", "<i2").reshape(-1, 2, 2)
    np.testing.assert_array_equal(opened.samples.read(0, len(opened.samples)), recorded)
    np.testing.assert_array_equal(opened.captures.time, names["tags"]["uav2"])
    assert opened.channels == ["radar", "sidelink"]
    assert (raw / "uav2.track.pos").read_bytes() == (tmp_path / "uav2_solution.pos").read_bytes()
    track = read_track(raw / "uav1.track.csv", node="uav1")
    np.testing.assert_array_equal(track.time.values, names["log_utc"])
    np.testing.assert_allclose(np.degrees(track.attitude.values), names["log"][:, 4:], atol=1e-4)
