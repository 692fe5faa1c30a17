"""One case of a scene before and after: images from logs, refined and true tracks, and the tracks' errors."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from apertura.focus.engines import native
from apertura.geometry.track_correction import TrackCorrection
from apertura.refinement.outcome import Refinement
from apertura.scene.grid import SceneGrid
from apertura.study.png import save_png
from apertura.study.refinement.cases import Case
from apertura.study.refinement.measures import UNCORRECTED
from apertura.study.refinement.outcomes import KINDS, drawn, outcome_of, refined
from apertura.study.refinement.scenes import GRID

SIGMA_CM, SEED = 2.0, 1
DEPTH_DB = 35.0

_MIDDLE_M, _WITHIN_M = (0.0, 15.0), 4.0  # what is looked at closely is the brightest of the scene's middle
_CLOSE_M, _FINE_M = 3.0, 0.015
_AXES = ("east", "north", "up")
_LINES = {"uav1": "#0072b2", "uav2": "#d55e00"}

Floats = NDArray[np.float64]


def draw_case(scene: str, path: Path, *, sigma_cm: float = SIGMA_CM, seed: int = SEED) -> None:
    """Draw one case of a scene of `KINDS` as PNG: the whole scene, a close look, and errors of the tracks over time.

    Parameters
    ----------
    scene
        A row of `KINDS`.
    path
        Of the PNG.
    sigma_cm, seed
        Of the logs' errors.
    """
    one = drawn(scene, sigma_cm, seed)
    found = refined(one)
    figure = Figure(figsize=(12.5, 16), layout="constrained")
    rows = figure.subplots(3, 3, height_ratios=(1.15, 1.0, 0.75))
    _draw_images(figure, rows[:2], one, found)
    for number, (axes, name) in enumerate(zip(rows[2], _AXES, strict=True)):
        _draw_errors(axes, one, found, number)
        axes.set_title(name)
    rows[2][0].set_ylabel("Error of the tracks, cm")
    rows[2][-1].legend(fontsize=8, ncols=2)
    figure.suptitle(_title(one, found), fontsize=12)
    save_png(figure, path)


def _title(one: Case, found: Refinement) -> str:
    row = outcome_of(one, found)
    flags = f"flags: {row.flags.replace(' ', ', ')}" if row.flags else "no flag"
    head = (
        f"{KINDS[row.scene]}, σ = {row.sigma_cm:g} cm per axis: loss at 15 places that were not fitted "
        f"{row.loss_db:.2f} dB from the logs, {row.product_loss_db:.2f} dB as the product leaves it"
    )
    return f"{fill(head, 120)}\n{fill(f'{row.said}: {row.why}; {flags}', 120)}"


def _draw_images(figure: Figure, rows: Sequence[Sequence[Axes]], one: Case, found: Refinement) -> None:
    """Draw the monostatic pair's images, all in dB against the brightest of those from the true tracks."""
    after = "refined tracks" if found.accepted else "refused: the logs stay"
    used = found.correction if found.accepted else UNCORRECTED
    tracks = {"logs": UNCORRECTED, after: used, "true tracks": one.truth}
    whole = {name: image(one, correction, GRID) for name, correction in tracks.items()}
    close = _about(_brightest(whole["true tracks"]))
    near = {name: image(one, correction, close) for name, correction in tracks.items()}
    for axes_row, grid, images in ((rows[0], GRID, whole), (rows[1], close, near)):
        peak = images["true tracks"].max()
        for axes, (name, values) in zip(axes_row, images.items(), strict=True):
            drawn_image = _draw_image(axes, values / peak, grid)
            axes.set_title(f"{name}\npeak {20 * np.log10(values.max() / peak):+.1f} dB", fontsize=10)
        axes_row[0].set_ylabel("North, m")
        figure.colorbar(drawn_image, ax=list(axes_row), label="dB against the true tracks' peak", pad=0.01)


def image(one: Case, correction: TrackCorrection, grid: SceneGrid) -> Floats:
    """Return (row, column), magnitude: the first pair's image from corrected tracks."""
    return np.asarray(np.abs(native.form(native.prepare(one.sightings[0].moved(correction)), grid.positions(0.0))))


def _brightest(magnitude: Floats) -> Floats:
    places = GRID.positions(0.0)
    near = np.linalg.norm(places[..., :2] - _MIDDLE_M, axis=-1) < _WITHIN_M
    return np.asarray(places[near][magnitude[near].argmax()])


def _about(place_m: Floats) -> SceneGrid:
    count = round(_CLOSE_M / _FINE_M)
    west, north = place_m[0] - _CLOSE_M / 2, place_m[1] + _CLOSE_M / 2
    return SceneGrid("local", float(west), float(north), _FINE_M, (count, count))


def _draw_image(axes: Axes, magnitude: Floats, grid: SceneGrid) -> AxesImage:
    west, south, east, north = grid.bounds_m
    levels = 20 * np.log10(np.maximum(magnitude, 1e-6))
    axes.set_xlabel("East, m")
    return axes.imshow(levels, cmap="magma", vmin=-DEPTH_DB, vmax=0, extent=(west, east, south, north))


def _draw_errors(axes: Axes, one: Case, found: Refinement, number: int) -> None:
    """Draw what logs are wrong by along one axis, and what is left of it as images are formed."""
    time_s = one.truth.time_s
    for node, colour in _LINES.items():
        wrong = one.truth.at(node, time_s)[:, number]
        mended = found.correction.at(node, time_s)[:, number] if found.accepted else 0.0
        axes.plot(time_s, 100 * wrong, color=colour, alpha=0.35, linewidth=1, label=f"{node}, log")
        axes.plot(time_s, 100 * (wrong - mended), color=colour, linewidth=1.3, label=f"{node}, left")
    axes.axhline(0, color="0.3", linewidth=0.6)
    axes.set_xlabel("Time, s")
    axes.grid(alpha=0.3)
