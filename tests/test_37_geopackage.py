"""Polygons of changed regions as a GeoPackage: geometry, reference system, and equal bytes for equal inputs."""

import sqlite3
import struct

import numpy as np
import pytest
from rasterio import Affine

from apertura.core.geometry.geodesy import local_crs
from apertura.formats.export.change import COLUMNS, ChangedRegions, write_regions

PLACE = Affine(0.5, 0, 500_000, 0, -0.5, 5_000_000)


def row(**values):
    return {name: values.get(name, kind()) for name, kind in COLUMNS.items()}


def written(path, labels, crs="EPSG:32632"):
    rows = [row(kind=f"region {number}", area_m2=float(number)) for number in range(1, labels.max() + 1)]
    write_regions(path, ChangedRegions(labels, rows, "2025-05-14T09:30:00.000Z"), transform=PLACE, crs=crs, tags={})
    return path


def geometry(blob):
    """Return reference system, envelope and polygons (rings) of a geometry."""
    magic, version, flags, srs, *envelope = struct.unpack_from("<2sBBi4d", blob)
    assert (magic, version, flags) == (b"GP", 0, 3)
    at, polygons = 40, []
    _, kind, count = struct.unpack_from("<BII", blob, at)
    assert kind == 6
    at += 9
    for _ in range(count):
        _, kind, rings = struct.unpack_from("<BII", blob, at)
        assert kind == 3
        at, polygon = at + 9, []
        for _ in range(rings):
            (points,) = struct.unpack_from("<I", blob, at)
            polygon.append(np.frombuffer(blob, "<f8", 2 * points, at + 4).reshape(-1, 2))
            at += 4 + 16 * points
        polygons.append(polygon)
    assert at == len(blob)
    return srs, envelope, polygons


def area(ring):
    x, y = ring.T
    return abs((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) / 2


def test_regions_are_multipolygons_with_the_area_of_their_pixels(tmp_path):
    labels = np.zeros((6, 8), np.int32)
    labels[0:3, 0:3] = 1
    labels[1, 1] = 0  # a hole
    labels[3, 3] = 1  # touches the region at a corner: another polygon
    labels[5, 6:8] = 2
    with sqlite3.connect(written(tmp_path / "regions.gpkg", labels)) as database:
        rows = database.execute("SELECT geom, kind FROM change_regions ORDER BY fid").fetchall()
        (bounds,) = database.execute("SELECT min_x, min_y, max_x, max_y, srs_id FROM gpkg_contents").fetchall()
        assert database.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
    assert bounds == (500_000, 5_000_000 - 3, 500_004, 5_000_000, 32632)
    srs, envelope, polygons = geometry(rows[0][0])
    assert (srs, rows[0][1]) == (32632, "region 1")
    assert envelope == [500_000, 500_002, 5_000_000 - 2, 5_000_000]
    assert sorted(len(polygon) for polygon in polygons) == [1, 2]
    assert sum(area(outer) - sum(map(area, holes)) for outer, *holes in polygons) == pytest.approx(9 * 0.25)


def test_equal_regions_have_equal_bytes(tmp_path):
    labels = np.eye(4, dtype=np.int32)
    first, second = (written(tmp_path / name, labels).read_bytes() for name in ("one.gpkg", "other.gpkg"))
    assert first == second


def test_local_frame_and_no_region_are_written(tmp_path):
    path = written(tmp_path / "none.gpkg", np.zeros((3, 3), np.int32), crs=local_crs("scene"))
    with sqlite3.connect(path) as database:
        assert database.execute("SELECT min_x, srs_id FROM gpkg_contents").fetchone() == (None, -1)
        assert database.execute("SELECT count(*) FROM change_regions").fetchone() == (0,)
