"""Plan of an image: decisions with reasons, memory and disk, and flags of exceeded imaging limits."""

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
    """Check the geometry of a job and return flags: name of the exceeded limit → measured value, in one line.

    Parameters
    ----------
    job
        Imaging job.

    Raises
    ------
    CampaignError
        If there is no pulse, or a position is not finite.
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
            f"{int(over.sum())} of {len(aperture)} pulses are transmitted or received above the scene, which causes a "
            "left-right ambiguity"
        )
    weigh = None if job.beams is None else job.beams.coverage(aperture)
    cell_m = aperture.resolution_cell_m(ground_m, band_hz=job.band_hz, weigh=weigh)
    if job.spacing_m > WIDEST_PIXEL * cell_m:
        flags["spacing_coarse"] = (
            f"pixel spacing {job.spacing_m:g} m, finest resolution cell {cell_m:.3g} m: targets may fall between pixels"
        )
    if missing := no_aperture(aperture, ground_m, wavelength_m=2 * SPEED_OF_LIGHT_M_S / sum(job.band_hz)):
        flags["no_aperture"] = missing
    if sparse := undersampling(job):
        flags["azimuth_undersampled"] = sparse
    return flags


_LEAST_CELLS = 2.0
"""Minimum number of resolution cells across the line of sight: with fewer cells, an image is resolved in range only."""


def no_aperture(aperture: Aperture, ground_m: NDArray[np.float64], *, wavelength_m: float) -> str | None:
    """Return a one-line description of a track too short for cross-range resolution; None if the track is sufficient.

    Parameters
    ----------
    aperture
        Aperture of a pair.
    ground_m, wavelength_m
        As for `Aperture.cross_cell_m`.

    Notes
    -----
    Source: docs/theory/planner.md, "No aperture".
    """
    cell_m = aperture.cross_cell_m(ground_m, wavelength_m=wavelength_m)
    side_m = max(float(np.linalg.norm(ground_m[end] - ground_m[0, 0])) for end in ((0, -1), (-1, 0)))
    if _LEAST_CELLS * cell_m <= side_m:
        return None
    moved_m = max(float(np.linalg.norm(leg - leg[0], axis=1).max()) for leg in aperture.legs)
    resolution = f"a resolution of {cell_m:.3g} m" if np.isfinite(cell_m) else "no resolution"
    return (
        f"the antennas moved by {moved_m:.3g} m, which yields {resolution} across the line of sight in a scene of "
        f"{side_m:.3g} m; possibly a bench recording"
    )


GHOST_DB, REACHED = -20.0, 0.1
"""Limits above which ghosts are visible: level of a ghost relative to the point that causes it, dB; and ambiguous
fraction of the scene, mean over the pulses."""

FOLDED_DB = 1.0
"""Mean increase of the power of the scene by aliased echoes, dB, above which these echoes are visible between targets.
"""


def undersampling(job: Job) -> str | None:
    """Return a one-line description of visible ambiguities from an undersampled aperture; None if none is visible.

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
    # The path of a ghost changes by a wavelength per pulse: a ghost crosses the range response in 2·f/B pulses.
    walked = (lowest_hz + highest_hz) / max(highest_hz - lowest_hz, 1.0) / max(pulses, 1)
    ghost_db = 20 * np.log10(max(min(1.0, walked, float(folded.max())), 1e-6))
    reached, brighter_db = float(np.minimum(folded, 1).mean()), decibels(1 + float(folded.mean()))
    if not (brighter_db > FOLDED_DB or (ghost_db > GHOST_DB and reached > REACHED)):
        return None
    return (
        f"phase rates over the scene span {spread:.2f} cycles per pulse (unambiguous up to 1): echoes alias onto "
        f"{100 * reached:.0f} % of the scene and increase its mean power by {brighter_db:.1f} dB; ghosts of points at "
        f"{ghost_db:.0f} dB"
    )


def check_positions(aperture: Aperture) -> None:
    """Raise CampaignError if there is no pulse, or if a pulse has phase centres that are not finite."""
    if len(aperture) == 0:
        raise CampaignError(
            "no pulses", where="echo", expected="at least one pulse", remedy="Check the triggers and the sidelink."
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
    """Return a mask of the antenna positions above the scene."""
    corner, over = ground_m[0, 0], np.ones(len(position_m), bool)
    right, down = ground_m[0, -1] - corner, ground_m[-1, 0] - corner
    lengths = [float(np.linalg.norm(side)) for side in (right, down)]
    if not lengths[1]:  # a single row or column has the width of a pixel
        down = np.cross(right if lengths[0] else np.eye(3)[np.abs(up).argmin()], up)
    if not lengths[0]:
        right = np.cross(down, up)
    for side, length in zip((right, down), lengths, strict=True):
        along = (position_m - corner) @ side / np.linalg.norm(side)
        over &= np.abs(along - length / 2) <= (length + spacing_m) / 2
    return over


def vertical(ground_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the upward unit normal of ground points (row, column, 3), with rows going south and columns east.

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
    """One decision of the planner.

    Attributes
    ----------
    name, value
        Option and its value. The decision is overridden if the option is set: it is a key of section `processing` of
        the configuration, or an option of the engine.
    reason
        Reason, including numbers, one line.
    error_db
        Error added by this decision, relative to the full model, dB; None if the decision adds no error.
    """

    name: str
    value: str | int | float | bool
    reason: str
    error_db: float | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """Plan of the formation of an image.

    Attributes
    ----------
    setting
        Engine and options.
    fallbacks
        More exact settings, for tiles with a certified error above the requested error; the last one is `reference`.
    decisions
        All decisions with their reasons.
    accuracy_db
        Requested numerical error.
    predicted_error_db
        Predicted RMS error at random pixels, from the setting and the models together.
    predicted_seconds
        Predicted run time for tables and tiles.
    memory_bytes, disk_bytes
        Peak memory of the imaging step; size of its results.
    flags
        Limits exceeded by the job: name → measured value, in one line.
    presum, middle_m
        Low-pass sum over pulses, and the point to which the pulses are aligned; not used by the settings of
        `fallbacks`.
    terrain
        Terrain model of the image: the full terrain, a plane fitted to it, or level ground.
    beams, integration, illumination
        As in the job.
    fixed_engine
        True if the engine of `setting` was requested.
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
        """Option → value and reason, in one line."""
        return {decision.name: f"{decision.value}: {decision.reason}" for decision in self.decisions}

    @property
    def choices(self) -> dict[str, Any]:
        """Option → value: all decisions that affect the pixels of the image, without predictions."""
        return {decision.name: decision.value for decision in self.decisions} | {"ground": self.terrain.spec}

    @property
    def count(self) -> int | None:
        """Number of pulses by which the sum is divided; None: all pulses."""
        return None if self.integration is None or self.integration.sector is None else self.integration.count

    @property
    def presumming(self) -> tuple[Presum, NDArray[np.float64]] | None:
        """Low-pass sum over pulses, and the point to which the pulses are aligned; None: no presumming."""
        return None if self.presum is None or self.middle_m is None else (self.presum, self.middle_m)

    def fallen_back(self, setting: Setting) -> "Plan":
        """Return the plan with one of its fallback settings, without presumming."""
        reason = f"{self.setting.line} did not meet the requested accuracy at the pixels that were recomputed exactly"
        replaced = {"engine", "presum", "pulse_blocks", *self.setting.reasons}
        decisions = (
            Decision("engine", setting.engine, reason, setting.error_db),
            *(Decision(name, setting.all_options[name], reason) for name, reason in setting.reasons.items()),
            Decision("presum", 1, "no presumming in a fallback"),
            Decision("pulse_blocks", setting.pulse_blocks, "number of pulse blocks of the fallback setting"),
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
        """Return a flag if the requested engine is replaced for `what`: the image, or a number of its tiles."""
        if not self.fixed_engine or setting.engine == self.engine:
            return Flags()
        line = f"{what} formed by {setting.engine}: the requested {self.engine} does not meet {self.accuracy_db:.0f} dB"
        return Flags({"engine_replaced": line})

    def inputs(self, profiles: Profiles) -> Profiles:
        """Return the profiles for the plan's setting, presummed if planned."""
        return profiles if self.presumming is None else presummed(profiles, *self.presumming)


# ---- Memory, disk and pulse blocks

BLOCK_BYTES = 512 << 20
"""Largest size of the samples and tables of a pulse block, bytes: the memory does not grow with the flight duration."""

_BASE_BYTES = 350_000_000  # bytes of the interpreter and its libraries
_PULSE_BYTES = 500  # bytes per pulse in addition to its samples: phase centres, axes, and copies of them
_TILE_BYTES = 150  # bytes per pixel during formation: positions, their projection, the sum
_READ_BYTES = 3  # bytes in memory per byte of a block while it is read: compressed, decoded, and in its destination
_SUM_BYTES = 8  # bytes per pixel for the sum over pulse blocks
_CHECKED_PULSES, _CHECKED_BYTES = 1024, 40  # pulses per read for certificate and focus; bytes per subcarrier and pulse
_LEAST_PULSES = 64  # minimum number of pulses of a block: batch size of the kernel
# bytes per pixel on disk before compression: image, part of the cube, three rasters with overviews
_PRODUCT_BYTES = 76


def pulse_blocks(setting: Setting, job: Job, presum: Presum | None, *, requested: int | None = None) -> int:
    """Return the number of pulse blocks: as requested, or the smallest number with which a block fits into memory.

    If not even the smallest blocks fit into the job's memory, the smallest blocks are used, and the memory of the plan
    exceeds the limit.
    """
    pulses = len(job.aperture) if presum is None else len(presum.at)
    resident = _resident_bytes(setting, job, presum)
    available = min(BLOCK_BYTES, max(1.0, job.memory_bytes - _forming_bytes(job)))
    if requested is None and resident <= available:
        return 1
    available = min(BLOCK_BYTES, max(1.0, job.memory_bytes - _forming_bytes(job) - _SUM_BYTES * job.pixels))
    count = requested or -(-resident // available)
    return int(min(count, max(1, pulses // _LEAST_PULSES)))


def block_decision(chosen: Setting, job: Job, presum: Presum | None, *, requested: bool) -> Decision:
    """Return the decision on pulse blocks; for a single block, the stated reason does not depend on the machine."""
    size = f"{decimal(int(_resident_bytes(chosen, job, presum)))} of samples and tables"
    if requested:
        reason = f"requested, with at least {_LEAST_PULSES} pulses per block; {size} in total"
    elif chosen.pulse_blocks > 1:
        limit = decimal(int(min(job.memory_bytes, BLOCK_BYTES)))
        reason = f"{size} exceed the memory limit of a block, {limit}"
    else:
        reason = f"{size} fit into memory"
    return Decision("pulse_blocks", chosen.pulse_blocks, reason)


def bytes_needed(job: Job, chosen: Setting, presum: Presum | None) -> tuple[int, int]:
    """Return the peak memory of the imaging step, and the disk space of the pair's results, bytes."""
    pulses = len(job.aperture)
    sums = _SUM_BYTES * job.pixels if chosen.pulse_blocks > 1 else 0
    forming = sums + _resident_bytes(chosen, job, presum) // chosen.pulse_blocks
    checking = _CHECKED_BYTES * min(pulses, _CHECKED_PULSES) * job.subcarriers
    stages = 8 * pulses * (job.subcarriers + job.signal.samples)
    return _forming_bytes(job) + max(forming, checking), stages + _PRODUCT_BYTES * job.pixels


def _resident_bytes(setting: Setting, job: Job, presum: Presum | None) -> int:
    """Return the memory for the samples and tables of all pulses at once, bytes."""
    samples = job.signal.samples if setting.table_bytes else job.subcarriers
    virtual = 0 if presum is None else 16 * (len(job.aperture) + len(presum.at)) * samples
    return _READ_BYTES * 8 * len(job.aperture) * samples + virtual + setting.table_bytes


def _forming_bytes(job: Job) -> int:
    """Return the memory during image formation without pulse samples and tables, bytes."""
    tiles = min(job.threads, job.tiles) * _TILE_BYTES * min(job.tile_px**2, job.pixels)
    return _BASE_BYTES + _PULSE_BYTES * len(job.aperture) + tiles


_UNKNOWN_BYTES = 4 << 30  # memory assumed on systems that do not report it


def memory_limit(*, groups: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> int:
    """Return the memory available to this process, bytes: memory of the machine, or limit of the control groups.

    Batch systems and containers limit a job by a control group (version 1 or 2); limits of parent groups apply as well.

    Parameters
    ----------
    groups, root
        File that lists the control groups of the process, and root folder of the control groups.

    Notes
    -----
    Source: Linux kernel documentation, admin-guide/cgroup-v2 (memory.max) and cgroup-v1/memory.

    Examples
    --------
    >>> 0 < memory_limit() <= memory_limit(groups=Path("none"))
    True
    """
    if not hasattr(os, "sysconf"):  # Windows
        return _UNKNOWN_BYTES
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for line in groups.read_text(encoding="utf-8").splitlines() if groups.is_file() else ():
        _, controllers, path = line.split(":", 2)
        name = "memory.max" if controllers == "" else "memory.limit_in_bytes"
        if controllers == "" or "memory" in controllers.split(","):
            top = root / controllers if controllers else root
            own = top / path.lstrip("/")
            files = [folder / name for folder in (own, *own.parents) if folder.is_relative_to(top)]
            texts = [file.read_text(encoding="utf-8").strip() for file in files if file.is_file()]
            limits += [int(text) for text in texts if text.isdecimal()]  # 'max': no limit
    return min(limits)
