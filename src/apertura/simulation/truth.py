"""What a simulated campaign hides from the processor, written down for those who judge it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import default_rng

from apertura.geometry.geodesy import projected_from_ecef
from apertura.simulation.continuous import pulse_samples
from apertura.simulation.plan import Flight, Grid, Recorded, Simulation, pulse_times
from apertura.simulation.recording import full_scale
from apertura.simulation.scene import PointTarget, Scene


def targets_truth(scene: Scene, grid: Grid) -> dict[str, Any]:
    """Return point targets in the grid's CRS with ellipsoidal heights, and what else there is in words."""
    points = [target for target in scene.targets if isinstance(target, PointTarget)]
    others = [repr(target) for target in scene.targets if not isinstance(target, PointTarget)]
    found = Scene(scene.origin, tuple(points)).scatterers(default_rng(0))
    places = projected_from_ecef(grid.crs, found.position_m)
    targets = [
        {
            "x": float(x),
            "y": float(y),
            "height_m": float(height),
            "amplitude": float(abs(amplitude)),
            "phase_rad": float(np.angle(amplitude)),
        }
        for (x, y, height), amplitude in zip(places, found.amplitude, strict=True)
    ]
    return {"crs": grid.crs, "targets": targets} | ({"extended": others} if others else {})


def flight_truth(simulation: Simulation, flight: Flight, recorded: dict[str, Recorded]) -> dict[str, Any]:
    """Return everything that was drawn of a flight, node by node."""
    truth: dict[str, Any] = {"pulses": flight.pulses, "kind": flight.kind, "nodes": {}}
    if flight.targets is not None:
        truth |= targets_truth(Scene(simulation.scene.origin, flight.targets), simulation.grid)
    for name, record in recorded.items():
        node, hidden = simulation.node(name), record.hidden
        radar = record.channels["radar"]
        truth["nodes"][name] = {
            "kept": None if hidden.kept.all() else np.flatnonzero(hidden.kept).tolist(),
            "cfo_hz": radar.cfo_hz,
            "sfo_hz": radar.sfo_hz,
            "path_offset_m": dict(node.path_offset_m),
            "phase_rad": _series(hidden.phase_rad),
            "start_s": _series(hidden.start_s),
            "tag_error_s": _series(hidden.tag_error_s),
            "blocked": np.flatnonzero(hidden.blocked).tolist(),
            "position_error_m": hidden.position_error_m.tolist() if hidden.position_error_m.any() else 0.0,
            "channels": {
                channel_name: {
                    "noise_variance": channel.noise_variance,
                    "full_scale": full_scale(channel, node.impairments.adc),
                }
                for channel_name, channel in record.channels.items()
            },
            "impairments": repr(node.impairments),
        }
        if flight.continuous:
            place = pulse_samples(radar, pulse_times(simulation, flight))
            truth["nodes"][name]["pulse_start_sample"] = place.tolist()
    return truth


def write_truth(path: Path, truth: dict[str, Any]) -> None:
    """Write truth.json."""
    path.write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")


def _series(values: np.ndarray[Any, np.dtype[np.float64]]) -> list[float] | float:
    """Return a constant as one number, anything else pulse by pulse."""
    return float(values[0]) if (values == values[0]).all() else values.tolist()
