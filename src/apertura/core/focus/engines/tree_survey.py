"""A few tiles of a job, each seen from a few chunks of its pulses: what a tree is predicted from."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.core.focus.engines.native_prediction import pixel_steps
from apertura.core.focus.engines.tree_inputs import roughness
from apertura.core.focus.engines.tree_sheets import Relief
from apertura.core.focus.engines.tree_surface import Surface, surfaces_of
from apertura.core.focus.engines.tree_track import LEAF, subaperture_sizes
from apertura.core.focus.engines.tree_view import Looks, look
from apertura.core.focus.engines.tree_weights import DIRECTLY, SILENTLY, weights_over
from apertura.core.focus.job import Job

_TILES, _CHUNKS_SEEN = 5, 3  # that are looked at


@dataclass(frozen=True, eq=False)
class Seen:
    """A few tiles of one side, each seen from a few chunks."""

    surfaces: tuple[Surface, ...]
    looks: tuple[tuple[Looks, ...], ...]
    rough: tuple[float, ...]  # mean squared error by pixels off their surface
    sheets_rad: tuple[tuple[float, float], ...]  # band along heights, and phase of what leaves the surface otherwise
    groups: tuple[NDArray[np.int64], ...]  # some pulses of each chunk

    @property
    def phase_rad(self) -> float:
        """RMS over them, of places of a tile against its centre."""
        phases = [look.phase_rad for looks in self.looks for look in looks]
        return float(np.sqrt(np.mean(np.square(phases)))) if phases else 1.0


@lru_cache(maxsize=64)
def seen_of(job: Job, pulses: int, side_px: int, chunk: int) -> Seen:
    """Return some tiles, and how they are seen from some chunks."""
    side = min(side_px, job.tile_px, *job.shape)
    whole = [(slice(0, side), slice(0, side))]
    patches = [np.ascontiguousarray(patch[whole[0]]) for patch in _patches(job, side)]
    surfaces = tuple(surfaces_of(patch, whole)[0] for patch in patches)
    places = np.linspace(0, len(job.aperture) - 1, pulses).astype(int)
    starts = np.arange(0, pulses, chunk)
    starts = starts[np.unique(np.linspace(0, len(starts) - 1, _CHUNKS_SEEN).astype(int))]
    k, b = job.signal.wavenumber_rad_m, np.pi / (job.signal.step_m * job.signal.oversampling)
    chunks = [job.aperture[places[start : start + chunk]] for start in starts]
    looks = tuple(
        tuple(look(part, surface, subaperture_sizes(chunk), wavenumber_rad_m=k, band_rad_m=b) for part in chunks)
        for surface in surfaces
        if np.isfinite(surface.rough_m)
    )
    some = job.aperture[job.aperture.sample(64)]
    groups = [places[start + at : start + at + LEAF] for start in starts for at in (0, chunk // 2 // LEAF * LEAF)]
    rough = tuple(roughness(some, surface, wavenumber_rad_m=k, band_rad_m=b) for surface in surfaces)
    sheets = tuple(
        _sheets(job, surface, patch, wavenumber_rad_m=k, band_rad_m=b)
        for surface, patch in zip(surfaces, patches, strict=True)
    )
    return Seen(surfaces, looks, rough, sheets, tuple(group for group in groups if len(group)))


def _sheets(
    job: Job, surface: Surface, patch: NDArray[np.float64], *, wavenumber_rad_m: float, band_rad_m: float
) -> tuple[float, float]:
    """Return what `Seen` says of the sheets of a tile."""
    if not np.isfinite(surface.rough_m):
        return np.inf, np.inf
    relief = Relief.of(surface, patch)
    band = relief.band_rad(job.aperture, wavenumber_rad_m=wavenumber_rad_m, band_rad_m=band_rad_m)
    return band, wavenumber_rad_m * relief.aside_m


@lru_cache(maxsize=256)
def weighed_directly(job: Job, seen: Seen, nodes_db: int) -> float:
    """Return the part of the groups of pulses that see a tile whose weights no polynomial follows."""
    if job.beams is None:
        return 0.0
    smooth = [surface for surface in seen.surfaces if np.isfinite(surface.rough_m)]
    ways = [
        weights_over(job.beams[group], job.aperture[group], surface, nodes_db)[1]
        for surface in smooth
        for group in seen.groups
    ]
    taken = np.concatenate([*ways, np.empty(0, np.uint8)])
    taken = taken[taken != SILENTLY]
    return float((taken == DIRECTLY).mean()) if len(taken) else 0.0


def _patches(job: Job, side: int) -> list[NDArray[np.float64]]:
    """Return the pixels' places of a few tiles: those of the job, or on planes about some points of its ground."""
    if job.patches_m:
        return list(job.patches_m)
    count = len(job.points_m)
    right, down = (pixel_steps(job.ground_m, axis, job.spacing_m).reshape(-1, 3) for axis in (1, 0))
    at = np.arange(side) - (side - 1) / 2
    return [
        job.points_m[n] + at[:, None, None] * down[n] + at[None, :, None] * right[n]
        for n in np.unique(np.linspace(0, count - 1, _TILES).astype(int))
    ]
