"""Loss of targets with `integration: auto` relative to `all`: `python benchmarks/integration.py [--count 200]`.

Random passes, short and long, squinted, curved, next to the scene, mono- and bistatic, with pixels from much finer to
much coarser than the resolution of the aperture. The brightest pixel of each target is compared in both images, each
normalised to a target to which every pulse contributes.
"""

import argparse
from dataclasses import replace

import numpy as np

from apertura import PhaseHistory, SceneGrid, backproject
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.job import decide_integration
from apertura.core.scene.terrain import FlatGround
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers

FREQUENCY = 1.2e9 + 1e6 * np.arange(96)
SIDE, TARGETS, PULSES = 40, 4, 150


def draw_pass(generator: np.random.Generator) -> tuple[Aperture, SceneGrid, np.ndarray]:
    """Draw a pass, a grid and targets on the terrain."""
    spacing_m = float(np.exp(generator.uniform(np.log(0.05), np.log(1.5))))
    size_m = SIDE * spacing_m
    range_m = max(generator.uniform(15, 60), 0.7 * size_m)
    length_m, height_m = float(np.exp(generator.uniform(np.log(2), np.log(60)))), generator.uniform(8, 30)
    along = np.linspace(-0.5, 0.5, PULSES)
    track = np.stack([length_m * along, length_m * generator.uniform(-0.3, 0.3) * along**2, 0 * along + height_m], -1)
    track[:, 0] += generator.uniform(-1, 1) * range_m  # squint of at most 45°
    angle = generator.uniform(-0.4, 0.4)
    track[:, :2] = track[:, :2] @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    baseline = generator.uniform(-4, 4, 3) * [1, 1, 0.3] if generator.random() < 0.5 else np.zeros(3)
    grid = SceneGrid("local", -size_m / 2, range_m + size_m / 2, spacing_m, (SIDE, SIDE))
    spread = (np.stack(np.meshgrid([-0.25, 0.25], [-0.25, 0.25]), -1).reshape(-1, 2)) * size_m
    spread += generator.uniform(-0.5, 0.5, (TARGETS, 2)) * spacing_m
    targets = np.column_stack([spread + [0.0, range_m], np.zeros(TARGETS)])
    return Aperture(track, track + baseline), grid, targets


def brightest(image: np.ndarray, grid: SceneGrid, targets: np.ndarray) -> np.ndarray:
    """Return the largest amplitude within a pixel and a half of each target."""
    column = (targets[:, 0] - grid.west_m) / grid.spacing_m - 0.5
    row = (grid.north_m - targets[:, 1]) / grid.spacing_m - 0.5
    around = [
        image[max(0, round(r) - 1) : round(r) + 2, max(0, round(c) - 1) : round(c) + 2]
        for r, c in zip(row, column, strict=True)
    ]
    return np.array([np.abs(one).max() for one in around])


def main(count: int) -> None:
    """Print the losses."""
    losses, is_covered, empty = list[np.ndarray](), list[np.ndarray](), 0
    for seed in range(count):
        aperture, grid, targets = draw_pass(np.random.default_rng(seed))
        echo = transfer(Scatterers(targets, np.ones(TARGETS)), aperture, FREQUENCY, spreading=False)
        history = PhaseHistory(echo, FREQUENCY, np.full(96, 1 / 96), np.zeros(PULSES), aperture)
        auto, whole = (
            backproject(history, grid, integration=how, certified_pixels=0, engine="native") for how in ("auto", "all")
        )
        empty += not np.abs(auto.values).all()
        sector = decide_integration(aperture, float(FREQUENCY.mean()), grid, FlatGround(0.0)).sector
        span = (
            0 * targets[:, 0] if sector is None else np.ptp(replace(sector, ends=None).place(aperture, targets), axis=0)
        )
        is_covered.append(span <= 2 * (sector.inner if sector else 1.0))
        with np.errstate(divide="ignore"):
            losses.append(20 * np.log10(brightest(auto.values, grid, targets) / brightest(whole.values, grid, targets)))
    loss = np.concatenate(losses)
    parts = ", ".join(f"{part} %: {np.percentile(loss, part):+.2f}" for part in (0, 1, 5, 25, 50, 75, 95, 100))
    print(f"{count} passes, {loss.size} targets, level with auto relative to all, dB, percentiles: {parts}")
    weaker = [(one < -1).any() for one in losses]
    print(
        f"{(loss < -1).sum()} targets more than 1 dB weaker, in {sum(weaker)} passes; {empty} images with empty pixels"
    )
    covered = np.concatenate(is_covered)
    print(f"{covered.sum()} targets with a span within the sector of their pixels: worst {loss[covered].min():+.2f} dB")
    for seed in np.argsort([one.min() for one in losses])[:8]:
        aperture, grid, targets = draw_pass(np.random.default_rng(seed))
        print(
            seed,
            np.round(losses[seed], 1),
            f"spacing {grid.spacing_m:.2f} m, track {np.ptp(aperture.tx_m[:, 0]):.1f} m",
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    main(parser.parse_args().count)
