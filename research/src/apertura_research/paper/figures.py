"""The paper's data figures: simulated scenes and experiments."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from apertura.common.arrays import Complexes, Floats
from apertura.core.backprojection.engines import numba
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.imaging.backproject import backproject
from apertura.core.quality.measures import coherence_factor
from apertura.core.quality.point_targets import BandLimitedPatch, find_peak
from apertura.core.scene.grid import SceneGrid
from apertura.tools.chart.pareto import save_png
from apertura_research.paper.experiments import (
    BISTATIC,
    MONOSTATIC,
    PRINTED,
    Experiment,
    open_experiment,
    profiles_at,
    terms_at,
)
from apertura_research.paper.fusion import Images, open_images
from apertura_research.paper.losses import ERRORS, history_of
from apertura_research.paper_scene import UNDISTURBED, PaperScene, receive_pair
from apertura_research.point_response import amplitude_db, find_peaks, range_tables, undisturbed_tables

SHOWN = ("no_errors", "sfo", "cfo", "carrier_phase", "timing", "localization")
"""Figures of data and image: without error, and for each of `ERRORS` at all sizes of its loss table."""

RANGE_DB = 50.0
PULSES = 600
"""Smallest number of pulses: fewer cause grating lobes along the track."""

_GRID = SceneGrid.from_bounds("local", (-7.0, 2.0, 7.0, 28.0), spacing_m=0.025)
_CORNERS_M = np.array([[x, y, 0.0] for x in (-7.0, 7.0) for y in (2.0, 28.0)])
_PATH_M = np.arange(20.0, 66.0, 0.1)
_COLUMNS = 500


def draw_simulated(name: str, path: Path, *, seed: int = 1) -> Path:
    """Draw data above image at every size of one error of `SHOWN` as PNG, and return its path.

    All panels are in dB relative to the peak of the same scene without error, so that losses are visible.
    """
    error = ERRORS["timing" if name == "no_errors" else name]
    title, either = error.sweep.title.removesuffix(" ±"), error.sweep.title.endswith(" ±")
    sizes = [0.0] if name == "no_errors" else list(error.independent_model_db)
    scene = error.scene(max(error.pulses, PULSES))
    clean, targets = undisturbed_tables(scene), scene.scatterers.position_m
    strongest, peak = float(np.abs(clean.samples).max()), float(find_peaks(clean, targets)[1].max())
    figure = Figure(figsize=(2 + 3.6 * len(sizes), 8), layout="constrained")
    panels = figure.subplots(2, len(sizes), squeeze=False, sharex="row", sharey="row")
    for column, size in enumerate(sizes):
        disturbance = error.disturbance(size) if size else UNDISTURBED
        radar, sidelink, _ = receive_pair(scene, disturbance, np.random.default_rng(seed))
        history = history_of(scene, radar, sidelink, divided=error.divided)
        _draw_data(panels[0, column], scene, range_tables(history, _CORNERS_M), strongest)
        picture = _draw_image(panels[1, column], backproject(history, _GRID, certified_pixels=0).values, peak)
        words = f"{'±' * either}{size:g} {error.sweep.unit}: " if size else ""
        for row, what in enumerate(("range-compressed data", "image")):
            letter = chr(ord("a") + row * len(sizes) + column)
            panels[row, column].set_title(f"({letter}) {words}{what}", loc="left", fontsize=10)
    panels[0, 0].set_ylabel("Half of the total path, m")
    panels[1, 0].set_ylabel("Ground range, m")
    figure.suptitle("No errors" if name == "no_errors" else title)
    figure.colorbar(picture, ax=panels, label="dB re peak without error", extend="min", fraction=0.04)
    save_png(figure, path)
    return path


def _draw_data(axes: Axes, scene: PaperScene, data: numba.OversampledTables, peak: float) -> None:
    """Draw the profiles on a common axis of total path, although pulses start at different paths."""
    every = max(1, len(data.samples) // _COLUMNS)
    levels = [_level_at(data, pulse) for pulse in range(0, len(data.samples), every)]
    along = scene.geometry.radar_tx[:, 0]
    extent = (along[0], along[-1], _PATH_M[0] / 2, _PATH_M[-1] / 2)
    shades = amplitude_db(np.array(levels).T / peak)
    axes.imshow(shades, extent=extent, origin="lower", aspect="auto", cmap="viridis", vmin=-RANGE_DB, vmax=0)
    axes.set_xlabel("Position along the track, m")


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
    axes.set_xlabel("Cross-range, m")
    return picture


def draw_scene(path: Path) -> Path:
    """Draw the simulated track and targets in plan view and along the track."""
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
    aside.annotate("track, height 10 m", (0, 10), (8, 4), textcoords="offset points")
    above.set(xlabel="Cross-range, m", ylabel="Ground range, m", ylim=(-2, 28))
    aside.set(xlabel="Ground range, m", ylabel="Height, m", xlim=(-2, 28), ylim=(-2, 13))
    above.set_title("(a) Plan view", loc="left")
    aside.set_title("(b) View along the track", loc="left")
    save_png(figure, path)
    return path


BLUE, ORANGE, GREEN, BLACK = "#0072B2", "#D55E00", "#009E73", "black"
"""Colours of Okabe and Ito, distinguishable with colour vision deficiencies."""

DEPTH_DB = 40.0
SPANS_M = {"lab": (-6.0, 10.0), "static": (0.0, 12.0)}
"""Range axes: half of the total path in excess of the cables, metres."""

TITLES = ("(a) Monostatic", "(b) Bistatic, code only", "(c) Bistatic, divided by the sidelink")


def draw_profile(name: str, folder: Path, path: Path) -> Path:
    """Draw every pulse's range profile of `lab` or `static`: monostatic, bistatic without and with correction."""
    experiment = open_experiment(folder, name)
    slant_m = np.linspace(*SPANS_M[name], 1200)
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    for axes, history, title in zip(panels, _three(experiment), TITLES, strict=True):
        level = np.abs(profiles_at(history, slant_m))
        level_db = 20 * np.log10(level / level.max())
        axes.plot(slant_m, level_db.T, color=BLUE, alpha=0.05, linewidth=0.6, rasterized=True)
        axes.plot(slant_m, level_db[0], color=BLACK, linewidth=0.8, label="first pulse")
        axes.plot([], [], color=BLUE, label=f"all {len(level)} pulses")
        for place, words, colour in zip(experiment.places_m, _names(name), (ORANGE, GREEN), strict=False):
            axes.axvline(_half_path_m(history, place), color=colour, linestyle="--", linewidth=1, label=words)
        axes.set(xlabel="Half of the total path without cables, m", xlim=SPANS_M[name], ylim=(-60, 3))
        axes.set_title(title, loc="left", fontsize=10)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("Magnitude, dB re peak of all pulses")
    panels[0].legend(fontsize=8, loc="lower left")
    save_png(figure, path)
    return path


def draw_phase(name: str, folder: Path, path: Path) -> Path:
    """Draw the phase of every pulse at the targets of `lab` or `static` about its mean, with the coherence factor."""
    experiment = open_experiment(folder, name)
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    panels = figure.subplots(1, 3)
    limits: list[float] = []
    for axes, history, title in zip(panels, _three(experiment, "none"), TITLES, strict=True):
        for place, words, colour, mark in zip(experiment.places_m, _names(name), (ORANGE, GREEN), "o^", strict=False):
            terms = terms_at(history, place)
            phase_deg = np.degrees(np.angle(terms / terms.mean()))
            limits.append(float(np.abs(phase_deg).max()))
            label = f"{words}: Γ = {coherence_factor(terms):.5f}, spread {phase_deg.std():.2f}°"
            axes.plot(phase_deg, mark, color=colour, markersize=2.5, label=label)
        axes.set(xlabel="Pulse")
        axes.set_title(title, loc="left", fontsize=10)
        axes.legend(fontsize=8, loc="upper left")
        axes.grid(alpha=0.3)
    count = len(experiment.places_m)
    panels[1].set(ylim=(-190, 250), yticks=range(-180, 181, 90))
    reach = 1.15 * max(limits[:count] + limits[2 * count :])
    for axes in (panels[0], panels[2]):
        axes.set_ylim(-reach, 1.35 * reach)
    panels[0].set_ylabel("Phase about its mean, degrees")
    save_png(figure, path)
    return path


def _names(name: str) -> list[str]:
    return [target for target, _ in PRINTED[name]]


def _three(experiment: Experiment, window: str = "hann") -> Sequence[PhaseHistory]:
    return experiment.history(MONOSTATIC, window), experiment.uncorrected(window), experiment.history(BISTATIC, window)


def _half_path_m(history: PhaseHistory, place_m: Floats) -> float:
    return float(history.aperture.path(place_m[None]).mean()) / 2


def draw_geometry(folder: Path, path: Path) -> Path:
    """Draw the UAVs' tracks, the imaged segments and the targets: plan view and heights."""
    experiment = open_experiment(folder, "uav")
    enu = experiment.specification.origin.enu
    tracks = {node: enu(experiment.opened.stage("track", "f01", node).position.values) for node in ("uav1", "uav2")}
    middles = {
        label: enu(experiment.history(pair).aperture.middle_m)
        for label, pair in (("mono segment, antennas", MONOSTATIC), ("bistatic segment, midpoint", BISTATIC))
    }
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    above, heights = figure.subplots(1, 2)
    for axes, up in ((above, 1), (heights, 2)):
        for (node, track), style in zip(tracks.items(), ("-", "--"), strict=True):
            axes.plot(track[:, 0], track[:, up], style, color="0.5", linewidth=1, label=f"{node}, logged track")
        for (label, middle), colour in zip(middles.items(), (BLUE, ORANGE), strict=True):
            axes.plot(middle[:, 0], middle[:, up], color=colour, linewidth=4, label=label)
        axes.set_xlabel("Cross-range (east), m")
        axes.grid(alpha=0.3)
    targets = enu(experiment.places_m)
    above.plot(targets[:, 0], targets[:, 1], "D", color=GREEN, label="targets")
    above.set(ylabel="Ground range (north), m", aspect="equal")
    heights.set(ylabel="Height above the scene, m", ylim=(4.0, 5.6))
    above.set_title("(a) Plan view", loc="left")
    heights.set_title("(b) Height", loc="left")
    above.legend(fontsize=8, loc="center left")
    save_png(figure, path)
    return path


PANELS = {
    "mono": "(a) Monostatic",
    "bistatic": "(b) Bistatic",
    "coherent": "(c) Coherent sum",
    "noncoherent": "(d) Noncoherent sum, magnitudes",
}


def draw_images(folder: Path, path: Path) -> Path:
    """Draw the four images of the UAV experiment on a common scale, each relative to its own peak."""
    experiment = open_experiment(folder, "uav")
    images, grid = open_images(experiment), experiment.opened.scene.grid
    middle_m = grid.map_at(*images.pixel[0])
    west, south, east, north = grid.bounds_m
    extent = (west - middle_m[0], east - middle_m[0], south - middle_m[1], north - middle_m[1])
    figure = Figure(figsize=(11, 5), layout="compressed")
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    for axes, (name, title) in zip(panels.flat, PANELS.items(), strict=True):
        shades = 20 * np.log10(np.maximum(np.abs(images.amplitude[name]), 1e-6))
        picture = axes.imshow(shades, extent=extent, cmap="viridis", vmin=-DEPTH_DB, vmax=0, interpolation="nearest")
        axes.set_title(title, loc="left")
    for axes in panels[1]:
        axes.set_xlabel("Cross-range (east), m")
    figure.supylabel("Ground range (north), m", fontsize="medium")
    figure.colorbar(picture, ax=panels, label="dB re peak of each image", extend="min", fraction=0.04)
    save_png(figure, path)
    return path


def draw_cuts(folder: Path, path: Path) -> Path:
    """Draw cuts through the brightest target of all four images, along and across the track."""
    images = open_images(open_experiment(folder, "uav"))
    figure = Figure(figsize=(12, 4.8), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    kinds = (("(a) Cross-range", "East", 1.0, 0.0), ("(b) Ground range", "North", 0.0, 1.0))
    for axes, (title, direction, east, north) in zip(panels, kinds, strict=True):
        for name, colour, style in zip(PANELS, (BLUE, ORANGE, BLACK, GREEN), ("--", "-.", "-", ":"), strict=True):
            along_m, level_db = _cut_db(images, name, east, north)
            axes.plot(along_m, level_db, style, color=colour, label=PANELS[name][4:])
        axes.axhline(-3, color="0.6", linewidth=0.8)
        axes.annotate("−3 dB", (1.28, -2.8), fontsize=8, color="0.4")
        axes.set(xlabel=f"{direction} of the coherent peak, m", xlim=(-1.5, 1.5), ylim=(-DEPTH_DB, 2))
        axes.set_title(title, loc="left")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("Magnitude, dB re peak of each image")
    panels[1].legend(fontsize=9)
    save_png(figure, path)
    return path


def _cut_db(images: Images, name: str, east: float, north: float) -> tuple[Floats, Floats]:
    """Return positions (m) and level (dB) along a line through the peak of the coherent image."""
    row, column = images.brightest("coherent")
    peak = find_peak(images.amplitude["coherent"], row, column)
    along_m = np.linspace(-1.5, 1.5, 601)
    steps = along_m / images.spacing_m
    values = BandLimitedPatch(images.amplitude[name], row, column).at(
        peak.row - north * steps, peak.column + east * steps
    )
    return along_m, 20 * np.log10(np.maximum(np.abs(values), 1e-6))


DRAWN: dict[str, Callable[[Path, Path], Path]] = {
    "lab_profile": partial(draw_profile, "lab"),
    "lab_phase": partial(draw_phase, "lab"),
    "static_profile": partial(draw_profile, "static"),
    "static_phase": partial(draw_phase, "static"),
    "uav_geometry": draw_geometry,
    "uav_images": draw_images,
    "uav_cuts": draw_cuts,
}
"""Figure → function that draws it from a folder of campaigns as a PNG."""
