"""The campaign's one grid: `auto` settled once, so that every image of every flight lies on it."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.crs import CRS

from apertura.atomic import write_json
from apertura.campaign import Campaign
from apertura.geometry.geodesy import local_crs, projected_from_ecef
from apertura.load.ground import Ground, on_the_ground
from apertura.scene.auto_grid import auto_bounds, auto_spacing, utm_crs
from apertura.scene.grid import LOCAL, SceneGrid
from apertura.scene.terrain import COVER_NODES
from apertura.settings import Scene
from apertura.store import open_stage

PATH = Path("results/scene.json")


def scene(campaign: Campaign) -> Path:
    """Write results/scene.json: the grid that config/config.yaml asks for, with every `auto` settled and why."""
    asked = campaign.settings.scene
    if asked.crs == "auto" or asked.bounds_m == "auto" or asked.spacing_m == "auto":
        grid, chosen = settle(asked, *_first_flight(campaign), root=campaign.root)
    else:
        grid = SceneGrid.from_bounds(asked.crs, asked.bounds_m, spacing_m=asked.spacing_m, height_m=asked.height_m)
        grid, chosen = on_the_ground(grid, Ground.of(asked, campaign.root, crs=asked.crs))
    path = campaign.root / PATH
    inputs = Ground.of(asked, campaign.root, crs=grid.crs).inputs
    write_json(path, {"grid": asdict(grid), "chosen": chosen, "inputs": inputs})
    return path


def settle(
    asked: Scene,
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    frequency_hz: NDArray[np.float64],
    path_limit_m: float,
    *,
    root: Path,
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
    root
        Campaign folder, where the DEM and the grid of the geoid are looked for.
    """
    chosen: dict[str, str] = {}
    crs, bounds, spacing, height_m = asked.crs, asked.bounds_m, asked.spacing_m, asked.height_m
    middle = np.median(np.concatenate([tx, rx]), axis=0)
    if crs == "auto":
        crs = utm_crs(middle)
        chosen["crs"] = "UTM zone of the first image flight"
    ground = Ground.of(asked, root, crs=crs)
    if bounds == "auto":
        east, north = (middle if crs == LOCAL else projected_from_ecef(crs, middle))[:2]
        height_m = ground.height_under(float(east), float(north))
        bounds = auto_bounds(tx, rx, crs=crs, height_m=height_m, path_limit_m=path_limit_m)
        chosen["bounds_m"] = "ground that the first image flight sees well (docs/theory.md, eq. 8)"
    elif spacing == "auto":
        height_m = _level(crs, bounds, ground)
    if spacing == "auto":
        spacing = auto_spacing(tx, rx, frequency_hz, crs=crs, bounds_m=bounds, height_m=height_m)
        chosen["spacing_m"] = "a third of the finest resolution cell (docs/theory.md, eq. 8)"
    whole = bounds if asked.bounds_m != "auto" and asked.spacing_m != "auto" else _whole(bounds, spacing)
    grid, why = on_the_ground(SceneGrid.from_bounds(crs, whole, spacing_m=spacing, height_m=height_m), ground)
    return grid, chosen | why


def scene_grid(campaign: Campaign) -> SceneGrid:
    """Return the grid of results/scene.json."""
    found = json.loads((campaign.root / PATH).read_text(encoding="utf-8"))["grid"]
    return SceneGrid(**{**found, "shape": tuple(found["shape"]), "first": tuple(found["first"])})


def scene_inputs(campaign: Campaign) -> dict[str, str]:
    """Return role → sha256 of the files that the grid's height came from."""
    inputs: dict[str, str] = json.loads((campaign.root / PATH).read_text(encoding="utf-8"))["inputs"]
    return inputs


def grid_spec(grid: SceneGrid) -> dict[str, Any]:
    """Return the grid as JSON values for provenance."""
    return asdict(grid)


def grid_coordinates(grid: SceneGrid, name: str) -> dict[str, Any]:
    """Return the coordinates y, x and spatial_ref of a raster stage; `name` is that of a local frame."""
    crs = CRS.from_user_input(local_crs(name) if grid.crs == LOCAL else grid.crs)
    step, _, west, _, _, north = grid.transform
    reference = {"crs_wkt": crs.to_wkt(), "GeoTransform": f"{west} {step} 0 {north} 0 {-step}"}
    return {"y": grid.y_m, "x": grid.x_m, "spatial_ref": ((), 0, reference)}


def _first_flight(
    campaign: Campaign,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
    flight = campaign.image_flights[0]
    echoes = [open_stage(campaign.stage("echo", flight.name, pair), "echo") for pair in flight.pairs]
    tx, rx = (np.concatenate([echo[name].values for echo in echoes]) for name in ("tx_position", "rx_position"))
    frequency = echoes[0].frequency.values
    return tx, rx, frequency, float(min(echo.path_limit.min() for echo in echoes))


def _level(crs: str, bounds: tuple[float, float, float, float], ground: Ground) -> float:
    """Return the reference height (m) of bounds whose spacing is still open, from pixels just for that."""
    xmin, ymin, xmax, ymax = bounds
    spacing = min(xmax - xmin, ymax - ymin) / COVER_NODES
    return on_the_ground(SceneGrid.from_bounds(crs, bounds, spacing_m=spacing, height_m=0.0), ground)[0].height_m


def _whole(bounds: tuple[float, float, float, float], spacing: float) -> tuple[float, float, float, float]:
    xmin, ymin, xmax, ymax = bounds
    columns, rows = (int(np.ceil(extent / spacing - 1e-9)) for extent in (xmax - xmin, ymax - ymin))
    return (xmin, ymax - rows * spacing, xmin + columns * spacing, ymax)
