"""Impairments of the stability study, from negligible to destructive size."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.sidelink import METHODS
from apertura.simulation.impairments import (
    Adc,
    Blockage,
    Clock,
    Impairments,
    Leakage,
    Localization,
    PhaseWalk,
    Reflection,
    Ripple,
    Timing,
    UniformPhase,
)
from apertura.simulation.presets import paper_waveform
from apertura_research.paper_scene import RX_AHEAD_M, Disturbance, PaperScene, reduced_scene

UNKNOWN = "unknown_qpsk"
"""Correction by QPSK symbols that change from pulse to pulse and are decided from the sidelink."""

CHOICES = ("none", *METHODS, UNKNOWN, "auto")
"""Corrections: none (radar channel only), each method of the sidelink, unknown symbols, and the automatic choice."""

PULSES = 240
ORDINARY = Impairments(radar_snr_db=20.0, sidelink_snr_db=30.0)
"""Impairments that are present in addition to the swept one."""

_CELL_M = SPEED_OF_LIGHT_M_S / 409.6e6


@dataclass(frozen=True)
class ImpairmentSweep:
    """Impairment and its simulated sizes, from negligible to destructive.

    Attributes
    ----------
    receiver, transmitter
        Size → fields of `Impairments` that it sets in the receiving node, and all impairments of the transmitting node.
    subcarriers
        1024 if the result depends on the bandwidth, 4096 if it depends on the SNR or the subcarrier spacing.
    logarithmic
        True if sizes are drawn and interpolated on a logarithmic axis.
    draws
        Number of draws over which results are averaged.
    moving, tagged
        True if the size is the speed of both nodes (m/s), or the error of the receiver's time tags (ms).
    """

    title: str
    unit: str
    sizes: tuple[float, ...]
    receiver: Callable[[float], dict[str, object]]
    transmitter: Callable[[float], Impairments] = lambda _: Impairments()
    subcarriers: int = 1024
    sampled: bool = False
    quantised: bool = False
    logarithmic: bool = True
    draws: int = 2
    moving: bool = False
    tagged: bool = False

    def disturbance(self, size: float, *, besides: Impairments = ORDINARY) -> Disturbance:
        """Return the disturbance of a given size, in addition to the impairments `besides` of the receiving node."""
        receiver = replace(besides, **self.receiver(size))  # type: ignore[arg-type]
        return Disturbance(receiver, self.transmitter(size), self.sampled, self.quantised)

    def flown(self, size: float) -> PaperScene:
        """Return the true scene: the receiver 4.7 m ahead of the transmitter, a track of 30 m at 1 m/s."""
        clocked = self.sampled and not self.quantised
        scene = reduced_scene(pulses=PULSES, subcarriers=self.subcarriers, rx_ahead_m=RX_AHEAD_M, qpsk=clocked)
        if not self.moving:
            return scene
        velocity = np.tile([size, 0.0, 0.0], (PULSES, 1))
        return replace(scene, geometry=replace(scene.geometry, tx_velocity=velocity, rx_velocity=velocity))

    def logged(self, flown: PaperScene, size: float, generator: np.random.Generator) -> PaperScene:
        """Return the logged scene: the receiver has its positions at the erroneous time tags."""
        if not self.tagged:
            return flown
        along = np.outer(1e-3 * size * generator.standard_normal(PULSES), [1.0, 0.0, 0.0])
        geometry = flown.geometry
        wrong = replace(geometry, radar_rx=geometry.radar_rx + along, sidelink_rx=geometry.sidelink_rx + along)
        return replace(flown, geometry=wrong)


def _one_clock(size: float) -> dict[str, object]:
    wave = paper_waveform()
    return {"clock": Clock.of_ppm(size, carrier_hz=wave.carrier_hz, sample_rate_hz=wave.sample_rate_hz)}


def _ripple(field: str) -> Callable[[float], dict[str, object]]:
    # A period of five range cells is within the gate, like the ripple of a cable or an antenna.
    return lambda size: {field: Ripple(size, 5 / 409.6e6)}


def _reflection(size: float) -> dict[str, object]:
    return {"sidelink_multipath": (Reflection(12.3 * _CELL_M, 10 ** (size / 20)),)}


_SNR_DB = tuple(float(snr) for snr in np.arange(30.0, -20.1, -2.5))

SWEEPS: Mapping[str, ImpairmentSweep] = {
    "carrier_phase": ImpairmentSweep(
        "Carrier phase per pulse, uniform ±", "π rad", (0.05, 0.125, 0.25, 0.375, 0.5, 0.75, 1.0),
        lambda size: {"carrier_phase": UniformPhase(size * np.pi)}, logarithmic=False,
    ),
    "phase_walk": ImpairmentSweep(
        "Phase noise, random walk", "rad/√s", (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 3.0),
        lambda size: {"carrier_phase": PhaseWalk(size)}, draws=4,
    ),
    "timing": ImpairmentSweep(
        "Timing offset per pulse, uniform ±", "ns", (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 10.0, 100.0),
        lambda size: {"timing": Timing(half_width_s=1e-9 * size)},
    ),
    "trigger_jitter": ImpairmentSweep(
        "Trigger jitter, σ", "samples of 0.98 ns", (0.1, 0.2, 0.3, 0.5, 1.0, 3.0, 10.0),
        lambda size: {"timing": Timing(jitter_samples=size)}, draws=4,
    ),
    "cfo": ImpairmentSweep(
        "Carrier frequency offset", "kHz", (3, 10, 20, 30, 50, 70, 100),
        lambda size: {"clock": Clock(cfo_hz=1e3 * size)}, subcarriers=4096, sampled=True, draws=1,
    ),
    "sfo": ImpairmentSweep(
        "Sampling frequency offset", "kHz", (10, 30, 60, 100, 200, 400, 1000),
        lambda size: {"clock": Clock(sfo_hz=1e3 * size)}, subcarriers=4096, sampled=True, draws=1,
    ),
    "clock": ImpairmentSweep(
        "One clock for carrier and sampling", "ppm", (0.3, 1, 3, 8, 20, 40, 80),
        _one_clock, subcarriers=4096, sampled=True, draws=1,
    ),
    "radar_noise": ImpairmentSweep(
        "SNR of the echo per subcarrier", "dB", (30, 20, 10, 0, -10, -20, -30, -40),
        lambda size: {"radar_snr_db": float(size)}, logarithmic=False,
    ),
    "sidelink_noise": ImpairmentSweep(
        "SNR of the sidelink per subcarrier", "dB", _SNR_DB,
        lambda size: {"sidelink_snr_db": size, "radar_snr_db": None}, subcarriers=4096, logarithmic=False,
    ),
    "sidelink_gain": ImpairmentSweep(
        "Gain of the sidelink, 30 dB SNR at 0 dB", "dB", (0, -10, -20, -25, -30, -35, -40, -50),
        lambda size: {"sidelink_gain_db": float(size)}, logarithmic=False,
    ),
    "sidelink_multipath": ImpairmentSweep(
        "Reflection in the sidelink, 12.3 cells late", "dB", (-40, -30, -20, -15, -10, -6, -3, -1),
        _reflection, logarithmic=False, draws=1,
    ),
    "sidelink_blockage": ImpairmentSweep(
        "Fraction of pulses with the sidelink blocked by 60 dB", "1", (0.01, 0.03, 0.1, 0.2, 0.4, 0.7),
        lambda size: {"sidelink_blockage": Blockage(size)}, logarithmic=False, draws=4,
    ),
    "leakage": ImpairmentSweep(
        "Leakage into the radar relative to the echo", "dB", (-20, -10, 0, 10, 20, 30, 40),
        lambda size: {"leakage": Leakage(float(size))}, logarithmic=False, draws=1,
    ),
    "transmit_ripple": ImpairmentSweep(
        "Ripple of the transmitter, peak to peak", "dB", (0.1, 0.3, 1, 2, 3, 6, 10),
        lambda _: {}, lambda size: Impairments(transmit_ripple=Ripple(size, 5 / 409.6e6)), draws=1,
    ),
    "radar_ripple": ImpairmentSweep(
        "Ripple of the radar's receiver, peak to peak", "dB", (0.1, 0.3, 1, 2, 3, 6, 10), _ripple("radar_ripple"),
        draws=1,
    ),
    "sidelink_ripple": ImpairmentSweep(
        "Ripple of the sidelink's receiver, peak to peak", "dB", (0.1, 0.3, 1, 2, 3, 6, 10), _ripple("sidelink_ripple"),
        draws=1,
    ),
    "adc_bits": ImpairmentSweep(
        "Bits of the converter", "bit", (14, 10, 8, 6, 4, 3, 2, 1),
        lambda size: {"adc": Adc(bits=int(size))}, sampled=True, quantised=True, logarithmic=False, draws=1,
    ),
    "adc_clipping": ImpairmentSweep(
        "Full scale of the converter relative to the RMS", "dB", (14, 9, 6, 3, 0, -6, -12, -20),
        lambda size: {"adc": Adc(backoff_db=float(size))}, sampled=True, quantised=True, logarithmic=False, draws=1,
    ),
    "localization": ImpairmentSweep(
        "Localization error, σ per axis after 1 s", "cm", (0.1, 0.3, 0.5, 1, 1.5, 2, 3, 5),
        lambda size: {"localization": Localization(size / 100)},
        lambda size: Impairments(localization=Localization(size / 100)), draws=6,
    ),
    "time_tag": ImpairmentSweep(
        "Error of the receiver's time tags at 1 m/s, σ", "ms", (1, 3, 10, 20, 30, 50, 100), lambda _: {}, draws=4,
        tagged=True,
    ),
    "missed_triggers": ImpairmentSweep(
        "Fraction of triggers missed", "1", (0.02, 0.05, 0.1, 0.3, 0.5, 0.8, 0.95),
        lambda size: {"missed_fraction": size}, logarithmic=False, draws=4,
    ),
    "doppler": ImpairmentSweep(
        "Speed of both nodes within the pulse", "m/s", (1, 3, 10, 30, 100, 300, 1000), lambda _: {"doppler": True},
        subcarriers=4096, sampled=True, draws=1, moving=True,
    ),
}  # fmt: skip
