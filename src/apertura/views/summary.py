"""`apertura summary`: verdict and quality of every image of a campaign, flags with meaning and advice, main files."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from apertura.campaign.config import FUSED
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_listed
from apertura.common.documents import undamaged
from apertura.common.errors import number_of, shown
from apertura.core.backprojection.engines import missing_kernel
from apertura.formats.export import MAP, exports_in
from apertura.run.results import counted, states
from apertura.views.quality import (
    ImageValues,
    Report,
    decibels,
    printable,
    raised_flags,
    read_report,
)
from apertura.workflow.lineage import on_demand
from apertura.workflow.rules import INTERFEROMETRY, STACK
from apertura.workflow.stale import absent_lines, stale_results

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_HEADINGS = ("image", "verdict", "focus loss", "expected loss", "coherence", "numerical error", "pulses", "flags")
_WHOLE = {"image", "verdict", "focus loss", "pulses"}
_WIDE = 120
_MOST_FLIGHTS = 3
_SENTENCE = 40  # minimum length in characters; shorter parts are measurements, which may be equal for two flags


def is_finished(campaign: Campaign) -> bool:
    """Return True if every image has a complete and up-to-date report."""
    images = ((flight.name, name) for flight in campaign.image_flights for name in flight.images)
    return all(campaign.is_current(campaign.result(*image, "export")) for image in images)


def print_summary(campaign: Campaign) -> None:
    """Print a table row for each image, each raised flag with meaning and advice, and the main files.

    Raises
    ------
    CampaignError
        If no image exists.
    """
    from rich.console import Console

    campaign.check_images()
    names = [(flight.name, name) for flight in campaign.image_flights for name in flight.images]
    current = [image for image in names if campaign.is_current(campaign.result(*image, "export"))]
    # if no image is up to date, reading the first image raises the error
    reports = {" ".join(image): read_report(campaign, *image) for image in current or names[:1]}
    values = {name: ImageValues.of(report) for name, report in reports.items()}
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=max(_WIDE, console.width))
    console.print(_table(values))
    undecided = dict[str, list[str]]()  # reason → images without flags whose verdict is not `focused`
    for name, image_values in values.items():
        if image_values.verdict not in ("", "focused") and not image_values.flags:
            undecided.setdefault(f"{image_values.verdict}: {image_values.reason}", []).append(name)
    for reason, images in undecided.items():
        console.print(f"{_abbreviated(images)}: {reason}", soft_wrap=True)
    if slow := missing_kernel():
        console.print(slow, soft_wrap=True)
    uncertain = max(values.values(), key=lambda image_values: image_values.place_m, default=None)
    if uncertain and uncertain.place_m:
        console.print(
            f"geolocation uncertainty {uncertain.place_m:.2g} m, dominated by {uncertain.place_cause}", soft_wrap=True
        )
    not_stated = dict.fromkeys(cause for image_values in values.values() for cause in image_values.not_stated)
    if not_stated:
        console.print(
            f"not in the error budget, because their uncertainty is not configured: {', '.join(not_stated)}; see "
            "image.json"
        )
    between = dict(_between_flights(campaign))
    for name, report in between.items():
        console.print(f"{name}: {report['says']}", soft_wrap=True)
    _print_flags(console, {**reports, **between})
    if missing := [" ".join(image) for image in names if image not in current]:
        console.print(f"missing or out of date: {_abbreviated(missing)}; `apertura run` computes them", soft_wrap=True)
    print_products(campaign)


def print_stale(campaign: Campaign) -> None:
    """Print the number of out-of-date results, except results that are only made on demand.

    Missing recordings, which cannot be compared, are reported in a separate line.
    """
    print(*(f"{line}\n" for line in absent_lines(campaign)), sep="", end="")
    if stale := [manifest for manifest in stale_results(campaign) if not on_demand(campaign, manifest)]:
        verb = "is" if len(stale) == 1 else "are"
        print(f"{number_of(len(stale), 'result')} {verb} out of date: `apertura run` recomputes them")


def print_unfinished(campaign: Campaign) -> None:
    """Print the numbers of finished, missing and out-of-date results, except results that are only made on demand."""
    print(f"{counted(states(campaign))}: `apertura run` computes the remaining results")


def print_benches(campaign: Campaign) -> None:
    """Print the raised flags and the report page of each measured flight of kind bench, one line per flight."""
    for flight in campaign.flights:
        report, page = (campaign.result(flight.name, name) for name in ("bench.json", "bench.html"))
        if flight.kind == "bench" and campaign.is_current(campaign.result(flight.name, "bench")):
            flags = open_listed(report, report.with_name("bench.manifest.json"))["flags"]
            verdict = f"flags {', '.join(printable(flags))}" if flags else "all measurements are within their limits"
            print(f"bench {flight.name}: {verdict}: {campaign.relative(page)}")


def print_products(campaign: Campaign) -> None:
    """Print the main files of the first flights."""
    print(f"main files in {campaign.root}:")
    flights = campaign.image_flights
    folders = [
        ("fused" if FUSED in flight.images else "pair", flight.name, flight.images[-1])
        for flight in flights[:_MOST_FLIGHTS]
    ]
    folders += [("interferogram", INTERFEROMETRY, name) for name in campaign.settings.interferometry.pairs]
    if stack := campaign.settings.stack:
        folders += [("change", STACK, name) for name in stack.flights[:_MOST_FLIGHTS]]
    for kind, *folder in folders:
        for row in sorted(exports_in(kind), key=lambda row: row.pictured):  # rasters first
            path = campaign.result(*folder, row.file)
            if row.opened and path.is_file():
                print(f"  {campaign.relative(path)}  {row.opened}")
    if len(flights) > _MOST_FLIGHTS:
        print(f"  and the files of {number_of(len(flights) - _MOST_FLIGHTS, 'further flight')}")
    if campaign.result(MAP).is_file():
        print(f"  map of all images: apertura map {shlex.quote(str(campaign.root))}")


def _between_flights(campaign: Campaign) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and summary of each up-to-date interferogram, flight of the stack, and change between flights."""
    pairs, stack = campaign.settings.interferometry.pairs, campaign.settings.stack
    flights = stack.flights if stack else ()
    products = [("interferogram", INTERFEROMETRY, name, "interferogram", "interferogram") for name in pairs]
    products += [("stack", STACK, flight, "stack", "stack_image") for flight in flights]
    products += [("changes", STACK, flight, "change", "change") for flight in flights]
    for heading, folder, name, document, result in products:
        path = campaign.result(folder, name, f"{document}.json")
        if campaign.is_current(campaign.result(folder, name, result)):
            report = open_listed(path, path.with_name(f"{result}.manifest.json"))
            with undamaged(path, expected=f"the report of step {result}", remedy="Run the workflow again."):
                entry = {"says": shown(report["says"], 400), "flags": printable(report["flags"])}
            yield f"{heading} {name}", entry


def _abbreviated(names: Sequence[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _print_flags(console: "Console", reports: Mapping[str, Report]) -> None:
    """Print each flag with meaning, measurement in each image, and advice.

    A sentence that was already printed for another flag is replaced by a reference to that flag.
    """
    from rich.padding import Padding
    from rich.text import Text

    printed = dict[str, str]()  # sentence → flag for which the sentence was printed
    for flag in raised_flags(reports, quotes=False):
        console.print(Text.assemble((flag.name, "yellow"), f": {flag.meaning}" if flag.meaning else ""))
        measured = []
        for line, images in flag.measured.items():
            sentences = line.split("; ")
            repeated = [text for text in sentences if text in printed]
            references = ["as above" if printed[text] == flag.name else f"see {printed[text]}" for text in repeated]
            parts = [*(text for text in sentences if text not in repeated), *dict.fromkeys(references)]
            measured.append(f"{_abbreviated(images)}: {'; '.join(parts)}")
            printed |= {text: flag.name for text in sentences if text not in repeated and len(text) >= _SENTENCE}
        for line in [*measured, *([f"advice: {flag.advice}"] if flag.advice else [])]:
            console.print(Padding(Text(line), (0, 0, 0, 4)))


def _table(images: Mapping[str, ImageValues]) -> "Table":
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, padding=0)
    for heading in _HEADINGS:
        table.add_column(heading, overflow="fold", no_wrap=heading in _WHOLE)
    for name, values in images.items():
        expected, coherence = decibels(values.expected_db, 1), []
        if values.worst_cause and (values.expected_db or 0.0) < -0.05:
            expected += f", {values.worst_cause}"
        if values.coherence is not None:
            coherence.append(f"{values.coherence:.3f}")
        if values.excluded:
            coherence.append(f"{values.excluded} excluded")
        table.add_row(
            name,
            values.verdict,
            decibels(values.loss_db, 1),
            expected,
            " ".join(coherence),
            f"{values.error_db:.1f} dB",
            "" if values.used is None else f"{values.used}/{values.recorded}",
            str(len(values.flags) or "none"),
        )
    return table
