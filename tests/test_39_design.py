"""Flight plan design: resolution, noise and loss against closed forms, and refusal of invalid plans."""

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
    """Return a small plan of one node on a line past level terrain, in a local frame, with keys replaced."""
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
    track = {"kind": "line", "start_m": [-20.0, 0.0], "end_m": [20.0, 0.0], "height_m": 30.0, "speed_m_s": 5.0}
    return track | changes


def with_tracks(plan, **tracks):
    """Return a plan with the tracks of its flight replaced."""
    changed = copy.deepcopy(plan)
    changed["flights"]["f01"]["tracks"] = tracks
    return changed


def with_second(shape="column", spacing_m=4.0, **flight):
    """Return a plan of two nodes in formation, of which the second only receives."""
    plan = plan_of()
    plan["nodes"]["uav2"] = {"antennas": {"radar_rx_gain_dbi": 3.0}, "receiver": RECEIVER, "attitude": "log"}
    formation = {"shape": shape, "leader": "uav1", "spacing_m": spacing_m}
    plan["flights"]["f01"] |= {"receivers": ["uav1", "uav2"], "formation": formation, **flight}
    return plan


def at_centre(design, name, image=0):
    return float(design[name].isel(image=image, y=design.sizes["y"] // 2, x=design.sizes["x"] // 2))


def test_resolution_of_a_line_follows_from_wavelength_and_angle():
    """For flat spectra, the widths are 0.886 λ/(4 sin(Θ/2)) across and 0.886 c/(2B sin θ) along range."""
    design = ap.design(with_tracks(plan_of(), uav1=line(start_m=[-5.0, 0.0], end_m=[5.0, 0.0])))
    x, y = (float(design[axis][design.sizes[axis] // 2]) for axis in "xy")
    ends = [np.array([end - x, y, 30.0]) for end in (-5, 5)]
    wavelength = SPEED_OF_LIGHT_M_S / CARRIER
    spread = 2 * sum(abs(end[0]) / np.linalg.norm(end) for end in ends) / wavelength
    across = 0.886 / spread
    bandwidth = SPACING * COUNT
    along = 0.886 * SPEED_OF_LIGHT_M_S / (2 * bandwidth) / (y / np.hypot(y, 30.0))
    assert at_centre(design, "resolution_fine") == pytest.approx(across, rel=0.03)
    assert at_centre(design, "resolution") == pytest.approx(along, rel=0.05)
    assert abs(at_centre(design, "orientation")) == pytest.approx(90, abs=3)


def test_resolution_of_a_circle_is_equal_in_all_directions():
    """|p|² = J₀²(4π r sin θ/λ) is 1/2 at an argument of 1.126, so that the full width is 2.252."""
    circle = {"kind": "circle", "centre_m": [0.0, 30.0], "radius_m": 30.0, "height_m": 30.0, "speed_m_s": 3.0}
    scene = plan_of()["scene"] | {"bounds_m": [-0.5, 29.5, 0.5, 30.5]}
    design = ap.design(with_tracks(plan_of(scene=scene), uav1=circle))
    width = 2.252 * SPEED_OF_LIGHT_M_S / CARRIER / (4 * np.pi * np.sin(np.pi / 4))
    for name in ("resolution", "resolution_fine"):
        assert at_centre(design, name) == pytest.approx(width, rel=0.015)


@pytest.mark.parametrize("rise", [-0.3, 0.3])
def test_ground_range_resolution_depends_on_the_terrain_slope(rise):
    """With the rise r, the path grows by g = 2(sin θ - r cos θ) per metre of the map; the width is 0.886 c/(B g)."""
    along = np.linspace(-2, 2, 401)
    track = np.stack([along, np.full(401, -30.0), np.full(401, 30.0)], -1)
    band = CARRIER + np.linspace(-1e8, 1e8, 64)
    grid, ground = SceneGrid("local", -2.0, 2.0, 1.0, (4, 4)), Plane(0.0, 0.0, 0.0, east=0.0, north=rise)
    aperture = Aperture(track, track)
    resolution = Resolution.of(grid, ground, aperture, None, frequency_hz=band, weight=np.ones(64) / 64)
    fine, coarse, azimuth = resolution.axes((slice(1, 2), slice(2, 3)))
    width = 0.886 * SPEED_OF_LIGHT_M_S / 2e8 / (2 * np.sqrt(0.5) * (1 - rise))
    widths = (fine, coarse) if abs(azimuth[0, 0]) < 45 else (coarse, fine)
    assert widths[0][0, 0] == pytest.approx(width, rel=0.04)


def test_noise_and_point_snr_follow_from_the_radar_equation():
    """The SNR of M pulses of duration T is P G² λ² σ T M / ((4π)³ R⁴ kT₀F), with R nearly constant on a short track."""
    design = ap.design(with_tracks(plan_of(), uav1=line(start_m=[-1.0, 0.0], end_m=[1.0, 0.0])))
    pulses = at_centre(design, "looks")
    distance = np.sqrt(30.25**2 + 30**2)
    power, gains, wavelength = 0.1, 10 ** (9 / 10), SPEED_OF_LIGHT_M_S / CARRIER
    received = power * gains * wavelength**2 / ((4 * np.pi) ** 3 * distance**4)
    noise = BOLTZMANN_J_K * 290 * 10**0.5 / 2.5e-6
    snr_db = 10 * np.log10(received * pulses / noise)
    assert at_centre(design, "point_snr") == pytest.approx(snr_db, abs=0.1)
    assert at_centre(design, "snr") == pytest.approx(-15 - at_centre(design, "nesz"), abs=1e-4)


def test_sum_of_two_pairs_has_finer_resolution_and_their_mean_noise():
    design = ap.design(with_tracks(with_second(spacing_m=8.0), uav1=line(start_m=[-3.0, 0.0], end_m=[3.0, 0.0])))
    assert list(design.image.values) == ["f01/uav1-uav1", "f01/uav1-uav2", "f01/sum"]
    assert at_centre(design, "resolution_fine", 2) < 0.9 * at_centre(design, "resolution_fine", 0)
    linear = [10 ** (at_centre(design, "nesz", image) / 10) for image in range(3)]
    assert linear[2] == pytest.approx((linear[0] + linear[1]) / 2, rel=1e-3)


def drawn_tracks(generator, pulses=32):
    """Draw straight tracks of two antennas in any direction, 20 to 60 m from the origin and 15 to 60 m high."""
    for _ in range(2):
        azimuth, heading = generator.uniform(0, 2 * np.pi, 2)
        distance, height, length = generator.uniform((20, 15, 8), (60, 60, 40))
        along = np.linspace(-length / 2, length / 2, pulses)[:, None]
        middle = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), height])
        yield middle + along * np.array([np.cos(heading), np.sin(heading), 0.0])


@pytest.mark.slow
def test_resolution_of_a_sum_matches_its_response_in_random_geometries():
    """The series of eq. 1 assumes one lobe; for separate spectra of the pairs, the widths have errors of up to 15 %."""
    generator, count = np.random.default_rng(3), 16
    band = CARRIER + 12.8e6 * (np.arange(count) - (count - 1) / 2)
    weight = np.hanning(count + 2)[1:-1] / np.hanning(count + 2).sum()
    grid, ground, errors = SceneGrid("local", -0.5, 0.5, 1.0, (1, 1)), FlatGround(0.0), []
    for _ in range(60):
        first, second = drawn_tracks(generator)
        pairs = [Aperture(first, first), Aperture(first, second)]
        resolutions = [Resolution.of(grid, ground, pair, None, frequency_hz=band, weight=weight) for pair in pairs]
        *widths, azimuth = Resolution.summed(resolutions).axes((slice(0, 1), slice(0, 1)))
        for width, offset_deg in zip(widths, (0, 90), strict=True):
            angle = np.radians(float(azimuth[0, 0]) + offset_deg)
            displacement_m = np.linspace(0, 1.5 * float(width[0, 0]), 400)
            response = 0
            for pair in pairs:
                path_slope = pair.path_gradient(np.zeros((1, 3)))[:, 0] @ [np.sin(angle), np.cos(angle), 0.0]
                cycles = np.multiply.outer(np.multiply.outer(displacement_m, path_slope), band) / SPEED_OF_LIGHT_M_S
                response = response + (weight * np.exp(2j * np.pi * cycles)).sum(axis=-1).mean(axis=-1)
            half = int(np.argmax(np.abs(response / 2) ** 2 < 0.5))
            errors.append(float(width[0, 0]) / (2 * displacement_m[half]) - 1)
    assert abs(np.median(errors)) < 0.01
    assert np.quantile(np.abs(errors), 0.9) < 0.05
    assert np.max(np.abs(errors)) < 0.15


def test_coherence_of_two_heights_is_the_overlap_of_windowed_spectra():
    """For spectra shifted by δ widths, the overlap is 1 - δ if flat, 1 - (2π²/3) δ² with a Hann window and small δ."""
    shares, low = [], line(start_m=[-2.0, 0.0], end_m=[2.0, 0.0])
    for window in ("none", "hann"):
        plan = plan_of(processing={"window": window, "integration": "all"}, expect={"sigma0_db": None})
        plan["flights"] = {
            name: {"transmitter": "uav1", "receivers": ["uav1"], "tracks": {"uav1": low | {"height_m": height}}}
            for name, height in (("f01", 30.0), ("f02", 31.0))
        }
        design = ap.design(plan | {"interferometry": {"pairs": {"two": ["f01/uav1-uav1", "f02/uav1-uav1"]}}})
        shares.append(float(design.coherence[0, 10, 10]))
    sines = [29.75 / np.hypot(29.75, height) for height in (30.0, 31.0)]
    shift = (sines[0] - sines[1]) * CARRIER / (SPACING * COUNT) / np.mean(sines)
    assert shares[0] == pytest.approx(1 - shift, abs=0.02)
    assert shares[1] == pytest.approx(1 - 2 * np.pi**2 / 3 * shift**2, abs=0.02)


def test_position_errors_are_reported_as_cause_of_the_loss():
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
def test_loss_is_judged_after_refinement_if_the_plan_requests_it(autofocus, met):
    """At L-band, 2 cm cause a loss of 2 to 5 dB, 0.3 dB after refinement (docs/theory/autofocus.md, "Measured")."""
    design = design_of(0.02, autofocus)
    (verdict,) = judge(design)
    assert verdict.met == met
    layers = design.images["f01/uav1-uav1"].layers
    assert 2 < np.median(layers["loss"]) < 6
    assert np.median(layers["loss_refined"]) == pytest.approx(0.3, abs=0.1)
    assert verdict.found == pytest.approx(np.max(layers["loss_refined" if met else "loss"]), abs=0.05)


def test_refinement_needs_points_of_a_stated_cross_section():
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
def test_refinement_beyond_its_measured_limits_is_not_assumed(std_m, node, obstacle):
    design = design_of(std_m, "on", **node)
    (verdict,) = judge(design)
    assert not verdict.met
    assert obstacle in refinement_line(design, "f01")
    assert np.isnan(design.images["f01/uav1-uav1"].layers["loss_refined"]).all()


def test_sparse_pulses_are_refused_on_a_coarse_grid_too():
    """2 × 2 pixels span half the Doppler of 20 × 20 pixels; plans found by a search must be valid on the full grid."""
    plan = plan_of()
    plan["waveform"]["prf_hz"] = 8.0
    for coarse in (None, 2):
        with pytest.raises(CampaignError, match="Hz, the Doppler spread over the scene, instead of 8 Hz"):
            designed(FlightPlan.model_validate(plan), HERE, coarse=coarse)


@pytest.mark.slow
def test_ambiguous_echoes_are_reported_as_cause_and_more_pulses_help(tmp_path):
    """At 5 m/s, the Doppler spread over 60 m of scene is between 50 and 100 Hz."""
    plan = plan_of(require={"ambiguity": 0.02})
    plan["waveform"]["prf_hz"] = 50.0
    plan["scene"] |= {"bounds_m": [-30.0, 20.0, 30.0, 80.0], "spacing_m": 1.0}
    (verdict,) = judge(designed(FlightPlan.model_validate(plan), tmp_path))
    assert not verdict.met
    assert "Doppler spread of" in verdict.cause
    assert "double the pulse rate (waveform.prf_hz)" in {
        change.words for change in changes_of(plan, tmp_path) if change.meets
    }


def changes_of(plan, root):
    plan = FlightPlan.model_validate(plan)
    return helpful_changes(plan, root, judge(designed(plan, root)))


@pytest.mark.slow
def test_requirement_missed_by_little_on_the_fine_grid_gets_changes(tmp_path):
    """A coarser grid omits 0.1 to 1 % of the far side; therefore, gains are relative to the plan on the same grid."""
    plan = plan_of(scene=plan_of()["scene"] | {"spacing_m": 0.05})
    (verdict,) = judge(designed(FlightPlan.model_validate(plan | {"require": {"nesz_db": 0.0}}), tmp_path))
    missed = plan | {"require": {"nesz_db": verdict.found - 0.002}}
    changes = changes_of(missed, tmp_path)
    assert any(change.meets for change in changes)
    assert all(change.gain_db == pytest.approx(0.002, abs=1e-4) for change in changes if change.meets)


@pytest.mark.slow
def test_changes_are_sorted_by_their_gain(tmp_path):
    changes = changes_of(plan_of(require={"nesz_db": -60.0}), tmp_path)
    assert changes[0].gain_db >= changes[-1].gain_db > 0
    gains = {change.words: change.gain_db for change in changes}
    assert gains["increase the transmit power by 3 dB (transmit_power_dbm)"] == pytest.approx(3, abs=0.01)
    assert gains["double the pulse rate (waveform.prf_hz)"] == pytest.approx(3.01, abs=0.05)


@pytest.mark.slow
def test_changes_that_violate_met_requirements_come_last(tmp_path):
    required = {"point_snr_db": 60.0, "flight_s": 15.9}
    changes = changes_of(plan_of(require=required), tmp_path)
    violated = {change.words: change.breaks for change in changes}
    assert violated["fly at 0.5 times the speed (speed_m_s)"] == ("flight_s",)
    assert violated["increase the transmit power by 3 dB (transmit_power_dbm)"] == ()
    assert [*map(bool, violated.values())] == sorted(map(bool, violated.values()))


@pytest.mark.slow
def test_search_is_reproducible_and_improves_the_plan(tmp_path):
    plan = FlightPlan.model_validate(plan_of(require={"resolution_m": 0.8}, bounds={"height_m": [-20, 20]}))
    best, tried = search(plan, tmp_path, ["height"], most=5)
    again, _ = search(plan, tmp_path, ["height"], most=5)
    assert best == again
    assert best.moved.height_m < 0  # a lower height gives a finer ground range resolution
    assert min(tried, key=lambda candidate: candidate.objective).on_front
    first = tried_report(tried)[0]
    assert first["moved"] == {"height_m": best.moved.height_m}
    assert first["found"]["resolution_m"] < 0.8


def test_recording_size_follows_from_its_captures():
    recording = ap.design(with_second()).attrs["recording"]
    capture = round(3.5e-6 * 2.56e8) * 4
    assert recording["node_bytes_s"]["f01"] == {"uav1": 100 * capture, "uav2": 200 * capture}
    assert recording["recorded_bytes"] == recording["pulses"]["f01"] * 3 * capture


def test_fmcw_design_has_resolution_but_no_noise():
    sweep = {"kind": "fmcw", "format": "beat_npy", "start_hz": 5.7e9, "bandwidth_hz": 2e8, "sweep_s": 1e-3}
    plan = plan_of(waveform=sweep | {"sample_rate_hz": 4e5, "prf_hz": 200.0}, nodes={"uav1": {"attitude": "log"}})
    design = ap.design(with_tracks(plan, uav1=line(start_m=[-2.0, 0.0], end_m=[2.0, 0.0])))
    across = 0.886 * SPEED_OF_LIGHT_M_S / (2 * 2e8) / np.sin(np.pi / 4)
    assert at_centre(design, "resolution") == pytest.approx(across, rel=0.02)
    assert np.isnan(design.nesz).all()
    assert design.attrs["recording"]["node_bytes_s"]["f01"]["uav1"] == 200 * 400 * 2


def test_turns_between_legs_are_not_imaged():
    racetrack = line(kind="racetrack", legs=3, spacing_m=5.0)
    opened = open_plan(FlightPlan.model_validate(with_tracks(plan_of(), uav1=racetrack)), HERE)
    course = opened.courses["f01"]["uav1"]
    assert len(course.imaged_s) == 3
    assert len(opened.pairs[0].time_s) == 3 * 801
    assert course.length_s > 3 * 8.0 + 2.0
    legs = np.unique(opened.pairs[0].aperture.tx_m[:, 1].round(2))
    assert legs.tolist() == [-10.0, -5.0, 0.0]


def test_tracks_are_moved_relative_to_the_scene_centre():
    moved = {"height_m": 5.0, "offset_m": 10.0, "heading_deg": 90.0}
    opened = open_plan(FlightPlan.model_validate(plan_of(moved=moved)), HERE)
    positions = opened.pairs[0].aperture.tx_m
    # Shifted 10 m south to 40 m from the centre (0, 30), then rotated clockwise: west of the centre, north to south.
    assert positions[:, 0] == pytest.approx(-40.0)
    assert positions[[0, -1], 1] == pytest.approx([50.0, 10.0])
    assert positions[:, 2] == pytest.approx(35.0)


INVALID = {
    "through the ground": (with_tracks(plan_of(), uav1=line(height_m=-2.0)), "at or below the terrain"),
    "too few pulses": (
        plan_of(
            waveform=plan_of()["waveform"] | {"prf_hz": 8.0},
            scene=plan_of()["scene"] | {"bounds_m": [-25.0, 5.0, 25.0, 55.0]},
        ),
        "the Doppler spread over the scene, instead of 8 Hz",
    ),
    "colliding formation": (with_second(spacing_m=1.0), "separation of uav1 and uav2 falls to 1.00 m at"),
    "no track": (with_second(formation=None), "uav2 has no track, and there is no formation"),
    "a hover": (with_tracks(plan_of(), uav1=line(end_m=[-20.0, 0.0])), "a hover gives no image"),
    "unknown key": (plan_of(requires={"nesz_db": -20}), "requires: unknown key (did you mean 'require'?)"),
    "beyond the prefix": (
        plan_of(waveform=plan_of()["waveform"] | {"cyclic_prefix_s": 1e-7}),
        "echoes of the scene arrive after the cyclic prefix",
    ),
    "tracks elsewhere": (
        with_tracks(plan_of(), uav1=line(start_m=[4840.0, 990.0], end_m=[4880.0, 990.0])),
        "km from the tracks",
    ),
    "a racetrack without length": (
        with_tracks(plan_of(), uav1=line(kind="racetrack", end_m=[-20.0, 0.0])),
        "a hover gives no image",
    ),
    "GHz": (plan_of(waveform=plan_of()["waveform"] | {"carrier_hz": 1.3, "carrier_is": "band_start"}), "in Hz"),
    "a receiver twice": (with_second(receivers=["uav1", "uav1", "uav2"]), "contain a duplicate"),
}


@pytest.mark.parametrize("case", INVALID)
def test_invalid_plan_is_refused(case):
    plan, message = INVALID[case]
    with pytest.raises(CampaignError) as caught:
        ap.design(plan)
    assert message in str(caught.value)
    assert "config.yaml" not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["dike.plan", "dike.kml"])
def test_mission_file_instead_of_a_plan_is_refused_with_a_remedy(tmp_path, name):
    (tmp_path / name).write_text('{"mission": {}}')
    with pytest.raises(CampaignError, match=rf"{name}: a mission, not a flight plan.*kind: mission, file: {name}"):
        read_flight_plan(tmp_path / name)


def test_unknown_key_named_like_a_kind_of_track_is_reported(tmp_path):
    """The key `mission` is a kind of track, not a key of a plan."""
    (tmp_path / "plan.yaml").write_text("mission: dike.plan\n")
    with pytest.raises(CampaignError, match="mission: unknown key"):
        read_flight_plan(tmp_path / "plan.yaml")
