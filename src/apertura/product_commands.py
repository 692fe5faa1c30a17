"""What people ask of finished products: how far off their targets are, and to see them on a map."""

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


def map_page(
    campaign: Annotated[Path, typer.Argument(help="campaign folder with results")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="to serve on; 0: a free one")] = 0,
    open_: Annotated[bool, typer.Option("--open", help="show it in the browser")] = False,
) -> None:
    """Show a finished campaign as a map in a browser: served to this machine alone, until Ctrl-C."""
    from apertura.campaign import Campaign
    from apertura.load.map_server import served

    served(Campaign.load(leave_working_folder(campaign)), port=port).show(in_browser=open_)
