"""Preview of a growing campaign: delay behind the recording, CPU share, files that remain.

``python benchmarks/preview.py WORK --seconds 60`` simulates a flight at 500 Hz into WORK/flown if it is not there yet
(one transmitter, one receiver, 5 m/s; 27 kB per pulse), then copies its recordings and logs at their own rate into
WORK/replayed, cut wherever a write may end, while ``apertura preview --follow`` runs there; then runs the workflow on a
copy of these, without look, and compares what the two runs leave, file by file. ``--campaign DIR`` replays another
campaign, ``--rate`` times as fast.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from apertura.campaign.folder import Campaign
from apertura.formats.reading import open_recording
from apertura.simulation import preset, simulate

PRF_HZ = 500
_STEP_S = 0.1  # between two writes
_OWN = ("preview", "logs", "benchmarks", ".hashes", ".run")
"""Folders of the results that tell of a run: times, machine."""


def main() -> None:
    """Run what the command line asks for."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("work", type=Path)
    asked.add_argument("--seconds", type=float, default=60)
    asked.add_argument("--half-width", type=float, default=25.6, help="of the scene, m; pixels are 10 cm")
    asked.add_argument("--campaign", type=Path, help="a campaign to replay instead")
    asked.add_argument("--rate", type=float, default=1.0, help="times as fast as it was recorded")
    asked.add_argument("--every", type=float, default=5.0, help="s between pictures")
    asked.add_argument("--cores", type=int, default=1)
    asked.add_argument("--no-run", action="store_true", help="look alone: no workflow, nothing compared")
    given = asked.parse_args()
    flown = given.campaign or given.work / f"flown_{given.seconds:g}s_{given.half_width:g}m"
    if not flown.exists():
        simulate(flown, flight(given.seconds, given.half_width))
    replayed = given.work / "replayed"
    shutil.rmtree(replayed, ignore_errors=True)
    begin(flown, replayed)
    words = ["preview", str(replayed), "--follow", "--every", str(given.every), "--cores", str(given.cores)]
    looking = subprocess.Popen(
        [*APERTURA, *words, *(["--no-run"] if given.no_run else [])], stdout=subprocess.PIPE, text=True
    )
    said: list[str] = []
    reader = threading.Thread(target=_read, args=(looking, said))
    reader.start()
    time.sleep(5.0)  # what it imports before a flight is no part of it
    before, began = cpu_s(looking.pid), time.monotonic()
    replay(flown, replayed, given.rate)
    spent, lasted = cpu_s(looking.pid) - before, time.monotonic() - began
    looking.wait()
    reader.join()
    report(said, spent / lasted, lasted)
    if not given.no_run:
        other = run_without_look(replayed, given.work / "without_look", cores=given.cores)
        compare(other / "results", replayed / "results")


def run_without_look(root: Path, other: Path, *, cores: int) -> Path:
    """Run the workflow on a copy of a campaign's own files, of the same dates; return that."""
    shutil.rmtree(other, ignore_errors=True)
    for name in ("config", "raw"):
        shutil.copytree(root / name, other / name)
    subprocess.run([*APERTURA, "run", str(other), "-q", "--cores", str(cores)], check=True)
    return other


APERTURA = [sys.executable, "-P", "-m", "apertura"]


def flight(seconds: float, half_width_m: float):
    """Return the preset `flight` with one receiver, so long, and targets inside a smaller scene."""
    whole = preset("flight", pulses=round(seconds * PRF_HZ))
    (flown,) = whole.flights
    nodes = {name: whole.nodes[name] for name in ("uav1", "uav2")}
    tracks = {name: flown.tracks[name] for name in nodes}
    part = half_width_m / 204.8
    targets = tuple(
        replace(one, position_m=(one.position_m[0] * part, one.position_m[1] * part, 0.0)) for one in whole.targets
    )
    scene = replace(whole.scene, half_width_m=half_width_m)
    return replace(
        whole, nodes=nodes, targets=targets, flights=(replace(flown, tracks=tracks),), scene=scene, campaign="preview"
    )


def begin(flown: Path, replayed: Path) -> None:
    """Copy what is there before a flight: the config and what is transmitted."""
    shutil.copytree(flown / "config", replayed / "config")
    (replayed / "raw").mkdir()
    for path in (flown / "raw").iterdir():
        if path.is_file():
            shutil.copy2(path, replayed / "raw" / path.name)


def replay(flown: Path, replayed: Path, rate: float = 1.0) -> None:
    """Write recordings and logs as a recorder would: what was known at each time, whole or not."""
    campaign = Campaign.load(flown)
    writers = []
    for one in campaign.image_flights:
        (replayed / "raw" / one.name).mkdir(parents=True, exist_ok=True)
        for node in one.participants:
            writers.append(RecordingWriter(campaign, one.name, node, replayed))
            writers.append(LogWriter(campaign, one.name, node, replayed))
    first = min(writer.times[0] for writer in writers if isinstance(writer, RecordingWriter))
    last = max(writer.times[-1] for writer in writers if isinstance(writer, RecordingWriter))
    began = time.monotonic()
    while True:
        now = first + np.timedelta64(round((time.monotonic() - began) * rate * 1e9), "ns")
        for writer in writers:
            writer.write(now)
        if now > last:
            break
        time.sleep(_STEP_S)
    for writer in writers:
        writer.end()


class RecordingWriter:
    """Metadata as a stream that is not closed, and samples that end within a pulse."""

    def __init__(self, campaign: Campaign, flight: str, node: str, replayed: Path) -> None:
        self.meta, self.data = campaign.recording_files(flight, node)
        self.to = replayed / "raw" / flight
        recording = open_recording((self.meta, self.data))
        self.times, self.start = recording.captures.time, recording.captures.start
        self.bytes = recording.samples.sample_bytes * recording.captures.length
        self.document = json.loads(self.meta.read_text(encoding="utf-8"))
        self.source, self.written, self.told = self.data.open("rb"), 0, 0
        known = {name: value for name, value in self.document["global"].items() if name != "core:sha512"}
        self._meta("w", json.dumps({"global": known})[:-1] + ', "captures": [')

    def _meta(self, mode: str, text: str) -> None:
        with (self.to / self.meta.name).open(mode, encoding="utf-8") as stream:
            stream.write(text)

    def write(self, now: np.datetime64) -> None:
        """Write the pulses recorded by `now`; the last one may be half there."""
        pulses = int(np.searchsorted(self.times, now, "right"))
        captures = [json.dumps(one) for one in self.document["captures"][self.told : pulses]]
        if captures:
            self._meta("a", ("" if self.told == 0 else ", ") + ", ".join(captures))
            self.told = pulses
            upto = int(self.start[pulses - 1] / self.start[1] * self.bytes) + self.bytes // 2 + 1
            with (self.to / self.data.name).open("ab") as stream:
                stream.write(self.source.read(upto - self.written))
            self.written = upto

    def end(self) -> None:
        """Write what is left, and the metadata as they were."""
        with (self.to / self.data.name).open("ab") as stream:
            shutil.copyfileobj(self.source, stream)
        beside = self.to / f".{self.meta.name}"
        shutil.copy2(str(self.meta), beside)
        beside.replace(self.to / self.meta.name)


class LogWriter:
    """Lines of a log, by shares of its bytes: each line ends wherever it may."""

    def __init__(self, campaign: Campaign, flight: str, node: str, replayed: Path) -> None:
        path = campaign.track_file(flight, node)
        self.to, self.content, self.written = replayed / "raw" / flight / path.name, path.read_bytes(), 0
        from apertura.stages.node_log import read_log

        epochs = read_log(campaign, flight, node).time.values
        self.first, self.last = epochs[0], epochs[-1]

    def write(self, now: np.datetime64) -> None:
        """Write the epochs logged by `now`."""
        share = float((now - self.first) / (self.last - self.first))
        upto = min(len(self.content), max(0, int(share * len(self.content))))
        with self.to.open("ab") as stream:
            stream.write(self.content[self.written : upto])
        self.written = max(self.written, upto)

    def end(self) -> None:
        """Write the rest."""
        with self.to.open("ab") as stream:
            stream.write(self.content[self.written :])
        self.written = len(self.content)


def cpu_s(process: int) -> float:
    """Return the CPU seconds of a process so far, its threads included."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _read(looking: subprocess.Popen, said: list[str]) -> None:
    for line in looking.stdout:
        print(line, end="", flush=True)
        said.append(line)


def report(said: list[str], share: float, lasted_s: float) -> None:
    """Print delay, share of a core and images shown while it was recorded."""
    delays = [float(found[1]) for line in said if (found := re.search(r"([\d.]+) s behind", line))]
    print(
        f"recorded for {lasted_s:.0f} s; {share:.2f} of one core; {len(delays)} images; load {os.getloadavg()[0]:.1f}"
    )
    if delays:
        print(f"behind the recording: median {statistics.median(delays):.1f} s, most {max(delays):.1f} s")


def compare(first: Path, second: Path) -> None:
    """Print which files of two runs differ."""
    hashes = [hashes_of(folder) for folder in (first, second)]
    names = sorted(set(hashes[0]) | set(hashes[1]))
    other = [name for name in names if hashes[0].get(name) != hashes[1].get(name)]
    print(f"{len(names) - len(other)} of {len(names)} files of the runs are the same, byte for byte")
    print(*other[:10], *(["…"] if len(other) > 10 else []), sep="\n")


def hashes_of(results: Path) -> dict[str, str]:
    """Return file → sha256 of what a run leaves, but what tells of the run itself."""
    found = {path.relative_to(results): path for path in results.rglob("*") if path.is_file()}
    return {
        name.as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in found.items()
        if name.parts[0] not in _OWN and not name.name.startswith(".")
    }


if __name__ == "__main__":
    main()
