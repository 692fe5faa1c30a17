"""Check that the files named in flights.tsv and config.yaml are readable, and that memory and disk suffice."""

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
"""Folder for plugins installed by jobs, relative to the working directory (Snakemake 9, `PIP_DEPLOYMENTS_PATH`)."""

_KEPT = (
    "If the settings of the echo are unchanged, transfer functions kept by `processing: {keep: [echo]}` replace the "
    "recording."
)

_RECORDS = ("metadata", "incomplete")
"""Folders of Snakemake's records, which are not needed and can be removed if damaged."""


def check_flights(examined: "Examination") -> Iterator[CampaignError]:
    """Yield a problem if no flight is of kind image or bench."""
    if {flight.kind for flight in examined.campaign.flights} <= {"calibration"}:
        yield CampaignError(
            f"{number_of(len(examined.campaign.flights), 'flight')}, none of kind image",
            where=examined.campaign.root / FLIGHTS,
            expected="at least one flight of kind image or bench",
            remedy="Add such a flight, or correct the kind of a flight.",
        )


def check_files(examined: "Examination") -> Iterator[CampaignError]:
    """Yield a problem for each file that is missing, empty, dated in the future or not readable."""
    campaign = examined.campaign
    required_by = _wanted(examined)
    for flight in campaign.flights:
        yield from _recorded(campaign, flight, required_by)
    lookups: list[Callable[[], dict[str, ConfinedPath]]] = [
        lambda: {f"scene.{role}": path for role, path in campaign.height_files().items()}
    ]
    lookups += [partial(campaign.pattern_files, pair) for flight in campaign.image_flights for pair in flight.pairs]
    if campaign.settings.processing.radiometric_calibration:
        lookups.append(lambda: {"processing.radiometric_calibration": campaign.calibration_file or campaign.root})
    waveform = campaign.settings.waveform
    if isinstance(waveform, SampledWaveform):
        lookups.append(lambda: {f"waveform.{waveform.file_key}": path for path in campaign.sent_files})
    for lookup in lookups:
        try:
            named = lookup()
        except CampaignError as problem:  # a path outside the folder
            yield problem
            continue
        for key, path in named.items():
            remedy = f"Copy the file there, or correct {key}."
            yield from _readable(path, f"the file named in {CONFIG}: {key}", remedy)


def _wanted(examined: Examination) -> Callable[[str], str | None]:
    """Return a function that maps the name of an absent recording file to the result that a run would compute from it.

    The function returns '' if no run needs the file, and None if the file was never an input, or if this is unknown.
    """

    @cache
    def files() -> tuple[dict[str, str], list[str]] | None:
        try:
            return wanted_files(examined.campaign, examined.stale), absent_files(examined.campaign)
        except CampaignError:  # reported by other checks
            return None

    def required_by(name: str) -> str | None:
        known = files()
        return known[0].get(name, "") if known and name in known[1] else None

    return required_by


def _recorded(campaign: Campaign, flight: Flight, required_by: Callable[[str], str | None]) -> Iterator[CampaignError]:
    """Yield problems of the files of a flight: samples and logs, or phase histories."""
    if not isinstance(campaign.settings.waveform, SampledWaveform):
        for node in flight.nodes:
            yield from _looked_up(lambda node=node: list(campaign.raw_files(flight.name, node).values()))  # type: ignore[misc]
        return
    for node in flight.recorded:
        expected = f"the recording of node {node} in flight {flight.name}"
        remedy = f"Copy the recording there, or remove {node} from the nodes of {flight.name} in {FLIGHTS}."
        try:
            promised = campaign.promised_files(flight.name, node)
        except CampaignError as problem:  # invalid metadata
            yield problem
            promised = ()
        for path in promised:
            try:
                exists = path.is_file()
            except CampaignError as problem:  # a link
                yield problem
                continue
            if exists or (result := required_by(campaign.relative(path))) is None:
                yield from _readable(path, expected, remedy)
            elif result:
                yield from _readable(path, f"{expected}, to recompute {result}", f"{remedy} {_KEPT}")
        if flight.kind != "bench":
            yield from _looked_up(lambda node=node: [campaign.track_file(flight.name, node)])  # type: ignore[misc]


def _looked_up(files: Callable[[], list[ConfinedPath]]) -> Iterator[CampaignError]:
    """Yield the error raised by the lookup of files, or the problems of the files found."""
    try:
        paths = files()
    except CampaignError as problem:
        yield problem
        return
    for path in paths:
        yield from _readable(path, "the recorded file", "Copy the file again.")


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
            f"the modification time is {(state.st_mtime - time.time()) / 3600:.1f} h in the future",
            where=path,
            expected="a modification time in the past, according to the clock of this machine",
            remedy=f"Set the clock, or run `touch {path}`: Snakemake rejects inputs dated in the future.",
        )
    elif state.st_size == 0:
        yield CampaignError("empty, 0 bytes", where=path, expected=expected, remedy="Copy the file again.")
    elif not path.permits(os.R_OK):
        yield CampaignError("no read permission", where=path, expected=expected, remedy=f"Run `chmod u+r {path}`.")


def check_raw_root(examined: "Examination") -> Iterator[CampaignError]:
    """Yield a problem if the configured raw_root does not exist, or raw/ contains files that are not read."""
    campaign, stated = examined.campaign, examined.campaign.settings.raw_root
    if not stated:
        return
    if not Path(stated).is_dir():
        yield CampaignError(
            f"{stated} is not a folder",
            where="raw_root",
            expected="the folder that contains <flight>/<node>.*",
            remedy="Mount the folder, or correct raw_root, or copy the recordings to raw/ and remove raw_root.",
        )
    own = ConfinedPath.at(Path(campaign.root)) / "raw"
    if any(files for _, _, files in own.walk()):
        yield CampaignError(
            f"raw/ contains files, although raw_root is {stated}",
            where="raw_root",
            expected="recordings in only one of the two folders",
            remedy="Move the files to raw_root, or remove raw_root.",
        )


def check_links(examined: "Examination") -> Iterator[CampaignError]:
    """Yield a problem for each symbolic link inside, or in place of, the folders results and .snakemake."""
    root = examined.campaign.root
    for top in (root / "results", root / ".snakemake"):
        below = () if top.is_symlink() else (folder / name for folder, _, names in top.walk() for name in names)
        for path in (top, *below):
            if path.is_symlink():
                yield CampaignError(
                    "a symbolic link",
                    where=path,
                    expected="a folder or a file, because Snakemake writes and deletes files through links",
                    remedy="Remove the link. To store results elsewhere, move the whole campaign folder.",
                )


def check_modules(examined: "Examination") -> Iterator[CampaignError]:
    """Yield a problem if the folder that Snakemake adds to the module search path of every job contains modules."""
    folder = examined.campaign.root / _IMPORTED
    if folder.is_dir() and any(folder.iterdir()):
        yield CampaignError(
            "Python modules in a folder of Snakemake",
            where=folder,
            expected="a campaign folder without code, because every job would import these modules",
            remedy="Remove the folder, and install Snakemake plugins in the environment of apertura.",
        )


def drop_damaged_records(root: ConfinedPath) -> int:
    """Remove the records of earlier runs that Snakemake cannot read; return their number.

    Out-of-date results are detected by hashes, not by these records. Only the run times of earlier jobs are lost.
    """
    records = root / ".snakemake"
    damaged = [path for folder in _RECORDS for path in (records / folder).rglob("*") if _is_damaged(path)]
    for path in damaged:
        path.unlink()
    if (records / "metadata").is_dir():
        (records / "incomplete").mkdir(exist_ok=True)  # without this folder Snakemake assumes records of version 7
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
_CAPTURE_BYTES = 1100  # memory for the metadata of a capture during reading; samples are read in blocks
_RAW_BYTES = 10  # disk space per capture in the stage raw, compressed
_ECHO_SHARE = 0.95  # assumed fraction of the pulses that are not excluded; 8 bytes per pulse and subcarrier
PIXEL_BYTES = 36  # disk space per pixel and pair for image, cube and three rasters, compressed; 76 uncompressed
MEMINFO = Path("/proc/meminfo")


def check_writable(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem for the campaign folder or its results folder if it is not writable."""
    campaign = examined.campaign
    for folder in (campaign.root, campaign.results):
        if folder.exists() and not (folder.is_dir() and folder.permits(os.W_OK | os.X_OK)):
            yield CampaignError(
                "no write permission" if folder.is_dir() else "not a folder",
                where=folder,
                expected="a writable folder for results",
                remedy="Copy the campaign to a writable disk, or change the folder's permissions.",
            )


def check_memory(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem if the metadata of the longest recording do not fit into memory; samples are read in blocks."""
    if not examined.recorded:
        return
    key, captures = max(
        ((key, recording.captures) for key, recording in examined.recorded.items()), key=lambda item: item[1]
    )
    needed = _BASE_BYTES + _CAPTURE_BYTES * captures
    if needed > (free := free_memory()):
        yield CampaignError(
            f"{captures} captures of {key[1]} in {key[0]} need at least {needed / 1e9:.1f} GB of memory",
            where=examined.recordings[key].files[-1],
            expected=f"at most {free / 1e9:.1f} GB, the memory available to this process",
            remedy="Use a machine with more memory, stop other processes, or split the recording into several flights.",
        )


def free_memory(meminfo: Path = MEMINFO) -> int:
    """Return the memory available to this process, bytes: free memory of the machine, or limit of the control group.

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
    """Yield a problem if the free disk space is less than the size of the results that are still to be computed."""
    campaign = examined.campaign
    needed = sum(disk_bytes(examined).values())
    folder = campaign.results if campaign.results.is_dir() else campaign.root
    free = folder.free_bytes()
    if needed > free:
        parts = ", ".join(f"{name} {size / 1e6:.0f} MB" for name, size in disk_bytes(examined).items() if size)
        yield CampaignError(
            f"remaining results need at least {needed / 1e6:.0f} MB ({parts})",
            where=folder,
            expected=f"at most {free / 1e6:.0f} MB, the free disk space",
            remedy="Free disk space, copy the campaign to a larger disk, or make the scene smaller.",
        )


def disk_bytes(examined: Examination) -> dict[str, int]:
    """Return stage → lower bound of the bytes still to be written; stages with a manifest are already complete."""
    campaign, transmitted = examined.campaign, examined.transmitted
    raw = sum(
        _RAW_BYTES * recording.captures
        for key, recording in examined.recorded.items()
        if not recording.runs_through and not _has_result(examined, "raw", *key)
    )
    pixels = examined.grid.shape[0] * examined.grid.shape[1] if examined.grid else 0
    if campaign.settings.scene.spacing_m == "auto":
        pixels = 0
    echo = images = 0
    for flight in campaign.flights:
        recorded = examined.recorded.get((flight.name, flight.transmitter))
        pulses = recorded.captures if recorded and not recorded.runs_through else 0
        for pair in flight.pairs:
            if transmitted and not _has_result(examined, "echo", flight.name, pair):
                echo += round(_ECHO_SHARE * 8 * pulses * transmitted.numerology.numbers.size)
            if flight.kind == "image" and not _has_result(examined, "image", flight.name, pair):
                images += PIXEL_BYTES * pixels
    return {"raw": raw, "echo": echo, "images": images}


def _has_result(examined: Examination, stage: str, *where: str) -> bool:
    return (examined.campaign.root / examined.campaign.manifest(stage, *where)).is_file()


def check_scheduler(examined: Examination) -> Iterable[CampaignError]:
    """Raise CampaignError if the user has not enabled the configured scheduler."""
    scheduler = examined.campaign.settings.processing.scheduler
    if scheduler != "threads":
        from apertura.core.backprojection.tiles import check_named

        check_named(scheduler)
    return ()
