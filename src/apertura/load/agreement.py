"""How two finished images of a campaign agree, by the bright points that each found in itself."""

from dataclasses import asdict
from typing import TYPE_CHECKING

from apertura.quality.agreement import Agreement, agreement
from apertura.quality.bright_points import BrightPoint
from apertura.scene.grid import SceneGrid

if TYPE_CHECKING:
    import xarray as xr


def agreement_of(first: "xr.Dataset", second: "xr.Dataset", grid: SceneGrid) -> Agreement | None:
    """Return how a second stage `image` lies against a first; None where they share no bright point."""
    return agreement(
        (first.image, second.image),
        (_points(first, grid), _points(second, grid)),
        spacing_m=grid.spacing_m,
        cell_m=common_cell_m(first, second),
    )


def common_cell_m(first: "xr.Dataset", second: "xr.Dataset") -> float:
    """Return the coarser of two images' resolution cells, metres."""
    return float(max(image.attrs["quality"]["focus"]["cell_m"] for image in (first, second)))


def agreement_report(found: Agreement | None) -> dict[str, float] | None:
    """Return an agreement as JSON values."""
    return None if found is None else {name: float(f"{value:.4g}") for name, value in asdict(found).items()}


def _points(image: "xr.Dataset", grid: SceneGrid) -> list[BrightPoint]:
    points = image.attrs["quality"]["focus"]["points"]
    rows, columns = grid.pixel_of([point["x_m"] for point in points], [point["y_m"] for point in points])
    return [
        BrightPoint(float(row), float(column), point["amplitude"])
        for row, column, point in zip(rows, columns, points, strict=True)
    ]
