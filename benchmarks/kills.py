"""Kill whole runs at random moments, resume each, and compare every product of the finished campaign.

    python benchmarks/kills.py CAMPAIGN [KILLS] [SEED]

A run's whole process group gets SIGKILL after a random share of the time that an undisturbed run takes; what resumes
it is killed too, until KILLS (16) are spent. Whenever a run gets through, its results are compared byte for byte with
the undisturbed ones, logs and timings left out, and the next begins from nothing. Ends with an error where they differ.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

APERTURA = Path(sys.executable).parent / "apertura"


def start(root):
    command = [APERTURA, "run", root, "--cores", "2"]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def finish(process):
    output = process.communicate()[0]
    if process.returncode:
        sys.exit(f"the run failed:\n{output}")


def products(root):
    """Return path → bytes of all results but logs and timings."""
    results = root / "results"
    files = (path for path in results.rglob("*") if path.is_file() and not path.is_relative_to(results / "logs"))
    return {path.relative_to(results): path.read_bytes() for path in files if path.suffix != ".tsv"}


def compare(root, expected):
    made = products(root)
    differ = sorted(str(path) for path in made.keys() | expected.keys() if made.get(path) != expected.get(path))
    if differ:
        sys.exit(f"{len(differ)} of {len(expected)} files differ: {', '.join(differ[:5])}")


def copy(campaign, root):
    shutil.copytree(campaign, root, ignore=shutil.ignore_patterns("results", ".snakemake"))
    return root


def main():
    campaign, kills, seed = Path(sys.argv[1]), *(int(word) for word in [*sys.argv[2:], "16", "1"][:2])
    moment = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        root = copy(campaign, Path(folder) / "campaign")
        began = time.perf_counter()
        finish(start(root))
        whole_s = time.perf_counter() - began
        expected = products(root)
        print(f"undisturbed: {len(expected)} files in {whole_s:.1f} s", flush=True)
        shutil.rmtree(root)
        spent = 0
        while spent < kills:
            copy(campaign, root)
            while spent < kills:
                process = start(root)
                wait_s = moment.uniform(0.1, 0.6) * whole_s
                try:
                    process.wait(wait_s)
                    break
                except subprocess.TimeoutExpired:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.communicate()
                    spent += 1
                    print(f"kill {spent} after {wait_s:.1f} s: {len(products(root))} files", flush=True)
            finish(start(root))
            compare(root, expected)
            print("resumed to identical bytes", flush=True)
            shutil.rmtree(root)


if __name__ == "__main__":
    main()
