"""Images of a flight hold each other: what is wrong with one is said of it, with what would mend it."""

import json

import pytest
from folders import SHARED, copy_writable, edit_config, edit_track, run_steps

from apertura.pipeline.campaign import Campaign
from apertura.pipeline.opening.results import assessment_of
from apertura.pipeline.steps import assess, cube, echo, image, profile
from apertura.pipeline.store import record_files
from apertura.views.summary import print_summary

PAIRS = ("uav1-uav1", "uav1-uav2")


def reports_of(campaign):
    return {
        name: json.loads((campaign.results / "f01" / name / "image.json").read_text()) for name in (*PAIRS, "fused")
    }


def flags_of(campaign):
    return {name: set(report["flags"]) for name, report in reports_of(campaign).items()}


def sample(folder, spoil=lambda _: None):
    if not SHARED.is_dir():
        pytest.skip("../shared/data is absent")
    root = copy_writable(SHARED / "campaign-sample", folder / "campaign")
    spoil(root)
    return run_steps(root)


def test_a_right_campaign_is_focused_agrees_and_has_no_flag(finished_sample):
    reports = reports_of(finished_sample)
    assert flags_of(finished_sample) == {name: set() for name in (*PAIRS, "fused")}
    for pair in PAIRS:
        assert reports[pair]["focus"]["verdict"] == "focused"
        assert reports[pair]["focus"]["loss_db"] > -0.1
        assert reports[pair]["hypotheses"] == []
    found = reports["uav1-uav2"]["agreement"]
    assert found["points"] == 4
    assert abs(found["phase_rad"]) < 0.1
    assert reports["fused"]["coherence"]["mean"] > 0.99
    assert reports["fused"]["coherence"]["chance"] == 0.5
    assert list(reports["fused"]["fusion"]["phases_rad"]) == list(PAIRS)


def test_every_image_carries_its_budget(finished_sample):
    lines = {line["cause"]: line for line in reports_of(finished_sample)["uav1-uav2"]["budget"]}
    assert {"positions", "heights", "time tags", "calibration", "clock", "sidelink noise", "arithmetic"} <= set(lines)
    assert lines["heights"]["stated"].startswith("not stated; 1 m")
    assert 0.2 < lines["heights"]["shift_m"] < 0.8
    assert lines["arithmetic"]["loss_db"] > -0.001


def test_the_summary_says_each_flag_once_and_whole(finished_sample, capsys, tmp_path):
    root = copy_writable(finished_sample.root, tmp_path / "campaign")
    for name in (*PAIRS, "fused"):
        path = root / "results" / "f01" / name / "image.json"
        report = json.loads(path.read_text())
        path.write_text(json.dumps(report | {"flags": {"defocused": "a line [with brackets]"}}))
        record_files(path.with_name("export.manifest.json"), [path])
    print_summary(Campaign.load(root))
    said = capsys.readouterr().out
    assert said.count("a line [with brackets]") == 1
    assert "not stated, so not in the budget" in said


def flip_right_arm(document):
    arms = document["nodes"]["uav1"]["lever_arms_m"]
    for point in arms:
        arms[point][1] *= -1


@pytest.mark.slow
def test_the_sign_of_a_lever_arm_is_seen_and_named(tmp_path):
    """Both images are sharp, 33 and 26 cm from the truth: only each other they contradict."""
    campaign = sample(tmp_path, lambda root: edit_config(root, flip_right_arm))
    reports = reports_of(campaign)
    for pair in PAIRS:
        assert reports[pair]["focus"]["verdict"] == "focused"
        assert {"pairs_apart", "pairs_out_of_phase"} <= set(reports[pair]["flags"])
    best = reports["uav1-uav1"]["hypotheses"][0]
    assert best["kind"] == "lever arm"
    assert best["what"] == "right axis of the lever arms of uav1 has the other sign"
    assert best["what"] in reports["uav1-uav1"]["flags"]["pairs_apart"]
    left_out = reports["fused"]["fusion"]["left_out"]
    assert len(left_out) == 1
    assert next(iter(left_out)) in reports["fused"]["models"]["fusion"]


def later(seconds):
    """Shift the times of a CSV log."""

    def change(lines):
        shifted = []
        for line in lines:
            stamp, *cells = line.split(",")
            if stamp[0].isdigit():
                whole, rest = stamp[:-1].rsplit(":", 1)
                stamp = f"{whole}:{float(rest) + seconds:09.6f}Z" if 0 <= float(rest) + seconds < 60 else ""
            if stamp:
                shifted.append(",".join([stamp, *cells]))
        return shifted

    return change


@pytest.mark.slow
def test_a_log_half_a_second_late_is_seen_and_named(tmp_path):
    campaign = sample(tmp_path, lambda root: edit_track(root, "uav1", later(0.5)))
    report = reports_of(campaign)["uav1-uav2"]
    assert {"pairs_apart", "defocused", "pairs_out_of_phase"} & set(report["flags"])
    assert report["hypotheses"][0]["kind"] == "time"
    assert "the times of the log of uav1 are 0.50 s late" in report["hypotheses"][0]["what"]


@pytest.mark.slow
def test_a_phase_between_pairs_is_taken_off_where_that_is_asked_for(finished_sample, tmp_path):
    def off_by_a_quarter(align):
        root = copy_writable(finished_sample.root, tmp_path / f"align-{align}")

        def change(document):
            offsets = document["nodes"]["uav2"]["path_offset_m"]
            offsets["radar"] += 0.05
            document["processing"] = {"fusion": {"align_phase": align}}

        edit_config(root, change)
        campaign = Campaign.load(root)
        for step in (echo.echo, profile.profile, image.image):
            step(campaign, "f01", "uav1-uav2")
        assess.assess(campaign, "f01")
        cube.cube(campaign)
        return assessment_of(campaign, "f01")

    left = off_by_a_quarter(align=False)
    assert left["fusion"]["left_out"].keys() == {"uav1-uav2"}
    assert "pairs_out_of_phase" in left["pairs"]["uav1-uav2"]["flags"]
    aligned = off_by_a_quarter(align=True)
    assert aligned["fusion"]["left_out"] == {}
    assert abs(aligned["fusion"]["phases_rad"]["uav1-uav2"]) == pytest.approx(2 * 3.1416 * 0.05 / 0.2142, abs=0.15)
