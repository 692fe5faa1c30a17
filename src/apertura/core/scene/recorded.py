"""Shares of the summed weights of a pixel that its recorded echoes contribute."""

from dataclasses import dataclass, field

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.contracts import Window
from apertura.core.antenna.beam import Beams
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import balls
from apertura.core.scene.terrain import Terrain

_PULSES = 512  # largest number of pulses sampled
_CELL_PX = 8  # side, pixels, of the cells that are tested as a whole first
_PIXELS = 4096  # pixels evaluated together


@dataclass(frozen=True, eq=False)
class RecordedShares:
    """Shares of Σ|w| and Σw² of recorded echoes, evaluated pixel by pixel.

    At the end of a recording the sums change within a few pixels, faster than the lattice of `Looks` resolves; the sums
    by antennas and sector alone, which the lattice resolves, are multiplied by these shares.

    Attributes
    ----------
    grid, terrain, aperture, beams
        As of `apertura.core.scene.looks.Looks`.

    Notes
    -----
    Source: docs/theory/layers.md, eq. 5.
    """

    grid: SceneGrid
    terrain: Terrain
    aperture: Aperture
    beams: Beams | None
    _last: dict[tuple[int, ...], tuple[Floats, Floats]] = field(default_factory=dict)

    def at(self, window: Window) -> tuple[Floats, Floats] | None:
        """Return Σ|w|g/Σ|w| and Σ(wg)²/Σw² at the pixels of a window, (row, column) each; None without a gate."""
        if self.beams is None or self.beams.gate is None:
            return None
        key = (window[0].start, window[0].stop, window[1].start, window[1].stop)
        shares = self._last.get(key) or self._shares(window)
        self._last.clear()  # only the last window is kept; other threads may replace it
        self._last[key] = shares
        return shares

    def _shares(self, window: Window) -> tuple[Floats, Floats]:
        pulses = self.aperture.sample(_PULSES)
        aperture, beams, part = self.aperture[pulses], (self.beams or Beams())[pulses], self.grid[window]
        gate, applied = beams.gate, beams.on_profiles
        shares = np.ones((2, *part.shape))
        if gate is None:
            return shares[0], shares[1]
        # Cells of which no pulse records a pixel, and cells of which every pulse records all pixels.
        cells = list(part.tiles(_CELL_PX))
        middle_m, radius_m = balls(part, self.terrain, cells)
        path_m, limit_m = aperture.path(middle_m), gate.limit_m[:, None]
        is_dark = np.asarray((path_m - 2 * radius_m >= limit_m).all(axis=0))
        is_cut = np.asarray((path_m + 2 * radius_m > limit_m - gate.edge_m).any(axis=0)) & ~is_dark
        undecided = np.zeros(part.shape, bool)
        for number, cell in enumerate(cells):
            shares[:, *cell], undecided[cell] = not is_dark[number], is_cut[number]
        rows, columns = np.nonzero(undecided)
        points = self.terrain.positions_at(part, rows, columns)
        for first in range(0, len(rows), _PIXELS):
            at = slice(first, first + _PIXELS)
            recorded = gate.weight(aperture, points[at])
            weight = np.ones(recorded.shape) if applied is None else np.abs(applied.weight(aperture, points[at]))
            for share, order in zip(shares, (1, 2), strict=True):
                total = (weight**order).sum(axis=0)
                gated = ((weight * recorded) ** order).sum(axis=0)
                share[rows[at], columns[at]] = gated / np.where(total > 0, total, np.inf)
        return shares[0], shares[1]
