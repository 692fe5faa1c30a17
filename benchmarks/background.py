"""Background removal: loss of targets and residual arcs for coupling of 0 to 60 dB above a target.

``python benchmarks/background.py`` simulates transfer functions of three radars (OFDM, FMCW, UWB) on a straight pass, a
circle and a hover, adds coupling whose response decays over the ranges of the scene, and prints the decision of
`processing.background: auto`, its predicted and measured loss, and the median pixel relative to the median without
coupling (docs/theory/background.md).
"""

from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.backprojection.contributions import band_limited_image
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.background import GroupMeans
from apertura.core.echo.compression import window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.background import BackgroundScene, decide_removal
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround

RADARS = {"OFDM 1.2 GHz": (1.2e9, 410e6), "FMCW 10 GHz": (10e9, 500e6), "UWB 4.2 GHz": (3.1e9, 2.2e9)}
COUPLING_DB = (None, 0, 20, 40, 60)
PULSES, SUBCARRIERS, PRF_HZ, NOISE = 600, 256, 50.0, 0.3
GRID, GROUND = SceneGrid("local", -5.0, 30.0, 0.1, (100, 100)), FlatGround(0.0)
TARGETS = {"straight": [[-2.0, 25.0, 0.0], [3.0, 22.0, 0.0]], "circle": [[0.0, 25.0, 0.0]], "hover": [[0.0, 25.0, 0.0]]}


def track(kind: str) -> np.ndarray:
    """Return (pulse, 3) positions of a pass of 20 m, a circle of 15 m radius, or a hover within 3 cm."""
    along = np.linspace(-1, 1, PULSES)
    if kind == "circle":
        angle = np.pi * along
        return np.stack([15 * np.cos(angle), 25 + 15 * np.sin(angle), np.full(PULSES, 10.0)], -1)
    return np.stack([(10 if kind == "straight" else 0.015) * along, 0 * along, np.full(PULSES, 10.0)], -1)


def history(kind: str, radar: str, coupling_db: float | None) -> PhaseHistory:
    """Return transfer functions of unit targets, noise and coupling."""
    start_hz, band_hz = RADARS[radar]
    frequency = start_hz + band_hz / SUBCARRIERS * np.arange(SUBCARRIERS)
    aperture, rng = Aperture(track(kind), track(kind)), np.random.default_rng(1)
    delays = aperture.path(np.array(TARGETS[kind])) / SPEED_OF_LIGHT_M_S
    transfer = np.exp(-2j * np.pi * np.remainder(delays[..., None] * frequency, 1.0)).sum(axis=1)
    transfer += rng.normal(size=(*transfer.shape, 2)) @ np.array([1, 1j]) * NOISE / np.sqrt(2)
    if coupling_db is not None:
        tail = np.arange(20.0, 75.0, 1.5) / SPEED_OF_LIGHT_M_S
        amplitude = 10 ** (coupling_db / 20) * np.exp(-np.arange(len(tail)) / 8)
        transfer += amplitude @ np.exp(-2j * np.pi * np.remainder(tail[:, None] * frequency, 1.0))
    weight = window_weights("hann", SUBCARRIERS)
    return PhaseHistory(transfer.astype(np.complex64), frequency, weight, np.zeros(PULSES), aperture)


def levels_db(recorded: PhaseHistory, kind: str) -> tuple[float, float]:
    """Return the weakest target and the median of random pixels, dB."""
    pixels = GRID.positions_at(*np.random.default_rng(2).integers(100, size=(2, 400)), 0.0)
    points = np.concatenate([np.array(TARGETS[kind]), pixels])
    power = np.abs(band_limited_image(range_compress(recorded, GRID, GROUND), points) / PULSES) ** 2
    count = len(TARGETS[kind])
    return 10 * np.log10(power[:count].min()), 10 * np.log10(np.median(power[count:]))


def main() -> None:
    """Print a row for each radar, track and coupling."""
    table = Table(title="background removal, auto")
    for heading in ("radar", "track", "coupling", "removed", "predicted loss", "target", "median pixel", "not removed"):
        table.add_column(heading, justify="right")
    zero, time_s = np.zeros(PULSES), np.arange(PULSES) / PRF_HZ
    for radar in RADARS:
        for kind in TARGETS:
            clean = levels_db(history(kind, radar, None), kind)
            for coupling_db in COUPLING_DB:
                recorded = history(kind, radar, coupling_db)
                means = GroupMeans.of(recorded.transfer.__getitem__, time_s)
                scene = BackgroundScene(recorded, zero, zero, time_s, GRID, GROUND)
                removal = decide_removal(means, scene, method="auto", generator=np.random.default_rng(3))
                cleaned = recorded
                if removal.background is not None:
                    background = removal.background.at(time_s, recorded.frequency_hz, zero)
                    cleaned = replace(recorded, transfer=recorded.transfer - background)
                after, before = levels_db(cleaned, kind), levels_db(recorded, kind)
                table.add_row(
                    radar,
                    kind,
                    "none" if coupling_db is None else f"{coupling_db} dB",
                    removal.value,
                    f"{removal.loss_db:.1f} dB",
                    f"{after[0] - clean[0]:+.1f} dB",
                    f"{after[1] - clean[1]:+.1f} dB",
                    f"{before[1] - clean[1]:+.1f} dB",
                )
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
