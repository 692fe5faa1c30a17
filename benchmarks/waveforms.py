"""Comparison of an OFDM symbol, a chirp, a maximum-length sequence and a Golay code on one scene.

`python benchmarks/waveforms.py` prints the table of docs/theory/waveforms.md. Pulses of 1 µs with 409.6 MHz about
1.4048 GHz, two nodes, three targets, with the quantisation noise of 14 bits only; the noise loss is measured on a
separate scene with an SNR of 10 dB per bin.
"""

import json
import tempfile
import time
from pathlib import Path

import numpy as np
import xarray as xr

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.compression import window_weights
from apertura.core.geometry.geodesy import frame_from_map
from apertura.core.quality.point_targets import cut_through, find_peak
from apertura.run.process import process
from apertura.simulation import Impairments, PulseSpecification, WaveformSpecification, preset, simulate
from apertura.simulation.targets import PointTarget
from apertura.stages.scene import open_scene
from apertura.stages.transfer import PairEcho

PULSE = {"carrier_hz": 1.4048e9, "pulse_s": 1e-6, "listen_s": 0.78125e-6, "sample_rate_hz": 1.024e9, "prf_hz": 20.0}
BAND = {"lead_s": 0.1e-6, "band_hz": (-204.8e6, 204.8e6)}
WAVEFORMS = {
    "ofdm": WaveformSpecification(1024, 1.4048e9, 400e3, 2.5e-6, 0.78125e-6, 1.024e9, 20.0, "band_centre"),
    "chirp": PulseSpecification("chirp", bandwidth_hz=409.6e6, **PULSE, **BAND),
    "chirp, matched": PulseSpecification("chirp", bandwidth_hz=409.6e6, filter="matched", **PULSE, **BAND),
    "pn": PulseSpecification("pn", bandwidth_hz=512e6, **PULSE, **BAND),
    "pn, matched": PulseSpecification("pn", bandwidth_hz=512e6, filter="matched", **PULSE, **BAND),
    "golay": PulseSpecification("golay", bandwidth_hz=512e6, **PULSE, **BAND),
}
TARGETS = (PointTarget((0.0, 0.0, 0.0)), PointTarget((-4.0, -4.0, 0.0)), PointTarget((4.0, 4.0, 0.0)))
PAIRS = "uav1-uav1", "uav1-uav2"
PULSES = 200


def run(waveform, targets, snr_db: float | None) -> tuple[Campaign, float]:
    """Simulate a campaign and process it up to its images; return the campaign and the CPU seconds of the echo step."""
    root = Path(tempfile.mkdtemp()) / "campaign"
    own = Impairments(radar_snr_db=snr_db)
    quiet = {"uav1": own, "uav2": own}
    simulate(root, preset("demo", pulses=PULSES), waveform=waveform, targets=targets, impairments=quiet)
    campaign = Campaign.load(root)
    process(campaign, last="ingest")
    start_s = time.process_time()
    process(campaign, first="echo", last="echo")
    seconds = time.process_time() - start_s
    process(campaign, first="scene", last="image", threads=2)
    return campaign, seconds


def places(campaign: Campaign, pair: str) -> tuple[float, float, float]:
    """Return the largest position error (cm), and the mean widths of the targets to the east and north (cm)."""
    truth = json.loads((campaign.root / "truth.json").read_text())["targets"]
    grid = open_scene(campaign).grid
    pixels = open_stage(campaign.stage("image", "f01", pair), "image").image.values
    errors, widths = [], []
    for target in truth:
        row, column = (float(value) for value in grid.pixel_of(target["x"], target["y"]))
        peak = find_peak(pixels, round(row), round(column))
        errors.append(np.hypot(peak.row - row, peak.column - column) * grid.spacing_m)
        cuts = [
            cut_through(pixels, peak, direction=one, spacing_m=grid.spacing_m, reach_m=3.0) for one in ((1, 0), (0, 1))
        ]
        widths.append([cut.width_m for cut in cuts])
    return 100 * max(errors), *(100 * np.mean(widths, axis=0))


def aligned(stage: xr.Dataset, campaign: Campaign) -> np.ndarray:
    """Return transfer functions with the path to the first target removed, (pulse, subcarrier)."""
    truth = json.loads((campaign.root / "truth.json").read_text())
    first = truth["targets"][0]
    place = frame_from_map(truth["crs"], np.array(first["x"]), np.array(first["y"]), np.array(first["height_m"]))
    path = sum(np.linalg.norm(stage[leg].values - place, axis=1) for leg in ("tx_position", "rx_position"))
    phasors = np.exp(2j * np.pi * np.outer(path / SPEED_OF_LIGHT_M_S, stage.frequency.values))
    return stage.transfer.values * phasors


def sidelobes_db(campaign: Campaign, pair: str) -> float:
    """Return the highest sidelobe of one target's range profile with a Hann window, at all delays."""
    stage = PairEcho.opened(campaign, "f01", pair).stage
    mean = aligned(stage, campaign).mean(0)
    count = len(mean)
    level = np.abs(np.fft.ifft(mean * window_weights("hann", count), 16 * count))
    lobe = 16 * 2 + 6  # to the first null of a Hann window, 2 cells
    return float(20 * np.log10(level[lobe:-lobe].max() / level[0]))


def noise_loss_db(campaign: Campaign, pair: str, snr_db: float) -> float:
    """Return the loss of the SNR in the range profile of one target relative to N·SNR, without window."""
    stage = PairEcho.opened(campaign, "f01", pair).stage
    own = aligned(stage, campaign)
    profile_ = np.fft.ifft(own, axis=1)
    noise = (np.abs(profile_ - profile_.mean(0)) ** 2).mean() * len(own) / (len(own) - 1)
    return float(10 * np.log10(own.shape[1]) + snr_db - 10 * np.log10(np.abs(profile_[:, 0].mean()) ** 2 / noise))


if __name__ == "__main__":
    print(
        "waveform | pair | position error, cm | widths east, north, cm | sidelobes, dB | noise loss (reported), dB | "
        "echo, CPU s"
    )
    for name, waveform in WAVEFORMS.items():
        whole, seconds = run(waveform, TARGETS, None)
        alone, _ = run(waveform, TARGETS[:1], None)
        noisy, _ = run(waveform, TARGETS[:1], 10.0)
        for pair in PAIRS:
            error, *widths = places(whole, pair)
            stated = open_stage(whole.stage("echo", "f01", pair), "echo").attrs.get("waveform", {})
            title = f"{name.split(',')[0]}, {stated.get('filter', 'codes')}"
            print(
                f"{title} | {pair} | {error:.2f} | {widths[0]:.1f}, {widths[1]:.1f} | "
                f"{sidelobes_db(alone, pair):.1f} | {noise_loss_db(noisy, pair, 10.0):.2f} "
                f"({stated.get('loss_db', 0.0):.2f}) | {seconds:.2f}",
                flush=True,
            )
