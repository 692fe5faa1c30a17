"""A layer of a pair, opened as the workflow left it; any raster, read to few places."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling

from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.common.raster import opened_raster
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.store import read_manifest


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
    fewer = max(1.0, max(raster.shape) / dots)
    shape = tuple(max(1, round(size / fewer)) for size in raster.shape)
    values: NDArray[np.float32] = raster.read(1, out_shape=shape, resampling=Resampling.average)
    return values
