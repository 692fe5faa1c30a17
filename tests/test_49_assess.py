"""Assessment of a flight: agreement between pairs, flags, hypotheses of causes, error budget and sums."""

import json
import re
from io import StringIO
from types import SimpleNamespace

import numpy as np
import pytest
from folders import SHARED, copy_writable, edit_config, edit_track
from rich.console import Console

from apertura.campaign.folder import Campaign
from apertura.campaign.store import record_files
from apertura.common.errors import CampaignError
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.run.process import process
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


def run_sample(folder, change=lambda _: None):
    if not SHARED.is_dir():
        pytest.skip("../shared/data is absent")
    root = copy_writable(SHARED / "campaign-sample", folder / "campaign")
    change(root)
    return process(root)


def test_correct_campaign_is_focused_and_raises_no_flag(finished_sample):
    reports = reports_of(finished_sample)
    assert flags_of(finished_sample) == {name: set() for name in (*PAIRS, "fused")}
    for pair in PAIRS:
        assert reports[pair]["focus"]["verdict"] == "focused"
        assert reports[pair]["focus"]["loss_db"] > -0.1
        assert reports[pair]["hypotheses"] == []
    agreement = reports["uav1-uav2"]["agreement"]
    assert agreement["points"] == 4
    assert abs(agreement["phase_rad"]) < 0.1
    assert reports["fused"]["coherence"]["mean"] > 0.99
    assert reports["fused"]["coherence"]["chance"] == 0.5
    assert list(reports["fused"]["fusion"]["phases_rad"]) == list(PAIRS)


def test_every_image_states_its_budget(finished_sample):
    lines = {line["cause"]: line for line in reports_of(finished_sample)["uav1-uav2"]["budget"]}
    assert {"positions", "heights", "time tags", "calibration", "clock", "sidelink noise", "arithmetic"} <= set(lines)
    assert lines["heights"]["stated"].startswith("not configured; assumed 3 m")  # not observable with a straight track
    assert 0.6 < lines["heights"]["shift_m"] < 2.4
    assert lines["arithmetic"]["loss_db"] > -0.001


def test_summary_prints_each_flag_once(finished_sample, capsys, tmp_path):
    root = copy_writable(finished_sample.root, tmp_path / "campaign")
    for name in (*PAIRS, "fused"):
        path = root / "results" / "f01" / name / "image.json"
        report = json.loads(path.read_text())
        path.write_text(json.dumps(report | {"flags": {"defocused": "a line [with brackets]"}}))
        record_files(path.with_name("export.manifest.json"), [path])
    print_summary(Campaign.load(root))
    printed = capsys.readouterr().out
    assert printed.count("a line [with brackets]") == 1
    assert "not in the error budget, because their uncertainty is not configured" in printed
    assert re.search(r"geolocation uncertainty \d\.\d+ m, dominated by heights \(not configured; assumed 3 m", printed)


def test_common_part_of_several_flags_is_printed_once():
    cause = "4.1 of 4.5 dB of the peak loss are explained if the times of the log of uav1 are 0.50 s late"
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
def test_sign_error_of_a_lever_arm_is_identified(tmp_path):
    """Both images are sharp but displaced by 33 and 26 cm; only the comparison of pairs detects the error."""
    campaign = run_sample(tmp_path, lambda root: edit_config(root, flip_right_arm))
    reports = reports_of(campaign)
    for pair in PAIRS:
        assert reports[pair]["focus"]["loss_db"] > -0.3
        assert reports[pair]["focus"]["verdict"] == "inconclusive"
        assert "contradicted by pairs_displaced, pairs_out_of_phase" in reports[pair]["focus"]["reason"]
        assert {"pairs_displaced", "pairs_out_of_phase"} <= set(reports[pair]["flags"])
    best = reports["uav1-uav1"]["hypotheses"][0]
    assert best["kind"] == "offset"  # one of several equivalent causes along a straight track
    assert best["what"].endswith("right axis of the lever arms of uav1 has the opposite sign")
    assert best["what"] in reports["uav1-uav1"]["flags"]["pairs_displaced"]
    excluded_pairs = reports["fused"]["fusion"]["excluded"]
    assert len(excluded_pairs) == 1
    assert next(iter(excluded_pairs)) in reports["fused"]["models"]["fusion"]


def delayed(seconds):
    """Return a function that shifts the times of a CSV log."""

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
def test_log_late_by_half_a_second_is_identified(tmp_path):
    campaign = run_sample(tmp_path, lambda root: edit_track(root, "uav1", delayed(0.5)))
    report = reports_of(campaign)["uav1-uav2"]
    assert {"pairs_displaced", "defocused", "pairs_out_of_phase"} & set(report["flags"])
    assert "the times of the log of uav1 are 0.50 s late" in report["hypotheses"][0]["what"]


@pytest.mark.slow
def test_random_log_errors_have_no_single_cause(tmp_path):
    """With errors of 2 cm, several hypotheses and random tracks all regain 2 dB of the loss of 7 dB."""
    generator = np.random.default_rng(5)

    def noisy(lines):
        noisy_lines = []
        for line in lines:
            stamp, latitude, longitude, *rest = line.split(",")
            if stamp[0].isdigit():
                north, east = generator.normal(0, 0.02 / 111e3, 2)
                latitude, longitude = f"{float(latitude) + north:.10f}", f"{float(longitude) + 1.5 * east:.10f}"
            noisy_lines.append(",".join([stamp, latitude, longitude, *rest]))
        return noisy_lines

    reports = reports_of(run_sample(tmp_path, lambda root: edit_track(root, "uav1", noisy)))
    flags = reports["uav1-uav1"]["flags"]
    assert reports["uav1-uav1"]["hypotheses"] == []
    assert "no single cause explains this" in flags["defocused"]


def trial(gain_db, kind, *, offset=False):
    return Hypothesis(f"it is {kind}", kind, (), gain_db=gain_db, is_offset=offset)


@pytest.mark.parametrize(
    ("trials", "drawn", "lost_db", "named"),
    [
        ([trial(6.0, "time"), trial(2.9, "height")], [2.0, 1.0], 7.0, "time"),
        ([trial(6.0, "time"), trial(5.9, "time"), trial(2.9, "height")], [2.0], 7.0, "time"),  # two values of one cause
        ([trial(6.0, "range"), trial(5.9, "prefix")], [2.0], 7.0, "range"),  # equivalent causes
        ([trial(4.0, "time"), trial(1.0, "height")], [1.0], 7.0, None),  # explains less than most of the loss
        ([trial(6.0, "time"), trial(3.1, "height")], [1.0], 7.0, None),  # another cause explains half as much
        ([trial(6.0, "time"), trial(1.0, "height")], [3.1], 7.0, None),  # random tracks explain half as much
        ([trial(0.4, "time")], [], 0.5, None),
        ([trial(60.0, "height"), trial(37.0, "carrier_is")], [3.0], 22.0, "height"),  # far above all others
        ([trial(2.4, "range", offset=True), trial(2.3, "lever arm", offset=True)], [1.0], 2.6, "offset"),
        ([trial(2.4, "range", offset=True), trial(2.3, "time")], [1.0], 2.6, None),
        ([], [], 5.0, None),
    ],
)
def test_hypothesis_is_reported_if_it_alone_explains_the_loss(trials, drawn, lost_db, named):
    explanations = explanation(trials, [trial(gain_db, "chance") for gain_db in drawn], lost_db)
    assert [one["kind"] for one in explanations] == ([named] if named else [])


@pytest.mark.parametrize(
    ("loss_db", "std_db", "gain_db", "is_regained"),
    [
        (-1.35, 0.3, 1.6, True),
        (-1.35, 0.3, 0.0, False),  # the cause is in another pair
        (-1.35, 0.6, 1.6, False),  # not significant
        (-3.0, 0.3, 1.6, False),  # most of the loss has another cause
        (-0.1, 0.01, 0.3, False),
    ],
)
def test_cause_is_reported_for_other_pairs_that_it_restores(loss_db, std_db, gain_db, is_regained):
    assert assess._regained({"loss_db": loss_db, "std_db": std_db}, gain_db) is is_regained
    assert assess._regained({}, gain_db) is False


@pytest.mark.slow
def test_phase_between_pairs_is_removed_if_configured(finished_sample, tmp_path):
    def with_quarter_cycle(align):
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

    excluded = with_quarter_cycle(align=False)
    assert excluded["fusion"]["excluded"].keys() == {"uav1-uav2"}
    assert "pairs_out_of_phase" in excluded["pairs"]["uav1-uav2"]["flags"]
    aligned = with_quarter_cycle(align=True)
    assert aligned["fusion"]["excluded"] == {}
    assert abs(aligned["fusion"]["phases_rad"]["uav1-uav2"]) == pytest.approx(2 * 3.1416 * 0.05 / 0.2142, abs=0.15)


def with_longer_path(root, added_m):
    """Recompute a campaign with a longer path of the second receiver and export its sums."""
    edit_config(root, lambda document: document["nodes"]["uav2"]["path_offset_m"].update(radar=0.911 + added_m))
    campaign = Campaign.load(root)
    for step in (echo.echo, profile.profile, image.image):
        step(campaign, "f01", "uav1-uav2")
    assess.assess(campaign, "f01")
    cube.cube(campaign)
    export.export_fused(campaign, "f01")
    return json.loads((campaign.results / "f01" / "fused" / "image.json").read_text())


@pytest.mark.slow
def test_sum_with_unobservable_phase_is_flagged(finished_tiny, tmp_path, monkeypatch):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    monkeypatch.setattr("apertura.stages.assess.agreement_of", lambda *_: None)
    report = with_longer_path(root, 0.214 / 4)
    assert [*report["fusion"]["phases_rad"]] == list(PAIRS)
    assert "is added with phase 0: no common features with" in report["flags"]["phase_unobservable"]
    assert "peak loss for a phase error of a quarter cycle: 3 dB" in report["flags"]["phase_unobservable"]
    assert report["coherence"]["mean"] == pytest.approx(0.5, abs=0.15)
    assert "sum_incoherent" in report["flags"]
    assert report["focus"]["verdict"] == "defocused"
    assert "from phase differences between pairs" in report["focus"]["reason"]


def test_sum_states_its_gain(finished_tiny):
    report = json.loads((finished_tiny.results / "f01" / "fused" / "image.json").read_text())
    assert report["focus"]["verdict"] == "focused"
    assert report["gain"]["allowed_db"] == pytest.approx(3.01)
    pairs = [json.loads((finished_tiny.results / "f01" / pair / "image.json").read_text()) for pair in PAIRS]
    for cut in ("cross_range_width_m", "ground_range_width_m"):
        assert report["brightest"][cut] < 1.05 * min(one["brightest"][cut] for one in pairs)
    assert report["brightest"]["cross_range_width_m"] < 0.75 * pairs[0]["brightest"]["cross_range_width_m"]


@pytest.fixture(scope="module")
def papers_flight(tmp_path_factory):
    root = tmp_path_factory.mktemp("uav") / "campaign"
    simulate(root, preset("paper-uav"), seed=1)
    return process(root)


@pytest.mark.parametrize(
    ("spacing_m", "reason"), [(0.1, ""), (0.11, "pixels of 0.11 m do not sample resolution cells of 0.0997 m")]
)
def test_pixels_much_wider_than_a_resolution_cell_are_not_compared(spacing_m, reason):
    """The resolution cell is 9.97 cm; pixels of up to 1.13 cells sample the band at the Nyquist rate."""
    images = {pair: SimpleNamespace(cell_m=0.0997) for pair in PAIRS}
    grid = SceneGrid("local", 0.0, 10.0, spacing_m, (100, 100))
    assert assess._too_coarse(images, grid).partition(":")[0] == reason


@pytest.mark.slow
def test_flight_of_the_paper_is_added_in_phase(papers_flight):
    """The resolution is 12 cm × 54 cm; the paper states 11 cm × 49 cm for unspecified segments."""
    report = json.loads((papers_flight.results / "f01" / "fused" / "image.json").read_text())
    assert report["flags"] == {}
    assert report["focus"]["verdict"] == "focused"
    assert report["fusion"]["agreeing"] == list(PAIRS)
    assert report["fusion"]["unmeasured"] == {}
    assert report["coherence"]["mean"] > 0.95
    brightest = report["brightest"]
    assert brightest["cross_range_width_m"] == pytest.approx(0.12, abs=0.005)
    assert brightest["ground_range_width_m"] == pytest.approx(0.54, abs=0.03)
    assert brightest["cross_range_pslr_db"] == pytest.approx(-4.5, abs=0.6)  # sidelobe of the gap between the segments
    (between,) = assessment_of(papers_flight, "f01")["between"]
    assert between["points"] == 3  # the fourth is 0.2 m from the edge
    assert abs(between["phase_rad"]) < 3 * between["phase_std_rad"] < 1


@pytest.mark.slow
@pytest.mark.parametrize(("wavelengths", "flag"), [(0.25, "phase"), (0.5, "phase"), (1.0, "position")])
def test_path_error_of_the_papers_flight_is_flagged(papers_flight, tmp_path, wavelengths, flag):
    root = copy_writable(papers_flight.root, tmp_path / "campaign")
    report = with_longer_path(root, wavelengths * 0.2134)
    line = report["flags"][{"phase": "pairs_out_of_phase", "position": "pairs_displaced"}[flag]]
    assert "do not show which pairs are wrong" in line
    assert len(report["fusion"]["excluded"]) == 1
    assert report["fusion"]["ties"] == [[*report["fusion"]["excluded"]]]
    assert "form an equally large set of pairs that agree" in report["flags"]["pair_excluded"]


@pytest.mark.parametrize("height_m", [-3.0, 0.5, 3.0])
def test_height_hypothesis_moves_its_point(monkeypatch, height_m):
    """Terrain that is 3 m lower displaces points by several metres, at a constant mean path."""
    track = np.stack([np.linspace(-5, 5, 64), np.full(64, -30.0), np.full(64, 25.0)], -1)
    pairs = [SimpleNamespace(history=SimpleNamespace(aperture=Aperture(track, track + [0.0, 4.0, 2.0])))]
    point_m = np.array([1.0, 2.0, 0.0])
    monkeypatch.setattr(hypotheses, "_on_level", lambda *_: point_m)
    scene = SimpleNamespace(axes=np.eye(3))
    east_m, north_m = hypotheses._displacement_by_height(scene, (1.0, 2.0), pairs, height_m)
    displaced_m = point_m + [east_m, north_m, height_m]
    before, after = (pairs[0].history.aperture.path(point[None]).mean() for point in (point_m, displaced_m))
    moved_m = np.hypot(east_m, north_m)
    assert moved_m > 0.6 * abs(height_m)
    assert abs(after - before) < (moved_m**2 + height_m**2) / 30  # second order: iso-range curve of an 80 m path


def test_missing_carrier_of_a_recording_is_accepted():
    """The field core:frequency is optional in SigMF."""
    waveform = SimpleNamespace(carrier_hz=1.3e9, sample_rate_hz=5e7)
    check_rates(waveform, {"carrier_hz": 0.0, "sample_rate_hz": 5e7}, where="uav1.sigmf-meta")
    with pytest.raises(CampaignError, match="recorded with carrier_hz 1200000000"):
        check_rates(waveform, {"carrier_hz": 1.2e9}, where="uav1.sigmf-meta")


@pytest.mark.slow
def test_hypotheses_of_a_flight_without_a_monostatic_pair_are_tested(tmp_path):
    """Before, the log of a transmitter that does not receive was not opened: an internal error."""

    def change(root):
        table = root / "config/flights.tsv"
        table.write_text(table.read_text().replace("uav1,uav2", "uav2"))
        edit_track(root, "uav1", delayed(0.5))

    campaign = run_sample(tmp_path, change)
    assert campaign.flight("f01").images == ("uav1-uav2",)
    target = json.loads((SHARED / "campaign-sample/truth.json").read_text())["targets"][0]
    found = hypotheses.hypotheses(campaign, "f01", brightest=(target["x"], target["y"]), cell_m=0.3)
    assert len(found) <= 1
