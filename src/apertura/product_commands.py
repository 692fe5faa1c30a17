"""What people ask of finished products: how far off their targets are."""

from pathlib import Path
from typing import Annotated

import typer

from apertura.paths import leave_working_folder


def score(
    campaign: Annotated[Path, typer.Argument(help="campaign folder with truth.json")], paths: bool = True
) -> None:
    """Compare where point targets are found with where they were put, and print the products' paths."""
    from apertura.campaign import Campaign
    from apertura.steps.score import print_findings

    print_findings(Campaign.load(leave_working_folder(campaign)), paths=paths)
