"""Output files of a design: layers as GeoTIFFs on the later campaign's grid, tracks and footprints, campaign config."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rasterio import Affine

from apertura import __version__
from apertura.campaign.config import FLIGHTS
from apertura.common.atomic import made_folder, write_json, write_text
from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError
from apertura.common.provenance import canonical_json
from apertura.core.geometry.geodesy import LOCAL
from apertura.formats.campaign_files import write_config
from apertura.formats.export.cog import Band, write_cog
from apertura.formats.export.coverage import Covered, feature_collection, placed_footprint, write_coverage
from apertura.formats.export.layers import BISTATIC_ANGLE, INCIDENCE, LOOKS, MASK
from apertura.formats.export.style import write_layer_style, write_mask_style
from apertura.formats.tracks.missions import write_kml
from apertura.stages.coverage import crs_name, place_of, transform_of
from apertura.tools.design.expected_images import Design
from apertura.tools.design.flight_plan import FlightPlan
from apertura.tools.design.layers import UNITS
from apertura.tools.design.requirements import Tried, report_of, tried_report

_BANDS = {"incidence": INCIDENCE, "bistatic_angle": BISTATIC_ANGLE, "mask": MASK, "looks": LOOKS}
_DOTS = 480  # maximum number of pixels of the longer side of the scene for footprints
_VERTICES = 400  # approximate number of vertices of a track


def write_design(design: Design, folder: Path, tried: Sequence[Tried] = ()) -> list[Path]:
    """Write layers, tracks, footprints, a map and design.json into a folder; return their paths.

    Parameters
    ----------
    design
        A design on the full-resolution grid.
    folder
        Output folder, created if necessary; files of the same names are replaced.
    tried
        Plans tried by a search; the Pareto-optimal plans are written to design.json.
    """
    folder, grid, written = made_folder(folder), design.opened.scene.grid, list[Path]()
    georeference = {"transform": Affine(*grid.transform), "crs": grid.crs_wkt}
    tags = tags_of(design)
    images = {name: image.layers for name, image in design.images.items()}
    for name, layers in {
        **images,
        **{f"interferometry/{name}": layers for name, layers in design.interferograms.items()},
    }.items():
        for layer, values in layers.items():
            path = folder / name / f"{layer}.tif"
            path.parent.mkdir(parents=True, exist_ok=True)
            unit, meaning = UNITS[layer]
            band = _BANDS.get(layer) or Band("float32", np.nan, unit, meaning, "AVERAGE")
            title = f"{design.opened.campaign.settings.campaign} · {name} · {layer}, planned"
            write_cog(path, values.astype(band.dtype), band, **georeference, tags=tags, title=title)
            style = path.with_suffix(".qml")
            (write_mask_style if layer == "mask" else write_layer_style)(style)
            written += [path, style]
    write_json(folder / "design.json", report_of(design) | ({"plans": tried_report(tried)} if tried else {}))
    return [*written, *_write_tracks(design, folder), folder / "design.json"]


PICTURE_TAGS = {"APERTURA_VERSION": __version__, "APERTURA_PLANNED": "true"}
"""Provenance tags of plots of a design; the tags of rasters also contain the plan."""


def tags_of(design: Design) -> dict[str, str]:
    """Return the provenance tags of a design's rasters."""
    plan = design.opened.plan.model_dump(mode="json", exclude_unset=True)
    return PICTURE_TAGS | {"APERTURA_PLAN": canonical_json(plan)}


def _write_tracks(design: Design, folder: Path) -> list[Path]:
    """Write coverage.png, tracks.geojson and, for a georeferenced scene, tracks.kml."""
    scene, covered = design.opened.scene, list(_covered(design))
    transform = transform_of(scene.grid, covered[0].looks)
    title = f"{design.opened.campaign.settings.campaign} · planned"
    picture, features = folder / "coverage.png", folder / "tracks.geojson"
    name, local = crs_name(scene.grid), scene.grid.crs == LOCAL
    write_coverage(picture, covered, transform, crs_name=name, title=title, tags=PICTURE_TAGS, local=local)
    to_geographic = place_of(scene)
    collection = feature_collection(covered, transform, to_geographic, height_m=scene.level.height_m)
    write_text(features, canonical_json(collection) + "\n")
    if to_geographic is None:
        return [picture, features]

    lines = {
        f"{flight} {node}": np.asarray(to_geographic(course.place_m[:: max(1, len(course.place_m) // _VERTICES)]))
        for flight, nodes in design.opened.courses.items()
        for node, course in nodes.items()
    }
    areas = {
        f"{pair.flight} {pair.pair}": placed_footprint(
            pair.looks, transform, to_geographic, height_m=scene.level.height_m
        )
        for pair in covered
    }
    write_kml(folder / "tracks.kml", title, lines, areas)
    return [picture, features, folder / "tracks.kml"]


def _covered(design: Design) -> Iterator[Covered]:
    for pair in design.opened.pairs:
        image = design.images[f"{pair.flight}/{pair.name}"]
        step = max(1, max(image.layers["mask"].shape) // _DOTS)
        looks = np.where(image.layers["mask"] == 0, image.layers["looks"], 0)[::step, ::step].astype(np.float32)
        courses, nodes = design.opened.courses[pair.flight], pair.name.split("-")
        legs = dict(zip(("transmitter", "receiver"), dict.fromkeys(nodes), strict=False))
        tracks = {
            leg: courses[node].place_m[:: max(1, len(courses[node].place_m) // _VERTICES)] for leg, node in legs.items()
        }
        imaged = {leg: courses[node].imaged_legs_m() for leg, node in legs.items()}
        yield Covered(pair.flight, pair.name, tracks, looks, imaged)


def write_campaign_config(plan: FlightPlan, directory: Path) -> Sequence[Path]:
    """Write the config and the raw folders of the later campaign.

    Raises
    ------
    CampaignError
        If a config exists already; the folder then remains unchanged.
    """
    directory = made_folder(directory)
    paths = [directory / "config" / "config.yaml", directory / FLIGHTS]
    for path in paths:
        if path.exists():
            raise CampaignError("exists already", path, "a new folder", "Choose another folder; nothing was changed.")
    (directory / "config").mkdir(parents=True, exist_ok=True)
    for flight in plan.image_flights:
        (directory / "raw" / flight.name).mkdir(parents=True, exist_ok=True)
    flights = [(flight.name, flight.kind, flight.transmitter, flight.nodes) for flight in plan.image_flights]
    write_config(directory, plan.document, flights)
    return paths


def plan_text(plan: FlightPlan) -> str:
    """Return a plan as YAML without defaults, which `read_flight_plan` can read."""
    return yaml.safe_dump(plan.model_dump(mode="json", exclude_unset=True), sort_keys=False, width=110)


def copy_named(plan: FlightPlan, root: Path, folder: Path) -> None:
    """Copy the missions and DEMs named in a plan to another folder, so that the plan can be used there."""

    def named(value: Any) -> Iterator[str]:
        if isinstance(value, str):
            yield value
        for part in value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ():
            yield from named(part)

    root, folder = ConfinedPath.at(root), made_folder(folder)
    names = {Path(name) for name in named(plan.model_dump(mode="json", exclude_unset=True)) if name}
    for name in sorted(name for name in names if not name.is_absolute() and ".." not in name.parts):
        source, copy = root / name, folder / name
        if source.is_file() and copy.real() != source.real():
            copy.parent.mkdir(parents=True, exist_ok=True)
            source.copy_to(copy)
