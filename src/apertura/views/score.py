"""`apertura score`: compare target positions measured in exported GeoTIFFs with the true positions in truth.json."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from apertura.campaign.config import FUSED, Flight
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_listed, open_stage
from apertura.common.documents import read_json, undamaged
from apertura.common.errors import CampaignError
from apertura.common.raster import opened_raster
from apertura.common.units import decibels
from apertura.core.quality.bright_points import BrightPoint, bright_point, brightest_near
from apertura.core.quality.point_targets import cut_through, find_peak
from apertura.formats.export import product, product_files
from apertura.formats.export.radiometry import CROSS_SECTIONS
from apertura.stages.pair import open_pair
from apertura.stages.planning import gated
from apertura.stages.radiometry import calibrated_pair
from apertura.stages.scene import open_scene, settled_scene
from apertura.views.summary import print_summary

REACH_M = 1.0
"""Half length of the cuts through a target, metres; the search radius around the true position is a quarter of it."""


@dataclass(frozen=True)
class Finding:
    """Measurement of a target in an image: position error and widths; in calibrated images, radar cross-section."""

    flight: str
    image: str
    target: int
    error_east_m: float
    error_north_m: float
    cross_range_m: float
    ground_range_m: float
    rcs_dbsm: float | None = None
    rcs_std_db: float | None = None
    rcs_put_dbsm: float | None = None

    @property
    def error_m(self) -> float:
        """Distance between measured and true position, metres."""
        return float(np.hypot(self.error_east_m, self.error_north_m))


def score(campaign: Campaign) -> list[Finding]:
    """Locate each target of truth.json in each SLC of the campaign and measure its −3 dB widths.

    Raises
    ------
    CampaignError
        If the campaign has no truth.json or no results.
    """
    path = campaign.root.named("truth.json", where=campaign.root)
    expected, remedy = "true target positions", "Use a simulated campaign: only these contain true positions."
    document = read_json(path, expected=expected, remedy=remedy)
    with undamaged(path, expected=expected, remedy=remedy):
        keys = ("x", "y", "rcs_m2")
        targets = [{key: float(target[key]) for key in keys if key in target} for target in document["targets"]]
    return [finding for flight in campaign.image_flights for finding in _flight(campaign, flight, targets)]


def _flight(campaign: Campaign, flight: Flight, targets: list[dict[str, float]]) -> Iterator[Finding]:
    grid = settled_scene(campaign).grid
    echo = open_stage(campaign.stage("echo", flight.name, flight.pairs[0]), "echo")
    ends = echo.tx_position.values[[0, -1]]
    down, right, _ = np.diff(grid.pixel_below(ends), axis=0)[0]
    along = (float(right), float(-down))
    sources = {name: "coherent" if name == FUSED else "image" for name in flight.images}
    files = {name: campaign.result(flight.name, name, product(of, "write_slc").file) for name, of in sources.items()}
    for name, file in files.items():
        if not file.is_file():
            raise CampaignError(
                "no such file", where=file, expected="a finished campaign", remedy="Run the workflow first."
            )
        with opened_raster(file, expected="a finished campaign", remedy="Run the workflow again.") as raster:
            image, spacing = raster.read(1), grid.spacing_m
        sections = _cross_sections(campaign, flight.name, name)
        for number, target in enumerate(targets):
            row, column = map(float, grid.pixel_of(target["x"], target["y"]))
            if not (0 <= row < image.shape[0] - 1 and 0 <= column < image.shape[1] - 1):
                continue
            nearest = brightest_near(image, row, column, REACH_M / 4 / spacing)
            peak = find_peak(image, *nearest)
            across = (along[1], -along[0])
            cuts = [
                cut_through(image, peak, direction=direction, spacing_m=spacing, reach_m=REACH_M)
                for direction in (along, across)
            ]
            yield Finding(
                flight.name,
                name,
                number,
                error_east_m=(peak.column - column) * spacing,
                error_north_m=(row - peak.row) * spacing,
                cross_range_m=cuts[0].width_m,
                ground_range_m=cuts[1].width_m,
                **({} if sections is None else sections(bright_point(image, *nearest), target.get("rcs_m2"))),
            )


def _cross_sections(
    campaign: Campaign, flight: str, pair: str
) -> Callable[[BrightPoint, float | None], dict[str, Any]] | None:
    """Return a function that measures the cross-section of a point in a pair's image; None if not calibrated.

    The arguments of the function are the point and its true cross-section.
    """
    if not campaign.calibrated or pair == FUSED:
        return None
    scene, path = open_scene(campaign), campaign.result(flight, pair, CROSS_SECTIONS)
    calibrated = calibrated_pair(campaign, gated(campaign, open_pair(campaign, flight, pair), scene), scene)
    noise = open_listed(path, campaign.root / campaign.manifest("layers", flight, pair))["noise"]["pulse"]

    def measure(point: BrightPoint, true_rcs_m2: float | None) -> dict[str, Any]:
        if calibrated is None:
            return {}
        (measured,) = calibrated.points([point], scene, np.nan if noise is None else float(noise))
        true_dbsm = None if not true_rcs_m2 else decibels(true_rcs_m2)
        return {"rcs_dbsm": measured["rcs_dbsm"], "rcs_std_db": measured["std_db"], "rcs_put_dbsm": true_dbsm}

    return measure


def print_findings(campaign: Campaign, *, paths: bool) -> None:
    """Print a table of the findings of `score`; with `paths`, also print the files of all products."""
    campaign.check_images()
    console = Console(width=120)
    table = Table(title=f"{campaign.settings.campaign}: measured and true positions", title_justify="left")
    calibrated = ("RCS, dBsm", "true RCS") if campaign.calibrated else ()
    errors = ("error east", "error north", "error")
    headings = ("flight", "image", "target", *errors, "cross-range", "ground range", *calibrated)
    for heading in headings:
        table.add_column(heading, justify="right" if heading not in {"flight", "image"} else "left")
    for finding in score(campaign):
        numbers = (finding.error_east_m, finding.error_north_m, finding.error_m)
        widths = (finding.cross_range_m, finding.ground_range_m)
        row = [f"{100 * value:+.1f} cm" for value in numbers[:2]] + [f"{100 * numbers[2]:.1f} cm"]
        row += [f"{100 * width:.1f} cm" for width in widths]
        if finding.rcs_put_dbsm is not None or finding.rcs_dbsm is not None:
            is_measured = finding.rcs_dbsm is not None
            row.append(f"{finding.rcs_dbsm:.2f} ± {finding.rcs_std_db:.2f}" if is_measured else "in noise or clutter")
            row.append("" if finding.rcs_put_dbsm is None else f"{finding.rcs_put_dbsm:.2f}")
        table.add_row(finding.flight, finding.image, str(finding.target), *row)
    console.print(table)
    print_summary(campaign)
    if paths:
        for file in product_files(campaign.images, campaign.coefficients):
            print(campaign.results / file)
