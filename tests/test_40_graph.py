"""The job graph of `workflow/*.smk` equals that of `apertura.workflow.rules`, from which lineage is derived."""

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
    """Yield rule, wildcards, inputs and outputs of every job that Snakemake plans."""
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
    """Compare inputs and outputs of every job with the table of rules; return the rules that have jobs."""
    campaign, rules_with_jobs = Campaign.load(root), set()
    for rule, wildcards, inputs, outputs in jobs_of(root, *targets):
        if rule not in RULES:
            continue
        rules_with_jobs.add(rule)
        row, where = RULES[rule], [wildcards[name] for name in RULES[rule].of.wildcards]
        rows = [result for result in RESULTS.values() if result.name == rule] or [RESULTS[row.result]]
        results = [result_of(campaign, result_row.result, *where) for result_row in rows]
        sources = {str((campaign.root / name).location) for result in results for name in result.sources}
        read = {str((campaign.root / name).location) for name in inputs if "/tiles/" not in name}
        assert read == sources, (rule, where)
        folder = "/".join(filter(None, ["results", row.folder])).format(**wildcards)
        files = {f"{folder}/{file}" for file in (*row.documents, *products_of(row))}
        files |= {result.manifest for result in results}
        if rule == "tiles":
            assert [Path(file).parent.name for file in outputs] == ["tiles"]
        elif rule in {"mosaic", "pictures", "page"}:  # these rules also write files that depend on the campaign
            assert files <= outputs, (rule, where)
        else:
            assert files == outputs, (rule, where)
    return rules_with_jobs


def test_inputs_and_outputs_of_rules_match_lineage(tiny):
    assert check(tiny, *ON_DEMAND) == set(RULES) - {
        "bench",
        "calibrate",
        "interferogram",
        "change",
        "stack",
        "stack_image",
        "payload",
        "terrain",
        "tiles",
        "transfer",
    }


@pytest.mark.slow
def test_configured_results_change_rules_and_lineage_alike(tiny):
    edit_config(
        tiny,
        lambda document: document.update(
            interferometry={"pairs": {"both": ["f01/uav1-uav1", "f01/uav1-uav2"]}},
            processing={"keep": ["echo"], "autofocus": "off", "multilook": {"spacing_m": 1.0, "subtract_noise": True}},
        ),
    )
    assert check(tiny) >= {"interferogram", "transfer", "export_fused"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["continuous", "swarm", "payload", "paper-lab", "paper-static"])
def test_rules_match_lineage_for_other_campaigns(name, tmp_path):
    simulate(tmp_path / "campaign", preset(name))
    assert ("payload" in check(tmp_path / "campaign", "pages")) == (name == "payload")


def test_rule_files_name_manifests_and_products(tmp_path):
    text = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "workflow" / "rules").glob("*.smk"))
    for row in RESULTS.values():
        if row.name in RULES:
            assert f'"results/{row.manifest}.manifest.json"' in text
            assert all(
                f'"{"/".join(filter(None, ["results", row.folder, file]))}"' in text for file in products_of(row)
            )
