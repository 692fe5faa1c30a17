"""`apertura study …`: each job of the studies as one command; a file that exists is complete."""

import pkgutil
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import typer

from apertura.common.errors import CampaignError
from apertura.common.processes import given

app = typer.Typer(
    no_args_is_help=True,
    help="The paper's claims, the stability of every correction, tracks refined by images, and what spoils an image.",
)

PAPER = Path("results/study/paper")
STABILITY = Path("results/study/stability")
REFINEMENT = Path("results/study/refinement")
_LOSS = "losses:loss_claims"
PAPER_PARTS = {
    "parameters": "parameters:parameter_claims",
    "effects": "effects:effect_claims",
    "resolution": "resolution:simulated_table",
    "uav_resolution": "resolution:uav_table",
    "coherence": "coherence:coherence_claims",
    "fusion": "fusion:fusion_claims",
    **{f"loss_{error}": _LOSS for error in ("carrier_phase", "timing", "cfo", "sfo", "localization")},
    "positions": "positions:position_claims",
    "corrected": "corrected:corrected_claims",
    "clock": "corrected:clock_claims",
    "swarm": "swarm:swarm_claims",
}
"""Files of rows that make up claims.csv, in its order → what computes them; `loss_…` gives its error as argument."""

PAPER_READS = {"coherence": ("lab", "static"), "fusion": ("uav",)}
"""Part → the experiments whose campaigns it reads, from a folder that it is given."""

CAMPAIGNS = "campaigns"

PAPER_FIGURES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("no_errors", "sfo", "cfo", "carrier_phase", "timing", "localization", "scene"), ()),
    **dict.fromkeys(("lab_profile", "lab_phase"), ("lab",)),
    **dict.fromkeys(("static_profile", "static_phase"), ("static",)),
    **dict.fromkeys(("uav_geometry", "uav_images", "uav_cuts"), ("uav",)),
}
"""The paper's figures with data, in its order → the experiments whose campaigns they show."""

Folder = Annotated[Path, typer.Option("--folder", callback=given, help="where results are written")]


@app.command()
def paper_part(part: str, folder: Folder = PAPER) -> None:
    """Compute some rows of the claims table, parts/PART.csv."""
    from apertura.common.tables import write_table

    require("part", part, PAPER_PARTS)
    path = folder / "parts" / f"{part}.csv"
    claims = pkgutil.resolve_name(f"apertura_research.study.paper.{PAPER_PARTS[part]}")
    error = [part.removeprefix("loss_")] if PAPER_PARTS[part] == _LOSS else []
    write_table(path, claims(*error, *([folder / CAMPAIGNS] if part in PAPER_READS else [])))
    typer.echo(path)


def require(kind: str, name: str, choices: Collection[str]) -> None:
    """Raise CampaignError with the choices there are unless a name is one of them."""
    if name not in choices:
        expected = f"one of {', '.join(choices)}"
        raise CampaignError(f"{kind} {name!r}", where="apertura study", expected=expected, remedy="Choose one of them.")


@app.command()
def paper_claims(folder: Folder = PAPER) -> None:
    """Put the parts together: claims.csv."""
    from apertura.common.tables import read_table, write_table
    from apertura_research.study.paper.claims import Claim

    path = folder / "claims.csv"
    write_table(path, [row for part in PAPER_PARTS for row in read_table(folder / "parts" / f"{part}.csv", Claim)])
    typer.echo(path)


@app.command()
def paper_figure(name: str, folder: Folder = PAPER) -> None:
    """Draw one figure of the paper, NAME.png."""
    require("figure", name, PAPER_FIGURES)
    path = folder / f"{name}.png"
    if PAPER_FIGURES[name]:
        from apertura_research.study.paper.experiment_figures import DRAWN

        DRAWN[name](folder / CAMPAIGNS, path)
    else:
        from apertura_research.study.paper.figures import draw_scene, draw_simulated

        draw_scene(path) if name == "scene" else draw_simulated(name, path)
    typer.echo(path)


@app.command()
def stability_sweep(impairment: str, method: str, folder: Folder = STABILITY) -> None:
    """Sweep one impairment under one correction, parts/IMPAIRMENT.METHOD.csv."""
    from apertura.common.tables import write_table
    from apertura_research.study.stability.outcomes import run_sweep
    from apertura_research.study.stability.summary import part_path
    from apertura_research.study.stability.sweeps import CHOICES, SWEEPS

    require("impairment", impairment, SWEEPS)
    require("method", method, CHOICES)
    path = part_path(folder, impairment, method)
    write_table(path, run_sweep(impairment, method))
    typer.echo(path)


@app.command()
def stability_chart(impairment: str, folder: Folder = STABILITY) -> None:
    """Put the corrections of one impairment together: IMPAIRMENT.csv and .png."""
    from apertura_research.study.stability.charts import draw_impairment
    from apertura_research.study.stability.summary import join_parts
    from apertura_research.study.stability.sweeps import SWEEPS

    require("impairment", impairment, SWEEPS)
    outcomes = join_parts(folder, impairment)
    draw_impairment(impairment, outcomes, folder / f"{impairment}.png")
    typer.echo(folder / f"{impairment}.csv")


@app.command()
def stability_summary(folder: Folder = STABILITY) -> None:
    """Where the loss passes 1 and 3 dB, and how far `auto` is from the best: summary.csv, .png, sidelink.csv."""
    from apertura_research.study.stability.charts import draw_summary
    from apertura_research.study.stability.summary import write_sidelink_tables, write_summary

    draw_summary(write_summary(folder), folder / "summary.png")
    typer.echo(write_sidelink_tables(folder))


@app.command()
def refinement_sweep(scene: str, folder: Folder = REFINEMENT) -> None:
    """Refine tracks with ever larger errors over one kind of scene, parts/SCENE.csv."""
    from apertura.common.tables import write_table
    from apertura_research.study.refinement.outcomes import KINDS, run_kind

    require("scene", scene, KINDS)
    path = folder / "parts" / f"{scene}.csv"
    write_table(path, run_kind(scene))
    typer.echo(path)


@app.command()
def refinement_chart(folder: Folder = REFINEMENT) -> None:
    """Put the scenes together, loss against sigma with and without refinement: losses.csv and .png."""
    from apertura.common.tables import read_table, write_table
    from apertura_research.study.refinement.charts import draw_losses
    from apertura_research.study.refinement.outcomes import KINDS, Outcome

    rows = [row for scene in KINDS for row in read_table(folder / "parts" / f"{scene}.csv", Outcome)]
    write_table(folder / "losses.csv", rows)
    draw_losses(rows, folder / "losses.png")
    typer.echo(folder / "losses.png")


@app.command()
def refinement_picture(scene: str, folder: Folder = REFINEMENT) -> None:
    """Draw one case of a scene before and after, with the errors of its tracks, SCENE.png."""
    from apertura_research.study.refinement.outcomes import KINDS
    from apertura_research.study.refinement.pictures import draw_case

    require("scene", scene, KINDS)
    draw_case(scene, folder / f"{scene}.png")
    typer.echo(folder / f"{scene}.png")
