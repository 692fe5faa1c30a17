"""What people ask of finished products: how far off their targets are, and a report on all of them."""

import os
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


def report(
    campaign: Annotated[Path, typer.Argument(help="campaign folder")],
    cores: Annotated[int, typer.Option(min=1, help="cores to use")] = os.cpu_count() or 1,
) -> None:
    """Write results/report.html: what was asked and decided, how images turned out, pictures; one file that needs no net."""
    from apertura.atomic import replacement
    from apertura.campaign import Campaign
    from apertura.paths import shipped
    from apertura.workflow import run_workflow

    campaign = campaign.absolute()
    status = run_workflow(campaign, cores, "all", "pages")
    if status == 0:
        style = ["--report-stylesheet", str(shipped() / "workflow" / "report" / "report.css")]
        with replacement(campaign / "results" / "report.html") as temporary:
            status = run_workflow(campaign, 1, "all", "pages", "--quiet", "--report", str(temporary), *style)
            if status:
                raise SystemExit(status)
    if status == 0:
        opened = Campaign.load(leave_working_folder(campaign))
        pages = [opened.result(flight.name, "report.html") for flight in opened.image_flights]
        print(opened.result("report.html"), *pages, sep="\n")
    raise SystemExit(status)
