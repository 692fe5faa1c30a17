"""Whether memory, disk and permissions suffice for what is certain to be needed."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from apertura.check.examination import Examination
from apertura.common.errors import CampaignError

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
    """Raise for a scheduler that whoever runs this has not named."""
    scheduler = examined.campaign.settings.processing.scheduler
    if scheduler != "threads":
        from apertura.core.backprojection.tiles import check_named

        check_named(scheduler)
    return ()
