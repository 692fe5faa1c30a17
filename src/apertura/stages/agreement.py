"""Finished images of a campaign opened again: a layer at few places, and how two images agree."""

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
from apertura.core.quality.agreement import WIDEST_PIXEL, Agreement, agreement, agreement_of_ground
from apertura.core.quality.bright_points import SPECKLE, BrightPoint, bright_points, has_point, near
from apertura.core.quality.measures import BlockRaster
from apertura.core.quality.point_targets import BandLimitedPatch, carrier_at
from apertura.core.scene.grid import SceneGrid

_SPECKLE_SHOWS = 2e-3
"""Probability that speckle has a pixel 10 dB above its mean within a resolution cell of a place."""

_BY_CHANCE = 0.01
"""Probability below which bright pixels at the points of another image are these points."""


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
        If it is not there as the step wrote it.
    """
    from apertura.common.raster import opened_raster

    path = campaign.result(flight, pair, file)
    manifest = campaign.root / campaign.manifest("layers", flight, pair)
    remedy = remake_from(manifest)
    if not path.is_file() or read_manifest(manifest)["files"].get(path.name) != sha256_file(path):
        raise CampaignError("not as it was written", path, f"what {manifest.name} describes", remedy)
    with opened_raster(path, expected="what step layers writes", remedy=remedy) as raster:
        yield raster


def averaged(raster: Any, dots: int) -> NDArray[np.float32]:
    """Return a raster averaged to few places, from its overviews.

    Parameters
    ----------
    raster
        Open for reading.
    dots
        Places along the longer side, at most.

    Returns
    -------
    ndarray
        (row, column) float32.
    """
    from rasterio.enums import Resampling

    fewer = max(1.0, max(raster.shape) / dots)
    shape = tuple(max(1, round(size / fewer)) for size in raster.shape)
    values: NDArray[np.float32] = raster.read(1, out_shape=shape, resampling=Resampling.average)
    return values


@dataclass(frozen=True, eq=False)
class ComparedImage:
    """An image as it is compared with others of its scene.

    Attributes
    ----------
    raster
        (y, x) complex64.
    points
        Its isolated bright points whose main lobe lies in the image. Each stands above what lies around it there,
        whether or not it dominates its range cell in every pulse, as evidence of focus has to.
    cell_m, spectrum
        Finest resolution cell, and (2, 2) covariance of a point's spatial spectrum, cycles² per m².
    focus
        Its section of image.json.
    carriers, grid
        Of points over the image, as `apertura.core.imaging.view.carriers_of`; and where its pixels lie.
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
        """Return a stage `image` with its bright points, from windows that cover it once."""
        quality = image.attrs["quality"]
        return cls.found(image.image, quality["focus"], np.array(quality["view"]["carriers_cycles_m"]), grid, windows)

    @classmethod
    def found(
        cls,
        raster: BlockRaster,
        focus: Mapping[str, Any],
        carriers: NDArray[np.float64],
        grid: SceneGrid,
        windows: Iterable[Window],
    ) -> "ComparedImage":
        """Return an image with its bright points."""
        spectrum = np.array(focus["spectrum_cycles2_m2"])
        points = bright_places(raster, grid, windows, spectrum, cell_m=focus["cell_m"])
        image = cls(raster, points, focus["cell_m"], spectrum, focus, carriers, grid)
        placed = [replace(point, carrier=image.carrier(point.row, point.column)) for point in points]
        return replace(image, points=placed)

    def carrier(self, row: float, column: float) -> tuple[float, float]:
        """Return the carrier of a point there, cycles per pixel down and right."""
        east, north = carrier_at(self.carriers, self.grid.shape, row, column)
        return -north * self.grid.spacing_m, east * self.grid.spacing_m

    def shows(self, point: BrightPoint) -> bool:
        """Test whether one of its bright points lies within a resolution cell of another image's."""
        reach_px = self.cell_m / self.grid.spacing_m
        return any(np.hypot(point.row - one.row, point.column - one.column) <= reach_px for one in self.points)

    def at(self, row: float, column: float) -> complex:
        """Return the image at a fractional pixel, interpolated about the carrier of a point there."""
        patch = BandLimitedPatch(self.raster, round(row), round(column), self.carrier(row, column))
        return complex(patch.at(row, column))


def bright_places(
    raster: BlockRaster,
    grid: SceneGrid,
    windows: Iterable[Window],
    spectrum: NDArray[np.float64],
    *,
    cell_m: float,
    isolated: bool = True,
) -> list[BrightPoint]:
    """Return the bright points of an image whose main lobe lies in it.

    Parameters
    ----------
    raster
        (y, x) complex64.
    grid, windows
        Of it, and windows that cover it once.
    spectrum
        (2, 2) float64, covariance of a point's spatial spectrum east and north, cycles² per m².
    cell_m
        Finest resolution cell.
    isolated
        Those alone that stand far enough above their surroundings not to be speckle.
    """
    cell_px = cell_m / grid.spacing_m
    found = bright_points(raster, windows, cell_px=max(8, round(cell_px)), shown=near(spectrum, grid.spacing_m, cell_m))
    return [
        point
        for point in found
        if (point.background <= SPECKLE or not isolated)
        and all(
            cell_px <= at <= size - 1 - cell_px for at, size in zip((point.row, point.column), grid.shape, strict=True)
        )
    ]


def agreement_of(
    first: ComparedImage, second: ComparedImage, grid: SceneGrid, windows: Sequence[Window]
) -> Agreement | None:
    """Compare a second image with a first: by bright points, else by ground; None where neither is possible.

    None as well where pixels are wider than a resolution cell: they do not resolve the place of a point.
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
    """Test whether the pixels of two images are fine enough to compare the places of points."""
    return grid.spacing_m <= WIDEST_PIXEL * min(first.cell_m, second.cell_m)


def shows_points_of(first: ComparedImage, second: ComparedImage, grid: SceneGrid) -> bool:
    """Test whether a second image has bright pixels at more bright points of a first than chance explains.

    Notes
    -----
    Source: docs/theory/fusion.md, eq. 9.
    """
    reach, count = max(1, round(first.cell_m / grid.spacing_m)), len(first.points)
    shown = sum(has_point(second.raster, round(one.row), round(one.column), reach=reach) for one in first.points)
    return shown > 0 and float(scipy.special.bdtrc(shown - 1, count, _SPECKLE_SHOWS)) < _BY_CHANCE


def agreement_report(found: Agreement | None) -> dict[str, float | str] | None:
    """Return an agreement as JSON values."""
    if found is None:
        return None
    return {
        name: value if isinstance(value, str | bool) else float(f"{value:.4g}") for name, value in asdict(found).items()
    }


def report_of(campaign: Campaign, flight: str, image: str) -> dict[str, Any]:
    """Return image.json of a pair or of 'fused'; raise CampaignError if it is not there as step export left it."""
    path = campaign.result(flight, image, "image.json")
    return open_listed(path, path.with_name("export.manifest.json"))


def assessment_of(campaign: Campaign, flight: str) -> dict[str, Any]:
    """Return the assessment of a flight: agreement of its images, their flags, members of the coherent sum.

    Raises
    ------
    CampaignError
        If it is not there as the step left it.
    """
    path = campaign.result(flight, "assessment.json")
    document = open_document(path)
    with undamaged(path, expected="what step assess writes", remedy=remake(path)):
        read = {name: document[name] for name in ("reference", "hypotheses", "code_sha256")}
        fusion, pairs = document["fusion"], document["pairs"]
        phases = {pair: float(phase_rad) for pair, phase_rad in fusion["phases_rad"].items()}
        excluded = {name: {**fusion[name]} for name in ("left_out", "unmeasured")}
        read["fusion"] = {**fusion, **excluded, "phases_rad": phases}
        read["pairs"] = {pair: {**agreed, "flags": {**agreed["flags"]}} for pair, agreed in pairs.items()}
    return {**document, **read}
