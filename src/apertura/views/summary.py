"""`apertura summary`: what every image of a finished campaign says of itself, its flags explained, and what to open."""

import shlex
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from apertura.common.documents import undamaged
from apertura.common.errors import shown
from apertura.common.flags import FLAGS
from apertura.formats.export import MAP
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.rules import INTERFEROMETRY
from apertura.pipeline.store import open_listed

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_HEADINGS = ("image", "verdict", "lost", "budget", "in phase", "error <", "pulses", "flags")
_WHOLE = {"image", "verdict", "lost", "error <", "pulses"}
_WIDE = 120
_OPENED = {
    "db.tif": "in a GIS",
    "coherent_db.tif": "in a GIS",
    "noncoherent_db.tif": "in a GIS, added without phases",
    "quicklook.png": "with what the image says of itself",
}
_MOST_FLIGHTS = 3
_NOT_STATED = "not stated"

Reports = Mapping[tuple[str, str], Mapping[str, Any]]


def is_finished(campaign: Campaign) -> bool:
    """Return whether every image has its report."""
    return all(campaign.result(*image, "image.json").is_file() for image in _images(campaign))


def print_summary(campaign: Campaign) -> None:
    """Print a row for each image, every flag once with what it means and what to look at, and which files to open.

    Raises
    ------
    CampaignError
        If an image is not there.
    """
    from rich.console import Console

    reports = {image: _report(campaign, *image) for image in _images(campaign)}
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=max(_WIDE, console.width))
    console.print(_table(reports))
    silent = dict.fromkeys(cause for report in reports.values() for cause in _silent(report))
    if silent:
        console.print(f"not stated, so not in the budget; image.json tells what they would do: {', '.join(silent)}")
    compared = dict(_interferograms(campaign))
    for (_, name), report in compared.items():
        console.print(f"interferogram {name}: {report['says']}", soft_wrap=True)
    _print_flags(console, {**reports, **compared})
    print_products(campaign)


def print_products(campaign: Campaign) -> None:
    """Print which files to open, of the first flights."""
    print(f"what to open, in {campaign.root}:")
    flights = campaign.image_flights
    for flight in flights[:_MOST_FLIGHTS]:
        for name, why in _OPENED.items():
            path = campaign.result(flight.name, "fused", name)
            if path.is_file():
                print(f"  {campaign.relative(path)}  {why}")
    for name in campaign.settings.interferometry.pairs:
        path = campaign.result(INTERFEROMETRY, name, "height.tif")
        if path.is_file():
            print(f"  {campaign.relative(path)}  in a GIS, with its deviation beside it")
    if len(flights) > _MOST_FLIGHTS:
        print(f"  and the same of {len(flights) - _MOST_FLIGHTS} flights more")
    if campaign.result(MAP).is_file():
        print(f"  all of them on a map: apertura map {shlex.quote(str(campaign.root))}")


def _images(campaign: Campaign) -> Iterator[tuple[str, str]]:
    for flight in campaign.image_flights:
        yield from ((flight.name, name) for name in (*flight.pairs, "fused"))


def _report(campaign: Campaign, flight: str, name: str) -> dict[str, Any]:
    path = campaign.result(flight, name, "image.json")
    report = open_listed(path, path.with_name("export.manifest.json"))
    with undamaged(path, expected="the report of an image", remedy="Run the workflow again."):
        flags = {shown(flag): shown(line, 2000) for flag, line in report["flags"].items()}
        return {**report, "flags": flags, "numerical_error_db": float(report["numerical_error_db"])}


def _interferograms(campaign: Campaign) -> Iterator[tuple[tuple[str, str], dict[str, Any]]]:
    """Yield what each interferogram that is there says of itself."""
    for name in campaign.settings.interferometry.pairs:
        path = campaign.result(INTERFEROMETRY, name, "interferogram.json")
        if path.is_file():
            report = open_listed(path, path.with_name("interferogram.manifest.json"))
            with undamaged(path, expected="the report of an interferogram", remedy="Run the workflow again."):
                flags = {shown(flag): shown(line, 2000) for flag, line in report["flags"].items()}
                yield (INTERFEROMETRY, name), {"says": shown(report["says"], 400), "flags": flags}


def _print_flags(console: "Console", reports: Reports) -> None:
    """Print each flag with what it means and what to look at first, and below it what was measured of which images."""
    from rich.padding import Padding
    from rich.text import Text

    raised: dict[str, dict[str, list[str]]] = {}
    for (flight, name), report in reports.items():
        for flag, line in report["flags"].items():
            images = raised.setdefault(flag, {})
            if name != "fused" or not any(known in line for known in images):  # it quotes its pairs
                images.setdefault(line, []).append(f"{flight} {name}")
    for flag, lines in raised.items():
        known = FLAGS.get(flag)  # an image of another version may carry one that is unknown here
        console.print(Text.assemble((flag, "yellow"), f": {known.means}" if known else ""))
        told = [f"{_some(images)}: {line}" for line, images in lines.items()]
        for line in [*told, *([f"look at: {known.look}"] if known else [])]:
            console.print(Padding(Text(line), (0, 0, 0, 4)))


def _some(names: list[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _table(reports: Reports) -> "Table":
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, padding=0)
    for heading in _HEADINGS:
        table.add_column(heading, overflow="fold", no_wrap=heading in _WHOLE)
    for (flight, name), report in reports.items():
        focus, pulses, coherence = (report.get(key) or {} for key in ("focus", "pulses", "coherence"))
        mean, alone = coherence.get("mean"), len((report.get("fusion") or {}).get("left_out", ()))
        together = "" if mean is None else f"{mean:.3f}"
        used, dropped = pulses.get("used"), pulses.get("dropped") or 0
        table.add_row(
            f"{flight} {name}",
            focus.get("verdict", ""),
            f"{abs(focus['loss_db']):.1f} dB" if "loss_db" in focus else "",
            _expected(report),
            f"{together} {alone} left out".strip() if alone else together,
            f"{report['numerical_error_db']:.1f} dB",
            "" if used is None else f"{used}/{used + dropped}",
            str(len(report["flags"]) or "none"),
        )
    return table


def _expected(report: Mapping[str, Any]) -> str:
    """Return what the budget expects to be lost, and by what most."""
    focus = report.get("focus") or {}
    if "expected_db" not in focus:
        return ""
    stated = [line for line in report.get("budget", ()) if not line["stated"].startswith(_NOT_STATED)]
    most = min(stated, key=lambda line: line["loss_db"], default=None)
    by = f", {most['cause']}" if most and focus["expected_db"] < -0.05 else ""
    return f"{abs(focus['expected_db']):.1f} dB{by}"


def _silent(report: Mapping[str, Any]) -> list[str]:
    """Return the causes of the budget whose size nobody has stated."""
    return [line["cause"] for line in report.get("budget", ()) if line["stated"].startswith(_NOT_STATED)]
