"""Comparison of two finished images of a campaign, and access to their layers, sums and reports."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.campaign.store import (
    open_document,
    open_listed,
    read_manifest,
    remake,
    remake_from,
)
from apertura.common.contracts import Window
from apertura.common.documents import undamaged
from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.core.combination import PairSum
from apertura.core.quality.agreement import WIDEST_PIXEL, Agreement, agreement, agreement_of_ground
from apertura.core.quality.bright_points import SPECKLE, BrightPoint, bright_points, has_point, near
from apertura.core.quality.measures import BlockRaster
from apertura.core.quality.point_targets import BandLimitedPatch, carrier_at
from apertura.core.scene.grid import SceneGrid

_SPECKLE_PROBABILITY = 2e-3
"""Probability that, within a resolution cell of a given pixel, a speckle pixel exceeds the mean by 10 dB."""

_SIGNIFICANCE = 0.01
"""Significance level of the test for the bright points of another image."""


@contextmanager
def opened_layer(campaign: Campaign, flight: str, pair: str, file: str) -> Iterator[Any]:
    """Open a GeoTIFF that step `layers` wrote, such as 'mask.tif'.

    Yields
    ------
    rasterio.DatasetReader
        The raster.

    Raises
    ------
    CampaignError
        If the file is missing, or has changed since the step wrote it.
    """
    from apertura.common.raster import opened_raster

    path = campaign.result(flight, pair, file)
    manifest = campaign.root / campaign.manifest("layers", flight, pair)
    remedy = remake_from(manifest)
    if not path.is_file() or read_manifest(manifest)["files"].get(path.name) != sha256_file(path):
        raise CampaignError(
            "the file has changed since it was written" if path.is_file() else "no such file",
            path,
            f"the file listed in {manifest.name}",
            remedy,
        )
    with opened_raster(path, expected="a raster of step layers", remedy=remedy) as raster:
        yield raster


def averaged(raster: Any, dots: int) -> NDArray[np.float32]:
    """Return a raster averaged to a coarse grid, from its overviews.

    Parameters
    ----------
    raster
        Raster open for reading.
    dots
        Largest number of averaged pixels along the longer side.

    Returns
    -------
    ndarray
        (row, column) float32.
    """
    from rasterio.enums import Resampling

    factor = max(1.0, max(raster.shape) / dots)
    shape = tuple(max(1, round(size / factor)) for size in raster.shape)
    values: NDArray[np.float32] = raster.read(1, out_shape=shape, resampling=Resampling.average)
    return values


@dataclass(frozen=True, eq=False)
class ComparedImage:
    """Image with the properties required for a comparison with other images of the scene.

    Attributes
    ----------
    raster
        (y, x) complex64.
    points
        Isolated bright points whose main lobe lies in the image. The points exceed their surroundings in the image, but
        unlike the points used to measure the focus, they need not dominate their range cell in every pulse.
    cell_m, spectrum
        Finest resolution cell, and (2, 2) covariance of a point's spatial spectrum, cycles² per m².
    focus
        Section `focus` of image.json.
    carriers, grid
        Spatial carriers of points over the image, as returned by `apertura.core.imaging.view.carriers_of`, and the
        image grid.
    """

    raster: BlockRaster
    points: Sequence[BrightPoint]
    cell_m: float
    spectrum: NDArray[np.float64]
    focus: Mapping[str, Any]
    carriers: NDArray[np.float64]
    grid: SceneGrid

    @classmethod
    def of(cls, image: "xr.Dataset", grid: SceneGrid, windows: Iterable[Window]) -> "ComparedImage":
        """Return the comparison data of a stage `image`; `windows` cover the grid once."""
        quality = image.attrs["quality"]
        carriers = np.array(quality["view"]["carriers_cycles_m"])
        return cls.from_raster(image.image, quality["focus"], carriers, grid, windows)

    @classmethod
    def from_raster(
        cls,
        raster: BlockRaster,
        focus: Mapping[str, Any],
        carriers: NDArray[np.float64],
        grid: SceneGrid,
        windows: Iterable[Window],
    ) -> "ComparedImage":
        """Return the comparison data of a raster, with its bright points."""
        spectrum = np.array(focus["spectrum_cycles2_m2"])
        points = bright_points_within(raster, grid, windows, spectrum, cell_m=focus["cell_m"])
        image = cls(raster, points, focus["cell_m"], spectrum, focus, carriers, grid)
        with_carriers = [replace(point, carrier=image.carrier(point.row, point.column)) for point in points]
        return replace(image, points=with_carriers)

    def carrier(self, row: float, column: float) -> tuple[float, float]:
        """Return the spatial carrier of a point at a pixel, cycles per pixel down and right."""
        east, north = carrier_at(self.carriers, self.grid.shape, row, column)
        return -north * self.grid.spacing_m, east * self.grid.spacing_m

    def shows(self, point: BrightPoint) -> bool:
        """Return True if this image has a bright point within a resolution cell of another image's bright point."""
        reach_px = self.cell_m / self.grid.spacing_m
        return any(np.hypot(point.row - own.row, point.column - own.column) <= reach_px for own in self.points)

    def at(self, row: float, column: float) -> complex:
        """Return the image at a fractional pixel, interpolated about the spatial carrier at that pixel."""
        patch = BandLimitedPatch(self.raster, round(row), round(column), self.carrier(row, column))
        return complex(patch.at(row, column))


def bright_points_within(
    raster: BlockRaster,
    grid: SceneGrid,
    windows: Iterable[Window],
    spectrum: NDArray[np.float64],
    *,
    cell_m: float,
    isolated: bool = True,
) -> list[BrightPoint]:
    """Return the bright points of an image whose main lobe lies within the image.

    Parameters
    ----------
    raster
        (y, x) complex64.
    grid, windows
        Grid of the image, and windows that cover it once.
    spectrum
        (2, 2) float64, covariance of a point's spatial spectrum east and north, cycles² per m².
    cell_m
        Finest resolution cell.
    isolated
        Return only points that exceed their surroundings by more than speckle would.
    """
    cell_px = cell_m / grid.spacing_m
    shown = near(spectrum, grid.spacing_m, cell_m)
    return [
        point
        for point in bright_points(raster, windows, cell_px=max(8, round(cell_px)), shown=shown)
        if (point.background <= SPECKLE or not isolated)
        and all(
            cell_px <= at <= size - 1 - cell_px for at, size in zip((point.row, point.column), grid.shape, strict=True)
        )
    ]


def agreement_of(
    first: ComparedImage, second: ComparedImage, grid: SceneGrid, windows: Sequence[Window]
) -> Agreement | None:
    """Compare a second image with a first at bright points, or, without common bright points, by distributed clutter.

    The result is None if neither is possible, or if pixels are too wide, relative to a resolution cell, to resolve the
    position of a point.
    """
    if not comparable(first, second, grid):
        return None
    images = first.raster, second.raster
    where: dict[str, Any] = {
        "spacing_m": grid.spacing_m,
        "cell_m": max(first.cell_m, second.cell_m),
        "spectrum": (first.spectrum + second.spectrum) / 2,
    }
    alone = all(len(one.points) == one.focus["maxima"] == 1 for one in (first, second))
    by_points = agreement(images, (first.points, second.points), alone=alone, **where)
    return by_points or agreement_of_ground(images, windows, **where)


def comparable(first: ComparedImage, second: ComparedImage, grid: SceneGrid) -> bool:
    """Return True if the pixels of two images are fine enough to compare the positions of points."""
    return grid.spacing_m <= WIDEST_PIXEL * min(first.cell_m, second.cell_m)


def shows_points_of(first: ComparedImage, second: ComparedImage, grid: SceneGrid) -> bool:
    """Return True if a second image has bright pixels at a significant number of the bright points of a first image.

    Notes
    -----
    Source: docs/theory/fusion.md, eq. 9.
    """
    reach, count = max(1, round(first.cell_m / grid.spacing_m)), len(first.points)
    shown = sum(has_point(second.raster, round(one.row), round(one.column), reach=reach) for one in first.points)
    return shown > 0 and float(scipy.special.bdtrc(shown - 1, count, _SPECKLE_PROBABILITY)) < _SIGNIFICANCE


def agreement_report(measured: Agreement | None) -> dict[str, float | str] | None:
    """Return an agreement as JSON values; None if the images were not compared."""
    if measured is None:
        return None
    return {
        name: value if isinstance(value, str | bool) else float(f"{value:.4g}")
        for name, value in asdict(measured).items()
    }


def sum_of(images: Mapping[str, xr.Dataset], assessed: Mapping[str, Any], kind: str) -> PairSum:
    """Return a sum of a flight's images; `kind` is coherent, noncoherent or magnitude."""
    peaks = {pair: image.attrs["quality"]["brightest"]["amplitude"] for pair, image in images.items()}
    rasters = {pair: image.image for pair, image in images.items()}
    return PairSum(rasters, peaks, assessed["fusion"]["phases_rad"], kind)


def report_of(campaign: Campaign, flight: str, image: str) -> dict[str, Any]:
    """Return image.json of a pair or of 'fused'; raise CampaignError if it is missing or has changed since export."""
    path = campaign.result(flight, image, "image.json")
    return open_listed(path, path.with_name("export.manifest.json"))


def assessment_of(campaign: Campaign, flight: str) -> dict[str, Any]:
    """Return the assessment of a flight: agreement of its images, their flags, members of the coherent sum.

    Raises
    ------
    CampaignError
        If the file is missing, or has changed since the step wrote it.
    """
    path = campaign.result(flight, "assessment.json")
    document = open_document(path)
    with undamaged(path, expected="the fields that step assess writes", remedy=remake(path)):
        read = {name: document[name] for name in ("reference", "hypotheses", "code_sha256")}
        fusion, pairs = document["fusion"], document["pairs"]
        phases = {pair: float(phase_rad) for pair, phase_rad in fusion["phases_rad"].items()}
        excluded = {name: {**fusion[name]} for name in ("excluded", "unmeasured")}
        read["fusion"] = {**fusion, **excluded, "phases_rad": phases}
        read["first_flight"] = {**document.get("first_flight", {})}
        read["pairs"] = {pair: {**agreed, "flags": {**agreed["flags"]}} for pair, agreed in pairs.items()}
    return {**document, **read}
