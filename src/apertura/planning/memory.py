"""What a plan says of its setting, and what it takes: reasons, seconds, bytes, pulse blocks where memory is short."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from apertura.focus.presum import Presum
from apertura.planning.candidates import WIDE_SUM_DB, Setting
from apertura.planning.models import Decision
from apertura.planning.plan import Job

_BASE_BYTES = 350_000_000  # the interpreter and its libraries
_TILE_BYTES = 150  # per pixel in work: positions, their projection, the sum
_READ_BYTES = 3  # per byte of an array while it is read (as stored, as decoded, where it goes) or summed in float64
_SUM_BYTES = 8  # per pixel of the sum of pulse blocks, in a file
_LEAST_PULSES = 64  # of a block: the kernel sums that many at a time
_PRODUCT_BYTES = 60  # per pixel: image, its part of the cube, three rasters with overviews, before compression
_SETTING_KEYS = {"engine", "table_degree", "table_oversampling", "phase_tolerance_rad", "accumulate"}


def setting_decisions(chosen: Setting, asked: Mapping[str, Any], accuracy_db: float) -> Iterator[Decision]:
    """Yield the choices that make up a setting, with their reasons.

    Parameters
    ----------
    chosen
        The setting.
    asked
        Choice → value that a person asks for.
    accuracy_db
        Error asked.
    """

    def why(*keys: str) -> str:
        return "asked for in config/config.yaml; " if any(key in asked for key in keys) else ""

    met = "meets" if chosen.error_db <= accuracy_db else "does not meet"
    rank = "what was asked for" if asked.keys() & _SETTING_KEYS else "cheapest of every engine and setting, to 5 %"
    yield Decision("engine", chosen.engine, f"{why('engine')}{rank}, {met} {accuracy_db:.0f} dB", chosen.error_db)
    if "oversampling" in chosen.options:
        yield Decision("table_oversampling", chosen.options["oversampling"], why("table_oversampling") + chosen.reason)
    if chosen.engine == "native":
        options = {**chosen.options, **chosen.form_options}
        shared, wide, exact = (100 * share for share in chosen.shares)
        paths = (
            f"of pixel·pulses {shared:.0f} % share curvature, {wide:.0f} % take wide windows, {exact:.0f} % exact paths"
        )
        reasons = {
            "table_degree": "cheapest with this oversampling",
            "phase_tolerance_rad": paths,
            "accumulate": f"sums in float32 err by -115 dB, wider below {WIDE_SUM_DB:.0f} dB; paths start in float64",
        }
        names = {"table_degree": "degree", "phase_tolerance_rad": "tolerance_rad", "accumulate": "accumulate"}
        for name, reason in reasons.items():
            yield Decision(name, options[names[name]], why(name) + reason)


def wall_seconds(chosen: Setting, job: Job) -> float:
    """Return the seconds on the job's threads; choices are made on one, so that they do not depend on it."""
    return chosen.table_seconds + (chosen.seconds - chosen.table_seconds) / min(job.threads, job.load.tiles)


def blocked(setting: Setting, job: Job, presum: Presum | None, *, asked: int | None = None) -> Setting:
    """Return the setting with its pulses split into as few blocks as fit into the job's memory, or into `asked` ones.

    Where not even the smallest blocks fit, those are taken, and the plan's bytes say that the job does not fit.
    """
    if setting.table_bytes == 0:
        return setting
    pulses = len(job.tx_position_m) if presum is None else len(presum.at)
    room = max(1.0, job.memory_bytes - _forming_bytes(job, presum))
    wanted = asked or -(-setting.table_bytes // room)
    return replace(setting, pulse_blocks=int(min(wanted, max(1, pulses // _LEAST_PULSES))))


def block_decision(chosen: Setting, job: Job, *, asked: bool) -> Decision:
    """Return the choice of pulse blocks with its reason; that of one block does not depend on the machine."""
    size = f"{size_text(chosen.table_bytes)} of tables"
    if not chosen.table_bytes:
        why = "the double sum needs no table"
    elif asked:
        why = f"asked for in config/config.yaml, in blocks of {_LEAST_PULSES} pulses or more; {size} in all"
    elif chosen.pulse_blocks > 1:
        why = f"{size} do not fit into {size_text(job.memory_bytes)} of memory with all else"
    else:
        why = f"{size} fit into memory"
    return Decision("pulse_blocks", chosen.pulse_blocks, why)


def bytes_needed(job: Job, chosen: Setting, presum: Presum | None) -> tuple[int, int]:
    """Return peak memory of the imaging step, and what the pair leaves on disk, bytes."""
    echo, profile = _history_bytes(job)
    reading = max(_READ_BYTES * echo + profile, echo + _READ_BYTES * profile)
    forming = _forming_bytes(job, presum) + chosen.table_bytes // chosen.pulse_blocks
    disk = echo + profile + _PRODUCT_BYTES * job.load.pixels
    return max(_BASE_BYTES + reading, forming), disk + (_SUM_BYTES * job.load.pixels if chosen.pulse_blocks > 1 else 0)


def _history_bytes(job: Job) -> tuple[int, int]:
    pulses = len(job.tx_position_m)
    return 8 * pulses * job.subcarriers, 8 * pulses * job.signal.samples


def _forming_bytes(job: Job, presum: Presum | None) -> int:
    """Return what is in memory while tiles are formed, but for tables."""
    virtual = 0 if presum is None else 16 * (len(job.tx_position_m) + len(presum.at)) * job.signal.samples
    tiles = min(job.threads, job.load.tiles) * _TILE_BYTES * min(job.tile_px**2, job.load.pixels)
    return _BASE_BYTES + sum(_history_bytes(job)) + virtual + tiles


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


def size_text(count: float) -> str:
    """Return a number of bytes to be read.

    Examples
    --------
    >>> size_text(24.1e9)
    '24.1 GB'
    """
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 1000 or unit == "TB":
            break
        count /= 1000
    return f"{count:.3g} {unit}"
