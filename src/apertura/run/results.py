"""`apertura list` and `apertura clean`: what is finished, stale or missing, and the removal of what a run has made."""

import fcntl
import json
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from apertura.campaign.folder import Campaign
from apertura.campaign.store import read_manifest
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError, number_of, shown
from apertura.common.processes import hold
from apertura.common.progress import RUN
from apertura.workflow.lineage import on_demand, results_of
from apertura.workflow.stale import absent_lines, stale_results

_HEADINGS = ("flight", "of", "finished", "stale", "missing", "size")
_COLOURS = {"finished": "green", "stale": "yellow", "missing": ""}

_LOCK = ".zarr.lock"
_OWN: Mapping[str, str | tuple[str, ...]] = {
    "logs": ".log",
    "benchmarks": ".tsv",
    ".hashes": ".json",
    RUN: "",
    "look": (".png", ".json", ".html", ".tif"),
}
"""Folder of the results → how the names of the files end that a run, or a look, leaves there."""


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
    wip = sum(name.endswith(".zarr.wip") for _, folders, _ in campaign.results.walk() for name in folders)
    console.print(
        f"{in_bytes(sum(sizes.values()))} in results" + (f", {wip} stages under way or left unfinished" if wip else "")
    )
    for line in absent_lines(campaign):
        console.print(line, soft_wrap=True, markup=False)


def states(campaign: Campaign) -> dict[tuple[str, ...], dict[str, list[str]]]:
    """Return place below the results → finished, stale, missing → names of results."""
    stale = stale_results(campaign)
    found: dict[tuple[str, ...], dict[str, list[str]]] = defaultdict(lambda: {state: [] for state in _COLOURS})
    for name, result in results_of(campaign):
        there = (campaign.root / result.manifest).is_file()
        place = Path(result.manifest).parent.parts[1:]
        if there or result.manifest in stale or not on_demand(campaign, result.manifest):
            state = "stale" if result.manifest in stale else "finished" if there else "missing"
            found[place][state].append("export" if name == "fused" else name)
    return dict(found)


def counted(found: Mapping[tuple[str, ...], Mapping[str, list[str]]]) -> str:
    """Return how many results are in each state, of what `states` returns.

    Examples
    --------
    >>> counted({(): {"finished": ["cube", "stac"], "stale": [], "missing": []}, ("f01",): {"missing": ["tracks"]}})
    '2 results finished, 1 result missing'
    """
    counts = {state: sum(len(names.get(state, ())) for names in found.values()) for state in _COLOURS}
    return ", ".join(f"{number_of(count, 'result')} {state}" for state, count in counts.items() if count)


def _sizes(results: ConfinedPath, places: set[tuple[str, ...]]) -> dict[tuple[str, ...], int]:
    """Return how many bytes lie in each place; what lies in no other counts for the campaign."""
    sizes = dict.fromkeys({*places, ()}, 0)
    for folder, _, names in results.walk():
        parts = folder.relative_to(results).parts
        place = next(parts[:depth] for depth in range(len(parts), -1, -1) if parts[:depth] in sizes)
        sizes[place] += sum((folder / name).lstat().st_size for name in names)
    return sizes


def clean(campaign: Campaign, *, unfinished_only: bool, agreed: bool) -> None:
    """Remove what the workflow has made, and say what stays.

    Parameters
    ----------
    campaign
        Whose results; its recordings and config are never touched.
    unfinished_only
        Only work in progress.
    agreed
        Do not ask.

    Raises
    ------
    CampaignError
        If a run holds the campaign, a step still writes, or nobody is there to be asked.
    """
    if not campaign.results.is_dir():
        print(f"nothing to remove: {campaign.results} is not there")
        return
    with hold(campaign.root):
        _refuse_writers(campaign.results)
        files = sorted(set(_unfinished(campaign.results) if unfinished_only else _made(campaign.results)))
        size = sum(path.lstat().st_size for path in files)
        told = f"{number_of(len(files), 'file')}, {in_bytes(size)}, that the workflow has made in {campaign.results}"
        if not files or not (agreed or _is_wanted(f"remove {told}?", campaign.root)):
            print("nothing removed")
            return
        for path in files:
            path.unlink(missing_ok=True)
        if not unfinished_only:
            (campaign.root / ".snakemake").remove()
        _drop_empty(campaign.results)
        print(f"removed {told}")
        kept = [] if unfinished_only else _files(campaign.results)
        if kept:
            more = f" and {len(kept) - 1} more" if len(kept) > 1 else ""
            print(f"kept what it has not made: {shown(campaign.relative(kept[0]), 400)}{more}")
        elif not unfinished_only:
            campaign.results.remove()  # with nothing in it but the lock


def in_bytes(size: int) -> str:
    """Return a size as people say it.

    Examples
    --------
    >>> in_bytes(0), in_bytes(25_300_000), in_bytes(5 * 10**12)
    ('0.0 kB', '25.3 MB', '5.0 TB')
    """
    value, units = size / 1e3, iter(("kB", "MB", "GB"))
    for unit in units:
        if value < 1000:
            return f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} TB"


def _refuse_writers(results: ConfinedPath) -> None:
    """Raise CampaignError if a step that has outlived its run still writes a stage."""
    for path in _files(results):
        if path.name.startswith(".") and path.name.endswith(_LOCK):
            with path.open("rb") as lock:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    expected, remedy = "no step under way", "Wait until it ends, or end it."
                    raise CampaignError("a step still writes it", path, expected, remedy) from None


def _is_wanted(question: str, root: Path) -> bool:
    import typer

    if not sys.stdin.isatty():
        raise CampaignError("nobody to ask", root, "a terminal, or --yes", "Say --yes to remove without being asked.")
    return typer.confirm(question)


def _made(results: ConfinedPath) -> Iterator[ConfinedPath]:
    """Yield what the workflow has made: what manifests and locks of stages list, work in progress, logs."""
    yield from _unfinished(results)
    for path in _files(results):
        if path.name.endswith(".manifest.json"):
            with suppress(CampaignError):  # damaged: its files are nobody's
                yield from _listed(path, read_manifest(path)["files"], below=path.parent)
                yield path
        elif path.name.startswith(".") and path.name.endswith(_LOCK):
            yield path
            with suppress(ValueError, AttributeError, UnicodeDecodeError, CampaignError):
                stage = path.with_name(path.name.removeprefix(".").removesuffix(".lock"))
                yield from _listed(path, json.loads(path.read_text("utf-8") or "{}"), below=stage)
    for folder, suffix in _OWN.items():
        yield from (path for path in _files(results / folder) if path.name.endswith(suffix))


def _listed(where: ConfinedPath, names: dict[str, object], *, below: ConfinedPath) -> Iterator[ConfinedPath]:
    """Yield the files that are there of those that a manifest or a lock lists; none outside, none through a link."""
    for name in names:
        with suppress(CampaignError):
            path = below.named(name, where=where)
            if path.is_file():
                yield path


def _unfinished(results: ConfinedPath) -> Iterator[ConfinedPath]:
    for path in _files(results):
        if any(part.endswith(".zarr.wip") for part in path.relative_to(results).parts[:-1]):
            yield path


def _files(top: ConfinedPath) -> list[ConfinedPath]:
    """Return every file below a folder, links as such, sorted."""
    return sorted(folder / name for folder, _, names in top.walk() for name in names if name != ".run.lock")


def _drop_empty(top: ConfinedPath) -> None:
    for folder, _, _ in reversed(list(top.walk())):
        with suppress(OSError):
            folder.rmdir()
