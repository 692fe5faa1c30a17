"""CRS of a scene: checks, CF attributes, and ECEF positions of the pixels of a grid."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.enums import TransformDirection
from pyproj.exceptions import ProjError

from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import ecef_from_geodetic, ecef_from_projected, projected_from_ecef

# ---- Checks of the CRS of a scene

MARGIN_DEG = 3.0
"""Largest accepted distance of a scene from the area of use of its projection, degrees: half a UTM zone, where the
scale error is 0.5 %."""

RETURN_M = 1e-3
"""Round-trip error of a projection, metres, above which a point is outside the domain of the projection."""

_WHERE = "scene"


def grid_mapping(crs_wkt: str) -> dict[str, str | float]:
    """Return the attributes of a CF grid mapping: the unchanged WKT of the CRS, and the named parameters of the CRS.

    Examples
    --------
    >>> grid_mapping(CRS("EPSG:32632").to_wkt())["grid_mapping_name"]
    'transverse_mercator'
    >>> grid_mapping('LOCAL_CS["local",UNIT["metre",1]]')
    {'crs_wkt': 'LOCAL_CS["local",UNIT["metre",1]]'}
    """
    return {**CRS(crs_wkt).to_cf(), "crs_wkt": crs_wkt}


def axis_attributes(side: str, *, projected: bool) -> dict[str, str]:
    """Return the CF attributes of coordinate 'x' or 'y' of a raster.

    Examples
    --------
    >>> axis_attributes("x", projected=False)
    {'units': 'm', 'axis': 'X', 'long_name': 'x'}
    """
    standard = {"standard_name": f"projection_{side}_coordinate"} if projected else {}
    name = {"x": "easting", "y": "northing"}[side] if projected else side
    return {"units": "m", "axis": side.upper(), "long_name": name, **standard}


def horizontal_crs(crs: str) -> CRS:
    """Return a horizontal CRS; raise CampaignError if the CRS is unknown to PROJ or has a vertical component.

    Examples
    --------
    >>> horizontal_crs("EPSG:5555")
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: scene: crs EPSG:5555 (ETRS89 / UTM zone 32N + DHHN92 height) includes ...
    """
    try:
        system = CRS(crs)
    except ProjError as error:
        raise CampaignError(
            f"crs {crs!r} is unknown to PROJ",
            where=_WHERE,
            expected="an EPSG code such as EPSG:32632, auto, or local",
            remedy="Correct scene.crs.",
        ) from error
    if system.is_compound:
        horizontal = system.sub_crs_list[0]
        raise CampaignError(
            f"crs {crs} ({system.name}) includes a vertical CRS",
            where=_WHERE,
            expected="a horizontal CRS, because the datum of heights is configured by height_datum or dem_datum",
            remedy=f"Set scene.crs to {':'.join(horizontal.to_authority() or (horizontal.name,))}.",
        )
    return system


def check_crs(crs: str, bounds_m: tuple[float, float, float, float]) -> None:
    """Raise CampaignError if `crs` is not projected in metres or not usable at the bounds.

    Parameters
    ----------
    crs
        A pyproj definition.
    bounds_m
        xmin, ymin, xmax, ymax, metres.

    Examples
    --------
    >>> check_crs("EPSG:32632", (5e5, 5e6, 5e5 + 10, 5e6 + 10))
    >>> check_crs("EPSG:4326", (0, 0, 1, 1))
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: scene: crs EPSG:4326 (WGS 84) is not projected in metres; ...
    """
    system = horizontal_crs(crs)
    if not system.is_projected or any(axis.unit_name != "metre" for axis in system.axis_info):
        raise CampaignError(
            f"crs {crs} ({system.name}) is not projected in metres",
            where=_WHERE,
            expected="a projected CRS in metres, such as a UTM zone",
            remedy="Set scene.crs to a projected CRS in metres.",
        )
    try:
        _check_usable(system, bounds_m)
        projected_from_ecef(crs, ecef_from_geodetic(*(np.array(angle) for angle in (0.0, 0.0, 0.0))))
    except ProjError as error:  # for instance a datum that requires a grid of datum shifts
        raise CampaignError(
            f"this installation of PROJ has no exact transformation from {crs} ({system.name}) to WGS 84",
            where=_WHERE,
            expected="a CRS with a parametric transformation to WGS 84, or with installed datum shift grids",
            remedy="Install the grid with `projsync`, or set scene.crs to another CRS, such as the local UTM zone.",
        ) from error


def _check_usable(system: CRS, bounds_m: tuple[float, float, float, float]) -> None:
    """Raise CampaignError if a corner is outside the domain of the projection or far from its area of use."""
    area = system.area_of_use
    inverse = Transformer.from_crs(system, system.geodetic_crs, always_xy=True)
    xmin, ymin, xmax, ymax = bounds_m
    corners = np.array([[xmin, xmax, xmin, xmax], [ymin, ymin, ymax, ymax]])
    longitudes, latitudes = inverse.transform(corners[0], corners[1])
    returned = np.array(inverse.transform(longitudes, latitudes, direction=TransformDirection.INVERSE))
    finite = np.where(np.isfinite(returned), returned, np.nan)
    usable = (np.abs(finite - corners) < RETURN_M).all(axis=0)  # False for NaN
    if area is not None:
        usable &= _near(area.bounds, longitudes, latitudes)
    if usable.all():
        return
    first = int(np.argmin(usable))
    near_area = ""
    if area is not None:
        near_area = (
            f"within {MARGIN_DEG:g} degrees of the area of use of {system.name}: "
            f"longitude {area.west} to {area.east}, latitude {area.south} to {area.north}"
        )
    raise CampaignError(
        f"bounds_m {list(bounds_m)} reach longitude {longitudes[first]:.4f}, latitude {latitudes[first]:.4f}",
        where=_WHERE,
        expected=near_area or f"bounds within the domain of {system.name}",
        remedy="Correct scene.bounds_m (easting before northing) or scene.crs.",
    )


def _near(
    area_deg: tuple[float, float, float, float], longitude: NDArray[np.float64], latitude: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return a mask of points within `MARGIN_DEG` of an area (west, south, east, north), which may extend over 180°."""
    west, south, east, north = area_deg
    width = (east - west) % 360 or 360.0
    longitude = np.where(np.isfinite(longitude), longitude, np.nan)
    inside = (longitude - west + MARGIN_DEG) % 360 <= width + 2 * MARGIN_DEG
    return np.asarray(inside & (latitude >= south - MARGIN_DEG) & (latitude <= north + MARGIN_DEG))


# ---- Positions of the pixels of a projected grid
# The transformation of a pixel by PROJ takes as long as the integration of hundreds of pulses at this pixel. Over a
# block of pixels, polynomials of degree four are as accurate as positions in float64
# (docs/theory/planner.md, "Pixel positions").

BLOCK_PX = 256

DEGREE = 4

TOLERANCE_M = 3e-8
"""Error of the polynomials of a block between nodes, metres, above which each pixel is transformed with PROJ; the
rounding error of float64 is 1e-9 m."""

# metres between two evaluated heights, which are sufficient because ECEF is exactly linear in ellipsoidal height
_CLIMB_M = 1e4
_NODES = np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
_BETWEEN = np.array([-1.0, -0.5, 0.45, 1.0])


@dataclass(frozen=True, eq=False)
class Block:
    """Polynomials of the positions of BLOCK_PX × BLOCK_PX pixels over -1 ≤ u, v ≤ 1, u downward and v to the right.

    Attributes
    ----------
    middle_m
        (3,) float64, centre of the block on the ellipsoid, ECEF metres.
    offset_m, normal
        (DEGREE + 1, DEGREE + 1, 3) float64, coefficients of u^k v^l: positions on the ellipsoid relative to the centre,
        ECEF metres; and change of the positions per metre of height.
    exact
        True if the polynomials are within `TOLERANCE_M` of PROJ.
    """

    middle_m: NDArray[np.float64]
    offset_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    exact: bool

    def positions(
        self, row: NDArray[np.int64], column: NDArray[np.int64], height_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the positions of pixels, (row, column, 3) float64, ECEF metres.

        Parameters
        ----------
        row, column
            (row,) and (column,) int64, counted from the corner of the block.
        height_m
            () or (row, column) float64, ellipsoidal height of all pixels, or of each pixel.
        """
        down, right = ((2 * index + 1) / BLOCK_PX - 1 for index in (row, column))
        if height_m.ndim == 0:  # for a constant height, only one polynomial is evaluated
            return _evaluated(self.offset_m + height_m * self.normal, down, right) + self.middle_m
        offset = _evaluated(self.offset_m, down, right)
        offset += height_m[..., None] * _evaluated(self.normal, down, right)
        return offset + self.middle_m


@lru_cache(maxsize=4096)
def block(crs: str, north_west_m: tuple[float, float], spacing_m: float, index: tuple[int, int]) -> Block:
    """Return the polynomials of a block of a grid.

    Parameters
    ----------
    crs
        Projected CRS in metres.
    north_west_m
        Northing and easting of the outer north-west corner of the grid.
    spacing_m
        Pixel spacing.
    index
        Row and column of the block in the grid.

    Examples
    --------
    >>> corner = block("EPSG:32632", (5e6, 5e5), 0.5, (0, 0))
    >>> corner.exact, corner.positions(np.arange(2), np.arange(3), np.array(100.0)).shape
    (True, (2, 3, 3))
    """
    side_m = BLOCK_PX * spacing_m
    north_m, west_m = north_west_m[0] - index[0] * side_m, north_west_m[1] + index[1] * side_m

    def proj(nodes: NDArray[np.float64], height: float) -> NDArray[np.float64]:
        down, right = np.meshgrid((nodes + 1) * side_m / 2, (nodes + 1) * side_m / 2, indexing="ij")
        return ecef_from_projected(crs, west_m + right, north_m - down, np.full(down.shape, height))

    surface, above = proj(_NODES, 0.0), proj(_NODES, _CLIMB_M)
    middle_m = surface[DEGREE // 2, DEGREE // 2]
    inverse = np.linalg.inv(np.vander(_NODES, increasing=True))
    offset, normal = (
        np.einsum("ki,lj,ijc->klc", inverse, inverse, values)
        for values in (surface - middle_m, (above - surface) / _CLIMB_M)
    )
    between = _evaluated(offset, _BETWEEN, _BETWEEN) + middle_m
    worst = np.abs(between - proj(_BETWEEN, 0.0)).max()
    return Block(middle_m, offset, normal, bool(worst < TOLERANCE_M))


def _evaluated(
    coefficients: NDArray[np.float64], down: NDArray[np.float64], right: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Evaluate Σ c_kl u^k v^l by Horner's rule, element by element, so that results are bit-identical in any window."""
    along = coefficients[:, -1, None]
    for power in range(DEGREE - 1, -1, -1):
        along = along * right[:, None] + coefficients[:, power, None]
    total = np.broadcast_to(along[-1], (len(down), *along[-1].shape))
    for power in range(DEGREE - 1, -1, -1):
        total = total * down[:, None, None] + along[power]
    return total
