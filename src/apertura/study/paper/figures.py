"""Figures like the paper's: range-compressed data beside the image, without and with each error."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from apertura.focus.engines import numba
from apertura.study.paper.losses import ERRORS, history_of
from apertura.study.paper_scene import UNDISTURBED, Complexes, PaperScene, receive_pair
from apertura.study.png import save_png
from apertura.study.point_response import Floats, amplitude_db, mean_image, pixels_around, range_tables

SHOWN = {"carrier_phase": 1.0, "timing": 0.5, "cfo": 50.0, "sfo": 400.0, "localization": 3.0}
"""Size of each error that is drawn, in its unit."""

RANGE_DB = 50.0
PULSES = 600
"""At least: fewer show grating lobes beside the track."""

_CROSS_M = np.linspace(-7, 7, 351)
_GROUND_M = np.linspace(2, 28, 261)


def draw_error(name: str, path: Path, *, seed: int = 1) -> Path:
    """Draw what one error, a key of `SHOWN`, does to data and image, as PNG; return its path."""
    error = ERRORS[name]
    scene = error.scene(max(error.pulses, PULSES))
    figure = Figure(figsize=(12, 9), layout="constrained")
    axes = figure.subplots(2, 2)
    label = f"{error.sweep.title} {SHOWN[name]:g} {error.sweep.unit}"
    peaks: tuple[float, float] | None = None
    cases = ((UNDISTURBED, "no error"), (error.disturbance(SHOWN[name]), label))
    for row, (disturbance, words) in zip(axes, cases, strict=True):
        radar, sidelink, _ = receive_pair(scene, disturbance, np.random.default_rng(seed))
        corners = pixels_around(np.zeros(3), _CROSS_M[[0, -1]], _GROUND_M[[0, -1]]).reshape(-1, 3)
        tables = range_tables(history_of(scene, radar, sidelink, divided=error.divided), corners)
        image = mean_image(tables, pixels_around(np.zeros(3), _CROSS_M, _GROUND_M))
        peaks = peaks or (float(np.abs(tables.samples).max()), float(np.abs(image).max()))
        _draw_data(row[0], scene, tables, peaks[0], words)
        picture = _draw_image(row[1], image, peaks[1], words)
    figure.colorbar(picture, ax=axes, label="dB against the peak without error", extend="min", fraction=0.03)
    save_png(figure, path)
    return path


def _draw_data(axes: Axes, scene: PaperScene, data: numba.Tables, peak: float, words: str) -> None:
    """Draw the profiles on one axis of total path, whatever the path at which each pulse begins."""
    every = max(1, len(data.samples) // 400)
    path_m = np.arange(20.0, 66.0, 0.1)
    levels = [_level_at(data, pulse, path_m) for pulse in range(0, len(data.samples), every)]
    along = scene.geometry.radar_tx[:, 0]
    extent = (along[0], along[-1], path_m[0] / 2, path_m[-1] / 2)
    shades = amplitude_db(np.array(levels).T / peak)
    axes.imshow(shades, extent=extent, origin="lower", aspect="auto", cmap="viridis", vmin=-RANGE_DB, vmax=0)
    axes.set(xlabel="Position along the track, m", ylabel="Half of the total path, m")
    axes.set_title(f"Range-compressed data: {words}", fontsize=10)


def _level_at(data: numba.Tables, pulse: int, path_m: Floats) -> Floats:
    cell = np.rint((path_m - data.start_m[pulse]) / data.step_m).astype(int)
    inside = (cell >= 0) & (cell < data.samples.shape[1])
    level = np.abs(data.samples[pulse, np.clip(cell, 0, data.samples.shape[1] - 1)])
    return np.asarray(np.where(inside, level, 0.0), np.float64)


def _draw_image(axes: Axes, image: Complexes, peak: float, words: str) -> AxesImage:
    extent = (_CROSS_M[0], _CROSS_M[-1], _GROUND_M[0], _GROUND_M[-1])
    shades = amplitude_db(np.asarray(np.abs(image.T) / peak, np.float64))
    picture = axes.imshow(shades, extent=extent, origin="lower", aspect="auto", cmap="viridis", vmin=-RANGE_DB, vmax=0)
    axes.set(xlabel="Cross-range, m", ylabel="Ground range, m")
    axes.set_title(f"Image: {words}", fontsize=10)
    return picture
