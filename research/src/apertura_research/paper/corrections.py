"""What the corrections reach: by the sidelink, of clocks, of positions, and for a swarm of receivers."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.captures import correct_clock
from apertura.core.echo.clock import estimate_clock
from apertura.core.echo.demodulate import Numerology
from apertura.core.echo.sidelink import METHODS, divide
from apertura.core.geometry.aperture import Aperture
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.steps.ingest import ingest
from apertura.pipeline.store import open_stage
from apertura.simulation import preset, simulate
from apertura.simulation.impairments import Clock, Impairments, Localization, Timing, UniformPhase
from apertura.simulation.observation import observe
from apertura.simulation.presets import paper_waveform
from apertura.simulation.synthesis import samples, straight_pair, transfer_functions
from apertura_research.paper.claims import Claim, compare, require
from apertura_research.paper.losses import ERRORS, peak_losses_db
from apertura_research.paper_scene import (
    RX_AHEAD_M,
    UNDISTURBED,
    Disturbance,
    PaperScene,
    demodulated,
    receive_pair,
    reduced_scene,
)
from apertura_research.point_response import (
    amplitude_db,
    error_floor_db,
    find_peaks,
    mean_image,
    phase_history,
    random_pixels,
    range_tables,
)
from apertura_research.stability.sweeps import ORDINARY

CLOCK_PPM = 8.0
LARGEST_EXCESS_DB = 1.0
LARGEST_LOSS_DB = 0.01


def corrected_claims(*, seed: int = 1) -> list[Claim]:
    """Return what carrier phase and timing cost after each sidelink correction, as large as the prefix allows."""
    scene = reduced_scene(pulses=150, subcarriers=4096, rx_ahead_m=RX_AHEAD_M, qpsk=True)
    clocks = Impairments(carrier_phase=UniformPhase(), timing=Timing(half_width_s=2e-6))
    disturbed = Disturbance(clocks, sampled=True)
    clean, direct, _ = receive_pair(scene, UNDISTURBED, np.random.default_rng(seed))
    radar, sidelink, _ = receive_pair(scene, disturbed, np.random.default_rng(seed))
    ideal = _peaks(scene, divide(clean, direct))
    rows = []
    for name, correct in METHODS.items():
        worst_db = float(np.abs(amplitude_db(_peaks(scene, correct(radar, sidelink)) / ideal)).max())
        title = f"loss after {name}: carrier phase ±π and timing ±2 µs per pulse, inside the prefix"
        limit, met = f"below {LARGEST_LOSS_DB:g} dB", worst_db < LARGEST_LOSS_DB
        note = "worst of five targets, from samples"
        rows.append(require(title, worst_db, "dB", limit=limit, met=met, style=".4f", note=note))
    return rows


def _peaks(scene: PaperScene, corrected: Complexes) -> Floats:
    targets = scene.scatterers.position_m
    return find_peaks(range_tables(phase_history(scene, corrected, divided=True), targets), targets)[1]


def clock_claims(*, pulses: int = 150) -> list[Claim]:
    """Return the floor that a fast clock leaves in the divided image, without and with correction in the samples.

    Samples are noisy, 20 dB in the radar and 30 dB in the sidelink per subcarrier, so that the model which made them is
    not simply taken back: a perfect clock with the same noise is what the correction is held against.
    """
    scene = reduced_scene(pulses=pulses, subcarriers=4096, rx_ahead_m=RX_AHEAD_M, qpsk=True)
    wave = scene.waveform
    clock = Clock.of_ppm(CLOCK_PPM, carrier_hz=wave.carrier_hz, sample_rate_hz=wave.sample_rate_hz)
    captures = _captures(scene, replace(ORDINARY, clock=clock))
    symbol = Numerology(
        wave.carrier_hz,
        wave.sample_rate_hz,
        np.arange(len(wave.codes)),
        prefix_samples=wave.prefix_samples,
        dft_samples=wave.dft_samples,
    )
    offset = estimate_clock(captures[1], symbol)
    cfo_hz = offset.cfo_of_pulses_hz(pulses)
    corrected = [correct_clock(capture, symbol, cfo_hz=cfo_hz, sfo_ppm=offset.sfo_ppm) for capture in captures]
    ideal, _ = _image(scene, _captures(scene, Impairments()))
    images = (_image(scene, pair) for pair in (_captures(scene, ORDINARY), captures, corrected))
    perfect_db, before_db, after_db = (error_floor_db(values, ideal, peaks) for values, peaks in images)
    return [
        require(
            f"{CLOCK_PPM:g} ppm clock corrected in the samples: floor above that of a perfect clock, same noise",
            after_db - perfect_db,
            "dB",
            limit=f"at most {LARGEST_EXCESS_DB:g} dB",
            met=after_db - perfect_db <= LARGEST_EXCESS_DB,
            style=".2f",
            note=f"floor {before_db:.1f} dB without, {after_db:.1f} dB with, {perfect_db:.1f} dB with a perfect clock; "
            f"measured as {offset.sfo_ppm:.4f} ppm",
        )
    ]


def _captures(scene: PaperScene, receiver: Impairments) -> list[Complexes]:
    _, _, observed = receive_pair(scene, Disturbance(receiver), np.random.default_rng(0))
    names = ("radar", "sidelink")
    noise = dict(zip(names, (np.random.default_rng(number) for number in (1, 2)), strict=True))
    return [samples(observed.channels[name], noise[name]).astype(np.complex64) for name in names]


def _image(scene: PaperScene, captures: list[Complexes]) -> tuple[Complexes, Floats]:
    """Return the divided image at random pixels, and the peaks of the targets."""
    window = slice(scene.waveform.prefix_samples, scene.waveform.prefix_samples + scene.waveform.dft_samples)
    radar, sidelink = (demodulated(capture[:, window], scene.waveform) for capture in captures)
    targets = scene.scatterers.position_m
    tables = range_tables(phase_history(scene, divide(radar, sidelink), divided=True), targets)
    return mean_image(tables, random_pixels(np.random.default_rng(1))), find_peaks(tables, targets)[1]


PRINTED_CM = 2.0
DRAWS = 20
SIGMA_CM = 1.0
TOLERATED_DB = 1.0


def position_claims(*, draws: int = DRAWS, seed: int = 3) -> list[Claim]:
    """Return what λ/10 is and costs, what a bistatic pair needs against a monostatic one, and what cancels."""
    tenth_cm = 10 * SPEED_OF_LIGHT_M_S / float(paper_waveform().frequency_hz.mean())
    mono_db, bistatic_db = (_mean_db(loss, SIGMA_CM, draws, seed) for loss in (_monostatic_db, _bistatic_db))
    tenth_db = _mean_db(_monostatic_db, tenth_cm, draws, seed)
    largest_db = _mean_db(_monostatic_db, tenth_cm / 3, draws, seed)
    return [
        compare("positions must be known to λ/10", tenth_cm, "cm", paper=PRINTED_CM, within=0.5, relative=False,
                style=".3g", note="at the middle of the band; the requirement rows use δR = 2 cm one way"),
        require(f"loss at position errors of λ/10, {draws} draws", tenth_db, "dB",
                limit=f"at most {TOLERATED_DB:g} dB", met=tenth_db >= -TOLERATED_DB, style=".2f",
                note="λ/10 as standard deviation per axis, moving average of 1 s, monostatic: too much"),
        require(f"loss at position errors of λ/30 = (λ/10)/3, {draws} draws", largest_db, "dB",
                limit=f"at most {TOLERATED_DB:g} dB", met=largest_db >= -TOLERATED_DB, style=".2f",
                note="λ/10 taken as three standard deviations: as the largest error, it is enough"),
        compare(f"bistatic over monostatic loss at {SIGMA_CM:g} cm: the need is about equal", bistatic_db / mono_db,
                "1", independent_model=1.0, within=0.35, style=".2f",
                note=f"mono {mono_db:.2f} dB, bistatic {bistatic_db:.2f} dB, {draws} draws; the model is equality"),
        *_along_the_sidelink(),
    ]  # fmt: skip


def _mean_db(loss_db: Callable[[float, np.random.Generator], float], size_cm: float, draws: int, seed: int) -> float:
    return float(np.mean([loss_db(size_cm, np.random.default_rng([seed, draw])) for draw in range(draws)]))


def _bistatic_db(size_cm: float, generator: np.random.Generator) -> float:
    return float(peak_losses_db(ERRORS["localization"], size_cm, generator).mean())


def _monostatic_db(size_cm: float, generator: np.random.Generator) -> float:
    scene = reduced_scene(pulses=600, subcarriers=128)
    targets = scene.scatterers.position_m
    levels = []
    for sigma_m in (0.0, size_cm / 100):
        wrong = Impairments(localization=Localization(sigma_m))
        # one antenna position for both legs: no transmitter of its own
        observed = observe(scene.waveform, scene.scatterers, scene.geometry, generator, receiver=wrong, sidelink=False)
        transfer = transfer_functions(observed.channels["radar"], None).astype(np.complex64)
        levels.append(find_peaks(range_tables(phase_history(scene, transfer), targets), targets)[1])
    return float(amplitude_db(levels[1] / levels[0]).mean())


def _along_the_sidelink() -> list[Claim]:
    """Return what an error of 1 cm along the sidelink leaves in the corrected path of a target abreast of the pair."""
    half_m, error_m = RX_AHEAD_M / 2, 0.01
    target = np.array([[0.0, 15.0, 0.0]])
    ends = np.array([[-half_m, 0.0, 10.0]]), np.array([[half_m, 0.0, 10.0]])

    def wrong_cm(tx_m: float, rx_m: float) -> float:
        moved = ends[0] + [tx_m, 0, 0], ends[1] + [rx_m, 0, 0]
        return 100 * float(_corrected_m(*moved, target) - _corrected_m(*ends, target))

    growth_cm = 100 * _echo_growth(ends, error_m, target)
    both, one = abs(wrong_cm(error_m, error_m)), abs(wrong_cm(0.0, error_m))
    why = "R_tx + R_rx − R_sl, target abreast of the middle, 15 m away and 10 m below"
    return [
        require("errors along the sidelink cancel: 1 cm common to both nodes", both, "cm",
                limit="less than 0.1 cm of path", met=both < 0.1, style=".3f",
                note=f"{why}; it shifts the image along the track"),
        require("errors along the sidelink cancel: 1 cm of the receiver alone", one, "cm",
                limit="less than 0.1 cm of path", met=one < 0.1, style=".3f",
                note=f"{why}; the sidelink grows by 1 cm, the echo's path by {growth_cm:.2f} cm: they cancel only "
                "where the target lies in line with the sidelink"),
    ]  # fmt: skip


def _corrected_m(tx_m: Floats, rx_m: Floats, target_m: Floats) -> float:
    return float(Aperture(tx_m, rx_m).path(target_m)[0, 0] - np.linalg.norm(tx_m - rx_m))


def _echo_growth(ends: tuple[Floats, Floats], error_m: float, target_m: Floats) -> float:
    paths = [Aperture(ends[0], ends[1] + [along, 0, 0]).path(target_m)[0, 0] for along in (0.0, error_m)]
    return float(paths[1] - paths[0])


RECEIVERS = 4
SPACING_M = 4.7
SNR_DB = -10.0
"""Of the radar per subcarrier: noise, so that adding receivers gains something."""


def swarm_claims(*, pulses: int = 150, seed: int = 1) -> list[Claim]:
    """Return how a swarm's receivers add up, each corrected by its own sidelink alone, and how pulses are detected."""
    images = [_receiver(number, pulses, np.random.default_rng([seed, number])) for number in range(1, RECEIVERS + 1)]
    peaks, noises = (np.array([image[part] for image in images]) for part in (0, 1))
    efficiency = float((np.abs(peaks.sum(axis=0)) / np.abs(peaks).sum(axis=0)).min())
    alone = np.mean(np.abs(peaks) ** 2) / np.mean(np.abs(noises) ** 2)
    together = np.mean(np.abs(peaks.sum(axis=0)) ** 2) / np.mean(np.abs(noises.sum(axis=0)) ** 2)
    return [
        compare(f"swarm: coherent sum of {RECEIVERS} receivers over the sum of their peaks", efficiency, "1",
                independent_model=1.0, within=0.02, style=".4f",
                note="worst of five targets; each receiver has a clock of its own and its own sidelink"),
        compare(f"swarm: gain in SNR by {RECEIVERS} receivers", 10 * float(np.log10(together / alone)), "dB",
                independent_model=10 * np.log10(RECEIVERS), within=0.5, relative=False, style=".2f",
                note="10·lg N: receivers only listen, so one transmitter serves any number of them"),
        *trigger_claims(),
    ]  # fmt: skip


def _receiver(number: int, pulses: int, generator: np.random.Generator) -> tuple[Complexes, Complexes]:
    """Return a receiver's image at the targets without noise, and what noise adds at random places."""
    clocks = Impairments(carrier_phase=UniformPhase(), timing=Timing(half_width_s=40e-9), sidelink_snr_db=30.0)
    scene = reduced_scene(pulses=pulses, subcarriers=512)
    along = scene.geometry.radar_tx[:, 0]
    scene = replace(scene, geometry=straight_pair(along, 10.0, rx_ahead_m=SPACING_M * (number - RECEIVERS / 2)))
    state = generator.bit_generator.state
    images = []
    for impairments in (clocks, replace(clocks, radar_snr_db=SNR_DB)):
        generator.bit_generator.state = state  # the same clocks and the same noise of the sidelink
        radar, sidelink, _ = receive_pair(scene, Disturbance(impairments), generator)
        history = phase_history(scene, divide(radar, sidelink), divided=True)
        tables = range_tables(history, scene.scatterers.position_m)
        images.append(
            (mean_image(tables, scene.scatterers.position_m[None])[0], mean_image(tables, _places()[None])[0])
        )
    return images[0][0], np.asarray(images[1][1] - images[0][1], np.complex64)


def _places() -> Floats:
    generator = np.random.default_rng(0)
    return np.column_stack([generator.uniform(-6, 6, 2000), generator.uniform(5, 25, 2000), np.zeros(2000)])


def trigger_claims(*, pulses: int = 12) -> list[Claim]:
    """Return what the trigger finds in recordings that ran through, against where the pulses are."""
    with TemporaryDirectory() as folder:
        campaign = Campaign.load(simulate(Path(folder) / "made", preset("continuous", pulses=pulses)))
        nodes = json.loads((campaign.root / "truth.json").read_text(encoding="utf-8"))["flights"]["f01"]["nodes"]
        errors, detected = [], 0
        for node, truth in nodes.items():
            ingest(campaign, "f01", node)
            raw = open_stage(campaign.stage("raw", "f01", node), "raw")
            since_s = (raw.time.values - raw.time.values[0]) / np.timedelta64(1, "s")
            starts = np.array(truth["pulse_start_sample"])
            detected += len(since_s)
            if len(since_s) == len(starts):
                errors.append(np.abs(since_s * raw.attrs["sample_rate_hz"] - (starts - starts[0])).max())
    return [
        compare("trigger: pulses found by the preamble", detected / (pulses * len(nodes)), "1", independent_model=1.0,
                within=1e-9, note=f"of {pulses} pulses in each of {len(nodes)} recordings that ran through"),
        require("trigger: largest error of a capture's start", float(np.max(errors)), "samples",
                limit="at most 2 samples, which the sidelink removes", met=bool(np.max(errors) <= 2), style=".2f",
                note="from pulse to pulse, against the simulation's truth"),
    ]  # fmt: skip
