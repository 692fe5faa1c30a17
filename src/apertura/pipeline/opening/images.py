"""Finished images of a campaign opened again: a layer at few places, and how two of them agree."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.core.quality.agreement import Agreement, agreement
from apertura.core.quality.bright_points import BrightPoint, has_point
from apertura.core.quality.measures import BlockRaster
from apertura.core.scene.grid import SceneGrid
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.store import read_manifest

if TYPE_CHECKING:
    import xarray as xr


# ---- Layers of a pair; rasters read at a few places -----------------------------------------------------------------


@contextmanager
def opened_layer(campaign: Campaign, flight: str, pair: str, file: str) -> Iterator[Any]:
    """Open a GeoTIFF that step `layers` wrote, such as 'mask.tif'.

    Yields
    ------
    rasterio.DatasetReader
        The raster.

    Raises
    ------
    CampaignError
        If it is not there as the step wrote it.
    """
    from apertura.common.raster import opened_raster

    path = campaign.result(flight, pair, file)
    manifest = campaign.root / campaign.manifest("layers", flight, pair)
    remedy = f"Delete {manifest} and run the workflow again."
    if not path.is_file() or read_manifest(manifest)["files"].get(path.name) != sha256_file(path):
        raise CampaignError("not as it was written", path, f"what {manifest.name} describes", remedy)
    with opened_raster(path, expected="what step layers writes", remedy=remedy) as raster:
        yield raster


def averaged(raster: Any, dots: int) -> NDArray[np.float32]:
    """Return a raster averaged to few places, from its overviews.

    Parameters
    ----------
    raster
        Open for reading.
    dots
        Places along the longer side, at most.

    Returns
    -------
    ndarray
        (row, column) float32.
    """
    from rasterio.enums import Resampling

    fewer = max(1.0, max(raster.shape) / dots)
    shape = tuple(max(1, round(size / fewer)) for size in raster.shape)
    values: NDArray[np.float32] = raster.read(1, out_shape=shape, resampling=Resampling.average)
    return values


# ---- Agreement of two images by their bright points -----------------------------------------------------------------


def agreement_of(first: "xr.Dataset", second: "xr.Dataset", grid: SceneGrid) -> Agreement | None:
    """Return how a second stage `image` lies against a first; None where they share no bright point.

    None as well where pixels are wider than a resolution cell: they do not resolve the place of a point.
    """
    if not comparable(first, second, grid):
        return None
    return agreement_by_focus((first.image, second.image), (_focus(first), _focus(second)), grid)


def agreement_by_focus(
    images: tuple[BlockRaster, BlockRaster], focus: tuple[Mapping[str, Any], Mapping[str, Any]], grid: SceneGrid
) -> Agreement | None:
    """Return the agreement of two images on a grid, by `apertura.core.imaging.focus_check.focus_report` of each."""
    return agreement(
        images,
        (_points(focus[0], grid), _points(focus[1], grid)),
        spacing_m=grid.spacing_m,
        cell_m=max(one["cell_m"] for one in focus),
        alone=all(one["maxima"] == 1 for one in focus),
        spectrum=np.mean([one["spectrum_cycles2_m2"] for one in focus], axis=0),
    )


def comparable(first: "xr.Dataset", second: "xr.Dataset", grid: SceneGrid) -> bool:
    """Return whether the pixels of two images are fine enough to compare the places of points."""
    return bool(grid.spacing_m <= min(_focus(image)["cell_m"] for image in (first, second)))


def shows_points_of(first: "xr.Dataset", second: "xr.Dataset", grid: SceneGrid) -> bool:
    """Return whether a second image has a bright pixel where a first has one of its bright points."""
    reach = max(1, round(_focus(first)["cell_m"] / grid.spacing_m))
    points = _points(_focus(first), grid)
    return any(has_point(second.image, round(point.row), round(point.column), reach=reach) for point in points)


def _focus(image: "xr.Dataset") -> dict[str, Any]:
    focus: dict[str, Any] = image.attrs["quality"]["focus"]
    return focus


def agreement_report(found: Agreement | None) -> dict[str, float] | None:
    """Return an agreement as JSON values."""
    return None if found is None else {name: float(f"{value:.4g}") for name, value in asdict(found).items()}


def _points(focus: Mapping[str, Any], grid: SceneGrid) -> list[BrightPoint]:
    points = focus["points"]
    rows, columns = grid.pixel_of([point["x_m"] for point in points], [point["y_m"] for point in points])
    return [
        BrightPoint(
            float(row),
            float(column),
            point["amplitude"],
            point["background"],
            carrier=(-point["carrier_cycles_m"][1] * grid.spacing_m, point["carrier_cycles_m"][0] * grid.spacing_m),
        )
        for row, column, point in zip(rows, columns, points, strict=True)
    ]
