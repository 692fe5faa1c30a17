"""Rule of the cube wing: every image of the campaign on one grid, and each flight's pairs added up."""

from pathlib import Path

import numpy as np
import xarray as xr

from apertura.campaign import Campaign
from apertura.cube.fusion import coherent_sum, noncoherent_sum
from apertura.steps.stamping import stamped
from apertura.store import open_stage, save_stage


def cube(campaign: Campaign) -> Path:
    """Write results/cube.zarr: image (flight, pair, y, x) and the coherent and non-coherent sums of each flight."""
    flights = campaign.image_flights
    pairs = sorted({pair for flight in flights for pair in flight.pairs})
    images = {
        (flight.name, pair): open_stage(campaign.stage("image", flight.name, pair), "image")
        for flight in flights
        for pair in flight.pairs
    }
    first = next(iter(images.values()))
    shape = (len(flights), len(pairs), *first.image.shape)
    stack = np.full(shape, np.nan + 1j * np.nan, np.complex64)
    for (flight_name, pair), dataset in images.items():
        stack[[flight.name for flight in flights].index(flight_name), pairs.index(pair)] = dataset.image.values
    dataset = xr.Dataset(
        {
            "image": (("flight", "pair", "y", "x"), stack),
            "coherent": (("flight", "y", "x"), np.stack([coherent_sum(images) for images in stack])),
            "noncoherent": (("flight", "y", "x"), np.stack([noncoherent_sum(images) for images in stack])),
        },
        coords={"y": first.y, "x": first.x, "spatial_ref": first.spatial_ref},
        attrs={"flights": [flight.name for flight in flights], "pairs": pairs},
    )
    folder = campaign.stage("cube")
    tile = campaign.settings.processing.tile_px
    save_stage(
        stamped(dataset, "cube", module=__name__, parents=list(images.values())),
        folder,
        chunks={"flight": 1, "pair": 1, "y": tile, "x": tile},
    )
    return folder
