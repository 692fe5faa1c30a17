"""The paper's figures of its simulation: range-compressed data beside the image, without and with each error."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from apertura.common.arrays import Complexes, Floats
from apertura.core.focus.engines import numba
from apertura.core.imaging.backproject import backproject
from apertura.core.scene.grid import SceneGrid
from apertura.views.chart.png import save_png
from apertura_research.study.paper.losses import ERRORS, history_of
from apertura_research.study.paper_scene import UNDISTURBED, PaperScene, receive_pair
from apertura_research.study.point_response import amplitude_db, find_peaks, range_tables, undisturbed_tables

SHOWN: Mapping[str, tuple[str, float]] = {
    "no_errors": ("timing", 0.0),
    "sfo": ("sfo", 400.0),
    "cfo": ("cfo", 50.0),
    "carrier_phase": ("carrier_phase", 0.5),
    "timing": ("timing", 0.5),
    "localization": ("localization", 2.0),
}
"""Figure → the error that is drawn, and its size in its unit."""

RANGE_DB = 50.0
PULSES = 600
"""At least: fewer show grating lobes beside the track."""

_GRID = SceneGrid.from_bounds("local", (-7.0, 2.0, 7.0, 28.0), spacing_m=0.025)
_CORNERS_M = np.array([[x, y, 0.0] for x in (-7.0, 7.0) for y in (2.0, 28.0)])
_PATH_M = np.arange(20.0, 66.0, 0.1)
_COLUMNS = 500


def draw_simulated(name: str, path: Path, *, seed: int = 1) -> Path:
    """Draw data and image with one error, a key of `SHOWN`, as PNG; return its path.

    Both panels are in dB against the peak of the same scene without error, so that what is lost is seen.
    """
    key, size = SHOWN[name]
    error = ERRORS[key]
    scene = error.scene(max(error.pulses, PULSES))
    disturbance = error.disturbance(size) if size else UNDISTURBED
    radar, sidelink, _ = receive_pair(scene, disturbance, np.random.default_rng(seed))
    history, targets = history_of(scene, radar, sidelink, divided=error.divided), scene.scatterers.position_m
    clean = undisturbed_tables(scene)
    figure = Figure(figsize=(11, 5), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_data(left, scene, range_tables(history, _CORNERS_M), float(np.abs(clean.samples).max()))
    image = backproject(history, _GRID, certified_pixels=0).values
    picture = _draw_image(right, image, float(find_peaks(clean, targets)[1].max()))
    words = f"{error.sweep.title}: {size:g} {error.sweep.unit}".replace("±:", "±")
    figure.suptitle(words if size else "No errors")
    figure.colorbar(picture, ax=(left, right), label="dB re peak without error", extend="min", fraction=0.04)
    save_png(figure, path)
    return path


def _draw_data(axes: Axes, scene: PaperScene, data: numba.OversampledTables, peak: float) -> None:
    """Draw the profiles on one axis of total path, whatever the path at which each pulse begins."""
    every = max(1, len(data.samples) // _COLUMNS)
    levels = [_level_at(data, pulse) for pulse in range(0, len(data.samples), every)]
    along = scene.geometry.radar_tx[:, 0]
    extent = (along[0], along[-1], _PATH_M[0] / 2, _PATH_M[-1] / 2)
    shades = amplitude_db(np.array(levels).T / peak)
    axes.imshow(shades, extent=extent, origin="lower", aspect="auto", cmap="viridis", vmin=-RANGE_DB, vmax=0)
    axes.set(xlabel="Position along the track, m", ylabel="Half of the total path, m")
    axes.set_title("(a) Range-compressed data", loc="left")


def _level_at(data: numba.OversampledTables, pulse: int) -> Floats:
    cell = np.rint((_PATH_M - data.start_m[pulse]) / data.step_m).astype(int)
    inside = (cell >= 0) & (cell < data.samples.shape[1])
    level = np.abs(data.samples[pulse, np.clip(cell, 0, data.samples.shape[1] - 1)])
    return np.asarray(np.where(inside, level, 0.0), np.float64)


def _draw_image(axes: Axes, image: Complexes, peak: float) -> AxesImage:
    west, south, east, north = _GRID.bounds_m
    shades = amplitude_db(np.asarray(np.abs(image) / peak, np.float64))
    picture = axes.imshow(
        shades, extent=(west, east, south, north), aspect="auto", cmap="viridis", vmin=-RANGE_DB, vmax=0
    )
    axes.set(xlabel="Cross-range, m", ylabel="Ground range, m")
    axes.set_title("(b) Image", loc="left")
    return picture


def draw_scene(path: Path) -> Path:
    """Draw where the simulated track and targets are, from above and along the track."""
    scene = ERRORS["timing"].scene(PULSES)
    track, targets = scene.geometry.radar_tx, scene.scatterers.position_m
    figure = Figure(figsize=(11, 4.2), layout="compressed")
    above, aside = figure.subplots(1, 2, width_ratios=(1, 1.5))
    for axes, across, up in ((above, 0, 1), (aside, 1, 2)):
        axes.plot(
            track[:, across], track[:, up], "-", color="#0072B2", linewidth=3, marker="o", markevery=(0, len(track))
        )
        axes.plot(targets[:, across], targets[:, up], "D", color="#D55E00")
        axes.grid(alpha=0.3)
        axes.set_aspect("equal")
    for number, (x, y, _) in enumerate(targets, 1):
        above.annotate(f"{number}", (x, y), (6, 4), textcoords="offset points")
        aside.annotate(f"{number}", (y, 0.0), (4, 5), textcoords="offset points")
        aside.plot([0, y], [track[0, 2], 0.0], ":", color="0.6", linewidth=1)
    above.annotate("track, 30 m at 1 m/s", (0, 0), (-50, 8), textcoords="offset points")
    aside.annotate("track, 10 m high", (0, 10), (8, 4), textcoords="offset points")
    above.set(xlabel="Cross-range, m", ylabel="Ground range, m", ylim=(-2, 28))
    aside.set(xlabel="Ground range, m", ylabel="Height, m", xlim=(-2, 28), ylim=(-2, 13))
    above.set_title("(a) From above", loc="left")
    aside.set_title("(b) Seen along the track", loc="left")
    save_png(figure, path)
    return path
