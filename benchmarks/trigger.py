"""Throughput and detection probability of the preamble search in continuous recordings.

`python benchmarks/trigger.py` prints GB per minute on one core, and the detection probability against the SNR.
"""

import time

import numpy as np
from scipy.signal import max_len_seq

from apertura.core.echo.trigger import PulseFraming, find_preambles

RATE_HZ = 1.024e9
FRAMING = PulseFraming(2 * max_len_seq(10)[0].astype(np.int64) - 1, 4, 204.8e6, RATE_HZ, guard_samples=256)
SYMBOL = 16000


def search(blocks: list[np.ndarray], false_alarms_per_s: float = 1e-2) -> int:
    detections = find_preambles(blocks, FRAMING, symbol_samples=SYMBOL, false_alarms_per_s=false_alarms_per_s)
    return sum(1 for _ in detections)


def throughput_gb_min(samples: int = 2**25) -> float:
    noise = np.random.default_rng(1).integers(-500, 500, (2**21, 2), dtype=np.int16)
    start_s = time.perf_counter()
    search([noise] * (samples // len(noise)))
    return samples * 4 / 1e9 / (time.perf_counter() - start_s) * 60


def detection_probability(snr_db: float, trials: int = 200) -> float:
    """Return the detection probability of preambles in noise, `snr_db` per sample, with fractional starts."""
    rng = np.random.default_rng(2)
    spacing, length = 40_000, len(FRAMING.template())
    hits = 0
    for _ in range(trials):
        start = 10_000 + rng.random()
        sample = np.arange(spacing)
        chip = np.floor((sample - start) / FRAMING.chip_samples).astype(int)
        inside = (sample >= start) & (chip < len(FRAMING.preamble))
        keyed = np.where(inside, FRAMING.preamble[np.clip(chip, 0, len(FRAMING.preamble) - 1)], 0)
        sent = keyed * np.exp(2j * np.pi * (FRAMING.centre_hz / RATE_HZ * (sample - start) + rng.random()))
        iq = 100 * 10 ** (snr_db / 20) * sent + (rng.normal(size=(2, spacing)).T @ [1, 1j]) * 100 / np.sqrt(2)
        block = np.stack([iq.real, iq.imag], -1).round().astype(np.int16)
        detections = find_preambles([block], FRAMING, symbol_samples=SYMBOL, false_alarms_per_s=1e-2)
        hits += any(abs(detection.sample - start) < length / 100 for detection in detections)
    return hits / trials


if __name__ == "__main__":
    print(f"{throughput_gb_min():.1f} GB/min, one core")
    for snr_db in (-25, -23, -22, -21, -20, -19, -18):
        # A symbol with N of the f_s/Δf bins has a lower SNR per sample than per subcarrier, by N/(f_s/Δf).
        per_subcarrier_db = snr_db + 10 * np.log10(10240 / 4096)
        print(
            f"{snr_db} dB per sample ({per_subcarrier_db:.1f} dB per subcarrier): {detection_probability(snr_db):.3f}"
        )
