"""How two finished images of a campaign agree, by the bright points that each found in itself."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from apertura.core.quality.agreement import Agreement, agreement
from apertura.core.quality.bright_points import BrightPoint, shows_point
from apertura.core.quality.measures import Raster
from apertura.core.scene.grid import SceneGrid

if TYPE_CHECKING:
    import xarray as xr


def agreement_of(first: "xr.Dataset", second: "xr.Dataset", grid: SceneGrid) -> Agreement | None:
    """Return how a second stage `image` lies against a first; None where they share no bright point.

    None as well where pixels are wider than a resolution cell: they do not tell where a point is.
    """
    if not comparable(first, second, grid):
        return None
    return agreement_by_focus((first.image, second.image), (_focus(first), _focus(second)), grid)


def agreement_by_focus(
    images: tuple[Raster, Raster], focus: tuple[Mapping[str, Any], Mapping[str, Any]], grid: SceneGrid
) -> Agreement | None:
    """Return how two images on a grid agree, by what `apertura.core.imaging.focus_check.focus_report` says of each."""
    return agreement(
        images,
        (_points(focus[0], grid), _points(focus[1], grid)),
        spacing_m=grid.spacing_m,
        cell_m=max(one["cell_m"] for one in focus),
        alone=all(one["maxima"] == 1 for one in focus),
        spectrum=np.mean([one["spectrum_cycles2_m2"] for one in focus], axis=0),
    )


def comparable(first: "xr.Dataset", second: "xr.Dataset", grid: SceneGrid) -> bool:
    """Return whether the pixels of two images are fine enough to tell where their points are."""
    return bool(grid.spacing_m <= min(_focus(image)["cell_m"] for image in (first, second)))


def shows_points_of(first: "xr.Dataset", second: "xr.Dataset", grid: SceneGrid) -> bool:
    """Return whether a second image has a bright pixel where a first has one of its bright points."""
    reach = max(1, round(_focus(first)["cell_m"] / grid.spacing_m))
    points = _points(_focus(first), grid)
    return any(shows_point(second.image, round(point.row), round(point.column), reach=reach) for point in points)


def _focus(image: "xr.Dataset") -> dict[str, Any]:
    focus: dict[str, Any] = image.attrs["quality"]["focus"]
    return focus


def agreement_report(found: Agreement | None) -> dict[str, float] | None:
    """Return an agreement as JSON values."""
    return None if found is None else {name: float(f"{value:.4g}") for name, value in asdict(found).items()}


def _points(focus: Mapping[str, Any], grid: SceneGrid) -> list[BrightPoint]:
    points = focus["points"]
    rows, columns = grid.pixel_of([point["x_m"] for point in points], [point["y_m"] for point in points])
    return [
        BrightPoint(
            float(row),
            float(column),
            point["amplitude"],
            point["background"],
            carrier=(-point["carrier_cycles_m"][1] * grid.spacing_m, point["carrier_cycles_m"][0] * grid.spacing_m),
        )
        for row, column, point in zip(rows, columns, points, strict=True)
    ]
