"""The paper's experiments: recorded in the lab, standing and flying, processed as any campaign, judged and drawn."""

import numpy as np
import pytest
from apertura_research import commands
from apertura_research.paper import figures
from apertura_research.paper.claims import AGREES, DISAGREES, EXPLAINED, PAPER, VERDICTS
from apertura_research.paper.experiments import (
    BISTATIC,
    MONOSTATIC,
    coherence_claims,
    open_experiment,
    profiles_at,
    terms_at,
)
from apertura_research.paper.fusion import (
    MAGNITUDES_CONTRAST,
    MAGNITUDES_DB,
    Images,
    fusion_claims,
    two_segment_sidelobe_db,
)
from apertura_research.paper.losses import ERRORS
from folders import recordings_of, run_steps

from apertura.campaign.folder import Campaign
from apertura.core.quality.measures import coherence_factor
from apertura.simulation import preset, simulate
from apertura.simulation.presets import GAP_M, SEGMENT_M
from apertura.stages import echo, ingest

pytestmark = pytest.mark.slow  # of the research, not of the product

PULSES = 16


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    """A folder of the two experiments without motion, few pulses, as far as their echoes."""
    folder = tmp_path_factory.mktemp("campaigns")
    for name in ("lab", "static"):
        campaign = Campaign.load(simulate(folder / name, preset(f"paper-{name}", pulses=PULSES)))
        for node in ("uav1", "uav2"):
            ingest.ingest(campaign, "f01", node)
        for pair in (MONOSTATIC, BISTATIC):
            echo.echo(campaign, "f01", pair)
    return folder


@pytest.mark.parametrize("name", ["lab", "static"])
def test_the_sidelink_makes_random_phases_coherent_through_cable_and_air(campaigns, name):
    experiment = open_experiment(campaigns, name)
    place = experiment.places_m[0]
    assert coherence_factor(terms_at(experiment.uncorrected(), place)) < 0.3
    assert coherence_factor(terms_at(experiment.history(BISTATIC), place)) > 0.95


@pytest.mark.parametrize("name", ["lab", "static"])
@pytest.mark.parametrize("pair", [MONOSTATIC, BISTATIC])
def test_a_target_stands_in_the_profile_where_it_was_put(campaigns, name, pair):
    experiment = open_experiment(campaigns, name)
    history = experiment.history(pair)
    true_m = float(history.aperture.path(experiment.places_m[:1]).mean()) / 2
    slant_m = true_m + np.linspace(-0.6, 0.6, 601)
    found_m = slant_m[np.abs(profiles_at(history, slant_m)).mean(axis=0).argmax()]
    assert found_m == pytest.approx(true_m, abs=0.08)  # clutter moves it by a fraction of a cell of 37 cm


def test_the_lab_is_ten_metres_of_cable_beside_five_and_no_target():
    specification = preset("paper-lab")
    (joint,) = specification.targets
    tracks = specification.flights[0].tracks
    assert tracks["uav1"] == tracks["uav2"]
    assert tracks["uav1"].velocity_m_s == (0.0, 0.0, 0.0)
    assert joint.position_m[:2] == tracks["uav1"].start_m[:2]
    for name, recorded in recordings_of(preset("paper-lab", pulses=2))[0].items():
        path_m = 299792458 * recorded.channels["radar"].paths.delay_s
        np.testing.assert_allclose(path_m, 10.0, atol=1e-6)
        assert abs(recorded.channels["radar"].paths.amplitude) == pytest.approx(1.0, rel=1e-5)
        if name == "uav2":
            np.testing.assert_allclose(299792458 * recorded.channels["sidelink"].paths.delay_s, 5.0, atol=1e-6)


def test_one_receive_signal_is_split_to_both_nodes_of_the_static_recording():
    recorded, _ = recordings_of(preset("paper-static", pulses=2))
    mono, bistatic = (recorded[name].channels["radar"].paths for name in ("uav1", "uav2"))
    np.testing.assert_array_equal(mono.delay_s, bistatic.delay_s)
    np.testing.assert_array_equal(mono.amplitude, bistatic.amplitude)
    first, second = (abs(mono.amplitude[0, part].sum()) for part in (slice(4), slice(4, 8)))
    assert 20 * np.log10(first / second) == pytest.approx(7.0, abs=0.1)


def test_coherence_is_that_of_the_printed_recordings_and_of_the_noise_of_echo_free_ranges(campaigns):
    claims = {claim.claim: claim for claim in coherence_claims(campaigns)}
    assert {claim.verdict for claim in claims.values()} <= set(VERDICTS)
    before = claims["coherence factor without correction"]
    assert (before.paper, before.independent_model) == ("0.0034", f"{1 / PULSES:g}")
    printed = {name: claim for name, claim in claims.items() if "after correction" in name}
    assert {name.partition("correction, ")[2]: (claim.paper, claim.verdict) for name, claim in printed.items()} == {
        "lab, cables": ("0.986", EXPLAINED),
        "static, first cylinder": ("0.9999", EXPLAINED),
        "static, second cylinder": ("0.9995", EXPLAINED),
    }
    assert all("by construction" in claim.note for claim in printed.values())
    assert float(claims["phase spread at the second cylinder over that at the first"].computed) > 1.5
    for name, claim in claims.items():
        if name.startswith("lack of coherence"):
            assert float(claim.computed) == pytest.approx(1.0, abs=0.7)
    alike = [claims[f"{what} monostatic, static"] for what in ("phase of bistatic less", "gain of bistatic over")]
    assert [(claim.about, claim.verdict) for claim in alike] == [
        (PAPER, EXPLAINED)
    ] * 2  # one simulated signal is split
    assert all("by construction" in claim.note for claim in alike)


def test_a_profile_is_the_inner_sum_of_the_image(campaigns):
    experiment = open_experiment(campaigns, "static")
    history = experiment.history(BISTATIC)
    half_m = float(history.aperture.path(experiment.places_m[:1])[0, 0]) / 2
    expected = terms_at(history, experiment.places_m[0])
    np.testing.assert_allclose(profiles_at(history, np.array([half_m]))[:, 0], expected, rtol=2e-3)


@pytest.mark.parametrize("name", ["lab_profile", "lab_phase", "static_profile", "static_phase"])
def test_figures_of_the_experiments_are_drawn_from_their_campaigns(campaigns, tmp_path, name):
    path = figures.DRAWN[name](campaigns, tmp_path / f"{name}.png")
    assert path.stat().st_size > 20_000


def test_every_figure_of_the_paper_has_what_draws_it():
    drawn = {*figures.SHOWN, "scene", *figures.DRAWN}
    assert drawn == set(commands.PAPER_FIGURES)
    assert len(drawn) == 14
    assert set(figures.SHOWN) == {"no_errors", *ERRORS}
    campaigns_read = {name for names in commands.PAPER_FIGURES.values() for name in names}
    assert campaigns_read == {name for names in commands.PAPER_READS.values() for name in names}


def test_the_scene_is_drawn_without_a_campaign(tmp_path):
    assert figures.draw_scene(tmp_path / "scene.png").stat().st_size > 10_000


def test_segments_of_the_flight_lie_as_far_apart_at_their_midpoints_as_stated():
    specification = preset("paper-uav")
    (flight,) = specification.flights
    tx, rx = (np.array(flight.tracks[node].start_m) for node in ("uav1", "uav2"))
    speed_m_s = flight.tracks["uav1"].velocity_m_s[0]
    ((start, end),) = flight.segments[MONOSTATIC]
    ((later, last),) = flight.segments[BISTATIC]
    ahead_m = (rx - tx)[0] / 2
    assert (end - start) * speed_m_s == pytest.approx(SEGMENT_M)
    assert (later - end) * speed_m_s + ahead_m == pytest.approx(GAP_M)
    assert last <= (flight.pulses - 1) / specification.waveform.prf_hz
    middle_m = tx[0] + (start + last) / 2 * speed_m_s + ahead_m / 2
    assert middle_m == pytest.approx(0.0)  # the scene's middle is abreast of both segments together


def test_two_adjacent_segments_have_the_sidelobe_of_one_aperture_and_a_gap_raises_it():
    assert two_segment_sidelobe_db(1.0, 0.0) == pytest.approx(-13.26, abs=0.05)
    levels = [two_segment_sidelobe_db(3.4, gap_m) for gap_m in (0.0, 1.0, 2.0, 4.0)]
    assert (np.diff(levels) > 0).all()


def test_magnitudes_of_two_clutters_add_up_to_half_a_decibel_less_and_smoother():
    parts = np.random.default_rng(1).standard_normal((2, 200_000, 2)) @ [1, 1j] / np.sqrt(2)
    power = (np.abs(parts).sum(axis=0) / 2) ** 2
    assert -10 * np.log10(power.mean()) == pytest.approx(MAGNITUDES_DB, abs=0.02)
    assert power.std() / power.mean() == pytest.approx(MAGNITUDES_CONTRAST, abs=0.01)  # of one image: 1


def test_clutter_is_measured_away_from_every_target():
    images = Images({"mono": np.zeros((100, 100), np.complex64)}, np.array([[20.0, 20.0], [70.0, 50.0]]), 0.1)
    mask = images.clutter()
    assert not mask[20, 34]
    assert mask[20, 36]
    assert not mask[70, 50]
    assert mask.mean() == pytest.approx(1 - 2 * np.pi * 15**2 / 1e4, abs=0.01)


def test_the_flight_through_the_pipeline_fuses_as_its_segments_say(tmp_path):
    run_steps(simulate(tmp_path / "uav", "paper-uav"), exports=False)
    claims = {claim.claim: claim for claim in fusion_claims(tmp_path)}
    comparable = claims.pop("clutter suppression by the coherent sum over that by the noncoherent one")
    assert (comparable.about, comparable.verdict) == (PAPER, DISAGREES)
    gained = claims["UAV experiment: width of the noncoherent sum over that of the monostatic image"]
    assert (gained.about, gained.verdict) == (PAPER, AGREES)
    assert {claim.verdict for name, claim in claims.items() if "coherent sum" not in name} == {AGREES}
    width = float(claims["UAV experiment: cross-range width, coherent sum"].computed)
    assert 10 < width < 14  # a third of one segment's
