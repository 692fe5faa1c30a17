"""Small valid files of every input format, as bytes, and real files if they are available."""

import hashlib
import io
import json
import struct
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
import rasterio
import zarr
from rasterio.transform import from_origin
from scipy.io import savemat

from apertura.campaign.config.template import config_template, flights_template
from apertura.core.geometry.geodesy import ecef_from_geodetic
from apertura.formats.export.cphd import CphdCollection, write_cphd
from apertura.formats.phase_histories.pulson import MESSAGE
from apertura.simulation import preset
from apertura.simulation.specification import specification_text
from tests.autopilot_logs import (
    dataflash,
    dataflash_rows,
    dataflash_text,
    ulog,
    ulog_attitude,
    ulog_fused,
    ulog_receiver,
)

from . import logs

SHARED = Path(__file__).parents[3] / "shared" / "data"

SYMBOLS, NODES, SAMPLES, CHANNELS = 64, ("uav1", "uav2"), 24, 2

CALIBRATED = "calibration: {flight: c01, reflector_m: [570660.0, 5363700.0, 620.0], search_m: 2.0}\n"
FRAMING = {
    "chip_samples": 2,
    "centre_hz": 0.0,
    "counter_bits": 8,
    "bit_chips": 3,
    "guard_samples": 4,
}
"""Fields of apertura:framing except the preamble."""


def real(name: str, *, lines: int = 0, most: int = 40_000) -> list[bytes]:
    """Return a real file or its first lines, if it is available and small."""
    path = SHARED / name
    if not path.is_file():
        return []
    data = path.read_bytes()
    data = b"\n".join(data.split(b"\n")[:lines]) + b"\n" if lines else data
    return [data] if len(data) <= most else []


def configs() -> list[bytes]:
    """Return configs: one with all keys commented, one with a calibration and a DEM, and a real config."""
    rest = "\n".join(line for line in config_template().splitlines() if not line.startswith("calibration"))
    rest = rest.replace("crs: auto", "crs: EPSG:32632").replace("dem: null", "dem: config/dem.tif")
    rest = rest.replace("dem_datum: null", "dem_datum: ellipsoid")
    history = "campaign: g\nwaveform: {kind: phase_history, format: afrl_mat}\nnodes: {a: {}}\nscene: {crs: local}\n"
    named = "campaign: c\nwaveform: {kind: phase_history, format: afrl_mat}\nnodes:\n  a: &a {attitude: log}\n  b: *a\n"
    made = [config_template(), rest + "\n" + CALIBRATED, history, named]
    return [*(text.encode() for text in made), *real("campaign-sample/config/config.yaml")]


def flights() -> list[bytes]:
    """Return tables of flights."""
    more = flights_template() + "c01\tcalibration\tuav1\tuav1\r\nf02\timage\tuav2\t uav1 , uav2\n"
    return [flights_template().encode(), b"\xef\xbb\xbf" + more.encode(), *real("campaign-sample/config/flights.tsv")]


def segments() -> list[bytes]:
    """Return tables of segments."""
    heading = "flight\tpair\tstart\tend\n"
    first = "f01\tuav1-uav2\t2025-05-14T09:30:00\t2025-05-14T09:30:10.5\n"
    zoned = "f01\tuav1-uav1\t2025-05-14 09:30:00Z\t2025-05-14T11:30:01+02:00\n"
    return [(heading + first).encode(), (heading + zoned + first).encode()]


def clocks() -> list[bytes]:
    """Return tables of clocks."""
    heading = "flight\tnode\toffset_s\tdrift_ppm\tstd_s\n"
    return [(heading + "f01\tuav1\t1563913933.090524973\t0\t0.05\nf01\tuav2\t-4.5\t-1.5e1\t\n").encode()]


def scans() -> list[bytes]:
    """Return recordings of a PulsON radar, complete and with a truncated last scan."""
    messages = np.zeros((2, 2), MESSAGE)
    messages["type"], messages["source"], messages["step_bins"], messages["kind"] = 0xF201, 1, 32, 1
    messages["start_ps"], messages["stop_ps"], messages["total"], messages["messages"] = 10_000, 40_518, 500, 2
    messages["index"], messages["id"] = np.arange(2), np.arange(2)[:, None]
    messages["time_ms"] = 1_000_000 + 21 * np.arange(2)[:, None]
    messages["scan"] = np.random.default_rng(1).integers(-50_000, 50_000, messages["scan"].shape)
    whole = bytes(32) + messages.tobytes()
    return [whole, whole[:-1000]]


def sigmf_meta() -> list[bytes]:
    """Return metadata of recordings: triggered, continuous, with header bytes, and of another vendor."""
    header = {"core:datatype": "ci16_le", "core:version": "1.2.5", "core:sample_rate": 1e6, "core:num_channels": 2}
    captures = [
        {"core:sample_start": 6 * n, "core:frequency": 1.2e9, "core:datetime": f"2025-05-14T09:30:0{n}.25Z"}
        for n in range(4)
    ]
    counted = [{**capture, "apertura:frame": n} for n, capture in enumerate(captures)]
    framing = {"apertura:framing": {"preamble": "raw/preamble.npy", **FRAMING}}
    names = {"apertura:channels": ["radar", "sidelink"]}
    headed = [{**capture, "core:sample_start": 5 * n, "core:header_bytes": 8} for n, capture in enumerate(captures)]
    real_valued = {"core:datatype": "rf32_le", "apertura:if_hz": 2.5e5}
    documents = (
        {"global": header, "captures": captures, "annotations": []},
        {"global": {**header, **names}, "captures": counted},
        {"global": {**header, **names, **framing}, "captures": captures[:1]},
        {"global": {**header, "core:trailing_bytes": 0, "core:dataset": "uav1.sigmf-data"}, "captures": headed},
        {"global": {**header, **framing, **real_valued}, "captures": captures[:1]},
    )
    made = [json.dumps(document, indent=1).encode() for document in documents]
    return [*made, *real("sigmf_nbiot/V16-beacon-NB-IoT-uplink.sigmf-meta")]


def sigmf_data() -> list[bytes]:
    """Return samples of all channels."""
    return [np.arange(1, SAMPLES * CHANNELS * 2 + 1, dtype="<i2").tobytes()]


def sigmf_floats() -> list[bytes]:
    """Return the samples of all channels as float32."""
    return [np.arange(1, SAMPLES * CHANNELS * 2 + 1, dtype="<f4").tobytes()]


def sigmf_collections() -> list[bytes]:
    """Return collections that list the first recording of `sigmf_meta`, with the name of a node and its own name."""
    streams = [{"name": "rx_0", "hash": hashlib.sha512(sigmf_meta()[0]).hexdigest()}]
    body = {"core:version": "1.2.0", "core:streams": streams}
    return [json.dumps({"collection": body | more}).encode() for more in ({"apertura:nodes": {"uav1": "rx_0"}}, {})]


def tracks() -> list[bytes]:
    """Return CSV logs with and without attitude and quality."""
    plain = ["time_utc,latitude_deg,longitude_deg,height_m"]
    plain += [f"2025-05-14T09:30:0{n}.5Z,48.4225{n},9.9550{n},624.{n}" for n in range(8)]
    full = [f"{plain[0]},roll_deg,pitch_deg,yaw_deg,std_north_m,std_east_m,std_up_m,quality"]
    full += [
        f"{line},1.5,-2,{350 + n},0.01,0.01,0.02,{('fix', 'float', '')[n % 3]}" for n, line in enumerate(plain[1:])
    ]
    texts = ["\n".join(lines) + "\n" for lines in (plain, full)]
    return [*(text.encode() for text in texts), *real("campaign-sample/raw/f01/uav1.track.csv", lines=12)]


def solutions() -> list[bytes]:
    """Return RTKLIB solutions by date and by week."""
    names = "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
    head = "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float)\n%  {}   " + names + "\n"
    rest = "48.422{0} 9.955{0} 624.{0} {1} 12 0.01 0.01 0.02"
    dates = [f"2025/05/14 09:30:0{n}.500   {rest.format(n, 1)}" for n in range(8)]
    weeks = [f"2366 {293400 + n}.000   {rest.format(n, 2)}" for n in range(8)]
    texts = [head.format(system) + "\n".join(lines) + "\n" for system, lines in (("GPST", weeks), ("UTC", dates))]
    return [*(text.encode() for text in texts), *real("campaign-sample/raw/f01/uav2.track.pos", lines=40)]


def other_solutions() -> list[bytes]:
    """Return RTKLIB solutions as ECEF, as baselines and in degrees, minutes and seconds."""
    times, places = logs.circle(8)
    ecef = ecef_from_geodetic(*places.T)
    names = "x-ecef(m) y-ecef(m) z-ecef(m) sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m)"
    columns = np.hstack([ecef, np.full((8, 6), 0.01)])
    baseline = "e-baseline(m) n-baseline(m) u-baseline(m)"
    angles = [["48 24 10.5", "-0 57 03.6", height] for height in places[:, 2]]
    texts = [
        logs.solution(times, columns, names, system="GPST"),
        logs.solution(times, ecef - ecef[0], baseline, separator=",", head=["% ref pos   : 48.4,9.95,600.0"]),
        logs.solution(times, angles, "latitude(d'\") longitude(d'\") height(m)", system="JST"),
    ]
    return [text.encode() for text in texts]


def mapped_tracks() -> list[bytes]:
    """Return a CSV log with times in seconds and other column names."""
    _, places = logs.circle(8)
    rows = [f"{number / 10:.1f},{a},{b},{h}" for number, (a, b, h) in enumerate(places)]
    return ["\n".join(["t,lat,lon,alt", *rows, ""]).encode()]


def nmea() -> list[bytes]:
    """Return NMEA logs with and without dates and host time stamps."""
    times, places = logs.circle(8)
    texts = [logs.nmea(times, places), logs.nmea(times, places, every=1, prefix="2025-05-14 23:59:57.1 ", talker="GP")]
    return [text.encode() for text in texts]


def airdata() -> list[bytes]:
    """Return AirData exports of DJI flights, one with a constant clock, and the head of a real export."""
    times, places = logs.circle(24)
    late = times + np.where(np.arange(24) < 12, 0, 74_000).astype("timedelta64[ms]")
    texts = [logs.airdata(times, places), logs.airdata(late, places, clock_ms=100 + 100 * np.arange(24))]
    flight = "dji_rtk_ansfl/Jul-7th-2022-11-10AM-Flight-Airdata.csv"
    return [*(text.encode() for text in texts), *real(flight, lines=40)]


def captures() -> list[bytes]:
    """Return Motive takes of two bodies and the head of a real take."""
    text = logs.capture(np.arange(12) / 360, logs.poses(), lost=[5])
    return [text.encode(), *real("bwsi_rail_passA/Rail SAR 2.csv", lines=30)]


def ulogs() -> list[bytes]:
    """Return PX4 logs of both message generations, with attitude and fused positions."""
    attitude = ("vehicle_attitude", 0, ulog_attitude(12, 10.0))
    old = ulog(("vehicle_gps_position", 0, ulog_receiver(epochs=12)), attitude)
    new = ulog(
        ("sensor_gps", 1, ulog_receiver(old=False, epochs=12)), attitude, ("vehicle_global_position", 0, ulog_fused(12))
    )
    return [old, new]


def dataflash_logs() -> list[bytes]:
    """Return binary ArduPilot logs with one and with two receivers."""
    return [dataflash(dataflash_rows(epochs=12)), dataflash(dataflash_rows(epochs=8, receivers=(0, 1)))]


def dataflash_texts() -> list[bytes]:
    """Return the ArduPilot logs as text."""
    return [dataflash_text(dataflash_rows(epochs=12)), dataflash_text(dataflash_rows(epochs=8, receivers=(0, 1)))]


def patterns() -> list[bytes]:
    """Return sampled beam patterns with and without phase."""
    rows = [f"{cut},{angle},{-(angle**2) / 100}" for cut in ("azimuth", "elevation") for angle in range(-60, 61, 20)]
    with_phase = ["cut,angle_deg,gain_db,phase_deg", *(f"{row},-3.5" for row in rows), ""]
    return ["\n".join(["cut,angle_deg,gain_db", *rows, ""]).encode(), "\n".join(with_phase).encode()]


def _npy(array: np.ndarray) -> bytes:
    target = io.BytesIO()
    np.save(target, array)
    return target.getvalue()


def codes() -> list[bytes]:
    """Return code symbols of both precisions."""
    symbols = np.exp(0.5j * np.pi * np.arange(SYMBOLS))
    return [_npy(symbols.astype(np.complex64)), _npy(symbols), _npy(symbols.astype(">c8"))]


def pulses() -> list[bytes]:
    """Return samples of a pulse as complex numbers and as pairs of integers."""
    pulse = np.exp(1j * np.pi * np.arange(SYMBOLS) ** 2 / SYMBOLS)
    pairs = np.stack([pulse.real, pulse.imag], -1) * 30000
    return [_npy(pulse.astype(np.complex64)), _npy(pairs.astype(np.int16)), _npy(pairs.astype(">i2"))]


def preambles() -> list[bytes]:
    """Return chips as integers and as floats."""
    chips = np.where(np.arange(31) % 3, 1, -1)
    return [_npy(chips.astype(np.int8)), _npy(chips.astype(np.float64))]


def matlab() -> list[bytes]:
    """Return a Gotcha structure, uncompressed and compressed."""
    pulses, lines = 6, 5
    angle = np.linspace(0, 0.1, pulses)
    data = {
        "fp": np.exp(1j * np.arange(pulses * lines).reshape(lines, pulses)).astype(np.complex64),
        "freq": np.linspace(9.3e9, 9.9e9, lines),
        "x": 7000 * np.cos(angle),
        "y": 7000 * np.sin(angle),
        "z": np.full(pulses, 7000.0),
        "r0": np.full(pulses, 9899.5),
        "th": angle,
        "af": {"r_correct": angle},
    }
    files = []
    for packed in (False, True):
        target = io.BytesIO()
        savemat(target, {"data": data}, do_compression=packed)
        files.append(target.getvalue())
    return files


RECORDED = {
    "transfer": np.exp(1j * np.arange(30).reshape(6, 5)).astype(np.complex64),
    "frequency": 9.3e9 + 1e7 * np.arange(5),
    "time": 1_747_215_000_000_000_000 + 10_000_000 * np.arange(6),
    "tx_position": np.array([4177000.0, 855000.0, 4728000.0]) + np.arange(6)[:, None],
    "rx_position": np.array([4177000.0, 855000.0, 4728009.0]) + np.arange(6)[:, None],
    "reference_delay": np.linspace(6.6e-6, 6.7e-6, 6),
}
"""Phase history with the variables of the echo stage."""

TIME_UNITS = {"units": "nanoseconds since 1970-01-01"}


def cphd() -> list[bytes]:
    """Return a bistatic pair as CPHD, with and without a custom parameter."""
    place = RECORDED["tx_position"][0] - [500.0, 200.0, 300.0]
    parts = RECORDED["time"].astype("datetime64[ns]"), RECORDED["tx_position"], RECORDED["rx_position"]
    files = []
    for limit_m in (np.inf, 5000.0):
        collection = CphdCollection(
            "c f01 a-b",
            "a-b",
            *parts,
            RECORDED["frequency"],
            np.full(6, limit_m),
            place,
            place,
            np.eye(3),
            (-5.0, -5.0, 5.0, 5.0),
            0.5,
            299_700_000.0,
            {"APERTURA_FRAME": "ecef"},
        )
        with TemporaryDirectory() as folder:
            path = Path(folder) / "b.cphd"
            write_cphd(path, collection, [RECORDED["transfer"]])
            files.append(path.read_bytes())
    return files


def hdf5() -> list[bytes]:
    """Return a phase history in HDF5, uncompressed and compressed."""
    files = []
    for packed in (None, "gzip"):
        target = io.BytesIO()
        with h5py.File(target, "w") as file:
            file.attrs["frame"] = "ecef"
            for name, values in RECORDED.items():
                file.create_dataset(name, data=values, compression=packed)
            file["time"].attrs.update(TIME_UNITS)
        files.append(target.getvalue())
    return files


def zarr_folder(folder: Path) -> None:
    """Write a phase history as a zarr folder."""
    group = zarr.open_group(folder, mode="w", zarr_format=3, attributes={"frame": "ecef"})
    for name, values in RECORDED.items():
        group.create_array(name, data=values, attributes=TIME_UNITS if name == "time" else {})


def zarr_arrays() -> list[bytes]:
    """Return the metadata of the sample array of a zarr folder."""
    with TemporaryDirectory() as folder:
        zarr_folder(Path(folder) / "b.zarr")
        return [(Path(folder) / "b.zarr/transfer/zarr.json").read_bytes()]


def _tiff(heights: np.ndarray, place: rasterio.Affine, crs: str, **more: object) -> bytes:
    shape = {"height": heights.shape[0], "width": heights.shape[1], "count": 1, "dtype": heights.dtype}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "made.tif"
        with rasterio.open(path, "w", "GTiff", crs=crs, transform=place, **shape, **more) as raster:
            raster.write(heights, 1)
        return path.read_bytes()


def dems() -> list[bytes]:
    """Return DEMs of the scene of `parsers`: plain, packed, tiled, with voids, in degrees."""
    rows, columns = np.mgrid[:24, :24]
    heights, corner = (600 + 0.5 * rows - 0.25 * columns).astype(np.float32), from_origin(500000, 5400100, 5, 5)
    return [
        _tiff(heights, corner, "EPSG:32632"),
        _tiff(heights, corner, "EPSG:32632", compress="deflate", tiled=True, blockxsize=16, blockysize=16, nodata=-1),
        _tiff(heights.astype(np.int16), corner, "EPSG:25832", compress="lzw", predictor=2),
        _tiff(heights, from_origin(8.9995, 48.7545, 0.0001, 0.0001), "EPSG:4326"),
    ]


GEOID_AT = (np.array([9.0, 9.2]), np.array([48.5, 48.7]))
"""Longitudes and latitudes, in degrees, at which undulations are interpolated."""


def _undulations() -> np.ndarray:
    return np.linspace(40, 50, 81).reshape(9, 9).astype(">f4")


def gtx_grids() -> list[bytes]:
    """Return a geoid grid of 9 × 9 posts in GTX format."""
    return [struct.pack(">4d2i", 47.0, 7.0, 0.5, 0.5, 9, 9) + _undulations().tobytes()]


def tif_grids() -> list[bytes]:
    """Return the geoid grid as GeoTIFF in the format of PROJ."""
    return [_tiff(_undulations()[::-1].astype(np.float32), from_origin(6.75, 51.25, 0.5, 0.5), "EPSG:4326")]


def flight_plans() -> list[bytes]:
    """Return flight plans."""
    track = {"kind": "racetrack", "start_m": [0, 0], "end_m": [9, 0], "legs": 2, "speed_m_s": 2, "height_m": 9}
    flight = {"transmitter": "uav1", "receivers": ["uav1"], "tracks": {"uav1": track}}
    waveform = {"kind": "samples", "pulse_s": 1e-6, "listen_s": 2e-6} | {
        f"{key}_hz": value for key, value in (("carrier", 1e9), ("sample_rate", 1e8), ("prf", 10))
    }
    plan = {"campaign": "x", "waveform": waveform, "nodes": {"uav1": {}}, "scene": {"crs": "local"}}
    return [json.dumps(plan | {"flights": {"f01": flight}, "require": {"coverage": 0.9}}).encode()]


def missions() -> list[bytes]:
    """Return missions of QGroundControl."""
    items = [
        {"type": "SimpleItem", "command": 16, "frame": 3, "params": [0, 0, 0, None, 48.0 + step, 9.0, 30.0]}
        for step in (0.0, 1e-3)
    ]
    mission = {"vehicleType": 2, "hoverSpeed": 5, "plannedHomePosition": [48.0, 9.0, 480], "items": items}
    return [json.dumps({"fileType": "Plan", "mission": mission}).encode()]


def waypoints() -> list[bytes]:
    """Return waypoint missions of ArduPilot ground stations."""
    rows = ["0\t1\t0\t16\t0\t0\t0\t0\t48\t9\t480\t1"]
    rows += [f"{number}\t0\t3\t16\t0\t0\t0\t0\t48.00{number}\t9\t40\t1" for number in (1, 2)]
    return ["\n".join(["QGC WPL 110", *rows]).encode()]


def kmls() -> list[bytes]:
    """Return KML documents with lines."""
    line = "<altitudeMode>absolute</altitudeMode><coordinates>9,48,500 9.01,48,500</coordinates>"
    return [f"<kml><Placemark><LineString>{line}</LineString></Placemark></kml>".encode()]


def specifications() -> list[bytes]:
    """Return specifications of simulations."""
    return [specification_text(preset(name)).encode() for name in ("demo", "continuous", "paper-uav")]


SCENE = {
    "grid": {
        "crs": "EPSG:32632",
        "west_m": 500020.0,
        "north_m": 5400060.0,
        "spacing_m": 0.5,
        "shape": [40, 60],
        "first": [0, 0],
        "name": "x",
    },
    "height_m": 620.0,
    "inputs": {"dem": "0f"},
    "chosen": {"crs": "UTM zone"},
}
MANIFEST = {
    "files": {"scene.json": "0f" * 32},
    "sources": {"raw/dem.tif": "1e" * 32, "results/f01/uav1-uav1/echo.manifest.json": "2d" * 32},
    "settings": "3c" * 32,
    "code": "4b" * 32,
}
OFFSET = {"offset_m": 1.5, "std_m": 0.01, "inputs": {"raw/f01/uav1.sigmf-data": "0f"}, "flags": {"weak": "one line"}}
AGREED = {"coherence": 0.9, "phase_rad": 0.1, "flags": {"apart": "one line"}}
ASSESSED = {
    "reference": "uav1-uav1",
    "hypotheses": {},
    "code_sha256": "0f",
    "fusion": {"phases_rad": {"uav1-uav1": 0.0}, "excluded": {"uav1-uav2": "reason"}, "unmeasured": {}, "reason": {}},
    "pairs": {"uav1-uav1": AGREED, "uav1-uav2": AGREED},
}
RADAR = {"centre_hz": 1.4e9, "bandwidth_hz": 4e8, "subcarriers": 1024, "sent_power": 1024.0}
SHAPED = {"radar_tx": {"beamwidth_deg": [70.0, 50.0], "pattern_sha256": None}}
CONSTANTS = {
    "schema_version": 1,
    "software": "0.1.0",
    "campaign": "past",
    "flights": {"f01": "2025-05-14T09:30:00Z"},
    "reference": "uav1-uav1",
    "pairs": {
        "uav1-uav1": {
            "radar": {**RADAR, "antennas": SHAPED},
            "constant_db": 62.1,
            "std_db": 0.3,
            "chance": 0.8,
            "reflectors": 2,
            "flights": 1,
            "phase_rad": None,
            "phase_std_rad": None,
            "flags": {"constant_drifts": "one line"},
        }
    },
    "measurements": [{"flight": "f01", "constant_db": 62.0}],
    "images": {"results/f01/uav1-uav1/image.manifest.json": "2d" * 32},
}
REPORTED = {
    "flight": "f01",
    "engine": "native",
    "numerical_error_db": -70.5,
    "flags": {"noisy": "one line"},
    "focus": {},
}


def documents(document: object) -> list[bytes]:
    """Return a document in the format of the workflow."""
    return [json.dumps(document, indent=1).encode()]
