"""Images of a flight hold each other: what is wrong with one is said of it, with what would mend it."""

import json
import re
from io import StringIO
from types import SimpleNamespace

import numpy as np
import pytest
from folders import SHARED, copy_writable, edit_config, edit_track, run_steps
from rich.console import Console

from apertura.campaign.folder import Campaign
from apertura.campaign.store import record_files
from apertura.common.errors import CampaignError
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.simulation import preset, simulate
from apertura.stages import assess, cube, echo, export, hypotheses, image, profile
from apertura.stages.acquisition import check_rates
from apertura.stages.agreement import assessment_of
from apertura.stages.hypotheses import Hypothesis, explanation
from apertura.views.summary import _print_flags, print_summary

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
    assert lines["heights"]["stated"].startswith("not stated; assumed 3 m")  # a straight track does not show it
    assert 0.6 < lines["heights"]["shift_m"] < 2.4
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
    assert "not in the error budget, because no uncertainty is configured" in said
    assert re.search(r"geolocation uncertainty \d\.\d+ m, dominated by heights, not stated; assumed 3 m", said)


def test_a_sentence_that_several_flags_have_in_common_stands_once_in_the_summary():
    cause = "4.1 of 4.5 dB are explained if the times of the log of uav1 are 0.50 s late"
    lines = {"defocused": f"4.5 dB lost; {cause}", "pairs_displaced": f"5 points lie 12 cm apart; {cause}"}
    reports = {"f01 a-a": {"flags": lines}, "f01 a-b": {"flags": {"defocused": f"3.2 dB lost; {cause}"}}}
    console = Console(file=StringIO(), width=200)
    _print_flags(console, reports)
    lines = [line.strip() for line in console.file.getvalue().splitlines()]
    assert [line for line in lines if line.startswith("f01")] == [
        f"f01 a-a: 4.5 dB lost; {cause}",
        "f01 a-b: 3.2 dB lost; as above",
        "f01 a-a: 5 points lie 12 cm apart; see defocused",
    ]


def flip_right_arm(document):
    arms = document["nodes"]["uav1"]["lever_arms_m"]
    for point in arms:
        arms[point][1] *= -1


@pytest.mark.slow
def test_the_sign_of_a_lever_arm_is_seen_and_named(tmp_path):
    """Both images are sharp, 33 and 26 cm from the truth: only each other they contradict, so neither is `focused`."""
    campaign = sample(tmp_path, lambda root: edit_config(root, flip_right_arm))
    reports = reports_of(campaign)
    for pair in PAIRS:
        assert reports[pair]["focus"]["loss_db"] > -0.3
        assert reports[pair]["focus"]["verdict"] == "inconclusive"
        assert "contradicted by pairs_displaced, pairs_out_of_phase" in reports[pair]["focus"]["reason"]
        assert {"pairs_displaced", "pairs_out_of_phase"} <= set(reports[pair]["flags"])
    best = reports["uav1-uav1"]["hypotheses"][0]
    assert best["kind"] == "offset"  # along a straight track an arm's sign is one of several that do the same
    assert best["what"].endswith("right axis of the lever arms of uav1 has the opposite sign")
    assert best["what"] in reports["uav1-uav1"]["flags"]["pairs_displaced"]
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
    assert {"pairs_displaced", "defocused", "pairs_out_of_phase"} & set(report["flags"])
    assert "the times of the log of uav1 are 0.50 s late" in report["hypotheses"][0]["what"]


@pytest.mark.slow
def test_random_errors_of_a_log_have_no_cause_that_is_named(tmp_path):
    """2 cm in both logs: several hypotheses gain 2 dB of the 7 that are lost, and so do tracks drawn at random."""
    generator = np.random.default_rng(5)

    def noisy(lines):
        spoilt = []
        for line in lines:
            stamp, latitude, longitude, *rest = line.split(",")
            if stamp[0].isdigit():
                north, east = generator.normal(0, 0.02 / 111e3, 2)
                latitude, longitude = f"{float(latitude) + north:.10f}", f"{float(longitude) + 1.5 * east:.10f}"
            spoilt.append(",".join([stamp, latitude, longitude, *rest]))
        return spoilt

    reports = reports_of(sample(tmp_path, lambda root: edit_track(root, "uav1", noisy)))
    flags = reports["uav1-uav1"]["flags"]
    assert reports["uav1-uav1"]["hypotheses"] == []
    assert "no single cause explains it" in flags["defocused"]


def trial(gain_db, kind, *, offset=False):
    return Hypothesis(f"it is {kind}", kind, (), gain_db=gain_db, is_offset=offset)


@pytest.mark.parametrize(
    ("trials", "drawn", "lost_db", "named"),
    [
        ([trial(6.0, "time"), trial(2.9, "height")], [2.0, 1.0], 7.0, "time"),
        ([trial(6.0, "time"), trial(5.9, "time"), trial(2.9, "height")], [2.0], 7.0, "time"),  # half a second or 0.6
        ([trial(6.0, "range"), trial(5.9, "prefix")], [2.0], 7.0, "range"),  # one cause by two names
        ([trial(4.0, "time"), trial(1.0, "height")], [1.0], 7.0, None),  # less than most of what was lost
        ([trial(6.0, "time"), trial(3.1, "height")], [1.0], 7.0, None),  # another cause does as well
        ([trial(6.0, "time"), trial(1.0, "height")], [3.1], 7.0, None),  # so does chance
        ([trial(0.4, "time")], [], 0.5, None),
        ([trial(60.0, "height"), trial(37.0, "carrier_is")], [3.0], 22.0, "height"),  # beyond doubt
        ([trial(2.4, "range", offset=True), trial(2.3, "lever arm", offset=True)], [1.0], 2.6, "offset"),
        ([trial(2.4, "range", offset=True), trial(2.3, "time")], [1.0], 2.6, None),
        ([], [], 5.0, None),
    ],
)
def test_a_hypothesis_is_named_where_it_alone_explains_most_of_what_was_lost(trials, drawn, lost_db, named):
    found = explanation(trials, [trial(gain_db, "chance") for gain_db in drawn], lost_db)
    assert [one["kind"] for one in found] == ([named] if named else [])


@pytest.mark.parametrize(
    ("loss_db", "std_db", "gain_db", "told"),
    [
        (-1.35, 0.3, 1.6, True),
        (-1.35, 0.3, 0.0, False),  # the cause is another pair's
        (-1.35, 0.6, 1.6, False),  # chance
        (-3.0, 0.3, 1.6, False),  # something else does most of it
        (-0.1, 0.01, 0.3, False),
    ],
)
def test_a_cause_named_for_one_pair_is_told_of_another_that_it_brings_back(loss_db, std_db, gain_db, told):
    assert assess._regained({"loss_db": loss_db, "std_db": std_db}, gain_db) is told
    assert assess._regained({}, gain_db) is False


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


def with_longer_path(root, added_m):
    """Image a campaign again with the path of the second receiver so much longer, and export its sums."""
    edit_config(root, lambda document: document["nodes"]["uav2"]["path_offset_m"].update(radar=0.911 + added_m))
    campaign = Campaign.load(root)
    for step in (echo.echo, profile.profile, image.image):
        step(campaign, "f01", "uav1-uav2")
    assess.assess(campaign, "f01")
    cube.cube(campaign)
    export.export_fused(campaign, "f01")
    return json.loads((campaign.results / "f01" / "fused" / "image.json").read_text())


@pytest.mark.slow
def test_a_sum_whose_phase_nothing_tells_says_so_and_that_its_peaks_are_lost(finished_tiny, tmp_path, monkeypatch):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    monkeypatch.setattr("apertura.stages.assess.agreement_of", lambda *_: None)
    told = with_longer_path(root, 0.214 / 4)
    assert [*told["fusion"]["phases_rad"]] == list(PAIRS)
    assert "is added with phase 0: it shares nothing with" in told["flags"]["phase_unobservable"]
    assert "peak loss for a phase error of a quarter cycle: 3 dB" in told["flags"]["phase_unobservable"]
    assert told["coherence"]["mean"] == pytest.approx(0.5, abs=0.15)
    assert "sum_incoherent" in told["flags"]
    assert told["focus"]["verdict"] == "defocused"
    assert "from phase differences between pairs" in told["focus"]["reason"]


def test_a_sum_states_what_it_gained(finished_tiny):
    told = json.loads((finished_tiny.results / "f01" / "fused" / "image.json").read_text())
    assert told["focus"]["verdict"] == "focused"
    assert told["gain"]["allowed_db"] == pytest.approx(3.01)
    pairs = [json.loads((finished_tiny.results / "f01" / pair / "image.json").read_text()) for pair in PAIRS]
    for cut in ("cross_range_width_m", "ground_range_width_m"):
        assert told["brightest"][cut] < 1.05 * min(one["brightest"][cut] for one in pairs)
    assert told["brightest"]["cross_range_width_m"] < 0.75 * pairs[0]["brightest"]["cross_range_width_m"]


@pytest.fixture(scope="module")
def papers_flight(tmp_path_factory):
    root = tmp_path_factory.mktemp("uav") / "campaign"
    simulate(root, preset("paper-uav"), seed=1)
    return run_steps(root)


@pytest.mark.parametrize(
    ("spacing_m", "reason"), [(0.1, ""), (0.11, "pixels of 0.11 m do not sample resolution cells of 0.0997 m")]
)
def test_pixels_hardly_wider_than_a_cell_are_compared_and_wider_ones_are_named_as_the_reason(spacing_m, reason):
    """A cell of 9.97 cm against pixels of 10 cm is no loss: the band is sampled twice a cycle up to 1.13 cells."""
    shown = {pair: SimpleNamespace(cell_m=0.0997) for pair in PAIRS}
    grid = SceneGrid("local", 0.0, 10.0, spacing_m, (100, 100))
    assert assess._too_coarse(shown, grid).partition(":")[0] == reason


@pytest.mark.slow
def test_the_papers_flight_is_added_in_phase_and_the_sum_states_its_widths(papers_flight):
    """The paper prints 11 cm × 49 cm of segments that it does not give; those of the preset make 12 cm × 54 cm."""
    told = json.loads((papers_flight.results / "f01" / "fused" / "image.json").read_text())
    assert told["flags"] == {}
    assert told["focus"]["verdict"] == "focused"
    assert told["fusion"]["agreeing"] == list(PAIRS)
    assert told["fusion"]["unmeasured"] == {}
    assert told["coherence"]["mean"] > 0.95
    brightest = told["brightest"]
    assert brightest["cross_range_width_m"] == pytest.approx(0.12, abs=0.005)
    assert brightest["ground_range_width_m"] == pytest.approx(0.54, abs=0.03)
    assert brightest["cross_range_pslr_db"] == pytest.approx(-4.5, abs=0.6)  # of the gap between the segments
    (between,) = assessment_of(papers_flight, "f01")["between"]
    assert between["points"] == 3  # the fourth is 0.2 m from the edge
    assert abs(between["phase_rad"]) < 3 * between["phase_std_rad"] < 1


@pytest.mark.slow
@pytest.mark.parametrize(("wavelengths", "flag"), [(0.25, "phase"), (0.5, "phase"), (1.0, "place")])
def test_a_path_of_the_papers_flight_that_is_wrong_is_told_by_phase_or_place(
    papers_flight, tmp_path, wavelengths, flag
):
    root = copy_writable(papers_flight.root, tmp_path / "campaign")
    told = with_longer_path(root, wavelengths * 0.2134)
    line = told["flags"][{"phase": "pairs_out_of_phase", "place": "pairs_displaced"}[flag]]
    assert "do not show which pairs are wrong" in line
    assert len(told["fusion"]["left_out"]) == 1
    assert told["fusion"]["ties"] == [[*told["fusion"]["left_out"]]]
    assert "; tie: " in told["flags"]["pair_excluded"]


@pytest.mark.parametrize("height_m", [-3.0, 0.5, 3.0])
def test_a_hypothesis_on_the_height_is_tried_where_its_point_then_lies(monkeypatch, height_m):
    """A ground 3 m lower shifts points by several metres: as far as their mean path stays what it is."""
    track = np.stack([np.linspace(-5, 5, 64), np.full(64, -30.0), np.full(64, 25.0)], -1)
    found = [SimpleNamespace(history=SimpleNamespace(aperture=Aperture(track, track + [0.0, 4.0, 2.0])))]
    here_m = np.array([1.0, 2.0, 0.0])
    monkeypatch.setattr(hypotheses, "_on_level", lambda *_: here_m)
    scene = SimpleNamespace(axes=np.eye(3))
    east_m, north_m = hypotheses._displacement_by_height(scene, (1.0, 2.0), found, height_m)
    there_m = here_m + [east_m, north_m, height_m]
    before, after = (found[0].history.aperture.path(one[None]).mean() for one in (here_m, there_m))
    moved_m = np.hypot(east_m, north_m)
    assert moved_m > 0.6 * abs(height_m)
    assert abs(after - before) < (moved_m**2 + height_m**2) / 30  # of second order: a path of 80 m is curved


def test_a_carrier_that_a_recording_does_not_state_is_that_of_the_config():
    """SigMF makes core:frequency optional: absent, it is no contradiction."""
    waveform = SimpleNamespace(carrier_hz=1.3e9, sample_rate_hz=5e7)
    check_rates(waveform, {"carrier_hz": 0.0, "sample_rate_hz": 5e7}, where="uav1.sigmf-meta")
    with pytest.raises(CampaignError, match="recorded with carrier_hz 1200000000"):
        check_rates(waveform, {"carrier_hz": 1.2e9}, where="uav1.sigmf-meta")
