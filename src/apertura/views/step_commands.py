"""`apertura step`: one command per rule of the workflow, for a person to paste."""

import pkgutil
from pathlib import Path
from typing import Annotated

import typer

from apertura.common.processes import as_typed, given
from apertura.common.progress import progress_path, reporting_to

app = typer.Typer(no_args_is_help=True, help="One step of the pipeline, as the workflow runs it.")

Directory = Annotated[Path, typer.Option("--campaign", help="campaign folder")]
Threads = Annotated[int, typer.Option(min=1, help="tiles formed at once")]
HERE = Path()


def _run(function: str, campaign: Path, *arguments: str, **options: object) -> None:
    """Run ``module:function`` on a campaign and print the paths that it wrote."""
    from apertura.pipeline.campaign import Campaign

    opened = Campaign.load(given(campaign))
    with reporting_to(opened.result(*progress_path([function.rpartition(":")[2], *arguments]))):
        written = pkgutil.resolve_name(function)(opened, *arguments, **options)
    for path in [written] if isinstance(written, Path) else written:
        print(as_typed(path))


@app.command()
def ingest(flight: str, node: str, campaign: Directory = HERE) -> None:
    """Read a node's recording and flight log into raw.zarr and track.zarr."""
    _run("apertura.pipeline.steps.ingest:ingest", campaign, flight, node)


@app.command()
def echo(flight: str, pair: str, campaign: Directory = HERE) -> None:
    """Turn recordings of a pair into calibrated transfer functions, echo.zarr."""
    _run("apertura.pipeline.steps.echo:echo", campaign, flight, pair)


@app.command()
def calibrate(flight: str, campaign: Directory = HERE) -> None:
    """Estimate the path offsets of a calibration flight's pairs, calibration.json."""
    _run("apertura.pipeline.steps.calibration:calibrate", campaign, flight)


@app.command()
def scene(campaign: Directory = HERE) -> None:
    """Settle the campaign's grid, scene.json."""
    _run("apertura.pipeline.steps.scene:scene", campaign)


@app.command()
def terrain(campaign: Directory = HERE) -> None:
    """Bring the DEM onto the campaign's grid, terrain.zarr."""
    _run("apertura.pipeline.steps.scene:terrain", campaign)


@app.command()
def layers(flight: str, pair: str, campaign: Directory = HERE, threads: Threads = 1) -> None:
    """Write incidence, bistatic angle, mask, looks and noise of a pair as GeoTIFFs."""
    _run("apertura.pipeline.steps.layers:layers", campaign, flight, pair, threads=threads)


@app.command()
def coverage(campaign: Directory = HERE) -> None:
    """Draw what every flight and pair covers, coverage.png and coverage.geojson."""
    _run("apertura.pipeline.steps.coverage:coverage", campaign)


@app.command("map")
def step_map(campaign: Directory = HERE) -> None:
    """Write what `apertura map` shows of every image in a browser, map/map.json."""
    _run("apertura.views.webmap.step:webmap", campaign)


@app.command()
def mosaic(campaign: Directory = HERE) -> None:
    """Lay each product of all flights upon one another, mosaic/<pair>/<product>.vrt."""
    _run("apertura.pipeline.steps.mosaic:mosaic", campaign)


@app.command()
def profile(flight: str, pair: str, campaign: Directory = HERE) -> None:
    """Compress a pair in range over the scene, profile.zarr."""
    _run("apertura.pipeline.steps.profile:profile", campaign, flight, pair)


@app.command()
def refine(flight: str, campaign: Directory = HERE) -> None:
    """Estimate errors of a flight's tracks from its images, where that pays, refined_track.zarr."""
    _run("apertura.pipeline.steps.refine:refine", campaign, flight)


@app.command()
def image(flight: str, pair: str, campaign: Directory = HERE, threads: Threads = 1) -> None:
    """Focus a pair's image, image.zarr."""
    _run("apertura.pipeline.steps.image:image", campaign, flight, pair, threads=threads)


@app.command()
def tiles(flight: str, pair: str, share: str, campaign: Directory = HERE, threads: Threads = 1) -> None:
    """Form one job's share of a pair's tiles, '2-of-8'; step image finishes them."""
    _run("apertura.pipeline.steps.image:tiles", campaign, flight, pair, share, threads=threads)


@app.command("chart")
def step_chart(flight: str, pair: str, campaign: Directory = HERE, seconds: float = 60.0) -> None:
    """Time and measure every engine and setting on a pair, for at most so many seconds."""
    _run("apertura.views.chart.speed_accuracy:speed_accuracy", campaign, flight, pair, seconds=seconds)


@app.command()
def whole_chart(campaign: Directory = HERE, repeats: Annotated[int, typer.Option(min=1)] = 3) -> None:
    """Time and measure the way from raw samples to GeoTIFFs under several settings, whole.csv and .png."""
    _run("apertura.views.chart.whole:whole_chart", campaign, repeats=repeats)


@app.command()
def assess(flight: str, campaign: Directory = HERE) -> None:
    """Compare the images of a flight with each other, and choose what is added up, assessment.json."""
    _run("apertura.pipeline.steps.assess:assess", campaign, flight)


@app.command()
def cube(campaign: Directory = HERE) -> None:
    """Stack and add up every image, cube.zarr."""
    _run("apertura.pipeline.steps.cube:cube", campaign)


@app.command()
def interferogram(name: str, campaign: Directory = HERE) -> None:
    """Compare two images in phase: coherence, unwrapped phase and heights, by a name of interferometry.pairs."""
    _run("apertura.pipeline.steps.interferogram:interferogram", campaign, name)


@app.command()
def cphd(flight: str, pair: str, campaign: Directory = HERE) -> None:
    """Write the calibrated transfer functions of a pair for other processors, phase_history.cphd."""
    _run("apertura.pipeline.steps.cphd:cphd", campaign, flight, pair)


@app.command()
def pictures(flight: str, pair: str, campaign: Directory = HERE) -> None:
    """Draw what the report shows of a pair: geometry, pulses, phase, cuts, range profiles, budget."""
    _run("apertura.views.report.pictures:pictures", campaign, flight, pair)


@app.command()
def page(flight: str, campaign: Directory = HERE) -> None:
    """Write what the report says of a flight, report.html, which prints."""
    _run("apertura.views.report.step:page", campaign, flight)


@app.command()
def export(flight: str, pair: str, campaign: Directory = HERE) -> None:
    """Write GeoTIFFs and the quicklook of a pair, or of 'fused'."""
    _run("apertura.pipeline.steps.export:export", campaign, flight, pair)


@app.command()
def stac(campaign: Directory = HERE) -> None:
    """Describe every image in a static STAC catalog, stac/catalog.json."""
    _run("apertura.pipeline.steps.stac:stac", campaign)


@app.command()
def ro_crate(campaign: Directory = HERE) -> None:
    """Tell the whole run, with every file and command, as an RO-Crate, ro-crate-metadata.json."""
    _run("apertura.pipeline.steps.ro_crate:ro_crate", campaign)
