"""Air of a campaign, from its config and the heights of its ground and its antennas: one refractivity for each pair."""

from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.config import PhaseHistoryWaveform
from apertura.campaign.folder import Campaign
from apertura.core.geometry.atmosphere import Atmosphere, FlightAir, SceneAir
from apertura.core.geometry.geodesy import LOCAL, frame_from_map, map_from_frame
from apertura.core.imaging.range_profiles import aperture_of
from apertura.core.scene.auto_grid import utm_crs
from apertura.core.scene.grid import SceneGrid
from apertura.stages.scene import ConfiguredGround

GROUND_STEP_M = 10.0
"""To which the ground's height is rounded here: 0.4 N units, so that a height of focus does not form echoes anew."""

_SIDE = 16  # of a grid on which the mean height of a DEM is taken


def scene_air(campaign: Campaign, position_m: NDArray[np.float64]) -> SceneAir:
    """Return the air of a campaign.

    Parameters
    ----------
    campaign
        With `scene.atmosphere`.
    position_m
        (epoch, 3) float64, metres: where an antenna flew, which says where the scene is that the config leaves open.

    Notes
    -----
    Source: docs/theory/atmosphere.md. The ground is flat at the height of the config, or at the mean of the DEM,
    rounded to `GROUND_STEP_M`.
    """
    stated = campaign.settings.scene
    crs = utm_crs(np.median(position_m, axis=0)) if stated.crs == "auto" else stated.crs
    place = np.median(map_from_frame(crs, position_m)[:, :2], axis=0)
    if stated.bounds_m != "auto":
        xmin, ymin, xmax, ymax = stated.bounds_m
        place = np.array([xmin + xmax, ymin + ymax]) / 2
    air = stated.atmosphere
    ground_m = 0.0 if air == "vacuum" else _ground_m(campaign, crs, (float(place[0]), float(place[1])))
    middle = frame_from_map(crs, place[0], place[1], stated.height_m if air == "vacuum" else ground_m)
    if air == "vacuum":
        atmosphere = Atmosphere.vacuum()
    elif air == "auto":
        atmosphere = Atmosphere.standard(ground_m)
    elif air.refractivity_n is not None:
        atmosphere = Atmosphere.stated(air.refractivity_n, ground_m=ground_m)
    else:
        atmosphere = Atmosphere.of_weather(*air.weather, ground_m=ground_m)
    return SceneAir(atmosphere, middle, LOCAL if crs == LOCAL else "ecef")


def _ground_m(campaign: Campaign, crs: str, place: tuple[float, float]) -> float:
    stated = campaign.settings.scene
    ground = ConfiguredGround.of(stated, campaign.height_files(), crs=crs)
    if ground.dem is None or stated.bounds_m == "auto":
        return GROUND_STEP_M * round(ground.height_at(*place) / GROUND_STEP_M)
    xmin, ymin, xmax, ymax = stated.bounds_m
    heights = ground.dem.heights(SceneGrid(crs, xmin, ymax, max(xmax - xmin, ymax - ymin) / _SIDE, (_SIDE, _SIDE)))
    known = heights[np.isfinite(heights)]
    height_m = float(known.mean()) if known.size else ground.height_at(*place)
    return GROUND_STEP_M * round(height_m / GROUND_STEP_M)


def stated_air(air: FlightAir) -> dict[str, Any]:
    """Return the attributes by which a stage states the air that it is of."""
    return {"wave_speed_m_s": air.wave_speed_m_s, "atmosphere": air.report}


def in_air(campaign: Campaign, history: xr.Dataset) -> xr.Dataset:
    """Return a recorder's phase history with the air that its paths are of, by the config's `waveform.air`.

    Where samples are referred to a point, its delay is that of its distance in the air: none of the samples changes.
    """
    waveform, given = campaign.settings.waveform, history.attrs.get("reference", "delay")
    asked: str = waveform.air if isinstance(waveform, PhaseHistoryWaveform) else "auto"
    if asked == "auto":
        asked = "point" if given == "point" else "measured"
    air = scene_air(campaign, history.tx_position.values)
    if asked == "corrected":
        corrected = replace(Atmosphere.stated(0.0, ground_m=0.0), source="none: taken out of the files, as stated")
        air = replace(air, atmosphere=corrected)
    flown = air.over(aperture_of(history))
    if asked == "point":
        history = history.assign(reference_delay=history.reference_delay * (1 + 1e-6 * flown.refractivity_n))
    return history.assign_attrs(stated_air(flown))
