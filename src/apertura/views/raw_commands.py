"""What people ask of recordings and logs before anything is run."""

from pathlib import Path
from typing import Annotated

import typer

from apertura.common.processes import given


def inspect(
    path: Annotated[Path, typer.Argument(help="a recording, a flight log, phase history, a DEM, a folder, a campaign")],
    *,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="what a log cannot say of itself, as nodes.<n>.log does"),
    ] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE.png", help="draw a preview")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="for machines")] = False,
) -> None:
    """Tell what a file or folder is, its times, rates, gaps, fix and bounds, and what is missing for an image."""
    picture = None if plot is None else given(plot)
    from apertura.views.inspect.look import inspect_path

    raise typer.Exit(inspect_path(given(path), settings or (), name=path, plot=picture, as_json=as_json))


def align(
    campaign: Annotated[Path, typer.Argument(help="campaign folder")],
    flight: Annotated[str, typer.Argument(help="flight")],
    node: Annotated[str, typer.Argument(help="node that sends and receives")],
    *,
    point: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="reflector: easting, northing in scene.crs, ellipsoidal height (z in a local frame), m"),
    ] = None,
    search_s: Annotated[float | None, typer.Option(min=0, help="how far the clock may be off, s")] = None,
    search_m: Annotated[float, typer.Option(min=0, help="how long the path may be, m of total path")] = 10.0,
    drift: Annotated[bool, typer.Option("--drift", help="find by how much the clock runs slow, too")] = False,
    keep_path: Annotated[bool, typer.Option("--keep-path", help="the path is as the config says")] = False,
    write: Annotated[bool, typer.Option("--write", help="write config/clocks.tsv")] = False,
) -> None:
    """Find the clock and the range of a recorder against its flight log: where echoes add up best."""
    from apertura.pipeline.campaign import Campaign

    opened = Campaign.load(given(campaign))
    from apertura.pipeline.steps.align import print_alignment

    asked = {"point": point, "search_s": search_s, "search_m": 0.0 if keep_path else search_m, "drift": drift}
    print_alignment(opened, flight, node, write=write, **asked)
