"""A pair while it flies: which pulses have come, and the images that they are added to."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config import CONFIG
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.units import nanoseconds, seconds_since
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.contributions import band_limited_image
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.tiles import Weighing, image_array
from apertura.core.echo.association import associate
from apertura.core.echo.compression import centre_frequency, window_weights
from apertura.core.geometry.aperture import Aperture
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
from apertura.tools.look.node import NodeSoFar

Axes = dict[str, NDArray[np.float64]]
"""Body axes of the antennas with beams, as of `apertura.stages.pair.beams_of`."""


_CERTIFIED = 16  # pixels that are also summed exactly
_TOGETHER = 16  # pulses that are bounded in range by one of them
_CELLS = 8  # of resolution that the shorter side of a scene must have before its image is judged
_JUDGED = 1024  # pulses kept for the judgement, evenly spread


@dataclass(frozen=True, eq=False)
class PulseBlock:
    """Some pulses of a pair: transfer functions, body axes and times.

    Attributes
    ----------
    history
        Their phase history.
    axes
        As of `apertura.stages.pair.beams_of`.
    time
        (pulse,) datetime64[ns], UTC.
    weight
        Pulses that each stands for: those left out beside it, and itself.
    """

    history: PhaseHistory
    axes: Axes
    time: Times
    weight: int = 1


@dataclass(frozen=True, eq=False)
class Compressed:
    """Pulses of a block that may add to an image, with axes, times and weight as of the block, and how many it had."""

    profiles: Profiles
    axes: Axes
    time: Times
    pulses: int
    weight: int = 1

    def every(self, step: int) -> "Compressed":
        """Return every `step`-th pulse, apart from the others' memory."""
        some = self.profiles[::step]
        axes = {name: one[::step] for name, one in self.axes.items()}
        own = replace(some, samples=np.array(some.samples))
        return replace(self, profiles=own, axes=axes, time=self.time[::step])

    @classmethod
    def joined(cls, several: Sequence["Compressed"]) -> "Compressed":
        """Return several blocks as one; shorter profiles end in zeros."""
        parts = [one.profiles for one in several]
        longest = max(one.samples.shape[1] for one in parts)
        samples = [np.pad(one.samples, ((0, 0), (0, longest - one.samples.shape[1]))) for one in parts]
        whole = replace(
            parts[0],
            samples=np.concatenate(samples),
            start_m=np.concatenate([one.start_m for one in parts]),
            aperture=Aperture(*(np.concatenate([one.aperture.legs[leg] for one in parts]) for leg in (0, 1))),
        )
        axes = {name: np.concatenate([one.axes[name] for one in several]) for name in several[0].axes}
        return cls(whole, axes, np.concatenate([one.time for one in several]), sum(one.pulses for one in several))


class ImageSoFar:
    """The sum of the pulses so far over a grid: eq. 8 of docs/theory/engine.md, block by block.

    Parameters
    ----------
    campaign, pair
        Settings, and which pair.
    grid, terrain
        Its pixels, and the ground under them.
    share
        Of the band and of the resolution along the flight: 2 takes the middle half of the subcarriers and half the
        angle, whose cells twice as wide need every second pixel.
    accuracy_db
        Requested numerical error.
    threads
        Tiles formed at once.
    plans
        Share → how it is formed: what one pair has planned serves the others, as long as the error measured allows.
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
        self._speed_m_s = 0.0
        self._summed, self._every, self._kept = 0, 1, list[Compressed]()

    def compressed(self, block: PulseBlock) -> "Compressed":
        """Return the range profiles of a block, over this image's share of the band, of pulses that may add to it."""
        history, count = block.history, len(block.history.frequency_hz)
        self._speed_m_s = self._speed_m_s or history.wave_speed_m_s  # of all blocks: air changes it by less than 1e-8
        kept = -(-count // self.share)
        part = slice((count - kept) // 2, (count - kept) // 2 + kept)
        weight = window_weights(self._campaign.settings.processing.window, kept)
        some = replace(
            history, transfer=history.transfer[:, part], frequency_hz=history.frequency_hz[part], weight=weight
        ).at_speed(self._speed_m_s)
        window = RangeWindow.of(
            some.aperture,
            self.grid,
            self._terrain,
            some.frequency_hz,
            beams=self._beams(some.aperture, block.axes, centre_frequency(some.frequency_hz)),
            wave_speed_m_s=self._speed_m_s,
            together=_TOGETHER,
        )
        here = window.contributing
        some = replace(
            some,
            transfer=some.transfer[here],
            reference_delay_s=some.reference_delay_s[here],
            aperture=some.aperture[here],
        )
        window = replace(window, start_m=window.start_m[here], farthest_m=window.farthest_m[here])
        profiles = range_compress(some, self.grid, self._terrain, window=window)
        axes = {name: one[here] for name, one in block.axes.items()}
        return Compressed(profiles, axes, block.time[here], len(block.time), block.weight)

    def add(self, block: "Compressed") -> None:
        """Add a block of `compressed` pulses.

        The setting is planned for the first, and again where the measured error is above the requested one.
        """
        self.pulses += block.pulses
        profiles = block.profiles
        if not len(profiles):
            return
        beams = self._beams(profiles.aperture, block.axes, profiles.centre_frequency_hz)
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
        places = plan.terrain.positions_at(self.grid, *self._pixels.T)
        self._exact += block.weight * band_limited_image(profiles, places, beams=beams)
        self._summed += block.weight * len(profiles)
        power = np.full(_CERTIFIED, float(np.mean(np.abs(self.sums) ** 2)))
        computed = self.sums[tuple(self._pixels.T)]
        self.error_db = error_bound(computed, self._exact, np.ones(_CERTIFIED), power=power).bound_db
        self._kept.append(block.every(max(1, self._every // block.weight)))
        if sum(len(one.profiles) for one in self._kept) > _JUDGED:
            self._every *= 2
            self._kept = [one.every(2) for one in self._kept]

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

    def _beams(self, aperture: Aperture, axes: Axes, centre_hz: float) -> Beams | None:
        """Return the weights of pulses: antennas, and a sector that no later pulse changes; None: all count alike."""
        requested = self._campaign.settings.processing.integrated
        antennas = beams_of(self._campaign, self._pair, axes)
        if requested == "all" or len(aperture) < 2:
            return antennas
        half = sector_half(requested, self._speed_m_s / centre_hz, self.grid.spacing_m)
        half /= 1 if requested == "auto" else self.share  # what pixels carry follows from their spacing
        if half * (1 - TAPER) >= 1:  # all directions
            return antennas
        middle_m = self._terrain.positions_at(self.grid, *((size - 1) / 2 for size in self.grid.shape))
        range_m = float(np.linalg.norm(aperture.middle_m - middle_m, axis=-1).min())
        return Beams.within(Sector.of(aperture, chord_m=CHORD * range_m, centre=0.0, half=half), antennas)

    @property
    def image(self) -> NDArray[np.complex64]:
        """(y, x) complex64, the mean over the pulses so far that may add to it."""
        return np.asarray(self.sums / np.float32(max(1, self._summed)), np.complex64)

    @property
    def setting(self) -> str:
        """Engine and options."""
        return self._plan.setting.line if self._plan else ""

    @property
    def peak(self) -> dict[str, float]:
        """Place of the brightest pixel, metres of the scene's CRS, and dB above the median pixel."""
        power = np.abs(self.sums) ** 2
        row, column = np.unravel_index(int(power.argmax()), power.shape)
        x_m, y_m = map(float, self.grid.map_at(row, column))
        lit = power[power > 0]
        above_db = 10 * float(np.log10(power.max() / np.median(lit))) if lit.size else 0.0
        return {"x_m": round(x_m, 3), "y_m": round(y_m, 3), "above_median_db": round(above_db, 1)}

    def judged(self) -> dict[str, Any]:
        """Return verdict, why, loss_db where it was measured, and flags, by the pulses kept."""
        pulses = sum(len(one.profiles) for one in self._kept)
        if self._plan is None or pulses < LEAST_PULSES or not self.sums.any():
            return {"verdict": "cannot tell", "why": f"{pulses} pulses so far", "flags": {}}
        joined = Compressed.joined(self._kept)
        profiles, at = joined.profiles, joined.time
        beams = self._beams(profiles.aperture, joined.axes, profiles.centre_frequency_hz)
        plan = replace(self._plan, beams=beams, integration=None, flags={})  # they are of the block it was planned for
        side = self._campaign.settings.processing.tile_px
        formation = Formation(None, profiles, self.grid, plan, side)
        cell_m = resolution_cell_m(formation)
        if not cell_m * _CELLS < min(self.grid.shape) * self.grid.spacing_m:
            return {"verdict": "cannot tell", "why": f"no aperture yet: cells of {cell_m:.2g} m", "flags": {}}
        stated = [self._campaign.settings.nodes[node].position_std_m for node in self._pair.split("-")]
        std_m = None if None in stated else max(float(np.max(cast("Any", one))) for one in stated)
        seconds = seconds_since(at, at[0])
        error_db = float(self.error_db) if np.isfinite(self.error_db) else None
        lines = budget_by_hand(formation, error_db=error_db, position_std_m=std_m, time_s=seconds)
        judged = judgement(formation, self.image, lines)
        loss = {"loss_db": judged.focus["loss_db"]} if "loss_db" in judged.focus else {}
        return {"verdict": judged.verdict, "why": judged.why, **loss, "flags": dict(judged.flags)}


AT_ONCE = 2048
"""Pulses of a block at most: each costs a tenth of a second, however few they are."""

_LEAST = 32  # pulses of a block while more will come: the state of a sidelink is measured on each
_OVERLAP = 256  # pulses that are paired again, so that tags of the next follow from theirs
_QUEUE_BYTES = 512_000_000  # of profiles that wait for the fine image


@dataclass(eq=False)
class PairSoFar:
    """A pair while it flies: pulses are paired and held back until both logs know where they were sent and received.

    Attributes
    ----------
    campaign, flight, name
        Which.
    scene
        First block → grid, and its ground.
    echo
        Of a recorder that stores transfer functions; tx, rx and sent are then None.
    tx, rx, sent
        Its nodes, and what was transmitted.
    threads
        Tiles formed at once.
    plans
        As of `ImageSoFar`.
    images
        Coarse, then fine; the fine one's pulses wait in a queue.
    dropped
        Pulses read that have no position or no sidelink, or are left out as every other.
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
    images: list[ImageSoFar] = field(default_factory=list)
    taken: int = 0
    dropped: int = 0
    until: np.datetime64 | None = None
    why_dropped: str = ""
    _shift_ns: int = 0
    _blocks: int = 0
    _raised: dict[str, tuple[int, str]] = field(default_factory=dict)  # blocks that raised a flag, and its last line
    _queue: list[Compressed] = field(default_factory=list)
    _fine: bool = True

    def anew(self) -> "PairSoFar":
        """Return the pair before its first pulse."""
        given = ("campaign", "flight", "name", "scene", "echo", "tx", "rx", "sent", "threads", "plans")
        return PairSoFar(*(getattr(self, name) for name in given))

    def ready(self, *, ended: bool) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return captures of transmitter and receiver that belong together and were not taken yet.

        Those are held back that a log does not reach yet, or whose partner may still come.
        """
        nothing = np.zeros(0, np.int64)
        if self.tx is None or self.rx is None or self.sent is None:
            here = np.arange(self.taken, len(self.time))
            return here, here
        until = min(node.known_until(ended=ended) for node in (self.tx, self.rx))
        last = int(np.searchsorted(self.tx.time, until, "right"))
        if self.tx is self.rx:
            here = np.arange(self.taken, last)
            return here, here
        tags = [nanoseconds(node.time) for node in (self.tx, self.rx)]
        if last <= self.taken or not tags[1].size:
            return nothing, nothing
        interval_ns = round(1e9 / self.sent.waveform.prf_hz)
        tags[1] = tags[1] - self._shift_ns
        if not ended:
            last = min(last, int(np.searchsorted(tags[0], tags[1][-1] - interval_ns)))
        if last <= self.taken:
            return nothing, nothing
        begun = max(0, self.taken - _OVERLAP)
        ends = np.searchsorted(tags[1], [tags[0][begun] - interval_ns, tags[0][last - 1] + interval_ns])
        some = slice(begun, last), slice(*map(int, ends))
        if some[1].start == some[1].stop:
            return nothing, nothing
        found = associate(
            tags[0][some[0]],
            tags[1][some[1]],
            repetition_interval_s=interval_ns * 1e-9,
            tx_frame=self.tx.frame[some[0]],
            rx_frame=self.rx.frame[some[1]],
            where=f"flight {self.flight}, pair {self.name}",
        )
        tx_index, rx_index = found.tx_index + some[0].start, found.rx_index + some[1].start
        self._shift_ns += round(float(np.median(tags[1][rx_index] - tags[0][tx_index])))
        new = ~found.outlier & (tx_index >= self.taken)
        return tx_index[new], rx_index[new]

    def add_next(self, *, ended: bool, every: int = 1) -> bool:
        """Read a block of the pulses that have come and add it to the coarse image; return whether there was one.

        Of every `every` pulses one is taken.
        """
        try:
            tx_index, rx_index = self.ready(ended=ended)
        except CampaignError as error:  # tags that do not pair yet
            if ended:
                self.why_dropped = str(error)
            return False
        if len(tx_index) < (1 if ended else _LEAST * every):
            return False
        some = slice(0, AT_ONCE * every)
        tx_index, rx_index = tx_index[some], rx_index[some]
        read = self.taken
        self.taken = int(tx_index[-1]) + 1
        kept = tx_index % every == 0
        added = self._add(tx_index[kept], rx_index[kept], every) if kept.any() else 0
        self.dropped += self.taken - read - added
        self.until = self.time[self.taken - 1]
        return True

    def _add(self, tx_index: NDArray[np.int64], rx_index: NDArray[np.int64], every: int) -> int:
        """Add the pulses of some captures; return how many have a position and a transfer function."""
        try:
            block = self._block(tx_index, rx_index)
        except (CampaignError, OSError) as error:  # also a file that has just been removed
            self.why_dropped = str(error)
            return 0
        if block is None:
            return 0
        block = replace(block, weight=every)
        if not self.images:
            self.images = self._begin(block)
        coarse, fine = self.images
        coarse.add(coarse.compressed(block))
        if self._fine:
            self._queue.append(fine.compressed(block))
            self._fine = sum(one.profiles.samples.nbytes for one in self._queue) <= _QUEUE_BYTES
            self._queue = self._queue if self._fine else []  # it would never be as far as the coarse one
        return len(block.time)

    def _block(self, tx_index: NDArray[np.int64], rx_index: NDArray[np.int64]) -> PulseBlock | None:
        """Return the echo of some captures, as step `echo` forms it of all; None where no pulse is left."""
        campaign, processing = self.campaign, self.campaign.settings.processing
        if self.tx is None or self.rx is None or self.sent is None:
            return self._read(cast("PairEcho", self.echo), tx_index)
        try:
            inside = inside_segments(campaign, self.flight, self.name, self.tx.time[tx_index])
        except CampaignError:  # none is
            return None
        tx = self.tx.acquisition(tx_index[inside])
        rx = tx if self.rx is self.tx else self.rx.acquisition(rx_index[inside])
        hovers = bool(campaign.segments_of(self.flight, self.name))
        if not place(tx, rx, tx.raw.time.values, hovers=hovers).good.any():
            self.why_dropped = "hover: platform stationary"
            return None
        air = scene_air(campaign, tx.track.position.values)
        offset = calibrated(campaign, self.flight, self.name)
        echo = pair_echo(tx, rx, self.sent, processing, offset, air, hovers=hovers)
        return self._read(echo, np.arange(echo.dataset.sizes["pulse"]))

    def _read(self, echo: PairEcho, pulses: NDArray[np.int64]) -> PulseBlock:
        formed = replace(echo, dataset=echo.dataset.isel(pulse=pulses)).at(slice(None))
        self._blocks += 1
        for name, line in Flags.merged(formed.attrs["flags"], echo.saturation.flags).items():
            self._raised[name] = self._raised.get(name, (0, ""))[0] + 1, line
        history = phase_history_of(formed, self.campaign.settings.processing.window)
        return PulseBlock(history, body_axes(formed), formed.time.values)

    def _begin(self, block: PulseBlock) -> list[ImageSoFar]:
        """Return the images, coarse and fine."""
        campaign, (grid, ground) = self.campaign, self.scene(block)
        requested = campaign.settings.processing.accuracy_db
        accuracy_db = MOST_ACCURACY_DB if requested == "auto" else float(requested)
        images = []
        for share in (2, 1):
            own = grid.coarse(max(grid.shape) // share)
            terrain = UncheckedDem(ground.dem, own) if ground.dem else ground.level(own)
            how: dict[str, Any] = {
                "share": share,
                "accuracy_db": accuracy_db / share,
                "threads": self.threads,
                "plans": self.plans,
            }
            images.append(ImageSoFar(campaign, self.name, own, terrain, **how))
        return images

    def refine_next(self) -> bool:
        """Add the next block of the queue to the fine image; return whether there was one."""
        if not self._queue:
            return False
        self.images[1].add(self._queue.pop(0))
        return True

    def judged(self) -> dict[str, Any]:
        """Return the judgement of the fine image, or of the coarse one where that has more than twice its pulses.

        The coarse one may only say that it is focused: in its range cells, twice as deep, points spoil each other while
        they are being passed.
        """
        coarse, fine = self.images
        by = fine if 2 * fine.pulses >= coarse.pulses else coarse
        judged = by.judged() | {"judged_by": f"{by.pulses} pulses, {'fine' if by is fine else 'coarse'}"}
        if by is coarse and judged["flags"]:
            judged |= {"verdict": "cannot tell", "why": f"the coarse image alone: {judged['why']}", "flags": {}}
        return judged

    @property
    def time(self) -> Times:
        """(pulse,) datetime64[ns], UTC: when the pulses so far were sent."""
        if self.tx is None:
            return cast("Times", cast("PairEcho", self.echo).dataset.time.values)
        return self.tx.time

    @property
    def delay_s(self) -> float | None:
        """Seconds by which the last pulse added is behind the last one recorded; None before both."""
        if self.until is None or not len(self.time):
            return None
        return round(float((self.time[-1] - self.until) / np.timedelta64(1, "s")), 2)

    @property
    def counts(self) -> dict[str, int]:
        """Pulses recorded, added to what is shown, and left out."""
        return {"recorded": len(self.time), "added": self.shown.pulses if self.shown else 0, "left_out": self.dropped}

    @property
    def flags(self) -> dict[str, str]:
        """Flags that most blocks raised, with the last line: the statistics of a single block may be chance."""
        return {name: line for name, (times, line) in self._raised.items() if 2 * times > self._blocks}

    @property
    def waits(self) -> str:
        """Missing parts for more pulses; empty: none."""
        nodes = [node.waits for node in (self.tx, self.rx) if node is not None]
        return next((why for why in (*nodes, self.why_dropped) if why), "")

    @property
    def shown(self) -> ImageSoFar | None:
        """The fine image where it has all pulses that the coarse one has; else that one."""
        if not self.images:
            return None
        coarse, fine = self.images
        return fine if fine.pulses == coarse.pulses else coarse
