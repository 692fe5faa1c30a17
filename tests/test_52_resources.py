"""Resource requests of jobs: sufficient for measured use, growing with the work, and not excessive."""

import csv
import math
import os
import re
from types import SimpleNamespace

import pytest
from folders import ROOT, copy_writable, edit_config

from apertura.campaign.folder import Campaign
from apertura.workflow.resources import Resources
from apertura.workflow.rules import RULES

SNAKEMAKE_MB = 2 * 135
"""Measured memory of the two Snakemake processes that start the job and the step, in MB."""

PAIR = SimpleNamespace(flight="f01", pair="uav1-uav2")


def test_every_rule_uses_the_resources_of_its_row():
    rules = (path for path in (ROOT / "workflow" / "rules").glob("*.smk") if path.name != "study.smk")
    text = "\n".join(path.read_text() for path in rules)
    assert set(re.findall(r"^rule (\w+):", text, re.MULTILINE)) == set(RULES)
    for pattern in ("threads: {}.threads", "**{}.resources", "**{}.params"):
        assert all(pattern.format(f'job["{rule}"]') in text for rule in RULES)


def test_pulse_number_is_estimated_from_file_sizes_as_upper_bound(finished_tiny):
    work = Resources(finished_tiny).work("f01", "uav1-uav2", None)
    assert 40 <= work.pulses <= 3 * 40
    assert (work.pixels, work.tiles, work.images) == (3600, 1, 1)


def test_automatic_grid_requests_more_until_it_is_determined(tiny, finished_tiny):
    edit_config(tiny, lambda document: document["scene"].update(bounds_m="auto", spacing_m="auto"))

    def requests():
        image = Resources(Campaign.load(tiny))["image"]
        return image.mem_mb(PAIR, 1), image.threads(PAIR)

    before = requests()
    copy_writable(finished_tiny.results, tiny / "results")
    after = requests()
    assert before[0] > 1.4 * after[0]
    assert (before[1], after[1]) == (4, 1)
    (tiny / "results" / "scene.json").write_text('{"grid": 3}')
    assert requests() == before


def test_retry_doubles_requests_and_a_share_needs_less_time(tiny):
    edit_config(tiny, lambda document: document["scene"].update(spacing_m=0.0005))
    resources = Resources(Campaign.load(tiny))
    image, share = resources["image"], SimpleNamespace(**vars(PAIR), scatteritem="2-of-8")
    assert [image.mem_mb(PAIR, attempt) // image.mem_mb(PAIR, 1) for attempt in (1, 2, 3)] == [1, 2, 4]
    assert image.runtime(PAIR, 2) == 2 * image.runtime(PAIR, 1)
    assert resources["tiles"].runtime(share, 1) < image.runtime(PAIR, 1)


def test_long_recording_requests_time_but_bounded_memory(tiny):
    for suffix, size in ((".sigmf-data", 5_000_000_000), (".sigmf-meta", 40_000_000)):
        os.truncate(tiny / "raw" / "f01" / f"uav1{suffix}", size)
    resources = Resources(Campaign.load(tiny))
    node = SimpleNamespace(flight="f01", node="uav1")
    assert resources["ingest"].runtime(node, 1) > 20
    assert resources["ingest"].mem_mb(node, 1) < 2048
    assert resources["echo"].mem_mb(PAIR, 1) < 2048


@pytest.mark.slow
def test_memory_requests_cover_use_and_are_below_four_times_it(run_by_snakemake):
    resources, measured_rules = Resources(Campaign.load(run_by_snakemake)), set()
    for path in (run_by_snakemake / "results" / "benchmarks").rglob("*.tsv"):
        rule, job = job_of(path)
        with path.open() as lines:
            used = float(next(csv.DictReader(lines, delimiter="\t"))["max_rss"])
        predicted = resources[rule].mem_mb(job, 1)
        assert math.isnan(used) or used * 1.048576 + SNAKEMAKE_MB <= predicted, (rule, used, predicted)
        assert predicted <= 4 * max(used, 1000), (rule, used, predicted)
        measured_rules.add(rule)
    assert measured_rules == set(RULES) - {
        "bench",
        "calibrate",
        "terrain",
        "cphd",
        "transfer",
        "interferogram",
        "change",
        "stack",
        "stack_image",
        "payload",
        "speed_accuracy",
        "whole_chart",
    }


def job_of(path):
    """Return rule and wildcards of a benchmark file."""
    *folder, name = path.with_suffix("").parts[path.parts.index("benchmarks") + 1 :]
    where, _, rule = name.partition(".")
    if not rule:
        return name, SimpleNamespace(**({"flight": folder[0]} if folder else {}))
    if where == "fused":
        return rule, SimpleNamespace(flight=folder[0])
    rule, _, share = rule.partition(".")
    if where == rule:  # results of a whole flight
        return rule, SimpleNamespace(flight=folder[0])
    key = "pair" if "-" in where else "node"
    return rule, SimpleNamespace(flight=folder[0], **{key: where}, **({"scatteritem": share} if share else {}))
