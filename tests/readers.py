"""Programs that open a raster: what each says of its place, and of the pixel at a place."""

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
"""A Python that may have QGIS: not the one of the tests, which has no module from the system."""

Place = tuple[float, float]


@functools.cache
def have_qgis() -> bool:
    """Return whether QGIS is installed here."""
    return QGIS.is_file() and _outside(QGIS, "-c", "import qgis.core").returncode == 0


def have_gdal() -> bool:
    """Return whether GDAL's own programs are installed here, of another version than rasterio's."""
    return shutil.which("gdalinfo") is not None and shutil.which("gdallocationinfo") is not None


def _outside(*command: str | Path, given: str = "") -> "subprocess.CompletedProcess[str]":
    """Run a program of the system in the system's environment, not in that of the tests."""
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "LANG", "TMPDIR") if name in os.environ}
    # PAM off: statistics are not kept beside the file.
    return subprocess.run(
        command, env=kept | {"GDAL_PAM_ENABLED": "NO"}, input=given, capture_output=True, text=True, check=False
    )


def ask_qgis(**asked: Any) -> dict[str, Any]:
    """Return what QGIS, without a screen, answers to what `in_qgis.py` is asked."""
    done = _outside(QGIS, Path(__file__).with_name("in_qgis.py"), given=json.dumps(asked))
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
    """Return the same; the transform from the coordinates of the pixels' centres."""
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
    """Return the same as ``gdalinfo`` tells it."""
    told = json.loads(_outside("gdalinfo", "-json", path).stdout)
    west, right, _, north, _, down = told["geoTransform"]
    return {
        "wkt": told["coordinateSystem"]["wkt"],
        "transform": (right, 0.0, west, 0.0, down, north),
        "shape": told["size"][::-1],
        "nodata": float(told["bands"][0]["noDataValue"]),
    }


def sampled_by_rasterio(paths: Mapping[Path, Sequence[Place]]) -> dict[Path, list[complex]]:
    """Return the values of pixels at places."""
    found = {}
    for path, places in paths.items():
        with rasterio.open(path) as raster:
            found[path] = [complex(value[0]) for value in raster.sample(places)]
    return found


def sampled_by_rioxarray(paths: Mapping[Path, Sequence[Place]]) -> dict[Path, list[complex]]:
    """Return the values of pixels whose centres are nearest to places."""
    import rioxarray

    found = {}
    for path, places in paths.items():
        with rioxarray.open_rasterio(path) as raster:
            found[path] = [complex(raster[0].sel(x=x, y=y, method="nearest")) for x, y in places]
    return found


def sampled_by_gdal(paths: Mapping[Path, Sequence[Place]]) -> dict[Path, list[complex]]:
    """Return the values of pixels at places as ``gdallocationinfo`` tells them."""
    found = {}
    for path, places in paths.items():
        given = "".join(f"{x!r} {y!r}\n" for x, y in places)
        told = _outside("gdallocationinfo", "-valonly", "-geoloc", path, given=given).stdout.split()
        found[path] = [complex(value.replace("i", "j").replace("+-", "-")) for value in told]
    return found


def sampled_by_qgis(paths: Mapping[Path, Sequence[Place]]) -> dict[Path, list[complex]]:
    """Return the values of pixels at places, of real rasters: QGIS gives none of complex ones."""
    real = {str(path): places for path, places in paths.items() if not path.stem.endswith("slc")}
    told = ask_qgis(sample=real)["sampled"]
    return {Path(path): [np.nan if value is None else value for value in values] for path, values in told.items()}
