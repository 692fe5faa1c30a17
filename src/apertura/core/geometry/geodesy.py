"""Geodetic, projected and Earth-centred coordinates, and rotations of body axes.

Positions are processed in ECEF (EPSG:4978) in float64, so that no zones, scale factors or Earth curvature need to be
modelled.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer

from apertura.common.errors import CampaignError

ECEF = "EPSG:4978"
GEODETIC = "EPSG:4979"
_PLANE = "EPSG:4326"

LOCAL = "local"
"""CRS of a frame without a geodetic position: x east, y north, z up, metres."""

LOCAL_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""North, east and down unit vectors in a local frame, as columns."""

Positions = NDArray[np.float64]


def ecef_from_geodetic(latitude_deg: Positions, longitude_deg: Positions, height_m: Positions) -> Positions:
    """Convert WGS 84 latitude, longitude and ellipsoidal height to ECEF positions.

    Parameters
    ----------
    latitude_deg, longitude_deg
        (...,) float64, degrees, positive to the north and to the east.
    height_m
        (...,) float64, metres above the ellipsoid.

    Returns
    -------
    ndarray
        (..., 3) float64, metres, ECEF.

    Examples
    --------
    >>> ecef_from_geodetic(np.array(0.0), np.array(0.0), np.array(10.0))
    array([6378147.,       0.,       0.])
    """
    transformer = _transformer(GEODETIC, ECEF)
    return np.stack(transformer.transform(latitude_deg, longitude_deg, height_m), axis=-1)


def geodetic_from_ecef(position: Positions) -> Positions:
    """Convert ECEF positions (m) to latitude (deg), longitude (deg) and ellipsoidal height (m), (..., 3) float64.

    Examples
    --------
    >>> geodetic_from_ecef(np.array([6378147.0, 0.0, 0.0])).round(6) + 0.0
    array([ 0.,  0., 10.])
    """
    transformer = _transformer(ECEF, GEODETIC)
    return np.stack(transformer.transform(*np.moveaxis(position, -1, 0)), axis=-1)


def ecef_from_projected(crs: str, x: Positions, y: Positions, height_m: Positions) -> Positions:
    """Convert easting, northing in `crs` and ellipsoidal height (m) to ECEF positions (m), (..., 3) float64.

    Parameters
    ----------
    crs
        Any definition of a georeferenced CRS that pyproj reads.
    x, y
        (...,) float64, easting and northing, metres, regardless of the axis order of the CRS.
    height_m
        (...,) float64, metres above the WGS 84 ellipsoid, regardless of the ellipsoid of `crs`.

    Raises
    ------
    CampaignError
        If PROJ has no exact transformation from `crs` to ECEF, or if a transformed position is infinite.

    Examples
    --------
    >>> ecef_from_projected("EPSG:32632", *map(np.array, (500000.0, 0.0, 0.0))).round(2) + 0.0
    array([6299611.55,  997760.45,       0.  ])
    """
    if is_on_wgs84(crs):
        position = np.stack(_transformer(crs, ECEF).transform(x, y, height_m), axis=-1)
    else:  # transform horizontal coordinates only: heights above the ellipsoid of `crs` differ by tens of metres
        longitude, latitude = _transformer(crs, _PLANE).transform(x, y)
        position = ecef_from_geodetic(latitude, longitude, height_m)
    if not np.isfinite(position).all():
        raise CampaignError(
            f"positions outside the domain of the projection of {crs}",
            where="scene",
            expected="coordinates within the area of use of the CRS",
            remedy="Check scene.crs and scene.bounds_m.",
        )
    return position


def projected_from_ecef(crs: str, position: Positions) -> Positions:
    """Convert ECEF positions (m) to easting, northing in `crs` and height above WGS 84 (m), (..., 3) float64."""
    if is_on_wgs84(crs):
        return np.stack(_transformer(ECEF, crs).transform(*np.moveaxis(position, -1, 0)), axis=-1)
    latitude, longitude, height_m = np.moveaxis(geodetic_from_ecef(position), -1, 0)
    return np.stack([*_transformer(_PLANE, crs).transform(longitude, latitude), height_m], axis=-1)


@lru_cache(maxsize=64)
def is_on_wgs84(crs: str) -> bool:
    """Return True if the ellipsoid of a CRS is WGS 84, or GRS 80, whose semi-minor axis differs by 0.1 mm.

    Examples
    --------
    >>> is_on_wgs84("EPSG:25832"), is_on_wgs84("EPSG:31467")  # ETRS89; DHDN, on Bessel's ellipsoid
    (True, False)
    """
    ellipsoid = CRS(crs).ellipsoid
    return ellipsoid is None or (
        abs(ellipsoid.semi_major_metre - 6_378_137) < 0.1 and abs(ellipsoid.inverse_flattening - 298.2572) < 1e-3
    )


def longitude_range(longitude_deg: NDArray[np.float64]) -> tuple[float, float]:
    """Return the westernmost and easternmost longitude, within -180 to 180°; west > east across the antimeridian.

    The range excludes the widest gap between neighbouring longitudes on the circle (RFC 7946, section 5.2).

    Examples
    --------
    >>> longitude_range(np.array([9.0, 10.0, 9.5])), longitude_range(np.array([179.9, -179.8, 180.0]))
    ((9.0, 10.0), (179.9, -179.8))
    """
    ordered = np.sort(longitude_deg)
    gaps = np.append(np.diff(ordered), ordered[0] + 360 - ordered[-1])
    last = int(gaps[::-1].argmax())  # if gaps are equal, the gap across the antimeridian is selected
    end = len(ordered) - 1 - last
    return float(ordered[(end + 1) % len(ordered)]), float(ordered[end])


def longitudes_about(longitude_deg: NDArray[np.float64], middle_deg: float) -> NDArray[np.float64]:
    """Return longitudes without wraps, within 180° of a reference longitude.

    Examples
    --------
    >>> longitudes_about(np.array([179.5, -179.5]), 180.0)
    array([179.5, 180.5])
    """
    return np.asarray((longitude_deg - middle_deg + 180) % 360 - 180 + middle_deg)


def frame_from_map(crs: str, x: ArrayLike, y: ArrayLike, height_m: ArrayLike) -> Positions:
    """Convert map coordinates to positions in the processing frame (ECEF or local), (..., 3) float64, metres.

    Parameters
    ----------
    crs
        CRS as for `ecef_from_projected`, or 'local'.
    x, y
        (...,) float64, metres, easting and northing.
    height_m
        (...,) float64, metres above the ellipsoid of WGS 84, or z of the local frame.

    Raises
    ------
    CampaignError
        As for `ecef_from_projected`.

    Examples
    --------
    >>> frame_from_map("local", [1.0, 2.0], 5.0, 0.5)
    array([[1. , 5. , 0.5],
           [2. , 5. , 0.5]])
    """
    coordinates = np.broadcast_arrays(*(np.asarray(value, np.float64) for value in (x, y, height_m)))
    return np.stack(coordinates, axis=-1) if crs == LOCAL else ecef_from_projected(crs, *coordinates)


def map_from_frame(crs: str, position: Positions) -> Positions:
    """Convert positions in the processing frame to easting, northing and height (m), (..., 3) float64.

    Examples
    --------
    >>> position = frame_from_map("EPSG:32632", 500000.0, 5300000.0, 700.0)
    >>> map_from_frame("EPSG:32632", position).round(6)
    array([5.0e+05, 5.3e+06, 7.0e+02])
    """
    return position if crs == LOCAL else projected_from_ecef(crs, position)


@lru_cache(maxsize=64)
def _transformer(source: str, target: str) -> Transformer:
    """Return the PROJ transformer between two CRSs, cached because the creation of a transformer takes milliseconds."""
    if GEODETIC in (source, target):
        return Transformer.from_crs(source, target)
    if _PLANE in (source, target):
        return Transformer.from_crs(source, target, always_xy=True, allow_ballpark=False)
    source_3d, target_3d = (system if system == ECEF else CRS(system).to_3d() for system in (source, target))
    return Transformer.from_crs(source_3d, target_3d, always_xy=True, allow_ballpark=False)


def ned_axes(position: Positions) -> NDArray[np.float64]:
    """Return the local geodetic north, east and down unit vectors at ECEF positions.

    Parameters
    ----------
    position
        (..., 3) float64, metres, ECEF.

    Returns
    -------
    ndarray
        (..., 3, 3) float64; columns are north, east and down in ECEF. Each matrix is the rotation from NED to ECEF.

    Examples
    --------
    >>> ned_axes(np.array([6378137.0, 0.0, 0.0])) @ [0.0, 0.0, 1.0] + 0.0
    array([-1.,  0.,  0.])
    """
    latitude, longitude = np.moveaxis(np.radians(geodetic_from_ecef(position)[..., :2]), -1, 0)
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], -1)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(cos_lon)], -1)
    down = np.stack([-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat], -1)
    return np.stack([north, east, down], axis=-1)


def body_axes(attitude_rad: Positions) -> NDArray[np.float64]:
    """Return the rotations from body axes (forward, right, down) to NED: Rz(yaw)·Ry(pitch)·Rx(roll).

    Parameters
    ----------
    attitude_rad
        (..., 3) float64: roll, pitch and yaw in radians, with yaw clockwise from north.

    Returns
    -------
    ndarray
        (..., 3, 3) float64.

    Examples
    --------
    >>> (body_axes(np.radians([0.0, 0.0, 90.0])) @ [1.0, 0.0, 0.0]).round(12) + 0.0  # nose east
    array([0., 1., 0.])
    """
    from scipy.spatial.transform import Rotation  # slow to import, and rarely needed

    flat = np.reshape(attitude_rad, (-1, 3))
    matrices = Rotation.from_euler("ZYX", flat[:, ::-1]).as_matrix()
    return np.asarray(matrices.reshape(*np.shape(attitude_rad)[:-1], 3, 3))


def local_crs(name: str) -> str:
    """Return an engineering CRS for a frame without a geodetic position.

    The format is WKT 1, because GeoTIFF does not preserve the ENGCRS of WKT 2.

    Examples
    --------
    >>> local_crs("gotcha")
    'LOCAL_CS["gotcha",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    """
    return f'LOCAL_CS["{name}",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
