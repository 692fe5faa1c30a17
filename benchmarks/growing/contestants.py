"""Engines of apertura on a scene, with the planner's settings: complete calls, with tables and sums, tile by tile."""

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
"""Multiple of the time limit that the smallest representative part of an image may take."""


@dataclass
class Contestant:
    """Image formation of a scene by one program.

    Attributes
    ----------
    name, setting
        Name of the program and its settings.
    scene
        Imaged scene.
    run
        Returns the image at the checks, the CPU seconds common to all pixels, and the CPU seconds of the pixels.
    share
        Fraction of the image pixels that `run` forms; the CPU seconds of the pixels are divided by this fraction.
    aim_db
        Requested accuracy; None if the program has no such setting.
    from_echoes
        True if `run` includes range compression.
    ways
        Path variant, for an engine with several variants → number of pixels × pulses in the last run.
    planning_s
        CPU seconds of apertura's planner, not included in other times; fastsar plans inside `run`.
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
        """Run once, record the time and measure the error."""
        values, shared, pixels = self.run()
        self.shared.append(shared)
        self.seconds.append(shared + pixels / self.share)
        self.error_db = self.scene.error_db(values)

    @property
    def spent(self) -> float:
        """CPU seconds of all runs."""
        return sum(a + (b - a) * self.share for a, b in zip(self.shared, self.seconds, strict=True))

    def row(self, compression_s: float) -> dict[str, object]:
        """Return the results: seconds for the whole image from profiles, and from echoes with their spread."""
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
            "spread": [_digits(extreme(self.seconds) + echoes - seconds) for extreme in (min, max)],
            "planning_seconds": _digits(self.planning_s),
            "pixel_pulses_per_s": _digits(size**2 * pulses / echoes),
            "ways": {way: _digits(count / max(1, sum(self.ways.values()))) for way, count in self.ways.items()},
            "error_db": round(self.error_db, 1),
            "scaled": self.share < 1,
            "share": _digits(self.share),
            "rounds": len(self.seconds),
        }


class SkippedError(Exception):
    """Reason for skipping a contestant."""


def _digits(value: float) -> float:
    return float(f"{value:.3g}")


class EngineInput:
    """Input of apertura's engines for a scene: profiles, and the planner's job."""

    def __init__(self, scene: Scene):
        self.scene, history, grid = scene, scene.history, scene.grid
        self.profiles: Profiles = range_compress(history, grid, scene.ground)
        self.compressions: list[float] = []
        inputs = (history.aperture, history.frequency_hz, history.weight)
        models = GroundModels.of(scene.ground, None, grid)
        self.job: Job = imaging_job(*inputs, grid, models, integration="all")

    def compress(self) -> None:
        """Repeat range compression and record the time."""
        begin = time.process_time()
        range_compress(self.scene.history, self.scene.grid, self.scene.ground)
        self.compressions.append(time.process_time() - begin)

    def planned(self, engine: str, aim_db: float, limit_s: float, *, fields: bool = False) -> Contestant:
        """Return an engine with the planner's setting for an accuracy.

        Parameters
        ----------
        engine
            A key of `ENGINES`; engines missing in this version are skipped.
        limit_s
            Predicted time in seconds above which only a part of the tiles is formed.
        fields
            True if fields of clutter may represent the image, for engines that work pixel by pixel.

        Raises
        ------
        SkippedError
            If the engine is unknown, is not built on this machine, or takes too long.
        """
        if engine not in ENGINES:
            raise SkippedError(f"this version has no engine {engine}")
        if not load_engine(engine).available():
            raise SkippedError(f"{engine} is not built on this machine")
        flat = isinstance(self.scene.ground, FlatGround)
        overrides = {"engine": engine} | ({} if flat else {"terrain": "dem"})
        begin = time.process_time()
        plan = make_plan(self.job, accuracy_db=aim_db, overrides=overrides)
        planning_s = time.process_time() - begin
        setting, inputs = plan.setting, plan.inputs
        windows = _formed(self.scene, setting.form_seconds, limit_s, fields=fields)
        module, ground, grid = load_engine(engine), plan.terrain, self.scene.grid

        variants: tuple[str, ...] = getattr(module, "VARIANTS", ())
        variant_counts: dict[str, int] = {}

        def run() -> tuple[Image, float, float]:
            counts = np.zeros(len(variants), np.int64)
            counted = {"counts": counts} if variants else {}
            image = np.zeros(grid.shape, np.complex64)
            begin, pixels_s = time.process_time(), 0.0
            profiles = inputs(self.profiles)
            shared_s = time.process_time() - begin
            for block in pulse_blocks_of(len(profiles), setting.pulse_blocks, any_start=True):
                begin = time.process_time()
                tables = module.prepare(profiles[block], **setting.options)
                shared_s += time.process_time() - begin
                for window in windows:
                    places = ground.positions(grid[window])
                    begin = time.process_time()
                    image[window] += module.form(tables, places, **setting.form_options, **counted)
                    pixels_s += time.process_time() - begin
            variant_counts.update(zip(variants, counts.tolist(), strict=True))
            return image[*self.scene.checks], shared_s, pixels_s

        line = setting.line + (f", presum {plan.presum.factor}" if plan.presum else "")
        share = share_of(self.scene, windows)
        return Contestant(engine, line, self.scene, run, share, aim_db, planning_s=planning_s, ways=variant_counts)


def share_of(scene: Scene, windows: Iterable[Window]) -> float:
    """Return the fraction of the image pixels within the given windows."""
    return sum((rows.stop - rows.start) * (columns.stop - columns.start) for rows, columns in windows) / scene.size**2


def _formed(scene: Scene, predicted_s: float, limit_s: float, *, fields: bool) -> list[Window]:
    """Return the largest set of windows within the time limit, or the smallest set if it exceeds the limit slightly."""
    for windows in _samples(scene, fields=fields):
        seconds = predicted_s * share_of(scene, windows)
        if seconds <= limit_s:
            return windows
    if seconds > PATIENCE * limit_s:
        raise SkippedError(f"the smallest representative part takes {seconds:.0f} s")
    return windows


def _samples(scene: Scene, *, fields: bool) -> Iterator[list[Window]]:
    """Yield sets of windows of the image in descending order of size, each with all compared pixels."""
    every, most = 1, -(-scene.size // TILE_PX)
    while every <= most:
        yield scene.tiles(every)
        every *= 2
    if fields:
        yield scene.fields
        yield scene.inner
