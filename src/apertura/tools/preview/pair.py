"""Incremental image formation of a pair: association of new pulses, and images that accumulate them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config import CONFIG
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError, number_of
from apertura.common.flags import Flags
from apertura.common.units import nanoseconds, seconds_since
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.contributions import band_limited_image
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.tiles import Weighing, image_array
from apertura.core.echo.association import associate
from apertura.core.echo.compression import centre_frequency, range_step, window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.gate import EDGE_CELLS, RangeGate
from apertura.core.geometry.sector import TAPER, Sector
from apertura.core.imaging.focus_check import LEAST_PULSES, resolution_cell_m
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.job import profiles_job
from apertura.core.imaging.judgement import budget_by_hand, judgement
from apertura.core.imaging.range_profiles import RangeWindow, phase_history_of, range_compress
from apertura.core.planning.decisions import CHORD, sector_half
from apertura.core.planning.plan import Plan
from apertura.core.planning.planner import make_plan
from apertura.core.quality.budget import MOST_ACCURACY_DB
from apertura.core.quality.error_check import error_bound
from apertura.core.scene.dem import UncheckedDem
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import GroundModels, Terrain
from apertura.stages.calibration import calibrated
from apertura.stages.echo import pair_echo
from apertura.stages.pair import beams_of, body_axes
from apertura.stages.positions import inside_segments, place, scene_air
from apertura.stages.scene import ConfiguredGround
from apertura.stages.transfer import PairEcho
from apertura.stages.transmitted import Transmitted
from apertura.tools.preview.node import NodeSoFar

Axes = dict[str, NDArray[np.float64]]
"""Body axes of the antennas with beams, as required by `apertura.stages.pair.beams_of`."""


_CERTIFIED = 16  # number of pixels at which the exact sum is also computed
_TOGETHER = 16  # number of neighbouring pulses whose range bounds are computed from a single one of these pulses
_CELLS = 8  # minimum number of resolution cells along the shorter side of a scene for an assessment
_JUDGED = 1024  # number of evenly spread pulses kept for the assessment


@dataclass(frozen=True, eq=False)
class PulseBlock:
    """A block of pulses of a pair: transfer functions, body axes and times.

    Attributes
    ----------
    history
        Phase history of the pulses.
    axes
        Body axes, as required by `apertura.stages.pair.beams_of`.
    time
        (pulse,) datetime64[ns], UTC.
    path_limit_m
        (pulse,) float64, longest total path whose echo is recorded completely, metres.
    weight
        Decimation factor: number of recorded pulses that each pulse represents.
    """

    history: PhaseHistory
    axes: Axes
    time: Times
    path_limit_m: NDArray[np.float64]
    weight: int = 1


@dataclass(frozen=True, eq=False)
class Compressed:
    """Range-compressed pulses of a block that contribute to an image, with axes, times and pulse count of the block.

    `gate_m` (pulse,) is the path limit of a gated block, in metres, and infinite in other blocks.
    """

    profiles: Profiles
    axes: Axes
    time: Times
    gate_m: NDArray[np.float64]
    pulses: int
    weight: int = 1

    def every(self, step: int) -> "Compressed":
        """Return a copy with every `step`-th pulse, so that the memory of the other pulses can be freed."""
        selected = self.profiles[::step]
        axes = {name: values[::step] for name, values in self.axes.items()}
        profiles = replace(selected, samples=np.array(selected.samples))
        return replace(self, profiles=profiles, axes=axes, time=self.time[::step], gate_m=self.gate_m[::step])

    @classmethod
    def joined(cls, blocks: Sequence["Compressed"]) -> "Compressed":
        """Concatenate blocks; shorter profiles are padded with zeros."""
        parts = [block.profiles for block in blocks]
        longest = max(part.samples.shape[1] for part in parts)
        samples = [np.pad(part.samples, ((0, 0), (0, longest - part.samples.shape[1]))) for part in parts]
        profiles = replace(
            parts[0],
            samples=np.concatenate(samples),
            start_m=np.concatenate([part.start_m for part in parts]),
            aperture=Aperture(*(np.concatenate([part.aperture.legs[leg] for part in parts]) for leg in (0, 1))),
        )
        axes = {name: np.concatenate([block.axes[name] for block in blocks]) for name in blocks[0].axes}
        times, gate_m = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("time", "gate_m"))
        return cls(profiles, axes, times, gate_m, sum(block.pulses for block in blocks))


class ImageSoFar:
    """Backprojection of the pulses so far on a grid: eq. 8 of docs/theory/engine.md, accumulated block by block.

    Parameters
    ----------
    campaign, pair
        Campaign, and name of the pair.
    grid, terrain
        Pixels, and their heights.
    share
        Divisor of the bandwidth and of the integration angle. With 2, the central half of the subcarriers and half the
        angle are used; resolution cells are then twice as wide, and every second pixel suffices.
    accuracy_db
        Requested numerical error.
    threads
        Number of tiles formed in parallel.
    plans
        `share` → plan of the image formation, common to all pairs; a plan is replaced if the measured error exceeds the
        requested error.
    """

    def __init__(
        self,
        campaign: Campaign,
        pair: str,
        grid: SceneGrid,
        terrain: Terrain,
        *,
        share: int,
        accuracy_db: float,
        threads: int,
        plans: dict[int, Plan],
    ) -> None:
        self.grid, self.share, self.pulses, self.error_db = grid, share, 0, np.inf
        self.sums = np.zeros(grid.shape, np.complex64)
        self._campaign, self._pair, self._terrain = campaign, pair, terrain
        self._accuracy_db, self._threads = accuracy_db, threads
        self._pixels = np.random.default_rng(0).integers(0, grid.shape, (_CERTIFIED, 2))
        self._exact = np.zeros(_CERTIFIED, np.complex128)
        self._plans = plans
        self._speed_m_s = self._edge_m = 0.0
        self._cut = 0  # pulses that do not record the whole scene
        self._summed, self._every, self._kept = 0, 1, list[Compressed]()

    def compressed(self, block: PulseBlock) -> "Compressed":
        """Return range profiles of a block's contributing pulses, in the part of the band used for this image."""
        history, count = block.history, len(block.history.frequency_hz)
        # the wave speed of the first block is used for all blocks: the refractivity changes it by less than 1e-8
        self._speed_m_s = self._speed_m_s or history.wave_speed_m_s
        kept = -(-count // self.share)
        band = slice((count - kept) // 2, (count - kept) // 2 + kept)
        weight = window_weights(self._campaign.settings.processing.window, kept)
        banded = replace(
            history, transfer=history.transfer[:, band], frequency_hz=history.frequency_hz[band], weight=weight
        ).at_speed(self._speed_m_s)
        cell_m, _ = range_step(banded.frequency_hz, oversampling=1.0, wave_speed_m_s=self._speed_m_s)
        self._edge_m = EDGE_CELLS * cell_m
        gate_m = np.full(len(block.time), np.inf)

        def window_of(limit_m: NDArray[np.float64]) -> RangeWindow:
            return RangeWindow.of(
                banded.aperture,
                self.grid,
                self._terrain,
                banded.frequency_hz,
                beams=self._beams(banded.aperture, block.axes, centre_frequency(banded.frequency_hz), limit_m),
                wave_speed_m_s=self._speed_m_s,
                together=_TOGETHER,
            )

        window = window_of(gate_m)
        cut = window.contributing & (window.farthest_m > block.path_limit_m)
        if cut.any():  # eq. 6 of docs/theory/integration.md, decided per block
            self._cut += int(cut.sum())
            gate_m = block.path_limit_m
            window = window_of(gate_m)
        contributing = window.contributing
        banded = replace(
            banded,
            transfer=banded.transfer[contributing],
            reference_delay_s=banded.reference_delay_s[contributing],
            aperture=banded.aperture[contributing],
        )
        window = replace(window, start_m=window.start_m[contributing], farthest_m=window.farthest_m[contributing])
        profiles = range_compress(banded, self.grid, self._terrain, window=window)
        axes = {name: values[contributing] for name, values in block.axes.items()}
        return Compressed(profiles, axes, block.time[contributing], gate_m[contributing], len(block.time), block.weight)

    def add(self, block: "Compressed") -> None:
        """Add a block of `compressed` pulses.

        Settings are planned for the first block, and again if the measured error exceeds the requested error.
        """
        self.pulses += block.pulses
        profiles = block.profiles
        if not len(profiles):
            return
        beams = self._beams(profiles.aperture, block.axes, profiles.centre_frequency_hz, block.gate_m)
        if self._plan is None or self._accuracy_db < self.error_db < np.inf:
            self._plans[self.share] = self._planned(profiles, beams)
        plan = self._plans[self.share]
        image = image_array(
            profiles,
            plan.setting,
            self.grid,
            plan.terrain,
            side_px=self._campaign.settings.processing.tile_px,
            weighing=Weighing(beams, None, count=1),
        )
        self.sums += block.weight * image.compute(scheduler="threads", num_workers=self._threads)
        positions = plan.terrain.positions_at(self.grid, *self._pixels.T)
        self._exact += block.weight * band_limited_image(profiles, positions, beams=beams)
        self._summed += block.weight * len(profiles)
        power = np.full(_CERTIFIED, float(np.mean(np.abs(self.sums) ** 2)))
        computed = self.sums[tuple(self._pixels.T)]
        self.error_db = error_bound(computed, self._exact, np.ones(_CERTIFIED), power=power).bound_db
        self._kept.append(block.every(max(1, self._every // block.weight)))
        if sum(len(kept.profiles) for kept in self._kept) > _JUDGED:
            self._every *= 2
            self._kept = [kept.every(2) for kept in self._kept]

    @property
    def _plan(self) -> Plan | None:
        return self._plans.get(self.share)

    def _planned(self, profiles: Profiles, beams: Beams | None) -> Plan:
        ground = GroundModels.of(self._terrain, None, self.grid)
        job = profiles_job(profiles, self.grid, ground, integration="all")
        overrides = {**self._campaign.settings.processing.planned, "presum": 1, "pulse_blocks": 1}
        return make_plan(
            replace(job, beams=beams), accuracy_db=self._accuracy_db, overrides=overrides, where=str(CONFIG)
        )

    def _beams(self, aperture: Aperture, axes: Axes, centre_hz: float, gate_m: NDArray[np.float64]) -> Beams | None:
        """Return pulse weights of antennas, sector and gate, independent of later pulses; None: all are 1."""
        requested = self._campaign.settings.processing.integrated
        gate = RangeGate(gate_m, self._edge_m) if np.isfinite(gate_m).any() else None
        antennas = Beams.within(None, beams_of(self._campaign, self._pair, axes), gate)
        if requested == "all" or len(aperture) < 2:
            return antennas
        half = sector_half(requested, self._speed_m_s / centre_hz, self.grid.spacing_m)
        half /= 1 if requested == "auto" else self.share  # with auto, the sector already depends on the pixel spacing
        if half * (1 - TAPER) >= 1:  # the sector contains all directions
            return antennas
        middle_m = self._terrain.positions_at(self.grid, *((size - 1) / 2 for size in self.grid.shape))
        range_m = float(np.linalg.norm(aperture.middle_m - middle_m, axis=-1).min())
        return Beams.within(Sector.of(aperture, chord_m=CHORD * range_m, centre=0.0, half=half), antennas, gate)

    @property
    def image(self) -> NDArray[np.complex64]:
        """(y, x) complex64, the mean over the contributing pulses so far."""
        return np.asarray(self.sums / np.float32(max(1, self._summed)), np.complex64)

    @property
    def flags(self) -> dict[str, str]:
        """Flag of a scene that is larger than what was recorded so far; empty if all pulses recorded all pixels."""
        if not self._cut:
            return {}
        missing = 100 * float(np.mean(self.sums == 0))
        line = f"{self._cut} of {self.pulses} pulses so far do not record the whole scene; {missing:.0f} % has no data"
        return {"scene_beyond_recording": line}

    @property
    def setting(self) -> str:
        """Engine and options as text."""
        return self._plan.setting.line if self._plan else ""

    @property
    def peak(self) -> dict[str, float]:
        """Position of the brightest pixel, metres in the scene's CRS, and its level above the median pixel, dB."""
        power = np.abs(self.sums) ** 2
        row, column = np.unravel_index(int(power.argmax()), power.shape)
        x_m, y_m = map(float, self.grid.map_at(row, column))
        illuminated = power[power > 0]
        above_db = 10 * float(np.log10(power.max() / np.median(illuminated))) if illuminated.size else 0.0
        return {"x_m": round(x_m, 3), "y_m": round(y_m, 3), "above_median_db": round(above_db, 1)}

    def judged(self) -> dict[str, Any]:
        """Return focus verdict, reason, peak loss if measured, and flags, from the kept pulses."""
        pulses = sum(len(kept.profiles) for kept in self._kept)
        if self._plan is None or pulses < LEAST_PULSES or not self.sums.any():
            return {"verdict": "inconclusive", "reason": f"{pulses} pulses so far", "flags": {}}
        joined = Compressed.joined(self._kept)
        profiles, times = joined.profiles, joined.time
        beams = self._beams(profiles.aperture, joined.axes, profiles.centre_frequency_hz, joined.gate_m)
        # integration and flags of the plan are those of its first block
        plan = replace(self._plan, beams=beams, integration=None, flags={})
        side = self._campaign.settings.processing.tile_px
        formation = Formation(None, profiles, self.grid, plan, side)
        cell_m = resolution_cell_m(formation)
        if not cell_m * _CELLS < min(self.grid.shape) * self.grid.spacing_m:
            reason = f"aperture too short: resolution cells of {cell_m:.2g} m"
            return {"verdict": "inconclusive", "reason": reason, "flags": {}}
        stated = [self._campaign.settings.nodes[node].position_std_m for node in self._pair.split("-")]
        std_m = None if None in stated else max(float(np.max(cast("Any", axes))) for axes in stated)
        seconds = seconds_since(times, times[0])
        error_db = float(self.error_db) if np.isfinite(self.error_db) else None
        lines = budget_by_hand(formation, error_db=error_db, position_std_m=std_m, time_s=seconds)
        judged = judgement(formation, self.image, lines)
        loss = {"loss_db": judged.focus["loss_db"]} if "loss_db" in judged.focus else {}
        return {"verdict": judged.verdict, "reason": judged.reason, **loss, "flags": dict(judged.flags)}


AT_ONCE = 2048
"""Maximum number of pulses of a block; the computing time of a block is at least 0.1 s, independent of its size."""

_LEAST = 32  # minimum pulses per block before the recordings end; the sidelink state is measured in each block
_OVERLAP = 256  # number of pulses that are associated again, for continuity of the time tags
_QUEUE_BYTES = 512_000_000  # maximum memory of profiles queued for the fine image


@dataclass(eq=False)
class PairSoFar:
    """A pair during the flight: pulses are associated, and used when both logs cover their times.

    Attributes
    ----------
    campaign, flight, name
        Campaign, name of the flight and name of the pair.
    scene
        Function that returns the grid and its terrain, given the first block.
    echo
        Echo of a recorder that stores transfer functions; tx, rx and sent are then None.
    tx, rx, sent
        Nodes, and transmitted waveform.
    threads
        Number of tiles formed in parallel.
    plans
        As in `ImageSoFar`.
    source
        Node whose sidelink gives unknown symbols; None if the symbols are known, or given by the receiver itself.
    images
        Coarse and fine image; blocks for the fine image are queued.
    taken
        Number of transmitter captures processed so far.
    dropped
        Number of processed pulses that were excluded: no position, no sidelink, or decimation.
    until
        Time of the last processed pulse.
    drop_reason
        Reason for the exclusion of the last excluded block; empty: none.
    """

    campaign: Campaign
    flight: str
    name: str
    scene: Callable[[PulseBlock], tuple[SceneGrid, ConfiguredGround]]
    echo: PairEcho | None = None
    tx: NodeSoFar | None = None
    rx: NodeSoFar | None = None
    sent: Transmitted | None = None
    threads: int = 1
    plans: dict[int, Plan] = field(default_factory=dict)
    source: NodeSoFar | None = None
    images: list[ImageSoFar] = field(default_factory=list)
    taken: int = 0
    dropped: int = 0
    until: np.datetime64 | None = None
    drop_reason: str = ""
    _shift_ns: int = 0
    _blocks: int = 0
    _raised: dict[str, tuple[int, str]] = field(default_factory=dict)  # flag → number of blocks, last measurement
    _queue: list[Compressed] = field(default_factory=list)
    _fine: bool = True

    def reset(self) -> "PairSoFar":
        """Return the pair in its state before the first pulse."""
        parameters = ("campaign", "flight", "name", "scene", "echo", "tx", "rx", "sent", "threads", "plans", "source")
        return PairSoFar(*(getattr(self, name) for name in parameters))

    def ready(self, *, ended: bool) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return indices of associated captures that are ready and not processed yet: of `tx`, and of `heard_by`.

        Captures beyond the end of a log, or whose counterpart may still be recorded, are not ready.
        """
        nothing = np.zeros(0, np.int64)
        if self.tx is None or self.heard_by is None or self.sent is None:
            index = np.arange(self.taken, len(self.time))
            return index, index
        until = min(node.known_until(ended=ended) for node in self.nodes)
        last = int(np.searchsorted(self.tx.time, until, "right"))
        if self.tx is self.heard_by:
            index = np.arange(self.taken, last)
            return index, index
        tags = [nanoseconds(node.time) for node in (self.tx, self.heard_by)]
        if last <= self.taken or not tags[1].size:
            return nothing, nothing
        interval_ns = round(1e9 / self.sent.waveform.prf_hz)
        tags[1] = tags[1] - self._shift_ns
        if not ended:
            last = min(last, int(np.searchsorted(tags[0], tags[1][-1] - interval_ns)))
        if last <= self.taken:
            return nothing, nothing
        first = max(0, self.taken - _OVERLAP)
        ends = np.searchsorted(tags[1], [tags[0][first] - interval_ns, tags[0][last - 1] + interval_ns])
        tx_part, rx_part = slice(first, last), slice(*map(int, ends))
        if rx_part.start == rx_part.stop:
            return nothing, nothing
        association = associate(
            tags[0][tx_part],
            tags[1][rx_part],
            repetition_interval_s=interval_ns * 1e-9,
            tx_frame=self.tx.frame[tx_part],
            rx_frame=self.heard_by.frame[rx_part],
            where=f"flight {self.flight}, pair {self.name}",
        )
        tx_index, rx_index = association.tx_index + tx_part.start, association.rx_index + rx_part.start
        self._shift_ns += round(float(np.median(tags[1][rx_index] - tags[0][tx_index])))
        new = ~association.outlier & (tx_index >= self.taken)
        return tx_index[new], rx_index[new]

    def add_next(self, *, ended: bool, every: int = 1) -> bool:
        """Add every `every`-th pulse of the next block to the coarse image; return False if no pulse is ready."""
        try:
            tx_index, rx_index = self.ready(ended=ended)
        except CampaignError as error:  # the time tags cannot be associated yet
            if ended:
                self.drop_reason = str(error)
            return False
        if len(tx_index) < (1 if ended else _LEAST * every):
            return False
        block = slice(0, AT_ONCE * every)
        tx_index, rx_index = tx_index[block], rx_index[block]
        previously = self.taken
        self.taken = int(tx_index[-1]) + 1
        kept = tx_index % every == 0
        added = self._add(tx_index[kept], rx_index[kept], every) if kept.any() else 0
        self.dropped += self.taken - previously - added
        self.until = self.time[self.taken - 1]
        return True

    def _add(self, tx_index: NDArray[np.int64], rx_index: NDArray[np.int64], every: int) -> int:
        """Add the pulses of the given captures; return the number with a position and a transfer function."""
        try:
            block = self._block(tx_index, rx_index)
        except (CampaignError, OSError) as error:  # for example a file that was removed meanwhile
            self.drop_reason = str(error)
            return 0
        if block is None:
            return 0
        block = replace(block, weight=every)
        if not self.images:
            self.images = self._new_images(block)
        coarse, fine = self.images
        coarse.add(coarse.compressed(block))
        if self._fine:
            self._queue.append(fine.compressed(block))
            self._fine = sum(queued.profiles.samples.nbytes for queued in self._queue) <= _QUEUE_BYTES
            self._queue = self._queue if self._fine else []  # the fine image cannot keep up with the coarse one
        return len(block.time)

    def _block(self, tx_index: NDArray[np.int64], rx_index: NDArray[np.int64]) -> PulseBlock | None:
        """Return the echo of the given captures, computed as in step `echo`; None if no pulse is usable."""
        campaign, processing = self.campaign, self.campaign.settings.processing
        if self.tx is None or self.heard_by is None or self.sent is None:
            return self._read(cast("PairEcho", self.echo), tx_index)
        try:
            inside = inside_segments(campaign, self.flight, self.name, self.tx.time[tx_index])
        except CampaignError:  # all pulses are outside the segments
            return None
        tx = self.tx.acquisition(tx_index[inside])
        heard = tx if self.heard_by is self.tx else self.heard_by.acquisition(rx_index[inside])
        rx = heard if self.source is None else tx
        hovers = bool(campaign.segments_of(self.flight, self.name))
        if not place(tx, rx, tx.raw.time.values, hovers=hovers).good.any():
            self.drop_reason = "hover: platform stationary"
            return None
        air = scene_air(campaign, tx.track.position.values)
        offset = calibrated(campaign, self.flight, self.name)
        echo = pair_echo(tx, rx, self.sent, processing, offset, air, hovers=hovers, source=heard)
        return self._read(echo, np.arange(echo.dataset.sizes["pulse"]))

    def _read(self, echo: PairEcho, pulses: NDArray[np.int64]) -> PulseBlock:
        formed = replace(echo, dataset=echo.dataset.isel(pulse=pulses)).at(slice(None))
        self._blocks += 1
        for name, line in Flags.merged(formed.attrs["flags"], echo.flags).items():
            self._raised[name] = self._raised.get(name, (0, ""))[0] + 1, line
        history = phase_history_of(formed, self.campaign.settings.processing.window)
        return PulseBlock(history, body_axes(formed), formed.time.values, formed.path_limit.values)

    def _new_images(self, block: PulseBlock) -> list[ImageSoFar]:
        """Return an empty coarse and an empty fine image."""
        campaign, (grid, ground) = self.campaign, self.scene(block)
        requested = campaign.settings.processing.accuracy_db
        accuracy_db = MOST_ACCURACY_DB if requested == "auto" else float(requested)
        images = []
        for share in (2, 1):
            image_grid = grid.coarse(max(grid.shape) // share)
            terrain = UncheckedDem(ground.dem, image_grid) if ground.dem else ground.level(image_grid)
            options: dict[str, Any] = {
                "share": share,
                "accuracy_db": accuracy_db / share,
                "threads": self.threads,
                "plans": self.plans,
            }
            images.append(ImageSoFar(campaign, self.name, image_grid, terrain, **options))
        return images

    def refine_next(self) -> bool:
        """Add the next queued block to the fine image; return False if the queue is empty."""
        if not self._queue:
            return False
        self.images[1].add(self._queue.pop(0))
        return True

    def judged(self) -> dict[str, Any]:
        """Return the assessment of the fine image, or of the coarse image if its pulses are more than twice as many.

        For a coarse image, only the verdict "focused" is reported: its range cells are twice as long, so that points in
        the same cell disturb each other's measurement.
        """
        coarse, fine = self.images
        image = fine if 2 * fine.pulses >= coarse.pulses else coarse
        judged = image.judged() | {"judged_by": f"{image.pulses} pulses, {'fine' if image is fine else 'coarse'}"}
        if image is coarse and judged["flags"]:
            judged |= {"verdict": "inconclusive", "reason": f"coarse image only: {judged['reason']}", "flags": {}}
        return judged

    @property
    def nodes(self) -> list[NodeSoFar]:
        """Nodes whose recordings give the pulses; empty for a recorder that stores transfer functions."""
        return [node for node in (self.tx, self.rx, self.source) if node is not None]

    @property
    def heard_by(self) -> NodeSoFar | None:
        """Node whose captures are associated with those of the transmitter: the source of symbols, or the receiver."""
        return self.source or self.rx

    @property
    def time(self) -> Times:
        """(pulse,) datetime64[ns], UTC: transmission times of the pulses so far."""
        if self.tx is None:
            return cast("Times", cast("PairEcho", self.echo).dataset.time.values)
        return self.tx.time

    @property
    def delay_s(self) -> float | None:
        """Delay of the last added pulse behind the last recorded pulse, seconds; None before the first block."""
        if self.until is None or not len(self.time):
            return None
        return round(float((self.time[-1] - self.until) / np.timedelta64(1, "s")), 2)

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of pulses recorded, added to the shown image, and excluded."""
        return {"recorded": len(self.time), "added": self.shown.pulses if self.shown else 0, "excluded": self.dropped}

    @property
    def flags(self) -> dict[str, str]:
        """Flags raised by most blocks, with the last measurement; a single block is not statistically significant."""
        return {name: line for name, (times, line) in self._raised.items() if 2 * times > self._blocks}

    @property
    def waits(self) -> str:
        """Reason for missing pulses; empty: none."""
        symbols = ""
        if self.source is not None and not self.images:
            count = number_of(len(self.source.time), "capture")
            symbols = f"symbols are decided from the sidelink of {self.source.name}, which has recorded {count}"
        reasons = (*(node.waits for node in self.nodes), self.drop_reason, symbols)
        return next((reason for reason in reasons if reason), "")

    @property
    def shown(self) -> ImageSoFar | None:
        """The fine image if it has all pulses of the coarse image, else the coarse image."""
        if not self.images:
            return None
        coarse, fine = self.images
        return fine if fine.pulses == coarse.pulses else coarse
