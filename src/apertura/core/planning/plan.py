"""The plan of an image: choices with reasons, memory and disk, and flags of crossed limits of imaging."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.filesize import decimal

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import Illumination
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.inputs import Profiles
from apertura.core.backprojection.job import Integration, Job
from apertura.core.backprojection.presum import Presum, presummed
from apertura.core.geometry.aperture import Aperture
from apertura.core.quality.agreement import WIDEST_PIXEL
from apertura.core.scene.terrain import Terrain

# ---- Limits of imaging


def check_geometry(job: Job) -> dict[str, str]:
    """Return flags: limit of imaging that the job exceeds → what was measured, in one line.

    Parameters
    ----------
    job
        What is to be imaged.

    Raises
    ------
    CampaignError
        If there is no pulse, a position is not finite, or no echo of the scene arrives inside the prefix.
    """
    aperture, ground_m = job.aperture, job.ground_m
    check_positions(aperture)
    up = vertical(ground_m)
    flags: dict[str, str] = {}
    over = np.zeros(len(aperture), bool)
    for leg in aperture.legs:
        over |= _over(leg, ground_m, up, job.spacing_m)
    if over.any():
        flags["platform_inside_scene"] = (
            f"{int(over.sum())} of {len(aperture)} pulses are sent or received above the scene: echoes from both sides "
            "mix"
        )
    weigh = None if job.sector is None else job.sector.over(aperture)
    cell_m = aperture.resolution_cell_m(ground_m, band_hz=job.band_hz, weigh=weigh)
    if job.spacing_m > WIDEST_PIXEL * cell_m:
        flags["spacing_coarse"] = (
            f"spacing {job.spacing_m:g} m, finest resolution cell {cell_m:.3g} m: targets fall between"
        )
    if missing := no_aperture(aperture, ground_m, wavelength_m=2 * SPEED_OF_LIGHT_M_S / sum(job.band_hz)):
        flags["no_aperture"] = missing
    if sparse := undersampling(job):
        flags["azimuth_undersampled"] = sparse
    beyond = _share_beyond(aperture, job.points_m, job.path_limit_m)
    if beyond:
        flags["beyond_cyclic_prefix"] = (
            f"{100 * beyond:.0f} % of the scene arrives too late for all captures: after the cyclic prefix, or listen_s"
        )
    return flags


_LEAST_CELLS = 2.0
"""Cells across the line of sight that a scene must hold: with fewer, an image shows ranges, and no places."""


def no_aperture(aperture: Aperture, ground_m: NDArray[np.float64], *, wavelength_m: float) -> str | None:
    """Return one line where antennas move too little to resolve anything across the line of sight, else None.

    Parameters
    ----------
    aperture
        Of a pair.
    ground_m, wavelength_m
        As of `Aperture.cross_cell_m`.

    Notes
    -----
    Source: docs/theory/planner.md, "No aperture".
    """
    cell_m = aperture.cross_cell_m(ground_m, wavelength_m=wavelength_m)
    side_m = max(float(np.linalg.norm(ground_m[end] - ground_m[0, 0])) for end in ((0, -1), (-1, 0)))
    if _LEAST_CELLS * cell_m <= side_m:
        return None
    moved_m = max(float(np.linalg.norm(leg - leg[0], axis=1).max()) for leg in aperture.legs)
    resolved = f"resolves {cell_m:.3g} m" if np.isfinite(cell_m) else "resolves nothing"
    return (
        f"antennas moved {moved_m:.3g} m, which {resolved} across the line of sight, in a scene of {side_m:.3g} m: is "
        "this a bench recording?"
    )


GHOST_DB, REACHED = -20.0, 0.1
"""dB of a point's ghosts against it, and share of the scene, mean over the pulses, above which they show."""

FOLDED_DB = 1.0
"""dB by which echoes that fold brighten the scene on average, above which they show between its targets."""


def undersampling(job: Job) -> str | None:
    """Return one line where the aperture is undersampled so far that its ambiguities show, else None.

    Notes
    -----
    Source: docs/theory/planner.md, eq. 4 and 5.
    """
    wavelength_m, (lowest_hz, highest_hz) = SPEED_OF_LIGHT_M_S / job.band_hz[1], job.band_hz
    spread, _ = job.aperture.phase_rates(job.points_m, wavelength_m=wavelength_m)
    if spread <= 1:
        return None
    folded = job.aperture.ambiguities(job.points_m, wavelength_m=wavelength_m)
    pulses = len(job.aperture) if job.integration is None else job.integration.count
    # a ghost walks a wavelength of path per pulse: through the response of a windowed band in twice f/B pulses
    walked = (lowest_hz + highest_hz) / max(highest_hz - lowest_hz, 1.0) / max(pulses, 1)
    ghost_db = 20 * np.log10(max(min(1.0, walked, float(folded.max())), 1e-6))
    reached, brighter_db = float(np.minimum(folded, 1).mean()), decibels(1 + float(folded.mean()))
    if not (brighter_db > FOLDED_DB or (ghost_db > GHOST_DB and reached > REACHED)):
        return None
    return (
        f"phase rates over the scene spread {spread:.2f} cycles per pulse, 1 is unambiguous: echoes fold onto "
        f"{100 * reached:.0f} % of it and brighten it by {brighter_db:.1f} dB on average, ghosts of points are at "
        f"{ghost_db:.0f} dB"
    )


def check_positions(aperture: Aperture) -> None:
    """Raise CampaignError unless there is a pulse and each has finite phase centres."""
    if len(aperture) == 0:
        raise CampaignError(
            "zero pulses", where="echo", expected="at least one", remedy="Check the triggers and the sidelink."
        )
    lost = np.asarray(~np.isfinite(np.hstack(aperture.legs)).all(axis=1))
    if lost.any():
        raise CampaignError(
            f"{int(lost.sum())} of {len(lost)} phase centres are not finite, first at pulse {int(lost.argmax())}",
            where="track",
            expected="a position for every pulse",
            remedy="Correct the flight log.",
        )


def _over(
    position_m: NDArray[np.float64], ground_m: NDArray[np.float64], up: NDArray[np.float64], spacing_m: float
) -> NDArray[np.bool_]:
    """Return which pulses are above the scene."""
    corner, over = ground_m[0, 0], np.ones(len(position_m), bool)
    right, down = ground_m[0, -1] - corner, ground_m[-1, 0] - corner
    lengths = [float(np.linalg.norm(side)) for side in (right, down)]
    if not lengths[1]:  # one row or column is as wide as a pixel
        down = np.cross(right if lengths[0] else np.eye(3)[np.abs(up).argmin()], up)
    if not lengths[0]:
        right = np.cross(down, up)
    for side, length in zip((right, down), lengths, strict=True):
        along = (position_m - corner) @ side / np.linalg.norm(side)
        over &= np.abs(along - length / 2) <= (length + spacing_m) / 2
    return over


def _share_beyond(aperture: Aperture, points_m: NDArray[np.float64], path_limit_m: float) -> float:
    if not np.isfinite(path_limit_m):
        return 0.0
    shortest = aperture[aperture.sample(256)].path(points_m).min(axis=0)
    beyond = shortest > path_limit_m
    if beyond.all():
        raise CampaignError(
            f"zero pulses see the scene: the shortest total path is {shortest.min():.1f} m, the scene "
            f"{shortest.min() / 2000:.3g} km from the tracks at least",
            where="scene.bounds_m",
            expected=f"at most {path_limit_m:.1f} m, the cyclic prefix",
            remedy="Correct scene.bounds_m (easting before northing), scene.crs, the tracks' places, or the height of "
            "the ground: scene.height_m, or unit and datum of scene.dem; or make the prefix longer.",
        )
    return float(beyond.mean())


def vertical(ground_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit normal of ground points (row, column, 3) whose rows go south and columns east.

    Examples
    --------
    >>> east, south = np.meshgrid(np.arange(3.0), np.arange(2.0))
    >>> vertical(np.stack([east, -south, 0 * east], -1))
    array([0., 0., 1.])
    """
    if min(ground_m.shape[:2]) < 2:
        first = ground_m[0, 0]
        return np.asarray(first / np.linalg.norm(first)) if np.linalg.norm(first) > 6e6 else np.array([0.0, 0.0, 1.0])
    normal = np.cross(ground_m[0, -1] - ground_m[0, 0], ground_m[0, 0] - ground_m[-1, 0])
    return np.asarray(normal / np.linalg.norm(normal))


# ---- The plan and its decisions


@dataclass(frozen=True)
class Decision:
    """One choice.

    Attributes
    ----------
    name, value
        What was chosen: a key of the config's `processing`, or an option of the engine, where it can be overridden.
    reason
        One line with the numbers.
    error_db
        Error that this choice adds, relative to the full model; None where it adds none.
    """

    name: str
    value: str | int | float | bool
    reason: str
    error_db: float | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """How an image will be formed.

    Attributes
    ----------
    setting
        Engine and options.
    fallbacks
        Next better settings, for tiles whose certified error is worse than requested; the last one is `reference`.
    decisions
        Every choice with its reason.
    accuracy_db
        The requested numerical error.
    predicted_error_db
        RMS on random pixels: of the setting and of the models.
    predicted_seconds
        Tables and tiles, roughly.
    memory_bytes, disk_bytes
        Peak of the imaging step; what it leaves in the results folder.
    flags
        Limits that the job exceeds: name → what was measured, in one line.
    presum, middle_m
        The low-pass sum over pulses, and the point they are aligned to; settings of `fallbacks` do not use it.
    terrain
        The ground that is imaged on: as it is, a plane through it, or level.
    beams, integration, illumination
        Of the job.
    fixed_engine
        Whether the engine of `setting` was requested.
    """

    setting: Setting
    fallbacks: tuple[Setting, ...]
    decisions: tuple[Decision, ...]
    accuracy_db: float
    predicted_error_db: float
    predicted_seconds: float
    memory_bytes: int
    disk_bytes: int
    flags: Mapping[str, str]
    terrain: Terrain
    presum: Presum | None = field(default=None, repr=False)
    middle_m: NDArray[np.float64] | None = field(default=None, repr=False)
    beams: Beams | None = field(default=None, repr=False)
    integration: Integration | None = field(default=None, repr=False)
    illumination: Illumination | None = field(default=None, repr=False)
    fixed_engine: bool = False

    @property
    def engine(self) -> str:
        """A key of `ENGINES`."""
        return self.setting.engine

    @property
    def reasons(self) -> dict[str, str]:
        """Choice → value and reason, in one line."""
        return {decision.name: f"{decision.value}: {decision.reason}" for decision in self.decisions}

    @property
    def choices(self) -> dict[str, Any]:
        """Choice → value: all that the image's pixels depend on, and no prediction."""
        return {decision.name: decision.value for decision in self.decisions} | {"ground": self.terrain.spec}

    @property
    def count(self) -> int | None:
        """Pulses that the sum is divided by; None: all of them."""
        return None if self.integration is None or self.integration.sector is None else self.integration.count

    @property
    def presumming(self) -> tuple[Presum, NDArray[np.float64]] | None:
        """The low-pass sum over pulses and the point they are aligned to; None: every pulse as it is."""
        return None if self.presum is None or self.middle_m is None else (self.presum, self.middle_m)

    def fallen_back(self, setting: Setting) -> "Plan":
        """Return the plan with one of its fallbacks, which takes every pulse as it is."""
        reason = f"{self.setting.line} missed the accuracy asked on the pixels compared"
        replaced = {"engine", "presum", "pulse_blocks", *self.setting.reasons}
        decisions = (
            Decision("engine", setting.engine, reason, setting.error_db),
            *(Decision(name, setting.all_options[name], why) for name, why in setting.reasons.items()),
            Decision("presum", 1, "a fallback takes every pulse"),
            Decision("pulse_blocks", setting.pulse_blocks, "those of the fallback"),
            *(decision for decision in self.decisions if decision.name not in replaced),
        )
        return replace(
            self,
            setting=setting,
            decisions=decisions,
            predicted_error_db=setting.error_db,
            presum=None,
            middle_m=None,
        )

    def replaced_by(self, setting: Setting, what: str) -> Flags:
        """Raise a flag where a requested engine is replaced for `what`, the image or some of its tiles."""
        if not self.fixed_engine or setting.engine == self.engine:
            return Flags()
        line = f"{what} by {setting.engine}: {self.engine}, as requested, misses {self.accuracy_db:.0f} dB"
        return Flags({"engine_replaced": line})

    def inputs(self, profiles: Profiles) -> Profiles:
        """Return the profiles for the plan's setting, presummed if planned: the image's sum over pulses is the same."""
        return profiles if self.presumming is None else presummed(profiles, *self.presumming)


# ---- Memory, disk and blocks of pulses

BLOCK_BYTES = 512 << 20
"""Bytes of a block of pulses at most, read and as tables, so that memory does not grow with the flight."""

_BASE_BYTES = 350_000_000  # the interpreter and its libraries
_PULSE_BYTES = 500  # of a pulse whose samples are not in memory: phase centres, axes, copies of them
_TILE_BYTES = 150  # per pixel in work: positions, their projection, the sum
_READ_BYTES = 3  # per byte of a block while it is read: as stored, as decoded, where it goes
_SUM_BYTES = 8  # per pixel of the sum of pulse blocks
_CHECKED_PULSES, _CHECKED_BYTES = 1024, 40  # read at once for certificate and focus; bytes per subcarrier of one
_LEAST_PULSES = 64  # of a block: the kernel sums that many at a time
_PRODUCT_BYTES = 76  # per pixel: image, its part of the cube, three rasters with overviews, before compression


def pulse_blocks(setting: Setting, job: Job, presum: Presum | None, *, requested: int | None = None) -> int:
    """Return into how many blocks pulses are split: as few as fit into the job's memory, or as many as requested.

    Where not even the smallest blocks fit, those are taken, and the plan's bytes say that the job does not fit.
    """
    pulses = len(job.aperture) if presum is None else len(presum.at)
    resident = _resident_bytes(setting, job, presum)
    room = min(BLOCK_BYTES, max(1.0, job.memory_bytes - _forming_bytes(job)))
    if requested is None and resident <= room:
        return 1
    less = min(BLOCK_BYTES, max(1.0, job.memory_bytes - _forming_bytes(job) - _SUM_BYTES * job.pixels))
    count = requested or -(-resident // less)
    return int(min(count, max(1, pulses // _LEAST_PULSES)))


def block_decision(chosen: Setting, job: Job, presum: Presum | None, *, requested: bool) -> Decision:
    """Return the choice of pulse blocks with its reason; the reason of one block does not depend on the machine."""
    size = f"{decimal(int(_resident_bytes(chosen, job, presum)))} of samples and tables"
    if requested:
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
    forming = sums + _resident_bytes(chosen, job, presum) // chosen.pulse_blocks
    checking = _CHECKED_BYTES * min(pulses, _CHECKED_PULSES) * job.subcarriers
    stages = 8 * pulses * (job.subcarriers + job.signal.samples)
    return _forming_bytes(job) + max(forming, checking), stages + _PRODUCT_BYTES * job.pixels


def _resident_bytes(setting: Setting, job: Job, presum: Presum | None) -> int:
    """Return the bytes of all pulses in memory at once, as read and as tables."""
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
            texts = [file.read_text(encoding="utf-8").strip() for file in stated if file.is_file()]
            limits += [int(text) for text in texts if text.isdecimal()]  # 'max': none
    return min(limits)
