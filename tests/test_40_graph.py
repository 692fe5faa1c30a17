"""The graph of the workflow stands in `workflow/*.smk` for people and in `apertura.workflow.rules` for lineage: one."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from folders import ROOT, edit_config

from apertura.campaign.folder import Campaign
from apertura.simulation import preset, simulate
from apertura.workflow.lineage import products_of, result_of
from apertura.workflow.rules import RESULTS, RULES

ON_DEMAND = ("pages", "phase_history", "whole_chart", "speed_accuracy")


def jobs_of(root, *targets):
    """Yield rule, wildcards, inputs and outputs of every job, as Snakemake plans them."""
    script, options = (
        ROOT / "tests" / "snakemake_jobs.py",
        ["--directory", str(root), "--cores", "2", "-n", "--forceall"],
    )
    run = subprocess.run(
        [sys.executable, str(script), *options, "all", *targets], cwd=ROOT, text=True, capture_output=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr
    for job in map(json.loads, run.stdout.splitlines()):
        yield job["rule"], job["wildcards"], set(job["input"]), set(job["output"])


def check(root, *targets):
    """Compare inputs and outputs of every job with the rows of its rule; return the rules that have jobs."""
    campaign, found = Campaign.load(root), set()
    for rule, words, inputs, outputs in jobs_of(root, *targets):
        if rule not in RULES:
            continue
        found.add(rule)
        row, where = RULES[rule], [words[word] for word in RULES[rule].of.wildcards]
        rows = [made for made in RESULTS.values() if made.name == rule] or [RESULTS[row.result]]
        made = [result_of(campaign, one.result, *where) for one in rows]
        sources = {str((campaign.root / name).location) for one in made for name in one.sources}
        read = {str((campaign.root / name).location) for name in inputs if "/tiles/" not in name}
        assert read == sources, (rule, where)
        folder = "/".join(filter(None, ["results", row.folder])).format(**words)
        files = {f"{folder}/{file}" for file in (*row.documents, *products_of(row))} | {one.manifest for one in made}
        if rule == "tiles":
            assert [Path(file).parent.name for file in outputs] == ["tiles"]
        elif rule in {"mosaic", "pictures", "page"}:  # whose files follow from the campaign
            assert files <= outputs, (rule, where)
        else:
            assert files == outputs, (rule, where)
    return found


def test_inputs_and_outputs_of_rules_are_those_that_lineage_has(tiny):
    assert check(tiny, *ON_DEMAND) == set(RULES) - {
        "bench",
        "calibrate",
        "interferogram",
        "terrain",
        "tiles",
        "transfer",
    }


@pytest.mark.slow
def test_what_the_config_asks_for_changes_both(tiny):
    edit_config(
        tiny,
        lambda document: document.update(
            interferometry={"pairs": {"both": ["f01/uav1-uav1", "f01/uav1-uav2"]}},
            processing={"keep": ["echo"], "autofocus": "off", "multilook": {"spacing_m": 1.0, "subtract_noise": True}},
        ),
    )
    assert check(tiny) >= {"interferogram", "transfer", "export_fused"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["continuous", "swarm", "paper-lab", "paper-static"])
def test_other_kinds_of_campaigns_have_the_same_graph(name, tmp_path):
    simulate(tmp_path / "campaign", preset(name))
    assert check(tmp_path / "campaign")


def test_rules_name_their_files(tmp_path):
    text = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "workflow" / "rules").glob("*.smk"))
    for row in RESULTS.values():
        if row.name in RULES:
            assert f'"results/{row.manifest}.manifest.json"' in text
            assert all(
                f'"{"/".join(filter(None, ["results", row.folder, file]))}"' in text for file in products_of(row)
            )
