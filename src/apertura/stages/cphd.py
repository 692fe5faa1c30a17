"""Rule `cphd`: the calibrated transfer functions of a pair as a CPHD file, on request."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.campaign.store import blocks_of_rows, open_stage, record_files
from apertura.common.errors import CampaignError
from apertura.common.progress import progress
from apertura.common.provenance import Provenance, canonical_json
from apertura.core.echo.demodulate import remove_path
from apertura.core.geometry.geodesy import LOCAL, ecef_from_geodetic, ned_axes
from apertura.core.imaging.range_profiles import wave_speed_of
from apertura.formats.export import PHASE_HISTORY
from apertura.formats.export.cphd import CphdCollection, write_cphd
from apertura.stages.scene import OpenScene, settled_scene
from apertura.stages.tags import tags_of
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of

_NULL_ISLAND = (0.0, 0.0, 0.0)
"""Origin assumed for a local frame that is not georeferenced: latitude, longitude (deg) and height (m)."""


def cphd(campaign: Campaign, flight: str, pair: str) -> Path:
    """Write results/<flight>/<pair>/phase_history.cphd."""
    lineage = result_of(campaign, "cphd", flight, pair).begin(campaign.root)
    echo, scene = PairEcho.opened(campaign, flight, pair).stage, settled_scene(campaign)
    flags = open_stage(campaign.stage("profile", flight, pair), "profile").attrs["flags"]
    echo = echo.assign_attrs(flags=flags)  # the flags of the samples are raised by stage `profile`
    collection = _collection(campaign, flight, echo, scene, tags_of(Provenance.of(lineage.modules, [echo]), lineage))
    path = campaign.result(flight, pair, PHASE_HISTORY)
    if collection.swath_s[1] <= 0:
        raise CampaignError(
            "echoes of the scene centre exceed the cyclic prefix in some pulses",
            where=f"flight {flight}, pair {pair}",
            expected="a reference point whose echoes were recorded",
            remedy="Correct scene.bounds_m.",
        )
    write_cphd(path, collection, _rereferenced(echo, collection))
    record_files(path.with_name("cphd.manifest.json"), [path], lineage)
    return path


def _collection(
    campaign: Campaign, flight: str, echo: xr.Dataset, scene: OpenScene, tags: Mapping[str, str]
) -> CphdCollection:
    """Return the CPHD metadata of an echo; a local frame is placed at latitude and longitude 0.

    At that point, east, north and up are parallel to the axes of ECEF. Coordinates are unchanged, except that the
    height is rounded to 1 nm.
    """
    frame_origin, frame_axes = np.zeros(3), np.eye(3)
    origin = scene.middle_m
    if scene.grid.crs == LOCAL:
        origin = frame_origin = ecef_from_geodetic(*np.array(_NULL_ISLAND))
        frame_axes = _east_north_up(origin)

    def ecef(position: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(frame_origin + position @ frame_axes)

    axes = _east_north_up(origin)
    rows, columns = scene.grid.shape
    corners = [-0.5, -0.5, rows - 0.5, rows - 0.5], [-0.5, columns - 0.5, -0.5, columns - 0.5]
    edges = (ecef(scene.grid.positions_at(*corners, scene.level.height_m)) - origin) @ axes.T
    (west, south), (east, north) = edges[:, :2].min(axis=0), edges[:, :2].max(axis=0)
    return CphdCollection(
        f"{campaign.settings.campaign} {flight} {echo.attrs['pair']}",
        echo.attrs["pair"],
        echo.time.values,
        ecef(echo.tx_position.values),
        ecef(echo.rx_position.values),
        echo.frequency.values,
        echo.path_limit.values,
        ecef(scene.middle_m),
        origin,
        axes,
        (float(west), float(south), float(east), float(north)),
        scene.grid.spacing_m,
        wave_speed_of(echo),
        {**tags, "APERTURA_FLAGS": canonical_json(echo.attrs["flags"]), "APERTURA_FRAME": echo.attrs["frame"]},
    )


def _east_north_up(point_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the east, north and up axes at a point in ECEF, as the rows of (3, 3) float64."""
    north, east, down = ned_axes(point_m).T
    return np.stack([east, north, -down])


def _rereferenced(echo: xr.Dataset, collection: CphdCollection) -> Iterator[NDArray[np.complex64]]:
    """Yield blocks of samples referred to the delay of the reference point instead of the stage's reference delay."""
    extra_delay_s = collection.reference_delay_s - echo.reference_delay.values
    frequency: Any = echo.frequency.values
    with progress("pulses", len(extra_delay_s)) as done:
        for part in blocks_of_rows(echo, "transfer"):
            yield remove_path(echo.transfer[part].values, frequency, delay_s=extra_delay_s[part])
            done(part.stop - part.start)
