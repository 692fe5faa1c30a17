"""The command line: one subcommand per step, and campaigns from end to end.

Commands import what they run when they run: help and mistakes in the command line cost nothing.
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
"""Options that are not known go to snakemake."""


class Commands(TyperGroup):
    """Commands of apertura, and of other distributions: these are looked up only where no own command has the name."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command by its name, None where there is none."""
        if cmd_name not in self.commands:
            self._add_installed()
        if cmd_name == "study" and "study" not in self.commands:
            raise CampaignError(
                "the studies are not installed",
                where="apertura study",
                expected="the distribution apertura-research beside apertura",
                remedy="Install it from the source of apertura: `pip install ./research`.",
            )
        return super().get_command(ctx, cmd_name)

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands."""
        self._add_installed()
        return super().list_commands(ctx)

    def _add_installed(self) -> None:
        from importlib.metadata import entry_points  # 20 ms, which every job of a run would pay

        for point in entry_points(group="apertura.commands"):
            if point.name not in self.commands:
                self.commands[point.name] = group = get_group(point.load())
                group.name, group.hidden = point.name, True


# ---- apertura step: one command per rule, as rows of the rules say ---------------------------------------------------

step = typer.Typer(no_args_is_help=True, help="One step of the pipeline, as the workflow runs it.")

Directory = Annotated[Path, typer.Option("--campaign", help="campaign folder")]
Threads = Annotated[int, typer.Option(min=1, help="tiles formed at once")]

_OPTIONS: dict[str, tuple[Any, Any]] = {
    "threads": (Threads, 1),
    "seconds": (float, 60.0),
    "repeats": (Annotated[int, typer.Option(min=1)], 3),
}
"""Option of a step → its type and its default."""


def _command_of(rule: Rule) -> Callable[..., None]:
    """Return the command of a rule: its arguments, the campaign folder and its options."""

    def command(campaign: Path, **stated: Any) -> None:
        from apertura.campaign.folder import Campaign

        opened, words = Campaign.load(given(campaign)), [stated.pop(name) for name in rule.arguments]
        with reporting_to(opened.result(*progress_path([rule.command, *words]))):
            written = rule.step(opened, *words, **stated)
        for path in [written] if isinstance(written, Path) else written:
            print(as_typed(path))

    kinds: dict[str, tuple[Any, Any]] = dict.fromkeys(rule.arguments, (str, Parameter.empty))
    kinds |= {"campaign": (Directory, Path()), **{name: _OPTIONS[name] for name in rule.options}}
    command.__doc__ = rule.help
    command.__annotations__ = {name: kind for name, (kind, _) in kinds.items()}
    command.__signature__ = Signature(  # type: ignore[attr-defined]
        [
            Parameter(name, Parameter.POSITIONAL_OR_KEYWORD, default=default, annotation=kind)
            for name, (kind, default) in kinds.items()
        ]
    )
    return command


_named: dict[str, Rule] = {}
for _row in RULES.values():
    if _named.setdefault(_row.command, _row) is _row:  # `export` serves two rules
        step.command(_row.command)(_command_of(_row))


# ---- The commands ---------------------------------------------------------------------------------------------------

app = typer.Typer(cls=Commands, no_args_is_help=True, help="SAR images from campaign folders.")
app.add_typer(step, name="step", hidden=True)  # for rules, and to paste what one runs


CampaignFolder = Annotated[Path, typer.Argument(help="campaign folder, default: current folder", show_default=False)]
Cores = Annotated[int, typer.Option(min=1, help="cores to use")]
Paranoid = Annotated[bool, typer.Option("--paranoid", help="read every input again, whatever its times say")]
HERE = Path()
ALL_CORES = os.cpu_count() or 1


class _PassesOn(TyperCommand):
    """A command whose unknown options go to snakemake."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take options and values apart: of `-sFILE`, click would take each letter that is an option of ours.

        Names of steps that follow `--until` are all its values, as snakemake reads them; click takes one value.
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
"""Exit status where the reader of the output has gone, as `head` does: that of other commands, without a message."""


def main() -> None:
    """Run the command line; exits with 0, 2 (one message: something to see to), 130 (a signal) or 1 (a defect)."""
    with ended_by_signals():
        try:
            app()
        except CampaignError as error:
            from apertura.campaign.config import located

            _say(located(as_typed(error)))
            leave_status(2)
            raise SystemExit(2) from None
        except Interrupted as signalled:
            _say(str(signalled.code))
            raise SystemExit(INTERRUPTED) from None
        except SystemExit as ended:
            if isinstance(ended.__context__, BrokenPipeError):  # typer takes it for a failure of ours
                raise SystemExit(_UNREAD) from None
            raise
        except BrokenPipeError:
            raise SystemExit(_UNREAD) from None
        except Exception as error:
            message = explained(error)
            leave_status(2 if message else 1)
            if message is None:
                raise
            _say(message)
            raise SystemExit(2) from None
        finally:
            _flush()


def _flush() -> None:
    """Write what is printed; where its reader has gone or its disk is full, nothing is left to fail at the exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _say(message: str) -> None:
    """Print an error where the reader of the output may have gone."""
    with suppress(OSError):
        print(f"error: {message}", file=sys.stderr, flush=True)


def _print_version(asked: bool) -> None:
    if asked:
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
    from apertura.views.inspect.path import inspect_path

    raise typer.Exit(inspect_path(given(path), settings or (), name=path, plot=picture, as_json=as_json))


@app.command()
def align(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="[CAMPAIGN] FLIGHT NODE",
            help="campaign folder, default: current folder; flight; node that sends and receives",
        ),
    ],
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
    if len(words) not in {2, 3}:
        raise CampaignError(" ".join(words), "align", "[CAMPAIGN] FLIGHT NODE", "Name flight and node.")
    *folder, flight, node = words
    opened = _opened(Path(*folder))
    from apertura.tools.align import print_alignment

    asked = {"point": point, "search_s": search_s, "search_m": 0.0 if keep_path else search_m, "drift": drift}
    print_alignment(opened, flight, node, write=write, **asked)


@app.command(cls=_PassesOn, context_settings=PASS_ON)
def run(
    context: typer.Context,
    campaign: CampaignFolder = HERE,
    cores: Cores = ALL_CORES,
    *,
    paranoid: Paranoid = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="only errors, and what to open")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="all that snakemake says")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="tell which steps would run; run none")] = False,
    until: Annotated[
        list[str] | None, typer.Option("--until", "-U", metavar="STEP …", help="last steps: image, export, cube, …")
    ] = None,
    profile: Annotated[
        str | None, typer.Option(metavar="PROFILE", help="where steps run: profiles/slurm, or a folder of yours")
    ] = None,
    set_scatter: Annotated[
        list[str] | None, typer.Option("--set-scatter", metavar="tiles=N", help="form each image by N jobs")
    ] = None,
) -> None:
    """Run the workflow on a campaign folder; further options and targets go to snakemake."""
    show: Show = "snakemake" if verbose else "errors" if quiet else "steps"
    asked = [*context.args, *(["-n"] if dry_run else []), *(["--until", *until] if until else [])]
    asked += [*(["--profile", profile] if profile else []), *(["--set-scatter", *set_scatter] if set_scatter else [])]
    _run(campaign, cores, *asked, paranoid=paranoid, show=show)


def _run(campaign: Path, cores: int, *asked: str, paranoid: bool = False, show: "Show" = "steps") -> None:
    from apertura.run.driver import run_workflow
    from apertura.workflow.stale import forms_results

    status = run_workflow(given(campaign), cores, *asked, paranoid=paranoid, show=show)
    if status == 0 and forms_results(["", *asked]):
        opened = _opened(campaign)
        from apertura.views.summary import is_finished, print_benches, print_products, print_summary, print_unfinished

        print_benches(opened)
        if not is_finished(opened):  # after `--until`
            print_unfinished(opened)
        elif opened.image_flights:
            print_products(opened) if show == "errors" else print_summary(opened)
    raise SystemExit(status)


@app.command()
def look(
    campaign: CampaignFolder = HERE,
    cores: Cores = ALL_CORES,
    *,
    follow: Annotated[
        bool, typer.Option("--follow", help="its recordings still grow: show it as they do, then run the workflow")
    ] = False,
    every: Annotated[float, typer.Option(min=1, help="s between pictures")] = 5.0,
    end_after: Annotated[float, typer.Option(min=1, help="s without growth that end the recordings")] = 10.0,
    run_after: Annotated[bool, typer.Option("--run/--no-run", help="run the workflow when they have ended")] = True,
) -> None:
    """Show images of the pulses so far, beside the results; Ctrl-C ends a campaign that is followed, and runs it."""
    opened = _opened(campaign)
    from apertura.tools.look.follow import look_at

    look_at(opened, follow=follow, every_s=every, end_after_s=end_after, threads=cores)
    if follow and run_after:
        _run(campaign, cores)


@app.command()
def status(campaign: CampaignFolder = HERE) -> None:
    """Tell what a run does, from another terminal: steps done, under way and left, time left, the last error."""
    opened = _opened(campaign)
    from apertura.run.screen import print_status

    print_status(opened)


@app.command("list")
def list_results(campaign: CampaignFolder = HERE) -> None:
    """List flights and pairs, and which of their results are finished, stale or missing, with their sizes."""
    opened = _opened(campaign)
    from apertura.run.results import print_list

    print_list(opened)


@app.command()
def clean(
    campaign: CampaignFolder = HERE,
    wip: Annotated[bool, typer.Option("--wip", help="only work in progress that a killed run has left")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="do not ask")] = False,
) -> None:
    """Remove what the workflow has made, and nothing else; not while a run holds the campaign."""
    opened = _opened(campaign)
    from apertura.run.results import clean as remove_results

    remove_results(opened, unfinished_only=wip, agreed=yes)


@app.command()
def check(
    campaign: CampaignFolder = HERE,
    products: Annotated[bool, typer.Option("--products", help="read every byte of the results")] = False,
    paranoid: Paranoid = False,
) -> None:
    """Print all that is wrong with a campaign folder, a line each, and which results are overtaken; run nothing."""
    from apertura.check import print_findings

    raise SystemExit(2 if print_findings(given(campaign), products=products, paranoid=paranoid) else 0)


@app.command()
def plan(campaign: CampaignFolder = HERE, threads: Threads = 1) -> None:
    """Print how each pair would be imaged, why, how exactly and at what cost; nothing is run."""
    opened = _opened(campaign)
    from apertura.views.plan import print_plan

    print_plan(opened, threads=threads)


@app.command()
def design(
    plan: Annotated[Path, typer.Argument(metavar="PLAN.yaml", help="radar, nodes with planned tracks, scene")],
    out: Annotated[
        Path | None, typer.Argument(help="folder for layers, tracks, map and report", show_default=False)
    ] = None,
    *,
    optimise: Annotated[
        str | None,
        typer.Option(metavar="WORDS", help="move tracks within the plan's bounds first: height,offset,spacing,heading"),
    ] = None,
    threads: Threads = 1,
) -> None:
    """Tell before a flight what it will give: resolution, noise, coverage, volume; whether it is what is required."""
    path, folder = given(plan), None if out is None else given(out)
    from apertura.tools.design.view import print_design

    raise typer.Exit(0 if print_design(path, folder, optimise=optimise, threads=threads) else 2)


@app.command()
def compare(
    plan: Annotated[Path, typer.Argument(metavar="PLAN.yaml", help="as of `apertura design`")],
    campaign: CampaignFolder = HERE,
    threads: Threads = 1,
) -> None:
    """Print planned and flown side by side, by the campaign's logs and, where there are any, its images."""
    path, folder = given(plan), given(campaign)
    from apertura.tools.design.view import print_comparison

    print_comparison(path, folder, threads=threads)


@app.command(context_settings=PASS_ON)
def chart(context: typer.Context, campaign: CampaignFolder = HERE, cores: Cores = ALL_CORES) -> None:
    """Time and measure every engine and setting on the campaign: results/study/speed_accuracy.{png,html,csv}."""
    from apertura.run.driver import run_workflow

    status = run_workflow(given(campaign), cores, *context.args, "speed_accuracy")
    if status == 0:
        print(*(campaign / f"results/study/speed_accuracy.{suffix}" for suffix in ("png", "html", "csv")), sep="\n")
    raise SystemExit(status)


@app.command()
def summary(campaign: CampaignFolder = HERE) -> None:
    """Print what every finished image says of itself: focus, agreement, numerical error, flags."""
    opened = _opened(campaign)
    from apertura.views.summary import print_stale, print_summary

    print_summary(opened)
    print_stale(opened)


@app.command()
def score(
    campaign: Annotated[
        Path, typer.Argument(help="campaign folder with truth.json, default: current folder", show_default=False)
    ] = HERE,
    paths: Annotated[bool, typer.Option("--paths", help="list the files of all products, too")] = False,
) -> None:
    """Compare the measured positions of point targets with the true ones."""
    opened = _opened(campaign)
    from apertura.views.score import print_findings
    from apertura.views.summary import print_stale

    print_findings(opened, paths=paths)
    print_stale(opened)


@app.command()
def bench(
    campaign: CampaignFolder = HERE,
    write: Annotated[bool, typer.Option("--write", help="write the measured paths into config/config.yaml")] = False,
) -> None:
    """Measure a radar that stands still or is cabled: channels, clocks, coherence, paths; a verdict per line.

    Exits with 2 where a line is beyond its limit.
    """
    opened = _opened(campaign)
    from apertura.tools.bench.report import print_bench

    raise SystemExit(2 if print_bench(opened, write=write) else 0)


@app.command()
def reflectors(
    campaign: CampaignFolder = HERE,
    to: Annotated[Path | None, typer.Option(metavar="FILE", help="by default calibration.json in that folder")] = None,
) -> None:
    """Measure the constant of each pair at reflectors of known cross-section, and write it for later campaigns."""
    opened, path = _opened(campaign), None if to is None else given(to)
    from apertura.tools.reflectors import write_constants

    print(as_typed(write_constants(opened, path)))


@app.command()
def verify(
    product: Annotated[
        Path,
        typer.Argument(
            help="a file, a stage or a manifest of a campaign, or a campaign folder, default: current folder",
            show_default=False,
        ),
    ] = HERE,
    *,
    campaign: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="the campaign of a file that lies elsewhere")
    ] = None,
    crate: Annotated[
        bool, typer.Option("--crate", help="results that were passed on: every file by their RO-Crate, and the catalog")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="only what is not the same")] = False,
) -> None:
    """Walk from a product to the raw samples; say of each link whether it is the same, changed or missing."""
    if crate:
        from apertura.views.verify.chain import print_checked

        raise typer.Exit(print_checked(given(product), quiet=quiet))
    there = None if campaign is None else given(campaign)
    from apertura.views.verify.chain import print_verified

    raise typer.Exit(print_verified(given(product), there, quiet=quiet))


@app.command()
def reproduce(
    product: Annotated[
        Path,
        typer.Argument(
            help="a file, a stage or a manifest of a campaign, or a campaign folder, default: current folder",
            show_default=False,
        ),
    ] = HERE,
    *,
    cores: Cores = ALL_CORES,
    keep: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="a new folder to make it in, which stays; else in TMPDIR")
    ] = None,
) -> None:
    """Make a product again from the raw samples, in another folder, and compare it byte for byte with what is there."""
    kept = None if keep is None else given(keep)
    from apertura.views.verify.diff import print_reproduced

    raise typer.Exit(print_reproduced(given(product), cores=cores, keep=kept))


@app.command()
def diff(
    first: Annotated[Path, typer.Argument(help="a raster, picture, stage or report")],
    second: Annotated[Path, typer.Argument(help="what to hold it against, of this campaign or another")],
    *,
    whole: Annotated[bool, typer.Option("--all", help="every line of a section, however many")] = False,
) -> None:
    """Tell two products apart: geometry, settings, inputs, stages, code, software, flags and pixels."""
    from apertura.views.verify.diff import print_differences

    raise typer.Exit(print_differences(given(first), given(second), whole=whole))


@app.command()
def report(
    campaign: CampaignFolder = HERE,
    cores: Cores = ALL_CORES,
) -> None:
    """Write results/report.html: what was asked and decided, how images turned out, pictures; it needs no net."""
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
        asked = ["--report", str(temporary), "--report-stylesheet", str(style)]
        status = run_workflow(campaign, 1, "all", "pages", *asked, show="errors")
        if status:
            raise SystemExit(status)
    for path in (opened.result(PAGE), *(opened.result(flight.name, PAGE) for flight in opened.image_flights)):
        typer.echo(as_typed(path))


@app.command("map")
def map_page(
    campaign: CampaignFolder = HERE,
    port: Annotated[int, typer.Option(min=0, max=65535, help="to serve on; 0: a free one")] = 0,
    look_: Annotated[bool, typer.Option("--look", help="what `apertura look` shows, as it flies")] = False,
    open_: Annotated[bool, typer.Option("--open", help="show it in the browser")] = False,
) -> None:
    """Show a campaign as a map in a browser: served to this machine alone, until Ctrl-C."""
    opened = _opened(campaign)
    opened.check_images()
    from apertura.views.summary import print_stale
    from apertura.views.webmap.server import served, served_look

    if not look_:
        print_stale(opened)
    (served_look if look_ else served)(opened, port=port).show(in_browser=open_)


@app.command()
def init(
    directory: Annotated[Path, typer.Argument(help="folder to make")],
    kind: Annotated[str, typer.Option(help="of waveform: ofdm, samples, fmcw, phase_history")] = "ofdm",
    from_: Annotated[
        Path | None, typer.Option("--from", metavar="PLAN.yaml", help="the config of a flight that was planned")
    ] = None,
) -> None:
    """Write the commented config of a new campaign folder, or that of a flight plan, ready for its recordings."""
    if from_ is not None:
        path, folder = given(from_), given(directory)
        from apertura.tools.design.flight_plan import read_flight_plan
        from apertura.tools.design.products import write_campaign_config

        print(*map(as_typed, write_campaign_config(read_flight_plan(path), folder)), sep="\n")
        print(_next_after_init(directory))
        return
    from apertura.campaign.config.template import config_template, flights_template
    from apertura.common.atomic import made_folder, write_text

    texts = {"config.yaml": config_template(kind), "flights.tsv": flights_template(kind)}
    folder = made_folder(given(directory)) / "config"
    for path, text in ((folder / name, text) for name, text in texts.items()):
        if path.exists():
            raise CampaignError("exists already", path, "a new folder", "Choose another folder; nothing was changed.")
        write_text(path, text)
        print(as_typed(path))
    print(_next_after_init(directory))


def _next_after_init(directory: Path) -> str:
    folder = shlex.quote(str(directory))
    return (
        "Next: state radar, nodes and scene in config.yaml and the flights in flights.tsv, copy recordings and logs to "
        f"{folder}/raw/<flight>/, then: apertura check {folder}"
    )


@app.command()
def simulate(
    paths: Annotated[list[Path] | None, typer.Argument(metavar="[SPEC.yaml] DIR", help="what, and where to")] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="demo (the default), first-flight, paper, swarm, continuous, flight (13.5 GB), "
            "paper-lab, paper-static, paper-uav"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="of the random generator")] = 1,
    print_spec: Annotated[str | None, typer.Option(metavar="PRESET", help="print a preset to start from")] = None,
) -> None:
    """Write a simulated campaign folder of raw IQ, with truth.json, from a YAML specification or a preset."""
    from apertura import simulation

    if print_spec is not None:
        print(simulation.specification_text(simulation.preset(print_spec)), end="")
        return
    paths = paths or []
    if len(paths) + (preset is not None) not in {1, 2} or not paths:
        typed = " ".join(map(str, paths)) + (f" --preset {preset}" if preset else "") or "no folder"
        raise CampaignError(typed, "simulate", "[SPEC.yaml] DIR, or DIR --preset PRESET", "Name a folder to make.")
    chosen = given(paths[0]) if len(paths) > 1 else simulation.preset(preset or "demo")
    print(as_typed(simulation.simulate(given(paths[-1]), chosen, seed=seed)))
