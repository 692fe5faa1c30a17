"""Files of a campaign that no person would write: each is one message where a traceback, or nothing, used to be."""

import io
import json
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from folders import complaint, edit_config, edit_meta, edit_track

from apertura.campaign import Campaign
from apertura.ingest import read_track
from apertura.load.results import assessment_of, open_campaign
from apertura.load.scene import settled_scene
from apertura.load.transmitted import read_codes, read_framing
from apertura.settings import read_segments
from apertura.steps import ingest
from apertura.steps.calibration import calibrated
from apertura.steps.summary import print_summary
from apertura.steps.verify import verify

# Tables of the config


def test_tables_that_are_not_utf8_are_refused_with_their_line(tiny):
    path = tiny / "config" / "flights.tsv"
    path.write_bytes(path.read_bytes() + b"f\xe9\timage\tuav1\tuav1\n")
    assert "flights.tsv: byte 0xe9 in line 3 is not UTF-8" in complaint(lambda: Campaign.load(tiny))
    segments = tiny / "config" / "segments.tsv"
    segments.write_bytes(b"flight\tpair\tstart\tend\n\xff\n")
    assert "byte 0xff in line 2" in complaint(lambda: list(read_segments(segments, flights=())))


def test_a_table_of_windows_is_read_as_one_of_unix(tiny):
    path = tiny / "config" / "flights.tsv"
    flights = Campaign.load(tiny).flights
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert Campaign.load(tiny).flights == flights


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("f02\timage\tuav1\tuav1\tmore", "5 cells, the last 'more'"),
        ('f02\timage\tuav1\t"uav1', "not readable as a table"),
        ("f02\timage\tuav1\t" + "x" * 200_000, "field larger than field limit"),
        ("f02\t\x1b[31mred\tuav1\tuav1", r"kind '\x1b[31mred' is neither"),
        ("f02\timage\tuav1\t" + "x" * 2000, "xxx…' is not in"),
    ],
)
def test_a_wild_line_of_flights_is_named(tiny, line, expected):
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
def test_a_segment_at_a_time_that_no_flight_had_is_refused(tiny, time):
    (tiny / "config" / "segments.tsv").write_text(f"flight\tpair\tstart\tend\nf01\tuav1-uav1\t{time}\t{time}\n")
    assert "is no time" in complaint(lambda: Campaign.load(tiny))


# Arrays


def codes(tmp_path, content):
    path = tmp_path / "codes.npy"
    if isinstance(content, np.ndarray):
        np.save(path, content)
    else:
        path.write_bytes(content)
    return lambda: read_codes(path, 64)


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
def test_codes_that_are_no_complex_symbols_are_refused_before_anything_is_allocated(tmp_path, content, expected):
    message = complaint(codes(tmp_path, content))
    assert "codes.npy: " in message
    assert expected in message


@pytest.mark.parametrize("kind", [np.complex64, np.complex128, ">c8"])
def test_codes_of_any_precision_and_order_of_bytes_are_the_same(tmp_path, kind):
    symbols = np.exp(0.5j * np.pi * np.arange(64)).astype(np.complex64)
    np.testing.assert_array_equal(codes(tmp_path, symbols.astype(kind))(), symbols)


DESCRIBED = {"chip_samples": 2, "centre_hz": 0.0, "counter_bits": 8, "bit_chips": 3, "guard_samples": 4}


def test_a_preamble_is_chips_of_one_and_minus_one(tmp_path):
    path = tmp_path / "preamble.npy"
    for chips in (np.array([1, 2]), np.array([1.0, np.nan]), np.ones((2, 2)), np.zeros(0), np.array(["1"])):
        np.save(path, chips)
        assert "preamble.npy: " in complaint(lambda: read_framing(path, DESCRIBED, sample_rate_hz=1e6, where=path))
    np.save(path, np.array([1.0, -1.0, 1.0]))
    assert read_framing(path, DESCRIBED, sample_rate_hz=1e6, where=path).preamble.tolist() == [1, -1, 1]
    endless = DESCRIBED | {"guard_samples": 1 << 39}
    assert "samples of preamble" in complaint(lambda: read_framing(path, endless, sample_rate_hz=1e6, where=path))


# Metadata of recordings


def described(meta, **changes):
    meta["global"].update({f"apertura:{name}": value for name, value in changes.items()})


@pytest.mark.parametrize(
    ("place", "changes", "expected"),
    [
        ("global", {"apertura:channels": 3}, "global.apertura:channels: "),
        ("global", {"apertura:channels": ["radar", "radar"]}, "each its own"),
        ("global", {"core:sample_rate": float("inf")}, "core:sample_rate: "),
        ("global", {"core:sample_rate": 1e308}, "core:sample_rate: "),
        ("global", {"core:num_channels": 2**70}, "core:num_channels: "),
        ("global", {"core:datatype": "\x1b[2J"}, r"core:datatype '\x1b[2J'"),
        ("capture", {"apertura:frame": float("nan")}, "apertura:frame: "),
        ("capture", {"apertura:frame": "text"}, "apertura:frame: "),
        ("capture", {"apertura:frame": 2**63}, "apertura:frame: "),
        ("capture", {"core:sample_start": 2**63}, "core:sample_start: "),
        ("capture", {"core:sample_start": 10**400}, "core:sample_start: "),
        ("capture", {"core:frequency": float("nan")}, "core:frequency: "),
        ("capture", {"core:datetime": "99999-01-01T00:00:00Z"}, "is no time"),
        ("capture", {"core:datetime": "2300-01-01T00:00:00Z"}, "is not between 1980 and 2199"),
        ("capture", {"core:datetime": "1600-01-01T00:00:00Z"}, "is not between 1980 and 2199"),
        ("capture", {"core:datetime": "nowZ"}, "is no time"),
        ("capture", {"core:datetime": "NaTZ"}, "is no time"),
        ("capture", {"core:datetime": "2025-02-30T00:00:00Z"}, "core:datetime: "),
    ],
)
def test_metadata_that_no_recorder_writes_are_refused_by_key(tiny, place, changes, expected):
    edit_meta(tiny, "uav1", lambda meta: (meta["global"] if place == "global" else meta["captures"][3]).update(changes))
    message = complaint(lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav1"))
    assert "uav1.sigmf-meta: " in message
    assert expected in message
    assert len(message) < 600


@pytest.mark.parametrize("name", ["/etc/passwd", "../preamble.npy", "raw/../../x.npy", "link.npy"])
def test_a_preamble_outside_the_campaign_is_not_opened(tiny, name):
    (tiny / "link.npy").symlink_to("/etc/passwd")

    def one_capture(meta):
        meta["captures"] = meta["captures"][:1]
        described(meta, framing=DESCRIBED | {"preamble": name})

    edit_meta(tiny, "uav1", one_capture)
    message = complaint(lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav1"))
    assert "uav1.sigmf-meta: apertura:framing.preamble: path" in message
    assert "inside the campaign folder" in message


# Flight logs


def csv_log(tmp_path, *lines, heading="time_utc,latitude_deg,longitude_deg,height_m,yaw_deg"):
    path = tmp_path / "a.track.csv"
    path.write_text("\n".join([heading, *lines]) + "\n")
    return lambda: read_track(path, node="a")


GOOD = "2025-05-14T09:30:00Z,48,9,600,1"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("2025-05-14T09:30:01Z,48,9,1e308,1", "the height between -1000 and 100000 m"),
        ("2025-05-14T09:30:01Z,48,9,inf,1", "epochs without a position"),
        ("2025-05-14T09:30:01Z,48,1e9,600,1", "epochs without a position"),
        ("99999-05-14T09:30:01Z,48,9,600,1", "a.track.csv: "),
        ("2500-05-14T09:30:01Z,48,9,600,1", "a.track.csv: "),
        ("0001-05-14T09:30:01Z,48,9,600,1", "a.track.csv: "),
        (",48,9,600,1", "epoch 1 is at NaT"),
        ("2025-05-14T09:30:01Z,48,9,600,1,7", "more cells than"),
        ("2025-05-14T09:30:01Z,48,9,\x1b[2J,1", r"column height_m: '\x1b[2J'"),
        ("2025-05-14T09:30:01Z,48,9,6_00,1", "column height_m: '6_00'"),
        ("2025-05-14T09:30:01Z,48,True,600,1", "column longitude_deg: 'True'"),
        ('"2025-05-14T09:30:01Z,48', "a.track.csv: "),
    ],
)
def test_a_line_that_no_flight_logs_is_one_message(tmp_path, line, expected):
    message = complaint(csv_log(tmp_path, GOOD, line))
    assert expected in message
    assert message.isprintable()
    assert len(message) < 800


def test_a_column_that_stands_twice_is_named(tmp_path):
    heading = "time_utc,latitude_deg,longitude_deg,height_m,height_m"
    assert "column height_m a second time" in complaint(csv_log(tmp_path, GOOD, GOOD, heading=heading))


def test_a_standard_deviation_below_zero_is_refused(tmp_path):
    heading = "time_utc,latitude_deg,longitude_deg,height_m,std_north_m,std_east_m,std_up_m"
    lines = [f"2025-05-14T09:30:0{n}Z,48,9,600,1,{-n},1" for n in range(3)]
    assert "a standard deviation of -1 in epoch 1" in complaint(csv_log(tmp_path, *lines, heading=heading))


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("inf 5.0 48.0 9.0 600.0 1", "line 3 is"),
        ("99999999999999999999 5.0 48.0 9.0 600.0 1", "line 3 is"),
        ("2366 1e300 48.0 9.0 600.0 1", "line 3 is"),
        ("9999/01/01 00:00:00 48.0 9.0 600.0 1", "is not between 1980 and 2199"),
        ("2025/05/14 09:30:01 48.0 9.0 600.0 257", "Q 257"),
        ("2025/05/14 09:30:01 48.0 9.0 60_0.0 1", "line 3 is"),
        ("2025/05/14 09:30:01 48.0 9.0 \x1b[2J 1", r"\\x1b[2J"),
    ],
)
def test_a_solution_that_no_receiver_writes_is_one_message(tmp_path, line, expected):
    path = tmp_path / "a.track.pos"
    path.write_text(f"% (lat/lon/height=WGS84/ellipsoidal)\n% UTC latitude(deg) longitude(deg) height(m) Q\n{line}\n")
    message = complaint(lambda: read_track(path, node="a"))
    assert expected in message
    assert message.isprintable()


def test_logs_of_windows_are_read_as_those_of_unix(tiny):
    for node in ("uav1", "uav2"):
        path = next((tiny / "raw" / "f01").glob(f"{node}.track.*"))
        track = read_track(path, node=node)
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
        assert read_track(path, node=node).identical(track)


def test_a_log_that_is_not_utf8_is_refused(tiny):
    edit_track(tiny, "uav1", lambda lines: [*lines[:5], lines[5] + "é"])
    for node in ("uav1", "uav2"):
        path = next((tiny / "raw" / "f01").glob(f"{node}.track.*"))
        path.write_bytes(path.read_text().encode("latin-1") + b"\xe9")
        assert path.name in complaint(lambda path=path, node=node: read_track(path, node=node))


# Results


DAMAGE = [b"", b"{", b"[]", b"{}", b'{"grid": 3}', b"\xff", b"null", b'{"pairs": 3}', b'{"pairs": {"uav1-uav2": {}}}']


@pytest.mark.parametrize("content", DAMAGE)
def test_a_damaged_result_is_named_and_to_be_deleted(tiny, content):
    edit_config(
        tiny,
        lambda document: document.update(calibration={"flight": "c01", "reflector_m": [570660.0, 5363700.0, 620.0]}),
    )
    (tiny / "config" / "flights.tsv").write_text(
        "flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\tuav1,uav2\nc01\tcalibration\tuav1\tuav1,uav2\n"
    )
    campaign, results = Campaign.load(tiny), tiny / "results"
    readers = {
        "scene.json": lambda: settled_scene(campaign),
        "c01/calibration.json": lambda: calibrated(campaign, "f01", "uav1-uav2"),
        "f01/assessment.json": lambda: assessment_of(campaign, "f01"),
        "f01/uav1-uav1/image.json": lambda: print_summary(campaign),
    }
    for name, read in readers.items():
        assert "no such file" in complaint(read)
        (results / name).parent.mkdir(parents=True, exist_ok=True)
        (results / name).write_bytes(content)
        message = complaint(read)
        assert f"results/{name}: " in message
        assert "Delete it and run the workflow again" in message or content == b"\xff"
    if content in {b"", b"{", b"[]", b"null"}:
        assert "image.json: damaged" in complaint(lambda: open_campaign(tiny).report("f01", "uav1-uav1"))


def test_a_scene_whose_grid_is_none_is_damaged(tmp_path):
    grid = {
        "crs": "EPSG:32632",
        "west_m": 0,
        "north_m": 0,
        "spacing_m": 1,
        "shape": [2, 2],
        "first": [0, 0],
        "name": "x",
    }
    document = {"grid": grid, "height_m": 1.0, "inputs": {}, "chosen": {}}
    path = tmp_path / "results" / "scene.json"
    path.parent.mkdir()
    path.write_text(json.dumps(document))
    campaign = SimpleNamespace(root=tmp_path)
    assert settled_scene(campaign).grid.shape == (2, 2)
    for change in ({"spacing_m": -1}, {"shape": [1e308, 2]}, {"shape": [0, 2]}, {"west_m": "x"}, {"crs": None}):
        path.write_text(json.dumps(document | {"grid": grid | change}))
        assert "scene.json: damaged" in complaint(lambda: settled_scene(campaign))


def test_a_truth_that_is_none_is_one_message(tiny):
    (tiny / "truth.json").write_text('{"targets": [{"x": "left"}]}')
    assert "truth.json: damaged" in complaint(lambda: verify(Campaign.load(tiny)))
