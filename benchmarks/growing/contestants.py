"""Our engines on a scene, each as its planner sets it: whole calls, tables and sums, tile by tile."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from statistics import median

import numpy as np
from numpy.typing import NDArray

from apertura.core.backprojection.engines import ENGINES, load_engine
from apertura.core.backprojection.inputs import Profiles
from apertura.core.backprojection.job import Job
from apertura.core.backprojection.reach import pulse_blocks_of
from apertura.core.imaging.job import imaging_job
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.planning.planner import make_plan
from apertura.core.scene.terrain import FlatGround, GroundModels
from growing.scene import TILE_PX, Scene, Window

Image = NDArray[np.complex64]
PATIENCE = 5.0
"""Of so many times the limit the least part may be that can stand for an image."""


@dataclass
class Contestant:
    """One way to the image of a scene.

    Attributes
    ----------
    name, setting
        Who, and how it is set.
    scene
        What is imaged.
    run
        Returns the image at the checks, CPU seconds of what all pixels share, and those of the pixels.
    share
        Of the image's pixels that `run` forms; the second seconds are divided by it.
    aim_db
        Asked for; None where nothing can be asked.
    from_echoes
        Whether range compression is inside.
    ways
        Way that pixels × pulses went, where an engine has several → how many, in the last run.
    planning_s
        CPU seconds of our planner, which count in no others; fastsar plans inside `run`.
    """

    name: str
    setting: str
    scene: Scene
    run: Callable[[], tuple[Image, float, float]]
    share: float = 1.0
    aim_db: float | None = None
    from_echoes: bool = False
    planning_s: float = 0.0
    ways: dict[str, int] = field(default_factory=dict)
    shared: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    error_db: float = np.nan

    def go(self) -> None:
        """Run once, note the time, and measure the error."""
        values, shared, pixels = self.run()
        self.shared.append(shared)
        self.seconds.append(shared + pixels / self.share)
        self.error_db = self.scene.error_db(values)

    @property
    def spent(self) -> float:
        """CPU seconds that all runs took."""
        return sum(a + (b - a) * self.share for a, b in zip(self.shared, self.seconds, strict=True))

    def row(self, compression_s: float) -> dict[str, object]:
        """Return what was measured; seconds of the whole image from profiles, and from echoes with their spread."""
        seconds, size, pulses = median(self.seconds), self.scene.size, len(self.scene.history)
        echoes = seconds + (0.0 if self.from_echoes else compression_s)
        return {
            "group": "growth",
            "name": self.name,
            "setting": self.setting,
            "geometry": self.scene.geometry,
            "surface": self.scene.surface,
            "size": size,
            "pulses": pulses,
            "aim_db": self.aim_db,
            "seconds": None if self.from_echoes else _digits(seconds),
            "seconds_from_echoes": _digits(echoes),
            "seconds_shared": _digits(median(self.shared)),
            "spread": [_digits(found(self.seconds) + echoes - seconds) for found in (min, max)],
            "planning_seconds": _digits(self.planning_s),
            "pixel_pulses_per_s": _digits(size**2 * pulses / echoes),
            "ways": {way: _digits(count / max(1, sum(self.ways.values()))) for way, count in self.ways.items()},
            "error_db": round(self.error_db, 1),
            "scaled": self.share < 1,
            "share": _digits(self.share),
            "rounds": len(self.seconds),
        }


class SkippedError(Exception):
    """Why somebody does not take part."""


def _digits(value: float) -> float:
    return float(f"{value:.3g}")


class House:
    """What our engines are given of a scene: profiles, and the planner's job."""

    def __init__(self, scene: Scene):
        self.scene, history, grid = scene, scene.history, scene.grid
        self.profiles: Profiles = range_compress(history, grid, scene.ground)
        self.compressions: list[float] = []
        known = (history.aperture, history.frequency_hz, history.weight)
        models = GroundModels.of(scene.ground, None, grid)
        self.job: Job = imaging_job(*known, grid, models, integration="all")

    def compress(self) -> None:
        """Compress once more in range, and note the time."""
        begin = time.process_time()
        range_compress(self.scene.history, self.scene.grid, self.scene.ground)
        self.compressions.append(time.process_time() - begin)

    def planned(self, engine: str, aim_db: float, limit_s: float, *, fields: bool = False) -> Contestant:
        """Return an engine as the planner sets it for an accuracy.

        Parameters
        ----------
        engine
            A key of `ENGINES`, which may not be there yet.
        limit_s
            Predicted seconds above which only some of the tiles are formed.
        fields
            Whether fields of clutter alone may stand for the image, where the engine works pixel by pixel.

        Raises
        ------
        SkippedError
            If the engine is not there, cannot run here, or would take too long.
        """
        if engine not in ENGINES:
            raise SkippedError(f"{engine} is no engine of this version")
        if not load_engine(engine).available():
            raise SkippedError(f"{engine} was not built here")
        flat = isinstance(self.scene.ground, FlatGround)
        asked = {"engine": engine} | ({} if flat else {"terrain": "dem"})
        begin = time.process_time()
        plan = make_plan(self.job, accuracy_db=aim_db, overrides=asked)
        planning_s = time.process_time() - begin
        setting, inputs = plan.setting, plan.inputs
        windows = _formed(self.scene, setting.form_seconds, limit_s, fields=fields)
        module, ground, grid = load_engine(engine), plan.terrain, self.scene.grid

        ways: tuple[str, ...] = getattr(module, "VARIANTS", ())
        went: dict[str, int] = {}

        def run() -> tuple[Image, float, float]:
            counts = np.zeros(len(ways), np.int64)
            counted = {"counts": counts} if ways else {}
            image = np.zeros(grid.shape, np.complex64)
            begin, pixels_s = time.process_time(), 0.0
            given = inputs(self.profiles)
            shared_s = time.process_time() - begin
            for block in pulse_blocks_of(len(given), setting.pulse_blocks, any_start=True):
                begin = time.process_time()
                tables = module.prepare(given[block], **setting.options)
                shared_s += time.process_time() - begin
                for window in windows:
                    places = ground.positions(grid[window])
                    begin = time.process_time()
                    image[window] += module.form(tables, places, **setting.form_options, **counted)
                    pixels_s += time.process_time() - begin
            went.update(zip(ways, counts.tolist(), strict=True))
            return image[*self.scene.checks], shared_s, pixels_s

        line = setting.line + (f", presum {plan.presum.factor}" if plan.presum else "")
        share = share_of(self.scene, windows)
        return Contestant(engine, line, self.scene, run, share, aim_db, planning_s=planning_s, ways=went)


def share_of(scene: Scene, windows: Iterable[Window]) -> float:
    """Return the share of the image's pixels that lie in windows."""
    return sum((rows.stop - rows.start) * (columns.stop - columns.start) for rows, columns in windows) / scene.size**2


def _formed(scene: Scene, predicted_s: float, limit_s: float, *, fields: bool) -> list[Window]:
    """Return the most that is predicted to take no longer than the limit, or the least if it takes a little longer."""
    for windows in _samples(scene, fields=fields):
        seconds = predicted_s * share_of(scene, windows)
        if seconds <= limit_s:
            return windows
    if seconds > PATIENCE * limit_s:
        raise SkippedError(f"the least part of it would take {seconds:.0f} s")
    return windows


def _samples(scene: Scene, *, fields: bool) -> Iterator[list[Window]]:
    """Yield fewer and fewer windows of the image, each of which hold all pixels that are compared."""
    every, most = 1, -(-scene.size // TILE_PX)
    while every <= most:
        yield scene.tiles(every)
        every *= 2
    if fields:
        yield scene.fields
        yield scene.inner
