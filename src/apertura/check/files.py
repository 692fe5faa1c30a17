"""Check that the files of flights.tsv and the config are present and readable, and that memory and disk suffice."""

import json
import os
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from apertura.campaign.config import CONFIG, FLIGHTS, Flight, SampledWaveform
from apertura.campaign.folder import Campaign
from apertura.check.examination import Examination
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError, number_of
from apertura.workflow.stale import absent_files, wanted_files

if TYPE_CHECKING:
    from apertura.check.examination import Examination

_AHEAD_S = 5.0
_IMPORTED = ".snakemake/pip-deployments"
"""Relative to the working folder (snakemake 9, `PIP_DEPLOYMENTS_PATH`): for plugins that a job installs itself."""

_KEPT = "Where the echo stays as it is, transfer functions that `processing: {keep: [echo]}` has kept replace it."

_RECORDS = ("metadata", "incomplete")
"""Folders of Snakemake's records, of no use where they are damaged, and of no harm to lose."""


def check_flights(examined: "Examination") -> Iterator[CampaignError]:
    """Yield a problem where no flight becomes an image, and none is measured on a bench."""
    if {flight.kind for flight in examined.campaign.flights} <= {"calibration"}:
        yield CampaignError(
            f"{number_of(len(examined.campaign.flights), 'flight')}, none of kind image",
            where=examined.campaign.root / FLIGHTS,
            expected="at least one flight of kind image, or bench",
            remedy="Add one, or correct its kind.",
        )


def check_files(examined: "Examination") -> Iterator[CampaignError]:
    """Yield every file that is missing, empty, dated in the future or may not be read."""
    campaign = examined.campaign
    wanted = _wanted(examined)
    for flight in campaign.flights:
        yield from _recorded(campaign, flight, wanted)
    lookups: list[Callable[[], dict[str, ConfinedPath]]] = [
        lambda: {f"scene.{role}": path for role, path in campaign.height_files().items()}
    ]
    lookups += [partial(campaign.pattern_files, pair) for flight in campaign.image_flights for pair in flight.pairs]
    if campaign.settings.processing.radiometric_calibration:
        lookups.append(lambda: {"processing.radiometric_calibration": campaign.calibration_file or campaign.root})
    waveform = campaign.settings.waveform
    if isinstance(waveform, SampledWaveform):
        lookups.append(lambda: {f"waveform.{waveform.file_key}": campaign.sent_file})
    for lookup in lookups:
        try:
            named = lookup()
        except CampaignError as problem:  # a path that leaves the folder
            yield problem
            continue
        for key, path in named.items():
            yield from _readable(path, f"the file of {CONFIG}: {key}", f"Copy it there, or correct {key}.")


def _wanted(examined: Examination) -> Callable[[str], str | None]:
    """Return a function of a recording's file that is not there: the result that a run would make of it.

    Empty where it would make none, None where nothing was made of it or this is unknown.
    """

    @cache
    def files() -> tuple[dict[str, str], list[str]] | None:
        try:
            return wanted_files(examined.campaign, examined.stale), absent_files(examined.campaign)
        except CampaignError:  # other checks report it
            return None

    def wanted(name: str) -> str | None:
        known = files()
        return known[0].get(name, "") if known and name in known[1] else None

    return wanted


def _recorded(campaign: Campaign, flight: Flight, wanted: Callable[[str], str | None]) -> Iterator[CampaignError]:
    """Yield faults of the files of a flight: samples and logs, or phase history."""
    if not isinstance(campaign.settings.waveform, SampledWaveform):
        for node in flight.nodes:
            yield from _looked_up(lambda node=node: list(campaign.raw_files(flight.name, node).values()))  # type: ignore[misc]
        return
    for node in flight.recorded:
        expected = f"the recording of node {node} in flight {flight.name}"
        remedy = f"Copy it there, or take {node} out of the nodes of {flight.name} in {FLIGHTS}."
        try:
            promised = campaign.promised_files(flight.name, node)
        except CampaignError as problem:  # metadata that name files
            yield problem
            promised = ()
        for path in promised:
            try:
                there = path.is_file()
            except CampaignError as problem:  # a link
                yield problem
                continue
            if there or (made := wanted(campaign.relative(path))) is None:
                yield from _readable(path, expected, remedy)
            elif made:
                yield from _readable(path, f"{expected}, to make {made} again", f"{remedy} {_KEPT}")
        if flight.kind != "bench":
            yield from _looked_up(lambda node=node: [campaign.track_file(flight.name, node)])  # type: ignore[misc]


def _looked_up(files: Callable[[], list[ConfinedPath]]) -> Iterator[CampaignError]:
    """Yield the error of looking for files, or what is wrong with those that are there."""
    try:
        paths = files()
    except CampaignError as problem:
        yield problem
        return
    for path in paths:
        yield from _readable(path, "what was recorded", "Copy it again.")


def _readable(path: ConfinedPath, expected: str, remedy: str) -> Iterator[CampaignError]:
    try:
        state = path.stat() if path.is_file() else None
    except CampaignError as problem:  # a link
        yield problem
        return
    if state is None:
        yield CampaignError("no such file", where=path, expected=expected, remedy=remedy)
    elif state.st_mtime > time.time() + _AHEAD_S:
        yield CampaignError(
            f"dated {(state.st_mtime - time.time()) / 3600:.1f} h in the future",
            where=path,
            expected="a time that has been, by this machine's clock",
            remedy=f"Set the clock, or run `touch {path}`: Snakemake takes no input from the future.",
        )
    elif state.st_size == 0:
        yield CampaignError("empty, 0 bytes", where=path, expected=expected, remedy="Copy it again.")
    elif not path.permits(os.R_OK):
        yield CampaignError("may not be read", where=path, expected=expected, remedy=f"Run `chmod u+r {path}`.")


def check_raw_root(examined: "Examination") -> Iterator[CampaignError]:
    """Yield a problem where the stated folder of recordings is not there, or raw/ holds files that are not read."""
    campaign, stated = examined.campaign, examined.campaign.settings.raw_root
    if not stated:
        return
    if not Path(stated).is_dir():
        yield CampaignError(
            f"{stated} is no folder",
            where="raw_root",
            expected="the folder that holds <flight>/<node>.*",
            remedy="Mount or correct it, or copy the recordings to raw/ and leave raw_root out.",
        )
    own = ConfinedPath.at(Path(campaign.root)) / "raw"
    if any(files for _, _, files in own.walk()):
        yield CampaignError(
            f"raw/ holds files, and raw_root is {stated}",
            where="raw_root",
            expected="recordings in one of the two",
            remedy="Move the files there, or leave raw_root out.",
        )


def check_links(examined: "Examination") -> Iterator[CampaignError]:
    """Yield an error for each symbolic link that the results, or Snakemake's own records, hold or are."""
    root = examined.campaign.root
    for top in (root / "results", root / ".snakemake"):
        below = () if top.is_symlink() else (folder / name for folder, _, names in top.walk() for name in names)
        for path in (top, *below):
            if path.is_symlink():
                yield CampaignError(
                    "a symbolic link",
                    where=path,
                    expected="a folder or a file: Snakemake would write and delete through a link",
                    remedy="Remove it; to keep results elsewhere, put the whole campaign folder there.",
                )


def check_modules(examined: "Examination") -> Iterator[CampaignError]:
    """Yield an error where modules lie in the folder that Snakemake puts on its search path in every job."""
    folder = examined.campaign.root / _IMPORTED
    if folder.is_dir() and any(folder.iterdir()):
        yield CampaignError(
            "Python modules in Snakemake's own folder",
            where=folder,
            expected="a campaign folder without code: every job would import them",
            remedy="Remove that folder; plugins of Snakemake are installed beside apertura.",
        )


def drop_damaged_records(root: ConfinedPath) -> int:
    """Remove the records of earlier runs that Snakemake could not read; return how many.

    Hashes say what is stale, not these records: without them, a report only lacks how long earlier jobs took.
    """
    records = root / ".snakemake"
    damaged = [path for folder in _RECORDS for path in (records / folder).rglob("*") if _is_damaged(path)]
    for path in damaged:
        path.unlink()
    if (records / "metadata").is_dir():
        (records / "incomplete").mkdir(exist_ok=True)  # without it Snakemake takes the records for those of version 7
    return len(damaged)


def _is_damaged(path: ConfinedPath) -> bool:
    is_file = path.is_file(follow_symlinks=False)
    if not is_file or path.name == "migration_underway":
        return is_file
    try:
        return not isinstance(json.loads(path.read_bytes() or b"{}"), dict)
    except (ValueError, RecursionError):
        return True


_BASE_BYTES = 120_000_000  # the interpreter and its libraries
_CAPTURE_BYTES = 1100  # of the metadata of a capture while they are read; samples are read in blocks
_RAW_BYTES = 10  # of a capture in the stage raw, compressed
_ECHO_SHARE = 0.95  # of 8 bytes per pulse and subcarrier, which are not compressed; the rest for pulses that drop out
PIXEL_BYTES = 36  # per pixel and pair: image, its part of the cube, three rasters, compressed; 76 before
MEMINFO = Path("/proc/meminfo")


def check_writable(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem where neither the campaign folder nor its results may be written: a read-only disk, another's."""
    campaign = examined.campaign
    for folder in (campaign.root, campaign.results):
        if folder.exists() and not (folder.is_dir() and folder.permits(os.W_OK | os.X_OK)):
            yield CampaignError(
                "may not be written" if folder.is_dir() else "is no folder",
                where=folder,
                expected="a folder in which results can be made",
                remedy="Copy the campaign to a disk of your own, or change the folder's permissions.",
            )


def check_memory(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem where the metadata of the longest recording do not fit into memory; samples need none."""
    if not examined.recorded:
        return
    key, captures = max(
        ((key, recording.captures) for key, recording in examined.recorded.items()), key=lambda item: item[1]
    )
    needed = _BASE_BYTES + _CAPTURE_BYTES * captures
    if needed > (free := free_memory()):
        yield CampaignError(
            f"{captures} captures of {key[1]} in {key[0]} take at least {needed / 1e9:.1f} GB of memory",
            where=examined.recordings[key].files[-1],
            expected=f"at most the {free / 1e9:.1f} GB that this process may use now",
            remedy="Run on a machine with more memory, end other work, or cut the recording into several flights.",
        )


def free_memory(meminfo: Path = MEMINFO) -> int:
    """Return the bytes of memory that are free for this process: the machine's, or what its control group allows.

    Examples
    --------
    >>> 0 < free_memory() <= free_memory(Path("none"))
    True
    """
    from apertura.core.planning.plan import memory_limit

    lines = meminfo.read_text(encoding="utf-8").splitlines() if meminfo.is_file() else []
    stated = [int(line.split()[1]) * 1024 for line in lines if line.startswith(("MemAvailable:", "SwapFree:"))]
    return min(memory_limit(), sum(stated)) if stated else memory_limit()


def check_disk(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem where the file system of the results has less left than the stages still to be made."""
    campaign = examined.campaign
    needed = sum(disk_bytes(examined).values())
    folder = campaign.results if campaign.results.is_dir() else campaign.root
    free = folder.free_bytes()
    if needed > free:
        parts = ", ".join(f"{name} {size / 1e6:.0f} MB" for name, size in disk_bytes(examined).items() if size)
        yield CampaignError(
            f"results take at least {needed / 1e6:.0f} MB more ({parts})",
            where=folder,
            expected=f"at most the {free / 1e6:.0f} MB that are free",
            remedy="Free some space, copy the campaign to a larger disk, or make the scene smaller.",
        )


def disk_bytes(examined: Examination) -> dict[str, int]:
    """Return stage → bytes that are at least still to be written; stages with a manifest are there already."""
    campaign, transmitted = examined.campaign, examined.transmitted
    raw = sum(
        _RAW_BYTES * recording.captures
        for key, recording in examined.recorded.items()
        if not recording.runs_through and not _made(examined, "raw", *key)
    )
    pixels = examined.grid.shape[0] * examined.grid.shape[1] if examined.grid else 0
    if campaign.settings.scene.spacing_m == "auto":
        pixels = 0
    echo = images = 0
    for flight in campaign.flights:
        recorded = examined.recorded.get((flight.name, flight.transmitter))
        pulses = recorded.captures if recorded and not recorded.runs_through else 0
        for pair in flight.pairs:
            if transmitted and not _made(examined, "echo", flight.name, pair):
                echo += round(_ECHO_SHARE * 8 * pulses * transmitted.numerology.numbers.size)
            if flight.kind == "image" and not _made(examined, "image", flight.name, pair):
                images += PIXEL_BYTES * pixels
    return {"raw": raw, "echo": echo, "images": images}


def _made(examined: Examination, stage: str, *where: str) -> bool:
    return (examined.campaign.root / examined.campaign.manifest(stage, *where)).is_file()


def check_scheduler(examined: Examination) -> Iterable[CampaignError]:
    """Raise for a scheduler that the user has not named."""
    scheduler = examined.campaign.settings.processing.scheduler
    if scheduler != "threads":
        from apertura.core.backprojection.tiles import check_named

        check_named(scheduler)
    return ()
