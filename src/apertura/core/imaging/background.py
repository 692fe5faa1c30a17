"""Decision on the background of a pair: gain in the image by its removal, and loss of targets.

docs/theory/background.md: loss of targets (eq. 4), gain measured on pixels of the scene (eq. 5), decision (eq. 6).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.backprojection.contributions import band_limited_image
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.background import Background, GroupMeans
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround

LEAST_NET_DB = 0.5
"""Minimum gain minus loss, dB, for which `auto` removes a background: a smaller one is not visible in the image."""

MOST_LOSS_DB = 3.0
"""Largest loss of a target, dB, that `auto` accepts, whatever the gain: half of its power."""

FLAGGED_LOSS_DB = 1.0
"""Loss of a target by the removal, dB, above which `background_loss` is raised."""

FLAGGED_GAIN_DB = 3.0
"""Gain that the decision leaves unused, dB, above which `background` is raised."""

SIMPLER_DB = 2.0
"""Minimum additional net gain, dB, for which a method is preferred to a simpler one. Longer windows are simpler than
shorter ones, and removal at all delays is simpler than removal at some."""

RUNNING = 4, 8, 16
"""Lengths of the running medians that `auto` tries, as fractions of the duration."""

# for the gain: length of blocks of consecutive pulses, and number of random pixels
_BLOCKS, _PULSES, _PIXELS = 4, 2048, 256
_LOSS_PULSES, _STEADY_PULSES = 2**10, 512
_LATTICE, _ZOOMED = 33, 9
_WAVELENGTHS = 1 / 64  # step of the last lattice
_SIDELOBES = 3  # cells on either side of a target at which nothing is removed


@dataclass(frozen=True, eq=False)
class Removal:
    """Decision on a background.

    Attributes
    ----------
    background
        The component that is removed; None: nothing is removed.
    value
        Method, or none.
    reason
        A phrase.
    gain_db
        Ratio of the median pixel power without and with the removal, dB, for `value`; for the best method if none is
        used.
    loss_db
        Change of a target's peak by the removal, dB, 0 or less: that of the target with the largest loss.
    middle_loss_db
        The same for a target at the scene centre.
    left_db
        Gain of the best method, whatever targets lose, relative to that of the method applied, dB.
    """

    background: Background | None
    value: str
    reason: str
    gain_db: float
    loss_db: float
    middle_loss_db: float
    left_db: float = 0.0

    @property
    def net_db(self) -> float:
        """Gain less the largest loss, dB (eq. 6)."""
        return self.gain_db + self.loss_db

    def undone(self, reason: str, most_db: float) -> "Removal":
        """Return the decision against the removal, which leaves the gain of the best method unused."""
        return replace(self, background=None, value="none", reason=reason, left_db=most_db)

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values."""
        numbers = {name: round(getattr(self, name), 2) + 0.0 for name in ("gain_db", "loss_db", "middle_loss_db")}
        return {"removed": self.value, "reason": self.reason, **numbers}

    @property
    def flags(self) -> Flags:
        """Flags: `background` if arcs remain in the image, `background_loss` if targets lose power by the removal."""
        flags = Flags()
        if self.left_db >= FLAGGED_GAIN_DB:
            flags["background"] = f"{self.left_db:.1f} dB; {self.reason}"
        if self.background is not None and self.loss_db <= -FLAGGED_LOSS_DB:
            flags["background_loss"] = f"at most {-self.loss_db:.1f} dB; removed: {self.value}"
        return flags


@dataclass(frozen=True, eq=False)
class BackgroundScene:
    """Data of a pair and of its scene that the decision requires.

    Attributes
    ----------
    history
        Transfer functions, read on access.
    delay_s
        (pulse,) float64, delay removed from the recorder's transfer functions.
    extra_s
        (pulse,) float64, delay of an echo in the recorder in addition to the geometric delay.
    time_s
        (pulse,) float64, seconds from the first pulse.
    grid, ground
        The scene, as flat ground.
    """

    history: PhaseHistory
    delay_s: Floats
    extra_s: Floats
    time_s: Floats
    grid: SceneGrid
    ground: FlatGround

    def positions(self, rows: NDArray[Any], columns: NDArray[Any]) -> Floats:
        """Return the (pixel, 3) positions of pixels in the frame of the phase centres."""
        return self.grid.positions_at(rows, columns, self.ground.height_m)

    def delays(self, points_m: Floats, pulses: int) -> tuple[Floats, Floats]:
        """Return recorder delays of (point, 3) points, (pulse, point), and times, s, of at most `pulses` pulses."""
        some = slice(None, None, -(-len(self.time_s) // pulses))
        path_s = self.history.aperture[some].path(points_m) / self.history.wave_speed_m_s
        return path_s + self.extra_s[some, None], self.time_s[some]

    def cells(self, delays_s: Floats) -> NDArray[np.int64]:
        """Return the delays in steps of the resolution, modulo the unambiguous delay."""
        frequency = self.history.frequency_hz
        step_s = 1 / (len(frequency) * (frequency[1] - frequency[0]))
        return np.asarray(np.rint(delays_s / step_s).astype(np.int64) % len(frequency))

    def cells_of(self, point_m: Floats) -> NDArray[np.bool_]:
        """Return a mask of delays with the echo of a target, (subcarrier,) bool in steps of the resolution."""
        cells = np.unique(self.cells(self.delays(point_m[None], _STEADY_PULSES)[0]))
        mask = np.zeros(len(self.history.frequency_hz), np.bool_)
        mask[(cells[:, None] + np.arange(-_SIDELOBES, _SIDELOBES + 1)) % len(mask)] = True
        return mask

    @property
    def wavelength_m(self) -> float:
        """Wavelength at the highest frequency, metres."""
        return self.history.wave_speed_m_s / float(self.history.frequency_hz[-1])

    def pixel_powers(self, backgrounds: Sequence[Background | None], generator: np.random.Generator) -> list[float]:
        """Return the median power of random pixels, summed over blocks of pulses, without each of the backgrounds."""
        pixels = self.positions(*(generator.integers(size, size=_PIXELS) for size in self.grid.shape))
        count = len(self.time_s)
        starts = np.unique(np.linspace(0, max(0, count - _PULSES), _BLOCKS).astype(int))
        powers = np.zeros((len(backgrounds), _PIXELS))
        for start in starts:
            some = slice(int(start), min(int(start) + _PULSES, count))
            block = self.history[some]
            transfer = np.asarray(block.transfer)
            for number, background in enumerate(backgrounds):
                cleaned = transfer
                if background is not None:
                    cleaned = transfer - background.at(self.time_s[some], block.frequency_hz, self.delay_s[some])
                profiles = range_compress(replace(block, transfer=cleaned), self.grid, self.ground)
                powers[number] += np.abs(band_limited_image(profiles, pixels)) ** 2
        return [float(np.median(row)) for row in powers]


def decide_removal(
    means: GroupMeans, scene: BackgroundScene, *, method: str | float, generator: np.random.Generator
) -> Removal:
    """Decide on the removal of a background, and by which method.

    Parameters
    ----------
    means, scene
        Of the pair.
    method
        auto: the median or a running median, at all delays or at all except those of the target with the most stable
        delay, whichever has the largest gain. It is used only if the gain exceeds the loss of a target at any position,
        and no loss exceeds `MOST_LOSS_DB`. Any other method of `GroupMeans.background` is applied at all delays,
        regardless of the loss.
    generator
        Random generator that draws the pixels.

    Notes
    -----
    Source: docs/theory/background.md, eqs. 4 to 6.
    """
    middle_m = scene.positions(*(np.array([size // 2]) for size in scene.grid.shape))[0]
    first_m = steadiest(scene)
    everywhere = np.zeros(len(scene.history.frequency_hz), np.bool_)
    kept = scene.cells_of(first_m)
    candidates: list[tuple[str | float, NDArray[np.bool_], Floats]] = [(method, everywhere, first_m)]
    if method == "auto":
        duration_s = float(np.ptp(scene.time_s))
        methods: list[str | float] = ["median"]
        methods += [duration_s / part for part in RUNNING if duration_s / part >= means.shortest_s]
        second_m = steadiest(scene, without=kept)
        candidates = [(one, everywhere, first_m) for one in methods] + [(one, kept, second_m) for one in methods]
    backgrounds = [means.background(one).outside(excluded) for one, excluded, _ in candidates]
    without, *powers = scene.pixel_powers([None, *backgrounds], generator)
    tried = []
    for (one, excluded, steadiest_m), background, power in zip(candidates, backgrounds, powers, strict=True):
        middle_db = target_loss(scene, one, middle_m, without=excluded)
        loss_db = min(middle_db, target_loss(scene, one, steadiest_m, without=excluded))
        gain_db = decibels(without / max(power, 1e-300))
        value = one if isinstance(one, str) else f"running median of {one:.3g} s"
        value += " but at the delay of the steadiest target" if excluded.any() else ""
        reason = f"{value}: the median pixel falls by {gain_db:.1f} dB, targets lose at most {-loss_db:.2g} dB"
        tried.append(Removal(background, value, reason, gain_db, loss_db, middle_db))
    best, *others = [one for one in tried if one.loss_db >= -MOST_LOSS_DB] or tried
    for other in others:
        best = other if other.net_db > best.net_db + SIMPLER_DB else best
    if method != "auto":
        return replace(best, reason=f"configured; {best.reason}")
    most_db = max(one.gain_db for one in tried)
    if best.loss_db < -MOST_LOSS_DB:
        return best.undone(f"auto: too high a loss by {best.reason}", most_db)
    if best.net_db < LEAST_NET_DB:
        return best.undone(f"auto: no net gain by {best.reason}", most_db)
    return replace(best, reason=f"auto: {best.reason}", left_db=most_db - best.gain_db)


def steadiest(scene: BackgroundScene, *, without: NDArray[np.bool_] | None = None) -> Floats:
    """Return the position of the target whose delay changes least over the pulses, (3,) float64.

    Searches a lattice over the grid, then finer ones about its best point, down to a small fraction of the wavelength:
    the standard deviation of the delay is a smooth function of the position. Targets at the delays `without`, as
    returned by `cells_of`, are excluded.
    """
    shape = scene.grid.shape
    axes = [np.linspace(0, size - 1, _LATTICE) for size in shape]
    while True:
        rows, columns = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
        points = scene.positions(rows, columns)
        delays = scene.delays(points, _STEADY_PULSES)[0]
        spread_s = delays.std(axis=0)
        if without is not None:
            spread_s[without[scene.cells(delays)].any(axis=0)] += spread_s.max()
        best = int(spread_s.argmin())
        steps = [float(axis[1] - axis[0]) for axis in axes]
        if max(steps) * scene.grid.spacing_m < _WAVELENGTHS * scene.wavelength_m:
            return np.asarray(points[best])
        axes = [
            np.linspace(max(0, at - step), min(size - 1, at + step), _ZOOMED)
            for at, step, size in zip((rows[best], columns[best]), steps, shape, strict=True)
        ]


def target_loss(
    scene: BackgroundScene, method: str | float, point_m: Floats, *, without: NDArray[np.bool_] | None = None
) -> float:
    """Return the change of a target's peak by the removal of the background, dB, 0 or less (eq. 4).

    Parameters
    ----------
    scene
        Of the pair.
    method
        A name: method over all pulses; a number: length of the running median, s.
    point_m
        (3,) float64, position of the target.
    without
        Delays that are not removed, as returned by `BackgroundScene.cells_of`.
    """
    frequency, weight = scene.history.frequency_hz, scene.history.weight
    delays, times = scene.delays(point_m[None], _LOSS_PULSES)
    # exp(−jφ) of the echo at every pulse and frequency, and its share μ in the background
    echo = np.exp(-2j * np.pi * np.remainder(delays * frequency, 1.0))
    part = GroupMeans(echo, times).background("mean" if isinstance(method, str) else method)
    if without is not None and without.any():
        part = part.outside(without)
    removed = part.at(times, frequency, np.zeros(len(times)))
    kept = 1.0 - float((weight * (echo.conj() * removed).real.mean(axis=0)).sum())
    return 20 * math.log10(min(max(kept, 1e-15), 1.0))
