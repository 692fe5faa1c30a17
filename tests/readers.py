"""Programs that open a raster: the georeferencing and the pixel value at a point that each program reports."""

import functools
import json
import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

QGIS = Path("/usr/bin/python3")
"""Python interpreter that may have QGIS: that of the system, because the tests run without system modules."""

Place = tuple[float, float]


@functools.cache
def have_qgis() -> bool:
    """Return True if QGIS is installed."""
    return QGIS.is_file() and _outside(QGIS, "-c", "import qgis.core").returncode == 0


def have_gdal() -> bool:
    """Return True if the programs of GDAL are installed (the version differs from that of rasterio)."""
    return shutil.which("gdalinfo") is not None and shutil.which("gdallocationinfo") is not None


def _outside(*command: str | Path, given: str = "") -> "subprocess.CompletedProcess[str]":
    """Run a system program in the environment of the system instead of that of the tests."""
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "LANG", "TMPDIR") if name in os.environ}
    # PAM off: statistics are not written next to the file.
    words = [str(word) for word in command]
    return subprocess.run(
        words, env=kept | {"GDAL_PAM_ENABLED": "NO"}, input=given, capture_output=True, text=True, check=False
    )


def ask_qgis(**requests: Any) -> dict[str, Any]:
    """Return the answers of QGIS, without a display, to requests to `in_qgis.py`."""
    done = _outside(QGIS, Path(__file__).with_name("in_qgis.py"), given=json.dumps(requests))
    assert done.returncode == 0, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def by_rasterio(path: Path) -> dict[str, Any]:
    """Return CRS (WKT), transform, shape and no-data value."""
    with rasterio.open(str(path)) as raster:
        return {
            "wkt": raster.crs.to_wkt(),
            "transform": raster.transform[:6],
            "shape": raster.shape,
            "nodata": raster.nodata,
        }


def by_rioxarray(path: Path) -> dict[str, Any]:
    """Return the values of `by_rasterio`; the transform follows from the coordinates of the pixel centres."""
    import rioxarray

    with rioxarray.open_rasterio(str(path)) as raster:
        west, east, north, south = (float(at) for axis in (raster.x, raster.y) for at in axis.values[[0, -1]])
        rows, columns = raster.shape[1:]
        right, down = (east - west) / (columns - 1), (south - north) / (rows - 1)
        return {
            "wkt": raster.rio.crs.to_wkt(),
            "transform": (right, 0.0, west - right / 2, 0.0, down, north - down / 2),
            "shape": (rows, columns),
            "nodata": raster.rio.nodata,
        }


def by_gdal(path: Path) -> dict[str, Any]:
    """Return the values of `by_rasterio` as reported by ``gdalinfo``."""
    report = json.loads(_outside("gdalinfo", "-json", path).stdout)
    west, right, _, north, _, down = report["geoTransform"]
    return {
        "wkt": report["coordinateSystem"]["wkt"],
        "transform": (right, 0.0, west, 0.0, down, north),
        "shape": report["size"][::-1],
        "nodata": float(report["bands"][0]["noDataValue"]),
    }


def sampled_by_rasterio(paths: Mapping[Path, Sequence[Place]]) -> dict[Path, list[complex]]:
    """Return the values of pixels at points."""
    values = {}
    for path, places in paths.items():
        with rasterio.open(path) as raster:
            values[path] = [complex(value[0]) for value in raster.sample(places)]
    return values


def sampled_by_rioxarray(paths: Mapping[Path, Sequence[Place]]) -> dict[Path, list[complex]]:
    """Return the values of the pixels whose centres are nearest to points."""
    import rioxarray

    values = {}
    for path, places in paths.items():
        with rioxarray.open_rasterio(path) as raster:
            values[path] = [complex(raster[0].sel(x=x, y=y, method="nearest")) for x, y in places]
    return values


def sampled_by_gdal(paths: Mapping[Path, Sequence[Place]]) -> dict[Path, list[complex]]:
    """Return the values of pixels at points as reported by ``gdallocationinfo``."""
    found = {}
    for path, places in paths.items():
        given = "".join(f"{x!r} {y!r}\n" for x, y in places)
        output = _outside("gdallocationinfo", "-valonly", "-geoloc", path, given=given).stdout.split()
        found[path] = [complex(value.replace("i", "j").replace("+-", "-")) for value in output]
    return found


def sampled_by_qgis(paths: Mapping[Path, Sequence[Place]]) -> dict[Path, list[complex]]:
    """Return the values of pixels at points, of real rasters only: QGIS returns no values of complex rasters."""
    real = {str(path): places for path, places in paths.items() if not path.stem.endswith("slc")}
    answer = ask_qgis(sample=real)["sampled"]
    return {Path(path): [np.nan if value is None else value for value in values] for path, values in answer.items()}
