"""Removal of echoes at constant delay: effect on the image, loss of targets, and the decision to apply it."""

import shutil
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import pytest
from folders import ROOT, copy_writable, state
from scenes import monostatic, straight_track

import apertura as ap
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.backprojection.contributions import band_limited_image
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.background import GroupMeans, background_excess_db
from apertura.core.echo.captures import Saturation, sampled_pulses
from apertura.core.echo.compression import window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.background import BackgroundScene, decide_removal, steadiest, target_loss
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.run.process import process
from apertura.simulation import ImageGrid, preset, simulate
from apertura.simulation.impairments import Leakage
from apertura.stages import profile

FREQUENCY = 1.2e9 + 3.2e6 * np.arange(128)
GRID = SceneGrid("local", -5.0, 30.0, 0.1, (100, 100))
GROUND = FlatGround(0.0)
TARGETS = np.array([[-2.0, 25.0, 0.0], [3.0, 22.0, 0.0], [0.0, 28.0, 0.0]])
PRF_HZ = 100.0


@dataclass
class Recording:
    """Transfer functions of targets with noise, and with added coupling."""

    transfer: np.ndarray
    aperture: Aperture

    @property
    def time_s(self):
        return np.arange(len(self.transfer)) / PRF_HZ

    @property
    def history(self):
        count = len(self.transfer)
        return PhaseHistory(
            self.transfer.astype(np.complex64),
            FREQUENCY,
            window_weights("hann", len(FREQUENCY)),
            np.zeros(count),
            self.aperture,
        )

    @property
    def scene(self):
        none = np.zeros(len(self.transfer))
        return BackgroundScene(self.history, none, none, self.time_s, GRID, GROUND)

    @property
    def means(self):
        return GroupMeans.of(lambda pulses: self.history.transfer[pulses], self.time_s)

    @property
    def excess_db(self):
        return background_excess_db([self.history.transfer[group] for group in sampled_pulses(len(self.transfer))])

    def decided(self, method="auto"):
        return decide_removal(self.means, self.scene, method=method, generator=np.random.default_rng(5))

    def image(self, points, background=None):
        history = self.history
        if background is not None:
            transfer = history.transfer - background.at(self.time_s, FREQUENCY, np.zeros(len(self.time_s)))
            history = replace(history, transfer=transfer)
        return band_limited_image(range_compress(history, GRID, GROUND), points) / len(self.time_s)


def recorded(aperture, targets=TARGETS, *, noise=0.3, seed=1):
    rng, paths_s = np.random.default_rng(seed), aperture.path(np.asarray(targets)) / C
    echo = np.exp(-2j * np.pi * np.remainder(paths_s[..., None] * FREQUENCY, 1.0)).sum(axis=1)
    drawn = rng.normal(size=(*echo.shape, 2)) @ np.array([1, 1j]) * noise / np.sqrt(2)
    return Recording(echo + drawn, aperture)


def coupled(recording, level_db, *, drift=0.0):
    """Add a response that decays over the ranges of the scene, level_db above one target, with a phase drift (rad)."""
    delays_s = np.arange(20.0, 75.0, 1.5) / C
    amplitude = 10 ** (level_db / 20) * np.exp(-np.arange(len(delays_s)) / 8)
    response = (amplitude[:, None] * np.exp(-2j * np.pi * np.remainder(delays_s[:, None] * FREQUENCY, 1.0))).sum(axis=0)
    phase = np.exp(1j * drift * np.linspace(0, 1, len(recording.transfer)))
    return replace(recording, transfer=recording.transfer + phase[:, None] * response)


def straight(pulses=400, length_m=20.0):
    return monostatic(straight_track(pulses, length_m=length_m))


def peaks_db(recording, background=None):
    return 20 * np.log10(np.abs(recording.image(TARGETS, background)))


def median_db(recording, background=None):
    pixels = GRID.positions_at(*np.random.default_rng(2).integers(100, size=(2, 400)), 0.0)
    return 10 * np.log10(np.median(np.abs(recording.image(pixels, background)) ** 2))


@pytest.mark.parametrize(
    "level_db", [0, pytest.param(20, marks=pytest.mark.slow), pytest.param(40, marks=pytest.mark.slow), 60]
)
def test_removal_restores_targets_and_clutter_at_any_coupling_level(level_db):
    clean = recorded(straight())
    disturbed = coupled(clean, level_db)
    removal = disturbed.decided()
    assert disturbed.excess_db > 0
    assert removal.value == "median"
    assert np.abs(peaks_db(disturbed, removal.background) - peaks_db(clean)).max() < 0.5
    assert median_db(disturbed, removal.background) == pytest.approx(
        median_db(clean, clean.means.background("median")), abs=0.2
    )


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 20))])
def test_no_background_is_detected_without_coupling(seed):
    assert recorded(straight(), seed=seed, noise=3.0 if seed % 2 else 0.1).excess_db < 0


def test_predicted_loss_of_a_target_equals_that_of_its_image():
    """The passes are short, with little change of range."""
    target = np.array([[0.0, 25.0, 0.0]])
    losses = []
    for length_m in (1.5, 3.0, 6.0):
        recording = recorded(straight(length_m=length_m), target, noise=0.0)
        mean = recording.means.background("mean")
        before, after = (np.abs(recording.image(target, background))[0] for background in (None, mean))
        losses.append(target_loss(recording.scene, "mean", target[0]))
        assert 20 * np.log10(after / before) == pytest.approx(losses[-1], abs=0.05)
    assert losses[0] < -6
    assert -3 < losses[2] < -0.3


def circle(pulses=400, radius_m=15.0):
    angle = np.linspace(0, 2 * np.pi, pulses, endpoint=False)
    return monostatic(np.stack([radius_m * np.cos(angle), 25 + radius_m * np.sin(angle), np.full(pulses, 10.0)], -1))


CENTRE = np.array([[0.0, 25.0, 0.0]])


def test_target_circled_at_constant_range_is_not_removed():
    recording = recorded(circle(), CENTRE)
    removal = recording.decided()
    assert recording.excess_db > 0
    assert removal.background is None
    assert removal.flags == {}
    assert target_loss(recording.scene, "median", CENTRE[0]) < -20
    assert np.linalg.norm(steadiest(recording.scene) - CENTRE[0]) < 0.01


def test_coupling_is_removed_at_all_delays_except_a_circled_target():
    clean = recorded(circle(), CENTRE)
    disturbed = coupled(clean, 20)
    removal = disturbed.decided()
    assert "but at the delay of the steadiest target" in removal.value
    kept_db = 20 * np.log10(np.abs(disturbed.image(CENTRE, removal.background) / disturbed.image(CENTRE))[0])
    assert abs(kept_db) < 1.0
    assert median_db(disturbed, removal.background) < median_db(disturbed) - 10


def test_coupling_left_at_the_delay_of_a_circled_target_is_flagged():
    removal = coupled(recorded(circle(), CENTRE), 60).decided()
    assert removal.background is not None
    assert "background" in removal.flags


def test_configured_method_removes_a_circled_target_with_a_flag():
    recording = recorded(circle(), CENTRE)
    removal = recording.decided("median")
    lost_db = 20 * np.log10(np.abs(recording.image(CENTRE, removal.background) / recording.image(CENTRE))[0])
    assert lost_db < -20
    assert f"{-removal.loss_db:.1f} dB" in removal.flags["background_loss"]


def test_coupling_is_kept_and_flagged_if_every_target_would_be_lost():
    """The platform hovers, with 5 cm of track."""
    removal = coupled(recorded(straight(length_m=0.05)), 10).decided()
    assert removal.background is None
    assert removal.loss_db < -10
    assert "background" in removal.flags


@pytest.mark.slow
def test_drifting_coupling_is_removed_by_a_running_median():
    clean = recorded(straight(1600, 60.0))
    drifting = coupled(clean, 40, drift=6.0)
    removal = drifting.decided()
    assert removal.value.startswith("running median of ")
    assert np.abs(peaks_db(drifting, removal.background) - peaks_db(clean)).max() < 1.0
    median = drifting.means.background("median")
    assert np.abs(peaks_db(drifting, median) - peaks_db(clean)).max() > 1.0


def test_bursts_in_a_tenth_of_the_pulses_do_not_change_the_median():
    recording = coupled(recorded(straight()), 20)
    burst = recording.transfer.copy()
    burst[100:140] += 1000
    values = [
        GroupMeans.of(lambda pulses, transfer=transfer: transfer[pulses], recording.time_s).background("median").values
        for transfer in (recording.transfer, burst)
    ]
    assert np.abs(values[1] - values[0]).max() < 1.0


@pytest.fixture(scope="module")
def leaking(tmp_path_factory):
    """Process campaigns with coupling 40 dB above the echoes at the delay of the scene, with and without removal."""
    plan = replace(preset("demo", pulses=150), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    leaks = Leakage(level_db=40.0, path_m=20.0)
    nodes = {
        name: replace(node, impairments=replace(node.impairments, leakage=leaks)) for name, node in plan.nodes.items()
    }
    folder = tmp_path_factory.mktemp("leaking")
    simulate(folder / "auto", replace(plan, nodes=nodes), seed=7)
    state(copy_writable(folder / "auto", folder / "none"), "processing", background="none")
    for name in ("auto", "none"):
        process(folder / name)
    return {name: Campaign.load(folder / name) for name in ("auto", "none")}


@pytest.mark.slow
@pytest.mark.parametrize("pair", ["uav1-uav1", "uav1-uav2"])
def test_image_of_a_campaign_is_formed_without_the_background(leaking, pair):
    """Profiles, certificate and reports use the same transfer functions, and the image contains no coupling."""
    images = {name: open_stage(campaign.stage("image", "f01", pair), "image") for name, campaign in leaking.items()}
    quality = images["auto"].attrs["quality"]
    assert quality["background"]["removed"] == "median"
    assert quality["numerical_error_db"] <= -40
    assert any(line["cause"] == "background removal" for line in quality["budget"])
    powers = {name: float(np.nanmedian(np.abs(stage.image.values) ** 2)) for name, stage in images.items()}
    assert 10 * np.log10(powers["none"] / powers["auto"]) > 3
    assert "background" not in images["none"].attrs["flags"]
    echo = ap.open_campaign(leaking["auto"].root).stage("echo", "f01", pair)
    raw = ap.open_campaign(leaking["none"].root).stage("echo", "f01", pair)
    assert float(np.abs(echo.transfer).mean()) < 0.5 * float(np.abs(raw.transfer).mean())


@pytest.mark.slow
def test_reflector_of_a_real_flight_is_the_highest_peak_at_its_survey_point(shared, tmp_path):
    root = tmp_path / "uav_flight"
    shutil.copytree(ROOT / "examples" / "uav_flight", root)
    (root / "raw" / "f01").mkdir(parents=True)
    for name in ("radar.out", "radar.track.csv"):
        shutil.copyfile(shared / "bwsi_uav_flight" / name, root / "raw" / "f01" / name)
    process(root)
    stage = open_stage(Campaign.load(root).stage("image", "f01", "radar-radar"), "image")
    power = np.abs(stage.image.values) ** 2
    row, column = np.unravel_index(np.nanargmax(power), power.shape)
    assert np.hypot(stage.x[column] - 1.7929, stage.y[row] - 1.81) < 0.015
    assert 10 * np.log10(power[row, column] / np.nanmedian(power)) > 27
    assert stage.attrs["quality"]["background"]["removed"].startswith("running median of ")
    assert "background_loss" in stage.attrs["flags"]


def test_each_capture_is_checked_for_saturation_once(finished_tiny, tmp_path, monkeypatch):
    """Captures that were read for the decisions are not counted again in the flags of the profiles."""
    campaign = Campaign.load(copy_writable(finished_tiny.root, tmp_path / "campaign"))
    pulses = open_stage(campaign.stage("echo", "f01", "uav1-uav1"), "echo").sizes["pulse"]
    counts, count = Counter(), Saturation.count

    def counted(saturation, iq):
        counts[id(saturation)] += len(iq["radar"])
        count(saturation, iq)

    monkeypatch.setattr(Saturation, "count", counted)
    profile.profile(campaign, "f01", "uav1-uav1")
    assert len(counts) == 2
    assert min(counts.values()) == pulses
