"""The autofocus study: peak loss against sigma of the track errors, and images before and after refinement."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from apertura.common.arrays import Floats
from apertura.core.backprojection.engines import native
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.scene.grid import SceneGrid
from apertura.methods.autofocus.inputs import PairRecord, Refinement
from apertura.tools.chart.pareto import save_png
from apertura_research.autofocus.cases import GRID, NODES, AutofocusCase
from apertura_research.autofocus.outcomes import (
    ACCEPTED,
    FLAGGED,
    KINDS,
    REFUSED,
    SNR_DB,
    TOO_FEW,
    UNCORRECTED,
    AutofocusRow,
    case_of,
    cases_of,
    outcome_of,
    refine_case,
    run_case,
)
from apertura_research.sweep import Study, panels

_LOGS, _PRODUCT = "#000000", "#0072b2"
_MARKS = {
    ACCEPTED: ("o", "#0072b2", "#0072b2"),
    FLAGGED: ("D", "#0072b2", "#e69f00"),
    REFUSED: ("X", "#d55e00", "#d55e00"),
    TOO_FEW: ("s", "#d55e00", "none"),
}
_LEVELS_DB = (0, 0.1, 0.3, 1, 3, 10)
_LINEAR_DB = 0.3
"""Loss below which the axis is linear: losses may be zero or slightly negative."""

_MARK_SPACING_CM = 0.06
"""Horizontal spacing of the marks of one sigma, so that seeds do not hide each other."""


def draw_losses(_: str, outcomes: Sequence[AutofocusRow], path: Path) -> None:
    """Draw a panel per scene: mean losses of logged and refined tracks over the seeds, and the verdict on each seed."""
    scenes = [scene for scene in KINDS if any(one.scene == scene for one in outcomes)]
    seeds = len({one.seed for one in outcomes})
    title = f"Peak loss at 15 probes, which no refinement uses; both pairs, SNR {SNR_DB:g} dB, mean of {seeds} draws"
    with panels(path, (4 * len(scenes) + 1, 5.6), (1, len(scenes)), title=title, sharey=True) as every:
        for axes, scene in zip(every, scenes, strict=True):
            rows = [one for one in outcomes if one.scene == scene]
            _draw_scene(axes, rows)
            _mark_verdicts(axes, rows)
            axes.set_title(f"{KINDS[scene]}\n{tally(rows)}", fontsize=10)
            axes.set_xlabel("σ of each log per axis, correlated over 1 s, cm")
        _scale(every[0], outcomes)


def _draw_scene(axes: Axes, rows: Sequence[AutofocusRow]) -> None:
    sizes = sorted({one.sigma_cm for one in rows})
    for name, colour, style, label in (
        ("loss_db", _LOGS, "--", "logged tracks"),
        ("product_loss_db", _PRODUCT, "-", "tracks used by the product"),
    ):
        means = [np.mean([getattr(one, name) for one in rows if one.sigma_cm == size]) for size in sizes]
        axes.plot(sizes, means, color=colour, linestyle=style, marker="_", markersize=12, zorder=1, label=label)
    axes.set_xticks(sizes, [f"{size:g}" for size in sizes])
    axes.grid(alpha=0.3)


def _mark_verdicts(axes: Axes, rows: Sequence[AutofocusRow]) -> None:
    """Mark each draw by its verdict; if the refinement was refused, also the loss of the refused estimate."""
    seeds = sorted({row.seed for row in rows})
    offset_cm = {seed: _MARK_SPACING_CM * (number - (len(seeds) - 1) / 2) for number, seed in enumerate(seeds)}
    for verdict, (marker, edge, face) in _MARKS.items():
        marked = [row for row in rows if row.verdict == verdict]
        sigmas_cm = [row.sigma_cm + offset_cm[row.seed] for row in marked]
        losses = [row.product_loss_db for row in marked]
        axes.plot(sigmas_cm, losses, marker, color=edge, markerfacecolor=face, markersize=7, alpha=0.75, label=verdict)
    refused = [row for row in rows if row.verdict == REFUSED]
    axes.plot(
        [row.sigma_cm + offset_cm[row.seed] for row in refused],
        [row.estimate_loss_db for row in refused],
        "x", color="0.45", markersize=6, label="refused estimate",
    )  # fmt: skip


def tally(rows: Sequence[AutofocusRow]) -> str:
    """Count the accepted refinements, and the accepted refinements with a larger loss than the logged tracks.

    Examples
    --------
    >>> tally([AutofocusRow("five", 1.0, seed, 1.2, 0.1, 0.1, ACCEPTED, "", "") for seed in (1, 2)])
    '2 of 2 accepted, 0 of these worse than the logs'
    """
    accepted = [one for one in rows if one.verdict in (ACCEPTED, FLAGGED)]
    worse = [one for one in accepted if one.product_loss_db > one.loss_db]
    return f"{len(accepted)} of {len(rows)} accepted, {len(worse)} of these worse than the logs"


def _scale(axes: Axes, outcomes: Sequence[AutofocusRow]) -> None:
    losses = [loss for one in outcomes for loss in (one.loss_db, one.product_loss_db, one.estimate_loss_db)]
    axes.set_yscale("symlog", linthresh=_LINEAR_DB, linscale=0.6)
    axes.set_yticks(_LEVELS_DB, [f"{level:g}" for level in _LEVELS_DB])
    axes.set_yticks([], minor=True)
    axes.set_ylim(min(-0.05, *losses), 1.2 * max(3.0, *losses))
    axes.set_ylabel("Peak loss, dB (linear below 0.3)")


SIGMA_CM, SEED = 2.0, 1
DEPTH_DB = 35.0

_MIDDLE_M, _WITHIN_M = (0.0, 15.0), 4.0
"""Centre and radius of the area whose brightest point is enlarged."""

_CLOSE_M, _FINE_M = 3.0, 0.015
_AXES = ("east", "north", "up")
_PANELS: list[Any] = [
    ["whole 0", "whole 1", "whole 2"],
    ["close 0", "close 1", "close 2"],
    [*_AXES],
    ["path"] * 3,
]
_COLOURS = ("#0072b2", "#d55e00")
_TITLE_CHARACTERS = 125
"""Characters per line of the title."""


def draw_case(scene: str, path: Path, *, sigma_cm: float = SIGMA_CM, seed: int = SEED) -> None:
    """Draw one case of a scene of `KINDS` as PNG: the whole scene, an enlarged part, and track errors over time.

    Parameters
    ----------
    scene
        Name in `KINDS`.
    path
        Path of the PNG.
    sigma_cm, seed
        Standard deviation and seed of the logs' errors.
    """
    one = case_of(scene, sigma_cm, seed)
    result = refine_case(one)
    used = result.correction if result.accepted else UNCORRECTED
    figure = Figure(figsize=(12.5, 16), layout="constrained")
    panels = figure.subplot_mosaic(_PANELS, height_ratios=(1.2, 1.1, 0.6, 0.6))
    place_m = _draw_images(figure, panels, one, {"logs": UNCORRECTED, _named(result): used, "true tracks": one.truth})
    for number, name in enumerate(_AXES):
        _draw_errors(panels[name], one, used, number)
        panels[name].set_title(name, fontsize=10)
    panels[_AXES[0]].set_ylabel("Track error, cm")
    _draw_paths(panels["path"], one, used, place_m)
    figure.suptitle(_title(one, result), fontsize=11)
    save_png(figure, path)


def _named(result: Refinement) -> str:
    return "refined tracks" if result.accepted else "refused: logged tracks are used"


def _title(one: AutofocusCase, result: Refinement) -> str:
    row = outcome_of(one, result)
    flags = f"flags: {row.flags.replace(' ', ', ')}" if row.flags else "no flags raised"
    head = (
        f"{KINDS[row.scene]}, σ = {row.sigma_cm:g} cm: peak loss at the probes {row.loss_db:.2f} dB with the logged "
        f"tracks, {row.product_loss_db:.2f} dB with the tracks used by the product"
    )
    verdict = f"{row.verdict}: {row.reason}; {flags}"
    return f"{fill(head, _TITLE_CHARACTERS)}\n{fill(verdict, _TITLE_CHARACTERS)}"


def _draw_images(
    figure: Figure, panels: Mapping[str, Axes], one: AutofocusCase, tracks: Mapping[str, TrackCorrection]
) -> Floats:
    """Draw the first pair's image from each set of tracks, the last being true, and return the enlarged point."""
    true = image(one, one.truth, GRID)
    place_m = _brightest(true)
    for view, grid in (("whole", GRID), ("close", _about(place_m))):
        images = {name: image(one, correction, grid) for name, correction in tracks.items()}
        peak = images["true tracks"].max()
        row = [panels[f"{view} {number}"] for number in range(len(images))]
        for axes, (name, values) in zip(row, images.items(), strict=True):
            shown = _draw_image(axes, values / peak, grid)
            # The pixel spacing of the whole scene causes errors of tenths of a decibel in sampled peaks.
            peak_text = f", peak {20 * np.log10(values.max() / peak):+.1f} dB" if view == "close" else ""
            axes.set_title(name + peak_text, fontsize=10)
        row[0].set_ylabel("North, m")
        figure.colorbar(shown, ax=row, label="dB relative to the peak with the true tracks", pad=0.01, shrink=0.8)
    return place_m


def image(one: AutofocusCase, correction: TrackCorrection, grid: SceneGrid) -> Floats:
    """Return the magnitude of the first pair's image from corrected tracks, (row, column)."""
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


def _draw_errors(axes: Axes, one: AutofocusCase, used: TrackCorrection, number: int) -> None:
    """Draw the errors of the logs along one axis, and the residual errors of the tracks used for imaging."""
    time_s = one.truth.time_s
    for node, colour in zip(NODES, _COLOURS, strict=True):
        log_error = one.truth.at(node, time_s)[:, number]
        _draw_pair(axes, time_s, (log_error, log_error - used.at(node, time_s)[:, number]), (node, colour))


def _draw_paths(axes: Axes, one: AutofocusCase, used: TrackCorrection, place_m: Floats) -> None:
    """Draw the errors of paths to a point minus their means: the component that defocuses the point."""
    for record, colour in zip(one.records, _COLOURS, strict=False):
        true, logged, now = (_path(record, tracks, place_m) for tracks in (one.truth, UNCORRECTED, used))
        errors = tuple(error - error.mean() for error in (true - logged, true - now))
        _draw_pair(axes, record.time_s, errors, (record.pair, colour))
    axes.set_title(f"path to the enlarged point at {place_m[0]:.1f} m east, {place_m[1]:.1f} m north", fontsize=10)
    axes.set_ylabel("Path error minus its mean, cm")


def _path(record: PairRecord, tracks: TrackCorrection, place_m: Floats) -> Floats:
    """Return the echo path of a point along given tracks, (pulse,) metres (docs/theory/autofocus.md, eq. 1)."""
    aperture = tracks.aperture(record.profiles.aperture, record.pair, record.time_s)
    longer_m = tracks.longer_m(record.pair, record.time_s, record.sidelink_m)
    return np.asarray(aperture.path(place_m[None])[:, 0] - longer_m)


def _draw_pair(axes: Axes, time_s: Floats, errors: tuple[Floats, Floats], named: tuple[str, str]) -> None:
    (log, residual), (name, colour) = errors, named
    axes.plot(time_s, 100 * log, color=colour, alpha=0.35, linewidth=1, label=f"{name}, log")
    axes.plot(time_s, 100 * residual, color=colour, linewidth=1.2, label=f"{name}, residual")
    axes.axhline(0, color="0.3", linewidth=0.6)
    axes.set_xlabel("Time, s")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, ncols=2)


STUDY = Study(
    row=AutofocusRow,
    charts={"losses": tuple(KINDS)},
    cases=cases_of,
    run=run_case,
    draw=draw_losses,
)
"""A part is a scene; a case is a standard deviation of the logs' errors and a seed."""
