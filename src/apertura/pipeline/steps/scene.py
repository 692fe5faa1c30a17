"""Rule `scene`: the campaign's one grid, every `auto` settled once, so that each image of each flight lies on it."""

from dataclasses import asdict
from functools import cache
from pathlib import Path

from apertura.core.geometry.aperture import Aperture
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.scene import Flown, settled
from apertura.pipeline.store import open_stage, save_document


def scene(campaign: Campaign) -> Path:
    """Write results/scene.json: the grid that config/config.yaml asks for and the height of its ground, and why."""
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
