"""Command line: the workflow of a campaign, one subcommand per step, and further tools.

Commands import their modules on execution; help texts and usage errors therefore load no library.
"""

import os
import shlex
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from inspect import Parameter, Signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

from apertura import __version__
from apertura.common.errors import CampaignError, explained
from apertura.common.processes import (
    INTERRUPTED,
    SIGNALLED,
    Interrupted,
    as_typed,
    ended_by_signals,
    given,
    leave_status,
)
from apertura.common.progress import progress_path, reporting_to
from apertura.workflow.rules import RULES, Rule

if TYPE_CHECKING:
    from apertura.campaign.folder import Campaign
    from apertura.run.driver import Show

PASS_ON = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Click settings of a command that passes unknown options to snakemake."""


class Commands(TyperGroup):
    """Commands of apertura and of installed plugins; plugins are searched only for names unknown to apertura."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command by its name, None if there is none."""
        if cmd_name not in self.commands:
            self._add_installed()
        if cmd_name == "study" and "study" not in self.commands:
            raise CampaignError(
                "the studies are not installed",
                where="apertura study",
                expected="the distribution apertura-research",
                remedy="Install it from the source tree of apertura: `pip install ./research`.",
            )
        return super().get_command(ctx, cmd_name)

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands."""
        self._add_installed()
        return super().list_commands(ctx)

    def _add_installed(self) -> None:
        from importlib.metadata import entry_points  # takes 20 ms, which the jobs of a run avoid

        for point in entry_points(group="apertura.commands"):
            if point.name not in self.commands:
                self.commands[point.name] = group = get_group(point.load())
                group.name, group.hidden = point.name, True


# ---- apertura step: one command per row of RULES ---------------------------------------------------------------------

step = typer.Typer(no_args_is_help=True, help="Run a single step in the same way as the workflow.")

Directory = Annotated[Path, typer.Option("--campaign", help="campaign folder")]
Threads = Annotated[int, typer.Option(min=1, help="number of tiles processed in parallel")]

_OPTIONS: dict[str, tuple[Any, Any]] = {
    "threads": (Threads, 1),
    "seconds": (float, 60.0),
    "repeats": (Annotated[int, typer.Option(min=1)], 3),
}
"""Option of a step → its type and its default."""


def _command_of(rule: Rule) -> Callable[..., None]:
    """Return the command of a rule; its parameters are the rule's arguments, the campaign folder and the options."""

    def command(campaign: Path, **values: Any) -> None:
        from apertura.campaign.folder import Campaign

        opened, arguments = Campaign.load(given(campaign)), [values.pop(name) for name in rule.arguments]
        with reporting_to(opened.result(*progress_path([rule.command, *arguments]))):
            written = rule.step(opened, *arguments, **values)
        for path in [written] if isinstance(written, Path) else written:
            print(as_typed(path))

    parameters: dict[str, tuple[Any, Any]] = dict.fromkeys(rule.arguments, (str, Parameter.empty))
    parameters |= {"campaign": (Directory, Path()), **{name: _OPTIONS[name] for name in rule.options}}
    command.__doc__ = rule.help
    command.__annotations__ = {name: annotation for name, (annotation, _) in parameters.items()}
    command.__signature__ = Signature(  # type: ignore[attr-defined]
        [
            Parameter(name, Parameter.POSITIONAL_OR_KEYWORD, default=default, annotation=annotation)
            for name, (annotation, default) in parameters.items()
        ]
    )
    return command


_first_rows: dict[str, Rule] = {}
for _row in RULES.values():
    if _first_rows.setdefault(_row.command, _row) is _row:  # two rules run `export`
        step.command(_row.command)(_command_of(_row))


# ---- Commands --------------------------------------------------------------------------------------------------------

app = typer.Typer(cls=Commands, no_args_is_help=True, help="SAR images from campaign folders.")
app.add_typer(step, name="step", hidden=True)  # for the rules, and to repeat a single step


CampaignFolder = Annotated[Path, typer.Argument(help="campaign folder, default: current directory", show_default=False)]
Cores = Annotated[int, typer.Option(min=1, help="number of CPU cores")]
Paranoid = Annotated[
    bool, typer.Option("--paranoid", help="recompute the hash of every input, even if the file times are unchanged")
]
HERE = Path()
ALL_CORES = os.cpu_count() or 1


class _PassesOn(TyperCommand):
    """Command that passes unknown options to snakemake."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse arguments after separating short options from their values and repeating `--until` for each step.

        Otherwise click would interpret the letters of a value, as in `-sFILE`, as options of apertura. snakemake
        accepts several step names after one `--until`; click accepts a single value.
        """
        from apertura.run.driver import UNTIL, apart
        from apertura.workflow.rules import RULES

        words: list[str] = []
        for word in (word for one in args for word in apart(one)):
            if word in RULES and len(words) > 1 and words[-2] in UNTIL and words[-1] in RULES:
                words.append(words[-2])
            words.append(word)
        return super().parse_args(ctx, words)


def _opened(campaign: Path) -> "Campaign":
    from apertura.campaign.folder import Campaign

    return Campaign.load(given(campaign))


_UNREAD = SIGNALLED + signal.SIGPIPE
"""Exit status, without a message, if the reader of the output has closed the pipe, as `head` does."""


def main() -> None:
    """Run the command line; exit with 0, 2 (user error, one message), 130 (signal) or 1 (internal error)."""
    with ended_by_signals():
        try:
            app()
        except CampaignError as error:
            from apertura.campaign.config import located

            _print_error(located(as_typed(error)))
            leave_status(2)
            raise SystemExit(2) from None
        except Interrupted as interrupt:
            _print_error(str(interrupt.code))
            raise SystemExit(INTERRUPTED) from None
        except SystemExit as leaving:
            if isinstance(leaving.__context__, BrokenPipeError):  # typer turns a closed pipe into exit status 1
                raise SystemExit(_UNREAD) from None
            raise
        except BrokenPipeError:
            raise SystemExit(_UNREAD) from None
        except Exception as error:
            message = explained(error)
            leave_status(2 if message else 1)
            if message is None:
                raise
            _print_error(message)
            raise SystemExit(2) from None
        finally:
            _flush()


def _flush() -> None:
    """Flush the output; if the pipe is closed or the disk is full, discard the output, so that the exit succeeds."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _print_error(message: str) -> None:
    """Print an error message; ignore a closed or full error stream."""
    with suppress(OSError):
        print(f"error: {message}", file=sys.stderr, flush=True)


def _print_version(requested: bool) -> None:
    if requested:
        print(__version__)
        raise typer.Exit


@app.callback()
def _options(
    _: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@app.command()
def inspect(
    path: Annotated[
        Path, typer.Argument(help="recording, flight log, phase history, DEM, other folder or campaign folder")
    ],
    *,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="setting that the log does not contain; a key of nodes.<n>.log"
        ),
    ] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE.png", help="also write a plot")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """Describe a file or folder: type, times, rates, gaps, fix, bounds, and information missing for an image."""
    picture = None if plot is None else given(plot)
    from apertura.views.inspect.path import inspect_path

    raise typer.Exit(inspect_path(given(path), settings or (), name=path, plot=picture, as_json=as_json))


@app.command()
def align(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="[CAMPAIGN] FLIGHT NODE",
            help="campaign folder (default: current directory), flight, and node that transmits and receives",
        ),
    ],
    *,
    point: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="position of a reflector: easting, northing in scene.crs, ellipsoidal height (local frame: z), m"
        ),
    ] = None,
    search_s: Annotated[
        float | None, typer.Option(min=0, help="half width of the search range of the clock offset, s")
    ] = None,
    search_m: Annotated[
        float, typer.Option(min=0, help="half width of the search range of the path offset, m of total path")
    ] = 10.0,
    drift: Annotated[bool, typer.Option("--drift", help="estimate the clock drift as well")] = False,
    keep_path: Annotated[bool, typer.Option("--keep-path", help="keep the configured path offset")] = False,
    write: Annotated[bool, typer.Option("--write", help="write the result to config/clocks.tsv")] = False,
) -> None:
    """Estimate the clock offset (recorder to flight log) and the path offset by maximising the focus of echoes."""
    if len(words) not in {2, 3}:
        raise CampaignError(" ".join(words), "align", "[CAMPAIGN] FLIGHT NODE", "Name flight and node.")
    *folder, flight, node = words
    opened = _opened(Path(*folder))
    from apertura.tools.align import print_alignment

    search = {"point": point, "search_s": search_s, "search_m": 0.0 if keep_path else search_m, "drift": drift}
    print_alignment(opened, flight, node, write=write, **search)


@app.command(cls=_PassesOn, context_settings=PASS_ON)
def run(
    context: typer.Context,
    campaign: CampaignFolder = HERE,
    cores: Cores = ALL_CORES,
    *,
    paranoid: Paranoid = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="print only errors and the paths of products")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="print the whole output of snakemake")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", "-n", help="dry run: list the steps without running them")
    ] = False,
    until: Annotated[
        list[str] | None,
        typer.Option("--until", "-U", metavar="STEP …", help="stop after these steps: image, export, cube, …"),
    ] = None,
    profile: Annotated[
        str | None,
        typer.Option(metavar="PROFILE", help="snakemake profile: profiles/slurm, or the folder of another profile"),
    ] = None,
    set_scatter: Annotated[
        list[str] | None,
        typer.Option("--set-scatter", metavar="tiles=N", help="distribute the tiles of each image over N jobs"),
    ] = None,
) -> None:
    """Run the workflow on a campaign folder; other options and targets are passed to snakemake."""
    show: Show = "snakemake" if verbose else "errors" if quiet else "steps"
    arguments = [*context.args, *(["-n"] if dry_run else []), *(["--until", *until] if until else [])]
    arguments += ["--profile", profile] if profile else []
    arguments += ["--set-scatter", *set_scatter] if set_scatter else []
    _run(campaign, cores, *arguments, paranoid=paranoid, show=show)


def _run(campaign: Path, cores: int, *arguments: str, paranoid: bool = False, show: "Show" = "steps") -> None:
    from apertura.run.driver import run_workflow
    from apertura.workflow.stale import forms_results

    status = run_workflow(given(campaign), cores, *arguments, paranoid=paranoid, show=show)
    if status == 0 and forms_results(["", *arguments]):
        opened = _opened(campaign)
        from apertura.views.summary import is_finished, print_benches, print_products, print_summary, print_unfinished

        print_benches(opened)
        if not is_finished(opened):  # after `--until`
            print_unfinished(opened)
        elif opened.image_flights:
            print_products(opened) if show == "errors" else print_summary(opened)
    raise SystemExit(status)


@app.command()
def preview(
    campaign: CampaignFolder = HERE,
    cores: Cores = ALL_CORES,
    *,
    follow: Annotated[
        bool, typer.Option("--follow", help="update the images while recordings grow, then run the workflow")
    ] = False,
    every: Annotated[float, typer.Option(min=1, help="interval between updates, s")] = 5.0,
    end_after: Annotated[
        float, typer.Option(min=1, help="time without growth after which a recording is considered finished, s")
    ] = 10.0,
    run_after: Annotated[
        bool, typer.Option("--run/--no-run", help="run the workflow when the recordings are finished")
    ] = True,
) -> None:
    """Form images from the pulses recorded so far; with --follow, Ctrl-C stops the updates and starts the workflow."""
    opened = _opened(campaign)
    from apertura.tools.preview.follow import run_preview

    run_preview(opened, follow=follow, every_s=every, end_after_s=end_after, threads=cores)
    if follow and run_after:
        _run(campaign, cores)


@app.command()
def status(campaign: CampaignFolder = HERE) -> None:
    """Print the progress of a run in another terminal: finished, running and pending steps, time left, last error."""
    opened = _opened(campaign)
    from apertura.run.screen import print_status

    print_status(opened)


@app.command("list")
def list_results(campaign: CampaignFolder = HERE) -> None:
    """List flights and pairs, with state (finished, out of date or missing) and size of the results."""
    opened = _opened(campaign)
    from apertura.run.results import print_list

    print_list(opened)


@app.command()
def clean(
    campaign: CampaignFolder = HERE,
    wip: Annotated[bool, typer.Option("--wip", help="remove only unfinished files of a run that was killed")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="do not ask for confirmation")] = False,
) -> None:
    """Remove all files written by the workflow, and no others; refused during a run of the campaign."""
    opened = _opened(campaign)
    from apertura.run.results import clean as remove_results

    remove_results(opened, unfinished_only=wip, agreed=yes)


@app.command()
def check(
    campaign: CampaignFolder = HERE,
    products: Annotated[
        bool, typer.Option("--products", help="also read every byte of the results, to detect damage")
    ] = False,
    paranoid: Paranoid = False,
) -> None:
    """List all errors in a campaign folder, one per line, and all results that are out of date; run no step."""
    from apertura.check import print_findings

    raise SystemExit(2 if print_findings(given(campaign), products=products, paranoid=paranoid) else 0)


@app.command()
def plan(campaign: CampaignFolder = HERE, threads: Threads = 1) -> None:
    """Print engine, settings, reasons, predicted accuracy and cost of the image of each pair; run no step."""
    opened = _opened(campaign)
    from apertura.views.plan import print_plan

    print_plan(opened, threads=threads)


@app.command()
def design(
    plan: Annotated[
        Path, typer.Argument(metavar="PLAN.yaml", help="flight plan: radar, nodes with planned tracks, scene")
    ],
    out: Annotated[
        Path | None, typer.Argument(help="folder for layers, tracks, map and report", show_default=False)
    ] = None,
    *,
    optimise: Annotated[
        str | None,
        typer.Option(
            metavar="QUANTITIES",
            help="first optimise the tracks within the bounds of the plan; any of height,offset,spacing,heading",
        ),
    ] = None,
    threads: Threads = 1,
) -> None:
    """Predict resolution, noise, coverage and data volume of a planned flight, and compare them with requirements."""
    path, folder = given(plan), None if out is None else given(out)
    from apertura.tools.design.view import print_design

    raise typer.Exit(0 if print_design(path, folder, optimise=optimise, threads=threads) else 2)


@app.command()
def compare(
    plan: Annotated[Path, typer.Argument(metavar="PLAN.yaml", help="flight plan of `apertura design`")],
    campaign: CampaignFolder = HERE,
    threads: Threads = 1,
) -> None:
    """Compare a flight plan with the logs of a campaign and, if available, with its images."""
    path, folder = given(plan), given(campaign)
    from apertura.tools.design.view import print_comparison

    print_comparison(path, folder, threads=threads)


@app.command(context_settings=PASS_ON)
def chart(context: typer.Context, campaign: CampaignFolder = HERE, cores: Cores = ALL_CORES) -> None:
    """Measure speed and accuracy of all engines and settings; write results/study/speed_accuracy.{png,html,csv}."""
    from apertura.run.driver import run_workflow

    status = run_workflow(given(campaign), cores, *context.args, "speed_accuracy")
    if status == 0:
        print(*(campaign / f"results/study/speed_accuracy.{suffix}" for suffix in ("png", "html", "csv")), sep="\n")
    raise SystemExit(status)


@app.command()
def summary(campaign: CampaignFolder = HERE) -> None:
    """Print the quality of every finished image: focus, agreement, numerical error, flags."""
    opened = _opened(campaign)
    from apertura.views.summary import print_stale, print_summary

    print_summary(opened)
    print_stale(opened)


@app.command()
def score(
    campaign: Annotated[
        Path, typer.Argument(help="campaign folder with truth.json, default: current directory", show_default=False)
    ] = HERE,
    paths: Annotated[bool, typer.Option("--paths", help="list the files of all products as well")] = False,
) -> None:
    """Compare the measured positions of point targets with their true positions."""
    opened = _opened(campaign)
    from apertura.views.score import print_findings
    from apertura.views.summary import print_stale

    print_findings(opened, paths=paths)
    print_stale(opened)


@app.command()
def bench(
    campaign: CampaignFolder = HERE,
    write: Annotated[
        bool, typer.Option("--write", help="write the measured path offsets to config/config.yaml")
    ] = False,
) -> None:
    """Check channels, clocks, coherence and path lengths of a stationary or cabled radar against limits.

    The exit code is 2 if a measurement exceeds its limit.
    """
    opened = _opened(campaign)
    from apertura.tools.bench.report import print_bench

    raise SystemExit(2 if print_bench(opened, write=write) else 0)


@app.command()
def reflectors(
    campaign: CampaignFolder = HERE,
    to: Annotated[
        Path | None, typer.Option(metavar="FILE", help="output file, default: calibration.json in the campaign folder")
    ] = None,
) -> None:
    """Measure the calibration constant of each pair at reflectors of known cross-section, for later campaigns."""
    opened, path = _opened(campaign), None if to is None else given(to)
    from apertura.tools.reflectors import write_constants

    print(as_typed(write_constants(opened, path)))


export = typer.Typer(no_args_is_help=True, help="Write results in the layout of other software.")
app.add_typer(export, name="export")


@export.command("stack")
def export_stack(
    campaign: CampaignFolder = HERE,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="folder to write, default: time_series in the campaign folder")
    ] = None,
) -> None:
    """Write the stack of a campaign as images, mask, geometry and configuration for dolphin."""
    opened, folder = _opened(campaign), given(campaign / "time_series" if out is None else out)
    from apertura.tools.export_stack import write_stack

    print(*map(as_typed, write_stack(opened, folder)), sep="\n")


@export.command("time-series")
def export_time_series(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder of `apertura export stack` with a dolphin run")],
) -> None:
    """Write the result of dolphin as inputs of MintPy and as a point layer for QGIS (InSAR Explorer)."""
    path = given(folder)
    from apertura.tools.time_series import write_time_series

    print(*map(as_typed, write_time_series(path)), sep="\n")


@app.command()
def payload(campaign: CampaignFolder = HERE) -> None:
    """Read the data that the frames of a campaign carry: bits, errors and data rate of each node, over time."""
    opened = _opened(campaign)
    from apertura.tools.payload import print_payload

    print(*map(as_typed, print_payload(opened)), sep="\n")


@app.command()
def verify(
    product: Annotated[
        Path,
        typer.Argument(
            help="file, stage or manifest of a campaign, or a campaign folder, default: current directory",
            show_default=False,
        ),
    ] = HERE,
    *,
    campaign: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="campaign folder of a file that was copied elsewhere")
    ] = None,
    crate: Annotated[
        bool, typer.Option("--crate", help="verify a copy of results/ against its RO-Crate and STAC catalog")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="print only differences")] = False,
) -> None:
    """Verify the provenance of a product down to the raw samples: list each file as unchanged, changed or missing."""
    if crate:
        from apertura.views.verify.chain import print_checked

        raise typer.Exit(print_checked(given(product), quiet=quiet))
    folder = None if campaign is None else given(campaign)
    from apertura.views.verify.chain import print_verified

    raise typer.Exit(print_verified(given(product), folder, quiet=quiet))


@app.command()
def reproduce(
    product: Annotated[
        Path,
        typer.Argument(
            help="file, stage or manifest of a campaign, or a campaign folder, default: current directory",
            show_default=False,
        ),
    ] = HERE,
    *,
    cores: Cores = ALL_CORES,
    keep: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="new folder in which the reproduced files are kept; default: temporary folder in TMPDIR",
        ),
    ] = None,
) -> None:
    """Recompute a product from the raw samples in another folder, and compare it byte for byte with the original."""
    kept = None if keep is None else given(keep)
    from apertura.views.verify.diff import print_reproduced

    raise typer.Exit(print_reproduced(given(product), cores=cores, keep=kept))


@app.command()
def diff(
    first: Annotated[Path, typer.Argument(help="raster, picture, stage or report")],
    second: Annotated[
        Path, typer.Argument(help="product to compare with the first, from the same or another campaign")
    ],
    *,
    whole: Annotated[bool, typer.Option("--all", help="print every line of long sections")] = False,
) -> None:
    """Compare two products: geometry, settings, inputs, stages, code, software, flags and pixels."""
    from apertura.views.verify.diff import print_differences

    raise typer.Exit(print_differences(given(first), given(second), whole=whole))


@app.command("publish")
def publish_results(
    campaign: Annotated[Path, typer.Argument(help="campaign folder")],
    url: Annotated[str, typer.Argument(metavar="URL", help="target, such as s3://bucket/prefix")],
    *,
    href: Annotated[
        str, typer.Option(metavar="URL", help="address of the target for readers, if it differs from URL")
    ] = "",
    every: Annotated[bool, typer.Option("--all", help="publish intermediate results, too")] = False,
    raw: Annotated[bool, typer.Option("--raw", help="publish recordings and logs, too")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="list the changes without writing")] = False,
) -> None:
    """Copy changed results of a campaign to an object store, catalogs last; credentials are read from the environment.

    Objects of results that no longer exist are deleted. Recordings, logs and intermediate results are not published
    unless requested.
    """
    opened = _opened(campaign)
    from apertura.tools.publish import publish

    print(*publish(opened, url, href=href, every=every, raw=raw, dry_run=dry_run).lines, sep="\n")


@app.command()
def report(
    campaign: CampaignFolder = HERE,
    cores: Cores = ALL_CORES,
) -> None:
    """Write results/report.html: configuration, decisions, image quality and figures; readable offline."""
    from apertura.campaign.folder import Campaign
    from apertura.run.driver import run_workflow
    from apertura.views.report import PAGE
    from apertura.views.report.step import open_report

    campaign = given(campaign)
    opened = Campaign.load(campaign)
    opened.check_images()
    status = run_workflow(campaign, cores, "all", "pages")
    if status:
        raise SystemExit(status)
    with open_report(opened) as (temporary, style):
        arguments = ["--report", str(temporary), "--report-stylesheet", str(style)]
        status = run_workflow(campaign, 1, "all", "pages", *arguments, show="errors")
        if status:
            raise SystemExit(status)
    for path in (opened.result(PAGE), *(opened.result(flight.name, PAGE) for flight in opened.image_flights)):
        typer.echo(as_typed(path))


@app.command("map")
def map_page(
    campaign: CampaignFolder = HERE,
    *,
    port: Annotated[int, typer.Option(min=0, max=65535, help="port of the server; 0: any free port")] = 0,
    preview_: Annotated[bool, typer.Option("--preview", help="show the live images of `apertura preview`")] = False,
    open_: Annotated[bool, typer.Option("--open", help="open the map in the browser")] = False,
    tiles: Annotated[
        str | None,
        typer.Option(metavar="URL", help="background tiles, https://…/{z}/{x}/{y}.png; the only other host contacted"),
    ] = None,
    tiles_attribution: Annotated[
        str, typer.Option(metavar="TEXT", help="source of the tiles, named on the map and in exported pictures")
    ] = "",
    tiles_zoom: Annotated[int, typer.Option(min=0, max=24, help="highest zoom level of the tiles")] = 19,
) -> None:
    """Show a campaign on a map in a browser; the server is accessible only from this machine and runs until Ctrl-C."""
    opened = _opened(campaign)
    opened.check_images()
    from apertura.views.summary import print_stale
    from apertura.views.webmap.server import Tiles, served, served_look

    background = None if tiles is None else Tiles(tiles, tiles_attribution, tiles_zoom)
    if not preview_:
        print_stale(opened)
    (served_look if preview_ else served)(opened, tiles=background, port=port).show(in_browser=open_)


@app.command()
def init(
    directory: Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="folder to create")],
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FILES",
            help="recordings, flight logs, time tags, transmitted signal, DEM, and folders with such files",
            show_default=False,
        ),
    ] = None,
    *,
    kind: Annotated[
        str | None,
        typer.Option(help="kind of waveform: ofdm (default), samples, fmcw, phase_history", show_default=False),
    ] = None,
    from_: Annotated[
        Path | None, typer.Option("--from", metavar="PLAN.yaml", help="derive the config from this flight plan")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="value of a key of config.yaml that no file contains"),
    ] = None,
    side: Annotated[
        str | None, typer.Option(help="side of the track on which the scene lies: left, right or both (the default)")
    ] = None,
    transmitter: Annotated[str | None, typer.Option(metavar="NODE", help="node that transmits")] = None,
    assign: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE=[FLIGHT/]NODE", help="flight and node of a file, where its name is ambiguous"),
    ] = None,
    copy: Annotated[
        bool, typer.Option("--copy", help="copy files that could be cloned or hard-linked without using disk space")
    ] = False,
) -> None:
    """Create a campaign folder from recordings and logs, or with a config from a template or a flight plan.

    Values that no file contains are requested on a terminal; without an answer they are commented keys of the config.
    """
    if not files and (settings or side or transmitter or assign or copy):
        options, remedy = "--set, --side, --transmitter, --assign or --copy", "Name recordings and logs."
        raise CampaignError(f"{options} without files", "init", "files after the campaign folder", remedy)
    if files:
        words = {"settings": _pairs(settings, "--set"), "assign": _pairs(assign, "--assign")}
        chosen = {"transmitter": transmitter, "side": side, "kind": kind, "copy": copy}
        paths, folder = [given(path) for path in files], given(directory)
        words["assign"] = {str(given(Path(name))): target for name, target in words["assign"].items()}
        from apertura.tools.init import print_created

        raise SystemExit(print_created(folder, paths, directory, **words, **chosen))
    if from_ is not None:
        path, folder = given(from_), given(directory)
        from apertura.tools.design.flight_plan import read_flight_plan
        from apertura.tools.design.products import write_campaign_config

        print(*map(as_typed, write_campaign_config(read_flight_plan(path), folder)), sep="\n")
        print(_next_after_init(directory))
        return
    from apertura.campaign.config.template import config_template, flights_template
    from apertura.common.atomic import made_folder, write_text

    kind = kind or "ofdm"
    texts = {"config.yaml": config_template(kind), "flights.tsv": flights_template(kind)}
    folder = made_folder(given(directory)) / "config"
    for path, text in ((folder / name, text) for name, text in texts.items()):
        if path.exists():
            raise CampaignError("exists already", path, "a new folder", "Choose another folder; no file was changed.")
        write_text(path, text)
        print(as_typed(path))
    print(_next_after_init(directory))


def _pairs(words: list[str] | None, option: str) -> dict[str, str]:
    """Split words NAME=VALUE."""
    wrong = next((word for word in words or () if "=" not in word), None)
    if wrong is not None:
        raise CampaignError(wrong, option, "NAME=VALUE", "Correct the option.")
    return {name: value for name, _, value in (word.partition("=") for word in words or ())}


def _next_after_init(directory: Path) -> str:
    folder = shlex.quote(str(directory))
    return (
        "Next: describe radar, nodes and scene in config.yaml and the flights in flights.tsv, copy recordings and logs "
        f"to {folder}/raw/<flight>/, then run: apertura check {folder}"
    )


@app.command()
def simulate(
    paths: Annotated[
        list[Path] | None, typer.Argument(metavar="[SPEC.yaml] DIR", help="YAML specification, and folder to create")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="demo (the default), first-flight, paper, swarm, payload, continuous, flight (13.5 GB), "
            "paper-lab, paper-static, paper-uav, revisit"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="seed of the random generator")] = 1,
    print_spec: Annotated[
        str | None, typer.Option(metavar="PRESET", help="print the specification of a preset")
    ] = None,
) -> None:
    """Write a campaign folder with simulated raw samples and truth.json, from a YAML specification or a preset."""
    from apertura import simulation

    if print_spec is not None:
        print(simulation.specification_text(simulation.preset(print_spec)), end="")
        return
    paths = paths or []
    if len(paths) + (preset is not None) not in {1, 2} or not paths:
        typed = " ".join(map(str, paths)) + (f" --preset {preset}" if preset else "") or "no folder"
        raise CampaignError(typed, "simulate", "[SPEC.yaml] DIR, or DIR --preset PRESET", "Name a folder to create.")
    chosen = given(paths[0]) if len(paths) > 1 else simulation.preset(preset or "demo")
    print(as_typed(simulation.simulate(given(paths[-1]), chosen, seed=seed)))
