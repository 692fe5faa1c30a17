"""Residual phase and displacement errors of simulated stacks: five flights past one scene with a slope that moves.

Tracks are 0, 0.1 and 1 m apart, logs have errors of 1 cm, and the slope moves by 0, 1 and 3 mm towards the antennas
from flight to flight (preset `revisit`). For each flight the table lists the error of the removed phase, the standard
deviation of the phase of windows on stable ground, the displacement error there, and the mean displacement of the slope
against its true value. Run:
`.venv/bin/python benchmarks/stack.py [--autofocus on] [--seed 1] [OFFSET_M:SLOPE_MM …]`.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import rasterio
import yaml

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.methods.interferometry.coherence import box_sum
from apertura.simulation import simulate
from apertura.simulation.presets import DEMO_ORIGIN, revisit

CASES = ("0:0", "0.1:1", "1:3")
WINDOW = 15
WAVENUMBER = 2 * np.pi * (1.2e9 + 1.6e6 * 127.5) / SPEED_OF_LIGHT_M_S
MILLIMETRES = 1e3 / (2 * WAVENUMBER)  # displacement per phase
SLOPE_M, EDGE_M = (2.5, 1.5, 7.5, 6.5), 1.0
"""Bounds of the slope in the preset, and width of the edge that belongs neither to the slope nor to stable ground."""


def formed(root: Path, *, offset_m: float, slope_mm: float, autofocus: str, seed: int) -> Path:
    """Simulate a campaign and compute its stack."""
    simulate(root, revisit(offset_m=offset_m, slope_mm=slope_mm), seed=seed)
    path = root / "config" / "config.yaml"
    config = yaml.safe_load(path.read_text())
    first, *others = (f"f{number:02d}" for number in range(1, 6))
    config |= {"stack": {"reference": first, "flights": others, "pair": "uav1-uav1", "window_px": WINDOW}}
    config["processing"] = {"autofocus": autofocus}
    path.write_text(yaml.safe_dump(config))
    command = [Path(sys.executable).with_name("apertura"), "run", root, "--cores", "1", "--until", "stack"]
    run = subprocess.run(list(map(str, command)), text=True, capture_output=True, check=False)
    if run.returncode:
        raise RuntimeError(run.stdout + run.stderr)
    return root


def measured(root: Path) -> None:
    """Print the errors of each flight."""
    truth = json.loads((root / "truth.json").read_text())["flights"]
    report = {path.parent.name: json.loads(path.read_text()) for path in (root / "results/stack").glob("f*/stack.json")}
    reference = _raster(root, "f01")
    half = WINDOW // 2
    place = (np.indices(reference.shape) + 0.5) * 0.125 - 11.0
    east, north = place[1], -place[0]
    within = [
        (east > SLOPE_M[0] - edge)
        & (east < SLOPE_M[2] + edge)
        & (north > SLOPE_M[1] - edge)
        & (north < SLOPE_M[3] + edge)
        for edge in (-EDGE_M, EDGE_M)
    ]
    moving, stable = (mask[half::WINDOW, half::WINDOW] for mask in (within[0], ~within[1]))
    for flight, of in sorted(report.items())[1:]:
        phase = np.angle(box_sum(_raster(root, flight) * reference.conj(), WINDOW))[half::WINDOW, half::WINDOW]
        changed = truth[flight].get("changes", [])
        true_mm = 1e3 * max((np.linalg.norm(one["shift_m"]) for one in changed if one["target"] == 0), default=0.0)
        error_mm = np.abs(phase[stable] * MILLIMETRES)
        removed = _raster(root, flight, "residual_phase.tif") - _true_phase(truth, flight, east, north)
        fit = of["residual_track"]
        print(
            f"  {flight}: baseline {of['perpendicular_baseline_m']:6.3f} m; coherence {of['coherence']:.3f} "
            f"(expected {of['expected_coherence']:.3f}); removed phase minus true one: "
            f"{np.std(removed):.3f} rad; phase {np.std(phase[stable]):.3f} rad (stated "
            f"{of['residual_phase_std_rad']:.3f}); stable ground: median error {np.median(error_mm):.2f} mm, 90 % "
            f"{np.percentile(error_mm, 90):.2f} mm; slope {np.mean(phase[moving]) * MILLIMETRES:.2f} mm (true "
            f"{true_mm:.2f}); {fit['parameters']:.1f} parameters, scale {fit['prior_scale']:.1f}, "
            f"stable {fit['stable_fraction']:.2f}; flags {', '.join(of['flags']) or 'none'}"
        )


def _true_phase(truth: dict[str, Any], flight: str, east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Return the phase of the true residual track at places: k times the mean of logged minus true path."""
    first, other = (np.array(truth[name]["nodes"]["uav1"]["position_error_m"]) for name in ("f01", flight))
    latitude, longitude = np.radians([DEMO_ORIGIN.latitude_deg, DEMO_ORIGIN.longitude_deg])
    (sin_lat, cos_lat), (sin_lon, cos_lon) = ((np.sin(angle), np.cos(angle)) for angle in (latitude, longitude))
    axes = [
        [-sin_lon, cos_lon, 0.0],
        [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
    ]
    error_m = (other - first) @ np.array(axes).T
    along = np.linspace(-3.0, 3.0, len(error_m))
    track = np.column_stack([along, np.full(len(along), -25.0), np.full(len(along), 25.0)])
    away = track - np.stack([east, north, 0 * east], axis=-1)[..., None, :]
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    phase: np.ndarray = 2 * WAVENUMBER * np.einsum("...mi,mi->...m", away, error_m).mean(axis=-1)
    return phase


def _raster(root: Path, flight: str, name: str = "slc.tif") -> np.ndarray:
    with rasterio.open(root / "results/stack" / flight / name) as raster:
        pixels: np.ndarray = raster.read(1)
    return pixels


def main() -> None:
    """Run the cases of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=CASES)
    parser.add_argument("--autofocus", default="off", choices=("off", "auto", "on"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, default=None, help="folder in which the campaigns are kept")
    arguments = parser.parse_args()
    with TemporaryDirectory() as folder:
        for case in arguments.cases:
            offset_m, slope_mm = map(float, case.split(":"))
            root = (arguments.keep or Path(folder)) / f"offset{offset_m:g}_slope{slope_mm:g}_{arguments.autofocus}"
            print(
                f"tracks {offset_m:g} m apart, slope {slope_mm:g} mm a flight, autofocus {arguments.autofocus}",
                flush=True,
            )
            measured(
                formed(root, offset_m=offset_m, slope_mm=slope_mm, autofocus=arguments.autofocus, seed=arguments.seed)
            )


if __name__ == "__main__":
    main()
