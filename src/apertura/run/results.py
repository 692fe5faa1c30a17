"""Implementation of `apertura list` (states and sizes of results) and `apertura clean` (removal of results)."""

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

_HEADINGS = ("flight", "item", "finished", "out of date", "missing", "size")
_COLOURS = {"finished": "green", "stale": "yellow", "missing": ""}
_LABELS = {"finished": "finished", "stale": "out of date", "missing": "missing"}

_LOCK = ".zarr.lock"
_OWN: Mapping[str, str | tuple[str, ...]] = {
    "logs": ".log",
    "benchmarks": ".tsv",
    ".hashes": ".json",
    RUN: "",
    "preview": (".png", ".json", ".html", ".tif"),
}
"""Folder in the results → suffixes of the files that a run or `apertura preview` writes there."""


def print_list(campaign: Campaign) -> None:
    """Print a row for each folder of the results: finished, out-of-date and missing results, and size."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    states_of = states(campaign)
    sizes = _sizes(campaign.results, set(states_of))
    kinds = {flight.name: flight.kind for flight in campaign.flights}
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in _HEADINGS:
        table.add_column(heading, justify="right" if heading == "size" else "left", no_wrap=heading == "item")
    for folder in sorted(states_of, key=lambda folder: (folder[:1] not in {(name,) for name in kinds}, folder)):
        flight, *item = folder if folder and folder[0] in kinds else ("", *(folder or ("campaign",)))
        mark = f" ({kinds[flight]})" if kinds.get(flight, "image") != "image" and not item else ""
        cells = [", ".join(states_of[folder][state]) for state in _COLOURS]
        coloured = [
            f"[{colour}]{cell}[/]" if cell and colour else cell
            for cell, colour in zip(cells, _COLOURS.values(), strict=True)
        ]
        table.add_row(flight, (*item, f"flight{mark}")[0], *coloured, in_bytes(sizes[folder]))
    console = Console(highlight=False)
    console.print(table)
    wip = sum(name.endswith(".zarr.wip") for _, folders, _ in campaign.results.walk() for name in folders)
    console.print(
        f"{in_bytes(sum(sizes.values()))} in results" + (f", {wip} stages in progress or incomplete" if wip else "")
    )
    for line in absent_lines(campaign):
        console.print(line, soft_wrap=True, markup=False)


def states(campaign: Campaign) -> dict[tuple[str, ...], dict[str, list[str]]]:
    """Return folder relative to the results → state (finished, stale, missing) → names of results."""
    stale = stale_results(campaign)
    states_of: dict[tuple[str, ...], dict[str, list[str]]] = defaultdict(lambda: {state: [] for state in _COLOURS})
    for name, result in results_of(campaign):
        exists = (campaign.root / result.manifest).is_file()
        folder = Path(result.manifest).parent.parts[1:]
        if exists or result.manifest in stale or not on_demand(campaign, result.manifest):
            state = "stale" if result.manifest in stale else "finished" if exists else "missing"
            states_of[folder][state].append("export" if name == "fused" else name)
    return dict(states_of)


def counted(found: Mapping[tuple[str, ...], Mapping[str, list[str]]]) -> str:
    """Return a summary of the number of results in each state, given the return value of `states`.

    Examples
    --------
    >>> counted({(): {"finished": ["cube", "stac"], "stale": [], "missing": []}, ("f01",): {"missing": ["tracks"]}})
    '2 results finished, 1 result missing'
    """
    counts = {state: sum(len(names.get(state, ())) for names in found.values()) for state in _COLOURS}
    return ", ".join(f"{number_of(count, 'result')} {_LABELS[state]}" for state, count in counts.items() if count)


def _sizes(results: ConfinedPath, places: set[tuple[str, ...]]) -> dict[tuple[str, ...], int]:
    """Return the size of each folder, bytes; files outside the given folders are attributed to the campaign."""
    sizes = dict.fromkeys({*places, ()}, 0)
    for folder, _, names in results.walk():
        parts = folder.relative_to(results).parts
        place = next(parts[:depth] for depth in range(len(parts), -1, -1) if parts[:depth] in sizes)
        sizes[place] += sum((folder / name).lstat().st_size for name in names)
    return sizes


def clean(campaign: Campaign, *, unfinished_only: bool, agreed: bool) -> None:
    """Remove the results of the workflow, and report the files that remain.

    Parameters
    ----------
    campaign
        The campaign; its recordings and configuration are never changed.
    unfinished_only
        Remove incomplete results only.
    agreed
        Do not ask for confirmation.

    Raises
    ------
    CampaignError
        If a run locks the campaign, a step is still writing, or confirmation is required but there is no terminal.
    """
    if not campaign.results.is_dir():
        print(f"nothing to remove: {campaign.results} does not exist")
        return
    with hold(campaign.root):
        _refuse_writers(campaign.results)
        files = sorted(set(_unfinished(campaign.results) if unfinished_only else _made(campaign.results)))
        size = sum(path.lstat().st_size for path in files)
        summary = f"{number_of(len(files), 'file')} ({in_bytes(size)}) written by the workflow in {campaign.results}"
        if not files or not (agreed or _is_confirmed(f"remove {summary}?", campaign.root)):
            print("nothing removed")
            return
        for path in files:
            path.unlink(missing_ok=True)
        if not unfinished_only:
            (campaign.root / ".snakemake").remove()
        _drop_empty(campaign.results)
        print(f"removed {summary}")
        kept = [] if unfinished_only else _files(campaign.results)
        if kept:
            more = f" and {len(kept) - 1} more" if len(kept) > 1 else ""
            print(f"kept files that the workflow did not write: {shown(campaign.relative(kept[0]), 400)}{more}")
        elif not unfinished_only:
            campaign.results.remove()  # the folder only contains the lock


def in_bytes(size: int) -> str:
    """Format a size in bytes with a decimal prefix.

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
    """Raise CampaignError if a step left over from an earlier run is still writing a stage."""
    for path in _files(results):
        if path.name.startswith(".") and path.name.endswith(_LOCK):
            with path.open("rb") as lock:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    expected, remedy = "no running step", "Wait for the step to finish, or stop it."
                    raise CampaignError("a step is still writing this stage", path, expected, remedy) from None


def _is_confirmed(question: str, root: Path) -> bool:
    import typer

    if not sys.stdin.isatty():
        raise CampaignError(
            "confirmation is required, but there is no terminal",
            root,
            "a terminal, or --yes",
            "Use --yes to skip the confirmation.",
        )
    return typer.confirm(question)


def _made(results: ConfinedPath) -> Iterator[ConfinedPath]:
    """Yield the files written by the workflow: those listed in manifests and locks, incomplete results, and logs."""
    yield from _unfinished(results)
    for path in _files(results):
        if path.name.endswith(".manifest.json"):
            with suppress(CampaignError):  # files listed in a damaged manifest are not removed
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
    """Yield the existing files listed in a manifest or lock that are inside the folder; links are not followed."""
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
    """Return all files at any depth of a folder, sorted; links are not followed."""
    return sorted(folder / name for folder, _, names in top.walk() for name in names if name != ".run.lock")


def _drop_empty(top: ConfinedPath) -> None:
    for folder, _, _ in reversed(list(top.walk())):
        with suppress(OSError):
            folder.rmdir()
