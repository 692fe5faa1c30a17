"""`apertura summary`: what every image of a finished campaign states, its flags explained, and what to open."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from apertura.campaign.config import FUSED
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_listed
from apertura.common.documents import undamaged
from apertura.common.errors import number_of, shown
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
from apertura.workflow.rules import INTERFEROMETRY
from apertura.workflow.stale import absent_lines, stale_results

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_HEADINGS = ("image", "verdict", "focus loss", "expected loss", "coherence", "numerical error", "pulses", "flags")
_WHOLE = {"image", "verdict", "focus loss", "pulses"}
_WIDE = 120
_MOST_FLIGHTS = 3
_SENTENCE = 40  # letters: shorter parts of a line are measurements, which two flags may have in common


def is_finished(campaign: Campaign) -> bool:
    """Test whether every image has its report, complete and up to date."""
    images = ((flight.name, name) for flight in campaign.image_flights for name in flight.images)
    return all(campaign.is_current(campaign.result(*image, "export")) for image in images)


def print_summary(campaign: Campaign) -> None:
    """Print a row for each image, every flag once with its meaning and advice, and the files to open.

    Raises
    ------
    CampaignError
        If no image is there.
    """
    from rich.console import Console

    campaign.check_images()
    names = [(flight.name, name) for flight in campaign.image_flights for name in flight.images]
    there = [image for image in names if campaign.is_current(campaign.result(*image, "export"))]
    reports = {" ".join(image): read_report(campaign, *image) for image in there or names[:1]}
    values = {name: ImageValues.of(report) for name, report in reports.items()}
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=max(_WIDE, console.width))
    console.print(_table(values))
    undecided = dict[str, list[str]]()  # reason → images whose verdict is not `focused` although no flag explains it
    for name, one in values.items():
        if one.verdict not in ("", "focused") and not one.flags:
            undecided.setdefault(f"{one.verdict}: {one.why}", []).append(name)
    for why, images in undecided.items():
        console.print(f"{_abbreviated(images)}: {why}", soft_wrap=True)
    unsure = max(values.values(), key=lambda one: one.place_m, default=None)
    if unsure and unsure.place_m:
        console.print(
            f"targets may be misplaced by {unsure.place_m:.2g} m, mostly by {unsure.place_cause}", soft_wrap=True
        )
    not_stated = dict.fromkeys(cause for one in values.values() for cause in one.not_stated)
    if not_stated:
        console.print(f"left out of the budget, no uncertainty is configured: {', '.join(not_stated)}; see image.json")
    interferograms = dict(_interferograms(campaign))
    for name, report in interferograms.items():
        console.print(f"interferogram {name.removeprefix(f'{INTERFEROMETRY} ')}: {report['says']}", soft_wrap=True)
    _print_flags(console, {**reports, **interferograms})
    if missing := [" ".join(image) for image in names if image not in there]:
        console.print(f"not there yet: {_abbreviated(missing)}; apertura run makes what is missing", soft_wrap=True)
    print_products(campaign)


def print_stale(campaign: Campaign) -> None:
    """Print a line where results are overtaken by a file, a setting or code, but those made on demand.

    And one where recordings are absent, so that this is unknown.
    """
    print(*(f"{line}\n" for line in absent_lines(campaign)), sep="", end="")
    if stale := [manifest for manifest in stale_results(campaign) if not on_demand(campaign, manifest)]:
        print(f"{number_of(len(stale), 'result')} {'is' if len(stale) == 1 else 'are'} stale: apertura run")


def print_unfinished(campaign: Campaign) -> None:
    """Print how many results are finished and how many are not made yet, or stale; those on demand do not count."""
    print(f"{counted(states(campaign))}: apertura run makes the rest")


def print_benches(campaign: Campaign) -> None:
    """Print a line for each flight of kind bench that was measured: how many lines carry a flag, and its page."""
    for flight in campaign.flights:
        report, page = (campaign.result(flight.name, name) for name in ("bench.json", "bench.html"))
        if flight.kind == "bench" and campaign.is_current(campaign.result(flight.name, "bench")):
            flags = open_listed(report, report.with_name("bench.manifest.json"))["flags"]
            verdict = f"look at {', '.join(printable(flags))}" if flags else "every line within its limit"
            print(f"bench {flight.name}: {verdict}: {campaign.relative(page)}")


def print_products(campaign: Campaign) -> None:
    """Print which files to open, of the first flights."""
    print(f"what to open, in {campaign.root}:")
    flights = campaign.image_flights
    folders = [
        ("fused" if FUSED in one.images else "pair", one.name, one.images[-1]) for one in flights[:_MOST_FLIGHTS]
    ]
    folders += [("interferogram", INTERFEROMETRY, name) for name in campaign.settings.interferometry.pairs]
    for kind, *folder in folders:
        for row in sorted(exports_in(kind), key=lambda row: row.pictured):  # rasters first
            path = campaign.result(*folder, row.file)
            if row.opened and path.is_file():
                print(f"  {campaign.relative(path)}  {row.opened}")
    if len(flights) > _MOST_FLIGHTS:
        print(f"  and the same of {number_of(len(flights) - _MOST_FLIGHTS, 'flight')} more")
    if campaign.result(MAP).is_file():
        print(f"  all of them on a map: apertura map {shlex.quote(str(campaign.root))}")


def _interferograms(campaign: Campaign) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the summary of each interferogram."""
    for name in campaign.settings.interferometry.pairs:
        path = campaign.result(INTERFEROMETRY, name, "interferogram.json")
        if campaign.is_current(campaign.result(INTERFEROMETRY, name, "interferogram")):
            report = open_listed(path, path.with_name("interferogram.manifest.json"))
            with undamaged(path, expected="the report of an interferogram", remedy="Run the workflow again."):
                entry = {"says": shown(report["says"], 400), "flags": printable(report["flags"])}
            yield f"{INTERFEROMETRY} {name}", entry


def _abbreviated(names: Sequence[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _print_flags(console: "Console", reports: Mapping[str, Report]) -> None:
    """Print each flag with its meaning and advice, and below it what was measured of which images.

    A sentence that another line has printed already is replaced by a reference to its flag.
    """
    from rich.padding import Padding
    from rich.text import Text

    printed = dict[str, str]()  # sentence → its flag
    for flag in raised_flags(reports, quotes=False):
        console.print(Text.assemble((flag.name, "yellow"), f": {flag.meaning}" if flag.meaning else ""))
        measured = []
        for line, images in flag.measured.items():
            sentences = line.split("; ")
            again = [one for one in sentences if one in printed]
            above = ["as above" if printed[one] == flag.name else f"see {printed[one]}" for one in again]
            told = [*(one for one in sentences if one not in again), *dict.fromkeys(above)]
            measured.append(f"{_abbreviated(images)}: {'; '.join(told)}")
            printed |= {one: flag.name for one in sentences if one not in again and len(one) >= _SENTENCE}
        for line in [*measured, *([f"advice: {flag.advice}"] if flag.advice else [])]:
            console.print(Padding(Text(line), (0, 0, 0, 4)))


def _table(images: Mapping[str, ImageValues]) -> "Table":
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, padding=0)
    for heading in _HEADINGS:
        table.add_column(heading, overflow="fold", no_wrap=heading in _WHOLE)
    for name, values in images.items():
        expected, in_phase = decibels(values.expected_db, 1), []
        if values.worst_cause and (values.expected_db or 0.0) < -0.05:
            expected += f", {values.worst_cause}"
        if values.coherence is not None:
            in_phase.append(f"{values.coherence:.3f}")
        if values.left_out:
            in_phase.append(f"{values.left_out} left out")
        table.add_row(
            name,
            values.verdict,
            decibels(values.loss_db, 1),
            expected,
            " ".join(in_phase),
            f"{values.error_db:.1f} dB",
            "" if values.used is None else f"{values.used}/{values.recorded}",
            str(len(values.flags) or "none"),
        )
    return table
