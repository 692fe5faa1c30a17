"""Displacement time series of dolphin as inputs of MintPy, and as a point layer for InSAR Explorer in QGIS."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from rasterio.enums import Resampling
from rasterio.transform import rowcol, xy
from rasterio.vrt import WarpedVRT

from apertura.common.atomic import replacement, write_json, write_text
from apertura.common.documents import read_json
from apertura.common.errors import CampaignError
from apertura.common.raster import opened_raster
from apertura.tools.export_stack import DATE_FORMAT, HANDOFF

Values = NDArray[np.float32]

LEAST_COHERENCE = 0.7
"""Temporal coherence below which a pixel is no point of the layer; limit of MintPy's mask."""

POINTS = "displacement.geojson"
"""Point layer: fields `velocity`, mm/year, `coherence`, and `D<YYYYMMDD>`, mm."""

_EXPECTED = {"expected": "a result of dolphin", "remedy": "Run `dolphin run dolphin_config.yaml` in the folder."}

_MINTPY_CONFIG = """\
# Run in this folder: mintpy smallbaselineApp mintpy.cfg --start modify_network --end reference_point
# and then: mintpy smallbaselineApp mintpy.cfg --start invert_network
mintpy.compute.cluster = none
mintpy.reference.yx = {row},{column}
mintpy.networkInversion.weightFunc = no
mintpy.troposphericDelay.method = no
mintpy.topographicResidual = no
mintpy.geocode = no
mintpy.save.kmz = no
mintpy.plot = no
"""


@dataclass(frozen=True)
class DolphinResult:
    """Result of dolphin in a folder of `apertura export stack`.

    Attributes
    ----------
    folder
        The folder.
    times
        Start of each acquisition, in `DATE_FORMAT`, ascending.
    handoff
        Content of `handoff.json`.
    profile
        Georeference and shape of dolphin's rasters, as in rasterio.
    """

    folder: Path
    times: tuple[str, ...]
    handoff: Mapping[str, Any]
    profile: Mapping[str, Any]

    @classmethod
    def open(cls, folder: Path) -> "DolphinResult":
        """Open a folder; raise CampaignError if the stack or the result of dolphin is missing."""
        remedy = "Run `apertura export stack` first."
        handoff = read_json(folder / HANDOFF, expected="an exported stack", remedy=remedy)
        try:
            times = tuple(str(one["time"]) for one in handoff["flights"])
        except (KeyError, TypeError):
            times = ()
        if len(times) < 2:
            raise CampaignError("no flights", folder / HANDOFF, "a file of `apertura export stack`", remedy)
        with opened_raster(folder / f"dolphin/timeseries/{times[0]}_{times[-1]}.tif", **_EXPECTED) as raster:
            return cls(folder, times, handoff, raster.profile)

    def read(self, name: str) -> Values:
        """Return a raster of dolphin, (y, x) float32; NaN for no data."""
        with opened_raster(self.folder / "dolphin" / name, **_EXPECTED) as raster:
            values = raster.read(1)
            no_data = values == raster.nodata if raster.nodata is not None else np.zeros(values.shape, bool)
        return np.where(no_data, np.float32(np.nan), values.astype(np.float32))

    @property
    def displacement_m(self) -> Values:
        """Displacement towards the sensor since the first acquisition, (time, y, x) float32; NaN for no data."""
        since = [self.read(f"timeseries/{self.times[0]}_{time}.tif") for time in self.times[1:]]
        return np.stack([np.where(np.isfinite(since[0]), np.float32(0), np.float32(np.nan)), *since])

    @property
    def temporal_coherence(self) -> Values:
        """Agreement of the phases of a pixel with those of a single time series, (y, x) float32."""
        return self.read(f"interferograms/temporal_coherence_{self.times[0]}_{self.times[-1]}.tif")

    def layer(self, name: str) -> Values:
        """Return a layer of the folder `geometry` averaged to dolphin's pixels, (component, y, x) float32."""
        place = {key: self.profile[key] for key in ("crs", "transform", "width", "height")}
        with (
            opened_raster(
                self.folder / "geometry" / name, expected="an exported stack", remedy="Export again."
            ) as raster,
            WarpedVRT(raster, resampling=Resampling.average, **place) as warped,
        ):
            values: Values = warped.read().astype(np.float32)
        return values


def write_time_series(folder: Path) -> list[Path]:
    """Write dolphin's result as inputs of MintPy (CRS of UTM only) and as a point layer; return the files.

    Parameters
    ----------
    folder
        Folder of `apertura export stack`, in which dolphin has run.

    Raises
    ------
    CampaignError
        If the folder contains no exported stack or no result of dolphin, or if the scene has a local frame.
    """
    result = DolphinResult.open(folder)
    crs = CRS.from_user_input(result.profile["crs"])
    if not crs.is_projected:
        raise CampaignError(
            "a local frame", folder, "a scene in a projected CRS", "Set scene.crs, and run the workflow again."
        )
    write_json(folder / POINTS, point_layer(result, crs))
    return [*(_write_mintpy(result, crs) if crs.utm_zone else ()), folder / POINTS]


def point_layer(result: DolphinResult, crs: CRS) -> dict[str, Any]:
    """Return the pixels of sufficient temporal coherence as points with their time series, GeoJSON in WGS 84.

    InSAR Explorer reads the fields `D<YYYYMMDD>`. If a day has several acquisitions, this field is the last of them,
    and each acquisition has a further field `T<YYYYMMDDTHHMMSS>`.
    """
    moved_mm, coherence = 1e3 * result.displacement_m, result.temporal_coherence
    rows, columns = np.nonzero(np.isfinite(moved_mm).all(axis=0) & (coherence >= LEAST_COHERENCE))
    x, y = xy(result.profile["transform"], rows, columns)
    longitude, latitude = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(x, y)
    series = moved_mm[:, rows, columns]
    days = np.array([one["temporal_baseline_days"] for one in result.handoff["flights"]])
    velocity = 365.25 * np.polyfit(days - days[0], series, 1)[0]
    fields = {"velocity": velocity, "coherence": coherence[rows, columns]}
    fields |= {f"D{time[:8]}": values for time, values in zip(result.times, series, strict=True)}
    if len({time[:8] for time in result.times}) < len(result.times):
        fields |= {f"T{time}": values for time, values in zip(result.times, series, strict=True)}
    columns_of = {name: np.round(values.astype(float), 3).tolist() for name, values in fields.items()}
    points = np.round(np.stack([longitude, latitude], -1), 8).tolist()
    return {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "geometry": {"type": "Point", "coordinates": point},
                "properties": {name: values[number] for name, values in columns_of.items()},
            }
            for number, point in enumerate(points)
        ],
    }


def _write_mintpy(result: DolphinResult, crs: CRS) -> list[Path]:
    """Write ifgramStack.h5 and geometryGeo.h5 in MintPy's layout, and the template of smallbaselineApp."""
    folder, handoff, transform = result.folder / "mintpy", result.handoff, result.profile["transform"]
    start = datetime.strptime(result.times[0], DATE_FORMAT)
    east, north, up = result.layer("line_of_sight_enu.tif")
    ranges, height = result.layer("slant_range_distance.tif").mean(axis=0), result.layer("height.tif")[0]
    attributes = {
        "PROCESSOR": "isce",
        "PLATFORM": "UAV",
        "WAVELENGTH": handoff["wavelength_m"],
        "LENGTH": result.profile["height"],
        "WIDTH": result.profile["width"],
        "X_FIRST": transform.c,
        "Y_FIRST": transform.f,
        "X_STEP": transform.a,
        "Y_STEP": transform.e,
        "X_UNIT": "meters",
        "Y_UNIT": "meters",
        "UTM_ZONE": crs.utm_zone,
        "HEADING": handoff["heading_deg"],
        "ORBIT_DIRECTION": "ASCENDING" if abs(handoff["heading_deg"] - 180) > 90 else "DESCENDING",
        "ALOOKS": 1,
        "RLOOKS": 1,
        "RANGE_PIXEL_SIZE": transform.a,
        "AZIMUTH_PIXEL_SIZE": transform.a,
        "STARTING_RANGE": float(np.nanmin(ranges)),
        "EARTH_RADIUS": 6371e3,
        "HEIGHT": float(np.nanmean(height + ranges * up)),
        "CENTER_LINE_UTC": (start - start.replace(hour=0, minute=0, second=0)).total_seconds(),
    }
    geometry = {
        "height": height,
        "incidenceAngle": np.degrees(np.arccos(np.clip(up, -1, 1))),
        "azimuthAngle": np.degrees(np.arctan2(-east, north)),  # of the line of sight, counterclockwise from north
        "slantRangeDistance": ranges,
    }
    pairs = sorted(path.name.split(".")[0] for path in (result.folder / "dolphin/unwrapped").glob("*_*.unw.tif"))
    baselines = {one["time"]: one["perpendicular_baseline_m"] for one in handoff["flights"]}
    dates = [pair.split("_") for pair in pairs]
    stack = {
        "date": np.array(dates, dtype="S15"),
        "bperp": np.array([baselines[later] - baselines[earlier] for earlier, later in dates], np.float32),
        "dropIfgram": np.ones(len(pairs), bool),
        "unwrapPhase": np.stack([result.read(f"unwrapped/{pair}.unw.tif") for pair in pairs]),
        "coherence": np.stack([result.read(f"interferograms/{pair}.int.cor.tif") for pair in pairs]),
        "connectComponent": np.stack([result.read(f"unwrapped/{pair}.unw.conncomp.tif") for pair in pairs]),
    }
    files = {"ifgramStack": stack, "geometryGeo": geometry}
    for name, datasets in files.items():
        kind = "ifgramStack" if name == "ifgramStack" else "geometry"
        with replacement(folder / f"inputs/{name}.h5") as temporary, h5py.File(temporary, "w") as file:
            file.attrs.update({key: str(value) for key, value in (attributes | {"FILE_TYPE": kind}).items()})
            for key, values in datasets.items():
                # MintPy ignores pixels of interferograms that are 0.
                file.create_dataset(key, data=np.nan_to_num(values) if values.ndim == 3 else values)
    row, column = rowcol(transform, *handoff["reference_point_m"])
    write_text(folder / "mintpy.cfg", _MINTPY_CONFIG.format(row=row, column=column))
    return [*(folder / f"inputs/{name}.h5" for name in files), folder / "mintpy.cfg"]
