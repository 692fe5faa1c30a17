"""What a plan takes: bytes of memory and disk, and the blocks of pulses that are in memory at once."""

import os
from pathlib import Path

from rich.filesize import decimal

from apertura.core.focus.engines.engine import Setting
from apertura.core.focus.job import Job
from apertura.core.focus.presum import Presum
from apertura.core.planning.plan import Decision

BLOCK_BYTES = 512 << 20
"""Of a block of pulses in memory at most, read and as tables: longer flights go block by block."""

_BASE_BYTES = 350_000_000  # the interpreter and its libraries
_PULSE_BYTES = 500  # of a pulse whose samples are not in memory: phase centres, axes, copies of them
_TILE_BYTES = 150  # per pixel in work: positions, their projection, the sum
_READ_BYTES = 3  # per byte of a block while it is read: as stored, as decoded, where it goes
_SUM_BYTES = 8  # per pixel of the sum of pulse blocks
_CHECKED_PULSES, _CHECKED_BYTES = 1024, 40  # read at once for certificate and focus; bytes per subcarrier of one
_LEAST_PULSES = 64  # of a block: the kernel sums that many at a time
_PRODUCT_BYTES = 76  # per pixel: image, its part of the cube, three rasters with overviews, before compression


def pulse_blocks(setting: Setting, job: Job, presum: Presum | None, *, asked: int | None = None) -> int:
    """Return into how many blocks pulses are split: as few as fit into the job's memory, or those asked for.

    Where not even the smallest blocks fit, those are taken, and the plan's bytes say that the job does not fit.
    """
    pulses = len(job.aperture) if presum is None else len(presum.at)
    held = _held_bytes(setting, job, presum)
    room = min(BLOCK_BYTES, max(1.0, job.memory_bytes - _forming_bytes(job)))
    if asked is None and held <= room:
        return 1
    less = min(BLOCK_BYTES, max(1.0, job.memory_bytes - _forming_bytes(job) - _SUM_BYTES * job.pixels))
    wanted = asked or -(-held // less)
    return int(min(wanted, max(1, pulses // _LEAST_PULSES)))


def block_decision(chosen: Setting, job: Job, presum: Presum | None, *, asked: bool) -> Decision:
    """Return the choice of pulse blocks with its reason; that of one block does not depend on the machine."""
    size = f"{decimal(int(_held_bytes(chosen, job, presum)))} of samples and tables"
    if asked:
        why = f"asked for, in blocks of {_LEAST_PULSES} pulses or more; {size} in all"
    elif chosen.pulse_blocks > 1:
        room = decimal(int(min(job.memory_bytes, BLOCK_BYTES)))
        why = f"{size} are more than the {room} of memory that a block may take"
    else:
        why = f"{size} fit into memory"
    return Decision("pulse_blocks", chosen.pulse_blocks, why)


def bytes_needed(job: Job, chosen: Setting, presum: Presum | None) -> tuple[int, int]:
    """Return peak memory of the imaging step, and what the pair leaves on disk, bytes."""
    pulses = len(job.aperture)
    sums = _SUM_BYTES * job.pixels if chosen.pulse_blocks > 1 else 0
    forming = sums + _held_bytes(chosen, job, presum) // chosen.pulse_blocks
    checking = _CHECKED_BYTES * min(pulses, _CHECKED_PULSES) * job.subcarriers
    stages = 8 * pulses * (job.subcarriers + job.signal.samples)
    return _forming_bytes(job) + max(forming, checking), stages + _PRODUCT_BYTES * job.pixels


def _held_bytes(setting: Setting, job: Job, presum: Presum | None) -> int:
    """Return what all pulses would hold in memory at once, as they are read and as tables."""
    samples = job.signal.samples if setting.table_bytes else job.subcarriers
    virtual = 0 if presum is None else 16 * (len(job.aperture) + len(presum.at)) * samples
    return _READ_BYTES * 8 * len(job.aperture) * samples + virtual + setting.table_bytes


def _forming_bytes(job: Job) -> int:
    """Return what is in memory while tiles are formed, but for the samples of pulses and their tables."""
    tiles = min(job.threads, job.tiles) * _TILE_BYTES * min(job.tile_px**2, job.pixels)
    return _BASE_BYTES + _PULSE_BYTES * len(job.aperture) + tiles


def memory_limit(*, groups: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> int:
    """Return the bytes of memory that this process may use: the machine's, or less where a control group says so.

    Batch systems and containers limit a job by a control group (version 1 or 2); a limit of any group above the
    process's own counts as well.

    Parameters
    ----------
    groups, root
        Where Linux lists the groups of a process, and where their files are.

    Notes
    -----
    Source: Linux kernel documentation, admin-guide/cgroup-v2 (memory.max) and cgroup-v1/memory.

    Examples
    --------
    >>> 0 < memory_limit() <= memory_limit(groups=Path("none"))
    True
    """
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for line in groups.read_text(encoding="utf-8").splitlines() if groups.is_file() else ():
        _, controllers, path = line.split(":", 2)
        name = "memory.max" if controllers == "" else "memory.limit_in_bytes"
        if controllers == "" or "memory" in controllers.split(","):
            top = root / controllers if controllers else root
            own = top / path.lstrip("/")
            stated = [folder / name for folder in (own, *own.parents) if folder.is_relative_to(top)]
            found = [file.read_text(encoding="utf-8").strip() for file in stated if file.is_file()]
            limits += [int(text) for text in found if text.isdecimal()]  # 'max': none
    return min(limits)
