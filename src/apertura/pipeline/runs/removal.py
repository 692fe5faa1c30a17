"""`apertura clean`: which files of a campaign the workflow has made, and their removal; nothing else is touched."""

import fcntl
import json
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from apertura.common.atomic import remove
from apertura.common.errors import CampaignError, shown
from apertura.common.paths import inside
from apertura.common.processes import hold
from apertura.common.progress import RUN
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.store import read_manifest

_LOCK = ".zarr.lock"
_OWN = {"logs": ".log", "benchmarks": ".tsv", ".hashes": ".json", RUN: ""}
"""Folder of the results → how the names of the files end that a run leaves there."""


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
        told = f"{len(files)} files, {in_bytes(size)}, that the workflow has made in {campaign.results}"
        if not files or not (agreed or _is_wanted(f"remove {told}?", campaign.root)):
            print("nothing removed")
            return
        for path in files:
            path.unlink(missing_ok=True)
        if not unfinished_only:
            remove(inside(campaign.root, ".snakemake", where=campaign.root))
        _drop_empty(campaign.results)
        print(f"removed {told}")
        kept = [] if unfinished_only else _files(campaign.results)
        if kept:
            more = f" and {len(kept) - 1} more" if len(kept) > 1 else ""
            print(f"kept what it has not made: {shown(campaign.relative(kept[0]), 400)}{more}")
        elif not unfinished_only:
            remove(campaign.results)  # with nothing in it but the lock


def in_bytes(size: int) -> str:
    """Return a size as people say it.

    Examples
    --------
    >>> in_bytes(0), in_bytes(25_300_000), in_bytes(5 * 10**12)
    ('0.0 MB', '25.3 MB', '5.0 TB')
    """
    value, units = size / 1e6, iter(("MB", "GB"))
    for unit in units:
        if value < 1000:
            return f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} TB"


def _refuse_writers(results: Path) -> None:
    """Raise CampaignError if a step that has outlived its run still writes a stage."""
    for path in _files(results):
        if path.name.startswith(".") and path.name.endswith(_LOCK):
            with path.open("a+") as lock:
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


def _made(results: Path) -> Iterator[Path]:
    """Yield what the workflow has made: what manifests and locks of stages list, work in progress, logs."""
    yield from _unfinished(results)
    for path in _files(results):
        if path.name.endswith(".manifest.json"):
            with suppress(CampaignError):  # damaged: its files are nobody's
                yield from _listed(path, read_manifest(path)["files"], below=path.parent)
                yield path
        elif path.name.startswith(".") and path.name.endswith(_LOCK):
            yield path
            with suppress(ValueError, AttributeError, UnicodeDecodeError):
                stage = path.with_name(path.name.removeprefix(".").removesuffix(".lock"))
                yield from _listed(path, json.loads(path.read_text("utf-8") or "{}"), below=stage)
    for folder, suffix in _OWN.items():
        yield from (path for path in _files(results / folder) if path.name.endswith(suffix))


def _listed(where: Path, names: dict[str, object], *, below: Path) -> Iterator[Path]:
    """Yield the files that are there of those that a manifest or a lock lists; none outside, none through a link."""
    for name in names:
        with suppress(CampaignError):
            path = inside(below, name, where=where)
            if path.is_file():
                yield path


def _unfinished(results: Path) -> Iterator[Path]:
    for path in _files(results):
        if any(part.endswith(".zarr.wip") for part in path.relative_to(results).parts[:-1]):
            yield path


def _files(top: Path) -> list[Path]:
    """Return every file below a folder, sorted, without following links."""
    return sorted(Path(folder, name) for folder, _, names in os.walk(top) for name in names if name != ".run.lock")


def _drop_empty(top: Path) -> None:
    for folder, _, _ in os.walk(top, topdown=False):
        with suppress(OSError):
            Path(folder).rmdir()
