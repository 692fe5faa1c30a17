"""Table of rules: its rows agree with the steps, the commands, the products and the campaign."""

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
def test_step_and_command_of_a_rule_take_the_same_arguments(rule):
    campaign, *parameters = signature(pkgutil.resolve_name(rule.step.path)).parameters
    assert campaign == "campaign"
    assert len(parameters) == len(rule.arguments) + len(rule.last_words) + len(rule.options)
    assert set(rule.options) <= set(parameters)


def test_rules_and_commands_correspond():
    assert {command.name for command in step.registered_commands} == {rule.command for rule in RULES.values()}


def test_rules_name_the_products_that_steps_write():
    products = {name: RESULTS[name].products for name in ("coverage", "cphd", "map", "stac", "ro_crate")}
    files = {"coverage": COVERAGE, "cphd": (PHASE_HISTORY,), "stac": (f"stac/{CATALOG}",), "ro_crate": (CRATE,)}
    assert products == {**files, "map": (MAP.rpartition("/")[2],)}


def test_results_depend_only_on_earlier_results(tiny):
    earlier = set()
    for _, _, result in places_of(Campaign.load(tiny)):
        sources = {source for source in result.sources if source.startswith("results/")}
        assert sources <= earlier
        earlier.add(result.manifest)
