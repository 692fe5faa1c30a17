"""Comparison of FMCW and OFDM on one flight: position errors, widths and sidelobes of the same three targets.

`python benchmarks/fmcw.py` prints the table of docs/theory/fmcw.md. Band of 400 MHz from 2.2 GHz, 200 pulses along
10 m, at 20 m distance and 10 m height; FMCW 20 µs sampled at 25 MHz, OFDM 1000 subcarriers of 400 kHz; no noise.
"""

import json
import tempfile
import time
from pathlib import Path

import numpy as np
import yaml

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.core.echo.dechirp import FrequencySweep
from apertura.core.quality.point_targets import cut_through, find_peak
from apertura.run.process import process
from apertura.simulation import (
    CampaignSpecification,
    ImageGrid,
    Origin,
    PointTarget,
    SimulatedFlight,
    SimulatedNode,
    Straight,
    WaveformSpecification,
    simulate,
)
from apertura.simulation.fmcw import FmcwFlight, write_fmcw_campaign
from apertura.stages.scene import open_scene

TARGETS = ((0.0, 0.0, 0.0), (-2.0, 2.0, 0.0), (2.5, -1.5, 0.0))
PULSES, PRF_HZ, SPEED_M_S, HALF_M, SPACING_M = 200, 100.0, 5.0, 3.5, 0.0625
BAND = 2.2e9, 400e6


def fmcw(root: Path, iq: str) -> np.ndarray:
    """Write the FMCW campaign; return easting and northing of the targets."""
    sweep = FrequencySweep(*BAND, 20e-6, 25e6, iq)
    nodes = {"uav1": (0.0, -20.0, 10.0)}
    options = {"speed_m_s": SPEED_M_S, "half_width_m": HALF_M, "spacing_m": SPACING_M}
    flight = FmcwFlight(sweep, PRF_HZ, PULSES, nodes, TARGETS, **options)
    write_fmcw_campaign(root, flight, waveform={})
    return np.add(flight.origin[:2], np.array(TARGETS)[:, :2])


def ofdm(root: Path, _: str) -> np.ndarray:
    """Write the OFDM campaign; return easting and northing of the targets."""
    waveform = WaveformSpecification(1000, BAND[0], 400e3, 2.5e-6, 0.5e-6, 512e6, PRF_HZ)
    start = -SPEED_M_S * (PULSES - 1) / PRF_HZ / 2
    flight = SimulatedFlight("f01", "uav1", {"uav1": Straight((start, -20.0, 10.0), (SPEED_M_S, 0, 0))}, PULSES)
    grid = ImageGrid("EPSG:32632", half_width_m=HALF_M, spacing_m=SPACING_M)
    points = tuple(PointTarget(target) for target in TARGETS)
    specification = CampaignSpecification(
        "ofdm", Origin(48.4, 9.95, 500.0), waveform, points, {"uav1": SimulatedNode()}, (flight,), grid
    )
    simulate(root, specification)
    truth = json.loads((root / "truth.json").read_text())["targets"]
    return np.array([[target["x"], target["y"]] for target in truth])


def formed(root: Path, window: str) -> tuple[Campaign, float]:
    """Process a campaign up to its image; return the campaign and the CPU seconds of the echo step."""
    path = root / "config/config.yaml"
    document = yaml.safe_load(path.read_text())
    document["processing"] = {"autofocus": False, "window": window}
    path.write_text(yaml.safe_dump(document))
    campaign = Campaign.load(root)
    process(campaign, last="ingest")
    start_s = time.process_time()
    process(campaign, first="echo", last="echo")
    seconds = time.process_time() - start_s
    process(campaign, first="scene", last="image", threads=2)
    return campaign, seconds


def measured(campaign: Campaign, truth: np.ndarray) -> list[float]:
    """Return the largest position error (cm), and widths (cm) and PSLR (dB) of the central target along and across."""
    grid = open_scene(campaign).grid
    pixels = open_stage(campaign.stage("image", "f01", "uav1-uav1"), "image").image.values
    errors, cuts = [], []
    for east, north in truth:
        row, column = (float(value) for value in grid.pixel_of(east, north))
        peak = find_peak(pixels, round(row), round(column))
        errors.append(100 * SPACING_M * np.hypot(peak.row - row, peak.column - column))
        across = [
            cut_through(pixels, peak, direction=one, spacing_m=SPACING_M, reach_m=2.0) for one in ((1, 0), (0, 1))
        ]
        cuts.append([*(100 * cut.width_m for cut in across), *(cut.pslr_db for cut in across)])
    return [max(errors), *cuts[0]]


if __name__ == "__main__":
    print("waveform | window | position error, cm | width along, across, cm | PSLR along, across, dB | echo, CPU s")
    for name, write, iq in (("FMCW, real", fmcw, "real"), ("FMCW, complex", fmcw, "complex"), ("OFDM", ofdm, "")):
        for window in ("hann", "none"):
            with tempfile.TemporaryDirectory() as folder:
                root = Path(folder) / "campaign"
                truth = write(root, iq)
                campaign, seconds = formed(root, window)
                error, along, across, *sides = measured(campaign, truth)
            print(
                f"{name} | {window} | {error:.2f} | {along:.1f}, {across:.1f} | {sides[0]:.1f}, {sides[1]:.1f} "
                f"| {seconds:.2f}",
                flush=True,
            )
