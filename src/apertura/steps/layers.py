"""Rule `layers`: incidence, bistatic angle, and the mask of shadow and layover, as GeoTIFFs on the campaign's grid.

One layer stands for the campaign: that of the first image flight. Its pairs share the transmitter, whose incidence it
is; the bistatic angle is the largest of the pairs'; the mask marks what any pair does not see plainly, because their
sum does not either.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rasterio import Affine

from apertura.campaign import Campaign
from apertura.contracts import Window
from apertura.export import export_modules, write_exports
from apertura.geometry.geodesy import local_crs
from apertura.provenance import Provenance
from apertura.scene.grid import LOCAL, SceneGrid
from apertura.scene.visibility import (
    Relief,
    antennas_over,
    bistatic_angle_deg,
    incidence_deg,
    surface_normals,
    visibility,
)
from apertura.steps.scene import grid_spec, scene_grid, scene_inputs
from apertura.steps.terrain import Heights, open_heights
from apertura.store import open_stage

LOOKS = 17
"""Pulses, evenly spread over the aperture, from which shadow is decided."""

_TILE_PX = 256


def layers(campaign: Campaign, *, threads: int = 1) -> list[Path]:
    """Write the products of results/layers: incidence, bistatic angle and mask; return their paths."""
    grid, heights, flight = scene_grid(campaign), open_heights(campaign), campaign.image_flights[0]
    echoes = {pair: open_stage(campaign.stage("echo", flight.name, pair), "echo") for pair in flight.pairs}
    rasters = _rasters(grid, heights, [_track(echo) for echo in echoes.values()], threads=threads)
    origin = Provenance.of(
        [__name__, *export_modules("layers")],
        {**echoes, **dict(zip(["terrain"], heights.parents, strict=False))},
        settings={"grid": grid_spec(grid)},
        inputs=scene_inputs(campaign),
    )
    return write_exports(
        "layers",
        campaign.results / "layers",
        rasters,
        titles={name: f"{campaign.settings.campaign} · flight {flight.name} · {name}" for name in rasters},
        tags=origin.tags(),
        transform=Affine(*grid.transform),
        crs=local_crs(campaign.settings.campaign) if grid.crs == LOCAL else grid.crs,
    )


@dataclass(frozen=True)
class Track:
    """Phase centres of a pair: at mid-aperture (3,), and at some looks (look, 3), metres."""

    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    looks: tuple[NDArray[np.float64], NDArray[np.float64]]


def _track(echo: xr.Dataset) -> Track:
    tx, rx = echo.tx_position.values, echo.rx_position.values
    some = np.unique(np.linspace(0, len(tx) - 1, LOOKS).round().astype(int))
    return Track(tx[len(tx) // 2], rx[len(rx) // 2], (tx[some], rx[some]))


@dataclass(frozen=True)
class Layer:
    """A raster whose blocks are computed when they are read: tiles of them, by some threads.

    Attributes
    ----------
    grid
        Its pixels.
    dtype
        Of the values.
    of
        Window of the grid → values (row, column).
    threads
        Tiles computed at once.
    """

    grid: SceneGrid
    dtype: type[np.generic]
    of: Callable[[Window], NDArray[Any]]
    threads: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.grid.shape

    def __getitem__(self, block: Window) -> NDArray[Any]:
        """Return the values of a block of rows and columns."""
        part = self.grid[block]
        values = np.empty(part.shape, self.dtype)

        def work(tile: Window) -> None:
            rows, columns = (slice(at.start + by, at.stop + by) for at, by in zip(tile, part.first, strict=True))
            values[tile] = self.of((rows, columns))

        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(work, part.tiles(_TILE_PX)))
        return values


def _rasters(grid: SceneGrid, heights: Heights, tracks: Sequence[Track], *, threads: int) -> dict[str, Layer]:
    relief = None if heights.of is None else Relief.of(grid, heights.of)
    looks = [tuple(antennas_over(grid, leg) for leg in track.looks) for track in tracks]

    def incidence(window: Window) -> NDArray[np.float64]:
        return incidence_deg(*_surface(grid, heights, window), tracks[0].tx)

    def bistatic_angle(window: Window) -> NDArray[np.float64]:
        position = grid[window].positions(None if heights.of is None else heights.of(window))
        return np.asarray(np.max([bistatic_angle_deg(position, track.tx, track.rx) for track in tracks], axis=0))

    def mask(window: Window) -> NDArray[np.uint8]:
        if relief is None:
            return np.zeros(grid[window].shape, np.uint8)
        return np.asarray(np.bitwise_or.reduce([visibility(relief, tx, rx, window) for tx, rx in looks]))

    return {
        "incidence": Layer(grid, np.float32, incidence, threads),
        "bistatic_angle": Layer(grid, np.float32, bistatic_angle, threads),
        "mask": Layer(grid, np.uint8, mask, threads),
    }


def _surface(grid: SceneGrid, heights: Heights, window: Window) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions and upward normals of a window; its neighbours count, so that tiles leave no seams."""
    around = [
        np.arange(max(0, part.start - 1), max(2, min(size, part.stop + 1)))
        for part, size in zip(window, grid.shape, strict=True)
    ]
    rows, columns = around
    wider = replace(grid, first=(grid.first[0] + rows[0], grid.first[1] + columns[0]), shape=(rows.size, columns.size))
    height = None
    if heights.of is not None:  # a grid of one row or column is continued level
        known = [slice(axis[0], min(axis[-1] + 1, size)) for axis, size in zip(around, grid.shape, strict=True)]
        found = heights.of((known[0], known[1]))
        lacking = [(0, axis.size - size) for axis, size in zip(around, found.shape, strict=True)]
        height = np.pad(found, lacking, mode="edge")
    position = wider.positions(height)
    inner = tuple(slice(part.start - axis[0], part.stop - axis[0]) for part, axis in zip(window, around, strict=True))
    return position[inner], surface_normals(position)[inner]
