"""Track refinement from images: decision, image formation with refined tracks, and reports."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from folders import STAND_ON_ALL, copy_writable, edit_config, image_of, quality_of, state
from judging.bases import curved
from spoiling.logs import read_log, write_log
from spoiling.of_logs import late, noisy
from track_noise import declare_std

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, save_stage
from apertura.check import as_line, problems
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import ecef_from_geodetic, ned_axes
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.imaging.range_profiles import profiles_of
from apertura.core.planning.decisions import TOLERATED_LOSS_DB, decide_autofocus
from apertura.core.planning.plan import Decision
from apertura.methods.autofocus.inputs import PairRecord, Refinement
from apertura.run.process import process
from apertura.simulation import ImageGrid, preset, simulate
from apertura.stages import image, refine, tracks
from apertura.stages.acquisition import open_acquisition
from apertura.stages.hypotheses import subset_geometry, with_logs
from apertura.stages.pair import open_pair
from apertura.stages.refine import RefinedTrack, RefinementInputs, clock_s, open_refined, reference_points
from apertura.stages.scene import open_scene
from apertura.stages.tags import stamped
from apertura.stages.transfer import PairEcho
from apertura.stages.transmitted import transmitted
from apertura.tools.open_campaign import open_campaign
from apertura.views.plan import print_plan
from apertura.views.score import score
from apertura.workflow.stale import stale_results

PAIRS = ("uav1-uav1", "uav1-uav2")
DECISIONS = (Decision("autofocus", "on", "requested"), Decision("autofocus_method", "tracks", "requested"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("configured", "loss_db", "unstated_nodes", "value"),
    [
        ("auto", -TOLERATED_LOSS_DB - 0.01, [], "on"),
        ("auto", -TOLERATED_LOSS_DB + 0.01, [], "off"),
        ("auto", -5.0, ["b"], "off"),
        ("on", 0.0, ["a", "b"], "on"),
        ("off", -5.0, [], "off"),
    ],
)
def test_tracks_are_refined_if_configured_or_if_errors_exceed_tolerance(configured, loss_db, unstated_nodes, value):
    decision = decide_autofocus(configured, {"a-a": 0.0, "a-b": loss_db}, unstated_nodes)
    assert decision.value == value
    assert ("position_std_m" in decision.reason) is (unstated_nodes == ["b"])


@pytest.mark.slow
def test_unrefined_tracks_have_no_knots_and_the_reason_is_reported(finished_tiny):
    stage = open_campaign(finished_tiny.root).stage("refined_track", "f01")
    assert dict(stage.sizes) == {"node": 2, "knot": 0, "axis": 3, "pair": 0}
    assert stage.attrs["nodes"] == ["uav1", "uav2"]
    quality = quality_of(finished_tiny, "uav1-uav2")
    assert quality["autofocus"] == {
        "decision": "off: auto: position accuracy of uav1 is not configured; set nodes.<node>.position_std_m to "
        "have the tracks refined",
        "accepted": False,
        "reason": "images are formed from the unchanged logs",
    }
    assert quality["models"]["autofocus"].startswith("off: auto: position accuracy")


@pytest.mark.slow
def test_without_correction_images_use_the_original_arrays(finished_tiny):
    track, pair = open_refined(finished_tiny, "f01"), open_pair(finished_tiny, "f01", "uav1-uav2")
    profiles = profiles_of(open_stage(finished_tiny.stage("profile", "f01", "uav1-uav2"), "profile"))
    assert track.pair(pair) is pair
    assert track.profiles(pair, profiles) is profiles


@pytest.fixture(scope="module")
def erroneous(finished_tiny, tmp_path_factory):
    """Return a campaign with errors of centimetres in the transmitter's log, profiles formed, and their correction."""
    root = copy_writable(finished_tiny.root, tmp_path_factory.mktemp("erroneous") / "campaign")
    path = root / "raw" / "f01" / "uav1.track.csv"
    log = read_log(path)
    error_m = 0.03 * np.sin(2 * np.pi * log.time_s[:, None] / np.array([2.1, 1.7, 2.4]) + np.array([0.0, 1.0, 2.0]))
    moved = log.moved(error_m)
    write_log(path, moved)
    campaign = Campaign.load(root)
    process(campaign, last="profile")
    back_m = ecef_from_geodetic(*log.geodetic.T) - ecef_from_geodetic(*moved.geodetic.T)
    return campaign, (log.begun, TrackCorrection(log.time_s, {"uav1": back_m, "uav2": np.zeros_like(back_m)}))


def write_track(campaign, start, correction, *, accepted=True, flags=None):
    """Write the stage of a refinement with this correction."""
    opened = open_scene(campaign)
    records = []
    for name in PAIRS:
        pair = open_pair(campaign, "f01", name)
        profiles = profiles_of(open_stage(campaign.stage("profile", "f01", name), "profile"))
        records.append(PairRecord(name, profiles, clock_s(pair, start), pair.sidelink_m))
    std_m = {node: np.full_like(moved, 1e-3) for node, moved in correction.moved_m.items()}
    report = {"gain_held_out_db": 3.0, "left_db": -0.05, "left_rad": 0.1, "gauge_shift_m": 0.01}
    refinement = Refinement(correction, std_m, accepted, "as stated", report, flags or {})
    inputs = RefinementInputs(tuple(records), {}, (), start)
    stage = refine.refined_stage(refinement, DECISIONS, inputs, opened)
    save_stage(stamped(stage, "refined_track", modules=[refine.__name__]), campaign.stage("refined_track", "f01"))


@pytest.mark.slow
def test_corrected_track_gives_the_images_of_the_true_track(erroneous, finished_tiny):
    campaign, correction = erroneous
    correlation = {}
    for accepted in (False, True):
        write_track(campaign, *correction, accepted=accepted, flags={"position_error_understated": "as stated"})
        for pair in PAIRS:
            image.image(campaign, "f01", pair)
            true, corrected = (image_of(which, pair) for which in (finished_tiny, campaign))
            correlation[pair, accepted] = (
                abs(np.vdot(true, corrected)) / np.linalg.norm(true) / np.linalg.norm(corrected)
            )
    for pair in PAIRS:
        assert correlation[pair, False] < 0.9
        assert correlation[pair, True] > 0.9999
        quality = quality_of(campaign, pair)
        assert quality["autofocus"]["rms_cm"]["uav1"] == pytest.approx(3 * np.sqrt(3 / 2), rel=0.15)
        assert quality["autofocus"]["gain_held_out_db"] == 3.0
        assert quality["models"]["autofocus"] == "on: requested; as stated"
        assert quality["flags"]["position_error_understated"] == "as stated"
        assert [line for line in quality["budget"] if line["cause"] == "positions"] == [
            {
                "cause": "positions",
                "stated": "residual error after track refinement",
                "loss_db": -0.05,
                "shift_m": 0.01,
                "phase_rad": 0.1,
            }
        ]


@pytest.mark.slow
def test_delivered_refined_logs_give_the_same_images(erroneous, tmp_path):
    """Images are formed from the delivered tracks: a CSV table with attitude and a .pos solution without attitude."""
    campaign, (start, correction) = erroneous
    wave_m = 0.02 * np.sin(correction.time_s[:, None] / np.array([0.4, 0.5, 0.3]))
    both = TrackCorrection(correction.time_s, {"uav1": correction.moved_m["uav1"], "uav2": wave_m})
    write_track(campaign, start, both)
    tracks.tracks(campaign, "f01")
    logged = copy_writable(campaign.root, tmp_path / "logged")
    delivered = copy_writable(campaign.root, tmp_path / "delivered")
    for node, suffix in (("uav1", "csv"), ("uav2", "pos")):
        (delivered / "raw" / "f01" / f"{node}.track.{suffix}").write_bytes(
            (campaign.results / "f01" / "tracks" / f"{node}.{suffix}").read_bytes()
        )
    for root in (logged, delivered):
        off = state(root, "processing", autofocus="off")
        process(off, last="profile")
        refine.refine(off, "f01")
    for pair in PAIRS:
        images = []
        for which in (campaign, Campaign.load(logged), Campaign.load(delivered)):
            image.image(which, "f01", pair)
            images.append(image_of(which, pair) / np.linalg.norm(image_of(which, pair)))
        refined, as_logged, from_files = images
        assert abs(np.vdot(refined, as_logged)) < 0.9
        assert abs(np.vdot(refined, from_files)) > 0.9999


@pytest.mark.slow
def test_hypotheses_start_from_the_refined_tracks(erroneous):
    campaign, correction = erroneous
    write_track(campaign, *correction)
    track, waveform = open_refined(campaign, "f01"), campaign.settings.waveform
    logged = {
        node: open_acquisition(campaign, "f01", node, transmitted(campaign, waveform)) for node in ("uav1", "uav2")
    }
    nodes = {name: track.node(node) for name, node in logged.items()}
    for name in PAIRS:
        pair = open_pair(campaign, "f01", name)
        geometry = subset_geometry(logged, name, PairEcho.opened(campaign, "f01", name).stage, "hann")
        (moved,) = with_logs(nodes, [geometry])
        imaged = track.pair(pair).history
        assert np.abs(imaged.aperture.tx_m - pair.aperture.tx_m).max() > 0.02
        np.testing.assert_allclose(moved.history.aperture.tx_m, imaged.aperture.tx_m, atol=1e-3)
        np.testing.assert_allclose(moved.history.reference_delay_s, imaged.reference_delay_s, atol=1e-3 / 3e8)


@pytest.mark.slow
def test_settings_of_refinement_outdate_only_dependent_results(finished_tiny, tmp_path):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    x, y = np.mean(np.reshape(finished_tiny.settings.scene.bounds_m, (2, 2)), axis=0).tolist()
    known = [{"name": "corner", "position_m": [x, y, 620.0], "std_m": 0.01}]
    for section, keys in (("processing", {"autofocus": False}), ("scene", {"reference_points": known})):
        stale = {name.rsplit("/", 1)[1].split(".")[0] for name in stale_results(state(root, section, **keys))}
        assert stale == {"refined_track", "tracks", "image", "assessment", "export", "cube"} | STAND_ON_ALL
    (point,) = reference_points(Campaign.load(root))
    assert np.linalg.norm(np.array(point.place_m) - open_scene(finished_tiny).middle_m) < 0.2
    assert not problems(root)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("by_m", "message"),
    [((4.0, 0.0, 0.0), "outside the scene"), ((0.0, 0.0, 2000.0), "close to the terrain of the scene, about 620.0 m")],
)
def test_reference_point_outside_the_scene_is_reported(finished_tiny, tmp_path, by_m, message):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    x, y = np.mean(np.reshape(finished_tiny.settings.scene.bounds_m, (2, 2)), axis=0).tolist()
    place = [x + by_m[0], y + by_m[1], 620.0 + by_m[2]]
    state(root, "scene", reference_points=[{"name": "corner", "position_m": place, "std_m": 0.01}])
    (line,) = map(as_line, problems(root))
    assert line.startswith("config/config.yaml: scene.reference_points[0]: corner")
    assert message in line
    with pytest.raises(CampaignError, match="positions of reference_points refer to crs, which is auto"):
        state(root, "scene", crs="auto")


@pytest.mark.slow
def test_on_and_off_are_read_as_text_and_not_as_booleans(tiny):
    for word in ("on", "off", "auto"):
        path = tiny / "config" / "config.yaml"
        path.write_text(path.read_text().partition("processing:")[0] + f"processing:\n  autofocus: {word}\n")
        assert Campaign.load(tiny).settings.processing.autofocus == word


@pytest.mark.slow
def test_plan_reports_the_autofocus_decision(tiny, capsys):
    edit_config(tiny, lambda document: [node.update(position_std_m=0.02) for node in document["nodes"].values()])
    print_plan(Campaign.load(tiny))
    printed = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert printed.count("autofocus on auto: configured position errors cost") == 2


def campaign_to_refine(folder, *, pulses, half_m, std_m=0.0, stated_m=0.02):
    """Return a flight with true and stated log errors and autofocus on; its profiles are formed."""
    plan = replace(preset("demo", pulses=pulses), scene=ImageGrid("EPSG:32632", half_width_m=half_m, spacing_m=0.1))
    root = simulate(folder / "campaign", plan, seed=7)
    add_noise(root, std_m, stated_m)
    campaign = state(root, "processing", autofocus="on")
    process(campaign, last="profile")
    return campaign


@pytest.mark.slow
@pytest.mark.parametrize(("pulses", "half_m"), [(40, 3.0), (200, 6.0)])
def test_correct_logs_with_a_stated_error_of_2_cm_are_unchanged(tmp_path, pulses, half_m):
    campaign = campaign_to_refine(tmp_path, pulses=pulses, half_m=half_m)
    refine.refine(campaign, "f01")
    image.image(campaign, "f01", "uav1-uav1")
    quality, stage = quality_of(campaign, "uav1-uav1"), open_refined(campaign, "f01").stage
    assert "no improvement over the logs" in stage.attrs["reason"]
    assert stage.attrs["flags"].keys() <= {"position_error_overstated"}
    assert quality["flags"].items() >= stage.attrs["flags"].items()
    assert quality["autofocus"]["accepted"] is False
    assert quality["models"]["autofocus"].startswith("on: requested; ")
    assert json.loads(stage.attrs["runspec"]) == {
        "autofocus": "on",
        "autofocus_method": "auto",
        "reference_points": [],
        "refined": False,
    }
    pair = open_pair(campaign, "f01", "uav1-uav1")
    assert open_refined(campaign, "f01").pair(pair) is pair


def add_noise(root, std_m, stated_m):
    """Add noise with a correlation time of 1 s to both logs and state its standard deviation."""
    for path in sorted((root / "raw" / "f01").glob("*.track.*")):
        log = noisy(std_m, seed=3)(read_log(path))
        write_log(path, log if log.attitude_deg is not None else declare_std(stated_m)(log))
    edit_config(root, lambda document: [node.update(position_std_m=stated_m) for node in document["nodes"].values()])


@pytest.mark.slow
def test_errors_of_a_quarter_wavelength_are_corrected_or_flagged(tmp_path):
    """At the limit of the method, a track section may be wrong by a wavelength; the refinement is rejected."""
    campaign = campaign_to_refine(tmp_path, pulses=600, half_m=6.0, std_m=0.05, stated_m=0.05)
    refine.refine(campaign, "f01")
    stage = open_refined(campaign, "f01").stage
    assert stage.attrs["report"]["gain_held_out_db"] > 6
    if not stage.attrs["accepted"]:
        assert {"cycle_slip_suspected", "refinement_rejected"} & {*stage.attrs["flags"]}
        return
    image.image(campaign, "f01", "uav1-uav1")
    assert quality_of(campaign, "uav1-uav1")["focus"]["loss_db"] > -1.0


@pytest.mark.slow
def test_log_errors_of_2_cm_are_refined_automatically(tmp_path):
    right, erroneous = (tmp_path / name for name in ("right", "erroneous"))
    simulate(right, preset("demo", pulses=600), seed=7)
    copy_writable(right, erroneous)
    add_noise(erroneous, 0.02, 0.02)
    loss_of = {}
    for name, root in (("off", copy_writable(erroneous, tmp_path / "off")), ("auto", erroneous)):
        state(root, "processing", autofocus=name)
        campaign = process(root)
        loss_of[name] = {pair: quality_of(campaign, pair)["focus"]["loss_db"] for pair in PAIRS}
        worst_m = max(one.error_m for one in score(campaign))
    for pair in PAIRS:
        quality = quality_of(campaign, pair)
        assert quality["autofocus"]["accepted"]
        assert quality["focus"]["verdict"] == "focused"
        assert loss_of["off"][pair] < -1.0
        assert loss_of["auto"][pair] > -0.3
        assert quality["focus"]["expected_db"] == pytest.approx(quality["focus"]["loss_db"], abs=0.2)
    assert worst_m < 0.03
    report = json.loads((campaign.results / "f01" / "uav1-uav1" / "image.json").read_text())
    assert report["autofocus"]["gain_held_out_db"] > 0.3
    runspec = json.loads(open_stage(campaign.stage("image", "f01", "uav1-uav1"), "image").attrs["runspec"])
    assert runspec["uav1-uav2"]["nodes"].keys() == {"uav1", "uav2"}  # the image also depends on the other pair
    assert runspec["refined"] is True
    for node in ("uav1", "uav2"):
        check_delivered(campaign, node, right)


def check_delivered(campaign, node, right):
    """Check that the error of a delivered log is smaller than before and agrees with its stated deviation."""
    (name,) = (path.name for path in (right / "raw" / "f01").glob(f"{node}.track.*"))
    true_m, logged_m = (
        ecef_from_geodetic(*read_log(root / "raw" / "f01" / name).geodetic.T) for root in (right, campaign.root)
    )
    with (campaign.results / "f01" / "tracks" / f"{node}.csv").open() as stream:
        table = list(csv.DictReader(stream))
    texts = {"time_utc", "quality"}
    delivered = {column: np.array([float(row[column]) for row in table]) for column in table[0] if column not in texts}
    written_m = ecef_from_geodetic(*(delivered[name] for name in ("latitude_deg", "longitude_deg", "height_m")))
    enu = ned_axes(true_m)[..., [1, 0, 2]] * [1.0, 1.0, -1.0]
    before_m, after_m = (np.einsum("nai,na->ni", enu, one - true_m) for one in (logged_m, written_m))
    inside = delivered["refined"] == 1
    assert 0.8 < inside.mean() < 1
    std_m = np.stack([delivered[f"std_{axis}_m"] for axis in ("east", "north", "up")], axis=-1)
    assert (rms(after_m[inside]) < 0.95 * rms(before_m[inside])).all()
    assert rms(after_m[inside], axis=None) < 0.9 * rms(before_m[inside], axis=None)
    np.testing.assert_allclose(rms(after_m[inside] / std_m[inside]), 0.9, atol=0.25)
    assert rms(after_m[~inside] / std_m[~inside], axis=None) < 1.2


def rms(values, axis=0):
    return np.sqrt((values**2).mean(axis=axis))


@pytest.mark.slow
def test_refined_track_applies_to_a_pair_without_sidelink(erroneous):
    """Phase histories have no sidelink, whose length would be added to the paths."""
    campaign, (start, correction) = erroneous
    write_track(campaign, start, correction)
    track, pair = open_refined(campaign, "f01"), open_pair(campaign, "f01", "uav1-uav2")
    alone = track.pair(replace(pair, sidelink_m=None))
    np.testing.assert_array_equal(alone.history.reference_delay_s, pair.history.reference_delay_s)
    assert isinstance(track, RefinedTrack)
    assert not np.array_equal(track.pair(pair).history.reference_delay_s, pair.history.reference_delay_s)


@pytest.mark.slow
def test_delayed_log_is_identified_and_corrected(tmp_path):
    """From raw samples on curves at varying speed, a delay of 0.1 s costs 6 dB and displaces targets by 40 cm."""
    campaign = Campaign.load(curved(tmp_path / "campaign"))
    path = campaign.root / "raw" / "f01" / "uav1.track.csv"
    write_log(path, late(0.1)(read_log(path)))
    accuracy = {"position_std_m": 0.01}
    edit_config(campaign.root, lambda document: [node.update(accuracy) for node in document["nodes"].values()])
    campaign = process(campaign.root)
    attrs = open_refined(campaign, "f01").stage.attrs
    assert list(attrs["flags"]) == ["cause_corrected"]
    assert attrs["report"]["cause"]["what"].startswith("the times of the log of uav1 are ")
    assert attrs["report"]["cause"]["values"] == pytest.approx([0.1], abs=0.01)
    assert max(one.error_m for one in score(campaign)) < 0.03
    for pair in PAIRS:
        assert quality_of(campaign, pair)["focus"]["loss_db"] > -0.3
