"""A pair while it flies: which pulses have come, and the images that they are added to."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.core.echo.association import associate
from apertura.core.imaging.range_profiles import phase_history_of
from apertura.core.planning.plan import Plan
from apertura.core.quality.budget import MOST_ACCURACY_DB
from apertura.core.scene.dem import UncheckedDem
from apertura.core.scene.grid import SceneGrid
from apertura.stages.air import scene_air
from apertura.stages.calibration import calibrated
from apertura.stages.echo import pair_echo
from apertura.stages.pair import body_axes
from apertura.stages.positions import inside_segments, place
from apertura.stages.scene import ConfiguredGround
from apertura.stages.transfer import PairEcho
from apertura.stages.transmitted import Transmitted
from apertura.tools.look.image import Compressed, ImageSoFar, PulseBlock
from apertura.tools.look.node import NodeSoFar

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
        tags = [node.time.astype("datetime64[ns]").astype(np.int64) for node in (self.tx, self.rx)]
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
        asked = campaign.settings.processing.accuracy_db
        accuracy_db = MOST_ACCURACY_DB if asked == "auto" else float(asked)
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
        told = by.judged() | {"judged_by": f"{by.pulses} pulses, {'fine' if by is fine else 'coarse'}"}
        if by is coarse and told["flags"]:
            told |= {"verdict": "cannot tell", "why": f"the coarse image alone: {told['why']}", "flags": {}}
        return told

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
        """Flags that most blocks raised, by the last line: what is told by the statistics of one may be chance."""
        return {name: line for name, (times, line) in self._raised.items() if 2 * times > self._blocks}

    @property
    def waits(self) -> str:
        """What is missing for more; empty: nothing."""
        nodes = [node.waits for node in (self.tx, self.rx) if node is not None]
        return next((why for why in (*nodes, self.why_dropped) if why), "")

    @property
    def shown(self) -> ImageSoFar | None:
        """The fine image where it has all pulses that the coarse one has; else that one."""
        if not self.images:
            return None
        coarse, fine = self.images
        return fine if fine.pulses == coarse.pulses else coarse
