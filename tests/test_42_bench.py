"""A radar on the bench: a right set-up carries no flag, every spoilt one the flag of what is wrong with it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench_setups import FLIGHT, RADAR_M, RECEIVED, RIGHT, SIDELINK_M, SPOILT, Setup, cabled
from folders import edit_config

from apertura.common.errors import CampaignError
from apertura.common.flag_table import FLAGS
from apertura.methods.synchronisation.bench import measure_link
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.check import problems
from apertura.pipeline.opening.bench import Bench, measure_bench
from apertura.simulation import Impairments
from apertura.views.report.bench import PAGE, PICTURE, REPORT, print_bench

QUICK = ("reference unlocked", "sidelink leaks", "I and Q swapped", "cable warms up", "split unequal")


def measured(setup: Setup, folder: Path, seed: int = 3) -> Bench:
    return measure_bench(Campaign.load(setup.write(folder, seed)), FLIGHT)


def of(snr_db: float) -> Setup:
    """Return a right set-up whose compressed pulses have a signal to noise ratio, by noise of the radar channels."""
    per_subcarrier_db = snr_db - 10 * np.log10(512)
    own = Impairments(radar_snr_db=per_subcarrier_db)
    return replace(RIGHT, specification=cabled(own, replace(RECEIVED, radar_snr_db=per_subcarrier_db)))


@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in {*SPOILT} - {*QUICK})]
)
def test_a_spoilt_set_up_is_named(name: str, tmp_path):
    bench = measured(SPOILT[name], tmp_path / "bench")
    assert SPOILT[name].flags & bench.flags.keys(), dict(bench.flags)
    assert any(set(line.flags) & SPOILT[name].flags for line in bench.lines)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 21))])
def test_a_right_set_up_is_never_flagged(seed: int, tmp_path):
    snr_db = float(np.random.default_rng(seed).uniform(18.5, 45.0))
    assert not measured(of(snr_db), tmp_path / "bench", seed).flags


@pytest.mark.parametrize(("snr_db", "printed"), [(18.5, 0.986), (33.0, 0.9995), (40.0, 0.9999)])
def test_coherence_over_a_cable_is_what_its_snr_allows(snr_db: float, printed: float, tmp_path):
    """Γ of both pairs as the source paper prints it for its three recordings, within what chance and print leave."""
    for node in measured(of(snr_db), tmp_path / "bench").nodes:
        digit = 10.0 ** -len(str(printed).partition(".")[2])
        assert abs(node.link.coherence - printed) < 4 * node.link.coherence_std + digit / 2
        assert abs(10 * np.log10(node.link.snr) - snr_db) < 0.3
        assert node.coherence_before is None or node.coherence_before < 0.05  # random phases: 1/M


def test_paths_of_cables_are_measured(tmp_path):
    offsets = measured(RIGHT, tmp_path / "bench").offsets
    for node, true_m in (("uav1", 0.0), ("uav2", 0.911)):
        assert abs(offsets[node].offset_m - true_m) < max(4 * offsets[node].std_m, 2e-3)  # 1/25 of a count of phase


def test_white_phase_noise_has_the_allan_deviation_of_its_snr():
    rng, pulses = np.random.default_rng(2), 4000
    from apertura.core.echo.demodulate import Numerology

    numerology = Numerology(1.2e9, 64e6, np.arange(32), prefix_samples=16, dft_samples=64)
    noise = 0.3 * (rng.normal(size=(pulses, 32)) + 1j * rng.normal(size=(pulses, 32)))
    echo = (1 + noise).astype(np.complex64)
    link = measure_link("a", lambda some: echo[some], 0.1 * np.arange(pulses), numerology, divided=False)
    white = np.sqrt(3) * link.noise_rad / (2 * np.pi * link.frequency_hz)
    for averaged_s, deviation in link.deviation(0.1)[:4]:
        assert deviation == pytest.approx(white / averaged_s, rel=0.1)


def test_a_bench_needs_no_log_and_makes_no_image(tmp_path, capsys):
    campaign = Campaign.load(SPOILT["cable warms up"].write(tmp_path / "bench", 1))
    assert not problems(campaign.root)
    assert print_bench(campaign) > 0
    assert FLAGS["link_drifts"].look in capsys.readouterr().out
    made = sorted(path.name for path in campaign.result(FLIGHT).iterdir())
    assert made == sorted([REPORT, PAGE, PICTURE, "bench.manifest.json"])
    with pytest.raises(CampaignError, match="a flight of kind image"):
        campaign.check_images()


def test_measured_paths_go_into_the_config_and_nothing_else_changes(tmp_path):
    root = RIGHT.write(tmp_path / "bench", 1)
    edit_config(root, lambda config: config["nodes"]["uav2"]["path_offset_m"].update(radar=0.5))
    path = root / "config" / "config.yaml"
    path.write_text("# mine\n" + path.read_text())
    before = path.read_text().splitlines()
    print_bench(Campaign.load(root), write=True)
    after = path.read_text().splitlines()
    changed = [(old, new) for old, new in zip(before, after, strict=True) if old != new]
    assert len(changed) == 1
    assert changed[0][0].strip() == "radar: 0.5"
    assert float(changed[0][1].partition(": ")[2]) == pytest.approx(0.911, abs=2e-3)
    assert (RADAR_M, SIDELINK_M) == (10.0, 5.0)
    assert "path_disagrees" not in measure_bench(Campaign.load(root), FLIGHT).flags
