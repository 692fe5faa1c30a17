"""`apertura study …`: one command per job of the studies; every output file that exists is complete."""

import pkgutil
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apertura.common.errors import CampaignError
from apertura.common.processes import given

if TYPE_CHECKING:
    from apertura_research.sweep import Study

app = typer.Typer(
    no_args_is_help=True,
    help="Studies: the paper's claims, stability of the corrections, autofocus, and the error atlas (image errors).",
)

RESULTS = Path("results/study")
PAPER = RESULTS / "paper"
STUDIES = {
    "stability": "apertura_research.stability.summary:STUDY",
    "error_atlas": "apertura_research.error_atlas.summary:STUDY",
    "autofocus": "apertura_research.autofocus.charts:STUDY",
}
"""Name of a sweep → location of its `Study`; results are written to a folder of that name."""

_LOSS = "losses:loss_claims"
PAPER_PARTS = {
    "parameters": "parameters:parameter_claims",
    "effects": "losses:effect_claims",
    "resolution": "resolution:simulated_table",
    "uav_resolution": "resolution:uav_table",
    "coherence": "experiments:coherence_claims",
    "fusion": "fusion:fusion_claims",
    **{f"loss_{error}": _LOSS for error in ("carrier_phase", "timing", "cfo", "sfo", "localization")},
    "positions": "corrections:position_claims",
    "corrected": "corrections:corrected_claims",
    "clock": "corrections:clock_claims",
    "swarm": "corrections:swarm_claims",
}
"""Part of claims.csv, in the order of its rows → function that computes it; a part `loss_…` passes the name of its
error as argument.
"""

PAPER_READS = {"coherence": ("lab", "static"), "fusion": ("uav",)}
"""Part → experiments whose campaigns the part reads from the folder `CAMPAIGNS`."""

CAMPAIGNS = "campaigns"

PAPER_FIGURES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("no_errors", "sfo", "cfo", "carrier_phase", "timing", "localization", "scene"), ()),
    **dict.fromkeys(("lab_profile", "lab_phase"), ("lab",)),
    **dict.fromkeys(("static_profile", "static_phase"), ("static",)),
    **dict.fromkeys(("uav_geometry", "uav_images", "uav_cuts"), ("uav",)),
}
"""The paper's figures with data, in the order of the paper → experiments whose campaigns they show."""

Folder = Annotated[Path, typer.Option("--folder", callback=given, help="output folder")]
StudyName = Annotated[str, typer.Argument(metavar="study", help=f"one of {', '.join(STUDIES)}")]
StudyFolder = Annotated[
    Path | None,
    typer.Option("--folder", help="output folder", show_default="results/study/STUDY"),
]


def study_of(name: str) -> "Study[Any]":
    """Return a study of `STUDIES`.

    Raises
    ------
    CampaignError
        If no study has that name.
    """
    require("study", name, STUDIES)
    study: Study[Any] = pkgutil.resolve_name(STUDIES[name])
    return study


@app.command()
def paper_part(part: str, folder: Folder = PAPER) -> None:
    """Compute one part of the claims table: parts/PART.csv."""
    from apertura.common.tables import write_table

    require("part", part, PAPER_PARTS)
    path = folder / "parts" / f"{part}.csv"
    claims = pkgutil.resolve_name(f"apertura_research.paper.{PAPER_PARTS[part]}")
    error = [part.removeprefix("loss_")] if PAPER_PARTS[part] == _LOSS else []
    write_table(path, claims(*error, *([folder / CAMPAIGNS] if part in PAPER_READS else [])))
    typer.echo(path)


def require(kind: str, name: str, choices: Collection[str]) -> None:
    """Raise CampaignError with the available choices unless a name is one of them."""
    if name not in choices:
        heads, tails = (dict.fromkeys(one.partition(".")[part] for one in choices) for part in (0, 2))
        expected = f"one of {', '.join(heads)}" + (f", each with .{', .'.join(tails)}" if any(tails) else "")
        raise CampaignError(f"{kind} {name!r}", where="apertura study", expected=expected, remedy="Choose one of them.")


@app.command()
def paper_claims(folder: Folder = PAPER) -> None:
    """Merge the parts of the claims table: claims.csv."""
    from apertura.common.tables import read_table, write_table
    from apertura_research.paper.claims import Claim

    path = folder / "claims.csv"
    write_table(path, [row for part in PAPER_PARTS for row in read_table(folder / "parts" / f"{part}.csv", Claim)])
    typer.echo(path)


@app.command()
def paper_figure(name: str, folder: Folder = PAPER) -> None:
    """Draw one figure of the paper: NAME.png."""
    require("figure", name, PAPER_FIGURES)
    path = folder / f"{name}.png"
    if PAPER_FIGURES[name]:
        from apertura_research.paper.figures import DRAWN

        DRAWN[name](folder / CAMPAIGNS, path)
    else:
        from apertura_research.paper.figures import draw_scene, draw_simulated

        draw_scene(path) if name == "scene" else draw_simulated(name, path)
    typer.echo(path)


def _results(name: str, folder: Path | None) -> Path:
    return given(RESULTS / name if folder is None else folder)


@app.command()
def sweep(name: StudyName, part: str, folder: StudyFolder = None) -> None:
    """Run one part of a study: parts/PART.csv; a killed run resumes after its last finished case."""
    study = study_of(name)
    require("part", part, study.parts)
    typer.echo(study.compute(part, _results(name, folder)))


@app.command()
def chart(name: StudyName, chart: str, folder: StudyFolder = None) -> None:
    """Merge the parts of a chart and draw the chart: CHART.csv and CHART.png."""
    study = study_of(name)
    require("chart", chart, study.charts)
    typer.echo(study.chart(chart, _results(name, folder)))


@app.command()
def summary(name: StudyName, folder: StudyFolder = None) -> None:
    """Write the summary tables and plot of all parts of a study."""
    study = study_of(name)
    require("study with a summary", name, [one for one in STUDIES if study_of(one).summaries])
    for path in study.summary(_results(name, folder)):
        typer.echo(path)


@app.command()
def autofocus_picture(scene: str, folder: Folder = RESULTS / "autofocus") -> None:
    """Draw one case of a scene before and after autofocus, with its track errors: SCENE.png."""
    from apertura_research.autofocus.charts import draw_case
    from apertura_research.autofocus.outcomes import KINDS

    require("scene", scene, KINDS)
    draw_case(scene, folder / f"{scene}.png")
    typer.echo(folder / f"{scene}.png")
