"""Geolocation of targets with and without atmospheric correction, for flights at heights of 30 m, 300 m and 3 km.

Each one-way path is simulated with the refractivity at the heights of its ends
(`apertura.simulation.scatterers.TrueAir`); with `--weather`, the atmosphere is 10 °C warmer, has a pressure higher by
20 hPa, and is more humid than the standard atmosphere. The pipeline uses one refractivity N per pair. Run:
`.venv/bin/python benchmarks/atmosphere.py [--weather] [HEIGHT …]`; prints a table.
"""

import argparse
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import rasterio
import yaml
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.core.geometry.atmosphere import refractivity, standard_weather
from apertura.core.quality.point_targets import find_peak
from apertura.core.scene.grid import SceneGrid
from apertura.simulation import (
    CampaignSpecification,
    PointTarget,
    SimulatedNode,
    Straight,
    WaveformSpecification,
    preset,
    simulate,
)
from apertura.simulation.impairments import Impairments
from apertura.stages.scene import settled_scene

BAND_HZ, CARRIER_HZ = 200e6, 1.3e9
"""Bandwidth and lowest frequency: range cells of 75 cm, mean wavelength 21 cm."""

_NEAR_M = 2.4
"""Half width of the area in which a target is searched; other targets are farther away."""


def flown(height_m: float, *, weather: bool = False) -> CampaignSpecification:
    """Specify a flight of four pairs past targets at a slant range of 1.4 heights; aperture: a third of that range."""
    base, ground_m, side_m = preset("demo"), height_m, 12.0
    range_m = float(np.hypot(height_m, ground_m))
    prefix_s = 1e-6 * np.ceil(2e6 * range_m / 299_792_458 + 0.3)
    waveform = WaveformSpecification(int(BAND_HZ / 1e6), CARRIER_HZ, 1e6, 1e-6, float(prefix_s), 256e6, 20.0)
    long_m, pulses = range_m / 3, 240
    speed = long_m * 20.0 / pulses
    ahead = 0.02 * range_m + 3.0
    tracks = {
        name: Straight((-long_m / 2 + ahead_m, -ground_m, height_m), (speed, 0.0, 0.0))
        for name, ahead_m in (("uav1", 0.0), ("uav2", ahead), ("uav3", -ahead), ("uav4", 2 * ahead))
    }
    perfect = {name: SimulatedNode(impairments=Impairments(radar_snr_db=25.0, doppler=False)) for name in tracks}
    origin = base.origin
    air = {}
    if weather:
        celsius, hpa, _ = standard_weather(origin.height_m)
        air = {"atmosphere": refractivity(celsius + 10, hpa + 20, 80.0)}
    return replace(
        base,
        waveform=waveform,
        targets=tuple(PointTarget(place) for place in ((0.0, 0.0, 0.0), (-4.0, 3.0, 0.0), (4.0, -3.5, 0.0))),
        nodes=perfect,
        flights=(replace(base.flights[0], tracks=tracks, pulses=pulses),),
        scene=replace(base.scene, half_width_m=side_m, spacing_m=0.1),
        **air,
    )


def formed(root: Path, air: object) -> dict[str, Any]:
    """Process a campaign with a value of scene.atmosphere; return target displacements (north, east) and reports."""
    config = root / "config/config.yaml"
    document = yaml.safe_load(config.read_text(encoding="utf-8"))
    document["scene"]["atmosphere"] = air
    config.write_text(yaml.safe_dump(document), encoding="utf-8")
    subprocess.run([sys.executable, "-m", "apertura", "run", str(root)], check=True, capture_output=True)
    grid = settled_scene(Campaign.load(root)).grid
    truth = json.loads((root / "truth.json").read_text(encoding="utf-8"))["targets"]
    off, reports = {}, {}
    pairs = Campaign.load(root).image_flights[0].pairs
    for name, file in (*((pair, "slc.tif") for pair in pairs), ("fused", "coherent_slc.tif")):
        reports[name] = json.loads((root / f"results/f01/{name}/image.json").read_text(encoding="utf-8"))
        with rasterio.open(root / f"results/f01/{name}/{file}") as raster:
            image = raster.read(1)
        off[name] = [_off(image, grid, target) for target in truth]
    return {"off_m": off, "reports": reports}


def _off(image: NDArray[np.complex64], grid: SceneGrid, target: dict[str, float]) -> tuple[float, float]:
    row, column = (float(value) for value in grid.pixel_of(target["x"], target["y"]))
    side = round(_NEAR_M / grid.spacing_m)
    top, left = max(0, round(row) - side), max(0, round(column) - side)
    window = np.abs(image[top : round(row) + side + 1, left : round(column) + side + 1])
    down, right = np.unravel_index(int(window.argmax()), window.shape)
    peak = find_peak(image, top + int(down), left + int(right))
    return (row - peak.row) * grid.spacing_m, (peak.column - column) * grid.spacing_m


def expected_m(height_m: float, refractivity_n: float) -> float:
    """Return the displacement of a point in an image that neglects the atmosphere, metres in ground range.

    Position of the peak of the sum over all pulses and frequencies in ground range: (n - 1)·R²/r_g, reduced by the
    phases over the aperture that no displacement reproduces (docs/theory/atmosphere.md, eq. 5).
    """
    range_m = float(np.hypot(height_m, height_m))
    along = np.linspace(-range_m / 6, range_m / 6, 240)[:, None]
    frequency = CARRIER_HZ + 1e6 * np.arange(int(BAND_HZ / 1e6))
    weight = np.hanning(len(frequency))
    at_m = np.linspace(-0.5, 2.5, 1201)
    wrong_m = 2 * (
        np.sqrt(along**2 + (height_m + at_m) ** 2 + height_m**2)
        - (1 + 1e-6 * refractivity_n) * np.sqrt(along**2 + 2 * height_m**2)
    )
    total = sum(
        one * np.exp(2j * np.pi * f / 299_792_458 * wrong_m).sum(axis=0)
        for f, one in zip(frequency, weight, strict=True)
    )
    return float(at_m[np.abs(total).argmax()])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("heights", nargs="*", type=float, default=[30.0, 300.0, 3000.0])
    parser.add_argument("--weather", action="store_true", help="weather that differs from the standard atmosphere")
    options = parser.parse_args()
    cell_m = 299_792_458 / BAND_HZ / 2
    print(
        "height  atmosphere  image  N  mean displacement north, east; largest deviation from expected, in range cells; "
        "expected; budget"
    )
    for height_m in options.heights:
        with TemporaryDirectory() as folder:
            root, known_n = simulate(Path(folder) / "campaign", flown(height_m, weather=options.weather), seed=1), 0.0
            for air in ("auto", "vacuum"):
                result = formed(root, air)
                for name, off in result["off_m"].items():
                    report = result["reports"][name]
                    known_n = max(known_n, report.get("atmosphere", {}).get("refractivity_n", 0.0))
                    expected = expected_m(height_m, known_n) if air == "vacuum" else 0.0
                    north, east = np.mean(off, axis=0)
                    farthest = max(float(np.hypot(one - expected, other)) for one, other in off)
                    line = next((one for one in report.get("budget", []) if one["cause"] == "atmosphere"), {})
                    used_n, budget = (
                        known_n if air == "auto" else 0.0,
                        f"{line.get('shift_m')} m {line.get('phase_rad')} rad",
                    )
                    print(
                        f"{height_m:5.0f} {air:7} {name:9} {used_n:6.1f} {100 * north:+7.2f} {100 * east:+6.2f} cm; "
                        f"{100 * farthest:5.2f} cm {farthest / cell_m:6.3f}; {100 * expected:6.1f} cm; {budget}",
                        flush=True,
                    )
                fused = result["reports"]["fused"]
                print(f"      coherent sum: {json.dumps(fused['coherence'])}, gain {json.dumps(fused['gain'])}"[:300])


if __name__ == "__main__":
    main()
