"""Tracks as refined, as files for other programs: what is read from them again is what was refined."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from matplotlib.image import imread
from PIL import Image

from apertura.campaign.store import open_stage, read_manifest
from apertura.core.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef, ned_axes
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.formats.export.tracks import RefinedLog, write_csv, write_picture, write_pos
from apertura.formats.tracks.csv_track import read_csv_track
from apertura.formats.tracks.rtklib import read_rtklib_pos
from apertura.stages.refine import RefinedTrack
from apertura.stages.tracks import outcome_of, refined_log

BEGUN = np.datetime64("2025-05-14T09:30:00.123456789", "ns")
ENU = [1, 0, 2]


def track_of(position_m, *, frame="ecef", **more):
    """A log at 7 Hz, whose epochs are at no whole millisecond."""
    time = BEGUN + np.rint(np.arange(len(position_m)) / 7 * 1e9).astype("timedelta64[ns]")
    return xr.Dataset(
        {
            "time": ("epoch", time),
            "position": (("epoch", "axis"), position_m),
            "attitude": (("epoch", "axis"), np.full(position_m.shape, np.nan)),
            **more,
        },
        attrs={"node": "uav1", "frame": frame},
    )


@pytest.fixture
def log():
    """A flight of 20 m whose error of some centimetres was estimated but for the last five of its epochs."""
    step_m = np.outer(np.linspace(0, 20, 30), [0.5, 0.7, 0.1])
    position_m = ecef_from_geodetic(np.array(48.4), np.array(9.9), np.array(620.0)) + step_m
    rng = np.random.default_rng(3)
    left_m = np.where(np.arange(30)[:, None] < 25, rng.uniform(0.002, 0.02, (30, 3)), np.nan)
    fix = np.array([1] * 20 + [2] * 9 + [0], np.int8)
    return RefinedLog(
        "uav1",
        track_of(position_m, fix=("epoch", fix)),
        rng.normal(0, 0.03, (30, 3)),
        left_m,
        np.full((30, 3), [0.01, 0.02, np.nan]),
    )


def test_a_solution_that_is_read_again_has_the_refined_positions_to_a_tenth_of_a_millimetre(log, tmp_path):
    write_pos(tmp_path / "uav1.pos", log, outcome="refined: as told", version="0")
    text = (tmp_path / "uav1.pos").read_text()
    read = read_rtklib_pos(tmp_path / "uav1.pos", node="uav1")
    assert "% refined: as told" in text.splitlines()
    assert "5 of 30 epochs lie outside the pulses" in text
    assert "ns, age, ratio and covariances 0: unknown" in text  # for programs that filter by them
    np.testing.assert_array_equal(read.time.values, log.track.time.values)
    np.testing.assert_allclose(read.position.values, log.track.position.values + log.moved_m, atol=1e-4, rtol=0)
    np.testing.assert_allclose(read.position_std.values[:, ENU], np.nan_to_num(log.std_m), atol=5.1e-5, rtol=0)
    assert read.fix.values.tolist() == [1] * 20 + [2] * 9 + [5]


def test_a_table_that_is_read_again_has_the_refined_positions_and_the_attitude_of_the_log(log, tmp_path):
    attitude = np.random.default_rng(1).uniform(-0.2, 0.2, (30, 3))
    attitude[3] = np.nan
    log.track.attitude.values[:] = attitude
    write_csv(tmp_path / "uav1.csv", log)
    read = read_csv_track(tmp_path / "uav1.csv", node="uav1")
    np.testing.assert_array_equal(read.time.values, log.track.time.values)
    np.testing.assert_allclose(read.position.values, log.track.position.values + log.moved_m, atol=1e-4, rtol=0)
    np.testing.assert_allclose(np.sin(read.attitude.values), np.sin(attitude), atol=2e-6)
    np.testing.assert_allclose(read.position_std.values[:, ENU], log.std_m, atol=5.1e-6, rtol=0)
    np.testing.assert_array_equal(read.fix.values, log.fix)


def test_corrections_and_deviations_are_those_to_east_north_and_up(log):
    up = -ned_axes(log.track.position.values)[..., 2]
    lifted = RefinedLog("uav1", log.track, 0.05 * up, np.full((30, 3), 0.02), log.stated_m)
    np.testing.assert_allclose(lifted.correction_m, np.tile([0.0, 0.0, 0.05], (30, 1)), atol=1e-12)
    np.testing.assert_allclose(
        np.diff([geodetic_from_ecef(log.track.position.values), lifted.geodetic], axis=0)[0, :, 2], 0.05
    )
    np.testing.assert_allclose(lifted.std_m, 0.02)  # the same in every direction
    inside = log.refined
    assert inside.tolist() == [True] * 25 + [False] * 5
    np.testing.assert_allclose((log.std_m**2).sum(axis=1)[inside], (log.left_m**2).sum(axis=1)[inside])
    np.testing.assert_allclose(
        log.std_m[~inside, :2], np.hypot([0.01, 0.02], log.correction_m[~inside, :2])
    )  # what is held there was the error of other epochs
    assert np.isnan(log.std_m[~inside, 2]).all()


def test_a_node_without_a_place_on_earth_is_written_in_its_own_axes(tmp_path):
    position_m = np.arange(12.0).reshape(4, 3)
    log = RefinedLog(
        "uav1", track_of(position_m, frame="local"), np.full((4, 3), [0.1, 0.2, 0.3]), np.full((4, 3), 0.01), position_m
    )
    write_csv(tmp_path / "uav1.csv", log)
    read = read_csv_track(tmp_path / "uav1.csv", node="uav1")
    assert read.attrs["frame"] == "local"
    np.testing.assert_allclose(read.position.values, position_m + [0.1, 0.2, 0.3], atol=1e-5)
    np.testing.assert_allclose(log.correction_m, np.tile([0.1, 0.2, 0.3], (4, 1)))


def stage_of(*, accepted, further=()):
    """What a refinement has found: node uav1 moved up to a metre in two seconds, and offsets of so many pairs."""
    knots = BEGUN + np.array([0, 2_000_000_000], "timedelta64[ns]")
    moved_m = np.array([[[0.0, 0, 0], [1.0, 0, 0]]])
    return xr.Dataset(
        {
            "time": ("knot", knots),
            "correction": (("node", "knot", "axis"), moved_m),
            "further": (("pair", "knot"), np.zeros((len(further), 2))),
            "std": (("node", "knot", "axis"), np.full((1, 2, 3), 0.01)),
        },
        attrs={
            "nodes": ["uav1"],
            "pairs": list(further),
            "accepted": accepted,
            "reason": "as told",
            "decisions": {"autofocus": {"value": "on", "reason": "asked for"}},
        },
    )


@pytest.mark.parametrize(
    ("found", "outcome", "moved_m", "refined"),
    [
        ({"accepted": True}, "refined: autofocus on: asked for; as told", [0.0, 0.5, 1.0, 1.0], [1, 1, 1, 0]),
        ({"accepted": False}, "as logged: autofocus on: asked for; as told", [0.0] * 4, [0] * 4),
    ],
)
def test_what_was_accepted_moves_a_log_and_is_held_beyond_the_pulses(found, outcome, moved_m, refined, settings):
    track = track_of(np.zeros((22, 3)), frame="local").isel(epoch=[0, 7, 14, 21])
    one = RefinedTrack.of(stage_of(**found))
    log = refined_log(one, "uav1", track, settings)
    assert outcome_of(one) == outcome
    np.testing.assert_allclose(log.correction_m[:, 0], moved_m)
    np.testing.assert_array_equal(log.refined, refined)


def test_one_phase_per_pulse_moves_no_node(settings):
    stage = stage_of(accepted=True, further=["uav1-uav1"])
    one = RefinedTrack.of(stage.assign(correction=0 * stage.correction))
    assert isinstance(one.correction, TrackCorrection)
    assert outcome_of(one).startswith(
        "as logged: the refinement estimated one path offset per pulse and pair, and no node position"
    )
    log = refined_log(one, "uav1", track_of(np.zeros((8, 3)), frame="local"), settings)
    assert not log.refined.any()
    assert not log.correction_m.any()


def test_what_a_log_states_of_its_errors_comes_before_what_the_config_does(settings):
    own = np.array([[0.01, 0.02, 0.03], [0.0, 0.0, 0.0], [np.nan] * 3])
    track = track_of(np.zeros((3, 3)), frame="local", position_std=(("epoch", "axis"), own))
    one = RefinedTrack.of(stage_of(accepted=False))
    for stated, others in ((None, [np.nan] * 3), ((0.1, 0.2, 0.3), [0.2, 0.1, 0.3])):
        log = refined_log(one, "uav1", track, settings.model_copy(update={"position_std_m": stated}))
        np.testing.assert_allclose(log.std_m, [[0.02, 0.01, 0.03], others, others])


@pytest.fixture
def settings(finished_tiny):
    return finished_tiny.settings.nodes["uav1"]


def test_a_campaign_whose_tracks_are_left_alone_has_its_logs_as_they_are(finished_tiny):
    folder = finished_tiny.results / "f01" / "tracks"
    files = {f"{node}.{suffix}" for node in ("uav1", "uav2") for suffix in ("csv", "pos")} | {"tracks.png"}
    assert read_manifest(folder / "tracks.manifest.json")["files"].keys() == files
    for node in ("uav1", "uav2"):
        logged = open_stage(finished_tiny.stage("track", "f01", node), "track")
        assert "% as logged: autofocus off: auto: position accuracy" in (folder / f"{node}.pos").read_text()
        for read in (
            read_rtklib_pos(folder / f"{node}.pos", node=node),
            read_csv_track(folder / f"{node}.csv", node=node),
        ):
            np.testing.assert_array_equal(read.time.values, logged.time.values)
            np.testing.assert_allclose(read.position.values, logged.position.values, atol=1e-4, rtol=0)
    with Image.open(str(folder / "tracks.png")) as picture:
        assert picture.text["Title"] == "tandem_demo · tracks of flight f01"
        assert "f01" in picture.text["APERTURA_SOURCES"]


@pytest.mark.slow
def test_the_picture_shows_a_column_for_each_node(log, tmp_path):
    for count in (1, 4):
        write_picture(tmp_path / f"{count}.png", [log] * count, title="a flight", outcome="refined: as told", tags={})
    one, four = (imread(tmp_path / f"{count}.png") for count in (1, 4))
    assert four.shape[1] > 1.5 * one.shape[1]


def test_without_a_correction_the_picture_shows_the_logs_in_two_panels(log, tmp_path):
    still = replace(log, moved_m=np.zeros((30, 3)), left_m=np.full((30, 3), np.nan))
    for name, logs in (("still", [still] * 4), ("moved", [log] * 4)):
        write_picture(tmp_path / f"{name}.png", logs, title="a flight", outcome="as logged: off", tags={})
    still_px, moved_px = (imread(tmp_path / f"{name}.png") for name in ("still", "moved"))
    assert still_px.shape[0] < moved_px.shape[0]
    assert still_px.shape[1] < moved_px.shape[1]
    assert (still_px[..., :3].min(axis=-1) < 0.9).any()  # lines are drawn
