"""Rules `scene` and `terrain`: the campaign's one grid, every `auto` settled once, and the height of each pixel."""

from dataclasses import asdict
from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr

from apertura.common.errors import CampaignError, number_of
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.dem import height_range, steepest_step
from apertura.core.scene.terrain import GridHeights
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.digests import Lineage
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.scene import ConfiguredGround, Flown, OpenScene, settled, settled_scene
from apertura.pipeline.steps.stamping import stamped
from apertura.pipeline.store import finish, open_array, open_stage, resume, save_document, writing

# ---- Rule `scene`: the campaign's one grid, every `auto` decided once -----------------------------------------------


def scene(campaign: Campaign) -> Path:
    """Write results/scene.json: the grid requested in config/config.yaml, the height of its ground, and reasons."""
    lineage = result_of(campaign, "scene").begin(campaign.root)
    grid, ground, chosen = settled(campaign, cache(lambda: _first_flight(campaign)))
    path, height_m = campaign.result("scene.json"), ground.level(grid).height_m
    document = {"grid": asdict(grid), "height_m": height_m, "chosen": chosen, "inputs": ground.inputs}
    save_document(path, document, lineage)
    return path


def _first_flight(campaign: Campaign) -> Flown:
    flight = campaign.image_flights[0]
    echoes = [open_stage(campaign.stage("echo", flight.name, pair), "echo") for pair in flight.pairs]
    return Flown.together(
        [
            Flown(
                Aperture(echo.tx_position.values, echo.rx_position.values),
                echo.frequency.values,
                float(echo.path_limit.min()),
            )
            for echo in echoes
        ]
    )


# ---- Rule `terrain`: height of every pixel from the DEM -------------------------------------------------------------


def terrain(campaign: Campaign) -> Path:
    """Write results/terrain.zarr: ellipsoidal height (y, x) of the grid, tile by tile.

    Raises
    ------
    CampaignError
        If the config names no DEM, or the DEM does not reach over the scene or has voids in it.
    """
    scene, folder = settled_scene(campaign), campaign.stage("terrain")
    grid, ground = scene.grid, ConfiguredGround.of(campaign.settings.scene, campaign.height_files(), crs=scene.grid.crs)
    if ground.dem is None:
        raise CampaignError(
            "no DEM",
            where="config/config.yaml: scene.dem",
            expected="a GeoTIFF of heights",
            remedy="Flat ground needs no terrain; name a DEM and its dem_datum, or leave this step out.",
        )
    lineage = result_of(campaign, "terrain").begin(campaign.root)
    ground.dem.check_cover(grid)
    windows = list(grid.tiles(campaign.settings.processing.tile_px))
    with writing(folder) as wip:
        missing = resume(wip, _empty(scene, ground, lineage), "height", windows)
        print(f"{len(missing)} of {number_of(len(windows), 'tile')} to read from {ground.dem.path.name}", flush=True)
        heights = open_array(wip, "height")
        for window in missing:
            heights[window] = ground.dem.heights(grid[window])
        written = GridHeights(grid, heights)
        lowest_m, highest_m = height_range(written, grid, where=ground.dem.path)
        step = steepest_step(written, grid)
        report = {
            "dem": ground.dem.path.name,
            "geoid": ground.dem.geoid.name if ground.dem.geoid else None,
            "lowest_m": lowest_m,
            "highest_m": highest_m,
            "steepest_step": None if step is None else step._asdict(),
            "datum": campaign.settings.scene.dem_datum,
        }
        finish(wip, folder, lineage=lineage, terrain=report)
    return folder


def _empty(scene: OpenScene, ground: ConfiguredGround, lineage: Lineage) -> xr.Dataset:
    """Return the stamped stage without its heights."""
    return stamped(
        xr.Dataset(
            {"height": (("y", "x"), np.broadcast_to(np.float64(0), scene.grid.shape))},
            coords=scene.grid.coordinates,
            attrs={"frame": scene.grid.frame, "terrain": {}},
        ),
        "terrain",
        modules=lineage.modules,
        settings={**lineage.result.settings, **scene.spec},
        inputs=ground.inputs,
    )
