"""The scene in squares that share it out: what two pairs are compared on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain
from apertura.methods.autofocus.inputs import Sighting
from apertura.methods.autofocus.patches import Patch, bandwidth_hz

Floats = NDArray[np.float64]

MOST_TILES = 64
"""Of a larger scene so many tiles about its middle are taken."""

SAMPLING = 0.85
"""Of Nyquist of the image: products of two images are only summed."""

_CELLS_WIDE = 2.5  # of a tile, in cells of an aperture that is flown while an error lasts
_STEPS = 64


@dataclass(frozen=True, eq=False)
class Tile:
    """A square of the ground.

    Attributes
    ----------
    patch
        Its middle and pixels.
    sides_m
        (2, 3) float64, metres in the frame: from its northern edge to the southern, from the western to the eastern.
    """

    patch: Patch
    sides_m: Floats


def tiles(sightings: Sequence[Sighting], grid: SceneGrid, terrain: Terrain, *, lasting_s: float) -> list[Tile]:
    """Return squares that share out the scene without gaps, their pixels as fine as the sharpest pair needs.

    Parameters
    ----------
    sightings
        All pairs.
    grid, terrain
        The scene.
    lasting_s
        How long an error of the tracks lasts.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 22.

    Examples
    --------
    >>> from apertura.core.focus.inputs import Profiles
    >>> from apertura.core.geometry.aperture import Aperture
    >>> from apertura.core.scene.terrain import FlatGround
    >>> time_s = np.arange(0, 20, 0.1)
    >>> track = np.stack([time_s - 10, np.zeros(200), np.full(200, 10.0)], -1)
    >>> silent = np.zeros((200, 100), np.complex64)
    >>> profiles = Profiles(silent, np.full(200, 20.0), 0.366, 1.4e9, 2.0, Aperture(track, track))
    >>> grid = SceneGrid("local", -9.0, 24.0, 0.5, (36, 36))
    >>> found = tiles([Sighting("a-a", profiles, time_s)], grid, FlatGround(0.0), lasting_s=1.0)
    >>> len(found), found[0].sides_m.round(1).tolist()
    (9, [[0.0, -6.0, 0.0], [6.0, 0.0, 0.0]])
    """
    middle = terrain.positions_at(grid, (grid.shape[0] - 1) / 2, (grid.shape[1] - 1) / 2)
    side_m = tile_side_m(middle, sightings, lasting_s=lasting_s)
    counts = np.maximum(1, np.round(np.array(grid.shape) * grid.spacing_m / side_m)).astype(int)
    share = min(1.0, float(np.sqrt(MOST_TILES / counts.prod())))
    size, taken = np.array(grid.shape) / counts, np.maximum(1, counts * share).astype(int)
    first = (counts - taken) // 2
    corners = [size * (first + place) for place in np.ndindex(*taken)]
    return [_tile(corner, size, sightings, grid, terrain) for corner in corners]


def tile_side_m(place_m: Floats, sightings: Sequence[Sighting], *, lasting_s: float) -> float:
    """Return how wide tiles must be so that errors of the tracks are told apart while they last.

    Parameters
    ----------
    place_m
        (3,) float64, metres in the frame: the middle of the scene.
    sightings
        All pairs.
    lasting_s
        How long an error of the tracks lasts.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 22.
    """
    sides = []
    for one in sightings:
        begun = np.linspace(one.time_s[0], one.time_s[-1] - lasting_s, _STEPS)
        pulses = [np.searchsorted(one.time_s, at).clip(max=len(one.time_s) - 1) for at in (begun, begun + lasting_s)]
        before, after = (one.profiles.aperture[some].path_gradient(place_m) for some in pulses)
        turned = float(np.median(np.linalg.norm(after - before, axis=-1)))
        sides.append(_CELLS_WIDE * SPEED_OF_LIGHT_M_S / (one.profiles.centre_frequency_hz * max(turned, 1e-9)))
    return max(sides)


def _tile(corner: Floats, size: Floats, sightings: Sequence[Sighting], grid: SceneGrid, terrain: Terrain) -> Tile:
    """Return a tile of the grid from its corner and size, both in pixels (row, column)."""
    place, below, right = (
        terrain.positions_at(grid, *(corner + size * np.array(part) - 0.5)) for part in ((0.5, 0.5), (1, 0.5), (0.5, 1))
    )
    sides_m = 2 * np.stack([below - place, right - place])
    cycles = []
    for one in sightings:
        aperture, band_hz = one.profiles.aperture, np.array([-0.5, 0.5]) * bandwidth_hz(one.profiles)
        slope = aperture[aperture.sample(_STEPS)].path_gradient(place) @ sides_m.T
        wavenumbers = (one.profiles.centre_frequency_hz + band_hz) / SPEED_OF_LIGHT_M_S
        cycles.append(np.ptp(np.concatenate([slope * wavenumber for wavenumber in wavenumbers]), axis=0))
    counts = np.ceil(np.max(cycles, axis=0) / SAMPLING).astype(int) + 1
    rows, columns = (
        start + step * (np.arange(count) + 0.5) / count - 0.5
        for start, step, count in zip(corner, size, counts, strict=True)
    )
    pixels = terrain.positions_at(grid, *np.meshgrid(rows, columns, indexing="ij"))
    return Tile(Patch(place, pixels.reshape(-1, 3)), sides_m)
