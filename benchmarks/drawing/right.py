"""Random error-free campaigns over the parameter envelope of small UAV radars, with their intentional flaws."""

from dataclasses import dataclass
from math import log10
from typing import Any

import numpy as np

from apertura.simulation import (
    CampaignSpecification,
    Clutter,
    ImageGrid,
    Origin,
    PointTarget,
    SimulatedFlight,
    WaveformSpecification,
)
from apertura.simulation.targets import Target
from drawing.dice import CHANCE_OF_A_FLAW, Dice
from drawing.flight import Geometry, draw_geometry
from drawing.radar import draw_nodes, draw_waveform

SCENES = ("one target", "five targets", "clutter", "clutter and targets")
_POINTS_OF_CLUTTER = 250


@dataclass(frozen=True)
class Drawn:
    """Error-free campaign.

    Attributes
    ----------
    specification
        Input of `ap.simulate`.
    parameters
        Name with unit → value, for a table.
    true_flags
        Flag that is correct for this campaign → its intentional flaw.
    """

    specification: CampaignSpecification
    parameters: dict[str, Any]
    true_flags: dict[str, str]


def draw_right(number: int, *, seed: int = 0) -> Drawn:
    """Draw one campaign of the envelope; the same seed and number give the same campaign."""
    dice, true = Dice(seed, number), dict[str, str]()
    carrier_hz = dice.between(0.4e9, 10e9)
    bandwidth_hz = min(dice.between(50e6, 1e9), 0.4 * carrier_hz)
    geometry = draw_geometry(dice, carrier_hz + bandwidth_hz, bandwidth_hz, true)
    waveform = draw_waveform(dice, geometry, carrier_hz, bandwidth_hz)
    receivers, scene = dice.one_of(1, 1, 2, 2, 3, 4), dice.one_of(*SCENES)
    snr_db = dice.uniform(-30, 30)
    nodes, tracks = draw_nodes(dice, geometry, waveform, receivers, snr_db, true)
    origin = Origin(dice.uniform(-70, 70), dice.uniform(-179, 179), dice.one_of(-40.0, 0.0, 620.0, 4000.0))
    flight = SimulatedFlight("f01", "uav1", tracks, geometry.pulses)
    grid = _grid(dice, geometry, origin, true)
    targets = _targets(dice, geometry, scene)
    specification = CampaignSpecification(f"right{number}", origin, waveform, targets, nodes, (flight,), grid)
    _weak_echoes(waveform, snr_db, scene, true)
    lasting_s = waveform.cyclic_prefix_s + waveform.symbol_s
    if (lasting_s - 1 / waveform.subcarrier_spacing_hz) * waveform.sample_rate_hz < 40:
        true["clock_unmeasured"] = "symbols less than 40 samples longer than their period"
    missed = max(node.impairments.missed_fraction for node in nodes.values())
    if missed > 0:
        true["pulses_missing"] = f"a node misses {100 * missed:.0f} % of its triggers"
    parameters = _parameters(waveform, geometry, bandwidth_hz) | {
        "snr_db": round(snr_db, 1), "receivers": receivers, "scene": scene, "origin_height_m": origin.height_m,
        "missed": nodes["uav1"].impairments.missed_fraction,
    }  # fmt: skip
    return Drawn(specification, parameters, true)


def _grid(dice: Dice, geometry: Geometry, origin: Origin, true: dict[str, str]) -> ImageGrid:
    zone = int((origin.longitude_deg + 180) // 6) + 1
    crs = f"EPSG:{(32600 if origin.latitude_deg >= 0 else 32700) + zone}"
    spacing_m = geometry.cell_m / 3
    if dice.chance(CHANCE_OF_A_FLAW):
        spacing_m *= 5
        true["spacing_coarse"] = "pixel spacing larger than a resolution cell"
    spacing_m = float(f"{spacing_m:.2g}")
    half_m = max(8, round(geometry.half_width_m / spacing_m)) * spacing_m
    if dice.chance(0.7) or "spacing_coarse" in true:
        return ImageGrid(crs, half_width_m=half_m, spacing_m=spacing_m)
    bounds = ImageGrid(crs, half_width_m=half_m, spacing_m=spacing_m).bounds(origin)
    xmin, ymin, xmax, ymax = map(float, bounds)
    return ImageGrid(crs, bounds_m=(xmin, ymin, xmax, ymax))


def _targets(dice: Dice, geometry: Geometry, scene: str) -> tuple[Target, ...]:
    half = geometry.half_width_m
    count = {"one target": 1, "clutter": 0}.get(scene, 5)
    level = 10 ** (20 / 20) if scene == "clutter and targets" else 1.0
    about = ((0.0, 0.0), (0.6, 0.6), (-0.6, 0.6), (0.6, -0.6), (-0.6, -0.6))[:count]
    targets: list[Target] = []
    for east, north in about:
        place = (half * (east + dice.uniform(-0.1, 0.1)), half * (north + dice.uniform(-0.1, 0.1)), 0.0)
        targets.append(PointTarget(place, level * dice.uniform(0.5, 1)))
    if "clutter" in scene:
        area_m2 = (2 * half) ** 2
        density = _POINTS_OF_CLUTTER / area_m2
        targets.append(Clutter((-half, -half, half, half), density, density))
    return tuple(targets)


def _weak_echoes(waveform: WaveformSpecification, snr_db: float, scene: str, true: dict[str, str]) -> None:
    """Add the flag on the code if the echoes of a single pulse are below the noise after compression."""
    gathered_db = snr_db + 10 * log10(waveform.subcarriers)
    spread_db = 8 if "clutter" in scene else 0
    if gathered_db < 12 + spread_db:
        true["code_unconfirmed"] = f"echoes of one pulse {gathered_db:.0f} dB above the noise after compression"


def _parameters(waveform: WaveformSpecification, geometry: Geometry, bandwidth_hz: float) -> dict[str, Any]:
    return {
        "kind": geometry.kind, "carrier_ghz": round(waveform.carrier_hz / 1e9, 3),
        "bandwidth_mhz": round(bandwidth_hz / 1e6, 1), "subcarriers": waveform.subcarriers,
        "carrier_is": waveform.carrier_is, "range_m": round(geometry.range_m, 1), "up_m": round(geometry.up_m, 1),
        "aperture_deg": round(float(np.degrees(geometry.aperture_rad)), 2), "speed_m_s": round(geometry.speed_m_s, 2),
        "prf_hz": round(float(geometry.prf_hz), 2), "pulses": geometry.pulses,
        "cell_m": round(float(geometry.cell_m), 3),
    }  # fmt: skip
