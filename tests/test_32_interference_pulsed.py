"""Interference of single pulses, in some subcarriers or the whole band, and of the sidelink."""

from dataclasses import replace

import numpy as np
import pytest
from folders import image_of, state
from test_32_interference import FREQUENCY, WEIGHT, noise_floor_db, profiles, received

from apertura.campaign.store import open_stage
from apertura.core.echo.captures import sampled_pulses
from apertura.core.echo.interference import Interference, NoisyPulses, PulsedInterference, SidelinkInterference, limited
from apertura.run.process import process
from apertura.simulation import ImageGrid, preset, simulate
from apertura.simulation.impairments import Adc, Interferer
from apertura.stages.transfer import PairEcho

PULSES = 2000


def groups_of(transfer):
    return [transfer[group] for group in sampled_pulses(len(transfer))]


def pulsed_in(transfer):
    return PulsedInterference.measured(groups_of(transfer), FREQUENCY, WEIGHT)


def with_pulsed(level_db, *, every=5, lines=3, moving=False, noise=1.0, seed=2):
    """Return echoes and noise, and in every n-th pulse adjacent subcarriers at a level relative to one echo."""
    rng = np.random.default_rng(seed)
    transfer = received(pulses=PULSES, noise=noise)
    for pulse in range(0, PULSES, every):
        first = rng.integers(100, 400) if moving else min(300, 512 - lines)
        phase = np.exp(2j * np.pi * rng.random(lines))
        transfer[pulse, first : first + lines] += 10 ** (level_db / 20) * phase * np.sqrt(512 / lines)
    return transfer


@pytest.mark.quick("False-20", "True-0")
@pytest.mark.parametrize("level_db", [0, 20, 40])
@pytest.mark.parametrize("moving", [False, True])
def test_pulsed_interference_is_removed_from_the_pulses_that_contain_it(level_db, moving):
    clean, disturbed = received(pulses=PULSES), with_pulsed(level_db, moving=moving)
    found = pulsed_in(disturbed)
    assert found.report["pulses_share"] == pytest.approx(0.2, abs=0.02)
    assert noise_floor_db(found.removed(disturbed)) == pytest.approx(noise_floor_db(clean), abs=0.1)
    untouched = np.arange(PULSES) % 5 != 0
    changed = (found.removed(disturbed) != disturbed).any(axis=1)
    assert changed[untouched].mean() < 1e-3
    assert changed[~untouched].mean() > 0.99


def test_frequency_and_service_of_pulsed_interference_are_reported():
    found = pulsed_in(with_pulsed(20))
    assert 1e-6 * FREQUENCY[300] - 0.1 < 1e-6 * found.report["frequency_hz"] < 1e-6 * FREQUENCY[302] + 0.1
    assert "GNSS" in found.flags["interference_pulsed"]


def test_gain_of_the_exclusion_is_the_ratio_of_powers_over_all_ranges():
    disturbed = with_pulsed(20)
    found = pulsed_in(disturbed)
    both = disturbed, found.removed(disturbed)
    power = [(np.abs(np.fft.ifft(WEIGHT * transfer, axis=1)) ** 2).mean() for transfer in both]
    assert found.report["gain_db"] == pytest.approx(10 * np.log10(power[0] / power[1]), abs=0.3)


@pytest.mark.parametrize("moving", [False, True])
def test_interference_of_single_pulses_excludes_no_subcarrier_from_all_pulses(moving):
    found = Interference.measured(groups_of(with_pulsed(40, moving=moving)), FREQUENCY, WEIGHT)
    assert not found.excluded.any()
    assert found.flags == {}


@pytest.mark.quick("0-*")
@pytest.mark.parametrize("noise", [0.0, 0.05, 1.0, 10.0])
@pytest.mark.parametrize("seed", range(3))
def test_recordings_without_interference_are_unchanged(noise, seed):
    transfer = received(pulses=PULSES, noise=noise, seed=seed)
    assert pulsed_in(transfer) is None
    assert not bursts_in(transfer).excluded.any()
    assert bursts_in(transfer).flags == {}


def flash(transfer, *, gain_db, width):
    """Return transfer functions with a bright point that is visible in some pulses only."""
    pulses = np.arange(len(transfer))
    visible = np.exp(-(((pulses - len(pulses) / 2) / width) ** 2)) * 10 ** (gain_db / 20)
    return transfer + (visible[:, None] * np.exp(-2j * np.pi * FREQUENCY * 80 / 299792458.0)).astype(np.complex64)


@pytest.mark.quick("20-3", "40-0.5")
@pytest.mark.parametrize("width", [0.5, 3, 40])
@pytest.mark.parametrize("gain_db", [20, 40])
def test_flash_of_a_bright_point_is_not_interference(width, gain_db):
    clean = received(pulses=PULSES)
    bright = flash(clean, gain_db=gain_db, width=width)
    found = PulsedInterference.measured([bright], FREQUENCY, WEIGHT)
    assert found is None
    assert not PulsedInterference(np.median(np.abs(bright) ** 2, axis=0), WEIGHT).hits(bright)[900:1100].mean() > 1e-4
    assert not bursts_in(bright).excluded.any()


def test_interference_in_most_of_the_band_is_left_to_the_exclusion_of_pulses():
    transfer = with_pulsed(20, every=5, lines=400)
    found = PulsedInterference(np.median(np.abs(received()) ** 2, axis=0), WEIGHT)
    assert found.hits(transfer[:1]).sum() == 0


def with_bursts(level_db, *, every=50, seed=3):
    """Return echoes and noise, and in every n-th pulse noise over the whole band, relative to the noise."""
    rng = np.random.default_rng(seed)
    transfer = received(pulses=PULSES)
    burst = rng.normal(size=(len(transfer[::every]), 512, 2)) @ np.array([1, 1j]) / np.sqrt(2)
    transfer[::every] += 10 ** (level_db / 20) * burst.astype(np.complex64)
    return transfer


def bursts_in(transfer):
    """Return the noise of pulses, from the ranges without targets."""
    bursts = NoisyPulses()
    for first in range(0, len(transfer), 100):
        block = transfer[first : first + 100]
        bursts.add(block, profiles(block)[:, 100:])
    return bursts


@pytest.mark.parametrize("level_db", [10, 20, 40])
def test_pulses_with_interference_in_the_whole_band_are_excluded(level_db):
    bursts = bursts_in(with_bursts(level_db))
    assert np.flatnonzero(bursts.excluded).tolist() == list(range(0, PULSES, 50))
    raised_db = 10 * np.log10((0.98 + 0.02 * (1 + 10 ** (level_db / 10))) * 0.98)
    assert bursts.gain_db == pytest.approx(raised_db, abs=0.4)
    assert bursts.flags["pulses_noisy"].startswith("40 of 2000 pulses")


@pytest.mark.slow
def test_radar_that_starts_to_move_has_no_noisy_pulses():
    """At rest, echoes are constant and removed with the background; they appear at all ranges when the radar moves."""
    rng = np.random.default_rng(6)
    paths_m = rng.uniform(30, 100, 200) + 0.004 * np.arange(600)[:, None] * rng.uniform(-1, 1, 200)
    echo = np.exp(-2j * np.pi * np.remainder(paths_m[..., None] / 299792458.0 * FREQUENCY[::8], 1.0)).sum(axis=1)
    moving = echo + 0.1 * (rng.normal(size=(600, 64, 2)) @ np.array([1, 1j]))
    moving[:100] -= echo[:100]
    bursts = NoisyPulses()
    for first in range(0, 600, 100):
        block = moving[first : first + 100].astype(np.complex64)
        bursts.add(block, np.fft.ifft(block, axis=1))
    assert not bursts.excluded.any()
    assert bursts.flags == {}


def test_weak_bursts_are_kept():
    bursts = bursts_in(with_bursts(0))
    assert not bursts.excluded.any()
    assert bursts.flags == {}


def test_too_many_bursts_are_stated_and_kept():
    rng = np.random.default_rng(4)
    transfer = received(pulses=PULSES)
    hit = rng.random(PULSES) < 0.4
    transfer[hit] *= 10
    bursts = bursts_in(transfer)
    assert not bursts.excluded.any()
    assert "too many" in bursts.flags["pulses_noisy"]


def test_pulses_that_do_not_contribute_are_neither_interference_nor_a_reference():
    bursts = NoisyPulses()
    bursts.skip(300)
    transfer = with_bursts(20)
    bursts.add(transfer, profiles(transfer)[:, 100:])
    assert np.flatnonzero(bursts.excluded).tolist() == [300 + pulse for pulse in range(0, PULSES, 50)]


def test_sidelink_without_interference_is_unchanged():
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(64, 512, 2)) @ np.array([1, 1j])
    direct = np.exp(-2j * np.pi * np.outer(rng.random(64), np.arange(512)))
    for snr_db in (10, 30):
        sidelink = (10 ** (snr_db / 20) * direct * (1 + 0.5 * direct**3) + noise).astype(np.complex64)
        assert limited(sidelink)[0] is sidelink


@pytest.mark.parametrize("level_db", [20, 40])
def test_tone_in_the_sidelink_is_limited_and_flagged(level_db):
    sidelink = np.ones((64, 512), np.complex64)
    sidelink[:, 40] *= 10 ** (level_db / 20)
    interference = SidelinkInterference(FREQUENCY)
    power = np.abs(interference.limit(sidelink)) ** 2
    assert power[:, 40] == pytest.approx(20.0)
    assert (np.delete(power, 40, axis=1) == 1).all()
    assert interference.flags["interference_sidelink"].startswith(f"100.0% of pulses, strongest at {1166.0:.2f} MHz")
    assert f"{level_db:.1f} dB above the median" in interference.flags["interference_sidelink"]


# ---- Campaigns ------------------------------------------------------------------------------------------------------

BURST = Interferer(1.4e9, 30.0, bandwidth_hz=1e9, duration_s=20e-6, rate_hz=2e3)
DME = Interferer(1.35e9, 30.0, duration_s=7e-6, rate_hz=10e3, envelope="hann")
TONE = Interferer(1.31e9, 20.0, channel="sidelink")
RADAR_TONE = Interferer(1.31e9, 20.0)


def campaign_with(root, *sources, setting="auto"):
    """Return a campaign of 80 pulses with interference, processed up to its images."""
    plan = replace(preset("demo", pulses=80), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    nodes = {
        name: replace(
            node,
            impairments=replace(
                node.impairments,
                adc=Adc(16, 50.0),
                interference=tuple(source for source in sources if name == "uav2" or source.channel == "radar"),
            ),
        )
        for name, node in plan.nodes.items()
    }
    simulate(root, replace(plan, nodes=nodes), seed=7)
    state(root, "processing", interference=setting, autofocus="off")
    return process(root, last="cube")


def attributes(campaign, pair):
    """Return flags and report of interference of an image."""
    image, profile = (open_stage(campaign.stage(name, "f01", pair), name) for name in ("image", "profile"))
    return image.attrs["flags"], profile.attrs["interference"]


def difference_db(campaign, reference, pair):
    """Return the mean power of the difference of two images, dB relative to the peak."""
    image, clean = image_of(campaign, pair), image_of(reference, pair)
    return 10 * np.log10(np.nanmean(np.abs(image - clean) ** 2) / np.nanmax(np.abs(clean) ** 2))


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return campaign_with(tmp_path_factory.mktemp("clean") / "campaign")


@pytest.mark.slow
def test_clean_campaign_has_no_flag_of_interference(clean):
    for pair in ("uav1-uav1", "uav1-uav2"):
        flags, report = attributes(clean, pair)
        assert report == {"subcarriers": 0}
        assert not [flag for flag in flags if flag.startswith("interference")]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "flag"), [(BURST, "pulses_noisy"), (DME, "interference_pulsed"), (RADAR_TONE, "interference")]
)
def test_interference_of_a_campaign_is_flagged_and_removed(clean, source, flag, tmp_path):
    unchanged = campaign_with(tmp_path / "unchanged", source, setting="none")
    cleaned = campaign_with(tmp_path / "cleaned", source)
    for pair in ("uav1-uav1", "uav1-uav2"):
        assert flag in attributes(cleaned, pair)[0]
        assert flag not in attributes(unchanged, pair)[0]
        recorded, reference = (PairEcho.opened(of, "f01", pair) for of in (unchanged, clean))
        used = PairEcho.cleaned(cleaned, "f01", pair)
        same = np.isin(reference.dataset.time.values, used.dataset.time.values)
        wanted = reference.read(np.arange(reference.shape[0]))
        added = (np.abs(recorded.read(np.arange(recorded.shape[0])) - wanted) ** 2).mean()
        left = (np.abs(used.read(np.arange(used.shape[0])) - wanted[same]) ** 2).mean()
        assert left < 1e-3 * added
        assert left < 0.01 * (np.abs(wanted) ** 2).mean()
        assert difference_db(cleaned, clean, pair) < difference_db(unchanged, clean, pair) - 5


@pytest.mark.slow
def test_pulses_with_bursts_are_absent_from_all_later_stages(tmp_path):
    campaign = campaign_with(tmp_path / "campaign", BURST)
    for pair in ("uav1-uav1", "uav1-uav2"):
        recorded = open_stage(campaign.stage("echo", "f01", pair), "echo").sizes["pulse"]
        echo = PairEcho.cleaned(campaign, "f01", pair)
        bursts = attributes(campaign, pair)[1]["noisy_pulses"]
        assert recorded - bursts["pulses"] == echo.shape[0]
        assert echo.shape[0] == open_stage(campaign.stage("profile", "f01", pair), "profile").sizes["pulse"]
        noise = np.abs(np.diff(echo.read(np.arange(echo.shape[0])), axis=0)).mean(axis=1)
        assert noise.max() < 3 * np.median(noise)


@pytest.mark.slow
def test_tone_in_the_sidelink_changes_neither_focus_nor_peak(clean, tmp_path):
    campaign = campaign_with(tmp_path / "campaign", TONE)
    assert "1310" in attributes(campaign, "uav1-uav2")[0]["interference_sidelink"]
    assert difference_db(campaign, clean, "uav1-uav2") < -50
