"""Metadata for packages, catalogues and containers agree with the project."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import yaml

import apertura
from apertura.campaign.folder import Campaign
from apertura.check import problems
from apertura.simulation import simulate
from apertura.simulation.specification import read_specification

ROOT = Path(__file__).parents[1]
TEST_CAMPAIGN = ROOT / ".test"


def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_citation_file_is_complete_and_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] == "software"
    assert all(author.keys() >= {"name"} or author.keys() >= {"family-names"} for author in citation["authors"])
    assert (citation["version"], citation["license"]) == (apertura.__version__, project()["license"])


def test_classifiers_match_the_required_python_versions():
    versions = [name.rpartition(" ")[2] for name in project()["classifiers"] if re.search(r":: 3\.\d+$", name)]
    assert versions == sorted(versions, key=lambda version: int(version[2:]))
    assert project()["requires-python"] == f">={versions[0]}"
    assert "3.13" in versions
    # PEP 639: the license expression replaces the classifier
    assert not any(name.startswith("License ::") for name in project()["classifiers"])
    assert (ROOT / "src/apertura/py.typed").is_file()


def test_workflow_catalogue_files_exist():
    usage = yaml.safe_load((ROOT / ".snakemake-workflow-catalog.yml").read_text(encoding="utf-8"))["usage"]
    assert usage["mandatory-flags"].keys() == {"desc", "flags"}
    assert usage["software-stack-deployment"].keys() == {"conda", "apptainer", "apptainer+conda"}
    assert isinstance(usage["report"], bool)
    for name in ("workflow/Snakefile", "config/README.md", "README.md", "LICENSE", ".test/config/config.yaml"):
        assert (ROOT / name).is_file()


def test_catalogue_campaign_is_small_and_valid():
    files = subprocess.run(
        ["git", "ls-files", "-z", ".test"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.split("\0")[:-1]
    if not files:
        pytest.skip("no git, or no repository: the list of shipped files is not available")
    assert sum((ROOT / name).stat().st_size for name in files) < 1_000_000
    assert not any(name.startswith(".test/results") for name in files)
    assert problems(TEST_CAMPAIGN) == []
    assert len(Campaign.load(TEST_CAMPAIGN).image_flights[0].pairs) == 2


def test_catalogue_campaign_matches_its_specification(tmp_path):
    generated = simulate(tmp_path / "made", read_specification(TEST_CAMPAIGN / "simulation.yaml"), seed=1)
    for path in sorted(path for path in generated.rglob("*") if path.is_file()):
        kept = TEST_CAMPAIGN / path.relative_to(generated)
        if path.suffix == ".sigmf-data":  # sine functions of other machines round differently
            difference = np.fromfile(kept, "<i2").astype(int) - np.fromfile(path, "<i2")
            assert np.abs(difference).max() <= 1
        elif path.suffix not in {".sigmf-meta", ".npy"} and path.name != "truth.json":  # contains hashes of samples
            assert kept.read_bytes() == path.read_bytes(), path.name
        else:
            assert kept.is_file()


def test_conda_recipe_matches_environment_yml_and_version():
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text())
    *conda, _ = yaml.safe_load((ROOT / "environment.yml").read_text())["dependencies"]
    required = [re.sub(r"(?<=\w)(?=[<>=])", " ", line, count=1) for line in conda if line != "pip"]
    assert recipe["requirements"]["run"] == required
    assert recipe["context"]["version"] == apertura.__version__
    about = project()
    assert (recipe["about"]["summary"], recipe["about"]["license"]) == (about["description"], about["license"])


def container_lines():
    text = (ROOT / "Containerfile").read_text(encoding="utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def test_container_copies_existing_files_and_runs_unprivileged():
    lines = container_lines()
    for line in lines:
        if line.startswith("COPY ") and "--from" not in line:
            assert all((ROOT / name).exists() for name in line.split()[1:-1]), line
    last = lines[max(number for number, line in enumerate(lines) if line.startswith("FROM")) :]
    assert [line for line in last if line.startswith("USER")] == ["USER apertura"]
    assert [line for line in last if line.startswith("ENTRYPOINT")] == ['ENTRYPOINT ["apertura"]']


def test_container_installs_only_locked_packages():
    installs = [line for line in container_lines() if re.search(r"\bpip (install|sync)\b", line)]
    assert len(installs) == 3
    for line in installs:
        assert re.search(
            r"--require-hashes (-r )?requirements/(uv|all)\.txt$|--constraint requirements/all\.txt dist/", line
        )


def without_linux(script, platform):
    """Run a script without the modules and functions that other systems lack; return its completed process."""
    lacking = """
import os, sys
sys.modules |= dict.fromkeys(("fcntl", "grp", "pwd", "resource", "termios"))
for name in ("O_PATH", "fork", "sched_getaffinity", "sysconf"):
    delattr(os, name)
import apertura as ap
from apertura.common.errors import CampaignError
"""
    script = f"{lacking}\nPLATFORM = {platform!r}\n{script}"
    return subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)


@pytest.mark.slow
def test_library_forms_images_from_arrays_without_linux():
    """All public names either work or are refused: a reflector at the origin has amplitude 1."""
    script = """
import numpy as np
refused = set()
for name in ap.__all__:
    if name not in ap._ON_LINUX:
        getattr(ap, name)
from apertura.core.backprojection.engines import native_binding
from pathlib import Path
native_binding.library_path = lambda: Path("nowhere")
frequency = 1.2e9 + 2e6 * np.arange(64)
track = np.stack([np.linspace(-4, 4, 64), np.full(64, -20.0), np.full(64, 10.0)], -1)
aperture = ap.Aperture(track, track)
echo = np.exp(-2j * np.pi * frequency * aperture.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
history = ap.PhaseHistory(echo, frequency, np.full(64, 1 / 64), np.zeros(64), aperture)
image = ap.backproject(history, ap.SceneGrid("local", -1.0, 1.0, 0.1, (20, 20)))
print(round(float(abs(image).max()), 1), image.attrs["numerical_error_db"] < -60)
sys.platform = PLATFORM
for name in ap._ON_LINUX:
    try:
        getattr(ap, name)
    except CampaignError as error:
        assert f"apertura.{name}: operating system 'darwin'; expected Linux" in str(error), error
        refused.add(name)
print(refused == ap._ON_LINUX)
"""
    done = without_linux(script, "darwin")
    assert done.stdout.split() == ["1.0", "True", "True"], done.stderr


@pytest.mark.parametrize("platform", ["darwin", "win32"])
def test_command_on_another_system_is_one_message(platform):
    done = without_linux("sys.platform = PLATFORM\nfrom apertura.__main__ import main\nmain()", platform)
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: the command apertura: operating system '{platform}'; expected Linux")
    assert done.stderr.count("\n") == 1
