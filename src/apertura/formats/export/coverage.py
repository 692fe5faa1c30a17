"""Coverage of a campaign: looks, pairs, footprints and tracks as a picture and for a GIS."""

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
"""Left free around tracks and scene, of the longer side."""

_NAMED = 8  # flights that are told apart by colours; tracks of more are one colour
_HALF_DEG = 180.0  # of longitude: neighbours farther apart lie on both sides of the antimeridian
_SMALL = 0.25  # of the map's longer side: a smaller scene is drawn once more by itself
_COLOURS = tuple(colormaps["tab10"](number) for number in range(10))

Ring = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Covered:
    """Coverage of one pair of a flight.

    Attributes
    ----------
    flight, pair
        Which.
    tracks_m
        Antenna (transmitter, receiver) → (vertex, 3) float64, easting, northing and height on the map, metres.
    looks
        (row, column) float32, pulses that make each place of the scene, 0 where none does.
    imaged_m
        Antenna → what of its track makes the image, a list of (vertex, 2 or 3), metres; where that is not all of it.
    """

    flight: str
    pair: str
    tracks_m: Mapping[str, NDArray[np.float64]]
    looks: NDArray[np.float32]
    imaged_m: Mapping[str, Sequence[NDArray[np.float64]]] = field(default_factory=dict)


def footprint(looks: NDArray[np.float32], transform: Affine) -> list[list[Ring]]:
    """Return polygons about the places that pulses make: rings (vertex, 2) of map metres, the outer one first.

    Outer rings turn left, holes right, each ends where it begins, as GeoJSON requires.

    Examples
    --------
    >>> rings = footprint(np.array([[0, 5.0], [0, 5.0]], np.float32), Affine(2, 0, 100, 0, -2, 50))
    >>> rings[0][0].tolist()
    [[102.0, 46.0], [104.0, 46.0], [104.0, 50.0], [102.0, 50.0], [102.0, 46.0]]
    """
    covered = looks > 0
    found = shapes(covered.astype(np.uint8), mask=covered, transform=transform)
    return [
        [_turned(np.asarray(ring, np.float64), left=number == 0) for number, ring in enumerate(shape["coordinates"])]
        for shape, _ in found
    ]


def _turned(ring: Ring, *, left: bool) -> Ring:
    x, y = (ring - ring[0]).T
    turns_left = float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) > 0
    ring = ring if turns_left == left else ring[::-1]
    lowest = int(np.lexsort((ring[:-1, 0], ring[:-1, 1]))[0])  # the same vertex first, however it was traced
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
        Of each pair.
    transform
        Of its looks, on the map.
    place
        Map (n, 3), metres → longitude and latitude (deg, WGS 84) and height (m), (n, 3); None where the map has no
        place on Earth: geometries are then null.
    height_m
        Of the footprints, for `place`.
    """
    features = []
    for one in covered:
        named = {"flight": one.flight, "pair": one.pair}
        for antenna, track_m in one.tracks_m.items():
            line = None
            if place is not None:
                parts = [_rounded(part, heights=True) for part in cut_line(place(track_m))]
                whole = len(parts) == 1
                kind, at = ("LineString", parts[0]) if whole else ("MultiLineString", parts)
                line = {"type": kind, "coordinates": at}
            features.append(_feature(line, {"kind": "track", "antenna": antenna, **named}))
        area = None
        if place is not None:
            areas = placed_footprint(one.looks, transform, place, height_m=height_m)
            area = {"type": "MultiPolygon", "coordinates": [[_rounded(ring) for ring in rings] for rings in areas]}
        features.append(_feature(area, {"kind": "footprint", **named, **_statistics(one.looks, transform)}))
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
        As of `footprint`.
    place, height_m
        As of `feature_collection`.
    """

    def placed(ring: Ring) -> Ring:
        return place(np.c_[ring, np.full(len(ring), height_m)])

    polygons = [[placed(ring) for ring in rings] for rings in footprint(looks, transform)]
    if not any(np.ptp(ring[:, 0]) > _HALF_DEG for rings in polygons for ring in rings):
        return polygons
    # Each side has the pixels that reach into it; what of them lies beyond is moved onto the antimeridian.
    down, right = np.mgrid[: looks.shape[0] + 1, : looks.shape[1] + 1]
    corners = np.stack(transform @ (right.ravel(), down.ravel()), -1)
    east_of = (placed(corners)[:, 0] % 360 - _HALF_DEG).reshape(down.shape)
    of_pixel = np.stack([east_of[:-1, :-1], east_of[1:, :-1], east_of[:-1, 1:], east_of[1:, 1:]])
    cut = []
    for side, there in ((-1, of_pixel.min(axis=0) < 0), (1, of_pixel.max(axis=0) > 0)):
        for rings in footprint(np.where(there, looks, 0), transform):
            parts = [placed(ring) for ring in rings]
            for ring in parts:
                beyond = ring[:, 0] % 360 - _HALF_DEG
                ring[:, 0] = side * np.maximum(side * beyond, 0.0) - side * _HALF_DEG
            cut.append(parts)
    return cut


def cut_line(places: Ring) -> list[Ring]:
    """Return a line of longitude, latitude and height in parts that end at the antimeridian (RFC 7946, 3.1.9).

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
    """Return places as GeoJSON writes them: degrees to a millimetre, and metres."""
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
    """Draw as a PNG the pulses of all pairs at each place, and beside it how many pairs see it, or the scene by itself.

    The number of pairs is drawn where it differs from place to place, and footprints of up to eight flights each.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    covered
        Of each pair; their looks have one shape.
    transform
        Of the looks, on the map.
    crs_name
        Of the map.
    title
        What is drawn.
    tags
        Provenance, name → text; lies in the file.
    local
        Whether the map has no place on Earth.
    """
    total = np.sum([one.looks for one in covered], axis=0)
    pairs = np.sum([one.looks > 0 for one in covered], axis=0)
    flights = {name: number for number, name in enumerate(dict.fromkeys(one.flight for one in covered))}
    bounds, scene = _bounds(covered, total.shape, transform), array_bounds(*total.shape, transform)
    small = max(scene[2] - scene[0], scene[3] - scene[1]) < _SMALL * max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    counts = np.unique(pairs[pairs > 0])
    looks_label = f"pulses that make a pixel{', all pairs' if len(covered) > 1 else ''}"
    with matplotlib.style.context("default"):
        several, part = small or counts.size > 1, scene if small else None
        maps = [MapLayout.for_bounds(bounds, maps=2 if several else 1, part=part, local=local)]
        _draw(maps[0], total, transform, "viridis", looks_label)
        if several:
            maps.append(maps[0].beside(part))
        if counts.size > 1:
            _draw(maps[1], pairs, transform, "YlGnBu", f"pairs that see a pixel, of {len(covered)}", counts=True)
        elif small:
            _draw(maps[1], total, transform, "viridis", f"{looks_label}, the scene alone")
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
        share = f"{100 * float((pairs > 0).mean()):.1f} % of the scene is seen by {number_of(len(covered), 'pair')}"
        each = f", each place of it by {counts[0]}" if len(covered) > 1 and counts.size == 1 else ""
        thick = ", thick: makes the image" if any(one.imaged_m for one in covered) else ""
        footprints = "footprints" if len(flights) <= _NAMED else "edge of what is seen"
        lines = f"lines: tracks (dashed: receiver{thick}) and {footprints}"
        subtitle = f"{share} of {number_of(len(flights), 'flight')}{each}; {lines}"
        maps[0].write_words(title, subtitle, f"apertura {tags['APERTURA_VERSION']}")
        with replacement(path) as temporary:
            maps[0].figure.savefig(temporary, dpi=DPI, metadata={"Title": title, **dict(sorted(tags.items()))})


def _bounds(covered: Sequence[Covered], shape: tuple[int, ...], transform: Affine) -> tuple[float, float, float, float]:
    """Return west, south, east, north of the scene and all tracks, and a margin."""
    west, south, east, north = array_bounds(*shape, transform)
    corners = np.array([[west, south], [east, north]])
    places = np.concatenate([corners, *(track[:, :2] for one in covered for track in one.tracks_m.values())])
    low, high = places.min(axis=0), places.max(axis=0)
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
    for one in covered:
        colour = _COLOURS[flights[one.flight] % len(_COLOURS)]
        for style, (antenna, track_m) in zip(("-", "--"), one.tracks_m.items(), strict=False):
            imaged = one.imaged_m.get(antenna)
            layout.axes.plot(*track_m.T[:2], style, color=colour, linewidth=0.7 if imaged else 1.4)
            for leg_m in imaged or [track_m]:
                if imaged:
                    layout.axes.plot(*leg_m.T[:2], style, color=colour, linewidth=2.2)
                _draw_way(layout, leg_m, colour)
        for rings in footprint(one.looks, transform):
            for ring in rings:
                layout.axes.plot(*ring.T, color=colour, alpha=0.8, linewidth=1.2)


def _draw_overview(
    layout: MapLayout, covered: Sequence[Covered], total: NDArray[np.float32], transform: Affine
) -> None:
    """Draw tracks of many flights in one colour, and the edge of what any of them sees."""
    line: dict[str, Any] = {"color": "0.45", "alpha": 0.6, "linewidth": 0.7}
    for one in covered:
        for style, track_m in zip(("-", "--"), one.tracks_m.values(), strict=False):
            layout.axes.plot(*track_m.T[:2], style, **line)
    for rings in footprint(total, transform):
        for ring in rings:
            layout.axes.plot(*ring.T, color="black", linewidth=1.0)


def _draw_way(layout: MapLayout, leg_m: NDArray[np.float64], colour: Any) -> None:
    """Point an arrow the way that a leg is flown, in its middle."""
    middle = max(1, len(leg_m) // 2)
    if len(leg_m) > 1 and (leg_m[middle, :2] != leg_m[middle - 1, :2]).any():
        arrow = {"arrowstyle": "-|>", "color": colour, "mutation_scale": 12}
        ends = [(float(x), float(y)) for x, y in leg_m[middle - 1 : middle + 1, :2]]
        layout.axes.annotate("", ends[1], ends[0], arrowprops=arrow)
