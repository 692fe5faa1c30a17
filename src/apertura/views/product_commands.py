"""What people ask of finished products: targets against truth, what products were made from, a report, a map."""

import os
from pathlib import Path
from typing import Annotated

import typer

from apertura.common.processes import as_typed, given

ALL_CORES = os.cpu_count() or 1


def score(
    campaign: Annotated[Path, typer.Argument(help="campaign folder with truth.json")], paths: bool = True
) -> None:
    """Compare where point targets are found with where they were put, and print the products' paths."""
    from apertura.pipeline.campaign import Campaign
    from apertura.views.score import print_findings

    print_findings(Campaign.load(given(campaign)), paths=paths)


def verify(
    product: Annotated[Path, typer.Argument(help="a file, a stage or a manifest of a campaign, or a campaign folder")],
    *,
    campaign: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="the campaign of a file that lies elsewhere")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="only what is not the same")] = False,
) -> None:
    """Walk from a product to the raw samples; say of each link whether it is the same, changed or missing."""
    there = None if campaign is None else given(campaign)
    from apertura.views.verify.chain import print_verified

    raise typer.Exit(print_verified(given(product), there, quiet=quiet))


def reproduce(
    product: Annotated[Path, typer.Argument(help="a file, a stage or a manifest of a campaign, or a campaign folder")],
    *,
    cores: Annotated[int, typer.Option(min=1, help="cores to use")] = ALL_CORES,
    keep: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="a new folder to make it in, which stays; else in TMPDIR")
    ] = None,
) -> None:
    """Make a product again from the raw samples, in another folder, and compare it byte for byte with what is there."""
    kept = None if keep is None else given(keep)
    from apertura.views.verify.reproduce import print_reproduced

    raise typer.Exit(print_reproduced(given(product), cores=cores, keep=kept))


def diff(
    first: Annotated[Path, typer.Argument(help="a raster, picture, stage or report")],
    second: Annotated[Path, typer.Argument(help="what to hold it against, of this campaign or another")],
    *,
    whole: Annotated[bool, typer.Option("--all", help="every line of a section, however many")] = False,
) -> None:
    """Tell two products apart: geometry, settings, inputs, stages, code, software, flags and pixels."""
    from apertura.views.verify.diff import print_differences

    raise typer.Exit(print_differences(given(first), given(second), whole=whole))


def check_crate(
    folder: Annotated[Path, typer.Argument(help="campaign folder, or its results as they were passed on")],
) -> None:
    """Hold every file of a campaign's results against their RO-Crate, and the STAC catalog against its schemas."""
    from apertura.views.verify.crate import print_checked

    raise typer.Exit(print_checked(given(folder)))


def report(
    campaign: Annotated[Path, typer.Argument(help="campaign folder")],
    cores: Annotated[int, typer.Option(min=1, help="cores to use")] = os.cpu_count() or 1,
) -> None:
    """Write results/report.html: what was asked and decided, how images turned out, pictures; it needs no net."""
    from apertura.pipeline.campaign import Campaign
    from apertura.pipeline.workflow import run_workflow
    from apertura.views.report import PAGE
    from apertura.views.report.step import open_report

    campaign = given(campaign)
    status = run_workflow(campaign, cores, "all", "pages")
    if status:
        raise SystemExit(status)
    opened = Campaign.load(campaign)
    with open_report(opened) as (temporary, style):
        asked = ["--report", str(temporary), "--report-stylesheet", str(style)]
        status = run_workflow(campaign, 1, "all", "pages", *asked, show="errors")
        if status:
            raise SystemExit(status)
    for path in (opened.result(PAGE), *(opened.result(flight.name, PAGE) for flight in opened.image_flights)):
        typer.echo(as_typed(path))


def map_page(
    campaign: Annotated[Path, typer.Argument(help="campaign folder with results")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="to serve on; 0: a free one")] = 0,
    open_: Annotated[bool, typer.Option("--open", help="show it in the browser")] = False,
) -> None:
    """Show a finished campaign as a map in a browser: served to this machine alone, until Ctrl-C."""
    from apertura.pipeline.campaign import Campaign
    from apertura.views.webmap.server import served

    served(Campaign.load(given(campaign)), port=port).show(in_browser=open_)
