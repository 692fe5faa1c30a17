"""The look on the map page: the image so far of each pair as a GeoTIFF in dB, and the document that names them."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio import Affine

from apertura.campaign.folder import Campaign
from apertura.common.atomic import write_json
from apertura.common.provenance import sha256_file
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.scene.grid import SceneGrid
from apertura.formats.export import MAP
from apertura.formats.export.cog import power, write_cog
from apertura.formats.export.db import DB, decibels
from apertura.tools.look.pair import PairSoFar
from apertura.views.image_report import explained_flags
from apertura.views.webmap.document import Layer, Place, map_document, url_of
from apertura.views.webmap.step import crs_of, stated_places, true_places

_KEPT = 2
"""Pictures of a pair, in turn: a page that has just read the document still finds the one before the last."""


class LiveMap:
    """What the map page shows of a campaign while it flies, in a folder laid out like the results.

    Parameters
    ----------
    campaign
        Whose look it is.
    folder
        Of the look, relative to the results.
    every_s
        Seconds after which a page asks again.
    """

    def __init__(self, campaign: Campaign, folder: str, *, every_s: float) -> None:
        self._campaign, self._folder, self._every_s = campaign, campaign.result(folder), every_s
        self._grid: SceneGrid | None = None
        self._entries: dict[str, dict[str, Any]] = {}
        self._places: dict[str, Place] = {}
        self._shown: Counter[str] = Counter()

    @cached_property
    def _fixed(self) -> dict[str, Any]:
        """What the document says of the campaign whatever comes."""
        if self._grid is None:
            raise ValueError("no image was added")
        campaign, grid, notes = self._campaign, self._grid, list[str]()
        return {
            "grid": {"bounds_m": grid.bounds_m, "spacing_m": grid.spacing_m, "shape": grid.shape},
            "crs": crs_of(grid),
            "places": [*stated_places(campaign), *true_places(campaign, grid.crs, notes)],
            "notes": notes,
        }

    def begin(self) -> None:
        """Remove the document of an earlier look: who asks for the map now waits for the first picture of this one."""
        (self._folder / MAP).unlink(missing_ok=True)

    def add(self, pair: PairSoFar, told: Mapping[str, Any]) -> None:
        """Write the image so far of a pair, of which `told` is known."""
        shown, grid = pair.shown, pair.images[-1].grid
        if shown is None:
            return
        self._grid = grid
        where = f"{pair.flight}/{pair.name}"
        image = on_grid(shown.image, shown.share, grid.shape)
        path = self._folder / where / f"db.{self._shown[where] % _KEPT}.tif"
        self._shown[where] += 1
        path.parent.mkdir(parents=True, exist_ok=True)
        write_cog(path, image, DB, value=lambda block: decibels(power(block)), tags={}, **placed_on(grid))
        level = decibels(power(image[image != 0]))
        high = round(float(np.nanmax(level, initial=-300.0)), 1)
        low = min(round(float(np.nanmedian(level)), 1), high - 1.0) if np.isfinite(level).any() else high - 60.0
        layer = Layer("db.tif", sha256_file(path), "image", "image so far", "dB", low, high)
        self._entries[where] = {
            "flight": pair.flight,
            "image": pair.name,
            "verdict": told["verdict"],
            "why": told["why"],
            "error_db": told["error_db"],
            "flags": explained_flags(told["flags"]),
            "layers": [{**asdict(layer), "url": url_of(f"{where}/{path.name}", layer.sha256)}],
        }
        peak = told["peak"]
        self._places[where] = Place("brightest", "found", float(peak["x_m"]), float(peak["y_m"]), where)

    def drop(self, pair: PairSoFar) -> None:
        """Leave a pair out until it is added again: its image was of what is no longer there."""
        where = f"{pair.flight}/{pair.name}"
        self._entries.pop(where, None)
        self._places.pop(where, None)

    def write(self, *, ended: bool) -> None:
        """Write the document of what was added; nothing before there is an image."""
        if self._grid is None:
            return
        document = map_document(
            self._campaign.settings.campaign,
            **self._fixed | {"places": [*self._fixed["places"], *self._places.values()]},
            images=list(self._entries.values()),
            coverage_url=None,
            again_s=None if ended else self._every_s,
        )
        path = self._folder / MAP
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, document)


def placed_on(grid: SceneGrid) -> dict[str, Any]:
    """Return transform and crs of a grid, as exports take them."""
    return {"transform": Affine(*grid.transform), "crs": grid.crs_wkt if grid.crs == LOCAL else grid.crs}


def on_grid(image: NDArray[np.complex64], side: int, shape: tuple[int, ...]) -> NDArray[np.complex64]:
    """Return an image of pixels `side` times as wide on the grid that they are blocks of; 0 beyond the last block.

    Examples
    --------
    >>> on_grid(np.array([[1, 2]], np.complex64), 2, (2, 5)).real.astype(int).tolist()
    [[1, 1, 2, 2, 0], [1, 1, 2, 2, 0]]
    """
    fine = np.zeros(shape, np.complex64)
    blocks = image.repeat(side, axis=0).repeat(side, axis=1)
    fine[: blocks.shape[0], : blocks.shape[1]] = blocks[: shape[0], : shape[1]]
    return fine
