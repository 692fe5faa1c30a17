"""Overhead of the workflow for campaigns of 10 to 1000 flights, before the first step and with complete results.

    python benchmarks/scale.py [FOLDER] [FLIGHTS ...]

For each number of FLIGHTS (default: 10, 100, 1000), FOLDER (default: temporary) receives a campaign folder: two nodes
with 24 pulses, with the same files in every flight (hard links). Each line is a command on that folder, with its
wall-clock and CPU seconds and the peak resident memory of its largest process. The commands run first without results,
then with all results, as placeholders with valid manifests.
"""

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

BIN = Path(sys.executable).parent
FLIGHTS = (10, 100, 1000)
BATCH = 10


def campaign_of(root, flights):
    """Simulate one flight and link its files under the names of all flights."""
    from apertura.simulation import ImageGrid, preset, simulate

    if (root / "config").is_dir():
        return root
    scene = ImageGrid("EPSG:32632", half_width_m=1.2, spacing_m=0.05)
    simulate(root, replace(preset("demo", pulses=24), scene=scene), seed=3)
    names = [f"f{number:05d}" for number in range(1, flights + 1)]
    for name in names:
        (root / "raw" / name).mkdir()
        for file in (root / "raw" / "f01").iterdir():
            os.link(file, root / "raw" / name / file.name)
    table = root / "config" / "flights.tsv"
    head, line, *_ = table.read_text(encoding="utf-8").splitlines()
    table.write_text("\n".join([head, *(line.replace("f01", name, 1) for name in names)]) + "\n", encoding="utf-8")
    return root


def finish(root):
    """Write a placeholder for every result, with the manifest that its step writes."""
    from apertura.campaign.digests import Sources
    from apertura.campaign.folder import Campaign
    from apertura.campaign.store import record_files
    from apertura.common.atomic import write_json
    from apertura.common.provenance import code_sha256
    from apertura.formats.export import exports_in
    from apertura.workflow.lineage import results_of

    companions = {
        "scene": ["scene.json"],
        "assessment": ["assessment.json"],
        "calibration": ["calibration.json"],
        **{kind: [one.file for one in exports_in(kind)] for kind in ("fused", "layers")},
        "export": [one.file for one in exports_in("pair")],
    }
    for name in ("export", "fused"):
        companions[name].append("image.json")
    campaign, code = Campaign.load(root), cache(code_sha256)

    class PlaceholderRecord:
        def __init__(self, result):
            sources, code_digest = Sources.of(root, result.sources).digests, code(*result.modules)
            self.record = lambda: {"sources": sources, "settings": result.settings_sha256, "code": code_digest}

    for name, result in results_of(campaign):
        if "study" in result.manifest:
            continue
        manifest = root / result.manifest
        manifest.parent.mkdir(parents=True, exist_ok=True)
        files = [manifest.parent / file for file in companions.get(name, [])]
        for file in files:
            write_json(file, {"placeholder of": file.name})
        record_files(manifest, files, PlaceholderRecord(result))


def measured(name, *command, cwd):
    """Run a command, print its time and memory, and return its output."""
    start_s = time.perf_counter()
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(list(map(str, command)), cwd=cwd, stdout=output, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start_s
        output.seek(0)
        text = output.read()
    cpu = usage.ru_utime + usage.ru_stime
    print(f"{name:<44}{wall:>9.1f}{cpu:>9.1f}{usage.ru_maxrss / 1024:>9.0f}", flush=True)
    if status:
        sys.exit(text)
    return text


def measure(root, flights):
    apertura = BIN / "apertura"
    snakemake = (BIN / "snakemake", "--directory", root, "--cores", "2", "-n", "--quiet", "rules")
    home = Path(__file__).parents[1]
    print(f"\n{flights} flights{'wall s':>37}{'CPU s':>9}{'MiB':>9}")
    measured("apertura check, no results", apertura, "check", root, cwd=home)
    measured("snakemake -n", *snakemake, cwd=home)
    batch = f"all=1/{BATCH}"
    measured(f"snakemake -n --batch {batch}", *snakemake, "--batch", batch, cwd=home)
    measured("apertura run -n, no results", apertura, "run", root, "-n", "-q", cwd=home)
    measured("(placeholders for all results)", sys.executable, __file__, "--finish", root, cwd=home)
    measured("apertura check, all results", apertura, "check", root, cwd=home)
    measured("apertura run -n, all results", apertura, "run", root, "-n", "-q", cwd=home)


def main():
    if sys.argv[1:2] == ["--finish"]:
        finish(Path(sys.argv[2]))
        return
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(sys.argv[1] if sys.argv[1:] else scratch)
        for flights in map(int, sys.argv[2:] or FLIGHTS):
            measure(campaign_of(folder / f"flights-{flights}", flights), flights)


if __name__ == "__main__":
    main()
