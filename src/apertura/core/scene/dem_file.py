"""A DEM file opened: where its posts lie and what its heights count from, or what is wrong with it."""

import re
from pathlib import Path

import numpy as np
from pyproj import CRS
from pyproj.exceptions import ProjError

from apertura.common.errors import CampaignError, shown
from apertura.common.raster import opened_raster
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.scene.dem import Dem
from apertura.core.scene.geoid import carried_datum, geoid_file, grid_names
from apertura.core.scene.grid import SceneGrid

_EXPECTED = "the DEM of scene.dem, a GeoTIFF of heights"
NAMES_FILES = re.compile(r'\+proj=|grids=|init=|"PROJ4"|PARAMETERFILE\["[^"]*","[^"]*[/\\:~]', re.IGNORECASE)
"""What in a CRS (WKT) leads PROJ to a file other than the grids in its own folders."""

_REMEDY = "Correct the DEM, or scene.dem and scene.dem_datum (from Python: path and datum)."


def open_dem(
    path: str | Path, scene: str | SceneGrid, *, datum: str = "carried", geoid: str | Path | None = None
) -> Dem:
    """Return a DEM as the ground of a scene, whatever CRS the raster is in.

    Parameters
    ----------
    path
        A GeoTIFF, heights in band 1; files beside it (.aux.xml, .ovr, .tfw) count for nothing.
    scene
        The grid that the DEM must reach over; or the CRS alone, what pyproj reads or 'local', of whatever grid is read.
    datum
        What the heights count from: 'ellipsoid', 'egm96', 'egm2008', or 'carried' (the raster's CRS says it; in a local
        scene: z of the frame).
    geoid
        Grid of undulations; looked for on PROJ's search path if None.

    Raises
    ------
    CampaignError
        If the file is no DEM, its CRS says otherwise than `datum` or nothing, the grid of undulations is not here, or
        the DEM ends inside the scene.

    Examples
    --------
    A DEM in UTM whose heights are ellipsoidal, under a scene of 4 × 4 pixels:

    >>> import numpy as np, rasterio
    >>> from tempfile import TemporaryDirectory
    >>> kind = {"width": 9, "height": 9, "count": 1, "dtype": "float32", "crs": "EPSG:32632"}
    >>> place = rasterio.Affine(5, 0, 500000, 0, -5, 5400045)
    >>> with TemporaryDirectory() as folder:
    ...     with rasterio.open(f"{folder}/dem.tif", "w", "GTiff", transform=place, **kind) as raster:
    ...         raster.write(np.full((9, 9), 612.5, np.float32), 1)
    ...     grid = SceneGrid("EPSG:32632", 500020.0, 5400020.0, 0.5, (4, 4))
    ...     float(open_dem(f"{folder}/dem.tif", grid, datum="ellipsoid").heights(grid)[0, 0])
    612.5
    """
    crs = scene if isinstance(scene, str) else scene.crs
    dem = _dem(Path(path), crs, datum=datum, geoid=None if geoid is None else Path(geoid))
    if not isinstance(scene, str):
        dem.check_cover(scene)
    return dem


def _dem(path: Path, crs: str, *, datum: str, geoid: Path | None) -> Dem:
    pixel_from_map, shape, unit, system = _header(path)
    if crs == LOCAL:
        if system is not None and (system.is_geographic or system.is_projected):
            raise _wrong(path, f"CRS {system.name} under a scene in the local frame", "a DEM in the frame's own axes")
        return Dem(path, shape, pixel_from_map, "", "", None, 1.0)
    if system is None or not (system.is_geographic or system.is_projected or system.is_compound):
        raise _wrong(path, "no CRS on Earth", f"a georeferenced DEM, or scene.crs: {LOCAL}")
    counted_from = _datum(path, system, datum)
    metres = _metres_per_unit(path, system, unit)
    horizontal = system.sub_crs_list[0] if system.is_compound else system.to_2d()
    earth = counted_from in {"egm96", "egm2008"}
    geodetic = CRS("EPSG:4979") if earth or horizontal.geodetic_crs is None else horizontal.geodetic_crs.to_3d()
    undulations = (
        None
        if counted_from == "ellipsoid"
        else geoid_file(counted_from, geoid, names=grid_names(system) if datum == "carried" else ())
    )
    return Dem(path, shape, pixel_from_map, horizontal.to_wkt(), geodetic.to_wkt(), undulations, metres)


def _header(path: Path) -> tuple[tuple[float, ...], tuple[int, int], str, CRS | None]:
    """Return (x, y) → (column, row), rows and columns, unit of the heights and CRS."""
    with opened_raster(path, expected=_EXPECTED, remedy=_REMEDY) as raster:
        shape, unit, place, kind = (
            raster.shape,
            (raster.units[0] or "metre").lower(),
            raster.transform,
            raster.dtypes[0],
        )
        try:
            system = CRS.from_user_input(raster.crs) if raster.crs else None
            if system and NAMES_FILES.search(system.to_wkt()):
                raise _wrong(path, "a CRS that names a file", "a CRS that is complete in itself, or names a known grid")
        except ProjError as error:
            raise _wrong(path, f"a CRS that PROJ does not read ({shown(error)})", "a CRS that PROJ reads") from error
    if min(shape) < 2:
        raise _wrong(path, f"{shape[0]} × {shape[1]} posts", "at least 2 × 2")
    if not np.issubdtype(np.dtype(kind), np.integer) and not np.issubdtype(np.dtype(kind), np.floating):
        raise _wrong(path, f"heights of type {kind}", "integers or floating-point numbers")
    sides = (float(np.hypot(place.a, place.d)), float(np.hypot(place.b, place.e)))
    if not np.isfinite(place[:6]).all() or abs(place.determinant) <= 1e-9 * sides[0] * sides[1]:
        raise _wrong(path, f"a degenerate transform {[float(value) for value in place[:6]]}", "pixels with an area")
    inverse = ~place
    coefficients = (inverse.a, inverse.b, inverse.c, inverse.d, inverse.e, inverse.f)
    if not np.isfinite(coefficients).all():
        raise _wrong(path, f"pixels of {sides[0]:g} × {sides[1]:g} units", "pixels that can be told apart")
    return coefficients, shape, unit, system


def _wrong(path: Path, found: str, expected: str) -> CampaignError:
    return CampaignError(
        found,
        where=path,
        expected=expected,
        remedy=_REMEDY,
    )


def _datum(path: Path, system: CRS, stated: str) -> str:
    carried = carried_datum(system)
    if stated == "carried":
        if carried is None:
            raise _wrong(
                path, f"a CRS without heights ({system.name})", "a datum that is stated: ellipsoid, egm96 or egm2008"
            )
        return carried
    if carried not in {None, stated}:
        raise _wrong(path, f"heights of {carried} by its own CRS", f"{stated}, as stated, or carried")
    return stated


def _metres_per_unit(path: Path, system: CRS, unit: str) -> float:
    axis = system.axis_info[-1]
    if len(system.axis_info) == 3:
        return float(axis.unit_conversion_factor * (-1 if axis.direction == "down" else 1))
    if unit not in {"m", "metre", "meter", "metres", "meters"}:
        raise _wrong(path, f"heights in {unit}", "metres")
    return 1.0
