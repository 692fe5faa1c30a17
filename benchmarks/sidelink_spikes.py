"""Disturbed sidelink pulses: peak loss, image error and phase error, without and with the exclusion of these pulses.

``python benchmarks/sidelink_spikes.py`` simulates two nodes on a straight track past a point target, with oscillators
whose phase walks randomly, and disturbs the sidelink in a share of the pulses: by a phase step of random sign, or by a
reflection of random phase. The echo is divided by the sidelink. The table contains the peak loss, the RMS error of the
image along the track relative to its peak, and the phase error at the target (docs/theory/sidelink_spikes.md). With
``--replace`` the last columns are for pulses that are corrected by the phase of their neighbours instead.
"""

import sys
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.line_of_sight import fit_line_of_sight
from apertura.core.echo.sidelink import divide, two_parameter
from apertura.core.echo.sidelink_spikes import find_spikes
from apertura.simulation.impairments import Impairments, PhaseWalk, Spikes
from apertura.simulation.observation import observe
from apertura.simulation.synthesis import straight_pair, transfer_functions
from apertura.simulation.targets import Scatterers
from apertura.simulation.waveform import TransmitWaveform, qpsk_codes

PULSES, SUBCARRIERS, PRF_HZ, BAND_HZ = 2000, 32, 50.0, 400e6
FRACTIONS = (0.001, 0.01, 0.1)
WAVEFORM = TransmitWaveform(
    qpsk_codes(SUBCARRIERS, np.random.default_rng(0)),
    1.2e9,
    "band_start",
    BAND_HZ / SUBCARRIERS,
    8e-8,
    5e-8,
    5e8,
    PRF_HZ,
)
TARGET = np.array([0.0, 12.0, 0.0])
KINDS = {f"phase {phase_rad:.1f} rad": {"phase_rad": phase_rad} for phase_rad in (0.5, 1.0, 1.5, 2.0, np.pi)}
KINDS |= {f"reflection {level_db} dB": {"level_db": level_db} for level_db in (-20, -10, -6, -3, 0)}


def image(transfer: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the image at the target and on a line along the track, mean over the pulses used."""
    geometry = straight_pair(np.linspace(-10, 10, PULSES), 10.0, rx_ahead_m=4.7)
    points = TARGET + np.concatenate([[0.0], np.linspace(-6, 6, 81)])[:, None] * np.array([1.0, 0.0, 0.0])
    legs = [np.linalg.norm(side[:, None] - points, axis=2) for side in (geometry.radar_tx, geometry.radar_rx)]
    path_m = legs[0] + legs[1] - np.linalg.norm(geometry.sidelink_tx - geometry.sidelink_rx, axis=1)[:, None]
    total = np.zeros(len(points), complex)
    for number, frequency_hz in enumerate(WAVEFORM.frequency_hz):
        turns = np.remainder(path_m[used] * frequency_hz / SPEED_OF_LIGHT_M_S, 1.0)
        total += transfer[used, number] @ np.exp(2j * np.pi * turns)
    return total / (used.sum() * SUBCARRIERS)


def images(spikes: Spikes | None, *, replaced: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the images without and with correction of the disturbed pulses."""
    receiver = Impairments(
        carrier_phase=PhaseWalk(0.5), radar_snr_db=20.0, sidelink_snr_db=25.0, sidelink_spikes=spikes
    )
    geometry = straight_pair(np.linspace(-10, 10, PULSES), 10.0, rx_ahead_m=4.7)
    scene = Scatterers(TARGET[None], np.ones(1, complex))
    seen = observe(WAVEFORM, scene, geometry, np.random.default_rng(1), receiver=receiver, transmitter=Impairments())
    radar, sidelink = (
        transfer_functions(seen.channels[name], seen.noise[name]).astype(np.complex64) for name in ("radar", "sidelink")
    )
    path = fit_line_of_sight(sidelink)
    length_m = np.linalg.norm(geometry.sidelink_tx - geometry.sidelink_rx, axis=1)
    cell_m, wave_m = SPEED_OF_LIGHT_M_S / BAND_HZ, SPEED_OF_LIGHT_M_S / WAVEFORM.frequency_hz.mean()
    time_s = np.arange(PULSES) / PRF_HZ
    found = find_spikes(path, length_m / cell_m, time_s, cycles_per_cell=cell_m / wave_m, wave_m=wave_m)
    corrected, used = divide(radar, sidelink, path), path.locked
    before = image(corrected, used)
    if not replaced:
        return before, image(corrected, used & ~found.excluded)
    smooth = np.where(found.excluded, np.median(path.delay_cells), path.delay_cells)
    smoothed = replace(path, phase_rad=path.phase_rad - found.error_rad, delay_cells=smooth)
    corrected[found.excluded] = two_parameter(radar, sidelink, smoothed)[found.excluded]
    return before, image(corrected, used)


def main() -> None:
    """Print a row for each kind and share of disturbed pulses."""
    replaced = "--replace" in sys.argv
    table = Table(title=f"{PULSES} pulses: disturbed pulses kept | {'replaced' if replaced else 'excluded'}")
    for heading in (
        "disturbance",
        "share",
        "loss, dB",
        "error, dB",
        "phase, rad",
        "loss, dB",
        "error, dB",
        "phase, rad",
    ):
        table.add_column(heading, justify="right")
    clean = images(None)[0]
    for kind, settings in KINDS.items():
        for fraction in FRACTIONS:
            cells = []
            for one in images(Spikes(fraction, **settings), replaced=replaced):
                ratio = one[0] / clean[0]
                error = np.sqrt(np.mean(np.abs(one[1:] / ratio - clean[1:]) ** 2)) / abs(clean[0])
                cells += [f"{-20 * np.log10(abs(ratio)):.2f}", f"{20 * np.log10(error):.1f}", f"{np.angle(ratio):+.3f}"]
            table.add_row(kind, f"{100 * fraction:g} %", *cells)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
