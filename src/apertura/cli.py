"""The command line: one subcommand per step, and whole campaigns."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from apertura import __version__
from apertura.campaign import Campaign
from apertura.errors import CampaignError
from apertura.study.commands import app as study

app = typer.Typer(no_args_is_help=True, add_completion=False, help="SAR images from campaign folders.")
step = typer.Typer(no_args_is_help=True, help="One step of the pipeline, as the workflow runs it.")
app.add_typer(step, name="step")
app.add_typer(study, name="study")

Directory = Annotated[Path, typer.Option("--campaign", help="campaign folder")]
Threads = Annotated[int, typer.Option(min=1, help="tiles formed at once")]
HERE = Path()


def main() -> None:
    """Run the command line; what a person has to mend is said in one message, without a traceback."""
    try:
        app()
    except CampaignError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


@app.command()
def version() -> None:
    """Print the version."""
    print(__version__)


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def run(
    context: typer.Context,
    campaign: Annotated[Path, typer.Argument(help="campaign folder")],
    cores: Annotated[int, typer.Option(help="cores to use")] = os.cpu_count() or 1,
) -> None:
    """Run the workflow on a campaign folder; further options go to snakemake."""
    raise SystemExit(_snakemake(campaign, cores, *context.args))


def _snakemake(campaign: Path, cores: int, *arguments: str) -> int:
    """Run the workflow; return its exit status."""
    Campaign.load(campaign).check_files()
    root = _workflow_folder()
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(root / "Snakefile"), "--directory", str(campaign)]
    command += ["--workflow-profile", str(root / "profiles" / "default"), "--cores", str(cores), *arguments]
    here = Path(sys.executable).parent  # rules call `apertura`, which need not be on the caller's PATH
    environment = {**os.environ, "PATH": f"{here}{os.pathsep}{os.environ.get('PATH', os.defpath)}"}
    return subprocess.run(command, check=False, env=environment).returncode


def _workflow_folder() -> Path:
    """Return where the root Snakefile lies: inside the installed package, or beside its sources."""
    package = Path(__file__).parent
    return next(root for root in (package / "_workflow", package.parents[1]) if (root / "Snakefile").is_file())


@app.command()
def plan(campaign: Annotated[Path, typer.Argument(help="campaign folder")], threads: Threads = 1) -> None:
    """Print how each pair would be imaged, why, how exactly and at what cost; nothing is run."""
    from apertura.steps.plan import print_plan

    print_plan(Campaign.load(campaign), threads=threads)


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def chart(
    context: typer.Context,
    campaign: Annotated[Path, typer.Argument(help="campaign folder")],
    cores: Annotated[int, typer.Option(help="cores to use")] = os.cpu_count() or 1,
) -> None:
    """Time and measure every engine and setting on the campaign: results/study/speed_accuracy.{png,html,csv}."""
    status = _snakemake(campaign, cores, *context.args, "speed_accuracy")
    if status == 0:
        print(*(campaign / f"results/study/speed_accuracy.{suffix}" for suffix in ("png", "html", "csv")), sep="\n")
    raise SystemExit(status)


@app.command("calibrate-cost")
def calibrate_cost() -> None:
    """Measure what imaging costs on this machine, for the planner; takes less than a minute."""
    from apertura.planning.calibration import measure_costs
    from apertura.planning.machine import write_costs

    costs = measure_costs()
    for name, seconds in sorted(costs.seconds.items()):
        print(f"{name:<24}{1e9 * seconds:>12.3g} ns")
    print(write_costs(costs), "(a campaign that ran keeps its own: delete its results/costs.json to plan anew)")


@app.command()
def verify(
    campaign: Annotated[Path, typer.Argument(help="campaign folder with truth.json")], paths: bool = True
) -> None:
    """Compare where point targets are found with where they were put, and print the products' paths."""
    from apertura.steps.verify import print_findings

    print_findings(Campaign.load(campaign), paths=paths)


@app.command()
def init(directory: Annotated[Path, typer.Argument(help="folder to make")]) -> None:
    """Write the commented config of a new campaign folder."""
    from apertura.settings.template import config_template, flights_template

    folder = directory / "config"
    for path, text in ((folder / "config.yaml", config_template()), (folder / "flights.tsv", flights_template())):
        if path.exists():
            raise CampaignError("exists already", path, "a new folder", "Choose another folder; nothing was changed.")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        print(path)


@app.command()
def simulate(
    directory: Annotated[Path, typer.Argument(help="campaign folder to make")],
    seed: Annotated[int, typer.Option(help="of the random generator")] = 1,
) -> None:
    """Write a small tandem flight as a campaign folder of raw IQ, with truth.json."""
    import numpy as np

    from apertura.simulation.presets import tandem_demo

    print(tandem_demo(directory, np.random.default_rng(seed)))


@step.command()
def ingest(flight: str, node: str, campaign: Directory = HERE) -> None:
    """Read a node's recording and flight log into raw.zarr and track.zarr."""
    from apertura.steps import ingest as steps

    print(*steps.ingest(Campaign.load(campaign), flight, node), sep="\n")


@step.command()
def echo(flight: str, pair: str, campaign: Directory = HERE) -> None:
    """Turn recordings of a pair into calibrated transfer functions, echo.zarr."""
    from apertura.steps import echo as steps

    print(steps.echo(Campaign.load(campaign), flight, pair))


@step.command()
def calibrate(flight: str, campaign: Directory = HERE) -> None:
    """Estimate the path offsets of a calibration flight's pairs, calibration.json."""
    from apertura.steps import calibration as steps

    print(steps.calibrate(Campaign.load(campaign), flight))


@step.command()
def scene(campaign: Directory = HERE) -> None:
    """Settle the campaign's grid, scene.json."""
    from apertura.steps import scene as steps

    print(steps.scene(Campaign.load(campaign)))


@step.command()
def costs(campaign: Directory = HERE) -> None:
    """Keep what imaging costs on this machine as the campaign's, costs.json."""
    from apertura.steps import costs as steps

    print(steps.costs(Campaign.load(campaign)))


@step.command()
def terrain(campaign: Directory = HERE) -> None:
    """Bring the DEM onto the campaign's grid, terrain.zarr."""
    from apertura.steps import terrain as steps

    print(steps.terrain(Campaign.load(campaign)))


@step.command()
def layers(campaign: Directory = HERE, threads: Threads = 1) -> None:
    """Write incidence, bistatic angle and the mask of shadow and layover as GeoTIFFs."""
    from apertura.steps import layers as steps

    print(*steps.layers(Campaign.load(campaign), threads=threads), sep="\n")


@step.command()
def profile(flight: str, pair: str, campaign: Directory = HERE) -> None:
    """Compress a pair in range over the scene, profile.zarr."""
    from apertura.steps import profile as steps

    print(steps.profile(Campaign.load(campaign), flight, pair))


@step.command()
def image(flight: str, pair: str, campaign: Directory = HERE, threads: Threads = 1) -> None:
    """Focus a pair's image, image.zarr and image.json."""
    from apertura.steps import image as steps

    print(steps.image(Campaign.load(campaign), flight, pair, threads=threads))


@step.command()
def tiles(flight: str, pair: str, share: str, campaign: Directory = HERE, threads: Threads = 1) -> None:
    """Form one job's share of a pair's tiles, '2-of-8'; step image finishes them."""
    from apertura.steps import image as steps

    print(steps.tiles(Campaign.load(campaign), flight, pair, share, threads=threads))


@step.command("chart")
def step_chart(flight: str, pair: str, campaign: Directory = HERE, seconds: float = 60.0) -> None:
    """Time and measure every engine and setting on a pair, for at most so many seconds."""
    from apertura.study.chart.speed_accuracy import speed_accuracy

    print(*speed_accuracy(Campaign.load(campaign), flight, pair, seconds=seconds), sep="\n")


@step.command()
def cube(campaign: Directory = HERE) -> None:
    """Stack and add up every image, cube.zarr."""
    from apertura.steps import cube as steps

    print(steps.cube(Campaign.load(campaign)))


@step.command()
def export(flight: str, pair: str, campaign: Directory = HERE) -> None:
    """Write GeoTIFFs and the quicklook of a pair, or of 'fused'."""
    from apertura.steps import export as steps

    loaded = Campaign.load(campaign)
    written = steps.export_fused(loaded, flight) if pair == "fused" else steps.export(loaded, flight, pair)
    print(*written, sep="\n")
