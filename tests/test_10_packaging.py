"""What packages, catalogues and containers are told of the project is what the project is."""

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


def test_the_citation_has_what_the_format_asks_for_and_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] == "software"
    assert all(author.keys() >= {"name"} or author.keys() >= {"family-names"} for author in citation["authors"])
    assert (citation["version"], citation["license"]) == (apertura.__version__, project()["license"])


def test_classifiers_name_the_pythons_that_the_package_asks_for():
    versions = [name.rpartition(" ")[2] for name in project()["classifiers"] if re.search(r":: 3\.\d+$", name)]
    assert versions == sorted(versions, key=lambda version: int(version[2:]))
    assert project()["requires-python"] == f">={versions[0]}"
    assert "3.13" in versions
    assert not any(name.startswith("License ::") for name in project()["classifiers"])  # the expression says it
    assert (ROOT / "src/apertura/py.typed").is_file()


def test_the_workflow_catalogue_finds_what_it_looks_for():
    usage = yaml.safe_load((ROOT / ".snakemake-workflow-catalog.yml").read_text(encoding="utf-8"))["usage"]
    assert usage["mandatory-flags"].keys() == {"desc", "flags"}
    assert usage["software-stack-deployment"].keys() == {"conda", "apptainer", "apptainer+conda"}
    assert isinstance(usage["report"], bool)
    for name in ("workflow/Snakefile", "config/README.md", "README.md", "LICENSE", ".test/config/config.yaml"):
        assert (ROOT / name).is_file()


def test_the_campaign_of_the_catalogue_is_small_and_nothing_is_wrong_with_it():
    files = subprocess.run(
        ["git", "ls-files", "-z", ".test"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.split("\0")[:-1]
    if not files:
        pytest.skip("no git, or no repository: which files are shipped is not known")
    assert sum((ROOT / name).stat().st_size for name in files) < 1_000_000
    assert not any(name.startswith(".test/results") for name in files)
    assert problems(TEST_CAMPAIGN) == []
    assert len(Campaign.load(TEST_CAMPAIGN).image_flights[0].pairs) == 2


def test_the_campaign_of_the_catalogue_is_what_its_specification_makes(tmp_path):
    made = simulate(tmp_path / "made", read_specification(TEST_CAMPAIGN / "simulation.yaml"), seed=1)
    for path in sorted(one for one in made.rglob("*") if one.is_file()):
        kept = TEST_CAMPAIGN / path.relative_to(made)
        if path.suffix == ".sigmf-data":  # rounding of another machine's sine
            difference = np.fromfile(kept, "<i2").astype(int) - np.fromfile(path, "<i2")
            assert np.abs(difference).max() <= 1
        elif path.suffix not in {".sigmf-meta", ".npy"} and path.name != "truth.json":  # with hashes of the samples
            assert kept.read_bytes() == path.read_bytes(), path.name
        else:
            assert kept.is_file()


def container_lines():
    text = (ROOT / "Containerfile").read_text(encoding="utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def test_the_container_copies_what_is_there_and_runs_as_nobody_of_power():
    lines = container_lines()
    for line in lines:
        if line.startswith("COPY ") and "--from" not in line:
            assert all((ROOT / name).exists() for name in line.split()[1:-1]), line
    last = lines[max(number for number, line in enumerate(lines) if line.startswith("FROM")) :]
    assert [line for line in last if line.startswith("USER")] == ["USER apertura"]
    assert [line for line in last if line.startswith("ENTRYPOINT")] == ['ENTRYPOINT ["apertura"]']


def test_everything_that_the_container_installs_from_an_index_is_in_the_lock():
    installs = [line for line in container_lines() if re.search(r"\bpip (install|sync)\b", line)]
    assert len(installs) == 3
    for line in installs:
        assert re.search(
            r"--require-hashes (-r )?requirements/(uv|all)\.txt$|--constraint requirements/all\.txt dist/", line
        )
