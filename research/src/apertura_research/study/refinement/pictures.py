"""One case of a scene before and after: images from logs, refined and true tracks, and the tracks' errors."""

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from apertura.common.arrays import Floats
from apertura.core.focus.engines import native
from apertura.core.geometry.phase_centres import TrackCorrection
from apertura.core.scene.grid import SceneGrid
from apertura.methods.autofocus.inputs import PairRecord, Refinement
from apertura.views.chart.png import save_png
from apertura_research.study.refinement.cases import Case
from apertura_research.study.refinement.flights import NODES
from apertura_research.study.refinement.measures import UNCORRECTED
from apertura_research.study.refinement.outcomes import KINDS, drawn, outcome_of, refined
from apertura_research.study.refinement.scenes import GRID

SIGMA_CM, SEED = 2.0, 1
DEPTH_DB = 35.0

_MIDDLE_M, _WITHIN_M = (0.0, 15.0), 4.0  # what is looked at closely is the brightest of the scene's middle
_CLOSE_M, _FINE_M = 3.0, 0.015
_AXES = ("east", "north", "up")
_PANELS: list[Any] = [
    ["whole 0", "whole 1", "whole 2"],
    ["close 0", "close 1", "close 2"],
    [*_AXES],
    ["path"] * 3,
]
_COLOURS = ("#0072b2", "#d55e00")
_LETTERS = 125  # of a line of the title


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
    used = found.correction if found.accepted else UNCORRECTED
    figure = Figure(figsize=(12.5, 16), layout="constrained")
    panels = figure.subplot_mosaic(_PANELS, height_ratios=(1.2, 1.1, 0.6, 0.6))
    place_m = _draw_images(figure, panels, one, {"logs": UNCORRECTED, _named(found): used, "true tracks": one.truth})
    for number, name in enumerate(_AXES):
        _draw_errors(panels[name], one, used, number)
        panels[name].set_title(name, fontsize=10)
    panels[_AXES[0]].set_ylabel("Error of the tracks, cm")
    _draw_paths(panels["path"], one, used, place_m)
    figure.suptitle(_title(one, found), fontsize=11)
    save_png(figure, path)


def _named(found: Refinement) -> str:
    return "refined tracks" if found.accepted else "refused: the logs stay"


def _title(one: Case, found: Refinement) -> str:
    row = outcome_of(one, found)
    flags = f"flags: {row.flags.replace(' ', ', ')}" if row.flags else "no flag"
    head = (
        f"{KINDS[row.scene]}, σ = {row.sigma_cm:g} cm: loss at probes {row.loss_db:.2f} dB from the logs, "
        f"{row.product_loss_db:.2f} dB as the product leaves it"
    )
    return f"{fill(head, _LETTERS)}\n{fill(f'{row.said}: {row.why}; {flags}', _LETTERS)}"


def _draw_images(
    figure: Figure, panels: Mapping[str, Axes], one: Case, tracks: Mapping[str, TrackCorrection]
) -> Floats:
    """Draw the first pair's images from each of some tracks, the last the true ones, and return what is looked at."""
    true = image(one, one.truth, GRID)
    place_m = _brightest(true)
    for view, grid in (("whole", GRID), ("close", _about(place_m))):
        images = {name: image(one, correction, grid) for name, correction in tracks.items()}
        peak = images["true tracks"].max()
        row = [panels[f"{view} {number}"] for number in range(len(images))]
        for axes, (name, values) in zip(row, images.items(), strict=True):
            shown = _draw_image(axes, values / peak, grid)
            higher = f", peak {20 * np.log10(values.max() / peak):+.1f} dB" if view == "close" else ""
            axes.set_title(name + higher, fontsize=10)  # pixels of the whole scene miss peaks by tenths of a decibel
        row[0].set_ylabel("North, m")
        figure.colorbar(shown, ax=row, label="dB against the true tracks' peak", pad=0.01, shrink=0.8)
    return place_m


def image(one: Case, correction: TrackCorrection, grid: SceneGrid) -> Floats:
    """Return (row, column), magnitude: the first pair's image from corrected tracks."""
    return np.asarray(np.abs(native.form(native.prepare(one.records[0].moved(correction)), grid.positions(0.0))))


def _brightest(magnitude: Floats) -> Floats:
    places = GRID.positions(0.0)
    near = np.linalg.norm(places[..., :2] - _MIDDLE_M, axis=-1) < _WITHIN_M
    return np.asarray(places[near][magnitude[near].argmax()].round(3) + 0.0)


def _about(place_m: Floats) -> SceneGrid:
    count = round(_CLOSE_M / _FINE_M)
    west, north = place_m[0] - _CLOSE_M / 2, place_m[1] + _CLOSE_M / 2
    return SceneGrid("local", float(west), float(north), _FINE_M, (count, count))


def _draw_image(axes: Axes, magnitude: Floats, grid: SceneGrid) -> AxesImage:
    west, south, east, north = grid.bounds_m
    levels = 20 * np.log10(np.maximum(magnitude, 1e-6))
    axes.set_xlabel("East, m")
    return axes.imshow(levels, cmap="magma", vmin=-DEPTH_DB, vmax=0, extent=(west, east, south, north))


def _draw_errors(axes: Axes, one: Case, used: TrackCorrection, number: int) -> None:
    """Draw what logs are wrong by along one axis, and what is left of it as images are formed."""
    time_s = one.truth.time_s
    for node, colour in zip(NODES, _COLOURS, strict=True):
        wrong = one.truth.at(node, time_s)[:, number]
        _draw_pair(axes, time_s, (wrong, wrong - used.at(node, time_s)[:, number]), (node, colour))


def _draw_paths(axes: Axes, one: Case, used: TrackCorrection, place_m: Floats) -> None:
    """Draw by how much paths to a place are wrong, but for their mean: this is what blurs it."""
    for record, colour in zip(one.records, _COLOURS, strict=False):
        true, logged, now = (_path(record, tracks, place_m) for tracks in (one.truth, UNCORRECTED, used))
        errors = tuple(error - error.mean() for error in (true - logged, true - now))
        _draw_pair(axes, record.time_s, errors, (record.pair, colour))
    axes.set_title(
        f"path to the place looked at closely, {place_m[0]:.1f} m east, {place_m[1]:.1f} m north", fontsize=10
    )
    axes.set_ylabel("Error less its mean, cm")


def _path(record: PairRecord, tracks: TrackCorrection, place_m: Floats) -> Floats:
    """Return (pulse,) metres: the path that tracks expect of a place's echo (docs/theory/autofocus.md, eq. 1)."""
    aperture = tracks.aperture(record.profiles.aperture, record.pair, record.time_s)
    longer_m = tracks.longer_m(record.pair, record.time_s, record.sidelink_m)
    return np.asarray(aperture.path(place_m[None])[:, 0] - longer_m)


def _draw_pair(axes: Axes, time_s: Floats, errors: tuple[Floats, Floats], named: tuple[str, str]) -> None:
    (log, left), (name, colour) = errors, named
    axes.plot(time_s, 100 * log, color=colour, alpha=0.35, linewidth=1, label=f"{name}, log")
    axes.plot(time_s, 100 * left, color=colour, linewidth=1.2, label=f"{name}, left")
    axes.axhline(0, color="0.3", linewidth=0.6)
    axes.set_xlabel("Time, s")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, ncols=2)
