"""One row per rule: what a row says is what its step, its campaign and the workflow have."""

import pkgutil
from inspect import signature

import pytest

from apertura.campaign.folder import Campaign
from apertura.cli import step
from apertura.formats.catalog import CATALOG, CRATE
from apertura.formats.export import COVERAGE, MAP, PHASE_HISTORY
from apertura.workflow.lineage import places_of
from apertura.workflow.rules import RESULTS, RULES


@pytest.mark.parametrize("rule", RULES.values(), ids=list(RULES))
def test_the_step_of_a_row_takes_what_its_command_takes(rule):
    campaign, *words = signature(pkgutil.resolve_name(rule.step.path)).parameters
    assert campaign == "campaign"
    assert len(words) == len(rule.arguments) + len(rule.last_words) + len(rule.options)
    assert set(rule.options) <= set(words)


def test_every_rule_has_a_command_and_no_command_is_of_no_rule():
    assert {one.name for one in step.registered_commands} == {rule.command for rule in RULES.values()}


def test_products_of_rows_are_called_as_their_steps_call_them():
    named = {name: RESULTS[name].products for name in ("coverage", "cphd", "map", "stac", "ro_crate")}
    files = {"coverage": COVERAGE, "cphd": (PHASE_HISTORY,), "stac": (f"stac/{CATALOG}",), "ro_crate": (CRATE,)}
    assert named == {**files, "map": (MAP.rpartition("/")[2],)}


def test_every_result_is_made_from_files_and_results_before_it(tiny):
    made = set()
    for _, _, result in places_of(Campaign.load(tiny)):
        sources = {source for source in result.sources if source.startswith("results/")}
        assert sources <= made
        made.add(result.manifest)
