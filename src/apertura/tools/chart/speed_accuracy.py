"""Speed against accuracy on the user's own campaign: measured time and error of every engine and setting."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, record_files
from apertura.common.tables import write_table
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines import load_engine, reference
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.imaging.certify import BRIGHT_PIXELS, RANDOM_PIXELS
from apertura.core.imaging.range_profiles import profiles_of
from apertura.core.planning.plan import Plan
from apertura.core.planning.planner import SettingSearch
from apertura.core.quality.error_check import Brightness, error_bound, random_pixels
from apertura.stages.pair import open_pair
from apertura.stages.planning import accuracy_of, gated, job_of, plan_job
from apertura.stages.refine import open_refined
from apertura.stages.scene import OpenScene, open_scene
from apertura.tools.chart.pareto import Point, draw_points, with_front, write_page
from apertura.workflow.lineage import result_of
from apertura.workflow.rules import STUDY

PULSES, SIDE_PX = 1024, 256
LEAST_ROWS = 32
"""Number of rows of the window that are formed with every setting; these rows contain all pixels with exact values."""

_TOLERANCES_RAD = (1.5e-3, 1.5e-4)
_SLOW_SECONDS = 0.3
"""Predicted time for the window, seconds, above which a setting is timed on only some of the window's rows."""


@dataclass(frozen=True)
class Part:
    """Measured part of a campaign: a block of pulses and a window of the image.

    Attributes
    ----------
    history, profiles, beams
        Phase history, range profiles and beams of the block; `beams` is None for antennas without beams.
    pixels
        (y, x, 3) float64, positions of the window's pixels.
    picked, density
        (pixel, 2) int64, rows (below `LEAST_ROWS`) and columns in the window of the pixels with exact values;
        (pixel,) float64, sampling density at these pixels.
    exact
        (pixel,) complex128, exact values.
    total_pixels
        Number of pixels of the whole image.
    reference_seconds
        Time for computing the exact values, seconds.
    """

    history: PhaseHistory
    profiles: Profiles
    pixels: NDArray[np.float64]
    picked: NDArray[np.int64]
    density: NDArray[np.float64]
    exact: NDArray[np.complex128]
    total_pixels: int
    reference_seconds: float
    beams: Beams | None = None


def speed_accuracy(campaign: Campaign, flight: str, pair: str, *, seconds: float = 60.0) -> Sequence[Path]:
    """Write results/study/speed_accuracy.csv, .png and .html.

    Parameters
    ----------
    campaign, flight, pair
        Campaign, flight and pair with finished echo and profile stages.
    seconds
        Time limit of the measurement: the planner's choice and the reference are measured first, then settings in the
        order of their predicted cost.

    Notes
    -----
    The times are those of the engines. The computation of pixel positions and the storage of tiles, which are common to
    all settings, are not included.
    """
    lineage = result_of(campaign, "speed_accuracy").begin(campaign.root)
    scene, track = open_scene(campaign), open_refined(campaign, flight)
    logged = gated(campaign, open_pair(campaign, flight, pair), scene)
    profiles = profiles_of(open_stage(campaign.stage("profile", flight, pair), "profile"))
    opened, profiles = track.pair(logged), track.profiles(logged, profiles)
    middle = len(profiles) // 2
    block = slice(max(0, middle - PULSES // 2), middle + PULSES // 2)
    if opened.history is None:
        raise ValueError("no echo stage")
    history = opened.history[block]
    antennas, gate = opened.beams and opened.beams[block], opened.gate and opened.gate[block]
    beams = Beams.within(None, antennas, gate)
    accuracy_db = float(accuracy_of(campaign, opened, scene).value)
    opened = replace(opened, aperture=history.aperture, history=history, beams=antennas, gate=gate)
    job = job_of(campaign, opened, scene)
    plan, search = plan_job(campaign, job, accuracy_db=accuracy_db), SettingSearch(job)
    part = _part(history, profiles[block], scene, plan, total_pixels=job.pixels, beams=beams)
    settings = [  # sorted by predicted cost, without the reference, which is timed once
        setting
        for setting in search.settings(len(job.aperture))
        if not _is_reference(setting)
        and setting.form_options.get("tolerance_rad", _TOLERANCES_RAD[0]) in _TOLERANCES_RAD
    ]
    points = [
        replace(point, predicted_seconds=point.predicted_seconds - search.tile_seconds)
        for point in measure(part, plan, settings, seconds=seconds)
    ]
    middle_part = "" if len(history) == len(opened.time_s) else f"the central {len(history)} of "
    size = f"{scene.grid.shape[0]} × {scene.grid.shape[1]} pixels, {middle_part}{len(opened.time_s)} pulses"
    title = f"{campaign.settings.campaign}, {flight}/{pair}: {size}"
    paths = [campaign.result(STUDY) / f"speed_accuracy.{suffix}" for suffix in ("csv", "png", "html")]
    write_table(paths[0], points, digits=6)
    draw_points(points, paths[1], title=title, accuracy_db=accuracy_db)
    write_page([asdict(point) for point in points], paths[2], title=title, accuracy_db=accuracy_db)
    record_files(campaign.root / lineage.result.manifest, paths, lineage)
    return paths


def _part(
    history: PhaseHistory,
    profiles: Profiles,
    scene: OpenScene,
    plan: Plan,
    *,
    total_pixels: int,
    beams: Beams | None,
) -> Part:
    """Return the part to measure, with pixels sampled by brightness in the planned image, as for a certificate."""
    window = []
    for size in scene.grid.shape:
        first = max(0, size - SIDE_PX) // 2 // 16 * 16
        window.append(slice(first, min(size, first + SIDE_PX)))
    pixels = scene.terrain.positions(scene.grid[window[0], window[1]])
    rows = pixels[:LEAST_ROWS]
    engine, generator = load_engine(plan.setting.engine), np.random.default_rng(0)
    inputs = history if engine.READS == "phase_history" else plan.inputs(profiles)
    prepared = engine.prepare(inputs, **plan.setting.options)
    image = engine.form(prepared, rows, beams=beams, **plan.setting.form_options)
    whole = [(slice(0, rows.shape[0]), slice(0, rows.shape[1]))]
    brightness = Brightness.of(image, whole)
    bright = brightness.draw(image, whole, BRIGHT_PIXELS, generator)
    picked = np.concatenate([random_pixels(whole, RANDOM_PIXELS, generator), bright])
    density = brightness.density(picked, image[tuple(picked.T)], whole, random=RANDOM_PIXELS)
    start_s = perf_counter()
    exact = reference.form(history, rows[tuple(picked.T)], beams=beams)
    return Part(history, profiles, pixels, picked, density, exact, total_pixels, perf_counter() - start_s, beams)


def _is_reference(setting: Setting) -> bool:
    return cast("object", load_engine(setting.engine)) is reference


def measure(part: Part, plan: Plan, settings: Sequence[Setting], *, seconds: float) -> list[Point]:
    """Measure the plan, the reference and further settings within a time limit; return the points sorted by time."""
    start_s = perf_counter()
    exact = plan.fallbacks[-1] if plan.fallbacks else plan.setting
    exact_s = part.reference_seconds * part.total_pixels / len(part.picked)
    points = [replace(_point(part, exact, exact_s, None, None), planned=_is_reference(plan.setting))]
    if not _is_reference(plan.setting):
        points.append(_measured(part, plan.setting, plan))
    unplanned = [s for s in settings if plan.presum is not None or s.line != plan.setting.line]
    for setting in unplanned:
        if perf_counter() - start_s > seconds:
            break
        points.append(_measured(part, setting, None))
    return with_front(sorted(points, key=lambda point: point.seconds))


def _measured(part: Part, setting: Setting, plan: Plan | None) -> Point:
    engine = load_engine(setting.engine)

    def prepare() -> Any:
        if engine.READS == "phase_history":
            return engine.prepare(part.history, **setting.options)
        return engine.prepare(part.profiles if plan is None else plan.inputs(part.profiles), **setting.options)

    tables_s, prepared = _shortest(prepare, repeats=2)
    n_rows = _SLOW_SECONDS / max(setting.form_seconds, 1e-9) * part.total_pixels / part.pixels.shape[1]
    pixels = part.pixels[: max(LEAST_ROWS, round(n_rows))]
    form_s, image = _shortest(
        lambda: engine.form(prepared, pixels, beams=part.beams, **setting.form_options), repeats=3
    )
    power = float((np.abs(image[:LEAST_ROWS]) ** 2).sum())
    error = error_bound(image[tuple(part.picked.T)], part.exact, part.density, power=power)
    return _point(part, setting, tables_s + form_s * part.total_pixels / pixels[..., 0].size, error.bound_db, plan)


def _point(part: Part, setting: Setting, seconds: float, error_db: float | None, plan: Plan | None) -> Point:
    """Return the point of a setting; `plan` is given for the planner's choice only."""
    return Point(
        engine=setting.engine,
        setting=setting.line,
        presum=1 if plan is None or plan.presum is None else plan.presum.factor,
        seconds=seconds,
        pixel_pulses_per_s=part.total_pixels * len(part.profiles) / seconds,
        error_db=error_db,
        predicted_seconds=setting.seconds,
        predicted_error_db=setting.error_db if plan is None else plan.predicted_error_db,
        on_front=False,
        planned=plan is not None,
    )


def _shortest(work: Any, *, repeats: int) -> tuple[float, Any]:
    times = []
    for _ in range(repeats):
        start_s = perf_counter()
        result = work()
        times.append(perf_counter() - start_s)
    return min(times), result
