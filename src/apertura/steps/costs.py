"""Rule `costs`: what the campaign's plans reckon with, kept so that every job on every machine plans alike."""

from pathlib import Path

from apertura.campaign import Campaign
from apertura.planning.cost import Costs
from apertura.planning.machine import kept_costs, read_costs, write_costs

PATH = Path("results/costs.json")


def costs(campaign: Campaign) -> Path:
    """Write results/costs.json: the costs measured on this machine, or the shipped ones."""
    return write_costs(read_costs(), campaign.root / PATH)


def campaign_costs(campaign: Campaign) -> Costs:
    """Return the costs that the campaign keeps, or this machine's before it keeps any."""
    return kept_costs(campaign.root / PATH)
