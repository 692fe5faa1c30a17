"""Rule `layers`: incidence, bistatic angle, and the mask of shadow and layover, as GeoTIFFs on the campaign's grid.

One layer stands for the campaign: that of the first image flight. Its pairs share the transmitter, whose incidence it
is; the bistatic angle is the largest of the pairs'; the mask marks what any pair does not see plainly, because their
sum does not either.
"""

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rasterio import Affine

from apertura import __version__
from apertura.campaign import Campaign
from apertura.contracts import Window, canonical_json
from apertura.export import LAYERS
from apertura.geodesy import local_crs
from apertura.image.grid import LOCAL, SceneGrid
from apertura.image.visibility import (
    Relief,
    antennas_over,
    bistatic_angle_deg,
    incidence_deg,
    surface_normals,
    visibility,
)
from apertura.provenance import chained_sha256, code_sha256, merged
from apertura.steps.scene import grid_spec, scene_grid, scene_inputs
from apertura.steps.terrain import Heights, open_heights
from apertura.store import open_stage

LOOKS = 17
"""Pulses, evenly spread over the aperture, from which shadow is decided."""

_TILE_PX = 256


def layers(campaign: Campaign, *, threads: int = 1) -> list[Path]:
    """Write results/layers/{incidence,bistatic_angle,mask}.tif; return their paths."""
    grid, heights, flight = scene_grid(campaign), open_heights(campaign), campaign.image_flights[0]
    echoes = [open_stage(campaign.stage("echo", flight.name, pair), "echo") for pair in flight.pairs]
    rasters = _rasters(grid, heights, [_track(echo) for echo in echoes], threads=threads)
    tags = _tags(grid, [*echoes, *heights.parents], scene_inputs(campaign))
    crs = local_crs(campaign.settings.campaign) if grid.crs == LOCAL else grid.crs
    folder = campaign.results / "layers"
    for name, raster in rasters.items():
        title = f"{campaign.settings.campaign} · flight {flight.name} · {name.removesuffix('.tif')}"
        LAYERS[name](folder / name, raster, transform=Affine(*grid.transform), crs=crs, tags=tags, title=title)
    return [folder / name for name in rasters]


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


def _rasters(grid: SceneGrid, heights: Heights, tracks: Sequence[Track], *, threads: int) -> dict[str, Any]:
    incidence, angle = (np.empty(grid.shape, np.float32) for _ in range(2))
    mask = np.zeros(grid.shape, np.uint8)
    whole = None if heights.of is None else heights.of((slice(0, grid.shape[0]), slice(0, grid.shape[1])))
    relief = None if whole is None else Relief.of(grid, whole)
    looks = [tuple(antennas_over(grid, leg) for leg in track.looks) for track in tracks]

    def look_at(window: Window) -> None:
        position, normal = _surface(grid, whole, window)
        incidence[window] = incidence_deg(position, normal, tracks[0].tx)
        angle[window] = np.max([bistatic_angle_deg(position, track.tx, track.rx) for track in tracks], axis=0)
        if relief is not None:
            mask[window] = np.bitwise_or.reduce([visibility(relief, tx, rx, window) for tx, rx in looks])

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(look_at, grid.tiles(_TILE_PX)))
    return {"incidence.tif": incidence, "bistatic_angle.tif": angle, "mask.tif": mask}


def _surface(
    grid: SceneGrid, whole: NDArray[np.float64] | None, window: Window
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions and upward normals of a window; its neighbours count, so that tiles leave no seams."""
    around = [
        np.arange(max(0, part.start - 1), max(2, min(size, part.stop + 1)))
        for part, size in zip(window, grid.shape, strict=True)
    ]
    row, column = np.meshgrid(*around, indexing="ij")
    last = [size - 1 for size in grid.shape]
    height = None if whole is None else whole[np.minimum(row, last[0]), np.minimum(column, last[1])]
    position = grid.positions_at(row, column, height)
    inner = tuple(slice(part.start - axis[0], part.stop - axis[0]) for part, axis in zip(window, around, strict=True))
    return position[inner], surface_normals(position)[inner]


def _tags(grid: SceneGrid, parents: Sequence[xr.Dataset], inputs: dict[str, str]) -> dict[str, str]:
    runspec: dict[str, Any] = {}
    for parent in parents:
        runspec |= json.loads(parent.attrs["runspec"])
    return {
        "APERTURA_RUNSPEC": canonical_json(runspec | {"grid": grid_spec(grid)}),
        "APERTURA_INPUTS": canonical_json(merged(*(parent.attrs["inputs"] for parent in parents), inputs)),
        "APERTURA_CODE_SHA256": chained_sha256(code_sha256(__name__), [one.attrs["code_sha256"] for one in parents]),
        "APERTURA_VERSION": __version__,
    }
