"""Export of refined tracks as .csv and .pos: files read back contain the refined positions."""

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

START = np.datetime64("2025-05-14T09:30:00.123456789", "ns")
ENU = [1, 0, 2]


def track_of(position_m, *, frame="ecef", **more):
    """Return a log at 7 Hz, whose epochs are not at integer milliseconds."""
    time = START + np.rint(np.arange(len(position_m)) / 7 * 1e9).astype("timedelta64[ns]")
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
    """Return a flight of 20 m with estimated errors of centimetres, except at the last five epochs."""
    step_m = np.outer(np.linspace(0, 20, 30), [0.5, 0.7, 0.1])
    position_m = ecef_from_geodetic(np.array(48.4), np.array(9.9), np.array(620.0)) + step_m
    rng = np.random.default_rng(3)
    residual_m = np.where(np.arange(30)[:, None] < 25, rng.uniform(0.002, 0.02, (30, 3)), np.nan)
    fix = np.array([1] * 20 + [2] * 9 + [0], np.int8)
    return RefinedLog(
        "uav1",
        track_of(position_m, fix=("epoch", fix)),
        rng.normal(0, 0.03, (30, 3)),
        residual_m,
        np.full((30, 3), [0.01, 0.02, np.nan]),
    )


def test_pos_file_contains_the_refined_positions(log, tmp_path):
    write_pos(tmp_path / "uav1.pos", log, outcome="refined: as stated", version="0")
    text = (tmp_path / "uav1.pos").read_text()
    read = read_rtklib_pos(tmp_path / "uav1.pos", node="uav1")
    assert "% refined: as stated" in text.splitlines()
    assert "5 of 30 epochs are before or after the pulses" in text
    assert "ns, age, ratio and covariances 0: unknown" in text  # reported because programs filter by them
    np.testing.assert_array_equal(read.time.values, log.track.time.values)
    np.testing.assert_allclose(read.position.values, log.track.position.values + log.moved_m, atol=1e-4, rtol=0)
    np.testing.assert_allclose(read.position_std.values[:, ENU], np.nan_to_num(log.std_m), atol=5.1e-5, rtol=0)
    assert read.fix.values.tolist() == [1] * 20 + [2] * 9 + [5]


def test_csv_file_contains_the_refined_positions_and_the_attitude(log, tmp_path):
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


def test_corrections_and_deviations_are_in_east_north_up(log):
    up = -ned_axes(log.track.position.values)[..., 2]
    lifted = RefinedLog("uav1", log.track, 0.05 * up, np.full((30, 3), 0.02), log.stated_m)
    np.testing.assert_allclose(lifted.correction_m, np.tile([0.0, 0.0, 0.05], (30, 1)), atol=1e-12)
    np.testing.assert_allclose(
        np.diff([geodetic_from_ecef(log.track.position.values), lifted.geodetic], axis=0)[0, :, 2], 0.05
    )
    np.testing.assert_allclose(lifted.std_m, 0.02)  # equal in all directions
    inside = log.refined
    assert inside.tolist() == [True] * 25 + [False] * 5
    np.testing.assert_allclose((log.std_m**2).sum(axis=1)[inside], (log.left_m**2).sum(axis=1)[inside])
    np.testing.assert_allclose(
        log.std_m[~inside, :2], np.hypot([0.01, 0.02], log.correction_m[~inside, :2])
    )  # the constant correction applies to other epochs
    assert np.isnan(log.std_m[~inside, 2]).all()


def test_track_in_a_local_frame_is_written_in_its_axes(tmp_path):
    position_m = np.arange(12.0).reshape(4, 3)
    log = RefinedLog(
        "uav1", track_of(position_m, frame="local"), np.full((4, 3), [0.1, 0.2, 0.3]), np.full((4, 3), 0.01), position_m
    )
    write_csv(tmp_path / "uav1.csv", log)
    read = read_csv_track(tmp_path / "uav1.csv", node="uav1")
    assert read.attrs["frame"] == "local"
    np.testing.assert_allclose(read.position.values, position_m + [0.1, 0.2, 0.3], atol=1e-5)
    np.testing.assert_allclose(log.correction_m, np.tile([0.1, 0.2, 0.3], (4, 1)))


def stage_of(*, accepted, pairs=()):
    """Return the stage of a refinement: node uav1 displaced by up to 1 m in 2 s, zero path offsets of pairs."""
    knots = START + np.array([0, 2_000_000_000], "timedelta64[ns]")
    moved_m = np.array([[[0.0, 0, 0], [1.0, 0, 0]]])
    return xr.Dataset(
        {
            "time": ("knot", knots),
            "correction": (("node", "knot", "axis"), moved_m),
            "further": (("pair", "knot"), np.zeros((len(pairs), 2))),
            "std": (("node", "knot", "axis"), np.full((1, 2, 3), 0.01)),
        },
        attrs={
            "nodes": ["uav1"],
            "pairs": list(pairs),
            "accepted": accepted,
            "reason": "as stated",
            "decisions": {"autofocus": {"value": "on", "reason": "requested"}},
        },
    )


@pytest.mark.parametrize(
    ("refinement", "outcome", "moved_m", "refined"),
    [
        ({"accepted": True}, "refined: autofocus on: requested; as stated", [0.0, 0.5, 1.0, 1.0], [1, 1, 1, 0]),
        ({"accepted": False}, "as logged: autofocus on: requested; as stated", [0.0] * 4, [0] * 4),
    ],
)
def test_accepted_correction_is_applied_and_held_beyond_the_pulses(refinement, outcome, moved_m, refined, settings):
    track = track_of(np.zeros((22, 3)), frame="local").isel(epoch=[0, 7, 14, 21])
    refined_track = RefinedTrack.of(stage_of(**refinement))
    log = refined_log(refined_track, "uav1", track, settings)
    assert outcome_of(refined_track) == outcome
    np.testing.assert_allclose(log.correction_m[:, 0], moved_m)
    np.testing.assert_array_equal(log.refined, refined)


def test_one_phase_per_pulse_moves_no_node_position(settings):
    stage = stage_of(accepted=True, pairs=["uav1-uav1"])
    refined_track = RefinedTrack.of(stage.assign(correction=0 * stage.correction))
    assert isinstance(refined_track.correction, TrackCorrection)
    assert outcome_of(refined_track).startswith(
        "as logged: the refinement estimated one path offset per pulse and pair, and no node position"
    )
    log = refined_log(refined_track, "uav1", track_of(np.zeros((8, 3)), frame="local"), settings)
    assert not log.refined.any()
    assert not log.correction_m.any()


def test_accuracy_of_the_log_takes_precedence_over_the_config(settings):
    own = np.array([[0.01, 0.02, 0.03], [0.0, 0.0, 0.0], [np.nan] * 3])
    track = track_of(np.zeros((3, 3)), frame="local", position_std=(("epoch", "axis"), own))
    refined_track = RefinedTrack.of(stage_of(accepted=False))
    for configured, others in ((None, [np.nan] * 3), ((0.1, 0.2, 0.3), [0.2, 0.1, 0.3])):
        log = refined_log(refined_track, "uav1", track, settings.model_copy(update={"position_std_m": configured}))
        np.testing.assert_allclose(log.std_m, [[0.02, 0.01, 0.03], others, others])


@pytest.fixture
def settings(finished_tiny):
    return finished_tiny.settings.nodes["uav1"]


def test_unrefined_tracks_are_exported_as_logged(finished_tiny):
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
def test_plot_has_a_column_per_node(log, tmp_path):
    for count in (1, 4):
        write_picture(tmp_path / f"{count}.png", [log] * count, title="a flight", outcome="refined: as stated", tags={})
    one, four = (imread(tmp_path / f"{count}.png") for count in (1, 4))
    assert four.shape[1] > 1.5 * one.shape[1]


@pytest.mark.slow
def test_plot_without_correction_has_two_panels(log, tmp_path):
    still = replace(log, moved_m=np.zeros((30, 3)), left_m=np.full((30, 3), np.nan))
    for name, logs in (("still", [still] * 4), ("moved", [log] * 4)):
        write_picture(tmp_path / f"{name}.png", logs, title="a flight", outcome="as logged: off", tags={})
    still_px, moved_px = (imread(tmp_path / f"{name}.png") for name in ("still", "moved"))
    assert still_px.shape[0] < moved_px.shape[0]
    assert still_px.shape[1] < moved_px.shape[1]
    assert (still_px[..., :3].min(axis=-1) < 0.9).any()  # curves are drawn
