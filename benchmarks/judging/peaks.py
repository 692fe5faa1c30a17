"""Where the targets of truth.json stand in an image, how bright, and how that differs from the right campaign's."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.core.quality.point_targets import find_peak
from apertura.core.scene.grid import SceneGrid

REACH_M = 1.5
"""How far from its place a target is looked for, where no other stands nearer than twice that."""

WRONG_SHIFT_M, WRONG_LOSS_DB = 0.15, 1.0


@dataclass(frozen=True)
class Peaks:
    """Peaks of the targets in one image.

    Attributes
    ----------
    place_m
        (target, 2) float64, map coordinates; NaN where a target is outside the image.
    level_db
        (target,) float64.
    """

    place_m: NDArray[np.float64]
    level_db: NDArray[np.float64]


@dataclass(frozen=True)
class Harm:
    """What a mistake did to an image: worst and median over the targets, losses in dB, shifts in metres."""

    loss_db: float
    shift_m: float
    median_loss_db: float
    median_shift_m: float

    @property
    def wrong(self) -> bool:
        """Whether the image misleads: a target is off its place, or weak, or not in the image."""
        return not (self.shift_m <= WRONG_SHIFT_M and self.loss_db <= WRONG_LOSS_DB)


def true_places(root: Path) -> NDArray[np.float64]:
    """Return (target, 2) map coordinates (m) of a campaign's truth.json."""
    targets = json.loads((root / "truth.json").read_text(encoding="utf-8"))["targets"]
    return np.array([(target["x"], target["y"]) for target in targets], np.float64).reshape(-1, 2)


def find_targets(image: NDArray[np.complex64], grid: SceneGrid, places_m: NDArray[np.float64]) -> Peaks:
    """Return the brightest point near each target, nearer to it than to any other.

    Parameters
    ----------
    image
        (y, x) complex64.
    grid
        Of the image.
    places_m
        (target, 2) float64, map coordinates of the targets.
    """
    found, levels = np.full(places_m.shape, np.nan), np.full(len(places_m), np.nan)
    magnitude = np.abs(np.nan_to_num(image))
    apart = np.linalg.norm(places_m[:, None] - places_m[None], axis=2) + np.diag(np.full(len(places_m), np.inf))
    reaches = np.minimum(REACH_M, 0.45 * apart.min(axis=1, initial=np.inf)) / grid.spacing_m
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


def harm(spoilt: Peaks, right: Peaks) -> Harm:
    """Return how targets of a spoilt image differ from those of the right one; infinite where one is lost."""
    known = np.isfinite(right.level_db)
    loss, shift = right.level_db - spoilt.level_db, np.linalg.norm(spoilt.place_m - right.place_m, axis=1)
    loss, shift = (np.nan_to_num(values[known], nan=np.inf, posinf=np.inf) for values in (loss, shift))
    return Harm(float(loss.max()), float(shift.max()), float(np.median(loss)), float(np.median(shift)))
