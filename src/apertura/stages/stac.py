"""Rule `stac`: static STAC catalogue of all images of a campaign."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import acos, degrees
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray
from pystac.utils import datetime_to_str

from apertura import __version__
from apertura.campaign.config import FUSED, is_monostatic, polarisation_of
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_listed, open_stage, read_manifest, record_files, remake_from
from apertura.common.atomic import write_json
from apertura.common.documents import undamaged
from apertura.common.errors import CampaignError
from apertura.common.provenance import lock_sha256, software
from apertura.core.echo.compression import centre_frequency
from apertura.formats.catalog import CATALOG
from apertura.formats.catalog.stac import (
    POLARISATIONS,
    AcquisitionTime,
    Image,
    asset_of,
    catalog_files,
    instant,
    projection,
    read_facts,
    true_azimuth_deg,
)
from apertura.formats.export.coverage import Covered, feature_collection
from apertura.stages.coverage import few_looks, place_of, transform_of
from apertura.stages.image_tags import mode_of
from apertura.stages.scene import OpenScene, settled_scene
from apertura.workflow.lineage import result_of
from apertura.workflow.rules import INTERFEROMETRY

_SUMS = {"coherent": "SLC", "noncoherent": "MLI"}
"""Mapping from the name of each sum, with which its file names begin, to its product type."""

_COMPARED = ("reference", "secondary")
"""Relations of the links from an interferogram to its images, in the order of `interferometry.pairs`."""


def stac(campaign: Campaign) -> list[Path]:
    """Write results/stac/; return the path of its root, catalog.json."""
    lineage = result_of(campaign, "stac").begin(campaign.root)
    manifest, folder = campaign.root / lineage.result.manifest, campaign.result("stac")
    images = _ImageDescriptions(campaign, settled_scene(campaign)).images()
    files = catalog_files(campaign.settings.campaign, images, campaign.settings.metadata)
    manifest.unlink(missing_ok=True)
    for name, document in files.items():
        write_json(campaign.result("stac", name), document)
    record_files(manifest, [folder / name for name in files], lineage)
    return [folder / CATALOG]


@dataclass(frozen=True)
class _ImageDescriptions:
    """Descriptions of the images of a campaign."""

    campaign: Campaign
    scene: OpenScene

    def images(self) -> list[Image]:
        """Return the images of the catalogue by flight: every pair, then every sum; then the interferograms."""
        images = []
        for flight in self.campaign.image_flights:
            looks = {pair: few_looks(self.campaign, flight.name, pair) for pair in flight.pairs}
            pairs = [self._pair(flight.name, pair, looks[pair]) for pair in flight.pairs]
            all_looks = np.sum(list(looks.values()), axis=0)
            sums = _SUMS if FUSED in flight.images else ()
            images += pairs + [self._sum(flight.name, name, pairs, all_looks) for name in sums]
        by_name = {(image.flight, image.name): image for image in images}
        requested = self.campaign.settings.interferometry
        return images + [
            self._interferogram(name, [by_name[image] for image in requested.images(name)]) for name in requested.pairs
        ]

    def _interferogram(self, name: str, images: Sequence[Image]) -> Image:
        path = self.campaign.result(INTERFEROMETRY, name, "interferogram.json")
        manifest, (first, second) = path.with_suffix(".manifest.json"), (image.acquisition for image in images)
        report, code = open_listed(path, manifest), read_manifest(manifest).get("code", "unknown")
        with undamaged(path, expected="the report of an interferogram", remedy=remake_from(manifest)):
            facts = {
                "product:type": "INTERFEROGRAM",
                "sar:instrument_mode": mode_of(list(dict.fromkeys(image.name for image in images))),
                "processing:level": "L3",
                "processing:lineage": f"apertura step interferogram {name}; code {code}; lock {self._lock}",
                "insar:perpendicular_baseline": float(report["perpendicular_baseline_m"]),
                "insar:temporal_baseline": round((second.middle - first.middle).total_seconds() / 86400, 6),
                "insar:height_of_ambiguity": float(report["measured"]["ambiguity_m"]),
                "insar:reference_datetime": datetime_to_str(first.middle),
                "insar:secondary_datetime": datetime_to_str(second.middle),
                "apertura:coherence": float(report["measured"]["coherence"]),
                "apertura:flags": sorted(report["flags"]),
            }
        return Image(
            INTERFEROMETRY,
            name,
            f"{self.campaign.settings.campaign} · interferogram {name}",
            images[0].geometry,
            AcquisitionTime.together([first, second]),
            {**self._shared, **facts},
            *self._assets(self._listed(INTERFEROMETRY, name, "interferogram")),
            compared={relation: (image.flight, image.name) for relation, image in zip(_COMPARED, images, strict=True)},
        )

    def _pair(self, flight: str, pair: str, looks: NDArray[np.float32]) -> Image:
        files = self._listed(flight, pair, "export") | self._listed(flight, pair, "layers")
        facts: dict[str, Any] = {
            "sar:instrument_mode": mode_of([pair]),
            "product:type": "SLC",
            "sar:looks_range": 1,
            "sar:looks_azimuth": 1,
        }
        label = polarisation_of(self.campaign.settings.nodes, pair)
        if label in POLARISATIONS:
            facts["sar:polarizations"] = [label]
        return Image(
            flight,
            pair,
            f"{self.campaign.settings.campaign} · flight {flight} · {pair}",
            self._footprint(looks),
            self._acquisition(flight, pair),
            {**facts, **self._properties(flight, pair)},
            *self._assets(files),
        )

    def _sum(self, flight: str, name: str, pairs: Sequence[Image], looks: NDArray[np.float32]) -> Image:
        others = tuple(f"{other}_" for other in _SUMS if other != name)
        listed = self._listed(flight, FUSED, "export")
        facts: dict[str, Any] = {
            "sar:instrument_mode": mode_of([pair.name for pair in pairs]),
            "product:type": _SUMS[name],
        }
        sides = {pair.properties.get("sar:observation_direction") for pair in pairs}
        if len(sides) == 1 and None not in sides:
            facts["sar:observation_direction"] = sides.pop()
        angles = [pair.properties["view:incidence_angle"] for pair in pairs]
        facts["view:incidence_angle"] = round(float(np.mean(angles)), 4)
        return Image(
            flight,
            name,
            f"{self.campaign.settings.campaign} · flight {flight} · {name} sum of {len(pairs)} pairs",
            self._footprint(looks),
            AcquisitionTime.together([pair.acquisition for pair in pairs]),
            {**facts, **self._properties(flight, FUSED)},
            *self._assets({path: digest for path, digest in listed.items() if not path.name.startswith(others)}),
            [pair.name for pair in pairs],
        )

    def _listed(self, flight: str, name: str, result: str) -> dict[Path, str]:
        """Return the files of a result with the hashes in its manifest."""
        manifest = self.campaign.root / self.campaign.manifest(result, flight, name)
        hashes: Mapping[str, str] = read_manifest(manifest)["files"]
        return {manifest.parent.named(file, where=manifest): digest for file, digest in hashes.items()}

    def _assets(self, files: Mapping[Path, str]) -> tuple[dict[str, Any], dict[str, str]]:
        """Return the assets of files by their keys, and file → SHA-256 of the inputs of the rasters."""
        assets, inputs = {}, dict[str, str]()
        for path, digest in files.items():
            if not path.is_file():
                raise CampaignError("no such file", path, "a finished product", "Run the workflow again.")
            facts, name = read_facts(path), quote(self.campaign.relative(path).removeprefix("results/"))
            key = path.stem if path.suffix == ".tif" else path.name
            assets[key] = asset_of(path, f"../../../{name}", sha256=digest, facts=facts)
            if facts.place.get("proj:shape", list(self.scene.grid.shape)) != list(self.scene.grid.shape):
                assets[key].extra_fields |= facts.place
            inputs = inputs or dict(facts.inputs)
        return assets, inputs

    def _properties(self, flight: str, name: str) -> dict[str, Any]:
        """Return the properties of an image: projection, processing, quality."""
        path = self.campaign.result(flight, name, "image.json")
        manifest = path.with_name("export.manifest.json")
        report, remedy = open_listed(path, manifest), remake_from(manifest)
        code = read_manifest(manifest).get("code", "unknown")
        with undamaged(path, expected="the report of an image", remedy=remedy):
            verdict, facts = str(report["focus"]["verdict"]), dict[str, Any]()
            if verdict == "focused":  # -3 dB widths of the brightest point
                brightest = report.get("brightest") or {}
                for axis, width in (("range", "ground_range_width_m"), ("azimuth", "cross_range_width_m")):
                    if brightest.get(width) is not None:
                        facts[f"sar:resolution_{axis}"] = float(brightest[width])
            if "view" in report:  # look direction of the pair at the scene centre
                view, grid = report["view"], self.scene.grid
                west, south, east, north = grid.bounds_m
                centre = (west + east) / 2, (south + north) / 2
                directions = {
                    "sar:observation_direction": view["side"],
                    "view:azimuth": true_azimuth_deg(grid.crs_wkt, centre, view["look_deg"]),
                }
                facts |= {name: value for name, value in directions.items() if value not in {"both", None}}
                facts["view:incidence_angle"] = float(view["incidence_deg"])
                if name != FUSED and is_monostatic(name) and 0 < view["height_m"] <= view["range_m"]:
                    facts["view:off_nadir"] = round(degrees(acos(view["height_m"] / view["range_m"])), 4)
            return {
                **self._shared,
                **facts,
                "processing:lineage": f"apertura step export {flight} {name}; code {code}; lock {self._lock}",
                "apertura:verdict": verdict,
                "apertura:flags": sorted(report["flags"]),
                "apertura:numerical_error_db": float(report["numerical_error_db"]),
            }

    @cached_property
    def _lock(self) -> str:
        return lock_sha256()

    @cached_property
    def _shared(self) -> dict[str, Any]:
        """Properties shared by all images: the grid and the software."""
        grid = self.scene.grid
        return {
            **projection(grid.crs_wkt, grid.shape, grid.transform),
            "sar:pixel_spacing_range": grid.spacing_m,
            "sar:pixel_spacing_azimuth": grid.spacing_m,
            "processing:level": "L1",
            "processing:version": __version__,
            "processing:software": software(),
        }

    def _footprint(self, looks: NDArray[np.float32]) -> dict[str, Any] | None:
        covered, transform = Covered("", "", {}, looks), transform_of(self.scene.grid, looks)
        height_m = self.scene.level.height_m
        collection = feature_collection([covered], transform, place_of(self.scene), height_m=height_m)
        geometry: dict[str, Any] | None = collection["features"][0]["geometry"]
        return geometry if geometry and geometry["coordinates"] else None

    def _acquisition(self, flight: str, pair: str) -> AcquisitionTime:
        echo = open_stage(self.campaign.stage("echo", flight, pair), "echo")
        times, frequency = echo.time.values.astype(np.int64), echo.frequency.values
        span_hz = float(frequency[-1] - frequency[0])
        bandwidth_hz = span_hz * frequency.size / max(frequency.size - 1, 1)
        ends = instant(int(times.min())), instant(int(times.max()))
        return AcquisitionTime(*ends, centre_frequency(frequency), bandwidth_hz)
