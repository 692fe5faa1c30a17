"""Positions and levels of the targets of truth.json in an image, and their differences from an error-free campaign."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.core.quality.point_targets import find_peak
from apertura.core.scene.grid import SceneGrid

REACH_M = 1.5
"""Search radius about a target, unless another target is nearer than twice this distance."""

WRONG_SHIFT_M, WRONG_LOSS_DB = 0.15, 1.0


@dataclass(frozen=True)
class Peaks:
    """Peaks of the targets in one image.

    Attributes
    ----------
    place_m
        (target, 2) float64, map coordinates; NaN if a target is outside the image.
    level_db
        (target,) float64, level of the peak.
    """

    place_m: NDArray[np.float64]
    level_db: NDArray[np.float64]


@dataclass(frozen=True)
class Harm:
    """Effect of a mistake on an image: worst and median over the targets, losses in dB, displacements in metres."""

    loss_db: float
    shift_m: float
    median_loss_db: float
    median_shift_m: float

    @property
    def wrong(self) -> bool:
        """True if the image is wrong: a target is displaced, weakened, or missing in the image."""
        return not (self.shift_m <= WRONG_SHIFT_M and self.loss_db <= WRONG_LOSS_DB)


def true_places(root: Path) -> NDArray[np.float64]:
    """Read the map coordinates of the targets from a campaign's truth.json, (target, 2) metres."""
    targets = json.loads((root / "truth.json").read_text(encoding="utf-8"))["targets"]
    return np.array([(target["x"], target["y"]) for target in targets], np.float64).reshape(-1, 2)


def find_targets(image: NDArray[np.complex64], grid: SceneGrid, places_m: NDArray[np.float64]) -> Peaks:
    """Find the brightest point near each target that is closer to this target than to any other.

    Parameters
    ----------
    image
        (y, x) complex64.
    grid
        Grid of the image.
    places_m
        (target, 2) float64, map coordinates of the targets.
    """
    found, levels = np.full(places_m.shape, np.nan), np.full(len(places_m), np.nan)
    magnitude = np.abs(np.nan_to_num(image))
    distance_m = np.linalg.norm(places_m[:, None] - places_m[None], axis=2) + np.diag(np.full(len(places_m), np.inf))
    reaches = np.minimum(REACH_M, 0.45 * distance_m.min(axis=1, initial=np.inf)) / grid.spacing_m
    rows, columns = np.indices(image.shape, sparse=True)
    for number, ((x, y), reach) in enumerate(zip(places_m, reaches, strict=True)):
        row, column = map(float, grid.pixel_of(x, y))
        near = (rows - row) ** 2 + (columns - column) ** 2 <= reach**2
        inside = -0.5 <= row <= image.shape[0] - 0.5 and -0.5 <= column <= image.shape[1] - 0.5
        if inside and magnitude[near].any():
            best = np.unravel_index(int(np.where(near, magnitude, 0).argmax()), image.shape)
            peak = find_peak(image, *map(int, best))
            found[number] = np.array(grid.map_at(peak.row, peak.column), np.float64)
            levels[number] = 20 * np.log10(abs(peak.value))
    return Peaks(found, levels)


def harm(degraded: Peaks, right: Peaks) -> Harm:
    """Compare the targets of a degraded image with those of the error-free image; infinite for missing targets."""
    known = np.isfinite(right.level_db)
    loss, shift = right.level_db - degraded.level_db, np.linalg.norm(degraded.place_m - right.place_m, axis=1)
    loss, shift = (np.nan_to_num(values[known], nan=np.inf, posinf=np.inf) for values in (loss, shift))
    return Harm(float(loss.max()), float(shift.max()), float(np.median(loss)), float(np.median(shift)))
