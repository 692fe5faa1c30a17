"""The paper's figures of its experiments, from the campaigns that the pipeline processed."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from apertura.common.arrays import Floats
from apertura.core.focus.inputs import PhaseHistory
from apertura.core.quality.measures import coherence_factor
from apertura.core.quality.point_targets import BandLimitedPatch, find_peak
from apertura.views.chart.png import save_png
from apertura_research.study.paper.experiments import (
    BISTATIC,
    MONOSTATIC,
    Experiment,
    open_experiment,
    profiles_at,
    terms_at,
)
from apertura_research.study.paper.fusion import Images, open_images

BLUE, ORANGE, GREEN, BLACK = "#0072B2", "#D55E00", "#009E73", "black"
"""Okabe and Ito's, which the colour-blind tell apart."""

RANGE_DB = 40.0
SPANS_M = {"lab": (2.0, 10.0), "static": (8.0, 22.0)}
"""Halves of total paths that are drawn."""

NAMES = {"lab": ("cylinder 1", "cylinder 2"), "static": ("strong reflector", "weak reflector")}
TITLES = ("(a) Monostatic", "(b) Bistatic, code alone", "(c) Bistatic, divided by the sidelink")


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
        for place, words, colour in zip(experiment.places_m, NAMES[name], (ORANGE, GREEN), strict=True):
            axes.axvline(_half_path_m(history, place), color=colour, linestyle="--", linewidth=1, label=words)
        axes.set(xlabel="Half of the total path, m", xlim=SPANS_M[name], ylim=(-60, 3))
        axes.set_title(title, loc="left", fontsize=10)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("Magnitude, dB re peak of all pulses")
    panels[0].legend(fontsize=8, loc="lower left")
    save_png(figure, path)
    return path


def draw_phase(name: str, folder: Path, path: Path) -> Path:
    """Draw the phase of every pulse at the targets of `lab` or `static`, about its mean, with the coherence factor."""
    experiment = open_experiment(folder, name)
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    panels = figure.subplots(1, 3)
    limits: list[float] = []
    for axes, history, title in zip(panels, _three(experiment), TITLES, strict=True):
        for place, words, colour, mark in zip(experiment.places_m, NAMES[name], (ORANGE, GREEN), "o^", strict=True):
            terms = terms_at(history, place)
            phase_deg = np.degrees(np.angle(terms / terms.mean()))
            limits.append(float(np.abs(phase_deg).max()))
            label = f"{words}: Γ = {coherence_factor(terms):.5f}, spread {phase_deg.std():.2f}°"
            axes.plot(phase_deg, mark, color=colour, markersize=2.5, label=label)
        axes.set(xlabel="Pulse")
        axes.set_title(title, loc="left", fontsize=10)
        axes.legend(fontsize=8, loc="upper left")
        axes.grid(alpha=0.3)
    panels[1].set(ylim=(-190, 250), yticks=range(-180, 181, 90))
    reach = 1.15 * max(limits[:2] + limits[4:])
    for axes in (panels[0], panels[2]):
        axes.set_ylim(-reach, 1.35 * reach)
    panels[0].set_ylabel("Phase about its mean, degrees")
    save_png(figure, path)
    return path


def _three(experiment: Experiment) -> Sequence[PhaseHistory]:
    return experiment.history(MONOSTATIC), experiment.uncorrected(), experiment.history(BISTATIC)


def _half_path_m(history: PhaseHistory, place_m: Floats) -> float:
    return float(history.aperture.path(place_m[None]).mean()) / 2


def draw_geometry(folder: Path, path: Path) -> Path:
    """Draw the UAVs' tracks, the segments that image, and the targets: from above, and the heights."""
    experiment = open_experiment(folder, "uav")
    enu = experiment.specification.origin.enu
    tracks = {node: enu(experiment.opened.stage("track", "f01", node).position.values) for node in ("uav1", "uav2")}
    middles = {
        words: enu(experiment.history(pair).aperture.middle_m)
        for words, pair in (("mono segment, antennas", MONOSTATIC), ("bistatic segment, midpoint", BISTATIC))
    }
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    above, heights = figure.subplots(1, 2)
    for axes, up in ((above, 1), (heights, 2)):
        for (node, track), style in zip(tracks.items(), ("-", "--"), strict=True):
            axes.plot(track[:, 0], track[:, up], style, color="0.5", linewidth=1, label=f"{node}, as logged")
        for (words, middle), colour in zip(middles.items(), (BLUE, ORANGE), strict=True):
            axes.plot(middle[:, 0], middle[:, up], color=colour, linewidth=4, label=words)
        axes.set_xlabel("Cross-range (east), m")
        axes.grid(alpha=0.3)
    targets = enu(experiment.places_m)
    above.plot(targets[:, 0], targets[:, 1], "D", color=GREEN, label="targets")
    above.set(ylabel="Ground range (north), m", aspect="equal")
    heights.set(ylabel="Height above the scene, m", ylim=(4.0, 5.6))
    above.set_title("(a) From above", loc="left")
    heights.set_title("(b) Height", loc="left")
    above.legend(fontsize=8, loc="center left")
    save_png(figure, path)
    return path


PANELS = {
    "mono": "(a) Monostatic",
    "bistatic": "(b) Bistatic",
    "coherent": "(c) Coherent sum",
    "noncoherent": "(d) Noncoherent sum",
}


def draw_images(folder: Path, path: Path) -> Path:
    """Draw the four images of the UAV experiment on one scale, each relative to its own peak."""
    experiment = open_experiment(folder, "uav")
    images, grid = open_images(experiment), experiment.opened.scene.grid
    middle_m = grid.map_at(*images.pixel[0])
    west, south, east, north = grid.bounds_m
    extent = (west - middle_m[0], east - middle_m[0], south - middle_m[1], north - middle_m[1])
    figure = Figure(figsize=(10, 8.6), layout="compressed")
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    for axes, (name, title) in zip(panels.flat, PANELS.items(), strict=True):
        shades = 20 * np.log10(np.maximum(np.abs(images.amplitude[name]), 1e-6))
        picture = axes.imshow(shades, extent=extent, cmap="viridis", vmin=-RANGE_DB, vmax=0, interpolation="nearest")
        axes.set_title(title, loc="left")
    for axes in panels[1]:
        axes.set_xlabel("Cross-range (east), m")
    for axes in panels[:, 0]:
        axes.set_ylabel("Ground range (north), m")
    figure.colorbar(picture, ax=panels, label="dB re peak of each image", extend="min", fraction=0.04)
    save_png(figure, path)
    return path


def draw_cuts(folder: Path, path: Path) -> Path:
    """Draw cuts through the brightest target along and across the track, of all four images."""
    images = open_images(open_experiment(folder, "uav"))
    figure = Figure(figsize=(12, 4.8), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    kinds = (("(a) Cross-range", "East", 1.0, 0.0), ("(b) Ground range", "North", 0.0, 1.0))
    for axes, (title, words, east, north) in zip(panels, kinds, strict=True):
        for name, colour, style in zip(PANELS, (BLUE, ORANGE, BLACK, GREEN), ("--", "-.", "-", ":"), strict=True):
            along_m, level_db = _cut_db(images, name, east, north)
            axes.plot(along_m, level_db, style, color=colour, label=PANELS[name][4:])
        axes.axhline(-3, color="0.6", linewidth=0.8)
        axes.annotate("−3 dB", (1.28, -2.8), fontsize=8, color="0.4")
        axes.set(xlabel=f"{words} of the coherent peak, m", xlim=(-1.5, 1.5), ylim=(-RANGE_DB, 2))
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
"""Figure → what draws it, from a folder of campaigns to a PNG."""
