"""The campaign's one grid: `auto` settled once, so that every image of every flight lies on it."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.contracts import canonical_json
from apertura.image.extent import auto_bounds, auto_spacing, utm_crs
from apertura.image.grid import SceneGrid
from apertura.settings import Scene
from apertura.store import open_stage, write_json

PATH = Path("results/scene.json")


def scene(campaign: Campaign) -> Path:
    """Write results/scene.json: the grid that config/config.yaml asks for, with every `auto` settled and why."""
    asked = campaign.settings.scene
    if asked.crs == "auto" or asked.bounds_m == "auto" or asked.spacing_m == "auto":
        grid, chosen = settle(asked, *_first_flight(campaign))
    else:
        grid = SceneGrid.from_bounds(asked.crs, asked.bounds_m, spacing_m=asked.spacing_m, height_m=asked.height_m)
        chosen = {}
    path = campaign.root / PATH
    write_json(path, {"grid": asdict(grid), "chosen": chosen})
    return path


def settle(
    asked: Scene,
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    frequency_hz: NDArray[np.float64],
    path_limit_m: float,
) -> tuple[SceneGrid, dict[str, str]]:
    """Return the grid that is asked for, every `auto` settled from a flight's phase centres, and why.

    Parameters
    ----------
    asked
        Section `scene` of the config.
    tx, rx
        (pulse, 3) float64 phase centres, metres, ECEF or the local frame.
    frequency_hz
        (subcarrier,) float64.
    path_limit_m
        Longest total path inside the cyclic prefix, metres.
    """
    chosen: dict[str, str] = {}
    crs, bounds, spacing = asked.crs, asked.bounds_m, asked.spacing_m
    if crs == "auto":
        crs = utm_crs(np.median(np.concatenate([tx, rx]), axis=0))
        chosen["crs"] = "UTM zone of the first image flight"
    if bounds == "auto":
        bounds = auto_bounds(tx, rx, crs=crs, height_m=asked.height_m, path_limit_m=path_limit_m)
        chosen["bounds_m"] = "ground that the first image flight sees well (docs/theory.md, eq. 8)"
    if spacing == "auto":
        spacing = auto_spacing(tx, rx, frequency_hz, crs=crs, bounds_m=bounds, height_m=asked.height_m)
        chosen["spacing_m"] = "a third of the finest resolution cell (docs/theory.md, eq. 8)"
    whole = bounds if asked.bounds_m != "auto" and asked.spacing_m != "auto" else _whole(bounds, spacing)
    return SceneGrid.from_bounds(crs, whole, spacing_m=spacing, height_m=asked.height_m), chosen


def scene_grid(campaign: Campaign) -> SceneGrid:
    """Return the grid of results/scene.json."""
    found = json.loads((campaign.root / PATH).read_text(encoding="utf-8"))["grid"]
    return SceneGrid(**{**found, "shape": tuple(found["shape"]), "first": tuple(found["first"])})


def grid_spec(grid: SceneGrid) -> str:
    """Return the grid as one line for provenance."""
    return canonical_json(asdict(grid))


def _first_flight(
    campaign: Campaign,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
    flight = campaign.image_flights[0]
    echoes = [open_stage(campaign.stage("echo", flight.name, pair), "echo") for pair in flight.pairs]
    tx, rx = (np.concatenate([echo[name].values for echo in echoes]) for name in ("tx_position", "rx_position"))
    frequency = echoes[0].frequency.values
    return tx, rx, frequency, float(min(echo.path_limit.min() for echo in echoes))


def _whole(bounds: tuple[float, float, float, float], spacing: float) -> tuple[float, float, float, float]:
    xmin, ymin, xmax, ymax = bounds
    columns, rows = (int(np.ceil(extent / spacing - 1e-9)) for extent in (xmax - xmin, ymax - ymin))
    return (xmin, ymax - rows * spacing, xmin + columns * spacing, ymax)
