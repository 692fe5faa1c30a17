"""The aarch64 wheel in a Debian system under qemu, and its images against those of this machine.

Needs Debian's packages ``debootstrap`` and ``qemu-user-static``, and Linux 6.7 or newer (see enter.sh). The packages of
the Debian system are unpacked but not configured: Python needs no more.
"""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import rasterio

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
SUITE, MIRROR = "bookworm", "http://deb.debian.org/debian"
SITE = "opt/apertura"
ENVIRONMENT = {"PYTHONPATH": f"/{SITE}", "PATH": "/usr/bin:/bin", "HOME": "/tmp", "USER": "root", "LANG": "C.UTF-8"}


def make_system(system: Path) -> None:
    """Unpack Python and its libraries of Debian for aarch64 into a folder, if it does not exist."""
    if (system / "usr/bin/python3").exists():
        return
    shutil.rmtree(system, ignore_errors=True)
    options = ["--arch=arm64", "--foreign", "--variant=minbase", "--include=python3,libexpat1"]
    subprocess.run(["debootstrap", *options, SUITE, system, MIRROR], check=True, stdout=subprocess.DEVNULL)
    for package in sorted((system / "var/cache/apt/archives").glob("*.deb")):
        subprocess.run(["dpkg-deb", "--extract", package, system], check=True)
    (system / "etc/passwd").write_text("root:x:0:0:root:/root:/bin/sh\n")


def install(system: Path, wheel: Path) -> None:
    """Install a wheel and what it requires, in the locked versions, for Python 3.11 on aarch64."""
    site = system / SITE
    shutil.rmtree(site, ignore_errors=True)
    target = ["--python-platform", "aarch64-manylinux_2_36", "--python-version", "3.11", "--target", site]
    command = [
        Path(sys.executable).with_name("uv"),
        "pip",
        "install",
        "--quiet",
        *target,
        "--constraint",
        ROOT / "requirements/all.txt",
        wheel,
    ]
    subprocess.run(command, check=True)


def run(system: Path, campaign: Path) -> None:
    """Run a campaign with the installed wheel; a failure ends the test."""
    enter = ["unshare", "--user", "--map-root-user", "--mount", HERE / "enter.sh", system, campaign]
    variables = [f"{name}={value}" for name, value in ENVIRONMENT.items()]
    command = ["python3", "-m", "apertura", "run", "/work", "--cores", "1"]
    begin = time.monotonic()
    subprocess.run([*enter, "/usr/bin/env", "-i", *variables, *command], check=True)
    print(f"aarch64 under qemu: apertura run {time.monotonic() - begin:.0f} s", flush=True)


def compare(ours: Path, theirs: Path) -> None:
    """Compare the complex images of the pairs of two runs; the test ends at a difference above both error bounds.

    With x the exact image, |a − b| ≤ |a − x| + |x − b|: the norms, relative to the image, are bounded by the certified
    errors of a and b.
    """
    paths = sorted(path.relative_to(ours) for path in ours.glob("results/*/*-*/slc.tif"))
    if not paths:
        sys.exit(f"{ours}: no image")
    for path in paths:
        a, b = (rasterio.open(campaign / path).read(1) for campaign in (ours, theirs))
        reports = [json.loads((campaign / path).with_name("image.json").read_text()) for campaign in (ours, theirs)]
        valid = np.isfinite(a) & np.isfinite(b)
        difference_db = 20 * np.log10(np.linalg.norm((a - b)[valid]) / np.linalg.norm(b[valid]))
        bound_db = 20 * np.log10(sum(10 ** (report["numerical_error_db"] / 20) for report in reports))
        same = "the same pixels" if np.array_equal(np.isfinite(a), np.isfinite(b)) else "other pixels"
        engines = [f"{report['engine']} ({report['instruction_set']})" for report in reports]
        print(f"{path}: {engines[0]} against {engines[1]}: {difference_db:.1f} dB, bound {bound_db:.1f} dB, {same}")
        if not difference_db <= bound_db or same == "other pixels":
            sys.exit("the images differ by more than their error bounds")


def test(folder: Path, wheel: Path) -> None:
    """Run the test campaign of the repository with a wheel for aarch64 and on this machine, and compare the images."""
    system = folder / "system"
    make_system(system)
    install(system, wheel)
    ours, theirs = folder / "aarch64", folder / "host"
    for campaign in (ours, theirs):
        shutil.rmtree(campaign, ignore_errors=True)
        shutil.copytree(ROOT / ".test", campaign, ignore=shutil.ignore_patterns("results", ".snakemake"))
    subprocess.run([sys.executable, "-m", "apertura", "run", theirs], check=True, stdout=subprocess.DEVNULL)
    run(system, ours)
    compare(ours, theirs)
