"""What jobs ask of a cluster: enough for what they were measured to take, more where the work is more, not too much."""

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

BESIDE_MB = 2 * 135
"""Snakemake, which starts the job, and Snakemake again, which starts the step: measured."""

PAIR = SimpleNamespace(flight="f01", pair="uav1-uav2")


def test_every_rule_has_a_row_and_quotes_it():
    rules = (path for path in (ROOT / "workflow" / "rules").glob("*.smk") if path.name != "study.smk")
    text = "\n".join(path.read_text() for path in rules)
    assert set(re.findall(r"^rule (\w+):", text, re.MULTILINE)) == set(RULES)
    for what in ("threads: {}.threads", "**{}.resources", "**{}.params"):
        assert all(what.format(f'job["{rule}"]') in text for rule in RULES)


def test_pulses_are_told_from_sizes_alone_and_no_fewer_than_there_are(finished_tiny):
    work = Resources(finished_tiny).work("f01", "uav1-uav2", None)
    assert 40 <= work.pulses <= 3 * 40
    assert (work.pixels, work.tiles, work.images) == (3600, 1, 1)


def test_a_campaign_that_settles_its_grid_itself_is_taken_for_a_large_one_until_it_has(tiny, finished_tiny):
    edit_config(tiny, lambda document: document["scene"].update(bounds_m="auto", spacing_m="auto"))

    def asked():
        image = Resources(Campaign.load(tiny))["image"]
        return image.mem_mb(PAIR, 1), image.threads(PAIR)

    before = asked()
    copy_writable(finished_tiny.results, tiny / "results")
    after = asked()
    assert before[0] > 1.4 * after[0]
    assert (before[1], after[1]) == (4, 1)
    (tiny / "results" / "scene.json").write_text('{"grid": 3}')
    assert asked() == before


def test_a_further_attempt_asks_for_twice_as_much_and_a_share_for_less_time(tiny):
    edit_config(tiny, lambda document: document["scene"].update(spacing_m=0.0005))
    asked = Resources(Campaign.load(tiny))
    image, share = asked["image"], SimpleNamespace(**vars(PAIR), scatteritem="2-of-8")
    assert [image.mem_mb(PAIR, attempt) // image.mem_mb(PAIR, 1) for attempt in (1, 2, 3)] == [1, 2, 4]
    assert image.runtime(PAIR, 2) == 2 * image.runtime(PAIR, 1)
    assert asked["tiles"].runtime(share, 1) < image.runtime(PAIR, 1)


def test_a_long_recording_is_given_time_and_bounded_memory(tiny):
    for suffix, size in ((".sigmf-data", 5_000_000_000), (".sigmf-meta", 40_000_000)):
        os.truncate(tiny / "raw" / "f01" / f"uav1{suffix}", size)
    asked = Resources(Campaign.load(tiny))
    node = SimpleNamespace(flight="f01", node="uav1")
    assert asked["ingest"].runtime(node, 1) > 20
    assert asked["ingest"].mem_mb(node, 1) < 2048
    assert asked["echo"].mem_mb(PAIR, 1) < 2048


@pytest.mark.slow
def test_every_job_of_a_run_stays_within_what_it_asked_for_and_asked_for_no_more_than_four_times_that(run_by_snakemake):
    asked, seen = Resources(Campaign.load(run_by_snakemake)), set()
    for path in (run_by_snakemake / "results" / "benchmarks").rglob("*.tsv"):
        rule, job = job_of(path)
        with path.open() as lines:
            used = float(next(csv.DictReader(lines, delimiter="\t"))["max_rss"])
        predicted = asked[rule].mem_mb(job, 1)
        assert math.isnan(used) or used * 1.048576 + BESIDE_MB <= predicted, (rule, used, predicted)
        assert predicted <= 4 * max(used, 1000), (rule, used, predicted)
        seen.add(rule)
    assert seen == set(RULES) - {
        "bench",
        "calibrate",
        "terrain",
        "cphd",
        "transfer",
        "interferogram",
        "speed_accuracy",
        "whole_chart",
    }


def job_of(path):
    """The rule and the wildcards of a benchmark's file."""
    *folder, name = path.with_suffix("").parts[path.parts.index("benchmarks") + 1 :]
    where, _, rule = name.partition(".")
    if not rule:
        return name, SimpleNamespace(**({"flight": folder[0]} if folder else {}))
    if where == "fused":
        return rule, SimpleNamespace(flight=folder[0])
    rule, _, share = rule.partition(".")
    if where == rule:  # a flight's own folder
        return rule, SimpleNamespace(flight=folder[0])
    key = "pair" if "-" in where else "node"
    return rule, SimpleNamespace(flight=folder[0], **{key: where}, **({"scatteritem": share} if share else {}))
