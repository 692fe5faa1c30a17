"""Writing of polygons as a GeoPackage (OGC 12-128r19) with sqlite3: no wall clock, equal inputs give equal bytes."""

import sqlite3
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio.crs
from numpy.typing import NDArray

from apertura.common.atomic import replacement

Ring = NDArray[np.float64]
"""Closed ring, (vertex, 2) float64 easting and northing."""

_APPLICATION, _VERSION = 0x47504B47, 10300  # "GPKG", version 1.3
_UNDEFINED = -1  # identifier of a Cartesian system that is not georeferenced
_TYPES: Mapping[type, str] = {str: "TEXT", float: "DOUBLE", int: "INTEGER"}

_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE, description TEXT DEFAULT '',
  last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (
  table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL,
  z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
"""


def write_geopackage(
    path: Path,
    features: Iterable[tuple[Sequence[Sequence[Ring]], Mapping[str, Any]]],
    columns: Mapping[str, type],
    *,
    crs: str,
    table: str,
    description: str,
    changed: str,
) -> None:
    """Write polygons with attributes as one layer of a GeoPackage.

    Parameters
    ----------
    path
        ``….gpkg``; complete or absent.
    features
        Polygons (rings of each, outer ring first) and attributes of each feature.
    columns
        Attribute → type: str, float or int.
    crs
        CRS of the vertices; a frame without authority code is written as an undefined Cartesian system.
    table, description
        Name and description of the layer.
    changed
        Date of the content, such as ``2025-05-14T09:30:00.000Z``.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> square = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]], np.float64)
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "area.gpkg"
    ...     write_geopackage(path, [([[square]], {"area_m2": 1.0})], {"area_m2": float}, crs="EPSG:32632", table="area",
    ...                      description="one square", changed="2025-05-14T09:30:00.000Z")
    ...     with sqlite3.connect(path) as database:
    ...         database.execute("SELECT fid, area_m2 FROM area").fetchall()
    [(1, 1.0)]
    """
    parsed = rasterio.crs.CRS.from_user_input(crs)
    code = parsed.to_epsg() if parsed.is_projected or parsed.is_geographic else None
    geographic = rasterio.crs.CRS.from_epsg(4326)
    systems = [
        ("undefined Cartesian", _UNDEFINED, "NONE", _UNDEFINED, "undefined", None),
        ("undefined geographic", 0, "NONE", 0, "undefined", None),
        ("WGS 84", 4326, "EPSG", 4326, geographic.to_wkt(), None),
    ]
    if code not in {None, 4326}:
        systems.append((f"EPSG:{code}", code, "EPSG", code, parsed.to_wkt(), None))
    srs = _UNDEFINED if code is None else code
    rows, vertices = [], [np.empty((0, 2))]
    for polygons, attributes in features:
        rows.append((_multipolygon(polygons, srs), *(columns[name](attributes[name]) for name in columns)))
        vertices += [ring for polygon in polygons for ring in polygon]
    every = np.concatenate(vertices)
    bounds = [*every.min(axis=0).tolist(), *every.max(axis=0).tolist()] if len(every) else [None] * 4
    database = sqlite3.connect(":memory:", isolation_level=None)
    try:
        database.execute(f"PRAGMA application_id = {_APPLICATION}")
        database.execute(f"PRAGMA user_version = {_VERSION}")
        database.executescript(_TABLES)
        declared = "".join(f', "{name}" {_TYPES[kind]}' for name, kind in columns.items())
        database.execute(f'CREATE TABLE "{table}" (fid INTEGER PRIMARY KEY AUTOINCREMENT, geom MULTIPOLYGON{declared})')
        database.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", systems)
        content = (table, "features", table, description, changed, *bounds, srs)
        database.execute("INSERT INTO gpkg_contents VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", content)
        geometry = (table, "geom", "MULTIPOLYGON", srs, 0, 0)
        database.execute("INSERT INTO gpkg_geometry_columns VALUES (?, ?, ?, ?, ?, ?)", geometry)
        places = ", ".join("?" * (1 + len(columns)))
        names = ", ".join(["geom", *(f'"{name}"' for name in columns)])
        database.executemany(f'INSERT INTO "{table}" ({names}) VALUES ({places})', rows)
        content_bytes = database.serialize()
    finally:
        database.close()
    with replacement(path) as temporary:
        temporary.write_bytes(content_bytes)


def _multipolygon(polygons: Sequence[Sequence[Ring]], srs: int) -> bytes:
    """Return a multipolygon as GeoPackage binary: header with envelope, then well-known binary, little endian."""
    every = np.concatenate([ring for polygon in polygons for ring in polygon])
    (west, south), (east, north) = every.min(axis=0), every.max(axis=0)
    parts = [struct.pack("<2sBBi4d", b"GP", 0, 0b11, srs, west, east, south, north)]
    parts.append(struct.pack("<BII", 1, 6, len(polygons)))
    for polygon in polygons:
        parts.append(struct.pack("<BII", 1, 3, len(polygon)))
        for ring in polygon:
            parts += [struct.pack("<I", len(ring)), np.ascontiguousarray(ring, "<f8").tobytes()]
    return b"".join(parts)
