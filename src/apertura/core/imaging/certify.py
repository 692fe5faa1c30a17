"""Measures of a formed image: certified numerical error, pixel statistics, and response of the brightest target."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.common.flags import Flags
from apertura.core.backprojection.tiles import compute_tiles
from apertura.core.imaging.formation import Formation
from apertura.core.quality.error_check import CONFIDENCE, Brightness, Certificate, random_pixels
from apertura.core.quality.measures import coherence_factor, image_statistics
from apertura.core.quality.point_targets import CUT_REACH_M, cuts_report, find_peak
from apertura.core.scene.grid import SceneGrid

RANDOM_PIXELS, BRIGHT_PIXELS = 160, 112
"""Numbers of pixels recomputed exactly: pixels drawn uniformly over the tiles, and pixels drawn with a probability that
increases with brightness (docs/theory.md, eq. 6a)."""

# largest number of tiles with a random pixel (8192 x 8192 pixels); an exact pixel costs as much as 500 pixels by `tree`
_MOST_TILES = 1024


def certified(
    formation: Formation,
    target: Any,
    *,
    accuracy_db: float,
    threads: int,
    scheduler: str = "threads",
    rewriting: Callable[[Sequence[Window]], None] = lambda _: None,
) -> dict[str, Any]:
    """Certify the error bound of an image, after recomputing tiles that do not meet the requested accuracy.

    Parameters
    ----------
    formation
        Formation of the image.
    target
        The stored image, (y, x) complex64, which is read and written by blocks.
    accuracy_db
        Requested numerical error, dB.
    threads
        Number of tiles computed concurrently.
    scheduler
        Scheduler for recomputed tiles, as for `compute_tiles`.
    rewriting
        Function called with the tiles before these are recomputed, so that after an interruption the resumed run
        recomputes these tiles with the planned setting.
    """
    count = min(max(RANDOM_PIXELS, len(formation.windows)), _MOST_TILES)
    drawn, certificate = random_pixels(formation.windows, count, np.random.default_rng(0)), None
    settings, recomputed, flags = iter(formation.plan.fallbacks), [], Flags()
    while True:
        brightness, setting = Brightness.of(target, formation.windows), next(settings, None)
        # Bright pixels depend on the image, random pixels do not. For the first image, pulses are read once for both.
        bright = brightness.draw(target, formation.windows, BRIGHT_PIXELS, np.random.default_rng(1))
        pixels = bright if certificate else np.concatenate([drawn, bright])
        exact = formation.exact(pixels, threads=threads)
        certificate = certificate or Certificate(formation.windows, drawn, exact[: len(drawn)])
        uncertified, worse = certificate.failing(target, accuracy_db, power=brightness.mean_power)
        if not worse or setting is None:
            error = certificate.error(target, brightness, bright, exact[len(pixels) - len(bright) :])
            error = error.with_error(formation.compression_db)
            if error.bound_db <= accuracy_db or setting is None:
                break
            worse = formation.windows  # each tile meets the accuracy, but the bound of the whole image does not
        line = f"{len(worse)} tiles exceed a numerical error of {accuracy_db} dB and are recomputed with {setting.line}"
        print(line, flush=True)  # noqa: T201
        image = formation.image_by(setting)
        rewriting([*uncertified, *worse])
        for tiles in (uncertified, worse):
            compute_tiles(image, tiles, target, threads=threads, scheduler=scheduler)
        flags = Flags.merged(flags, formation.plan.replaced_by(setting, f"{len(worse) + len(uncertified)} tiles"))
        recomputed.append({"tiles": len(worse) + len(uncertified), "with": f"{setting.line}, every pulse"})
    if error.bound_db > accuracy_db:
        bound = f"numerical error up to {error.bound_db:.1f} dB ({CONFIDENCE:.0%} confidence)"
        flags["accuracy_not_met"] = f"{bound}, {accuracy_db:.1f} dB requested"
    return {
        "numerical_error_db": round(error.bound_db, 2),
        "numerical_error_confidence": CONFIDENCE,
        "numerical_error_estimate_db": round(error.estimate_db, 2),
        "certified_pixels": count + BRIGHT_PIXELS,
        "recomputed": recomputed,
        "flags": flags,
    }


def measures(formation: Formation, target: Any) -> dict[str, Any]:
    """Measure entropy, noise floor and the brightest target of an image."""
    overview, grid = image_statistics(target, formation.windows), formation.grid
    peak = find_peak(target, overview.row, overview.column)
    x, y = map(float, grid.map_at(peak.row, peak.column))
    along = _direction(grid, _flown(formation, peak.row, peak.column), peak.row, peak.column)
    (terms,) = formation.contributions(peak.row, peak.column)
    return {
        "entropy": round(overview.entropy, 6),
        "noise_floor_db": overview.noise_floor_db,
        "brightest": {
            "x_m": round(x, 4),
            "y_m": round(y, 4),
            "amplitude": float(abs(peak.value)),
            "coherence_factor": coherence_factor(terms),
            "cross_range_direction": [round(part / (float(np.hypot(*along)) or 1.0), 6) for part in along],
            **cuts_report(target, peak, cross_range=along, spacing_m=grid.spacing_m, reach_m=CUT_REACH_M),
        },
    }


def _flown(formation: Formation, row: float, column: float) -> NDArray[np.float64]:
    """Return the vector between the transmitter's first and last position from which a pixel is illuminated, metres."""
    blocks = [
        (pulses, parts) for pulses, parts in formation.illuminating_pulses(formation.positions_at([row], [column]))
    ]
    first, last = blocks[0][0].start + blocks[0][1][0][0].start, blocks[-1][0].start + blocks[-1][1][-1][0].stop - 1
    track = formation.profiles.aperture.tx_m
    return np.asarray(track[last] - track[first])


def _direction(grid: SceneGrid, vector_m: NDArray[np.float64], row: float, column: float) -> tuple[float, float]:
    """Return the components (east, north) of a vector in the processing frame along the axes of the grid at a pixel."""
    origin, east, north = grid.positions_at([row, row, row - 1], [column, column + 1, column], 0.0)
    axes = np.stack([east - origin, north - origin])
    steps = axes @ vector_m / np.linalg.norm(axes, axis=1)
    return float(steps[0]), float(steps[1])
