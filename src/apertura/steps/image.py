"""Rules of the image wing: a focused image of one pair, with its measured error."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from rasterio.crs import CRS

from apertura.campaign import Campaign
from apertura.echo.compression import window_weights
from apertura.geodesy import local_crs
from apertura.image.engines import ENGINES, reference
from apertura.image.grid import LOCAL, SceneGrid
from apertura.image.history import Profiles, Spectra
from apertura.image.peaks import brightest, ground_position
from apertura.image.quality import coherence_factor, entropy, noise_floor_db, numerical_error, random_pixels
from apertura.image.tiles import Window, form_tiles
from apertura.steps.scene import grid_spec, scene_grid
from apertura.steps.stamping import stamped
from apertura.store import finish, open_stage, tiles_missing, write_json, writing

CERTIFIED_PIXELS = 256


def image(campaign: Campaign, flight: str, pair: str, *, threads: int = 1) -> Path:
    """Write results/<flight>/<pair>/image.zarr and image.json, tile by tile; finished tiles are kept after a kill."""
    folder = campaign.stage("image", flight, pair)
    echo, profile = (open_stage(campaign.stage(stage, flight, pair), stage) for stage in ("echo", "profile"))
    grid, processing = scene_grid(campaign), campaign.settings.processing
    chosen, reason = _engine(processing.engine)
    spectra, profiles = _spectra(echo, processing.window), _profiles(profile)
    empty = stamped(
        _empty(grid, pair, echo.attrs["flags"], campaign.settings.campaign),
        "image",
        module=__name__,
        parents=[echo, profile],
        settings={**campaign.relevant("image"), "grid": grid_spec(grid), "engine": chosen},
    )
    with writing(folder) as wip:
        windows = list(grid.tiles(processing.tile_px))
        missing = tiles_missing(wip, empty, "image", windows)
        print(f"{pair}: engine {chosen}, {len(missing)} of {len(windows)} tiles to form", flush=True)
        engine = ENGINES[chosen]
        prepared = engine.prepare({"echo": spectra, "profile": profiles}[engine.reads])
        target = zarr.open_array(wip / "image", mode="r+")
        form_tiles(_mean(engine.form, prepared, len(echo.pulse)), grid, missing, write=_writer(target), threads=threads)
        formed = np.asarray(target[:], np.complex64)
        quality = {
            "engine": chosen,
            "models": {"engine": reason, **profile.attrs.get("models", {})},
            **_certificate(formed, spectra, grid),
            **_measures(formed, spectra, grid),
            **{name: echo.attrs[name] for name in ("pulses", "sidelink") if name in echo.attrs},
            "flags": echo.attrs["flags"],
        }
        zarr.open_group(wip, mode="r+").attrs["quality"] = quality
        write_json(folder.with_name("image.json"), {"flight": flight, "pair": pair, **quality})
        finish(wip, folder)
    return folder


def _engine(asked: str) -> tuple[str, str]:
    if asked != "auto":
        return asked, "asked for in config/config.yaml"
    return "numba", "cubic interpolation of an 8× table errs below the accuracy asked"


def _spectra(echo: xr.Dataset, window: str) -> Spectra:
    return Spectra(
        echo.transfer.values,
        echo.frequency.values,
        window_weights(window, len(echo.subcarrier)),
        echo.reference_delay.values,
        echo.tx_position.values,
        echo.rx_position.values,
    )


def _profiles(profile: xr.Dataset) -> Profiles:
    return Profiles(
        profile.profile.values,
        profile.start.values,
        profile.attrs["step_m"],
        profile.attrs["centre_frequency_hz"],
        profile.attrs["oversampling"],
        profile.tx_position.values,
        profile.rx_position.values,
    )


def _empty(grid: SceneGrid, pair: str, flags: dict[str, str], name: str) -> xr.Dataset:
    wkt = local_crs(name) if grid.crs == LOCAL else grid.crs
    return xr.Dataset(
        {"image": (("y", "x"), np.broadcast_to(np.complex64(0), grid.shape))},
        coords={"y": grid.y_m, "x": grid.x_m, "spatial_ref": ((), 0, spatial_reference(wkt, grid.transform))},
        attrs={"frame": "local" if grid.crs == LOCAL else "ecef", "pair": pair, "flags": flags, "quality": {}},
    )


def spatial_reference(crs: str, transform: tuple[float, ...]) -> dict[str, Any]:
    """Return the attributes of a CF grid mapping variable that GDAL and xarray read."""
    west, north = transform[2], transform[5]
    return {
        "crs_wkt": CRS.from_user_input(crs).to_wkt(),
        "GeoTransform": f"{west} {transform[0]} 0 {north} 0 {transform[4]}",
    }


def _mean(
    form: Callable[..., NDArray[np.complex64]], prepared: object, pulses: int
) -> Callable[[NDArray[np.float64]], NDArray[np.complex64]]:
    return lambda pixels: np.asarray(form(prepared, pixels) / np.float32(pulses), np.complex64)


def _writer(target: Any) -> Callable[[Window, NDArray[np.complex64]], None]:
    def write(window: Window, values: NDArray[np.complex64]) -> None:
        target[window] = values

    return write


def _certificate(formed: NDArray[np.complex64], spectra: Spectra, grid: SceneGrid) -> dict[str, Any]:
    rows, columns = random_pixels(grid.shape, CERTIFIED_PIXELS, np.random.default_rng(0)).T
    exact = reference.form(spectra, grid.positions_at(rows, columns)) / len(spectra.transfer)
    error = numerical_error(formed[rows, columns], exact, peak=float(np.abs(formed).max()))
    return {
        "numerical_error_db": round(error.rms_db, 2),
        "peak_error_db": round(error.peak_db, 2),
        "certified_pixels": len(rows),
    }


def _measures(formed: NDArray[np.complex64], spectra: Spectra, grid: SceneGrid) -> dict[str, Any]:
    peak = brightest(formed)
    x, y = ground_position(grid, peak)
    terms = reference.terms(spectra, grid.positions_at(np.array([peak.row]), np.array([peak.column])))
    return {
        "entropy": round(entropy(formed), 6),
        "noise_floor_db": round(noise_floor_db(formed), 3),
        "brightest": {
            "x_m": round(x, 4),
            "y_m": round(y, 4),
            "amplitude": float(abs(peak.value)),
            "coherence_factor": coherence_factor(terms[:, 0]),
        },
    }
