"""What an image says of itself: its measured numerical error, and what its pixels and its brightest target tell."""

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.focus.tiles import compute_tiles
from apertura.imaging.formation import Formation
from apertura.quality.error_check import Certificate, certified_pixels
from apertura.quality.measures import coherence_factor, survey
from apertura.quality.point_targets import cut_through, find_peak
from apertura.scene.grid import SceneGrid

CERTIFIED_PIXELS = 256

CUT_REACH_M = 3.0
"""How far the cuts through the brightest target go to both sides."""


def certified(formation: Formation, target: Any, *, accuracy_db: float, threads: int) -> dict[str, Any]:
    """Return the measured error; form tiles that are worse than asked again with the next better settings first.

    Parameters
    ----------
    formation
        What forms the image.
    target
        The image where it was written: (y, x) complex64, read and written by blocks.
    accuracy_db
        Error asked.
    threads
        Tiles in work at once.
    """
    windows = formation.windows
    pixels = certified_pixels(target, windows, CERTIFIED_PIXELS, np.random.default_rng(0))
    certificate = Certificate(pixels, formation.exact(pixels), CERTIFIED_PIXELS)
    redone: list[dict[str, Any]] = []
    for setting in formation.plan.fallbacks:
        uncertified, worse = certificate.failing(target, windows, accuracy_db)
        if not worse:
            break
        print(f"{len(worse)} tiles are worse than {accuracy_db} dB: again with {setting.line}", flush=True)  # noqa: T201
        image = formation.image_by(setting)
        compute_tiles(image, uncertified, target, threads=threads)
        compute_tiles(image, worse, target, threads=threads)  # last: a run that was killed here does all of it again
        redone.append({"tiles": len(worse) + len(uncertified), "with": f"{setting.line}, every pulse"})
    error = certificate.error(target)
    line = f"numerical error {error.rms_db:.1f} dB, {accuracy_db:.1f} dB asked"
    return {
        "numerical_error_db": round(error.rms_db, 2),
        "numerical_error_std_db": round(error.std_db, 2),
        "peak_error_db": round(error.peak_db, 2),
        "certified_pixels": len(pixels),
        "redone": redone,
        "flags": {"accuracy_missed": line} if error.rms_db > accuracy_db else {},
    }


def measures(formation: Formation, target: Any) -> dict[str, Any]:
    """Return what one pass over the pixels and a close look at the brightest target tell."""
    overview, grid = survey(target, formation.windows), formation.grid
    peak = find_peak(target, overview.row, overview.column)
    x, y = map(float, grid.map_at(peak.row, peak.column))
    track = formation.profiles.aperture.tx_m
    along = _direction(grid, track[-1] - track[0], peak.row, peak.column)
    cuts = {
        name: cut_through(target, peak, direction=way, spacing_m=grid.spacing_m, reach_m=CUT_REACH_M)
        for name, way in (("cross_range", along), ("ground_range", (along[1], -along[0])))
    }
    terms = formation.contributions(peak.row, peak.column)[:, 0]
    return {
        "entropy": round(overview.entropy, 6),
        "noise_floor_db": overview.noise_floor_db,
        "brightest": {
            "x_m": round(x, 4),
            "y_m": round(y, 4),
            "amplitude": float(abs(peak.value)),
            "coherence_factor": coherence_factor(terms[terms != 0]),
            **{
                f"{name}_{measure}": None if np.isnan(value) else round(value, 4)
                for name, cut in cuts.items()
                for measure, value in asdict(cut).items()
            },
        },
    }


def _direction(grid: SceneGrid, vector_m: NDArray[np.float64], row: float, column: float) -> tuple[float, float]:
    """Return how far (east, north) along the grid's axes a vector of the processing frame points at a pixel."""
    here, east, north = grid.positions_at([row, row, row - 1], [column, column + 1, column], 0.0)
    axes = np.stack([east - here, north - here])
    steps = axes @ vector_m / np.linalg.norm(axes, axis=1)
    return float(steps[0]), float(steps[1])
