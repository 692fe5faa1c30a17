"""Metadata for packages, catalogues and containers agree with the project."""

import re
import subprocess
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
