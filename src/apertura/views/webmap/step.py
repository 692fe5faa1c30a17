"""Rule `map`: what a browser shows of every image of the campaign."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from apertura.campaign.config import FUSED
from apertura.campaign.digests import digest_of
from apertura.campaign.folder import Campaign
from apertura.campaign.store import check_listed, read_manifest, record_files
from apertura.common.atomic import write_json
from apertura.common.documents import read_json, undamaged
from apertura.common.errors import CampaignError
from apertura.common.raster import opened_raster
from apertura.core.geometry.geodesy import LOCAL, frame_from_map, geodetic_from_ecef
from apertura.core.scene.grid import SceneGrid
from apertura.formats.export import COVERAGE, MAP, Export, exports_in
from apertura.stages.scene import settled_scene
from apertura.views.image_report import read_report
from apertura.views.webmap.document import Layer, Place, found_places, image_entry, map_document, url_of
from apertura.workflow.lineage import result_of

_FEW = 512  # places along a raster's longer side that its range of values is taken from
_MOST_TARGETS = 1000


def webmap(campaign: Campaign) -> list[Path]:
    """Write results/map/map.json; return its path."""
    lineage = result_of(campaign, "map").begin(campaign.root)
    scene = settled_scene(campaign)
    images, places = [], [*stated_places(campaign)]
    notes: list[str] = []
    places += true_places(campaign, scene.grid.crs, notes)
    # Sums, the last of a flight, are what a map opens on.
    for flight, image in ((name, one) for name, (*pairs, last) in campaign.images.items() for one in (last, *pairs)):
        report = read_report(campaign, flight, image)
        with undamaged(campaign.result(flight, image, "image.json"), expected="a report", remedy="Run export again."):
            images.append(image_entry(flight, image, report, _layers(campaign, flight, image, report)))
            places += found_places(flight, image, report)
    document = map_document(
        campaign.settings.campaign,
        grid={"bounds_m": scene.grid.bounds_m, "spacing_m": scene.grid.spacing_m, "shape": scene.grid.shape},
        crs=crs_of(scene.grid),
        images=images,
        places=places,
        coverage_url=None if scene.grid.crs == LOCAL else _coverage_url(campaign),
        notes=notes,
    )
    path = campaign.result(MAP)
    write_json(path, document)
    record_files(campaign.root / lineage.result.manifest, [path], lineage)
    return [path]


def _layers(campaign: Campaign, flight: str, image: str, report: Mapping[str, Any]) -> list[Layer]:
    """Return what a page can show of an image: real rasters, the linear ones only where no dB show the same."""
    of_pairs = [("export", "pair"), ("layers", "layers"), ("layers", "radiometry")]
    kinds = [("export", "fused")] if image == FUSED else of_pairs
    return [
        layer
        for result, kind in kinds
        for row in exports_in(kind)
        if row.file.endswith(".tif")
        and (kind != "radiometry" or row.source in campaign.coefficients)
        and (layer := _layer(campaign.root / campaign.manifest(result, flight, image), row, report)) is not None
    ]


def _layer(manifest: Path, row: Export, report: Mapping[str, Any]) -> Layer | None:
    path, root = manifest.with_name(row.file), manifest.parents[3]

    def present(file: Path) -> str:
        return digest_of(root, file.relative_to(root).as_posix()) if file.is_file() else ""

    sha256 = check_listed(path, manifest, present=present)
    remedy = f"Delete {manifest} and run the workflow again."
    with opened_raster(path, expected="what the workflow wrote", remedy=remedy) as raster:
        title, unit = str(raster.descriptions[0] or row.file), str(raster.units[0] or "")
        if np.dtype(raster.dtypes[0]).kind == "c" or (unit == "1" and row.source in _SHOWN_IN_DB):
            return None
        if row.source == "mask":
            return Layer(row.file, sha256, "classes", title, "", 0.0, 3.0)
        if unit == "dB" and row.source in _SHOWN_IN_DB:
            peak_db = 20 * math.log10(max(float(report["brightest"]["amplitude"]), 1e-30))
            low, high = peak_db + float(report["noise_floor_db"]), peak_db
            return Layer(row.file, sha256, "image", title, unit, *(round(end, 2) + 0.0 for end in (low, high)))
        fewer = max(1.0, max(raster.shape) / _FEW)
        values = raster.read(1, out_shape=tuple(max(1, round(size / fewer)) for size in raster.shape), masked=True)
    valid = np.ma.masked_invalid(values).compressed()
    low, high = (float(valid.min()), float(valid.max())) if valid.size else (0.0, 1.0)
    return Layer(row.file, sha256, "measure", title, unit, _rounded(low), _rounded(high))


_SHOWN_IN_DB = frozenset({"image", "coherent", "noncoherent", "magnitude"})
"""Sources of products whose power has a file in dB."""


def _rounded(value: float) -> float:
    return float(f"{value:.4g}") + 0.0  # no -0


def crs_of(grid: SceneGrid) -> dict[str, Any]:
    """Return the CRS of a grid as the page needs it, with places by which it proves its own arithmetic."""
    from pyproj import CRS

    known = CRS.from_user_input(grid.crs_wkt)
    if grid.crs == LOCAL:
        return {"name": known.name, "code": None, "local": True, "proj4": None, "control": []}
    west, south, east, north = grid.bounds_m
    x, y = np.array([(x, y) for x in (west, (west + east) / 2, east) for y in (south, (south + north) / 2, north)]).T
    latitude, longitude, _ = geodetic_from_ecef(frame_from_map(grid.crs, x, y, np.zeros(len(x)))).T
    control = np.stack([x, y, longitude, latitude], axis=-1).round(10).tolist()
    return {"name": known.name, "code": grid.crs, "local": False, "proj4": _proj4(known), "control": control}


def _proj4(crs: Any) -> str | None:
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # what the short form loses, the control places show
        return str(crs.to_proj4()) or None


def _coverage_url(campaign: Campaign) -> str | None:
    name = COVERAGE[1]
    digest = read_manifest(campaign.root / campaign.manifest("coverage"))["files"].get(name)
    return url_of(name, digest) if digest else None


def stated_places(campaign: Campaign) -> list[Place]:
    """Return the places that the config knows."""
    scene, calibration = campaign.settings.scene, campaign.settings.calibration
    known = [(point.name, point.position_m) for point in scene.reference_points]
    known += [("reflector", calibration.reflector_m)] if calibration is not None else []
    return [Place(name, "stated", float(x), float(y)) for name, (x, y, _) in known]


def true_places(campaign: Campaign, crs: str, notes: list[str]) -> list[Place]:
    """Return the targets of a simulation, numbered as `apertura score` does; what cannot be read becomes a note."""
    path = campaign.root.named("truth.json", where=campaign.root)
    if not path.is_file():
        return []
    try:
        document = read_json(path, expected="the truth of a simulation", remedy="Delete it.")
        with undamaged(path, expected="the truth of a simulation", remedy="Delete it."):
            targets = [(float(target["x"]), float(target["y"])) for target in document["targets"]]
            if document.get("crs", crs) != crs:
                raise ValueError("its places are in another CRS than the images")
    except CampaignError as error:
        notes.append(f"No targets are listed: {error}".replace(f"{campaign.root}/", ""))
        return []
    if len(targets) > _MOST_TARGETS:
        notes.append(f"Of {len(targets)} targets the first {_MOST_TARGETS} are listed.")
    return [Place(f"target {number}", "truth", x, y) for number, (x, y) in enumerate(targets[:_MOST_TARGETS])]
