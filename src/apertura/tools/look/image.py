"""An image that pulses are added into as they come: a sum over pulses, block by block, judged by some of them.

Source: docs/theory/engine.md, eq. 9.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config import CONFIG
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Times
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.contributions import band_limited_image
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.tiles import Weighing, image_array
from apertura.core.echo.compression import centre_frequency, window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.sector import TAPER, Sector
from apertura.core.imaging.focus_check import LEAST_PULSES, resolution_cell_m
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.job import profiles_job
from apertura.core.imaging.judgement import budget_by_hand, judgement
from apertura.core.imaging.range_profiles import RangeWindow, range_compress
from apertura.core.planning.decisions import CHORD, sector_half
from apertura.core.planning.plan import Plan
from apertura.core.planning.planner import make_plan
from apertura.core.quality.error_check import error_bound
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import GroundModels, Terrain
from apertura.stages.pair import beams_of

Axes = dict[str, NDArray[np.float64]]
"""As of `apertura.stages.pair.beams_of`."""


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
        Numerical error asked.
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

        The setting is planned for the first, and again where the error measured is above the one asked.
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
        asked = self._campaign.settings.processing.integrated
        antennas = beams_of(self._campaign, self._pair, axes)
        if asked == "all" or len(aperture) < 2:
            return antennas
        half = sector_half(asked, self._speed_m_s / centre_hz, self.grid.spacing_m)
        half /= 1 if asked == "auto" else self.share  # what pixels carry follows from their spacing
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
        seconds = (at - at[0]) / np.timedelta64(1, "s")
        error_db = float(self.error_db) if np.isfinite(self.error_db) else None
        lines = budget_by_hand(formation, error_db=error_db, position_std_m=std_m, time_s=seconds)
        told = judgement(formation, self.image, lines)
        loss = {"loss_db": told.focus["loss_db"]} if "loss_db" in told.focus else {}
        return {"verdict": told.verdict, "why": told.why, **loss, "flags": dict(told.flags)}
