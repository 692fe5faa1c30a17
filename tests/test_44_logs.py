"""Logs and time tags in the echo stage: excluded pulses are counted and flagged, correct logs raise no flag."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from folders import complaint, edit_config, edit_data, edit_track, small_simulation

from apertura.campaign.config import Node
from apertura.campaign.folder import Campaign
from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import ecef_from_geodetic
from apertura.formats.tracks.track import damaged, make_track
from apertura.simulation import Impairments, PointTarget, Straight, simulate
from apertura.simulation.impairments import TimeTag
from apertura.simulation.targets import Wobble
from apertura.stages import echo, ingest
from apertura.stages.node_log import NodeLog, raw_log
from apertura.stages.pair import open_pair
from apertura.stages.planning import budget_of
from apertura.stages.positions import place
from apertura.stages.scene import expected_scene
from apertura.stages.transfer import PairEcho


def small_campaign(folder, *, pulses=40, prf_hz=20.0, **changes):
    """Return a campaign of two nodes at 5 m/s with RTKLIB logs in UTC at 10 Hz."""
    plan = small_simulation(pulses=pulses)
    nodes = {name: replace(node, log_format="pos_utc", lever_arms_m={}) for name, node in plan.nodes.items()}
    plan = replace(plan, nodes=nodes, waveform=replace(plan.waveform, prf_hz=prf_hz), **changes)
    return Campaign.load(simulate(folder / "campaign", plan, seed=3))


def with_yaw_offset(row, degrees):
    """Return an epoch of a CSV log with an offset of yaw, its last column."""
    *others, yaw = row.split(",")
    return ",".join([*others, f"{float(yaw) + degrees:.4f}"])


def echo_of(campaign, pair="a-b"):
    for node in ("a", "b"):
        ingest.ingest(campaign, "f01", node)
    echo.echo(Campaign.load(campaign.root), "f01", pair)
    return PairEcho.opened(campaign, "f01", pair).stage


def flags_of(dataset):
    """Return the flags except those of saturated converters, which occur in the small campaign."""
    return {name: line for name, line in dataset.attrs["flags"].items() if not name.startswith("saturated")}


def epochs(change):
    """Return a function that edits the epochs of a log and keeps its header."""

    def edit(lines):
        header = [line for line in lines if line.startswith("%")]
        return header + change([line.split() for line in lines if not line.startswith("%")])

    return edit


def rows(table):
    return ["   ".join(cells) for cells in table]


def test_good_log_excludes_no_pulses_and_states_its_accuracy(tmp_path):
    campaign = small_campaign(tmp_path)
    for pair in ("a-a", "a-b"):
        dataset = echo_of(campaign, pair)
        attrs = dataset.attrs
        assert flags_of(dataset) == {}
        assert attrs["pulses"] == {"used": 40, "dropped": 0, "reasons": {}}
        for leg, node in zip(("tx", "rx"), pair.split("-"), strict=True):
            stated = attrs["positions"][leg]
            assert stated["std_m"] == pytest.approx([0.005, 0.005, 0.01])
            assert (stated["node"], stated["stated_by"], stated["correlation_s"]) == (node, "log", 1.0)
            assert stated["interpolation_m"] < 1e-4
    assert attrs["time_tags"]["std_s"] == 0.003
    assert attrs["time_tags"]["jitter_s"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.quick("0.02-expected1")
@pytest.mark.parametrize(
    ("configured", "expected"),
    [(None, (None, "none")), (0.02, ([0.02] * 3, "config")), ([0.01, 0.02, 0.03], ([0.01, 0.02, 0.03], "config"))],
)
def test_config_states_the_accuracy_if_the_log_does_not(tmp_path, configured, expected):
    campaign = small_campaign(tmp_path)
    edit_track(campaign.root, "a", lambda lines: [line.replace("sdn(m)", "sd(m)") for line in lines])
    edit_config(campaign.root, lambda document: document["nodes"]["a"].update(position_std_m=configured))
    stated = echo_of(campaign, "a-b").attrs["positions"]
    assert (stated["tx"]["std_m"], stated["tx"]["stated_by"]) == expected
    assert stated["rx"]["stated_by"] == "log"


@pytest.mark.slow
def test_pulses_with_float_solution_are_excluded_unless_allowed(tmp_path):
    campaign = small_campaign(tmp_path)

    def with_float_solution(table):
        for cells in table[25:30]:  # the log begins 2 s early
            cells[5] = "2"
        return rows(table)

    edit_track(campaign.root, "b", epochs(with_float_solution))
    dataset = echo_of(campaign)
    excluded = dataset.attrs["pulses"]["reasons"]["fix_quality_low"]
    assert 10 <= excluded <= 12  # 0.6 s of 20 Hz
    assert dataset.sizes["pulse"] == dataset.attrs["pulses"]["used"] == 40 - excluded
    assert dataset.attrs["flags"]["fix_quality_low"].startswith(
        f"b: {excluded} of 40 pulses excluded: position solution poorer than"
    )
    assert flags_of(echo_of(campaign, "a-a")) == {}
    edit_config(campaign.root, lambda document: document["nodes"]["b"].update(worst_fix="float"))
    assert echo_of(campaign).attrs["pulses"]["used"] == 40


@pytest.mark.slow
def test_log_with_float_solutions_only_is_refused(tmp_path):
    campaign = small_campaign(tmp_path)
    for quality, refused in (("2", True), ("5", False)):
        edit_track(
            campaign.root,
            "a",
            epochs(lambda table, quality=quality: rows([*cells[:5], quality, *cells[6:]] for cells in table)),
        )
        if refused:
            message = complaint(lambda: echo_of(campaign))
            assert "no pulse has a valid position: a: 40 of 40 pulses excluded" in message
            assert "worst_fix" in message
        else:
            assert flags_of(echo_of(campaign)) == {}
    edit_config(campaign.root, lambda document: document["nodes"]["a"].update(worst_fix="fix"))
    assert "poorer than fix" in complaint(lambda: echo_of(campaign))


@pytest.mark.slow
def test_pulses_in_a_log_gap_are_excluded(tmp_path):
    plan = small_simulation().flights[0]
    swaying = replace(plan.tracks["a"], wobble=Wobble((0.3, 0.3, 0.3), smoothing_s=0.3))
    campaign = small_campaign(tmp_path, flights=(replace(plan, pulses=40, tracks={**plan.tracks, "a": swaying}),))
    assert flags_of(echo_of(campaign)) == {}
    edit_track(campaign.root, "a", epochs(lambda table: rows(table[:25] + table[39:])))
    attrs = echo_of(campaign).attrs
    assert "longest 1.50 s at 09:30:0" in attrs["flags"]["track_gap"]
    assert attrs["pulses"]["reasons"]["track_gap"] in (28, 29, 30)
    assert attrs["pulses"]["used"] == 40 - attrs["pulses"]["reasons"]["track_gap"]


@pytest.mark.slow
def test_single_outlier_is_corrected_and_counted(tmp_path):
    campaign = small_campaign(tmp_path)
    clean = echo_of(campaign).tx_position.values

    def spiked(table):
        table[28][4] = f"{float(table[28][4]) + 0.5:.5f}"
        return rows(table)

    edit_track(campaign.root, "a", epochs(spiked))
    dataset = echo_of(campaign)
    assert "1 fault, the worst 0.500 m at 09:30:0" in dataset.attrs["flags"]["track_outlier"]
    assert dataset.attrs["pulses"]["used"] == 40
    np.testing.assert_allclose(dataset.tx_position.values, clean, atol=1e-4)


@pytest.mark.slow
def test_repeated_positions_of_a_log_are_skipped(tmp_path):
    campaign = small_campaign(tmp_path)
    clean = echo_of(campaign).rx_position.values

    def repeated(table):
        return rows([*table[n][:2], *table[n - n % 2][2:]] for n in range(len(table)))

    edit_track(campaign.root, "b", epochs(repeated))
    dataset = echo_of(campaign)
    assert dataset.attrs["flags"]["track_frozen"].startswith("b: 0 of 40 pulses excluded: epochs that repeat")
    np.testing.assert_allclose(dataset.rx_position.values, clean, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("grain_s", "flagged"), [(0.1, False), (0.2, True)])
def test_log_with_rounded_times_is_flagged_with_the_position_error(tmp_path, grain_s, flagged):
    """Times rounded to 0.2 s at 5 m/s cause a position error of 5 m/s · 0.2 s/√12 = 0.29 m."""
    campaign = small_campaign(tmp_path)

    def rounded(table):
        for cells in table:
            hours, minutes, seconds = cells[1].split(":")
            total_s = 3600 * int(hours) + 60 * int(minutes) + round(float(seconds) / grain_s) * grain_s
            cells[1] = f"{int(total_s // 3600):02d}:{int(total_s % 3600 // 60):02d}:{total_s % 60:06.3f}"
        return rows(table)

    edit_track(campaign.root, "a", epochs(lambda table: rounded(table[::3])))
    flags = flags_of(echo_of(campaign))
    assert ("track_times" in flags) is flagged
    assert not flagged or "position errors of 0.29 m along the track" in flags["track_times"]


def logged_flags(position, *, damage=""):
    """Return the flags of a 10 Hz log for pulses at 1.2 GHz between its epochs."""
    times = np.datetime64("2025-05-14T09:30", "ns") + np.arange(len(position)) * np.timedelta64(100, "ms")
    where = Path("a.track.ulg")
    track = damaged(make_track(times, position, frame="local", node="a", where=where), damage, where)
    log = NodeLog("a", Node(), track, str(where), C / 1.2e9)
    return place(log, log, times[20:-20] + np.timedelta64(50, "ms")).flags


def test_log_with_rounded_positions_is_flagged_with_their_error():
    time_s = np.arange(400) * 0.1
    position_m = np.stack([5 * time_s, 3 * np.sin(time_s), 5 + np.sin(0.7 * time_s)], -1)
    assert logged_flags(position_m) == {}
    flags = logged_flags(np.round(position_m / [0.2, 0.1, 0.01]) * [0.2, 0.1, 0.01])
    assert "a: rounded coordinates of the log cause position errors of 0.065 m" in flags["track_positions"]


def test_damaged_log_is_flagged():
    time_s = np.arange(400) * 0.1
    position_m = np.stack([5 * time_s, 3 * np.sin(time_s), 5 + np.sin(0.7 * time_s)], -1)
    damage = "259 of 6873 bytes are not valid messages, from byte 2602 on; epochs in these bytes are lost"
    assert logged_flags(position_m, damage=damage) == {"track_log_damaged": f"a: {damage}"}


@pytest.mark.slow
@pytest.mark.parametrize("offset_s", [0.0, 1e-3, -4e-3])
def test_tag_offset_between_nodes_does_not_change_the_bistatic_phase(tmp_path, offset_s):
    """Positions of both nodes are those at the transmitter's tag, so that the target has the same phase in both pairs.

    At 12 m/s and 9.5 GHz, a receiver tag that is 1 ms late would cause an error of R_sl of 1.2 cm (-2.27 rad).
    """
    speed = (12.0, 0.0, 0.0)
    tracks = {"a": Straight((-2.0, -11.0, 5.0), speed), "b": Straight((2.7, -11.0, 5.0), speed)}
    plan = small_simulation(pulses=24, secondary=Impairments(time_tag=TimeTag(offset_s=offset_s)))
    nodes = {name: replace(node, lever_arms_m={}, attitude="none") for name, node in plan.nodes.items()}
    plan = replace(
        plan,
        nodes=nodes,
        targets=(PointTarget((0.0, 0.0, 0.0)),),
        waveform=replace(plan.waveform, carrier_hz=9.5e9, prf_hz=100.0),
        flights=(replace(plan.flights[0], tracks=tracks),),
    )
    campaign = Campaign.load(simulate(tmp_path / "campaign", plan, seed=3))
    target = ecef_from_geodetic(np.array(48.0), np.array(9.0), np.array(500.0))
    phases = []
    for pair in ("a-a", "a-b"):
        data = echo_of(campaign, pair)
        path_m = Aperture(data.tx_position.values, data.rx_position.values).path(target)
        cycles = np.outer(path_m, data.frequency.values) / C
        phases.append(np.angle((data.transfer.values * np.exp(2j * np.pi * cycles)).sum()))
    assert data.attrs["time_tags"]["offset_s"] == pytest.approx(offset_s, abs=1e-5)
    assert abs(np.angle(np.exp(1j * (phases[1] - phases[0])))) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("node", ["a", "b"])
def test_repeated_captures_are_excluded(tmp_path, node):
    """Eight captures repeat the samples of the preceding eight, from other positions, and would form a ghost."""
    campaign = small_campaign(tmp_path)

    def repeat(samples):
        captures = samples.reshape(40, -1)
        captures[20:28] = captures[12:20]

    edit_data(Path(str(campaign.root)), node, repeat)
    attrs = echo_of(campaign, f"a-{node}").attrs
    assert attrs["pulses"] == {"used": 32, "dropped": 8, "reasons": {"captures_repeated": 8}}
    assert attrs["flags"]["captures_repeated"] == f"8 of 40 captures of {node}, first at capture 20"


@pytest.mark.slow
def test_single_wrong_tag_is_excluded(tmp_path):
    campaign = small_campaign(tmp_path)
    from folders import edit_meta

    def late(meta):
        capture = meta["captures"][20]
        tag = np.datetime64(capture["core:datetime"].rstrip("Z"), "us") + np.timedelta64(12, "ms")
        capture["core:datetime"] = f"{tag}Z"

    edit_meta(campaign.root, "b", late)
    attrs = echo_of(campaign).attrs
    assert attrs["pulses"] == {"used": 39, "dropped": 1, "reasons": {"time_tag_outlier": 1}}
    assert attrs["flags"]["time_tag_outlier"].startswith("1 of 40 pulses excluded")


@pytest.mark.parametrize(("arm_m", "flagged"), [(0.3, True), (0.0, False)])
def test_attitude_in_radians_is_flagged_with_a_lever_arm(arm_m, flagged):
    """The track is 40 m to the east, with a logged yaw of π/2."""
    time = np.datetime64("2026-05-14T09:30", "ns") + np.arange(80) * np.timedelta64(100, "ms")
    position_m = np.column_stack([0.5 * np.arange(80), np.zeros(80), np.full(80, 20.0)])
    angles = np.column_stack([0.02 * np.sin(np.arange(80)), np.full(80, -0.07), np.full(80, np.pi / 2)])
    track = make_track(time, position_m, frame="local", attitude_deg=angles, node="a", where=Path("a.csv"))
    arms = {"radar_tx": [arm_m, 0, 0]}
    log = NodeLog("a", Node(attitude="log", lever_arms_m=arms), track, "a.csv", 0.2)
    flags = place(log, log, time[5:-5]).flags
    assert ("attitude_suspect" in flags) is flagged
    if flagged:
        found = "a: attitude angles appear to be in radians: with this convention, yaw deviates from the course by 0°"
        assert f"{found}; as degrees clockwise from north, it deviates by 88°" in flags["attitude_suspect"]


@pytest.mark.parametrize("pair", ["uav1-uav1", "uav1-uav2"])
def test_budget_predicts_the_phase_error_of_a_yaw_offset(tiny, pair):
    """A yaw offset of 3° in the log of uav1 displaces its antennas; the paths change as predicted by the budget."""

    def nodes(document):
        document["nodes"]["uav1"].update(attitude_std_deg=[1e-6, 3.0], attitude_correlation_s=1e9, lever_arm_std_m=1e-6)

    def paths():
        """Return total paths to the scene centre, minus the sidelink length of a bistatic pair."""
        opened = open_pair(Campaign.load(tiny), "f01", pair)
        tx, rx = (raw_log(campaign, "f01", name, 0.2) for name in pair.split("-"))
        at = opened.began + (1e9 * opened.time_s).round().astype("timedelta64[ns]")
        sidelink_m = np.linalg.norm(tx.antenna("sidelink", at) - rx.antenna("sidelink", at), axis=1)
        return opened.aperture.path(scene.middle_m[None])[:, 0] - sidelink_m * (not opened.monostatic)

    edit_config(tiny, nodes)
    campaign = Campaign.load(tiny)
    scene = expected_scene(campaign, lambda: open_pair(campaign, "f01", pair).position_m)
    before, opened = paths(), open_pair(campaign, "f01", pair)
    lines = {(line.cause, line.stated is None): line for line in budget_of(campaign, opened, scene)}
    edit_track(tiny, "uav1", lambda rows: [rows[0], *(with_yaw_offset(row, 3.0) for row in rows[1:])])
    wavenumber = 2 * np.pi * opened.frequency_hz.mean() / opened.wave_speed_m_s
    phase_rad = wavenumber * abs((paths() - before).mean())
    assert phase_rad > 0.02
    assert lines["attitude", False].effect.phase_rad == pytest.approx(phase_rad, rel=0.1)
