"""Rule `cube`: every image of the campaign on one grid, and each flight's pairs added up."""

from collections.abc import Mapping, Sequence
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from apertura.campaign import Campaign
from apertura.fusion.sums import coherent_sum, magnitude_sum, noncoherent_sum
from apertura.lineage import result_of
from apertura.load.agreement import agreement_of, agreement_report
from apertura.load.results import assessment_of
from apertura.load.scene import settled_scene
from apertura.scene.grid import SceneGrid
from apertura.steps.stamping import stamped
from apertura.store import create, finish, open_array, open_stage, writing

_SUMS = ("coherent", "noncoherent", "magnitude")


def cube(campaign: Campaign) -> Path:
    """Write results/cube.zarr: image (flight, pair, y, x) and the coherent and non-coherent sums of each flight.

    Tile by tile; a tile that no pulse of a pair sees is not stored and reads as NaN, as in its image.
    """
    flights, lineage = campaign.image_flights, result_of(campaign, "cube").begin(campaign.root, [__name__])
    pairs = sorted({pair for flight in flights for pair in flight.pairs})
    images = {
        f"{flight.name}/{pair}": open_stage(campaign.stage("image", flight.name, pair), "image")
        for flight in flights
        for pair in flight.pairs
    }
    assessed = {flight.name: assessment_of(campaign, flight.name) for flight in flights}
    fusion = {name: one["fusion"] for name, one in assessed.items()}
    references = {name: images[f"{name}/{one['reference']}"] for name, one in assessed.items()}
    side = campaign.settings.processing.tile_px
    windows, folder = list(settled_scene(campaign).grid.tiles(side)), campaign.stage("cube")
    with writing(folder) as wip:
        empty = stamped(
            _empty(images, fusion, pairs), "cube", modules=[__name__], parents=images, settings={"fusion": fusion}
        )
        empty.attrs |= _between_flights(references, settled_scene(campaign).grid)
        chunks = {"image": (1, 1, side, side), **dict.fromkeys(_SUMS, (1, side, side))}
        create(wip, empty, chunks)
        arrays = {name: open_array(wip, name) for name in chunks}
        for place, flight in enumerate(flights):
            present = [images[f"{flight.name}/{pair}"] for pair in flight.pairs]
            peaks = np.array([image.attrs["quality"]["brightest"]["amplitude"] for image in present])
            phases_rad = fusion[flight.name]["phases_rad"]
            added = np.array([pair in phases_rad for pair in flight.pairs])
            turned = np.array([phases_rad[pair] for pair in flight.pairs if pair in phases_rad])
            for window in windows:
                stack = np.stack([image.image[window].values for image in present])
                there = ~np.isnan(stack).all(axis=(1, 2))
                for pair, block in zip(compress(flight.pairs, there), stack[there], strict=True):
                    arrays["image"][place, pairs.index(pair), *window] = block
                if there[added].any():
                    arrays["coherent"][place, *window] = coherent_sum(stack[added], peaks[added], turned)
                if there.any():
                    arrays["noncoherent"][place, *window] = noncoherent_sum(stack, peaks)
                    arrays["magnitude"][place, *window] = magnitude_sum(stack, peaks)
        finish(wip, folder, lineage=lineage)
    return folder


def _between_flights(references: Mapping[str, xr.Dataset], grid: SceneGrid) -> dict[str, Any]:
    """Return how each flight's reference image lies against the first flight's, and its flags."""
    (first, image), *others = references.items()
    between: dict[str, Any] = {}
    flags: dict[str, dict[str, str]] = {}
    for name, other in others:
        found = agreement_of(image, other, grid)
        between[name] = agreement_report(found)
        if found is not None and found.shifted:
            flags[name] = {
                "flights_apart": f"{found.points} bright points of flight {name} lie {100 * found.shift_m:.1f} ± "
                f"{100 * found.shift_std_m:.1f} cm from where flight {first} has them, {100 * found.shift_east_m:+.1f} "
                f"cm east and {100 * found.shift_north_m:+.1f} cm north: a base station, datum or time system differs"
            }
    return {"agreement": {"reference": first, "flights": between}, "flags": flags}


def _empty(images: Mapping[str, xr.Dataset], fusion: Mapping[str, Any], pairs: Sequence[str]) -> xr.Dataset:
    first = next(iter(images.values()))
    shape = first.image.shape
    flights = list(fusion)
    missing, nothing = np.complex64(np.nan + 1j * np.nan), np.float32(np.nan)
    return xr.Dataset(
        {
            "image": (("flight", "pair", "y", "x"), np.broadcast_to(missing, (len(flights), len(pairs), *shape))),
            "coherent": (("flight", "y", "x"), np.broadcast_to(missing, (len(flights), *shape))),
            "noncoherent": (("flight", "y", "x"), np.broadcast_to(nothing, (len(flights), *shape))),
            "magnitude": (("flight", "y", "x"), np.broadcast_to(nothing, (len(flights), *shape))),
        },
        coords={"y": first.y, "x": first.x, "spatial_ref": first.spatial_ref},
        attrs={"flights": flights, "pairs": pairs, "fusion": fusion},
    )
