"""Ingest of recorders and flight logs: the stages contain the arrays that their contracts define."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import tried
from scipy.io import savemat

from apertura.campaign.folder import Campaign
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.contracts import check
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import geodetic_from_ecef
from apertura.formats.beam_pattern import read_beam_pattern
from apertura.formats.names import RECORDERS, TRACKS, LogFormat
from apertura.formats.reading import open_recording, read_phase_history, read_track
from apertura.formats.recordings.recording import Captures, Recording
from apertura.formats.recordings.sample_file import SampleFile
from apertura.formats.tracks.log_options import LogOptions
from apertura.formats.tracks.track import make_track

QUICK = tried(30)
EPOCHS = st.lists(
    st.tuples(st.floats(0.001, 89.9), st.floats(-179.9, 179.9), st.floats(-400, 9000), st.integers(1, 10**9)),
    min_size=2,
    max_size=12,
)
"""Latitude, longitude (deg), height (m), nanoseconds since the previous epoch."""

HEADER = (
    "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix)\n%  {}                  latitude(deg) longitude(deg)  height(m)   Q\n"
)


def pos(path, system, *lines):
    path.write_text(HEADER.format(system) + "\n".join(lines) + "\n")
    return read_track(path, node="a")


def test_gpst_is_18_seconds_ahead_of_utc(tmp_path):
    lines = [f"2025/05/14 09:30:{second}.500   48.0   9.0   600.0   1" for second in (16, 17)]
    gpst, utc = (pos(tmp_path / f"{system}.pos", system, *lines) for system in ("GPST", "UTC"))
    assert (utc.time.values - gpst.time.values == np.timedelta64(18, "s")).all()
    assert gpst.time.values[0] == np.datetime64("2025-05-14T09:29:58.500")


def test_gps_weeks_and_calendar_dates_are_the_same_times(tmp_path):
    dates = pos(tmp_path / "a.pos", "GPST", *(f"2025/05/14 09:30:{s}.000 48.0 9.0 600.0 1" for s in (16, 17)))
    weeks = pos(tmp_path / "b.pos", "GPST", *(f"2366 {293400 + s}.000 48.0 9.0 600.0 1" for s in (16, 17)))
    np.testing.assert_array_equal(dates.time.values, weeks.time.values)


def test_solution_has_its_type_and_standard_deviations(tmp_path):
    columns = "ns   sdn(m)   sde(m)   sdu(m)  sdne(m)"
    lines = [
        f"2025/05/14 09:30:1{n}.0 48.0 9.0 600.0 {q} 18 0.01 0.02 {up} 0.0" for n, q, up in ((6, 1, 0.03), (7, 2, 0.6))
    ]
    (tmp_path / "a.pos").write_text(HEADER.replace("Q\n", f"Q {columns}\n").format("UTC") + "\n".join(lines) + "\n")
    track = check(read_track(tmp_path / "a.pos", node="a"), "track")
    assert track.fix.values.tolist() == [1, 2]
    np.testing.assert_array_equal(track.position_std.values, [[0.01, 0.02, 0.03], [0.01, 0.02, 0.6]])  # north, east, up
    short = pos(tmp_path / "b.pos", "UTC", *(line.partition(" 18")[0] for line in lines))
    assert short.fix.values.tolist() == [1, 2]
    assert "position_std" not in short


CSV = "time_utc,latitude_deg,longitude_deg,height_m,quality,std_north_m,std_east_m,std_up_m\n"


def csv_log(path, *cells):
    rows = [f"2025-05-14T09:30:1{n}Z,48,9,600,{cell}" for n, cell in enumerate(cells)]
    path.write_text(CSV + "\n".join(rows) + "\n")
    return check(read_track(path, node="a", options=LogOptions(quality="rtklib")), "track")


def test_csv_log_has_solution_types_and_standard_deviations(tmp_path):
    track = csv_log(tmp_path / "a.csv", "fix,0.01,0.02,0.03", "Float,1,1,1", ",,,", "5,2,2,2")
    assert track.fix.values.tolist() == [1, 2, 0, 5]
    np.testing.assert_array_equal(track.position_std.values[[0, 2]], [[0.01, 0.02, 0.03], [np.nan] * 3])
    numbers = csv_log(tmp_path / "b.csv", "1,1,1,1", ",1,1,1", "2,1,1,1")  # read by pandas as 1.0, NaN, 2.0
    assert numbers.fix.values.tolist() == [1, 0, 2]
    with pytest.raises(
        CampaignError, match=r"quality 'fixed'; expected .*quality \(fix, float, sbas, dgps, single, ppp"
    ):
        csv_log(tmp_path / "c.csv", "fixed,1,1,1", "1,1,1,1")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2025/05/14 09:30:16.0 48.0 9.0 600.0\n", "no header line"),
        (HEADER.replace("ellipsoidal", "geodetic").format("GPST"), "above a geoid.*nodes.a.log.height_offset_m"),
        (HEADER.format("TAI"), "'TAI'"),
        (HEADER.format("GPST") + "2025/05/14 09:30:16.0 48.0 north 600.0\n", "line 3"),
        (HEADER.format("GPST") + "2025/05/14 09:30:16.0 48.0 9.0 600.0\n", "line 3 has 5 columns, the header 6"),
        (HEADER.format("GPST") + "2017/01/01 00:00:17.5 48.0 9.0 600.0 1\n", "leap second"),
    ],
)
def test_solution_with_an_incomplete_header_is_rejected(tmp_path, text, expected):
    (tmp_path / "a.pos").write_text(text)
    with pytest.raises(CampaignError, match=expected):
        read_track(tmp_path / "a.pos", node="a")


def test_csv_log_keeps_position_and_attitude(tmp_path):
    path = tmp_path / "a.track.csv"
    path.write_text(
        "time_utc,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,yaw_deg\n"
        "2025-05-14T09:30:00Z,48.0,9.0,600.0,1,2,359\n2025-05-14T09:30:01.5Z,48.0,9.0,601.0,1,2,1\n"
    )
    track = check(read_track(path, node="a"), "track")
    np.testing.assert_allclose(geodetic_from_ecef(track.position.values[1]), [48.0, 9.0, 601.0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(track.attitude.values[0]), [1, 2, 359])
    assert track.time.values[1] - track.time.values[0] == np.timedelta64(1500, "ms")


def test_csv_log_without_a_height_column_is_rejected(tmp_path):
    (tmp_path / "a.csv").write_text("time_utc,latitude_deg,longitude_deg\n2025-05-14T09:30:00Z,48,9\n")
    with pytest.raises(CampaignError, match="no column height_m"):
        read_track(tmp_path / "a.csv", node="a")


def raw_of(*files):
    opened = open_recording(files)
    opened.check_hash()
    return opened.cut(opened.captures, node="a")


def iq_of(raw):
    """Return the samples of the stage, (channel, pulse, sample, 2)."""
    file = SampleFile(Path(raw.attrs["samples"]), len(raw.attrs["channels"]))
    return np.moveaxis(file.captures(raw.start.values, raw.attrs["capture_samples"]), 2, 0)


def recording(folder, samples, captures, **header):
    data = folder / "a.sigmf-data"
    samples.astype("<i2").tofile(data)
    meta = {
        "global": {
            "core:datatype": "ci16_le",
            "core:sample_rate": 1e6,
            "core:version": "1.2.5",
            "core:num_channels": samples.shape[1],
            "core:sha512": hashlib.sha512(data.read_bytes()).hexdigest(),
            "core:extensions": [{"name": "apertura", "version": "0.1.0", "optional": True}],
            **header,
        },
        "captures": captures,
        "annotations": [],
    }
    (folder / "a.sigmf-meta").write_text(json.dumps(meta))
    return raw_of(folder / "a.sigmf-meta", data)


def capture(start, second, **more):
    return {"core:sample_start": start, "core:frequency": 1e9, "core:datetime": f"2025-01-01T00:00:0{second}Z", **more}


def test_channels_are_interleaved_per_sample_and_captures_become_pulses(tmp_path):
    samples = np.arange(1, 41).reshape(10, 2, 2)
    raw = recording(
        tmp_path,
        samples,
        [capture(0, 0, **{"apertura:frame": 7}), capture(5, 1)],
        **{"apertura:channels": ["sidelink", "radar"]},
    )
    check(raw, "raw")
    np.testing.assert_array_equal(iq_of(raw)[1, 1], samples[5:, 1])
    assert raw.attrs["channels"] == ["sidelink", "radar"]
    assert raw.frame.values.tolist() == [7, -1]
    assert raw.attrs["frequency_hz"] == 1e9


def test_decreasing_time_tags_are_rejected(tmp_path):
    with pytest.raises(CampaignError, match="capture 1 has time tag"):
        recording(tmp_path, np.ones((10, 1, 2)), [capture(0, 5), capture(5, 1)], **{"apertura:channels": ["radar"]})


def test_real_recording_of_another_recorder_is_read(shared):
    folder = shared / "sigmf_nbiot"
    names = [folder / f"V16-beacon-NB-IoT-uplink.sigmf-{kind}" for kind in ("meta", "data")]
    raw = check(raw_of(*names), "raw")
    assert iq_of(raw).shape == (1, 1, 512000, 2)
    assert raw.attrs["sample_rate_hz"] == 640000


@pytest.mark.usefixtures("reader")
def test_gotcha_delays_refer_to_the_scene_centre(shared):
    """The distance of the antenna from the scene centre is r0, so that an echo from the centre has zero phase."""
    files = sorted((shared / "gotcha_afrl").glob("*.mat"))
    echo = check(read_phase_history("afrl_mat", files, pair="a-a"), "echo")
    assert echo.transfer.shape == (234, 424)
    distance = np.linalg.norm(echo.tx_position.values, axis=1)
    np.testing.assert_allclose(echo.reference_delay.values * SPEED_OF_LIGHT_M_S / 2, distance, atol=2e-3)
    assert echo.attrs["frame"] == "local"


def gotcha(folder, *, version=7, **changes):
    """Write a file with AFRL's structure, 8 frequencies and 5 pulses, in MATLAB format 7 or 7.3."""
    generator, pulses = np.random.default_rng(6), np.arange(5.0)
    fields = {
        "fp": generator.normal(size=(8, 5)) + 1j * generator.normal(size=(8, 5)),
        "freq": 9.3e9 + 1e6 * np.arange(8.0),
        "x": 7000 + pulses,
        "y": 10 * pulses,
        "z": np.full(5, 7000.0),
        "r0": 9900 + pulses,
        "af": {"r_correct": 0.2 + 0.01 * pulses, "ph_correct": 0.5 * pulses},
    } | changes
    path = folder / "a.mat"
    if version == 7:
        savemat(path, {"data": {name: values for name, values in fields.items() if values is not None}})
        return path, fields
    import h5py

    def write(group, named):
        for name, values in named.items():
            if isinstance(values, dict):
                write(group.create_group(name), values)
                continue
            array = np.atleast_2d(values).T
            if array.dtype.kind == "c":
                array = np.rec.fromarrays([array.real, array.imag], names="real,imag")
            group[name] = array

    with h5py.File(path, "w", userblock_size=512) as file:
        write(file.create_group("data"), fields)
    return path, fields


@pytest.mark.usefixtures("reader")
def test_matlab_7_3_files_equal_those_of_version_7(tmp_path):
    echoes = [
        read_phase_history("afrl_mat", [gotcha(tmp_path, version=version)[0]], pair="a-a") for version in (7, 7.3)
    ]
    for name in ("transfer", "frequency", "reference_delay", "tx_position"):
        np.testing.assert_array_equal(echoes[0][name].values, echoes[1][name].values)
    assert echoes[0].attrs["remarks"] == echoes[1].attrs["remarks"]


@pytest.mark.usefixtures("reader")
def test_stored_corrections_are_applied_if_configured(tmp_path):
    path, fields = gotcha(tmp_path)
    raw = read_phase_history("afrl_mat", [path], pair="a-a")
    assert (
        "corrections of r0 (0.20 to 0.24 m) and of phases; these corrections are not applied" in raw.attrs["remarks"][0]
    )
    corrected = read_phase_history("afrl_mat", [path], pair="a-a", described={"corrections": "stored"})
    assert "remarks" not in corrected.attrs
    expected = raw.transfer.values * np.exp(1j * fields["af"]["ph_correct"])[:, None]
    np.testing.assert_allclose(corrected.transfer.values, expected, rtol=1e-5)
    range_m = (corrected.reference_delay - raw.reference_delay).values * SPEED_OF_LIGHT_M_S / 2
    np.testing.assert_allclose(range_m, fields["af"]["r_correct"], atol=1e-6)
    bare, _ = gotcha(tmp_path, af=None)
    assert "remarks" not in read_phase_history("afrl_mat", [bare], pair="a-a").attrs
    with pytest.raises(CampaignError, match=r"no field data\.af\.r_correct.*Set waveform\.corrections to none"):
        read_phase_history("afrl_mat", [bare], pair="a-a", described={"corrections": "stored"})


@pytest.mark.slow
def test_stored_corrections_of_gotcha_keep_trihedrals_focused(shared):
    """Corrections with the implemented signs keep the peak level; opposite signs would reduce it by 18 dB or more."""
    files = sorted((shared / "gotcha_afrl").glob("*.mat"))
    east, north = np.meshgrid(np.arange(-16.6, -14.6, 0.1), np.arange(20.0, 23.0, 0.1))
    peaks = []
    for corrections in ("none", "stored"):
        echo = read_phase_history("afrl_mat", files, pair="a-a", described={"corrections": corrections})
        antenna, half = echo.tx_position.values, echo.reference_delay.values * SPEED_OF_LIGHT_M_S / 2
        frequency, image = echo.frequency.values[::8], 0
        for place, reference_m, samples in zip(antenna, half, echo.transfer.values[:, ::8], strict=True):
            path_m = np.sqrt((place[0] - east) ** 2 + (place[1] - north) ** 2 + place[2] ** 2) - reference_m
            image = image + np.exp(4j * np.pi / SPEED_OF_LIGHT_M_S * path_m[..., None] * frequency) @ samples
        peaks.append(20 * np.log10(np.abs(image).max()))
    assert abs(peaks[1] - peaks[0]) < 0.5


@pytest.mark.usefixtures("reader")
def test_frequencies_in_ghz_are_rejected(tmp_path):
    path, _ = gotcha(tmp_path, freq=9.3 + 1e-3 * np.arange(8.0))
    with pytest.raises(CampaignError, match=r"frequencies of 9\.3 to 9\.307, probably not in Hz"):
        read_phase_history("afrl_mat", [path], pair="a-a")


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ("cut,angle_deg\nazimuth,0\n", "no column gain_db"),
        ("cut,angle_deg,gain_db\nazimut,0,0\n", "unknown cut 'azimut'"),
        ("cut,angle_deg,gain_db\nazimuth,-9,-9\nazimuth,0,0\nazimuth,9,-9\n", "0 samples in the elevation cut"),
        ("cut,angle_deg,gain_db\nazimuth,-9,-9\nazimuth,0,x\nazimuth,9,-9\n", "column gain_db: 'x' is not a number"),
        ("cut,angle_deg,gain_db\nazimuth,-9,-9\nazimuth,0,nan\nazimuth,9,-9\n", "azimuth cut contains a cell that"),
        ("cut,angle_deg,gain_db\nazimuth,0,-9\nazimuth,0,0\nazimuth,9,-9\n", "of the azimuth cut do not increase"),
        ("cut,angle_deg,gain_db\nazimuth,0,-9\nazimuth,90,0\nazimuth,270,-9\n", "0° to 270°, beyond ±180°"),
        ("cut,angle_deg,gain_db,phase_deg\nazimuth,-9,-9,0\nazimuth,0,0,\nazimuth,9,-9,0\n", "a cell that is no"),
        ("cut,angle_deg,gain_db,phase_deg\nazimuth,-9,-9,0\nazimuth,0,0,2e5\nazimuth,9,-9,0\n", "a phase of 200000°"),
    ],
)
def test_unreadable_antenna_pattern_is_named(tmp_path, rows, expected):
    path = tmp_path / "horn.csv"
    path.write_text(rows)
    with pytest.raises(CampaignError, match=rf"horn.csv: .*{expected}.*expected columns cut"):
        read_beam_pattern(path)


def epochs_of(logged, start="2025-05-14T09:30:00", grain_ns=1):
    """Return geodetic positions, rounded to the nine decimals of the log, and times."""
    values = np.array([epoch[:3] for epoch in logged]).round(9)
    elapsed = np.cumsum([epoch[3] for epoch in logged]) * grain_ns
    return values, np.datetime64(start, "ns") + elapsed.astype("timedelta64[ns]")


@QUICK
@given(logged=EPOCHS)
def test_any_csv_log_is_read_back_unchanged(tmp_path_factory, logged):
    geodetic, time = epochs_of(logged)
    path = tmp_path_factory.mktemp("log") / "a.track.csv"
    rows = (f"{t}Z,{lat:.9f},{lon:.9f},{h:.9f}" for t, (lat, lon, h) in zip(time, geodetic, strict=True))
    path.write_text("\n".join(["time_utc,latitude_deg,longitude_deg,height_m", *rows]) + "\n")
    track = check(read_track(path, node="a"), "track")
    np.testing.assert_array_equal(track.time.values, time)
    expected = make_track(time, geodetic, node="a", where=path)
    np.testing.assert_allclose(track.position.values, expected.position.values, atol=1e-6)


@QUICK
@given(logged=EPOCHS, weeks=st.booleans())
def test_any_rtklib_log_is_read_back_unchanged(tmp_path_factory, logged, weeks):
    geodetic, time = epochs_of(logged, grain_ns=10**6)
    path = tmp_path_factory.mktemp("log") / "a.track.pos"

    def stamp(gpst):
        if not weeks:
            return str(gpst).replace("-", "/").replace("T", " ")
        week, rest = divmod((gpst - np.datetime64("1980-01-06", "ns")).astype(int), 7 * 86_400 * 10**9)
        return f"{week} {rest / 1e9:.3f}"

    gpst = time + np.timedelta64(18, "s")
    lines = [f"{stamp(t)} {lat:.9f} {lon:.9f} {h:.9f} 1" for t, (lat, lon, h) in zip(gpst, geodetic, strict=True)]
    track = pos(path, "GPST", *lines)
    np.testing.assert_array_equal(track.time.values, time)
    expected = make_track(time, geodetic, node="a", where=path)
    np.testing.assert_allclose(track.position.values, expected.position.values, atol=1e-6)


@QUICK
@given(gaps=st.lists(st.integers(0, 3), min_size=1, max_size=9), channels=st.integers(1, 3), data=st.data())
def test_captures_have_their_own_samples_despite_gaps(tmp_path_factory, gaps, channels, data):
    """Every capture has the median length; further samples do not belong to any capture."""
    length = 6
    gaps = sorted(gaps)[: (len(gaps) + 1) // 2] if np.median(gaps) else gaps
    gaps = [0] * (len(gaps) + 1) + gaps  # most captures are contiguous
    order = data.draw(st.permutations(gaps))
    starts = np.cumsum([0, *(length + gap for gap in order)])
    samples = np.arange(1, starts[-1] * channels * 2 + 1).reshape(starts[-1], channels, 2) % 30_000 + 1
    names = ["radar", "sidelink", "spare"][:channels]
    captures = [
        {"core:sample_start": int(start), "core:datetime": f"2025-01-01T00:00:{index:02d}Z"}
        for index, start in enumerate(starts[:-1])
    ]
    raw = recording(tmp_path_factory.mktemp("sigmf"), samples, captures, **{"apertura:channels": names})
    assert raw.attrs["capture_samples"] == length
    for pulse, start in enumerate(starts[:-1]):
        for channel in range(channels):
            np.testing.assert_array_equal(iq_of(raw)[channel, pulse], samples[start : start + length, channel])


def test_new_log_format_is_one_function_and_one_row(tmp_path, monkeypatch):
    """The format is read through the table, and named in the message about a node without a log."""
    monkeypatch.setitem(TRACKS, "toy", LogFormat((".toy",), read_toy_track))
    (tmp_path / "a.track.toy").write_text("48 9 600\n48 9 601\n")
    track = read_track(tmp_path / "a.track.toy", node="a")
    np.testing.assert_allclose(geodetic_from_ecef(track.position.values[1]), [48, 9, 601], atol=1e-8)
    with pytest.raises(CampaignError, match=r"<node>\.track\.<.*\|toy[|>]"):
        Campaign(tmp_path, None, ()).track_file("f01", "b")


def read_toy_track(path, *, node, options):
    geodetic = np.loadtxt(path)
    time = np.datetime64("2025-05-14T09:30", "ns") + np.arange(len(geodetic)) * np.timedelta64(1, "s")
    return make_track(time, geodetic, node=node, where=path)


def test_new_recorder_is_one_function_and_one_row(tmp_path, monkeypatch):
    """The file is found, opened, checked against its hash, and cut into captures; messages contain its name."""
    monkeypatch.setitem(RECORDERS, (".toy",), open_toy_recording)
    path = tmp_path / "raw" / "f01" / "a.toy"
    path.parent.mkdir(parents=True)
    np.arange(1, 13, dtype="<i2").tofile(path)
    opened = open_recording(Campaign(tmp_path, None, ()).recording_files("f01", "a"))
    opened.check_hash()
    raw = check(opened.cut(opened.captures, node="a"), "raw")
    np.testing.assert_array_equal(iq_of(raw)[0, 1], [[7, 8], [9, 10], [11, 12]])
    np.zeros(12, "<i2").tofile(path)
    for work in (opened.check_hash, lambda: opened.cut(opened.captures, node="a")):
        with pytest.raises(CampaignError, match=r"a\.toy: "):
            work()


def open_toy_recording(path):
    time = np.array(["2025-05-14T09:30:00", "2025-05-14T09:30:01"], "datetime64[ns]")
    return Recording(
        samples=SampleFile(path, channels=1),
        channels=["radar"],
        sample_rate_hz=1e6,
        frequency_hz=1e9,
        captures=Captures(np.array([0, 3]), 3, time, np.array([-1, -1])),
        framing=None,
        files=(path,),
        sha512=hashlib.sha512(path.read_bytes()).hexdigest(),
    )


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"core:datetime": "2025-01-01T00:00:00"}, "captures.0.core:datetime"),
        ({"core:datetime": "yesterdayZ"}, "core:datetime: "),
        ({"core:sample_start": -1}, "captures.0.core:sample_start: .*not -1"),
    ],
)
def test_invalid_sigmf_metadata_are_rejected_by_key(tmp_path, change, expected):
    with pytest.raises(CampaignError, match=rf"a\.sigmf-meta: .*{expected}"):
        recording(tmp_path, np.ones((10, 1, 2)), [capture(0, 0) | change], **{"apertura:channels": ["radar"]})


def test_metadata_that_are_not_json_are_rejected(tmp_path):
    (tmp_path / "a.sigmf-meta").write_text('{"global": ')
    (tmp_path / "a.sigmf-data").write_bytes(b"1234")
    with pytest.raises(CampaignError, match="not valid SigMF: invalid JSON: parse error"):
        open_recording((tmp_path / "a.sigmf-meta", tmp_path / "a.sigmf-data"))


def test_capture_at_another_carrier_is_named(tiny):
    path = tiny / "raw/f01/uav1.sigmf-meta"
    meta = json.loads(path.read_text())
    for capture in meta["captures"][1:]:
        del capture["core:frequency"]
    path.write_text(json.dumps(meta))
    open_recording((path, path.with_suffix(".sigmf-data")))
    meta["captures"][3]["core:frequency"] = meta["captures"][0]["core:frequency"] + 1e6
    path.write_text(json.dumps(meta))
    with pytest.raises(CampaignError, match=r"uav1\.sigmf-meta: capture 3: core:frequency .* one carrier"):
        open_recording((path, path.with_suffix(".sigmf-data")))
