"""Rule `layers`: incidence, bistatic angle, and the mask of shadow and layover, as GeoTIFFs on the campaign's grid.

One layer stands for the campaign: that of the first image flight. Its pairs share the transmitter, whose incidence it
is; the bistatic angle is the largest of the pairs'; the mask marks what any pair sees in shadow or layover, because
their sum lacks it too.
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
from apertura.lineage import result_of
from apertura.load.scene import OpenScene, open_scene
from apertura.provenance import Provenance
from apertura.scene.grid import SceneGrid
from apertura.scene.terrain import FlatGround, Terrain
from apertura.scene.visibility import Relief, bistatic_angle_deg, incidence_deg, surface_normals, visibility
from apertura.store import open_stage, record_files

MASK_PULSES = 17
"""Pulses, evenly spread over the aperture, from which shadow is decided."""

_TILE_PX = 256


def layers(campaign: Campaign, *, threads: int = 1) -> list[Path]:
    """Write the products of results/layers: incidence, bistatic angle and mask; return their paths."""
    modules = [__name__, *export_modules("layers")]
    lineage = result_of(campaign, "layers").begin(campaign.root, modules)
    scene, flight = open_scene(campaign), campaign.image_flights[0]
    echoes = {pair: open_stage(campaign.stage("echo", flight.name, pair), "echo") for pair in flight.pairs}
    rasters = _rasters(scene, [_track(echo) for echo in echoes.values()], threads=threads)
    origin = Provenance.of(
        modules,
        {**echoes, **dict(zip(["terrain"], scene.parents, strict=False))},
        settings=scene.spec,
        inputs=scene.inputs,
    )
    written = write_exports(
        "layers",
        campaign.result("layers"),
        rasters,
        titles={name: f"{campaign.settings.campaign} · flight {flight.name} · {name}" for name in rasters},
        tags=origin.tags(),
        transform=Affine(*scene.grid.transform),
        crs=scene.grid.crs_wkt,
    )
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written


@dataclass(frozen=True)
class Track:
    """Phase centres of a pair: at mid-aperture (3,), and at the pulses of the mask, 2 × (pulse, 3), metres."""

    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    spread: tuple[NDArray[np.float64], NDArray[np.float64]]


def _track(echo: xr.Dataset) -> Track:
    tx, rx = echo.tx_position.values, echo.rx_position.values
    some = np.unique(np.linspace(0, len(tx) - 1, MASK_PULSES).round().astype(int))
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


def _rasters(scene: OpenScene, tracks: Sequence[Track], *, threads: int) -> dict[str, Layer]:
    grid, terrain = scene.grid, scene.terrain
    mask = _flat_mask(grid) if isinstance(terrain, FlatGround) else _mask(scene, tracks)

    def incidence(window: Window) -> NDArray[np.float64]:
        return incidence_deg(*_surface(grid, terrain, window), tracks[0].tx)

    def bistatic_angle(window: Window) -> NDArray[np.float64]:
        position = terrain.positions(grid[window])
        return np.asarray(np.max([bistatic_angle_deg(position, track.tx, track.rx) for track in tracks], axis=0))

    return {
        "incidence": Layer(grid, np.float32, incidence, threads),
        "bistatic_angle": Layer(grid, np.float32, bistatic_angle, threads),
        "mask": Layer(grid, np.uint8, mask, threads),
    }


def _flat_mask(grid: SceneGrid) -> Callable[[Window], NDArray[np.uint8]]:
    return lambda window: np.zeros(grid[window].shape, np.uint8)


def _mask(scene: OpenScene, tracks: Sequence[Track]) -> Callable[[Window], NDArray[np.uint8]]:
    relief = Relief.of(scene.grid, scene.terrain, scene.level.height_m)
    pairs = [tuple(relief.above(leg) for leg in track.spread) for track in tracks]
    return lambda window: np.asarray(np.bitwise_or.reduce([visibility(relief, tx, rx, window) for tx, rx in pairs]))


def _surface(grid: SceneGrid, terrain: Terrain, window: Window) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions and normals of a window; its neighbours count, so that tiles leave no seams."""
    around = [
        np.arange(max(0, part.start - 1), max(2, min(size, part.stop + 1)))
        for part, size in zip(window, grid.shape, strict=True)
    ]
    rows, columns = around
    wider = replace(grid, first=(grid.first[0] + rows[0], grid.first[1] + columns[0]), shape=(rows.size, columns.size))
    known = terrain.heights(grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])
    lacking = [(0, axis.size - size) for axis, size in zip(around, known.shape, strict=True)]
    position = wider.positions(np.pad(known, lacking, mode="edge"))  # a grid of one row or column is continued level
    inner = tuple(slice(part.start - axis[0], part.stop - axis[0]) for part, axis in zip(window, around, strict=True))
    return position[inner], surface_normals(position)[inner]
