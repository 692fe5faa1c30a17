"""`apertura summary`: what every image of a finished campaign says of itself, in one table with its flags below."""

from typing import TYPE_CHECKING, Any

from apertura.campaign import Campaign
from apertura.documents import undamaged
from apertura.errors import shown
from apertura.store import open_listed

if TYPE_CHECKING:
    from rich.table import Table

_HEADINGS = ("flight", "image", "focus", "expected", "pairs in phase", "numerical error", "pulses", "dropped", "flags")


def print_summary(campaign: Campaign) -> None:
    """Print verdict, expected loss, coherence, numerical error, pulses and flags of each image; each flag once, whole.

    Raises
    ------
    CampaignError
        If an image is not there.
    """
    from rich.console import Console

    reports = {
        (flight.name, name): _report(campaign, flight.name, name)
        for flight in campaign.image_flights
        for name in (*flight.pairs, "fused")
    }
    console = Console(width=max(120, Console().width))
    console.print(_table(reports))
    said: set[str] = set()
    for (flight, _), report in reports.items():
        for flag, line in report["flags"].items():
            if line not in said:
                said.add(line)
                console.print(f"[yellow]{flag}[/yellow] (flight {flight}): ", end="")
                console.print(line, markup=False)


def _report(campaign: Campaign, flight: str, name: str) -> dict[str, Any]:
    path = campaign.result(flight, name, "image.json")
    report = open_listed(path, path.with_name("export.manifest.json"))
    with undamaged(path, expected="the report of an image", remedy="Run the workflow again."):
        flags = {shown(flag): shown(line, 2000) for flag, line in report["flags"].items()}
        return {**report, "flags": flags, "numerical_error_db": float(report["numerical_error_db"])}


def _table(reports: dict[tuple[str, str], dict[str, Any]]) -> "Table":
    from rich.table import Table

    table = Table(title="what each image says of itself", title_justify="left")
    for heading in _HEADINGS:
        table.add_column(heading, overflow="fold")
    for (flight, name), report in reports.items():
        focus, pulses, coherence = (report.get(key) or {} for key in ("focus", "pulses", "coherence"))
        lost = f", {abs(focus['loss_db']):.1f} dB lost" if "loss_db" in focus else ""
        unstated = sum(line["stated"].startswith("not stated") for line in report.get("budget", ()))
        silent = f", {unstated} causes not stated" if unstated else ""
        expected = f"{abs(focus['expected_db']):.1f} dB{silent}" if "expected_db" in focus else ""
        mean, alone = coherence.get("mean"), len((report.get("fusion") or {}).get("left_out", ()))
        together = "" if mean is None else f"{mean:.3f} (chance {coherence['chance']:.2f})"
        table.add_row(
            flight,
            name,
            f"{focus.get('verdict', '')}{lost}",
            expected,
            f"{together} {alone} left out".strip() if alone else together,
            f"< {report['numerical_error_db']:.1f} dB",
            str(pulses.get("used", "")),
            str(pulses.get("dropped", "")),
            ", ".join(report["flags"]) or "none",
        )
    return table
