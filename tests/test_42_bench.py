"""Bench measurement of a radar: a correct set-up raises no flag, and each defect raises its own flag."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench_setups import FLIGHT, RADAR_M, RECEIVED, RIGHT, SIDELINK_M, SPOILT, Setup, cabled, carrying
from folders import edit_config

import apertura as ap
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.check import problems
from apertura.cli import main
from apertura.common.errors import CampaignError
from apertura.common.flag_table import FLAGS
from apertura.core.echo.demodulate import Numerology
from apertura.core.geometry.aperture import Aperture
from apertura.core.planning.plan import no_aperture
from apertura.methods.bench.channels import measure_channel
from apertura.methods.bench.links import measure_link
from apertura.simulation import Impairments, preset
from apertura.simulation.campaign import write_campaign
from apertura.simulation.targets import Waypoints
from apertura.stages import echo, ingest
from apertura.tools.bench.measurement import Bench, measure_bench
from apertura.tools.bench.report import PAGE, PICTURE, REPORT, print_bench

QUICK = ("reference unlocked", "sidelink leaks", "I and Q swapped", "cable warms up", "split unequal")


def measured(setup: Setup, folder: Path, seed: int = 3) -> Bench:
    return measure_bench(Campaign.load(setup.write(folder, seed)), FLIGHT)


def with_snr(snr_db: float) -> Setup:
    """Return a correct set-up with noise in the radar channels that gives an SNR of the compressed pulses."""
    per_subcarrier_db = snr_db - 10 * np.log10(512)
    own = Impairments(radar_snr_db=per_subcarrier_db)
    return replace(RIGHT, specification=cabled(own, replace(RECEIVED, radar_snr_db=per_subcarrier_db)))


@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SPOILT if name not in QUICK)]
)
def test_defective_set_up_raises_its_flag(name: str, tmp_path):
    bench = measured(SPOILT[name], tmp_path / "bench")
    assert SPOILT[name].flags & bench.flags.keys(), dict(bench.flags)
    assert any(set(line.flags) & SPOILT[name].flags for line in bench.lines)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 21))])
def test_correct_set_up_raises_no_flag(seed: int, tmp_path):
    snr_db = float(np.random.default_rng(seed).uniform(18.5, 45.0))
    assert not measured(with_snr(snr_db), tmp_path / "bench", seed).flags


@pytest.mark.quick("18.5-0.986")
@pytest.mark.parametrize(("snr_db", "printed"), [(18.5, 0.986), (33.0, 0.9995), (40.0, 0.9999)])
def test_coherence_over_a_cable_is_limited_by_its_snr(snr_db: float, printed: float, tmp_path):
    """Γ of both pairs equals the three printed values of the paper within 4σ and rounding."""
    for node in measured(with_snr(snr_db), tmp_path / "bench").nodes:
        digit = 10.0 ** -len(str(printed).partition(".")[2])
        assert abs(node.link.coherence - printed) < 4 * node.link.coherence_std + digit / 2
        assert abs(10 * np.log10(node.link.snr) - snr_db) < 0.3
        assert node.coherence_before is None or node.coherence_before < 0.05  # random phases: 1/M


def test_paths_of_cables_are_measured(tmp_path):
    offsets = measured(RIGHT, tmp_path / "bench").offsets
    for node, true_m in (("uav1", 0.0), ("uav2", 0.911)):
        assert abs(offsets[node].offset_m - true_m) < max(4 * offsets[node].std_m, 2e-3)  # 2 mm: phase error of 3°


@pytest.mark.parametrize(("stuck", "shift", "bits"), [(0, 0, ()), (0, 2, ()), (16, 0, (4,)), (16, 2, (6,)), (1, 0, ())])
def test_stuck_bit_is_distinguished_from_shifted_samples(stuck: int, shift: int, bits: tuple[int, ...]):
    numerology = Numerology(1.2e9, 64e6, np.arange(32), prefix_samples=16, dft_samples=64)
    iq = np.random.default_rng(1).normal(scale=300, size=(20, 80, 2)).astype(np.int16)
    assert measure_channel("radar", [(iq | stuck) << shift], numerology).stuck == bits


def test_unknown_symbols_measure_the_same_links_as_known_ones(tmp_path):
    """Links by 16-QAM symbols decided from the sidelink equal those by the true symbols; no flag is raised."""
    root = carrying(RIGHT).write(tmp_path / "bench", 3)
    edit_config(root, lambda config: config.update(processing={"sidelink": "two_parameter"}))
    decided = measure_bench(Campaign.load(root), FLIGHT)
    edit_config(root, lambda config: config["waveform"].update(codes="symbols.npy"))
    known = measure_bench(Campaign.load(root), FLIGHT)
    assert decided.flags == {}
    for node, by_table in zip(decided.nodes, known.nodes, strict=True):
        assert node.symbols.startswith("16qam of the sidelink of uav2, SNR 30.0 dB")
        assert node.link.path_m == pytest.approx(by_table.link.path_m, abs=1e-5)
        assert node.link.snr == pytest.approx(by_table.link.snr, rel=1e-3)
        assert node.link.coherence == pytest.approx(by_table.link.coherence, abs=1e-6)
        assert node.coherence_before == pytest.approx(by_table.coherence_before, abs=1e-4)


def test_ambiguous_symbols_measure_the_links_of_receivers_only(tmp_path):
    """Without header and pilots, the path relative to the sidelink is right, and the own link is not measured."""
    root = carrying(RIGHT).write(tmp_path / "bench", 3)
    edit_config(root, lambda config: config["waveform"]["codes"].pop("frame"))
    bench = measure_bench(Campaign.load(root), FLIGHT)
    own, other = bench.nodes
    assert (own.link, other.coherence_before) == (None, None)
    assert "ambiguous by quarter turns" in own.symbols
    assert bench.flags.keys() == {"symbols_unsure"}
    assert next(line.measured for line in bench.lines if line.what == "path") == "not measured"
    assert abs(bench.offsets["uav2"].offset_m - 0.911) < max(4 * bench.offsets["uav2"].std_m, 2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "others"),
    [
        ("another transmitter", set()),
        ("reference unlocked", set()),
        ("sidelink contact loose", {"symbols_unsure", "sidelink_lost"}),
        ("transmitter's phase wanders", set()),
        ("triggers missed", set()),
    ],
)
def test_defects_raise_their_flag_with_unknown_symbols(name: str, others: set[str], tmp_path):
    """Deciding the symbols does not hide a defect, and pulses that a node did not record are not unsure ones."""
    bench = measured(carrying(SPOILT[name]), tmp_path / "bench")
    assert SPOILT[name].flags & bench.flags.keys(), dict(bench.flags)
    assert bench.flags.keys() <= SPOILT[name].flags | others, dict(bench.flags)
    assert all(node.link for node in bench.nodes)


@pytest.mark.slow
@pytest.mark.parametrize("carrier_is", ["band_start", "band_centre"])
def test_inverted_spectrum_of_unknown_symbols_is_found(carrier_is, tmp_path):
    """The conjugate of a band around the carrier is a band of QAM symbols too: only its header differs."""
    swapped = carrying(SPOILT["I and Q swapped"])
    waveform = replace(swapped.specification.waveform, carrier_is=carrier_is)
    bench = measured(
        replace(swapped, specification=replace(swapped.specification, waveform=waveform)), tmp_path / "bench"
    )
    assert bench.flags.keys() == {"spectrum_inverted"}
    assert abs(bench.offsets["uav2"].offset_m - 0.911) < max(4 * bench.offsets["uav2"].std_m, 2e-3)


def test_white_phase_noise_has_the_allan_deviation_of_its_snr():
    rng, pulses = np.random.default_rng(2), 4000
    numerology = Numerology(1.2e9, 64e6, np.arange(32), prefix_samples=16, dft_samples=64)
    noise = 0.3 * (rng.normal(size=(pulses, 32)) + 1j * rng.normal(size=(pulses, 32)))
    echo = (1 + noise).astype(np.complex64)
    link = measure_link("a", lambda pulse: echo[pulse], 0.1 * np.arange(pulses), numerology, divided=False)
    white = np.sqrt(3) * link.noise_rad / (2 * np.pi * link.frequency_hz)
    for averaged_s, deviation in link.deviation(0.1)[:4]:
        assert deviation == pytest.approx(white / averaged_s, rel=0.1)


@pytest.mark.slow
def test_bench_needs_no_log_and_forms_no_image(tmp_path, capsys, monkeypatch):
    campaign = Campaign.load(SPOILT["cable warms up"].write(tmp_path / "bench", 1))
    assert not problems(campaign.root)
    monkeypatch.setattr("sys.argv", ["apertura", "bench", str(campaign.root)])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert FLAGS["link_drifts"].advice in capsys.readouterr().out
    names = sorted(path.name for path in campaign.result(FLIGHT).iterdir())
    assert names == sorted([REPORT, PAGE, PICTURE, "bench.manifest.json"])
    with pytest.raises(CampaignError, match="a flight of kind image"):
        campaign.check_images()


def test_common_signal_of_two_channels_agrees_despite_noise(tmp_path):
    """In 20 pulses at 18.5 dB, noise scatters phases over the band by 0.3 rad or more, which is not a disagreement."""
    noisy = with_snr(18.5)
    short = replace(
        noisy, specification=replace(noisy.specification, flights=(replace(noisy.specification.flights[0], pulses=20),))
    )
    root = short.write(tmp_path / "bench", 2)
    edit_config(root, lambda config: config["bench"].update(split=True))
    assert not measure_bench(Campaign.load(root), FLIGHT).flags


@pytest.mark.slow
def test_path_of_a_flagged_link_is_not_written_to_the_config(tmp_path, capsys):
    root = SPOILT["clocks of the two channels apart"].write(tmp_path / "bench", 1)
    edit_config(root, lambda config: config["nodes"]["uav2"]["path_offset_m"].update(radar=0.5))
    before = (root / "config/config.yaml").read_text()
    print_bench(Campaign.load(root), write=True)
    assert "nodes.uav2.path_offset_m: not determined; flags of the link: link_incoherent" in capsys.readouterr().out
    assert (root / "config/config.yaml").read_text() == before


@pytest.mark.slow
def test_only_measured_paths_are_written_to_the_config(tmp_path):
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
    assert "path_offset_disagrees" not in measure_bench(Campaign.load(root), FLIGHT).flags


# Images need an aperture


def test_stationary_radar_is_refused_as_an_image_flight(tmp_path):
    specification = cabled()
    flight = replace(specification.flights[0], kind="image")
    root = write_campaign(tmp_path / "c", replace(specification, flights=(flight,)), np.random.default_rng(1))
    (first, *_) = [problem for problem in problems(root) if "bench" in str(problem)]
    assert "no aperture, because the nodes moved by only 0 cm" in str(first)


@pytest.mark.parametrize(("length_m", "flagged"), [(0.3, True), (2.0, False)])
def test_aperture_too_short_for_its_scene_is_flagged(length_m: float, flagged: bool):
    """The resolution λR/2L at 10 m range in a scene of 6 m is 4.2 m for a track of 0.3 m, and 0.6 m for 2 m."""
    track = np.stack([np.linspace(0, length_m, 50) - length_m / 2, np.full(50, -10.0), np.full(50, 1.0)], -1)
    ground = np.stack(np.meshgrid(np.linspace(-3, 3, 5), np.linspace(3, -3, 5), indexing="xy"), -1)
    ground = np.concatenate([ground, np.zeros((5, 5, 1))], -1)
    aperture, wavelength = Aperture(track, track), 0.25
    assert aperture.cross_cell_m(ground, wavelength_m=wavelength) == pytest.approx(
        wavelength * 10.1 / (2 * length_m), rel=0.05
    )
    assert bool(no_aperture(aperture, ground, wavelength_m=wavelength)) is flagged


@pytest.mark.slow
def test_hover_is_excluded_unless_segments_are_configured(tmp_path):
    plan = preset("demo", pulses=400)
    times = (-2.0, 5.0, 15.0, 22.0)
    tracks = {
        name: Waypoints(times, tuple((north / 2 + x, -11.0, 4.8) for north in (-7.0, 0.0, 0.0, 7.0)))
        for name, x in (("uav1", 0.0), ("uav2", 4.7))
    }
    root = write_campaign(
        tmp_path / "c", replace(plan, flights=(replace(plan.flights[0], tracks=tracks),)), np.random.default_rng(1)
    )
    campaign = Campaign.load(root)
    for node in tracks:
        ingest.ingest(campaign, "f01", node)
    quality = open_stage(echo.echo(campaign, "f01", "uav1-uav2"), "echo").attrs
    assert 100 < quality["pulses"]["reasons"]["hover"] < 240
    assert "platform stationary" in quality["flags"]["hover"]
    segments = "flight\tpair\tstart\tend\nf01\tuav1-uav2\t2025-05-14T09:30:00\t2025-05-14T09:31:00\n"
    (root / "config/segments.tsv").write_text(segments)
    quality = open_stage(echo.echo(Campaign.load(root), "f01", "uav1-uav2"), "echo").attrs
    assert "hover" not in quality["flags"]


@pytest.mark.slow
def test_image_without_aperture_is_inconclusive_about_focus():
    """With stationary antennas, the echo resolves only range, and no_aperture is the only flag that concerns focus."""
    frequency, still = 1.2e9 + 1e6 * np.arange(128), np.tile([0.0, -20.0, 10.0], (64, 1))
    aperture, grid = Aperture(still, still), ap.SceneGrid("local", -5.0, 5.0, 0.1, (100, 100))
    echo = np.exp(-2j * np.pi * frequency * aperture.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    image = ap.backproject(ap.PhaseHistory(echo, frequency, np.full(128, 1 / 128), np.zeros(64), aperture), grid)
    focus = ap.judge(image)
    assert focus.verdict == "inconclusive"
    assert focus.reason.startswith("no aperture: the antennas moved by 0 m, which yields no resolution")
    assert "no_aperture" in image.attrs["flags"]
    assert not focus.flags.keys() & {"defocused", "echo_outside_scene"}


@pytest.mark.slow
def test_line_of_data_symbols_counts_the_recorded_pulses(tmp_path):
    """Pulses that the receiver did not record carry no symbols: before, "286 of 295" was within "all pulses"."""
    bench = measured(carrying(SPOILT["triggers missed"]), tmp_path / "bench")
    lines = [line for line in bench.lines if line.what == "data symbols"]
    assert {line.limit for line in lines} == {"decided in all recorded pulses"}
    for line in lines:
        decided, recorded = re.search(r"decided in (\d+) of (\d+) pulses recorded by uav2", line.measured).groups()
        assert (decided == recorded) == (line.flags == ())
    missed = next(node for node in bench.nodes if node.name == "uav1").triggers
    assert int(recorded) <= missed.recorded


@pytest.mark.slow
def test_wrong_header_of_data_symbols_is_flagged_on_the_bench(tmp_path):
    """The links are right, but the frames are not those of the config."""
    root = carrying(RIGHT).write(tmp_path / "bench", 3)
    edit_config(root, lambda config: config["waveform"]["codes"]["frame"].update(header="1acffc1e"))
    bench = measure_bench(Campaign.load(root), FLIGHT)
    assert bench.flags.keys() == {"header_differs"}
    assert all("header_differs" in line.flags for line in bench.lines if line.what == "data symbols")
