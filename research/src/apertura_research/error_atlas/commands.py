"""`apertura study atlas-…`: what spoils an image, each job as one command beside the other studies."""

from pathlib import Path

import typer

from apertura_research.study.commands import Folder, app, require

__all__ = ["app"]

ATLAS = Path("results/study/atlas")


@app.command()
def atlas_sweep(cause: str, folder: Folder = ATLAS) -> None:
    """Sweep one cause that spoils images, parts/CAUSE.csv."""
    from apertura.common.tables import write_table
    from apertura_research.error_atlas.causes import CAUSES
    from apertura_research.error_atlas.outcomes import run_cause
    from apertura_research.error_atlas.summary import part_path

    require("cause", cause, CAUSES)
    path = part_path(folder, cause)
    write_table(path, run_cause(cause), digits=6)
    typer.echo(path)


@app.command()
def atlas_chart(cause: str, folder: Folder = ATLAS) -> None:
    """Draw what one cause costs, what was expected and where flags came, CAUSE.png."""
    from apertura.common.tables import read_table
    from apertura_research.error_atlas.causes import CAUSES
    from apertura_research.error_atlas.charts import draw_cause
    from apertura_research.error_atlas.outcomes import Outcome
    from apertura_research.error_atlas.summary import part_path

    require("cause", cause, CAUSES)
    draw_cause(read_table(part_path(folder, cause), Outcome), folder / f"{cause}.png")
    typer.echo(folder / f"{cause}.png")


@app.command()
def atlas_summary(folder: Folder = ATLAS) -> None:
    """Where each cause costs 1 dB and its flag comes, and how often alarms are missed or false: summary.csv, .png."""
    from apertura_research.error_atlas.charts import draw_summary
    from apertura_research.error_atlas.summary import write_summary

    draw_summary(write_summary(folder), folder / "summary.png")
    typer.echo(folder / "summary.csv")
