"""What a scene's CRS must be: known to PROJ, projected in metres, and in use where the scene lies."""

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from apertura.errors import CampaignError

_WHERE = "scene"


def check_crs(crs: str, bounds_m: tuple[float, float, float, float]) -> None:
    """Raise CampaignError unless `crs` is projected in metres and its area of use holds the bounds.

    Parameters
    ----------
    crs
        What pyproj reads.
    bounds_m
        xmin, ymin, xmax, ymax, metres.

    Examples
    --------
    >>> check_crs("EPSG:32632", (5e5, 5e6, 5e5 + 10, 5e6 + 10))
    >>> check_crs("EPSG:4326", (0, 0, 1, 1))
    Traceback (most recent call last):
    ...
    apertura.errors.CampaignError: scene: crs EPSG:4326 (WGS 84) is not projected in metres; ...
    """
    try:
        system = CRS(crs)
    except CRSError as error:
        raise CampaignError(
            f"crs {crs!r} is unknown to PROJ",
            where=_WHERE,
            expected="an EPSG code such as EPSG:32632, auto, or local",
            remedy="Correct scene.crs.",
        ) from error
    if not system.is_projected or any(axis.unit_name != "metre" for axis in system.axis_info):
        raise CampaignError(
            f"crs {crs} ({system.name}) is not projected in metres",
            where=_WHERE,
            expected="a projected CRS in metres, such as a UTM zone",
            remedy="Choose another scene.crs.",
        )
    _check_area_of_use(system, bounds_m)


def _check_area_of_use(system: CRS, bounds_m: tuple[float, float, float, float]) -> None:
    area = system.area_of_use
    if area is None:
        return
    inverse = Transformer.from_crs(system, system.geodetic_crs, always_xy=True)
    xmin, ymin, xmax, ymax = bounds_m
    longitude, latitude = inverse.transform([xmin, xmax, xmin, xmax], [ymin, ymin, ymax, ymax])
    for lon, lat in zip(longitude, latitude, strict=True):
        if not (np.isfinite(lon) and area.west <= lon <= area.east and area.south <= lat <= area.north):
            raise CampaignError(
                f"bounds_m {list(bounds_m)} reach longitude {lon:.4f}, latitude {lat:.4f}",
                where=_WHERE,
                expected=f"inside the area of use of {system.name}: longitude {area.west} to {area.east}, "
                f"latitude {area.south} to {area.north}",
                remedy="Correct scene.bounds_m (easting before northing) or scene.crs.",
            )
