"""A flight plan: what it says of resolution, noise and loss against closed forms, and one message for each bad plan."""

import copy
from pathlib import Path

import numpy as np
import pytest

import apertura as ap
from apertura.common.constants import BOLTZMANN_J_K, SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.resolution import Resolution
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, Plane
from apertura.tools.design import designed
from apertura.tools.design.flight_plan import FlightPlan, read_flight_plan
from apertura.tools.design.planned_tracks import open_plan
from apertura.tools.design.requirements import helpful_changes, judge, refinement_line, search, tried_report

HERE = Path()
CARRIER, SPACING, COUNT = 1.3e9, 4e5, 512
RECEIVER = {"full_scale_counts": 8192, "full_scale_dbm": 0.0, "gain_db": 40.0, "noise_figure_db": 5.0}


def plan_of(**changes):
    """Return a small plan of one node on a line past level ground, in a local frame; keys of it replaced."""
    plan = {
        "campaign": "meadow",
        "waveform": {
            "kind": "ofdm",
            "subcarriers": COUNT,
            "subcarrier_spacing_hz": SPACING,
            "symbol_s": 2.5e-6,
            "cyclic_prefix_s": 1e-6,
            "carrier_hz": CARRIER,
            "carrier_is": "band_centre",
            "sample_rate_hz": 2.56e8,
            "prf_hz": 100.0,
        },
        "nodes": {
            "uav1": {
                "transmit_power_dbm": 20.0,
                "antennas": {"radar_tx_gain_dbi": 6.0, "radar_rx_gain_dbi": 3.0},
                "receiver": RECEIVER,
                "attitude": "log",
            }
        },
        "scene": {"crs": "local", "bounds_m": [-5.0, 25.0, 5.0, 35.0], "spacing_m": 0.5, "atmosphere": "vacuum"},
        "processing": {"window": "none", "integration": "all"},
        "flights": {
            "f01": {
                "transmitter": "uav1",
                "receivers": ["uav1"],
                "tracks": {"uav1": line()},
            }
        },
    }
    return plan | changes


def line(**changes):
    way = {"kind": "line", "start_m": [-20.0, 0.0], "end_m": [20.0, 0.0], "height_m": 30.0, "speed_m_s": 5.0}
    return way | changes


def flown(plan, **tracks):
    """Return a plan with other tracks in its flight."""
    changed = copy.deepcopy(plan)
    changed["flights"]["f01"]["tracks"] = tracks
    return changed


def with_second(shape="column", spacing_m=4.0, **flight):
    """Return a plan of two nodes in formation, the second receiving alone."""
    plan = plan_of()
    plan["nodes"]["uav2"] = {"antennas": {"radar_rx_gain_dbi": 3.0}, "receiver": RECEIVER, "attitude": "log"}
    formation = {"shape": shape, "leader": "uav1", "spacing_m": spacing_m}
    plan["flights"]["f01"] |= {"receivers": ["uav1", "uav2"], "formation": formation, **flight}
    return plan


def in_the_middle(found, name, image=0):
    return float(found[name].isel(image=image, y=found.sizes["y"] // 2, x=found.sizes["x"] // 2))


def test_a_line_resolves_half_a_wavelength_over_the_sine_of_its_angle():
    """λ/4 sin(Θ/2) across and c/2B sin θ along, of flat spectra: 0.886 of both."""
    found = ap.design(flown(plan_of(), uav1=line(start_m=[-5.0, 0.0], end_m=[5.0, 0.0])))
    x, y = (float(found[axis][found.sizes[axis] // 2]) for axis in "xy")
    ends = [np.array([end - x, y, 30.0]) for end in (-5, 5)]
    wavelength = SPEED_OF_LIGHT_M_S / CARRIER
    spread = 2 * sum(abs(one[0]) / np.linalg.norm(one) for one in ends) / wavelength
    across = 0.886 / spread
    bandwidth = SPACING * COUNT
    along = 0.886 * SPEED_OF_LIGHT_M_S / (2 * bandwidth) / (y / np.hypot(y, 30.0))
    assert in_the_middle(found, "resolution_fine") == pytest.approx(across, rel=0.03)
    assert in_the_middle(found, "resolution") == pytest.approx(along, rel=0.05)
    assert abs(in_the_middle(found, "orientation")) == pytest.approx(90, abs=3)


def test_a_circle_resolves_alike_in_every_direction():
    """|p|² = J₀²(4π r sin θ/λ): half of it at 1.126, a full width of 2.252."""
    circle = {"kind": "circle", "centre_m": [0.0, 30.0], "radius_m": 30.0, "height_m": 30.0, "speed_m_s": 3.0}
    scene = plan_of()["scene"] | {"bounds_m": [-0.5, 29.5, 0.5, 30.5]}
    found = ap.design(flown(plan_of(scene=scene), uav1=circle))
    width = 2.252 * SPEED_OF_LIGHT_M_S / CARRIER / (4 * np.pi * np.sin(np.pi / 4))
    for name in ("resolution", "resolution_fine"):
        assert in_the_middle(found, name) == pytest.approx(width, rel=0.015)


@pytest.mark.parametrize("rise", [-0.3, 0.3])
def test_ground_that_falls_away_from_the_radar_is_resolved_finer_on_the_map(rise):
    """The path grows by 2(sin θ - r cos θ) per metre of the map, r the rise: 0.886 c/B over that."""
    along = np.linspace(-2, 2, 401)
    track = np.stack([along, np.full(401, -30.0), np.full(401, 30.0)], -1)
    band = CARRIER + np.linspace(-1e8, 1e8, 64)
    grid, ground = SceneGrid("local", -2.0, 2.0, 1.0, (4, 4)), Plane(0.0, 0.0, 0.0, east=0.0, north=rise)
    aperture = Aperture(track, track)
    found = Resolution.of(grid, ground, aperture, None, frequency_hz=band, weight=np.ones(64) / 64)
    fine, coarse, azimuth = found.axes((slice(1, 2), slice(2, 3)))
    width = 0.886 * SPEED_OF_LIGHT_M_S / 2e8 / (2 * np.sqrt(0.5) * (1 - rise))
    widths = (fine, coarse) if abs(azimuth[0, 0]) < 45 else (coarse, fine)
    assert widths[0][0, 0] == pytest.approx(width, rel=0.04)


def test_noise_and_a_point_s_snr_are_those_of_the_radar_equation():
    """SNR of M pulses of duration T: P G² λ² σ T M / ((4π)³ R⁴ kT₀F), R all but the same along a short track."""
    found = ap.design(flown(plan_of(), uav1=line(start_m=[-1.0, 0.0], end_m=[1.0, 0.0])))
    pulses = in_the_middle(found, "looks")
    distance = np.sqrt(30.25**2 + 30**2)
    power, gains, wavelength = 0.1, 10 ** (9 / 10), SPEED_OF_LIGHT_M_S / CARRIER
    received = power * gains * wavelength**2 / ((4 * np.pi) ** 3 * distance**4)
    noise = BOLTZMANN_J_K * 290 * 10**0.5 / 2.5e-6
    snr_db = 10 * np.log10(received * pulses / noise)
    assert in_the_middle(found, "point_snr") == pytest.approx(snr_db, abs=0.1)
    assert in_the_middle(found, "snr") == pytest.approx(-15 - in_the_middle(found, "nesz"), abs=1e-4)


def test_the_sum_of_two_pairs_resolves_finer_and_its_noise_is_their_mean():
    found = ap.design(flown(with_second(spacing_m=8.0), uav1=line(start_m=[-3.0, 0.0], end_m=[3.0, 0.0])))
    assert list(found.image.values) == ["f01/uav1-uav1", "f01/uav1-uav2", "f01/sum"]
    assert in_the_middle(found, "resolution_fine", 2) < 0.9 * in_the_middle(found, "resolution_fine", 0)
    linear = [10 ** (in_the_middle(found, "nesz", image) / 10) for image in range(3)]
    assert linear[2] == pytest.approx((linear[0] + linear[1]) / 2, rel=1e-3)


def drawn_tracks(generator, pulses=32):
    """Straight tracks of two antennas, 20 to 60 m from the origin and 15 to 60 m high, in any direction."""
    for _ in range(2):
        azimuth, heading = generator.uniform(0, 2 * np.pi, 2)
        away, up, length = generator.uniform((20, 15, 8), (60, 60, 40))
        along = np.linspace(-length / 2, length / 2, pulses)[:, None]
        middle = np.array([away * np.cos(azimuth), away * np.sin(azimuth), up])
        yield middle + along * np.array([np.cos(heading), np.sin(heading), 0.0])


@pytest.mark.slow
def test_the_width_of_a_sum_is_that_of_its_response_in_random_geometries():
    """The series of eq. 1 is of one lobe; where spectra of pairs stand apart its widths are off by up to 15 %."""
    generator, count = np.random.default_rng(3), 16
    band = CARRIER + 12.8e6 * (np.arange(count) - (count - 1) / 2)
    weight = np.hanning(count + 2)[1:-1] / np.hanning(count + 2).sum()
    grid, ground, errors = SceneGrid("local", -0.5, 0.5, 1.0, (1, 1)), FlatGround(0.0), []
    for _ in range(60):
        first, second = drawn_tracks(generator)
        pairs = [Aperture(first, first), Aperture(first, second)]
        of_pairs = [Resolution.of(grid, ground, one, None, frequency_hz=band, weight=weight) for one in pairs]
        *widths, azimuth = Resolution.summed(of_pairs).axes((slice(0, 1), slice(0, 1)))
        for width, turned in zip(widths, (0, 90), strict=True):
            angle = np.radians(float(azimuth[0, 0]) + turned)
            away_m = np.linspace(0, 1.5 * float(width[0, 0]), 400)
            response = 0
            for pair in pairs:
                further = pair.path_gradient(np.zeros((1, 3)))[:, 0] @ [np.sin(angle), np.cos(angle), 0.0]
                turns = np.multiply.outer(np.multiply.outer(away_m, further), band) / SPEED_OF_LIGHT_M_S
                response = response + (weight * np.exp(2j * np.pi * turns)).sum(axis=-1).mean(axis=-1)
            half = int(np.argmax(np.abs(response / 2) ** 2 < 0.5))
            errors.append(float(width[0, 0]) / (2 * away_m[half]) - 1)
    assert abs(np.median(errors)) < 0.01
    assert np.quantile(np.abs(errors), 0.9) < 0.05
    assert np.max(np.abs(errors)) < 0.15


def test_coherence_of_two_heights_is_the_common_share_of_windowed_spectra():
    """Spectra of flat windows shift by δ of their width and share 1 - δ; under Hann 1 - (2π²/3) δ² for a small δ."""
    shares, low = [], line(start_m=[-2.0, 0.0], end_m=[2.0, 0.0])
    for window in ("none", "hann"):
        plan = plan_of(processing={"window": window, "integration": "all"}, expect={"sigma0_db": None})
        plan["flights"] = {
            name: {"transmitter": "uav1", "receivers": ["uav1"], "tracks": {"uav1": low | {"height_m": height}}}
            for name, height in (("f01", 30.0), ("f02", 31.0))
        }
        found = ap.design(plan | {"interferometry": {"pairs": {"two": ["f01/uav1-uav1", "f02/uav1-uav1"]}}})
        shares.append(float(found.coherence[0, 10, 10]))
    sines = [29.75 / np.hypot(29.75, height) for height in (30.0, 31.0)]
    shift = (sines[0] - sines[1]) * CARRIER / (SPACING * COUNT) / np.mean(sines)
    assert shares[0] == pytest.approx(1 - shift, abs=0.02)
    assert shares[1] == pytest.approx(1 - 2 * np.pi**2 / 3 * shift**2, abs=0.02)


def test_positions_known_worse_cost_more_and_the_cause_is_named():
    plan = plan_of(require={"loss_db": 0.5})
    plan["nodes"]["uav1"]["position_std_m"] = 0.02
    plan["processing"]["autofocus"] = "off"
    (verdict,) = judge(designed(FlightPlan.model_validate(plan), HERE))
    assert not verdict.met
    assert verdict.cause.startswith("positions: 2 2 2 cm")


def design_of(std_m, autofocus, **node):
    plan = plan_of(require={"loss_db": 1.0})
    plan["nodes"]["uav1"] |= {"position_std_m": std_m, **node}
    plan["processing"]["autofocus"] = autofocus
    return designed(FlightPlan.model_validate(plan), HERE)


@pytest.mark.parametrize(("autofocus", "met"), [("auto", True), ("on", True), ("off", False)])
def test_loss_is_judged_with_refinement_where_the_plan_requests_it_and_both_losses_are_stated(autofocus, met):
    """At L-band 2 cm cost 2 to 5 dB as logged, 0.3 dB after refinement (docs/theory/autofocus.md, "Measured")."""
    design = design_of(0.02, autofocus)
    (verdict,) = judge(design)
    assert verdict.met == met
    layers = design.images["f01/uav1-uav1"].layers
    assert 2 < np.median(layers["loss"]) < 6
    assert np.median(layers["loss_refined"]) == pytest.approx(0.3, abs=0.1)
    assert verdict.found == pytest.approx(np.max(layers["loss_refined" if met else "loss"]), abs=0.05)


def test_a_refinement_needs_points_whose_cross_section_follows_from_the_radar_equation():
    design = design_of(0.02, "on")
    layers = design.images["f01/uav1-uav1"].layers
    pulse_db = np.percentile(layers["point_snr"] - 10 * np.log10(layers["looks"]), 5)
    assert refinement_line(design, "f01").endswith(f"3 bright points in the scene, 10 dB above the noise of one pulse: "
                                                   f"at least {10 - pulse_db:.0f} dBsm")  # fmt: skip


@pytest.mark.parametrize(
    ("std_m", "node", "obstacle"),
    [
        (0.06, {}, "position errors of 6 cm exceed 4.4 cm"),
        (0.02, {"position_correlation_s": 0.2}, "the correlation time of position errors, 0.2 s, is below 0.5 s"),
    ],
)
def test_a_refinement_beyond_its_measured_limits_does_not_count(std_m, node, obstacle):
    design = design_of(std_m, "on", **node)
    (verdict,) = judge(design)
    assert not verdict.met
    assert obstacle in refinement_line(design, "f01")
    assert np.isnan(design.images["f01/uav1-uav1"].layers["loss_refined"]).all()


def test_a_coarse_grid_is_refused_for_sparse_pulses_as_the_grid_itself():
    """Corners of 2 × 2 pixels spread the Doppler half as far as those of 20 × 20: what a search keeps can be flown."""
    plan = plan_of()
    plan["waveform"]["prf_hz"] = 8.0
    for coarse in (None, 2):
        with pytest.raises(CampaignError, match="Hz, the Doppler spread over the scene, instead of 8 Hz"):
            designed(FlightPlan.model_validate(plan), HERE, coarse=coarse)


@pytest.mark.slow
def test_echoes_that_fold_are_told_for_what_is_required_and_more_pulses_help(tmp_path):
    """At 5 m/s the Doppler over 60 m of scene spreads more than 50 Hz and less than 100."""
    plan = plan_of(require={"ambiguity": 0.02})
    plan["waveform"]["prf_hz"] = 50.0
    plan["scene"] |= {"bounds_m": [-30.0, 20.0, 30.0, 80.0], "spacing_m": 1.0}
    (verdict,) = judge(designed(FlightPlan.model_validate(plan), tmp_path))
    assert not verdict.met
    assert "Doppler spread of" in verdict.cause
    assert "double the pulse rate (waveform.prf_hz)" in {one.words for one in changes_of(plan, tmp_path) if one.meets}


def changes_of(plan, root):
    plan = FlightPlan.model_validate(plan)
    return helpful_changes(plan, root, judge(designed(plan, root)))


@pytest.mark.slow
def test_what_is_missed_by_a_hair_on_the_fine_grid_alone_gets_its_change_too(tmp_path):
    """A coarser grid tells 0.1 to 1 % less of the far side: what it says of the plan as it is, is taken off."""
    plan = plan_of(scene=plan_of()["scene"] | {"spacing_m": 0.05})
    (verdict,) = judge(designed(FlightPlan.model_validate(plan | {"require": {"nesz_db": 0.0}}), tmp_path))
    missed = plan | {"require": {"nesz_db": verdict.found - 0.002}}
    changes = changes_of(missed, tmp_path)
    assert any(change.meets for change in changes)
    assert all(change.gain_db == pytest.approx(0.002, abs=1e-4) for change in changes if change.meets)


@pytest.mark.slow
def test_the_changes_that_help_most_come_first(tmp_path):
    changes = changes_of(plan_of(require={"nesz_db": -60.0}), tmp_path)
    assert changes[0].gain_db >= changes[-1].gain_db > 0
    gains = {change.words: change.gain_db for change in changes}
    assert gains["increase the transmit power by 3 dB (transmit_power_dbm)"] == pytest.approx(3, abs=0.01)
    assert gains["double the pulse rate (waveform.prf_hz)"] == pytest.approx(3.01, abs=0.05)


@pytest.mark.slow
def test_changes_that_break_what_is_met_come_last_and_say_so(tmp_path):
    required = {"point_snr_db": 60.0, "flight_s": 15.9}
    changes = changes_of(plan_of(require=required), tmp_path)
    broken = {change.words: change.breaks for change in changes}
    assert broken["fly at 0.5 times the speed (speed_m_s)"] == ("flight_s",)
    assert broken["increase the transmit power by 3 dB (transmit_power_dbm)"] == ()
    assert [*map(bool, broken.values())] == sorted(map(bool, broken.values()))


def test_a_search_finds_the_same_again_and_what_it_finds_is_better(tmp_path):
    plan = FlightPlan.model_validate(plan_of(require={"resolution_m": 0.8}, bounds={"height_m": [-20, 20]}))
    found, tried = search(plan, tmp_path, ["height"], most=5)
    again, _ = search(plan, tmp_path, ["height"], most=5)
    assert found == again
    assert found.moved.height_m < 0  # a flatter look resolves the ground better
    assert min(tried, key=lambda one: one.objective).on_front
    first = tried_report(tried)[0]
    assert first["moved"] == {"height_m": found.moved.height_m}
    assert first["found"]["resolution_m"] < 0.8


def test_recordings_are_as_large_as_their_captures():
    recording = ap.design(with_second()).attrs["recording"]
    capture = round(3.5e-6 * 2.56e8) * 4
    assert recording["node_bytes_s"]["f01"] == {"uav1": 100 * capture, "uav2": 200 * capture}
    assert recording["recorded_bytes"] == recording["pulses"]["f01"] * 3 * capture


def test_a_radar_of_sweeps_is_told_but_for_its_noise():
    sweep = {"kind": "fmcw", "format": "beat_npy", "start_hz": 5.7e9, "bandwidth_hz": 2e8, "sweep_s": 1e-3}
    plan = plan_of(waveform=sweep | {"sample_rate_hz": 4e5, "prf_hz": 200.0}, nodes={"uav1": {"attitude": "log"}})
    found = ap.design(flown(plan, uav1=line(start_m=[-2.0, 0.0], end_m=[2.0, 0.0])))
    across = 0.886 * SPEED_OF_LIGHT_M_S / (2 * 2e8) / np.sin(np.pi / 4)
    assert in_the_middle(found, "resolution") == pytest.approx(across, rel=0.02)
    assert np.isnan(found.nesz).all()
    assert found.attrs["recording"]["node_bytes_s"]["f01"]["uav1"] == 200 * 400 * 2


def test_turns_between_legs_are_flown_and_not_imaged():
    racetrack = line(kind="racetrack", legs=3, spacing_m=5.0)
    opened = open_plan(FlightPlan.model_validate(flown(plan_of(), uav1=racetrack)), HERE)
    course = opened.courses["f01"]["uav1"]
    assert len(course.imaged_s) == 3
    assert len(opened.pairs[0].time_s) == 3 * 801
    assert course.length_s > 3 * 8.0 + 2.0
    legs = np.unique(opened.pairs[0].aperture.tx_m[:, 1].round(2))
    assert legs.tolist() == [-10.0, -5.0, 0.0]


def test_tracks_are_moved_about_the_middle_of_the_scene():
    moved = {"height_m": 5.0, "offset_m": 10.0, "heading_deg": 90.0}
    opened = open_plan(FlightPlan.model_validate(plan_of(moved=moved)), HERE)
    place = opened.pairs[0].aperture.tx_m
    # Pushed 10 m south to 40 m from the middle (0, 30), then turned clockwise: west of it, flying north to south.
    assert place[:, 0] == pytest.approx(-40.0)
    assert place[[0, -1], 1] == pytest.approx([50.0, 10.0])
    assert place[:, 2] == pytest.approx(35.0)


BAD = {
    "through the ground": (flown(plan_of(), uav1=line(height_m=-2.0)), "at or below the terrain"),
    "too few pulses": (
        plan_of(
            waveform=plan_of()["waveform"] | {"prf_hz": 8.0},
            scene=plan_of()["scene"] | {"bounds_m": [-25.0, 5.0, 25.0, 55.0]},
        ),
        "the Doppler spread over the scene, instead of 8 Hz",
    ),
    "colliding formation": (with_second(spacing_m=1.0), "separation of uav1 and uav2 falls to 1.00 m at"),
    "nobody flies": (with_second(formation=None), "uav2 has no track, and there is no formation"),
    "a hover": (flown(plan_of(), uav1=line(end_m=[-20.0, 0.0])), "a hover gives no image"),
    "unknown key": (plan_of(requires={"nesz_db": -20}), "requires: unknown key (did you mean 'require'?)"),
    "beyond the prefix": (
        plan_of(waveform=plan_of()["waveform"] | {"cyclic_prefix_s": 1e-7}),
        "no pulse receives an echo of the scene",
    ),
    "tracks elsewhere": (
        flown(plan_of(), uav1=line(start_m=[4840.0, 990.0], end_m=[4880.0, 990.0])),
        "km from the tracks",
    ),
    "a racetrack of one place": (
        flown(plan_of(), uav1=line(kind="racetrack", end_m=[-20.0, 0.0])),
        "a hover gives no image",
    ),
    "GHz": (plan_of(waveform=plan_of()["waveform"] | {"carrier_hz": 1.3, "carrier_is": "band_start"}), "in Hz"),
    "a receiver twice": (with_second(receivers=["uav1", "uav1", "uav2"]), "contain a duplicate"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_plan_is_refused_by_one_message(case):
    plan, words = BAD[case]
    with pytest.raises(CampaignError) as caught:
        ap.design(plan)
    assert words in str(caught.value)
    assert "config.yaml" not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["dike.plan", "dike.kml"])
def test_a_mission_in_place_of_a_plan_is_one_message_that_says_where_it_belongs(tmp_path, name):
    (tmp_path / name).write_text('{"mission": {}}')
    with pytest.raises(CampaignError, match=rf"{name}: a mission, not a flight plan.*kind: mission, file: {name}"):
        read_flight_plan(tmp_path / name)


def test_an_unknown_key_called_as_an_alternative_of_another_is_named(tmp_path):
    """`mission` is also a kind of track."""
    (tmp_path / "plan.yaml").write_text("mission: dike.plan\n")
    with pytest.raises(CampaignError, match="mission: unknown key"):
        read_flight_plan(tmp_path / "plan.yaml")
