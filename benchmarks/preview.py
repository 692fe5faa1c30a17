"""Live imaging during a flight: delay relative to the recording, CPU load, and equality of the results.

``python benchmarks/preview.py WORK --seconds 60`` simulates a flight at 500 Hz into WORK/flown unless it exists (one
transmitter, one receiver, 5 m/s; 27 kB per pulse), then copies its recordings and logs in real time into WORK/replayed,
with writes that end at arbitrary bytes, while ``apertura preview --follow`` runs on this folder; then it runs the
workflow on a copy without preview, and compares the results of both runs file by file. ``--campaign DIR`` replays
another campaign, at ``--rate`` times its original rate.
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
"""Folders of the results that depend on the run, such as times and machine."""


def main() -> None:
    """Replay the requested flight and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--half-width", type=float, default=25.6, help="half width of the scene, m; pixels are 10 cm")
    parser.add_argument("--campaign", type=Path, help="campaign to replay instead of a simulated one")
    parser.add_argument("--rate", type=float, default=1.0, help="speed of the replay relative to the recording")
    parser.add_argument("--every", type=float, default=5.0, help="interval between images, s")
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--no-run", action="store_true", help="run the preview only, without workflow and comparison")
    options = parser.parse_args()
    flown = options.campaign or options.work / f"flown_{options.seconds:g}s_{options.half_width:g}m"
    if not flown.exists():
        simulate(flown, flight(options.seconds, options.half_width))
    replayed = options.work / "replayed"
    shutil.rmtree(replayed, ignore_errors=True)
    begin(flown, replayed)
    arguments = ["preview", str(replayed), "--follow", "--every", str(options.every), "--cores", str(options.cores)]
    looking = subprocess.Popen(
        [*APERTURA, *arguments, *(["--no-run"] if options.no_run else [])], stdout=subprocess.PIPE, text=True
    )
    lines: list[str] = []
    reader = threading.Thread(target=_read, args=(looking, lines))
    reader.start()
    time.sleep(5.0)  # excludes the time of imports, which happen before a flight
    cpu_before_s, start_s = cpu_s(looking.pid), time.monotonic()
    replay(flown, replayed, options.rate)
    spent, lasted = cpu_s(looking.pid) - cpu_before_s, time.monotonic() - start_s
    looking.wait()
    reader.join()
    report(lines, spent / lasted, lasted)
    if not options.no_run:
        other = run_without_look(replayed, options.work / "without_look", cores=options.cores)
        compare(other / "results", replayed / "results")


def run_without_look(root: Path, other: Path, *, cores: int) -> Path:
    """Run the workflow on a copy of a campaign's input files with the same dates; return the copy's folder."""
    shutil.rmtree(other, ignore_errors=True)
    for name in ("config", "raw"):
        shutil.copytree(root / name, other / name)
    subprocess.run([*APERTURA, "run", str(other), "-q", "--cores", str(cores)], check=True)
    return other


APERTURA = [sys.executable, "-P", "-m", "apertura"]


def flight(seconds: float, half_width_m: float):
    """Return the preset `flight` with one receiver, a given duration, and targets within a smaller scene."""
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
    """Copy the files that exist before a flight: the config and the transmitted waveform."""
    shutil.copytree(flown / "config", replayed / "config")
    (replayed / "raw").mkdir()
    for path in (flown / "raw").iterdir():
        if path.is_file():
            shutil.copy2(path, replayed / "raw" / path.name)


def replay(flown: Path, replayed: Path, rate: float = 1.0) -> None:
    """Write recordings and logs like a recorder: at each time, all data available by then, with incomplete ends."""
    campaign = Campaign.load(flown)
    writers = []
    for one in campaign.image_flights:
        (replayed / "raw" / one.name).mkdir(parents=True, exist_ok=True)
        for node in one.participants:
            writers.append(RecordingWriter(campaign, one.name, node, replayed))
            writers.append(LogWriter(campaign, one.name, node, replayed))
    first = min(writer.times[0] for writer in writers if isinstance(writer, RecordingWriter))
    last = max(writer.times[-1] for writer in writers if isinstance(writer, RecordingWriter))
    start_s = time.monotonic()
    while True:
        now = first + np.timedelta64(round((time.monotonic() - start_s) * rate * 1e9), "ns")
        for writer in writers:
            writer.write(now)
        if now > last:
            break
        time.sleep(_STEP_S)
    for writer in writers:
        writer.end()


class RecordingWriter:
    """Writer of a recording: metadata as an unterminated JSON stream, and samples that end within a pulse."""

    def __init__(self, campaign: Campaign, flight: str, node: str, replayed: Path) -> None:
        self.meta, self.data = campaign.recording_files(flight, node)
        self.to = replayed / "raw" / flight
        recording = open_recording((self.meta, self.data))
        self.times, self.start = recording.captures.time, recording.captures.start
        self.bytes = recording.samples.sample_bytes * recording.captures.length
        self.document = json.loads(self.meta.read_text(encoding="utf-8"))
        self.source, self.written, self.captures_written = self.data.open("rb"), 0, 0
        header = {name: value for name, value in self.document["global"].items() if name != "core:sha512"}
        self._meta("w", json.dumps({"global": header})[:-1] + ', "captures": [')

    def _meta(self, mode: str, text: str) -> None:
        with (self.to / self.meta.name).open(mode, encoding="utf-8") as stream:
            stream.write(text)

    def write(self, now: np.datetime64) -> None:
        """Write the pulses recorded by `now`; the last pulse may be incomplete."""
        pulses = int(np.searchsorted(self.times, now, "right"))
        captures = [json.dumps(one) for one in self.document["captures"][self.captures_written : pulses]]
        if captures:
            self._meta("a", ("" if self.captures_written == 0 else ", ") + ", ".join(captures))
            self.captures_written = pulses
            upto = int(self.start[pulses - 1] / self.start[1] * self.bytes) + self.bytes // 2 + 1
            with (self.to / self.data.name).open("ab") as stream:
                stream.write(self.source.read(upto - self.written))
            self.written = upto

    def end(self) -> None:
        """Write the remaining samples, and replace the metadata by the complete original file."""
        with (self.to / self.data.name).open("ab") as stream:
            shutil.copyfileobj(self.source, stream)
        temporary = self.to / f".{self.meta.name}"
        shutil.copy2(str(self.meta), temporary)
        temporary.replace(self.to / self.meta.name)


class LogWriter:
    """Writer of a log in proportion to its bytes: a write may end within a line."""

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
        """Write the remaining bytes."""
        with self.to.open("ab") as stream:
            stream.write(self.content[self.written :])
        self.written = len(self.content)


def cpu_s(process: int) -> float:
    """Return the CPU seconds used by a process with its threads."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _read(looking: subprocess.Popen, lines: list[str]) -> None:
    for line in looking.stdout:
        print(line, end="", flush=True)
        lines.append(line)


def report(lines: list[str], share: float, lasted_s: float) -> None:
    """Print the delay, the load as a fraction of one core, and the number of images during the recording."""
    delays = [float(match[1]) for line in lines if (match := re.search(r"([\d.]+) s behind", line))]
    print(
        f"recorded for {lasted_s:.0f} s; {share:.2f} of one core; {len(delays)} images; load {os.getloadavg()[0]:.1f}"
    )
    if delays:
        print(f"delay behind the recording: median {statistics.median(delays):.1f} s, maximum {max(delays):.1f} s")


def compare(first: Path, second: Path) -> None:
    """Print the files that differ between two runs."""
    hashes = [hashes_of(folder) for folder in (first, second)]
    names = sorted(set(hashes[0]) | set(hashes[1]))
    different = [name for name in names if hashes[0].get(name) != hashes[1].get(name)]
    print(f"{len(names) - len(different)} of {len(names)} files of the runs are identical")
    print(*different[:10], *(["…"] if len(different) > 10 else []), sep="\n")


def hashes_of(results: Path) -> dict[str, str]:
    """Return file → sha256 of the results of a run, without files that depend on the run."""
    files = {path.relative_to(results): path for path in results.rglob("*") if path.is_file()}
    return {
        name.as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in files.items()
        if name.parts[0] not in _OWN and not name.name.startswith(".")
    }


if __name__ == "__main__":
    main()
