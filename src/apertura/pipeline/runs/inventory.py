"""`apertura list`: what a campaign has, and what is finished, overtaken or missing."""

import os
from collections import defaultdict
from pathlib import Path

from apertura.pipeline.campaign import Campaign
from apertura.pipeline.check.stale import stale_results
from apertura.pipeline.lineage import on_demand, results_of
from apertura.pipeline.runs.removal import in_bytes

_HEADINGS = ("flight", "of", "finished", "stale", "missing", "size")
_COLOURS = {"finished": "green", "stale": "yellow", "missing": ""}

Place = tuple[str, ...]


def print_list(campaign: Campaign) -> None:
    """Print a row for each place of the results: what of it is finished, stale or missing, and its size."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    found = states(campaign)
    sizes = _sizes(campaign.results, set(found))
    kinds = {flight.name: flight.kind for flight in campaign.flights}
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in _HEADINGS:
        table.add_column(heading, justify="right" if heading == "size" else "left", no_wrap=heading == "of")
    for place in sorted(found, key=lambda place: (place[:1] not in {(name,) for name in kinds}, place)):
        flight, *of = place if place and place[0] in kinds else ("", *(place or ("campaign",)))
        mark = f" ({kinds[flight]})" if kinds.get(flight, "image") != "image" and not of else ""
        cells = [", ".join(found[place][state]) for state in _COLOURS]
        coloured = [
            f"[{colour}]{cell}[/]" if cell and colour else cell
            for cell, colour in zip(cells, _COLOURS.values(), strict=True)
        ]
        table.add_row(flight, (*of, f"flight{mark}")[0], *coloured, in_bytes(sizes[place]))
    console = Console(highlight=False)
    console.print(table)
    wip = sum(1 for _, folders, _ in os.walk(campaign.results) for name in folders if name.endswith(".zarr.wip"))
    console.print(
        f"{in_bytes(sum(sizes.values()))} in results" + (f", {wip} stages under way or left unfinished" if wip else "")
    )


def states(campaign: Campaign) -> dict[Place, dict[str, list[str]]]:
    """Return place below the results → finished, stale, missing → names of results."""
    stale = stale_results(campaign)
    found: dict[Place, dict[str, list[str]]] = defaultdict(lambda: {state: [] for state in _COLOURS})
    for name, result in results_of(campaign):
        there = (campaign.root / result.manifest).is_file()
        place = Path(result.manifest).parent.parts[1:]
        if there or result.manifest in stale or not on_demand(result.manifest):
            state = "stale" if result.manifest in stale else "finished" if there else "missing"
            found[place][state].append("export" if name == "fused" else name)
    return dict(found)


def _sizes(results: Path, places: set[Place]) -> dict[Place, int]:
    """Return how many bytes lie in each place; what lies in no other counts for the campaign."""
    sizes = dict.fromkeys({*places, ()}, 0)
    for folder, _, names in os.walk(results):
        parts = Path(folder).relative_to(results).parts
        place = next(parts[:depth] for depth in range(len(parts), -1, -1) if parts[:depth] in sizes)
        sizes[place] += sum(Path(folder, name).lstat().st_size for name in names)
    return sizes
