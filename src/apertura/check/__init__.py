"""What can be told of a campaign folder before anything runs."""

import sys
from pathlib import Path


def print_findings(root: Path, *, products: bool = False, paranoid: bool = False) -> int:
    """Print what is wrong with a campaign folder, a line each, and which results are overtaken; return how many."""
    from apertura.campaign import Campaign
    from apertura.check.stale import damaged_results, stale_lines, stale_results

    campaign = Campaign.load(root)
    campaign.check_files()
    lines = list(stale_lines(stale_results(campaign, paranoid=paranoid)))
    if products:
        lines += [f"{name}: damaged: {why}" for name, why in damaged_results(campaign).items()]
    print(*lines, sep="\n", end="\n" if lines else "", file=sys.stdout)
    return len(lines)
