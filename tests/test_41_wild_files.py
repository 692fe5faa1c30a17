"""Malformed files and files of other programs: each is read correctly or refused with one message."""

import hashlib
import io
import json
import os
import struct
from dataclasses import asdict

import numpy as np
import pytest
import rasterio
from autopilot_logs import dataflash, dataflash_rows, ulog, ulog_receiver
from folders import complaint, edit_meta
from pyproj import Transformer
from rasterio import Affine
from rasterio.transform import from_origin
from scipy.io import savemat, wavfile

from apertura.campaign.config import read_segments
from apertura.campaign.folder import Campaign
from apertura.check import problems
from apertura.core.echo.dechirp import FrequencySweep, transfer_of
from apertura.core.geometry.geodesy import ecef_from_geodetic
from apertura.core.scene.dem import height_range, open_dem
from apertura.core.scene.grid import SceneGrid
from apertura.formats.code_tables import CodeTable
from apertura.formats.phase_histories.pulson import MESSAGE, SAMPLE_RATE_HZ
from apertura.formats.reading import read_phase_history, read_track
from apertura.formats.recordings.sigmf import open_sigmf
from apertura.formats.tracks.log_options import LogOptions
from apertura.stages import ingest
from apertura.stages.transmitted import read_framing
from tests.attack import logs

# The campaign folder


def test_folder_name_that_is_not_utf_8_is_refused(tiny):
    latin_1_path = os.fsdecode(os.fsencode(tiny.parent) + b"/S\xfcd")
    tiny.rename(latin_1_path)
    for root in (latin_1_path, f"{latin_1_path}/."):
        message = complaint(lambda root=root: Campaign.load(root))
        assert "the path is not UTF-8 text; expected UTF-8 names of the folder and its parent folders" in message
        assert "LC_ALL=C.UTF-8" in message
        assert [str(problem) for problem in problems(root)] == [message]
        assert message.isprintable()


# Tables of the config


def test_tables_that_are_not_utf_8_are_refused_with_the_line(tiny):
    path = tiny / "config" / "flights.tsv"
    path.write_bytes(path.read_bytes() + b"f\xe9\timage\tuav1\tuav1\n")
    assert "flights.tsv: byte 0xe9 in line 3 is not UTF-8" in complaint(lambda: Campaign.load(tiny))
    segments = tiny / "config" / "segments.tsv"
    segments.write_bytes(b"flight\tpair\tstart\tend\n\xff\n")
    assert "byte 0xff in line 2" in complaint(lambda: list(read_segments(segments, flights=())))


def test_table_with_windows_line_ends_and_bom_is_read(tiny):
    path = tiny / "config" / "flights.tsv"
    flights = Campaign.load(tiny).flights
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert Campaign.load(tiny).flights == flights


@pytest.mark.parametrize("line", ["# f02\timage\tuav1\tuav1", "#f02", "\t\t\t", "   ", "\t\t\t\t\t\t", ""])
@pytest.mark.parametrize("first", [True, False])
def test_comments_and_blank_lines_of_a_table_are_skipped(tiny, line, first):
    for name in ("flights.tsv", "segments.tsv"):
        path = tiny / "config" / name
        if name == "segments.tsv":
            times = "2025-05-14T09:30:00\t2025-05-14T09:40:00"
            path.write_text(f"flight\tpair\tstart\tend\nf01\tuav1-uav1\t{times}\n")
        plain = Campaign.load(tiny)
        lines = path.read_text().splitlines()
        lines.insert(0 if first else 1, line)
        path.write_text("\n".join([*lines, line]) + "\n")
        commented = Campaign.load(tiny)
        assert (commented.flights, commented.segments) == (plain.flights, plain.segments)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("f02\timage\tuav1\tuav1\tmore", "5 cells, the last of which is 'more'"),
        ('f02\timage\tuav1\t"uav1', "not readable as a table"),
        ("f02\timage\tuav1\t" + "x" * 200_000, "field larger than field limit"),
        ("f02\t\x1b[31mred\tuav1\tuav1", r"unknown kind '\x1b[31mred', not one of"),
        ("f02\timage\tuav1\t" + "x" * 2000, "xxx…' is not in"),
    ],
)
def test_malformed_line_of_flights_is_reported(tiny, line, expected):
    path = tiny / "config" / "flights.tsv"
    path.write_text(path.read_text().rstrip("\n") + "\n" + line + "\n")
    message = complaint(lambda: Campaign.load(tiny))
    assert "flights.tsv: line 3" in message
    assert expected in message
    assert message.isprintable()
    assert len(message) < 600


@pytest.mark.parametrize(
    "time", ["0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59-23:59", "1066-10-14T09:00:00", "now"]
)
def test_segment_at_an_impossible_time_is_refused(tiny, time):
    (tiny / "config" / "segments.tsv").write_text(f"flight\tpair\tstart\tend\nf01\tuav1-uav1\t{time}\t{time}\n")
    assert "is not a valid time" in complaint(lambda: Campaign.load(tiny))


# Arrays


def codes(tmp_path, content):
    path = tmp_path / "codes.npy"
    if isinstance(content, np.ndarray):
        np.save(path, content)
    else:
        path.write_bytes(content)
    return lambda: CodeTable(path, 64)[np.zeros(1, int)][0]


def header(shape):
    text = f"{{'descr': '<c8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + bytes(512)


def zipped():
    target = io.BytesIO()
    np.savez(target, codes=np.ones(64, np.complex64))
    return target.getvalue()


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (np.full(64, "text"), "<U4 of shape (64,)"),
        (np.zeros(64, "V8"), "|V8 of shape (64,)"),
        (np.ones(64), "<f8 of shape (64,)"),
        (np.ones(64, np.int16), "<i2 of shape (64,)"),
        (np.ones(64, [("re", "f4"), ("im", "f4")]), "of shape (64,)"),
        (np.ones((8, 8), np.complex64), "complex64 of shape (8, 8)"),
        (np.full(64, 1e300 + 0j), "64 not finite"),
        (np.full(64, np.nan, np.complex64), "64 not finite"),
        (zipped(), "not a .npy file"),
        (b"", "not a .npy file"),
        (header((999_999_999_999,)), "not readable"),
        (header("(-1,)"), "not readable"),
        (header("(" * 90), "not readable"),
        (header((65,))[:300], "not readable"),
    ],
)
def test_codes_that_are_no_complex_symbols_are_refused(tmp_path, content, expected):
    message = complaint(codes(tmp_path, content))
    assert "codes.npy: " in message
    assert expected in message


def test_oversized_codes_are_refused_by_their_header(tmp_path):
    """The file is sparse and has the size stated in its header; reading it would allocate 2 TiB."""
    read = codes(tmp_path, header((1 << 38,)))
    os.truncate(tmp_path / "codes.npy", 128 + (8 << 38))
    assert "complex64 of shape (274877906944,)" in complaint(read)


@pytest.mark.parametrize("dtype", [np.complex64, np.complex128, ">c8"])
def test_codes_of_any_precision_and_byte_order_are_read(tmp_path, dtype):
    symbols = np.exp(0.5j * np.pi * np.arange(64)).astype(np.complex64)
    np.testing.assert_array_equal(codes(tmp_path, symbols.astype(dtype))(), symbols)


FRAMING = {"chip_samples": 2, "centre_hz": 0.0, "counter_bits": 8, "bit_chips": 3, "guard_samples": 4}


def test_preamble_consists_of_chips_plus_and_minus_one(tmp_path):
    path = tmp_path / "preamble.npy"
    for chips in (np.array([1, 2]), np.array([1.0, np.nan]), np.ones((2, 2)), np.zeros(0), np.array(["1"])):
        np.save(path, chips)
        assert "preamble.npy: " in complaint(lambda: read_framing(path, FRAMING, sample_rate_hz=1e6, where=path))
    np.save(path, np.array([1.0, -1.0, 1.0]))
    assert read_framing(path, FRAMING, sample_rate_hz=1e6, where=path).preamble.tolist() == [1, -1, 1]
    oversized = FRAMING | {"guard_samples": 1 << 39}
    assert "samples of preamble" in complaint(lambda: read_framing(path, oversized, sample_rate_hz=1e6, where=path))


# Metadata of recordings


def set_global(meta, **changes):
    meta["global"].update({f"apertura:{name}": value for name, value in changes.items()})


@pytest.mark.parametrize(
    ("part", "changes", "expected"),
    [
        ("global", {"apertura:channels": 3}, "global.apertura:channels: "),
        ("global", {"apertura:channels": ["radar", "radar"]}, "one unique name per channel"),
        ("global", {"core:sample_rate": float("inf")}, "invalid JSON: "),
        ("global", {"core:sample_rate": 1e308}, "core:sample_rate: "),
        ("global", {"core:sample_rate": 1e-3}, "core:sample_rate: "),
        ("global", {"apertura:channels": ["radar", "\x1b[2J"]}, "apertura:channels.1: "),
        ("global", {"core:num_channels": 2**70}, "invalid JSON: parse error: integer overflow"),
        ("global", {"core:datatype": "\x1b[2J"}, r"core:datatype '\x1b[2J'"),
        ("capture", {"apertura:frame": float("nan")}, "invalid JSON: "),
        ("capture", {"apertura:frame": "text"}, "apertura:frame: "),
        ("capture", {"apertura:frame": 2**62}, "captures.3.apertura:frame: "),
        ("capture", {"core:sample_start": 2**62}, "captures.3.core:sample_start: "),
        ("capture", {"core:sample_start": 10**400}, "invalid JSON: "),
        ("capture", {"core:frequency": float("nan")}, "invalid JSON: "),
        ("capture", {"core:datetime": "99999-01-01T00:00:00Z"}, "is not a time"),
        ("capture", {"core:datetime": "2300-01-01T00:00:00Z"}, "is not between 1980 and 2199"),
        ("capture", {"core:datetime": "1600-01-01T00:00:00Z"}, "is not between 1980 and 2199"),
        ("global", {"core:offset": 1}, "capture 0: core:sample_start 0; expected at least core:offset 1"),
        ("global", {"core:extensions": [{"name": "packed", "version": "1", "optional": False}]}, "requires 'packed'"),
        ("capture", {"core:datetime": "nowZ"}, "is not a time"),
        ("capture", {"core:datetime": "NaTZ"}, "is not a time"),
        ("capture", {"core:datetime": "2025-02-30T00:00:00Z"}, "core:datetime: "),
    ],
)
def test_malformed_metadata_are_refused_by_key(tiny, part, changes, expected):
    edit_meta(tiny, "uav1", lambda meta: (meta["global"] if part == "global" else meta["captures"][3]).update(changes))
    message = complaint(lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav1"))
    assert "uav1.sigmf-meta: " in message
    assert expected in message
    assert len(message) < 600


def test_sample_starts_of_a_split_recording_count_from_its_offset(tiny):
    """SigMF: core:offset is the index of the first sample of the file, and core:sample_start includes it."""

    def split(meta):
        meta["global"] |= {"core:offset": 1000, "core:extensions": [{"name": "antenna", "optional": False}]}
        for capture in meta["captures"]:
            capture["core:sample_start"] += 1000

    files = [tiny / "raw" / "f01" / f"uav1.sigmf-{kind}" for kind in ("meta", "data")]
    whole = open_sigmf(*files)
    edit_meta(tiny, "uav1", split)
    part = open_sigmf(*files)
    np.testing.assert_array_equal(part.captures.start, whole.captures.start)
    start = part.captures.start[1:2]
    np.testing.assert_array_equal(part.samples.captures(start, 8), whole.samples.captures(start, 8))


@pytest.mark.parametrize("name", ["/etc/passwd", "../preamble.npy", "raw/../../x.npy", "link.npy"])
def test_preamble_outside_the_campaign_is_not_opened(tiny, name):
    (tiny / "link.npy").symlink_to("/etc/passwd")

    def one_capture(meta):
        meta["captures"] = meta["captures"][:1]
        set_global(meta, framing=FRAMING | {"preamble": name})

    edit_meta(tiny, "uav1", one_capture)
    message = complaint(lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav1"))
    if name == "link.npy":
        assert "link.npy: a symbolic link" in message
    else:
        assert "uav1.sigmf-meta: apertura:framing.preamble: path" in message
        assert "inside the campaign folder" in message


# Files of other programs, each read correctly or refused with one message

TIMES, GEODETIC = logs.circle()
ECEF = ecef_from_geodetic(*GEODETIC.T)
LATER = TIMES + np.timedelta64(1, "h")
CSV = "time_utc,latitude_deg,longitude_deg,height_m"
PLAIN = [f"{time}Z,{a:.9f},{b:.9f},{h:.6f}" for time, (a, b, h) in zip(TIMES, GEODETIC, strict=True)]
LLH = "latitude(deg) longitude(deg) height(m)"


def gns(time, geodetic):
    """Return a GNS sentence, which some receivers send instead of GGA."""
    body = logs.gga(time, geodetic)[1:].partition("*")[0].split(",")
    return logs.sealed(",".join(["GNGNS", *body[1:6], "RR", *body[7:10], body[11], "", ""]))


def csv_log(*lines, heading=CSV):
    return "a.track.csv", "\n".join([heading, *lines]) + "\n"


def west(longitude):
    """Return the geodetic positions of the flight, displaced by a longitude in degrees."""
    return GEODETIC * [1, 0, 1] + [0, longitude, 0]


LOGS = {
    "rtklib: longitudes from 0 to 360": (
        "a.track.pos", logs.solution(TIMES, west(350.05), LLH), {}, ecef_from_geodetic(*west(-9.95).T),
    ),
    "rtklib: status records (.stat)": (
        "a.track.pos", "$POS,2366,293418.000,1,4177000.0,733000.0,4747000.0,0.01,0.01,0.01\n" * 9, {},
        "no header line with latitude(deg)",
    ),
    "rtklib: heights above the geoid, without the geoid separation": (
        "a.track.pos", logs.solution(TIMES, GEODETIC, LLH).replace("/ellipsoidal", "/geodetic"), {},
        "nodes.a.log.height_offset_m",
    ),
    "nmea: BeiDou talkers, GGA and ZDA, below the ellipsoid": (
        "a.track.txt",
        "".join(
            f"{logs.zda(time)}\r\n{logs.gga(time, place - [0, 0, 650], talker='GB', separation='-31.2')}\r\n"
            for time, place in zip(TIMES, GEODETIC, strict=True)
        ),
        {}, ecef_from_geodetic(*(GEODETIC - [0, 0, 650]).T),
    ),
    "nmea: GNS without GGA": (
        "a.track.nmea", "".join(f"{logs.rmc(t)}\n{gns(t, p)}\n" for t, p in zip(TIMES, GEODETIC, strict=True)), {},
        "no GGA, but 40 GNS; expected an NMEA 0183 log with GGA. Log the unmodified GGA",
    ),
    "csv: index column of pandas, all cells quoted": (
        *csv_log(
            *(",".join(f'"{cell}"' for cell in [number, *row.split(",")]) for number, row in enumerate(PLAIN)),
            heading='"",' + ",".join(f'"{name}"' for name in CSV.split(",")),
        ),
        {}, ECEF,
    ),
    "csv: times of PostgreSQL, zone +00": (
        *csv_log(*(row.replace("T", " ").replace("Z,", "+00,") for row in PLAIN), heading=CSV.replace("_utc", "")),
        {}, ECEF,
    ),
    "csv: hemispheres behind degrees": (
        *csv_log(*(row.replace(",9.9", "E,9.9") for row in PLAIN)), {}, "column latitude_deg: '48.4",
    ),
    "csv: seconds of GPS week alone": (
        *csv_log(*(f"{293418 + n}{row[30:]}" for n, row in enumerate(PLAIN)), heading=CSV.replace("utc", "s")), {},
        "nodes.a.log.start_utc",
    ),
    "px4: two logs joined by cat": (
        "a.track.ulg", ulog(("sensor_gps", 0, ulog_receiver())) * 2, {},
        "a second log starts at byte 3821: separate concatenated logs",
    ),
    "px4: encrypted": ("a.track.ulg", b"ULogEnc\x01" + bytes(4000), {}, "not readable (Invalid file format"),
    "ardupilot: a page of zeros before the first message": (
        "a.track.bin", bytes(512) + dataflash(dataflash_rows()), {}, 60,
    ),
    "ardupilot: telemetry, .tlog": (
        "a.track.bin", b"\xfe\x09\x00\x01\x01\x00" * 900, {}, "without 'FMT' in its first 8192 bytes",
    ),
    "airdata: saved by a spreadsheet with German number format": (
        "a.track.csv", logs.airdata(TIMES, GEODETIC).replace(",", ";").replace(".", ","), {"height_offset_m": 48.0},
        "are separated by semicolons",
    ),
    "airdata: two flights in one file": (
        "a.track.csv", logs.airdata(TIMES, GEODETIC) + logs.airdata(LATER, GEODETIC).partition("\n")[2],
        {"height_offset_m": 48.0}, "column time(millisecond) does not increase",
    ),
    "optitrack: a take that starts late, in millimetres": (
        "a.track.csv",
        logs.capture(
            20 + np.arange(12) / 360,
            {name: pose * np.r_[np.ones(4), np.full(3, 1e3)] for name, pose in logs.poses().items()},
            unit="Millimeters",
        ),
        {"start_utc": "2025-05-14", "body": "Radar"}, 12,
    ),
    "optitrack: markers alone": (
        "a.track.csv", logs.capture(np.arange(12) / 360, {}), {"start_utc": "2025-05-14"}, "no rigid body",
    ),
}  # fmt: skip


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("case", LOGS)
def test_logs_of_other_programs_are_read_or_refused_with_one_message(tmp_path, case):
    name, content, options, expected = LOGS[case]
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())

    def read():
        return read_track(path, node="a", options=LogOptions(**options))

    if isinstance(expected, str):
        message = complaint(read)
        assert expected in message
        assert message.isprintable()
        assert len(message) < 800
    elif isinstance(expected, int):
        assert read().sizes["epoch"] == expected
    else:
        np.testing.assert_allclose(read().position.values, expected, atol=2e-5, rtol=0)


SWEEP = FrequencySweep(2.26e9, 330e6, 2e-3, 44_100.0)
FMCW = {
    **asdict(SWEEP), "kind": "fmcw", "prf_hz": 100.0, "start_utc": "2025-05-14T09:30",
    "trigger": {"sync_channel": 1, "beat_channel": 2, "edge": "rising", "threshold": 0.3},
}  # fmt: skip
BEATS = np.random.default_rng(8).normal(size=(9, SWEEP.sweep_samples))


def scans():
    """Return the bytes of four scans of 350 samples of a PulsON radar."""
    messages = np.zeros(4, MESSAGE)
    messages["type"], messages["source"], messages["step_bins"], messages["kind"] = 0xF201, 1, 32, 1
    messages["start_ps"], messages["stop_ps"] = 10_000, 10_000 + round(350 / SAMPLE_RATE_HZ * 1e12)
    messages["total"], messages["messages"], messages["antenna"] = 350, 1, 2
    messages["id"], messages["time_ms"] = np.arange(4), 1000 + 20 * np.arange(4)
    messages["scan"] = np.random.default_rng(2).normal(0, 1e4, (4, 350)).round()
    return bytes(32) + messages.tobytes()


def npy_bytes(array, **more):
    """Return the bytes of a .npy file."""
    stream = io.BytesIO()
    np.save(stream, array, **more)
    return stream.getvalue()


def matlab(version="5", **fields):
    stream = io.BytesIO()
    savemat(stream, fields, format=version)
    return stream.getvalue()


def sound(dtype, channels=2, rate=44_100):
    """Return a recording of a sound card: nine sweeps, sync in channel 1."""
    samples = np.zeros((4000, channels))
    for number in range(9):
        first = 50 + 441 * number
        samples[first : first + SWEEP.sweep_samples, 0] = 0.9
        samples[first : first + SWEEP.sweep_samples, -1] = BEATS[number] / 10
    top = {"i2": 2**15 - 1, "i4": 2**31 - 1, "f4": 1.0, "u1": 127}[dtype]
    stream = io.BytesIO()
    wavfile.write(stream, rate, (samples * top + 128 * (dtype == "u1")).astype(dtype))
    return stream.getvalue()


def of_24_bits(wav):
    """Convert a .wav file of 32 bits to 24 bits with the extensible header that recorders write."""
    numbers = np.frombuffer(wav[44:], "<i4").view(np.uint8).reshape(-1, 4)[:, 1:].tobytes()
    fmt_chunk = (
        struct.pack("<HHIIHHHHI", 0xFFFE, 2, 44_100, 44_100 * 6, 6, 24, 22, 24, 3)
        + b"\x01\x00"
        + bytes.fromhex("000000001000800000aa00389b71")
    )
    chunks = (
        b"fmt " + struct.pack("<I", len(fmt_chunk)) + fmt_chunk + b"data" + struct.pack("<I", len(numbers)) + numbers
    )
    return b"RIFF" + struct.pack("<I", 4 + len(chunks)) + b"WAVE" + chunks


def gotcha(**changes):
    """Return AFRL's structure of 8 frequencies and 5 pulses in the format of MATLAB."""
    pulses = np.arange(5.0)
    fields = {
        "fp": np.exp(1j * np.arange(40.0)).reshape(8, 5), "freq": 9.3e9 + 1e6 * np.arange(8.0),
        "x": 7000 + pulses, "y": 10 * pulses, "z": np.full(5, 7000.0), "r0": 9900 + pulses,
    }  # fmt: skip
    return matlab(data=fields | changes)


RECORDINGS = {
    "npy: columns first in memory (Fortran)": ("beat_npy", "npy", npy_bytes(np.asfortranarray(BEATS)), 9),
    "npy: big-endian doubles": ("beat_npy", "npy", npy_bytes(BEATS.astype(">f8")), 9),
    "npy: a list of sweeps (pickled objects)": (
        "beat_npy", "npy", npy_bytes(np.array([*BEATS, [1]], object), allow_pickle=True), "not readable",
    ),
    "npy: frames × receivers × samples": ("beat_npy", "npy", npy_bytes(BEATS[:, None]), "of shape (9, 1, 88)"),
    "npy: complex samples where waveform.iq is real": (
        "beat_npy", "npy", npy_bytes(BEATS.astype(complex)), "complex128 samples, but waveform.iq is real",
    ),
    "mat: version 4": ("beat_mat", "mat", matlab("4", beat=BEATS), 9),
    "mat: times as days of MATLAB": (
        "beat_mat", "mat", matlab(beat=BEATS, time=739_751.4 + np.arange(9) * 0.01 / 86400),
        "times in days (MATLAB datenum); expected seconds since 1970",
    ),
    "mat: a table in place of the structure": ("afrl_mat", "mat", matlab(data=BEATS), "no structure data"),
    "mat: phase history in single precision, integer positions": (
        "afrl_mat", "mat", gotcha(fp=np.ones((8, 5), np.complex64), x=np.arange(7000, 7005, dtype=np.int16)), 5,
    ),
    "mat: frequencies that descend": (
        "afrl_mat", "mat", gotcha(freq=9.4e9 - 1e6 * np.arange(8.0)), "frequencies that do not increase in equal steps",
    ),
    "wav: 24 bits, extensible header": ("beat_wav", "wav", of_24_bits(sound("i4")), 9),
    "wav: floats": ("beat_wav", "wav", sound("f4"), 9),
    "wav: eight bits": ("beat_wav", "wav", sound("u1"), 9),
    "wav: one channel": ("beat_wav", "wav", sound("i2", channels=1), "1 channels"),
    "wav: another sample rate": ("beat_wav", "wav", sound("i2", rate=48_000), "48000 samples/s"),
    "wav: an .mp3 that was renamed": ("beat_wav", "wav", b"ID3\x04" + bytes(900), "not readable"),
    "cphd: a SICD image in NITF": ("cphd", "cphd", b"NITF02.10" + b" " * 4000, "not readable"),
    "cphd: version 0.3": (
        "cphd", "cphd", b"CPHD/0.3\nXML_DATA_SIZE := 3000\nXML_BYTE_OFFSET := 100\n\f\n" + bytes(4000), "CPHD/0.3",
    ),
    "pulson: log of the radar's own program, text": (
        "pulson", "out", b"Timestamp, Config, NodeId, ScanStartPs\n" * 90, "without a message MRM_SCAN_INFO",
    ),
    "pulson: ends within a message": ("pulson", "out", scans()[:-500], 3),
}  # fmt: skip


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("case", RECORDINGS)
def test_recordings_of_other_programs_are_read_or_refused_with_one_message(tmp_path, case):
    kind, suffix, content, expected = RECORDINGS[case]
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(content)

    def read():
        return read_phase_history(kind, [path], pair="a-a", described=FMCW if kind.startswith("beat") else {})

    if isinstance(expected, str):
        message = complaint(read)
        assert expected in message
        assert message.isprintable()
        assert len(message) < 800
        return
    echo = read()
    assert echo.sizes["pulse"] == expected
    if kind.startswith("beat"):
        late_s = np.full(9, 0.5 / SWEEP.sample_rate_hz) if kind == "beat_wav" else None  # sync rises between samples
        expected_transfer = transfer_of(BEATS, SWEEP, late_s=late_s)
        scale = np.vdot(echo.transfer.values, expected_transfer) / np.vdot(echo.transfer.values, echo.transfer.values)
        error = np.abs(scale * echo.transfer.values - expected_transfer).max() / np.abs(expected_transfer).max()
        assert error < (0.1 if "eight bits" in case else 1e-3)


RASTER = {"count": 1, "dtype": "float32", "crs": "EPSG:32632", "transform": from_origin(500000, 5400100, 2, 2)}
GROUND = 600 + np.add.outer(0.2 * np.arange(60), 0.3 * np.arange(60))  # slopes by rows and columns of 2 m
GRID = SceneGrid("EPSG:32632", 500030.0, 5400070.0, 1.0, (30, 30))


def raster(path, heights=GROUND, *, write=None, **profile):
    """Write a GeoTIFF of heights."""
    kind = RASTER | {"height": heights.shape[-2], "width": heights.shape[-1]} | profile
    with rasterio.open(path, "w", "GTiff", **kind) as file:
        for band in range(1, kind["count"] + 1):
            file.write(np.asarray(heights if heights.ndim == 2 else heights[band - 1]).astype(kind["dtype"]), band)
        if write is not None:
            write(file)


def rotated():
    """Return heights on a grid of 1 m that is rotated by 30°, and its transform."""
    transform = (
        Affine.translation(500045, 5400055)
        @ Affine.rotation(-30)
        @ Affine.scale(1, -1)
        @ Affine.translation(-100, -100)
    )
    columns, rows = np.meshgrid(np.arange(200) + 0.5, np.arange(200) + 0.5)
    x, y = transform @ (columns, rows)
    return 600 + 0.1 * (5400099 - y) + 0.15 * (x - 500001), transform


def in_web_mercator():
    to_map = Transformer.from_crs("EPSG:3857", "EPSG:32632", always_xy=True)
    west, north = Transformer.from_crs("EPSG:32632", "EPSG:3857", always_xy=True).transform(500000, 5400100)
    x, y = to_map.transform(*np.meshgrid(west + 3 * np.arange(70) + 1.5, north - 3 * np.arange(70) - 1.5))
    return 600 + 0.1 * (5400099 - y) + 0.15 * (x - 500001), from_origin(west, north, 3, 3)


def masked(file):
    file.write_mask(np.pad(np.zeros((4, 4), bool), ((20, 36), (20, 36)), constant_values=True))


def coloured(file):
    file.write_colormap(1, {value: (value, 0, 0) for value in range(256)})


DEMS = {
    "floating-point predictor with DEFLATE, heights about 0": (
        lambda path: raster(path, GROUND - 600, dtype="float32", predictor=3, compress="deflate"),
        -600.0,
    ),
    "BigTIFF, tiled, ZSTD": (
        lambda path: raster(path, BIGTIFF="YES", tiled=True, blockxsize=16, blockysize=16, compress="zstd"),
        0.0,
    ),
    "int16 in decimetres with an offset of 500 m": (
        lambda path: raster(
            path,
            np.rint(10 * (GROUND - 500)),
            dtype="int16",
            write=lambda file: (setattr(file, "scales", (0.1,)), setattr(file, "offsets", (500.0,))),
        ),
        0.0,
    ),
    "rotated by 30 degrees": (lambda path: raster(path, rotated()[0], transform=rotated()[1]), 0.0),
    "Web Mercator": (
        lambda path: raster(path, in_web_mercator()[0], transform=in_web_mercator()[1], crs="EPSG:3857"),
        0.0,
    ),
    "another UTM zone": (
        lambda path: raster(path, crs="EPSG:32633", transform=from_origin(60000, 5420000, 2, 2)),
        "% of the scene lies outside",
    ),
    "internal mask": (lambda path: raster(path, write=masked), "no height at"),
    "NaN as no-data value": (
        lambda path: raster(
            path, np.where(np.pad(np.ones((3, 3)), ((20, 37), (20, 37))) > 0, np.nan, GROUND), nodata=np.nan
        ),
        "no height at",
    ),
    "shaded relief in colours": (
        lambda path: raster(path, np.stack([GROUND % 255] * 3), count=3, dtype="uint8", photometric="RGB"),
        "colours (red, green, blue), not heights",
    ),
    "land cover with a palette": (
        lambda path: raster(path, GROUND % 9, dtype="uint8", write=coloured),
        "colours (palette), not heights",
    ),
    "complex image": (lambda path: raster(path, dtype="complex64"), "heights of type complex64"),
    "kilometres": (
        lambda path: raster(path, GROUND / 1000, write=lambda file: setattr(file, "units", ("km",))),
        "heights in km",
    ),
    "JPEG2000 that was renamed": (
        lambda path: path.write_bytes(b"\0\0\0\x0cjP  \r\n\x87\n" + bytes(900)),
        "not readable as GeoTIFF",
    ),
    "no geotransform and no CRS": (
        lambda path: raster(path, crs=None, transform=Affine.identity()),
        "no geodetic CRS",
    ),
}


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("case", DEMS)
def test_dems_of_other_programs_are_read_or_refused_with_one_message(tmp_path, case):
    write, expected = DEMS[case]
    path = tmp_path / "dem.tif"
    write(path)

    def read():
        terrain = open_dem(path, GRID, datum="ellipsoid")
        height_range(terrain, GRID, where=path)
        return terrain.heights(GRID)

    if isinstance(expected, str):
        message = complaint(read)
        assert expected in message
        assert message.isprintable()
        assert len(message) < 800
    else:
        expected_m = 600 + 0.1 * (5400099 - GRID.y_m)[:, None] + 0.15 * (GRID.x_m - 500001) + expected
        np.testing.assert_allclose(read(), expected_m, atol=0.06)


def with_changes(meta, changes):
    """Set ``part.key`` of the metadata to values, where part is global or the index of a capture."""
    for name, value in changes.items():
        part, _, key = name.partition(".")
        (meta["global"] if part == "global" else meta["captures"][int(part)])[key] = value
    return meta


COUNTS = np.arange(128, dtype="<i2")
NOTES = '[{"core:sample_start": 0, "core:label": "\\u0000"}]'
SIGMF = {
    "byte-order mark and extra white space": ({}, lambda text: ("\ufeff" + text.replace(",", " ,\r\n\t")).encode(), 4),
    "keys of other programs, geolocation, annotations": (
        {"global.core:geolocation": {"type": "Point", "coordinates": [9.9, 48.4]}, "global.gnuradio:block": [1, {}]},
        lambda text: text.replace('"captures"', f'"annotations": {NOTES}, "captures"').encode(), 4,
    ),
    "core:sha512 in capitals": (
        {"global.core:sha512": hashlib.sha512(COUNTS.tobytes()).hexdigest().upper()}, str.encode, 4,
    ),
    "time tags with an offset": (
        {"1.core:datetime": "2025-05-14T11:30:01+02:00"}, str.encode, "captures.1.core:datetime: ",
    ),
    "metadata in UTF-16": ({}, lambda text: text.encode("utf-16"), "not valid SigMF: invalid JSON"),
    "metadata cut off": ({}, lambda text: text[:-40].encode(), "not valid SigMF: invalid JSON"),
    "captures that are not sorted": ({"2.core:sample_start": 8}, str.encode, "capture 1 contains -8 samples"),
    "real samples without an intermediate frequency": (
        {"global.core:datatype": "ri16_le"}, str.encode, "core:datatype ri16_le without apertura:if_hz",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SIGMF)
def test_sigmf_of_other_programs_is_read_or_refused_with_one_message(tmp_path, case):
    """Read a recording of four captures of 16 samples."""
    changes, text_of, expected = SIGMF[case]
    captures = [
        {"core:sample_start": 16 * n, "core:datetime": f"2025-05-14T09:30:0{n}Z", "core:frequency": 1.2e9}
        for n in range(4)
    ]
    fields = {"core:datatype": "ci16_le", "core:version": "1.2.0", "core:sample_rate": 1e6}
    meta, data = tmp_path / "a.sigmf-meta", tmp_path / "a.sigmf-data"
    meta.write_bytes(text_of(json.dumps(with_changes({"global": fields, "captures": captures}, changes))))
    data.write_bytes(COUNTS.tobytes())
    if isinstance(expected, str):
        message = complaint(lambda: open_sigmf(meta, data))
        assert expected in message
        assert message.isprintable()
        assert len(message) < 800
        return
    recording = open_sigmf(meta, data)
    recording.check_hash()
    assert len(recording.captures.start) == expected
    iq = recording.samples.captures(recording.captures.start, 16)
    np.testing.assert_array_equal(iq.ravel(), COUNTS)
