"""Table of parsers: seeds, tokens and structure of the format, and reader of a file."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apertura.campaign.config import Flight, PulseWaveform, read_clocks, read_flights, read_segments, read_settings
from apertura.campaign.folder import Campaign
from apertura.campaign.store import manifest_of, read_manifest, record_files
from apertura.common.errors import CampaignError, shown
from apertura.core.scene.dem import open_dem
from apertura.core.scene.geoid import geoid_file, undulation
from apertura.core.scene.grid import SceneGrid
from apertura.formats.beam_pattern import read_beam_pattern
from apertura.formats.code_tables import CodeTable
from apertura.formats.names import recording_files
from apertura.formats.phase_histories import (
    cphd,
    cphd_fields,
    hdf5_history,
    history_layout,
    phase_history,
    zarr_history,
)
from apertura.formats.phase_histories.afrl import joined
from apertura.formats.phase_histories.mat_fields import read_fields
from apertura.formats.phase_histories.pulson import read_pulson
from apertura.formats.reading import open_recording, read_track
from apertura.formats.recordings.sigmf import GrowingSigmf, check_listed
from apertura.formats.tracks import ardupilot, dataflash_fields, px4_ulog, ulog_fields
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions
from apertura.formats.tracks.missions import read_mission
from apertura.simulation.specification import read_specification
from apertura.stages.agreement import assessment_of
from apertura.stages.calibration import calibrated
from apertura.stages.radiometry import read_constants
from apertura.stages.scene import settled_scene
from apertura.stages.transmitted import read_framing, read_pulse
from apertura.tools.design.flight_plan import read_flight_plan
from apertura.tools.open_campaign import OpenCampaign

from . import beats, mutators, products, seeds

GRID = SceneGrid("EPSG:32632", 500030.0, 5400060.0, 2.0, (20, 20))
FLIGHT = Flight("f01", "image", "uav1", seeds.NODES)


@dataclass(frozen=True)
class Parser:
    """A parser of one kind of file.

    Attributes
    ----------
    file
        File name; its suffix determines the format.
    seeds
        Function that returns valid files.
    read
        Function that returns the value of a file or raises `CampaignError`.
    structure
        Format-specific mutators.
    tokens
        Tokens of the format, separated by spaces.
    may_die
        True if the product reads the file in a separate process, where a crash is a refusal.
    """

    file: str
    seeds: Callable[[], list[bytes]]
    read: Callable[[Path], Any]
    structure: Sequence[mutators.Mutator] = ()
    tokens: str = ""
    may_die: bool = False

    @functools.cached_property
    def words(self) -> list[bytes]:
        """Tokens as bytes."""
        return self.tokens.encode().split()


def _written(path: Path, data: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def _metadata(path: Path) -> Any:
    return open_recording((path, _written(path.with_name("uav1.sigmf-data"), seeds.sigmf_data()[0])))


def _growing(path: Path) -> object:
    growing = GrowingSigmf(path, _written(path.with_name("uav1.sigmf-data"), seeds.sigmf_data()[0]))
    return growing.read() and growing.read()


def _samples(path: Path) -> Any:
    recording = open_recording((_written(path.with_name("uav1.sigmf-meta"), seeds.sigmf_meta()[0]), path))
    return recording.cut(recording.captures, node="uav1")


def _floats(path: Path) -> Any:
    meta = seeds.sigmf_meta()[0].replace(b"ci16_le", b"cf32_le")
    recording = open_recording((_written(path.with_name("uav1.sigmf-meta"), meta), path))
    return recording.cut(recording.captures, node="uav1")


def _collection(path: Path) -> Any:
    _written(path.with_name("rx_0.sigmf-meta"), seeds.sigmf_meta()[0])
    _written(path.with_name("rx_0.sigmf-data"), seeds.sigmf_data()[0])
    files = recording_files(path.parent, "uav1")
    return open_recording(files) if files[0].is_file() else check_listed(path.with_name("rx_0.sigmf-meta"))


def _preamble(path: Path) -> Any:
    return read_framing(path, seeds.FRAMING, sample_rate_hz=1e6, where=path)


def _history(path: Path) -> Any:
    return joined([path], [_alone(read_fields, path)], pair="a-a")


def _cphd(path: Path) -> Any:
    fields = cphd.of_channel(path, _alone(cphd_fields.read_fields, path), None)
    return phase_history.joined([cphd.history(path, fields, pair="a-b")], pair="a-b", expected="a CPHD file")


def _hdf5(path: Path) -> Any:
    fields = _alone(hdf5_history.read_fields, path)
    return phase_history.joined([history_layout.history(path, fields)], pair="a-b", expected="an HDF5 file")


def _zarr(path: Path) -> Any:
    folder, data = path.parents[1], path.read_bytes()
    if not (folder / "zarr.json").is_file():
        seeds.zarr_folder(folder)
        path.write_bytes(data)
    fields = _alone(zarr_history.read_fields, folder)
    return phase_history.joined([history_layout.history(folder, fields)], pair="a-b", expected="a zarr folder")


def _alone(read: Callable[[Path], Any], path: Path) -> Any:
    """Read like `read_isolated`, but in this process, which may crash."""
    try:
        return read(path)
    except Exception as error:  # of any type: the isolated reader prints the exception as its last line
        raise CampaignError(shown(str(error), 300), path, "a file of its format", "Copy it again.") from error


def _autopilot(fields_of: Any, track_of: Any) -> Callable[[Path], Any]:
    """Return a reader of autopilot logs that runs in this process, which may crash."""

    def read(path: Path) -> Any:
        return track_of(_alone(fields_of, path), node="uav1", options=DEFAULT_OPTIONS, where=path)

    return read


def _dem(path: Path) -> Any:
    dem = open_dem(path, GRID, datum="ellipsoid")
    return dem.heights(GRID)


def _geoid(path: Path) -> Any:
    return undulation(geoid_file("egm96", path), *seeds.GEOID_AT)


def _campaign(root: Path) -> Campaign:
    config = _written(root / "config.yaml", seeds.configs()[1])
    return Campaign(root, read_settings(config), (FLIGHT, Flight("c01", "calibration", "uav1", seeds.NODES)))


def _recorded(path: Path) -> Path:
    """Write the manifest of a document, so that its content is parsed."""
    record_files(manifest_of(path), [path])
    return path


def _listed(path: Path) -> Path:
    """Write the manifest of the products that includes a report."""
    record_files(path.with_name("export.manifest.json"), [path])
    return path


def _calibration(path: Path) -> Any:
    return calibrated(_campaign(_recorded(path).parents[2]), "f01", "uav1-uav2")


_YAML = (
    "&a *a - : {} [] ? | > << !!python/object:os.system !!binary !!timestamp --- ... # null ~ yes 1:2:3 0b1 .inf .nan"
)
_JSON = '{ } [ ] , : " null true false NaN Infinity 1e999 -0 \\ud800 \\u0000'
_NPY = (
    "'descr': '<c8' '|O' '|V8' '<U9' '>c16' 'fortran_order': True (7,)*9 'shape': (9999999999999,) () (-1,) PK\x03\x04"
)
_TIFF = "II*\0 MM\0* II+\0 <VRTDataset /vsicurl/http://127.0.0.1/x <GDAL_WMS> \x00\x01\x00\x04 \x83\x0e \x87\xaf"
_SIGMF = (
    f"{_JSON} core:sample_start core:datetime apertura:frame apertura:channels core:num_channels 2025-01-01T00:00:60Z "
    "core:header_bytes core:trailing_bytes core:dataset apertura:if_hz ri16_be cf64_le cu8"
)
_MAPPED = LogOptions(
    start_utc="2025-05-14",
    columns={"time_s": "t", "latitude_deg": "lat", "longitude_deg": "lon", "height_m": "alt"},
)
_CPHD = (
    "<CPHD </ CPHD/1.0.1 XML_BLOCK_SIZE := PVP_BLOCK_BYTE_OFFSET SIGNAL_BLOCK_BYTE_OFFSET -1 99999999999999999999 \x0c "
    "<Offset> <Format> CI4 F8 <!DOCTYPE <!ENTITY &x; SYSTEM <SGN> TOA BISTATIC MONOSTATIC \x7f\xf0\x00\x00"
)
_ZARR = (
    f"{_JSON} blosc zstd sharding_indexed numcodecs.pickle complex64 float64 r16 shape chunk_shape 99999999999999999999"
)
_TIMES = "2025-05-14T09:30:60Z 9999-12-31 0001-01-01T00:00:00+23:59 now NaT 2025-W20-3 T Z , ; : / - ."
_DATAFLASH = "FMT, GPS, GPA, ATT, PARM, FMTU, UNIT, MULT, TimeUS,I,Status QBBIHBcLLeffffB QZaMn , ,,,, 128 1e999 nan"
_JSON_TREE = (mutators.json_tree,)
_YAML_TREE = (mutators.yaml_tree, mutators.yaml_tree, mutators.bomb)
_CSV = (mutators.cells(","), mutators.cells(","), mutators.quoted_cells)

_PULSE = PulseWaveform(
    kind="samples", carrier_hz=1.2e9, sample_rate_hz=1e6, prf_hz=1e3, pulse_s=seeds.SYMBOLS * 1e-6, listen_s=1e-4
)

PARSERS: dict[str, Parser] = {
    "config.yaml": Parser("config.yaml", seeds.configs, read_settings, _YAML_TREE, _YAML),
    "flights.tsv": Parser(
        "flights.tsv",
        seeds.flights,
        lambda path: list(read_flights(path, nodes=seeds.NODES)),
        (mutators.cells("\t"),),
        "\t \t\t image calibration uav1, , fused layers",
    ),
    "segments.tsv": Parser(
        "segments.tsv",
        seeds.segments,
        lambda path: list(read_segments(path, flights=[FLIGHT])),
        (mutators.cells("\t"),),
        _TIMES,
    ),
    "clocks.tsv": Parser(
        "clocks.tsv",
        seeds.clocks,
        lambda path: list(read_clocks(path, flights=[FLIGHT])),
        (mutators.cells("\t"),),
        "f01 uav1 uav2 nan inf 1e400 5e9 - . 1_0",
    ),
    "scans.out": Parser("uav1.out", seeds.scans, lambda path: read_pulson([path], pair="uav1-uav1"), (), "\xf2\x01"),
    "sigmf-meta": Parser("uav1.sigmf-meta", seeds.sigmf_meta, _metadata, _JSON_TREE, _SIGMF),
    "sigmf-growing": Parser("uav1.sigmf-meta", seeds.sigmf_meta, _growing, _JSON_TREE, _SIGMF),
    "sigmf-data": Parser("uav1.sigmf-data", seeds.sigmf_data, _samples),
    "sigmf-floats": Parser("uav1.sigmf-data", seeds.sigmf_floats, _floats),
    "sigmf-collection": Parser(
        "flight.sigmf-collection",
        seeds.sigmf_collections,
        _collection,
        _JSON_TREE,
        f"{_JSON} core:streams apertura:nodes name hash rx_0 ../rx_0",
    ),
    "track.csv": Parser("uav1.track.csv", seeds.tracks, lambda path: read_track(path, node="uav1"), _CSV, _TIMES),
    "track.pos": Parser(
        "uav1.track.pos",
        seeds.solutions,
        lambda path: read_track(path, node="uav1"),
        (mutators.cells(" "),),
        f"{_TIMES} % GPST UTC JST latitude(deg) Q sdn(m) /geodetic 99999999999",
    ),
    "other.pos": Parser(
        "uav1.track.pos",
        seeds.other_solutions,
        lambda path: read_track(path, node="uav1"),
        (mutators.cells(" "), mutators.cells(",")),
        f"{_TIMES} % JST ref pos : x-ecef(m) e-baseline(m) latitude(d'\") sdxy(m) Q -0",
    ),
    "mapped.csv": Parser(
        "uav1.track.csv",
        seeds.mapped_tracks,
        lambda path: read_track(path, node="uav1", options=_MAPPED),
        _CSV,
        "t lat lon alt time_s time_utc x_m 1e9 4e9",
    ),
    "track.nmea": Parser(
        "uav1.track.nmea",
        seeds.nmea,
        lambda path: read_track(path, node="uav1", options=LogOptions(start_utc="2025-05-14")),
        (mutators.resealed, mutators.resealed, mutators.cells(",")),
        "$ * $GPGGA, $GNRMC, $GPZDA, $GPGST, *00 240060.00 235960 311299 A V M N S",
    ),
    "airdata.csv": Parser(
        "uav1.track.csv",
        seeds.airdata,
        lambda path: read_track(path, node="uav1", options=LogOptions(height_offset_m=17.0)),
        _CSV,
        f"{_TIMES} time(millisecond) datetime(utc) satellites (feet) 1e300",
    ),
    "capture.csv": Parser(
        "uav1.track.csv",
        seeds.captures,
        lambda path: read_track(path, node="uav1", options=LogOptions(start_utc="2025-05-14", body="Radar")),
        (mutators.cells(","),),
        "Quaternion Global Meters Millimeters Radar Type Name Frame X W Rotation Position",
    ),
    "track.ulg": Parser(
        "uav1.track.ulg",
        seeds.ulogs,
        _autopilot(ulog_fields.read_fields, px4_ulog.track_of),
        (),
        "ULog\x01\x12\x35 vehicle_gps_position sensor_gps: uint64_t timestamp; int32_t[9] lat D\x00 A\x00 \x2f\x73\x13",
        True,
    ),
    "track.bin": Parser(
        "uav1.track.bin",
        seeds.dataflash_logs,
        _autopilot(dataflash_fields.read_fields, ardupilot.track_of),
        (),
        f"{_DATAFLASH} \xa3\x95\x80 \xa3\x95\x82",
        True,
    ),
    "track.log": Parser(
        "uav1.track.log",
        seeds.dataflash_texts,
        _autopilot(dataflash_fields.read_fields, ardupilot.track_of),
        (mutators.cells(","),),
        _DATAFLASH,
        True,
    ),
    "pattern.csv": Parser("horn.csv", seeds.patterns, read_beam_pattern, _CSV, "cut azimuth elevation angle_deg , -"),
    "codes.npy": Parser("codes.npy", seeds.codes, lambda path: CodeTable(path, seeds.SYMBOLS), (), _NPY),
    "pulse.npy": Parser("pulse.npy", seeds.pulses, lambda path: read_pulse(path, _PULSE), (), _NPY),
    "preamble.npy": Parser("preamble.npy", seeds.preambles, _preamble, (), _NPY),
    "afrl.mat": Parser(
        "a.x.mat", seeds.matlab, _history, (), "MATLAB\x00 IM MI fp freq r0 x\x9c \x0e\x00 \x0f\x00", True
    ),
    "cphd": Parser("b.cphd", seeds.cphd, _cphd, (), _CPHD, True),
    "history.h5": Parser("b.h5", seeds.hdf5, _hdf5, (), "\x89HDF TREE SNOD HEAP GCOL OHDR FRHP transfer units", True),
    "history.zarr": Parser("b.zarr/transfer/zarr.json", seeds.zarr_arrays, _zarr, _JSON_TREE, _ZARR, True),
    "beat.npy": Parser("uav1.npy", beats.arrays, beats.read_array, (), _NPY),
    "beat.time.npy": Parser("uav1.time.npy", beats.times, beats.read_times, (), f"{_NPY} '<M8[ns]' '<M8[Y]' '<M8'"),
    "beat.mat": Parser("uav1.mat", beats.matlab, beats.read_matlab, (), "MATLAB\x00 IM MI beat time \x0e\x00", True),
    "beat.wav": Parser("uav1.wav", beats.sounds, beats.read_sound, (), "RIFF WAVE fmt\x20 data LIST RF64 ds64", True),
    "dem.tif": Parser("dem.tif", seeds.dems, _dem, (), _TIFF),
    "geoid.gtx": Parser("egm96.gtx", seeds.gtx_grids, _geoid),
    "geoid.tif": Parser("egm96.tif", seeds.tif_grids, _geoid, (), _TIFF),
    "flight plan": Parser("plan.yaml", seeds.flight_plans, read_flight_plan, _YAML_TREE, f"{_YAML} kind: line circle"),
    "mission.plan": Parser("a.plan", seeds.missions, read_mission, _JSON_TREE, "SimpleItem null 16 178 3 0 1e400"),
    "mission.waypoints": Parser("a.waypoints", seeds.waypoints, read_mission, (mutators.cells("\t"),), "QGC WPL nan 3"),
    "mission.kml": Parser("a.kml", seeds.kmls, read_mission, (), "<coordinates> </LineString> , nan 1e400"),
    "simulation.yaml": Parser("spec.yaml", seeds.specifications, read_specification, _YAML_TREE, f"{_YAML} 1+2j kind:"),
    "scene.json": Parser(
        "results/scene.json",
        lambda: seeds.documents(seeds.SCENE),
        lambda path: settled_scene(Campaign(_recorded(path).parents[1], None, ())),  # type: ignore[arg-type]
        _JSON_TREE,
        _JSON,
    ),
    "manifest.json": Parser(
        "results/scene.manifest.json",
        lambda: seeds.documents(seeds.MANIFEST),
        read_manifest,
        _JSON_TREE,
        _JSON,
    ),
    "calibration.json": Parser(
        "results/c01/calibration.json",
        lambda: seeds.documents({"pairs": {"uav1-uav1": seeds.OFFSET, "uav1-uav2": seeds.OFFSET}}),
        _calibration,
        _JSON_TREE,
        _JSON,
    ),
    "constants.json": Parser(
        "calibration.json",
        lambda: seeds.documents(seeds.CONSTANTS),
        read_constants,
        _JSON_TREE,
        _JSON,
    ),
    "assessment.json": Parser(
        "results/f01/assessment.json",
        lambda: seeds.documents(seeds.ASSESSED),
        lambda path: assessment_of(Campaign(_recorded(path).parents[2], None, (FLIGHT,)), "f01"),  # type: ignore[arg-type]
        _JSON_TREE,
        _JSON,
    ),
    "tag.json": Parser("tag.json", products.tag_texts, products.read_tag_text, _JSON_TREE, _JSON),
    "product.tif": Parser(
        "slc.tif", products.rasters, products.read_product, (), f"{_TIFF} <GDALMetadata> <Item name="
    ),
    "product.png": Parser(
        "quicklook.png", products.pictures, products.read_product, (), "\x89PNG IHDR IDAT tEXt zTXt iTXt iCCP IEND eXIf"
    ),
    "image.json": Parser(
        "results/f01/fused/image.json",
        lambda: seeds.documents(seeds.REPORTED),
        lambda path: OpenCampaign(Campaign(_listed(path).parents[3], None, (FLIGHT,))).report("f01", "fused"),  # type: ignore[arg-type]
        _JSON_TREE,
        _JSON,
    ),
}
