"""Beyond a pair: finding pulses in a running recording, and adding up the receivers of a swarm."""

import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from apertura.common.arrays import Complexes, Floats
from apertura.core.echo.sidelink import divide
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.steps.ingest import ingest
from apertura.pipeline.store import open_stage
from apertura.simulation import preset, simulate
from apertura.simulation.impairments import Impairments, Timing, UniformPhase
from apertura.simulation.recording import straight_pair
from apertura_research.study.paper.claims import Claim, compare, require
from apertura_research.study.paper_scene import Disturbance, receive_pair, reduced_scene
from apertura_research.study.point_response import mean_image, phase_history, range_tables

RECEIVERS = 4
SPACING_M = 4.7
SNR_DB = -10.0
"""Of the radar per subcarrier: noise, so that adding receivers gains something."""


def swarm_claims(*, pulses: int = 150, seed: int = 1) -> list[Claim]:
    """Return how a swarm's receivers add up, each corrected by its own sidelink alone, and how pulses are found."""
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
        errors, found = [], 0
        for node, truth in nodes.items():
            ingest(campaign, "f01", node)
            raw = open_stage(campaign.stage("raw", "f01", node), "raw")
            since_s = (raw.time.values - raw.time.values[0]) / np.timedelta64(1, "s")
            starts = np.array(truth["pulse_start_sample"])
            found += len(since_s)
            if len(since_s) == len(starts):
                errors.append(np.abs(since_s * raw.attrs["sample_rate_hz"] - (starts - starts[0])).max())
    return [
        compare("trigger: pulses found by the preamble", found / (pulses * len(nodes)), "1", independent_model=1.0,
                within=1e-9, note=f"of {pulses} pulses in each of {len(nodes)} recordings that ran through"),
        require("trigger: largest error of a capture's start", float(np.max(errors)), "samples",
                limit="at most 2 samples, which the sidelink removes", met=bool(np.max(errors) <= 2), style=".2f",
                note="from pulse to pulse, against the simulation's truth"),
    ]  # fmt: skip
