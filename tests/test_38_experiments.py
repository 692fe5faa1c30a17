"""Experiments of the paper (lab, static, UAV): simulated, processed as campaigns, evaluated and plotted."""

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
from folders import recordings_of

from apertura.campaign.folder import Campaign
from apertura.core.quality.measures import coherence_factor
from apertura.run.process import process
from apertura.simulation import preset, simulate
from apertura.simulation.presets import GAP_M, SEGMENT_M
from apertura.stages import echo, ingest

pytestmark = pytest.mark.slow  # research code

PULSES = 16


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    """Process the two experiments without motion, with few pulses, up to their echoes."""
    folder = tmp_path_factory.mktemp("campaigns")
    for name in ("lab", "static"):
        campaign = Campaign.load(simulate(folder / name, preset(f"paper-{name}", pulses=PULSES)))
        for node in ("uav1", "uav2"):
            ingest.ingest(campaign, "f01", node)
        for pair in (MONOSTATIC, BISTATIC):
            echo.echo(campaign, "f01", pair)
    return folder


@pytest.mark.parametrize("name", ["lab", "static"])
def test_sidelink_restores_coherence_of_random_phases(campaigns, name):
    experiment = open_experiment(campaigns, name)
    target = experiment.places_m[0]
    assert coherence_factor(terms_at(experiment.uncorrected(), target)) < 0.3
    assert coherence_factor(terms_at(experiment.history(BISTATIC), target)) > 0.95


@pytest.mark.parametrize("name", ["lab", "static"])
@pytest.mark.parametrize("pair", [MONOSTATIC, BISTATIC])
def test_target_peaks_at_its_range_in_the_profile(campaigns, name, pair):
    experiment = open_experiment(campaigns, name)
    history = experiment.history(pair)
    true_m = float(history.aperture.path(experiment.places_m[:1]).mean()) / 2
    slant_m = true_m + np.linspace(-0.6, 0.6, 601)
    peak_m = slant_m[np.abs(profiles_at(history, slant_m)).mean(axis=0).argmax()]
    assert peak_m == pytest.approx(true_m, abs=0.08)  # clutter displaces the peak by a fraction of a cell of 37 cm


def test_lab_experiment_has_10_m_radar_and_5_m_sidelink_cables():
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


def test_static_experiment_records_one_split_signal_on_both_nodes():
    recorded, _ = recordings_of(preset("paper-static", pulses=2))
    mono, bistatic = (recorded[name].channels["radar"].paths for name in ("uav1", "uav2"))
    np.testing.assert_array_equal(mono.delay_s, bistatic.delay_s)
    np.testing.assert_array_equal(mono.amplitude, bistatic.amplitude)
    first, second = (abs(mono.amplitude[0, part].sum()) for part in (slice(4), slice(4, 8)))
    assert 20 * np.log10(first / second) == pytest.approx(7.0, abs=0.1)


def test_coherence_claims_match_the_paper_and_the_noise_level(campaigns):
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
    pair_claims = [
        claims[f"{what} monostatic, static"] for what in ("phase of bistatic minus", "gain of bistatic over")
    ]
    assert [(claim.about, claim.verdict) for claim in pair_claims] == [
        (PAPER, EXPLAINED)
    ] * 2  # one simulated signal is split
    assert all("by construction" in claim.note for claim in pair_claims)


def test_profile_equals_the_inner_sum_of_the_image(campaigns):
    experiment = open_experiment(campaigns, "static")
    history = experiment.history(BISTATIC)
    half_m = float(history.aperture.path(experiment.places_m[:1])[0, 0]) / 2
    expected = terms_at(history, experiment.places_m[0])
    np.testing.assert_allclose(profiles_at(history, np.array([half_m]))[:, 0], expected, rtol=2e-3)


@pytest.mark.parametrize("name", ["lab_profile", "lab_phase", "static_profile", "static_phase"])
def test_figures_are_drawn_from_the_experiment_campaigns(campaigns, tmp_path, name):
    path = figures.DRAWN[name](campaigns, tmp_path / f"{name}.png")
    assert path.stat().st_size > 20_000


def test_every_figure_of_the_paper_has_a_drawing_function():
    drawn = {*figures.SHOWN, "scene", *figures.DRAWN}
    assert drawn == set(commands.PAPER_FIGURES)
    assert len(drawn) == 14
    assert set(figures.SHOWN) == {"no_errors", *ERRORS}
    campaigns_read = {name for names in commands.PAPER_FIGURES.values() for name in names}
    assert campaigns_read == {name for names in commands.PAPER_READS.values() for name in names}


def test_the_scene_is_drawn_without_a_campaign(tmp_path):
    assert figures.draw_scene(tmp_path / "scene.png").stat().st_size > 10_000


def test_flight_segments_have_the_stated_length_and_gap():
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
    assert middle_m == pytest.approx(0.0)  # the scene centre is abeam of the midpoint of both segments


def test_adjacent_segments_have_one_aperture_sidelobe_raised_by_a_gap():
    assert two_segment_sidelobe_db(1.0, 0.0) == pytest.approx(-13.26, abs=0.05)
    levels = [two_segment_sidelobe_db(3.4, gap_m) for gap_m in (0.0, 1.0, 2.0, 4.0)]
    assert (np.diff(levels) > 0).all()


def test_magnitude_sum_of_clutter_has_the_predicted_level_and_contrast():
    parts = np.random.default_rng(1).standard_normal((2, 200_000, 2)) @ [1, 1j] / np.sqrt(2)
    power = (np.abs(parts).sum(axis=0) / 2) ** 2
    assert -10 * np.log10(power.mean()) == pytest.approx(MAGNITUDES_DB, abs=0.02)
    assert power.std() / power.mean() == pytest.approx(MAGNITUDES_CONTRAST, abs=0.01)  # contrast of a single image: 1


def test_clutter_is_measured_away_from_every_target():
    images = Images({"mono": np.zeros((100, 100), np.complex64)}, np.array([[20.0, 20.0], [70.0, 50.0]]), 0.1)
    mask = images.clutter()
    assert not mask[20, 34]
    assert mask[20, 36]
    assert not mask[70, 50]
    assert mask.mean() == pytest.approx(1 - 2 * np.pi * 15**2 / 1e4, abs=0.01)


def test_processed_flight_gives_the_predicted_fusion_results(tmp_path):
    process(simulate(tmp_path / "uav", "paper-uav"), last="cube")
    claims = {claim.claim: claim for claim in fusion_claims(tmp_path)}
    suppression = claims.pop("clutter suppression by the coherent sum over that by the noncoherent one")
    assert (suppression.about, suppression.verdict) == (PAPER, DISAGREES)
    relative_width = claims["UAV experiment: width of the noncoherent sum over that of the monostatic image"]
    assert (relative_width.about, relative_width.verdict) == (PAPER, AGREES)
    assert {claim.verdict for name, claim in claims.items() if "coherent sum" not in name} == {AGREES}
    width = float(claims["UAV experiment: cross-range width, coherent sum"].computed)
    assert 10 < width < 14  # a third of the width of one segment
