"""Rule `coverage`: coverage of all flights and pairs of a campaign, as a PNG map and as GeoJSON."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio import Affine

from apertura.campaign.config import is_monostatic
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, record_files
from apertura.common.atomic import replacement
from apertura.common.provenance import Provenance, canonical_json
from apertura.core.geometry.geodesy import LOCAL, frame_from_map, geodetic_from_ecef, map_from_frame
from apertura.core.imaging.range_profiles import aperture_of
from apertura.core.scene.grid import SceneGrid
from apertura.formats.export import COVERAGE
from apertura.formats.export.coverage import Covered, feature_collection, write_coverage
from apertura.stages.agreement import averaged, opened_layer
from apertura.stages.scene import OpenScene, settled_scene
from apertura.stages.tags import tags_of
from apertura.workflow.lineage import result_of

_DOTS = 480  # maximum number of averaged pixels along the longer side of the scene
_VERTICES = 400  # number of vertices of a track


def coverage(campaign: Campaign) -> Sequence[Path]:
    """Write results/coverage.png and results/coverage.geojson; return their paths."""
    lineage = result_of(campaign, "coverage").begin(campaign.root)
    scene = settled_scene(campaign)
    covered = [
        _covered(campaign, flight.name, pair, scene.grid) for flight in campaign.image_flights for pair in flight.pairs
    ]
    transform = transform_of(scene.grid, covered[0].looks)
    picture, features = written = [campaign.result(name) for name in COVERAGE]
    tags = tags_of(Provenance.of(lineage.modules, settings=scene.spec, inputs=scene.inputs), lineage)
    title = f"{campaign.settings.campaign} · coverage"
    local = scene.grid.crs == LOCAL
    write_coverage(picture, covered, transform, crs_name=crs_name(scene.grid), title=title, tags=tags, local=local)
    collection = feature_collection(covered, transform, place_of(scene), height_m=scene.level.height_m)
    with replacement(features) as temporary:
        temporary.write_text(canonical_json(collection) + "\n", encoding="utf-8")
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written


def _covered(campaign: Campaign, flight: str, pair: str, grid: SceneGrid) -> Covered:
    aperture = aperture_of(open_stage(campaign.stage("echo", flight, pair), "echo"))
    vertices = np.unique(np.linspace(0, len(aperture) - 1, _VERTICES).round().astype(int))
    positions_m = dict(zip(("transmitter", "receiver"), aperture[vertices].legs, strict=True))
    if is_monostatic(pair):
        del positions_m["receiver"]  # the same node: one track
    tracks_m = {antenna: map_from_frame(grid.crs, track) for antenna, track in positions_m.items()}
    return Covered(flight, pair, tracks_m, few_looks(campaign, flight, pair))


def few_looks(campaign: Campaign, flight: str, pair: str) -> NDArray[np.float32]:
    """Return the looks of a pair, averaged to a coarse grid, from the overviews of its file.

    Raises
    ------
    CampaignError
        If the file has changed since step `layers` wrote it.
    """
    with opened_layer(campaign, flight, pair, "looks.tif") as raster:
        return averaged(raster, _DOTS)


def transform_of(grid: SceneGrid, looks: NDArray[np.float32]) -> Affine:
    """Return the affine transform from pixels of `few_looks` to map coordinates."""
    step, _, west, _, _, north = grid.transform
    down, right = (size * step / dots for size, dots in zip(grid.shape, looks.shape, strict=True))
    return Affine(right, 0, west, 0, -down, north)


def place_of(scene: OpenScene) -> Any:
    """Return a function from map coordinates to longitude, latitude and height; None in a local frame."""
    if scene.grid.crs == LOCAL:
        return None

    def place(at_m: NDArray[np.float64]) -> NDArray[np.float64]:
        latitude, longitude, height_m = geodetic_from_ecef(frame_from_map(scene.grid.crs, *at_m.T)).T
        return np.stack([longitude, latitude, height_m], axis=-1)

    return place


def crs_name(grid: SceneGrid) -> str:
    """Return the name of a grid's CRS for the labels of plots."""
    from pyproj import CRS

    crs = CRS.from_user_input(grid.crs_wkt)
    return crs.name + (" (local axes, not georeferenced)" if crs.is_engineering else "")
