"""Coverage of a campaign: number of pulses and pairs, footprints and tracks, as a plot and as GeoJSON."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib import colormaps
from matplotlib.colors import BoundaryNorm
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from rasterio import Affine
from rasterio.features import shapes
from rasterio.transform import array_bounds

from apertura.common.atomic import replacement
from apertura.common.errors import number_of
from apertura.formats.export.map_layout import DPI, MapLayout

MARGIN = 0.04
"""Margin around tracks and scene, relative to the longer side of their bounds."""

_NAMED = 8  # largest number of flights that are distinguished by colours
_HALF_DEG = 180.0  # a larger difference of longitude between neighbours indicates the antimeridian
_SMALL = 0.25  # size relative to the longer side of the map below which an additional map of the scene is plotted
_COLOURS = tuple(colormaps["tab10"](number) for number in range(10))

Ring = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Covered:
    """Coverage of one pair of a flight.

    Attributes
    ----------
    flight, pair
        Names of flight and pair.
    tracks_m
        Antenna (transmitter, receiver) → (vertex, 3) float64: easting, northing and height on the map, metres.
    looks
        (row, column) float32: number of pulses at each point of the scene.
    imaged_m
        Antenna → parts of its track that contribute to the image, a list of (vertex, 2 or 3), metres; empty if the
        whole track contributes.
    """

    flight: str
    pair: str
    tracks_m: Mapping[str, NDArray[np.float64]]
    looks: NDArray[np.float32]
    imaged_m: Mapping[str, Sequence[NDArray[np.float64]]] = field(default_factory=dict)


def footprint(looks: NDArray[np.float32], transform: Affine) -> list[list[Ring]]:
    """Return polygons around the pixels with pulses: rings (vertex, 2) in map metres, outer ring first.

    Outer rings are counterclockwise, holes clockwise, and all are closed, as required by GeoJSON.

    Examples
    --------
    >>> rings = footprint(np.array([[0, 5.0], [0, 5.0]], np.float32), Affine(2, 0, 100, 0, -2, 50))
    >>> rings[0][0].tolist()
    [[102.0, 46.0], [104.0, 46.0], [104.0, 50.0], [102.0, 50.0], [102.0, 46.0]]
    """
    covered = looks > 0
    polygons = shapes(covered.astype(np.uint8), mask=covered, transform=transform)
    return [
        [
            _oriented(np.asarray(ring, np.float64), counterclockwise=number == 0)
            for number, ring in enumerate(shape["coordinates"])
        ]
        for shape, _ in polygons
    ]


def _oriented(ring: Ring, *, counterclockwise: bool) -> Ring:
    x, y = (ring - ring[0]).T
    is_counterclockwise = float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) > 0
    ring = ring if is_counterclockwise == counterclockwise else ring[::-1]
    lowest = int(np.lexsort((ring[:-1, 0], ring[:-1, 1]))[0])  # reproducible first vertex
    return np.concatenate([ring[lowest:-1], ring[: lowest + 1]])


def feature_collection(
    covered: Sequence[Covered],
    transform: Affine,
    place: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None,
    *,
    height_m: float,
) -> dict[str, Any]:
    """Return tracks and footprints as GeoJSON (RFC 7946).

    Parameters
    ----------
    covered
        Coverage of each pair.
    transform
        Georeference of the looks on the map.
    place
        Function from map coordinates (n, 3), metres, to longitude and latitude (deg, WGS 84) and height (m), (n, 3);
        None if the map is not georeferenced; geometries are then null.
    height_m
        Height of the footprints, for `place`.
    """
    features = []
    for coverage in covered:
        names = {"flight": coverage.flight, "pair": coverage.pair}
        for antenna, track_m in coverage.tracks_m.items():
            line = None
            if place is not None:
                parts = [_rounded(part, heights=True) for part in cut_line(place(track_m))]
                is_single = len(parts) == 1
                kind, coordinates = ("LineString", parts[0]) if is_single else ("MultiLineString", parts)
                line = {"type": kind, "coordinates": coordinates}
            features.append(_feature(line, {"kind": "track", "antenna": antenna, **names}))
        area = None
        if place is not None:
            areas = placed_footprint(coverage.looks, transform, place, height_m=height_m)
            area = {"type": "MultiPolygon", "coordinates": [[_rounded(ring) for ring in rings] for rings in areas]}
        features.append(_feature(area, {"kind": "footprint", **names, **_statistics(coverage.looks, transform)}))
    return {"type": "FeatureCollection", "features": features}


def placed_footprint(
    looks: NDArray[np.float32],
    transform: Affine,
    place: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    *,
    height_m: float,
) -> list[list[Ring]]:
    """Return the polygons of `footprint` as longitude, latitude and height; cut at the antimeridian (RFC 7946, 3.1.9).

    Parameters
    ----------
    looks, transform
        See `footprint`.
    place, height_m
        See `feature_collection`.
    """

    def placed(ring: Ring) -> Ring:
        return place(np.c_[ring, np.full(len(ring), height_m)])

    polygons = [[placed(ring) for ring in rings] for rings in footprint(looks, transform)]
    if not any(np.ptp(ring[:, 0]) > _HALF_DEG for rings in polygons for ring in rings):
        return polygons
    # For each side of the antimeridian, select the pixels that extend into that side, and clip their vertices to it.
    down, right = np.mgrid[: looks.shape[0] + 1, : looks.shape[1] + 1]
    corners = np.stack(transform @ (right.ravel(), down.ravel()), -1)
    offset_deg = (placed(corners)[:, 0] % 360 - _HALF_DEG).reshape(down.shape)
    corner_offsets = np.stack([offset_deg[:-1, :-1], offset_deg[1:, :-1], offset_deg[:-1, 1:], offset_deg[1:, 1:]])
    cut = []
    for side, on_side in ((-1, corner_offsets.min(axis=0) < 0), (1, corner_offsets.max(axis=0) > 0)):
        for rings in footprint(np.where(on_side, looks, 0), transform):
            parts = [placed(ring) for ring in rings]
            for ring in parts:
                ring_offset = ring[:, 0] % 360 - _HALF_DEG
                ring[:, 0] = side * np.maximum(side * ring_offset, 0.0) - side * _HALF_DEG
            cut.append(parts)
    return cut


def cut_line(places: Ring) -> list[Ring]:
    """Split a line of longitude, latitude and height at the antimeridian (RFC 7946, 3.1.9).

    Examples
    --------
    >>> [line.tolist() for line in cut_line(np.array([[179.0, 10.0, 5.0], [-178.0, 13.0, 8.0]]))]
    [[[179.0, 10.0, 5.0], [180.0, 11.0, 6.0]], [[-180.0, 11.0, 6.0], [-178.0, 13.0, 8.0]]]
    """
    parts, line = [], places[:1]
    for before, after in pairwise(places):
        if abs(after[0] - before[0]) > _HALF_DEG:
            side = np.copysign(_HALF_DEG, before[0])
            unwrapped = after + [2 * side, 0.0, 0.0]
            crossing = before + (side - before[0]) / (unwrapped[0] - before[0]) * (unwrapped - before)
            parts.append(np.concatenate([line, [crossing]]))
            line = np.array([crossing - [2 * side, 0.0, 0.0]])
        line = np.concatenate([line, [after]])
    return [*parts, line]


def _feature(geometry: Mapping[str, Any] | None, properties: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _statistics(looks: NDArray[np.float32], transform: Affine) -> dict[str, Any]:
    covered_looks = looks[looks > 0]
    pixel_m2 = abs(transform.a * transform.e)
    if not covered_looks.size:
        return {"covered_share": 0.0, "area_m2": 0.0}
    return {
        "covered_share": round(covered_looks.size / looks.size, 4),
        "area_m2": float(f"{covered_looks.size * pixel_m2:.4g}"),
        "looks_median": round(float(np.median(covered_looks)), 1),
        "looks_most": round(float(covered_looks.max()), 1),
    }


def _rounded(places: NDArray[np.float64], *, heights: bool = False) -> list[list[float]]:
    """Round coordinates for GeoJSON: degrees and metres to about a millimetre."""
    return [[round(x, 8), round(y, 8), *([round(z, 3)] if heights else [])] for x, y, z in places.tolist()]


def write_coverage(
    path: Path,
    covered: Sequence[Covered],
    transform: Affine,
    *,
    crs_name: str,
    title: str,
    tags: Mapping[str, str],
    local: bool = False,
) -> None:
    """Plot the number of pulses at each point as a PNG, with a second map of the number of pairs or of the scene.

    The number of pairs is plotted if it varies within the scene. Footprints are plotted for up to eight flights.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    covered
        Coverage of each pair; the looks of all pairs have the same shape.
    transform
        Georeference of the looks on the map.
    crs_name
        Name of the map's CRS.
    title
        Title of the plot.
    tags
        Provenance, name → text; stored in the file.
    local
        True if the map is not georeferenced.
    """
    total = np.sum([coverage.looks for coverage in covered], axis=0)
    pairs = np.sum([coverage.looks > 0 for coverage in covered], axis=0)
    flights = {name: number for number, name in enumerate(dict.fromkeys(coverage.flight for coverage in covered))}
    bounds, scene = _bounds(covered, total.shape, transform), array_bounds(*total.shape, transform)
    small = max(scene[2] - scene[0], scene[3] - scene[1]) < _SMALL * max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    counts = np.unique(pairs[pairs > 0])
    looks_label = f"pulses per pixel{', all pairs' if len(covered) > 1 else ''}"
    with matplotlib.style.context("default"):
        has_two_maps, part = small or counts.size > 1, scene if small else None
        maps = [MapLayout.for_bounds(bounds, maps=2 if has_two_maps else 1, part=part, local=local)]
        _draw(maps[0], total, transform, "viridis", looks_label)
        if has_two_maps:
            maps.append(maps[0].beside(part))
        if counts.size > 1:
            _draw(maps[1], pairs, transform, "YlGnBu", f"pairs per pixel, out of {len(covered)}", counts=True)
        elif small:
            _draw(maps[1], total, transform, "viridis", f"{looks_label}, scene only")
        for number, layout in enumerate(maps):
            if len(flights) > _NAMED:
                _draw_overview(layout, covered, total, transform)
            else:
                _draw_lines(layout, covered, transform, flights)
            layout.draw_frame("" if number else crs_name)
        maps[0].draw_scale_and_north()
        if 1 < len(flights) <= _NAMED:
            samples = [Line2D([], [], color=_COLOURS[number]) for number in flights.values()]
            maps[0].draw_legend(samples, list(flights))
        share = f"{100 * float((pairs > 0).mean()):.1f} % of the scene is covered by {number_of(len(covered), 'pair')}"
        each = f", every covered pixel by {counts[0]}" if len(covered) > 1 and counts.size == 1 else ""
        thick = ", thick: used for the image" if any(coverage.imaged_m for coverage in covered) else ""
        footprints = "footprints" if len(flights) <= _NAMED else "edge of the covered area"
        lines = f"lines: tracks (dashed: receiver{thick}) and {footprints}"
        subtitle = f"{share} of {number_of(len(flights), 'flight')}{each}; {lines}"
        maps[0].write_words(title, subtitle, f"apertura {tags['APERTURA_VERSION']}")
        with replacement(path) as temporary:
            maps[0].figure.savefig(temporary, dpi=DPI, metadata={"Title": title, **dict(sorted(tags.items()))})


def _bounds(covered: Sequence[Covered], shape: tuple[int, ...], transform: Affine) -> tuple[float, float, float, float]:
    """Return west, south, east, north of the scene and all tracks, with a margin."""
    west, south, east, north = array_bounds(*shape, transform)
    corners = np.array([[west, south], [east, north]])
    tracks = (track[:, :2] for coverage in covered for track in coverage.tracks_m.values())
    points = np.concatenate([corners, *tracks])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = MARGIN * float((high - low).max())
    return (*(low - margin).tolist(), *(high + margin).tolist())


def _draw(
    layout: MapLayout, values: NDArray[Any], transform: Affine, colours: str, label: str, *, counts: bool = False
) -> None:
    west, south, east, north = array_bounds(*values.shape, transform)
    most = float(values.max()) or 1.0
    norm = BoundaryNorm(np.arange(0.5, most + 1), 256) if counts and most <= len(_COLOURS) else None
    picture = layout.axes.imshow(
        np.ma.masked_equal(values, 0),
        extent=(west, east, south, north),
        cmap=colours,
        interpolation="nearest",
        **({"norm": norm} if norm else {"vmin": 0, "vmax": most}),
    )
    bar = layout.draw_colour_bar(picture, label, beyond="neither")
    if counts:
        bar.locator = MaxNLocator(integer=True)
        bar.update_ticks()


def _draw_lines(layout: MapLayout, covered: Sequence[Covered], transform: Affine, flights: Mapping[str, int]) -> None:
    """Draw tracks and footprints in the colours of their flights."""
    for coverage in covered:
        colour = _COLOURS[flights[coverage.flight] % len(_COLOURS)]
        for style, (antenna, track_m) in zip(("-", "--"), coverage.tracks_m.items(), strict=False):
            imaged = coverage.imaged_m.get(antenna)
            layout.axes.plot(*track_m.T[:2], style, color=colour, linewidth=0.7 if imaged else 1.4)
            for leg_m in imaged or [track_m]:
                if imaged:
                    layout.axes.plot(*leg_m.T[:2], style, color=colour, linewidth=2.2)
                _draw_direction(layout, leg_m, colour)
        for rings in footprint(coverage.looks, transform):
            for ring in rings:
                layout.axes.plot(*ring.T, color=colour, alpha=0.8, linewidth=1.2)


def _draw_overview(
    layout: MapLayout, covered: Sequence[Covered], total: NDArray[np.float32], transform: Affine
) -> None:
    """Draw the tracks of more than `_NAMED` flights in a single colour, and the edge of the area covered by them."""
    line: dict[str, Any] = {"color": "0.45", "alpha": 0.6, "linewidth": 0.7}
    for coverage in covered:
        for style, track_m in zip(("-", "--"), coverage.tracks_m.values(), strict=False):
            layout.axes.plot(*track_m.T[:2], style, **line)
    for rings in footprint(total, transform):
        for ring in rings:
            layout.axes.plot(*ring.T, color="black", linewidth=1.0)


def _draw_direction(layout: MapLayout, leg_m: NDArray[np.float64], colour: Any) -> None:
    """Draw an arrow in the direction of flight at the centre of a track segment."""
    middle = max(1, len(leg_m) // 2)
    if len(leg_m) > 1 and (leg_m[middle, :2] != leg_m[middle - 1, :2]).any():
        arrow = {"arrowstyle": "-|>", "color": colour, "mutation_scale": 12}
        ends = [(float(x), float(y)) for x, y in leg_m[middle - 1 : middle + 1, :2]]
        layout.axes.annotate("", ends[1], ends[0], arrowprops=arrow)
