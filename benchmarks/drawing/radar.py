"""Random waveform and nodes of a campaign."""

from dataclasses import replace
from math import ceil, log10

import numpy as np

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.simulation import Impairments, SimulatedNode, WaveformSpecification
from apertura.simulation.impairments import Clock, TimeTag, Timing, UniformPhase
from apertura.simulation.targets import Track
from drawing.dice import CHANCE_OF_A_FLAW, Dice
from drawing.flight import MOST_SUBCARRIERS, Geometry, track


def draw_waveform(dice: Dice, geometry: Geometry, carrier_hz: float, bandwidth_hz: float) -> WaveformSpecification:
    """Draw an OFDM symbol with a prefix longer than all echo delays and a period longer than the prefix."""
    longest_m = 3.2 * (geometry.range_m + geometry.half_width_m) + 8.0  # longest total path of the farthest receiver
    needed = ceil(longest_m / C * bandwidth_hz)
    subcarriers = int(2 ** np.ceil(np.log2(max(needed, dice.between(64, MOST_SUBCARRIERS / 2)))))
    spacing_hz = bandwidth_hz / subcarriers
    samples = subcarriers * dice.one_of(1, 1.25, 2)
    prefix = ceil(longest_m / C * spacing_hz * samples)
    rate_hz = spacing_hz * samples
    return WaveformSpecification(
        subcarriers,
        carrier_hz,
        spacing_hz,
        1 / spacing_hz * (1 + 1e-12),
        prefix / rate_hz,
        rate_hz,
        geometry.prf_hz,
        dice.one_of("band_start", "band_centre"),
        dice.one_of("qpsk", "newman"),
    )


def draw_nodes(
    dice: Dice,
    geometry: Geometry,
    waveform: WaveformSpecification,
    receivers: int,
    snr_db: float,
    true: dict[str, str],
) -> tuple[dict[str, SimulatedNode], dict[str, Track]]:
    missed = round(dice.one_of(0.0, dice.uniform(0, 0.2)), 3)
    radar_db = snr_db + 10 * log10(waveform.sample_rate_hz / waveform.subcarrier_spacing_hz / waveform.subcarriers)
    arms = {point: tuple(np.round(dice.generator.uniform(-0.3, 0.3, 3), 3)) for point in ("radar_tx", "radar_rx")}
    # The transmitting node tags its own pulses: the jitter of its time tags displaces antennas by less than λ/100.
    jitter_s = min(1e-3, C / waveform.carrier_hz / 100 / geometry.speed_m_s) * dice.uniform(0, 1)
    own = Impairments(radar_snr_db=radar_db, missed_fraction=missed, time_tag=TimeTag(jitter_s=jitter_s))
    nodes = {"uav1": SimulatedNode(arms, {"radar": round(dice.uniform(0, 1.5), 3)}, impairments=own)}
    tracks = {"uav1": track(geometry, 0.0, 1.0)}
    for number in range(2, receivers + 1):
        name = f"uav{number}"
        nodes[name] = _secondary(dice, geometry, waveform, replace(own, radar_snr_db=radar_db), true)
        tracks[name] = track(geometry, dice.uniform(-0.35, 0.35), dice.uniform(0.9, 1.1))
    return nodes, tracks


def _secondary(
    dice: Dice, geometry: Geometry, waveform: WaveformSpecification, own: Impairments, true: dict[str, str]
) -> SimulatedNode:
    """Draw a node with an independent clock: frequency offset, phase and time tags."""
    interval_s = 1 / geometry.prf_hz
    sidelink_db = dice.uniform(15, 40)
    if dice.chance(CHANCE_OF_A_FLAW):
        sidelink_db = dice.uniform(-10, 8)
        true |= dict.fromkeys(
            ("sidelink_noisy", "clock_uncertain"), f"sidelink SNR {sidelink_db:.1f} dB per subcarrier"
        )
    ppm = dice.uniform(-1, 1) * min(10.0, 0.25e6 * waveform.subcarrier_spacing_hz / waveform.carrier_hz)
    clock = Clock.of_ppm(ppm, carrier_hz=waveform.carrier_hz, sample_rate_hz=waveform.sample_rate_hz)
    tag = TimeTag(
        dice.uniform(-1, 1) * min(3e-3, 0.2 * interval_s), dice.uniform(-20, 20), min(0.5e-3, 0.03 * interval_s)
    )
    wrong = replace(
        own,
        clock=dice.one_of(Clock(), clock),
        carrier_phase=UniformPhase(),
        timing=Timing(half_width_s=min(40e-9, 0.02 * waveform.cyclic_prefix_s)),
        time_tag=tag,
        sidelink_snr_db=sidelink_db,
    )
    offsets = {"radar": round(dice.uniform(0, 1.5), 3), "sidelink": round(dice.uniform(0, 1.0), 3)}
    return SimulatedNode({}, offsets, None, "none", dice.one_of("pos", "pos_utc"), impairments=wrong)
