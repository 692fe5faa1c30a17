"""Phase history with positions in a flight log whose clock differs from the clock of the recorder."""

import json

import numpy as np
import pytest
import xarray as xr
import yaml
from folders import complaint, edit_config

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.check import problems
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.geometry.geodesy import ecef_from_projected, geodetic_from_ecef
from apertura.formats.names import PHASE_HISTORIES, HistoryFormat
from apertura.formats.tracks.csv_track import read_csv_track
from apertura.run.process import process
from apertura.stages import tracks
from apertura.stages.transfer import recorded_echo
from apertura.tools.preview.follow import Preview

CRS = "EPSG:32632"
EAST, NORTH = 570_000.0, 5_363_000.0
FREQUENCY = 1.2e9 + 2e6 * np.arange(200)
START = np.datetime64("2025-05-14T09:30", "ns")
CLOCK_OFFSET_S = 4.44
"""Delay of the recorder's clock relative to the clock of the log, seconds."""


def position_ecef(east, north, up):
    return ecef_from_projected(CRS, EAST + np.asarray(east), NORTH + np.asarray(north), np.asarray(up) + 500.0)


def read_toy_history(paths, *, pair):
    stored = np.load(str(paths[0]))
    count = len(stored["time"])
    return xr.Dataset(
        {
            "time": ("pulse", stored["time"]),
            "transfer": (("pulse", "subcarrier"), stored["transfer"]),
            "frequency": ("subcarrier", FREQUENCY),
            "reference_delay": ("pulse", np.zeros(count)),
            "path_limit": ("pulse", np.full(count, np.inf)),
        },
        attrs={"pair": pair, "flags": {}},
    )


@pytest.fixture
def campaign(tmp_path, monkeypatch):
    """Write a flight of 12 m in 12 s at varying speed past one target, with 1.5 m of cable."""
    monkeypatch.setitem(PHASE_HISTORIES, "toy", HistoryFormat(".npz", read_toy_history))
    root = tmp_path / "campaign"
    (root / "raw" / "f01").mkdir(parents=True)
    (root / "config").mkdir()
    epoch_s, pulse_s = np.arange(0, 14, 0.1), np.arange(1, 13, 0.02)

    def position_m(time_s):
        return position_ecef(time_s - 7 + 0.3 * np.sin(time_s), np.zeros_like(time_s), np.full_like(time_s, 10.0))

    rows = [
        f"{START + np.timedelta64(round(t * 1e9), 'ns')}Z,{lat:.10f},{lon:.10f},{height:.5f}"
        for t, (lat, lon, height) in zip(epoch_s, geodetic_from_ecef(position_m(epoch_s)), strict=True)
    ]
    head = "time_utc,latitude_deg,longitude_deg,height_m"
    (root / "raw/f01/uav1.track.csv").write_text("\n".join([head, *rows]) + "\n")
    path_m = 2 * np.linalg.norm(position_m(pulse_s) - position_ecef(1.0, 20.0, 0.0), axis=1) + 1.5
    transfer = np.exp(-2j * np.pi * FREQUENCY * path_m[:, None] / SPEED_OF_LIGHT_M_S).astype(np.complex64)
    clock = START + np.round((pulse_s - CLOCK_OFFSET_S) * 1e9).astype("timedelta64[ns]")
    np.savez(root / "raw/f01/uav1.npz", time=clock, transfer=transfer)
    config = {
        "campaign": "rail",
        "waveform": {"kind": "phase_history", "format": "toy"},
        "nodes": {"uav1": {"path_offset_m": {"radar": 1.5}, "log": {"longest_gap_s": 1.0}}},
        "scene": {
            "crs": CRS,
            "bounds_m": [EAST - 3.0625, NORTH + 16.9375, EAST + 4.9375, NORTH + 22.9375],
            "spacing_m": 0.125,
            "height_m": 500.0,
            "height_datum": "ellipsoid",
        },
    }
    (root / "config/config.yaml").write_text(yaml.safe_dump(config))
    (root / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\tuav1\n")
    return root


def write_clocks(root, offset_s=CLOCK_OFFSET_S, **cells):
    cells = {"flight": "f01", "node": "uav1", "offset_s": offset_s, "drift_ppm": 0, "std_s": 1e-3} | cells
    table = "\n".join("\t".join(map(str, row)) for row in (cells.keys(), cells.values()))
    (root / "config/clocks.tsv").write_text(table + "\n")


def brightest(root):
    image = abs(open_stage(Campaign.load(root).stage("image", "f01", "uav1-uav1"), "image").image)
    peak = image.argmax(...)
    return float(image.x[peak["x"]]) - EAST, float(image.y[peak["y"]]) - NORTH, float(image.max())


@pytest.mark.slow
def test_clock_offset_puts_the_target_at_its_position(campaign):
    write_clocks(campaign)
    assert problems(campaign) == []
    process(campaign, last="cube")
    east, north, peak = brightest(campaign)
    assert (east, north) == (1.0, 20.0)
    assert peak > 0.97
    echo = open_stage(Campaign.load(campaign).stage("echo", "f01", "uav1-uav1"), "echo")
    assert echo.attrs["time_tags"]["std_s"] == 1e-3
    assert echo.attrs["frame"] == "ecef"


@pytest.mark.slow
def test_refined_tracks_of_a_phase_history_are_written(campaign):
    write_clocks(campaign)
    edit_config(campaign, lambda document: document.update(processing={"autofocus": "off"}))
    opened = process(campaign, last="cube")
    written = {path.name for path in tracks.tracks(opened, "f01")}
    assert written == {"uav1.csv", "uav1.pos", "tracks.png"}
    read, log = (read_csv_track(path, node="uav1") for path in (
        campaign / "results/f01/tracks/uav1.csv", campaign / "raw/f01/uav1.track.csv"
    ))  # fmt: skip
    np.testing.assert_array_equal(read.time.values, log.time.values)
    np.testing.assert_allclose(read.position.values, log.position.values, atol=1e-4, rtol=0)


@pytest.mark.slow
def test_phase_history_of_opposite_sign_is_imaged_with_iq_conjugate(campaign):
    write_clocks(campaign)
    file = campaign / "raw/f01/uav1.npz"
    stored = dict(np.load(file))
    np.savez(file, **stored | {"transfer": stored["transfer"].conj()})
    edit_config(campaign, lambda document: document["waveform"].update(iq="conjugate"))
    process(campaign, last="cube")
    assert brightest(campaign)[:2] == (1.0, 20.0)


@pytest.mark.slow
def test_clock_error_displaces_the_target_along_the_track(campaign):
    write_clocks(campaign, CLOCK_OFFSET_S + 0.5)
    process(campaign, last="cube")
    assert abs(brightest(campaign)[0] - 1.5) < 0.25


@pytest.mark.slow
def test_uncertainty_of_a_clock_offset_is_in_the_budget(campaign):
    write_clocks(campaign, std_s=0.05)
    process(campaign, last="cube")
    quality = open_stage(Campaign.load(campaign).stage("image", "f01", "uav1-uav1"), "image").attrs["quality"]
    tags = next(line for line in quality["budget"] if line["cause"] == "time tags")
    assert tags["stated"].startswith("50 ms")
    assert tags["shift_m"] > 0.01


def test_check_reports_pulses_outside_the_log(campaign):
    lines = [str(problem) for problem in problems(campaign)]
    assert len(lines) == 1
    assert "starts 3.440 s after the first pulse" in lines[0]
    (campaign / "raw/f01/uav1.track.csv").unlink()
    assert "samples without positions" in str(problems(campaign)[0])


def test_track_at_terrain_height_is_refused_before_the_run(campaign):
    """The rail lies in the terrain plane; the log alone shows that the antenna is at the terrain surface."""
    edit_config(campaign, lambda document: document["scene"].update(height_m=510.0))
    lines = [str(problem) for problem in problems(campaign)]
    heights = [f"uav1: median height above the terrain {height} m" for height in ("0.0", "-0.0")]
    assert any(height in line for line in lines for height in heights)


def test_log_that_misses_pulses_is_reported_with_the_clock_remedy(campaign):
    message = complaint(lambda: process(campaign, last="cube"))
    assert "starts 3.440 s after the first pulse" in message
    assert "apertura align" in message


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        ({"node": "uav7"}, "flight f01 has no node 'uav7'"),
        ({"offset_s": "soon"}, "offset_s 'soon'"),
        ({"drift_ppm": 5000}, "drift_ppm '5000'"),
    ],
)
def test_invalid_line_of_clocks_is_reported(campaign, cells, expected):
    write_clocks(campaign, **cells)
    message = complaint(lambda: Campaign.load(campaign))
    assert "clocks.tsv: line 2" in message
    assert expected in message


def test_samples_without_positions_are_refused(campaign):
    (campaign / "raw/f01/uav1.track.csv").unlink()
    message = complaint(lambda: process(campaign, last="cube"))
    assert "samples without positions" in message


@pytest.mark.slow
def test_preview_of_a_phase_history_works_without_follow(campaign):
    write_clocks(campaign)
    Preview(Campaign.load(campaign), follow=False).run()
    status = json.loads((campaign / "results/preview/status.json").read_text())["pairs"]["f01/uav1-uav1"]
    assert (status["peak"]["x_m"] - EAST, status["peak"]["y_m"] - NORTH) == (1.0, 20.0)
    assert (status["verdict"], status["pulses"]["added"]) == ("focused", 600)
    assert "waveform.kind phase_history" in complaint(lambda: Preview(Campaign.load(campaign), follow=True))


@pytest.fixture
def placed(campaign, monkeypatch):
    """Return a function that stores antenna positions with the samples, in place of the flight log."""

    def place(moved_m):
        def read(paths, *, pair):
            history = read_toy_history(paths, pair=pair)
            along = np.linspace(-moved_m / 2, moved_m / 2, history.sizes["pulse"])
            positions = (("pulse", "axis"), position_ecef(along, np.zeros_like(along), np.full_like(along, 10.0)))
            return history.assign(tx_position=positions, rx_position=positions).assign_attrs(frame="ecef")

        monkeypatch.setitem(PHASE_HISTORIES, "toy", HistoryFormat(".npz", read))
        (campaign / "raw/f01/uav1.track.csv").unlink()
        edit_config(campaign, lambda document: document["nodes"]["uav1"].update(position_std_m=0.01))
        edit_config(campaign, lambda document: document["nodes"]["uav1"].pop("log"))
        return campaign

    return place


def test_equal_positions_of_all_pulses_are_refused(placed):
    campaign = Campaign.load(placed(0.0))
    message = complaint(lambda: recorded_echo(campaign, "f01", "uav1-uav1"))
    assert "the antenna positions of all pulses are equal" in message


@pytest.mark.slow
def test_tracks_without_an_aperture_are_not_refined(placed):
    """The points of the scene are kilometres wide across the line of sight: no patch fits in memory."""
    root = placed(1e-6)
    opened = process(root, last="cube")
    image = open_stage(opened.stage("image", "f01", "uav1-uav1"), "image")
    assert "no_aperture" in image.attrs["quality"]["flags"]
