"""`apertura study …`: each job of the studies as one command; a file that exists is complete."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from apertura.study.paper.claims import Claim

app = typer.Typer(no_args_is_help=True, help="The paper's claims, and the stability of every correction.")

PAPER = Path("results/study/paper")
STABILITY = Path("results/study/stability")
PAPER_PARTS = (
    "parameters", "resolution", "uav_resolution", "coherence", "loss_carrier_phase", "loss_timing", "loss_cfo",
    "loss_sfo", "loss_localization", "corrected", "clock",
)  # fmt: skip
"""Files of rows that make up claims.csv, in its order; `loss_…` for each of `apertura.study.paper.losses.ERRORS`."""

Folder = Annotated[Path, typer.Option("--folder", help="where results are written")]


@app.command()
def paper_part(part: str, folder: Folder = PAPER) -> None:
    """Compute some rows of the claims table, parts/PART.csv."""
    from apertura.study.tables import write_table

    path = folder / "parts" / f"{part}.csv"
    write_table(path, _claims(part)())
    typer.echo(path)


def _claims(part: str) -> "Callable[[], list[Claim]]":
    from apertura.study.paper import coherence, corrected, losses, parameters, resolution

    if part.startswith("loss_"):
        return lambda: losses.loss_claims(part.removeprefix("loss_"))
    return {
        "parameters": parameters.parameter_claims,
        "resolution": resolution.simulated_table,
        "uav_resolution": resolution.uav_table,
        "coherence": coherence.coherence_claims,
        "corrected": corrected.corrected_claims,
        "clock": corrected.clock_claims,
    }[part]


@app.command()
def paper_claims(folder: Folder = PAPER) -> None:
    """Put the parts together: claims.csv."""
    from apertura.study.paper.claims import Claim
    from apertura.study.tables import read_table, write_table

    path = folder / "claims.csv"
    write_table(path, [row for part in PAPER_PARTS for row in read_table(folder / "parts" / f"{part}.csv", Claim)])
    typer.echo(path)


@app.command()
def paper_figure(error: str, folder: Folder = PAPER) -> None:
    """Draw range-compressed data beside the image of one error, ERROR.png."""
    from apertura.study.paper.figures import draw_error

    typer.echo(draw_error(error, folder / f"{error}.png"))


@app.command()
def stability_sweep(impairment: str, method: str, folder: Folder = STABILITY) -> None:
    """Sweep one impairment under one correction, parts/IMPAIRMENT.METHOD.csv."""
    from apertura.study.stability.outcomes import run_sweep
    from apertura.study.stability.summary import part_path
    from apertura.study.tables import write_table

    path = part_path(folder, impairment, method)
    write_table(path, run_sweep(impairment, method))
    typer.echo(path)


@app.command()
def stability_chart(impairment: str, folder: Folder = STABILITY) -> None:
    """Put the corrections of one impairment together: IMPAIRMENT.csv and .png."""
    from apertura.study.stability.charts import draw_impairment
    from apertura.study.stability.summary import join_parts

    outcomes = join_parts(folder, impairment)
    draw_impairment(impairment, outcomes, folder / f"{impairment}.png")
    typer.echo(folder / f"{impairment}.csv")


@app.command()
def stability_summary(folder: Folder = STABILITY) -> None:
    """Where the loss passes 1 and 3 dB, and how far `auto` is from the best: summary.csv, .png, sidelink.csv."""
    from apertura.study.stability.charts import draw_summary
    from apertura.study.stability.summary import write_sidelink_tables, write_summary

    draw_summary(write_summary(folder), folder / "summary.png")
    typer.echo(write_sidelink_tables(folder))
