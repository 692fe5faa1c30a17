"""EVM of NB-IoT uplink bursts in a recording of the air, by the functions that decide unknown symbols.

A single-tone NPUSCH burst (3GPP TS 36.211, section 10.1) has one subcarrier of 15 kHz, and slots of 7 symbols of 1/15
kHz with cyclic prefixes of 10 and 9 samples at 1.92 MHz; every second π/4-QPSK symbol is turned by π/4. A carrier
offset turns consecutive symbols of the burst as a delay turns consecutive subcarriers of a pulse: the symbols
of a burst are therefore decided as those of one pulse, whose delay is the carrier offset.

    python benchmarks/nbiot_evm.py RECORDING.sigmf-meta
"""

import json
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import resample_poly

from apertura.core.echo.constellation import constellation
from apertura.core.echo.demodulate import Numerology, demodulate
from apertura.core.echo.unknown_symbols import SymbolDecider

RATE_HZ, DFT, SLOT, FIRST_PREFIX, PREFIX, PER_SLOT = 1.92e6, 128, 960, 10, 9, 7
SEARCHED = range(-320, 321, 4)  # start of the first slot relative to the annotation, samples at 1.92 MHz


def symbols(burst: NDArray[np.complexfloating], start: int, slots: int) -> NDArray[np.complex64]:
    """Return the symbols of consecutive slots, (symbol,) complex64, without the turn of every second symbol."""
    first = start + SLOT * np.arange(slots)[:, None] + FIRST_PREFIX
    starts = (first + (DFT + PREFIX) * np.arange(PER_SLOT)).ravel()
    captures = burst[starts[:, None] + np.arange(DFT)].astype(np.complex64)
    tone = Numerology(0.0, RATE_HZ, np.array([0]), prefix_samples=0, dft_samples=DFT)
    return demodulate(captures, tone)[:, 0] * np.exp(-1j * np.pi / 4 * (np.arange(starts.size) % 2)).astype(
        np.complex64
    )


def main(path: Path) -> None:
    """Print carrier offset, SNR and EVM of all single-tone bursts of at least 8 ms."""
    described, qpsk = json.loads(path.read_text()), constellation("qpsk")
    rate_hz, carrier_hz = described["global"]["core:sample_rate"], described["captures"][0]["core:frequency"]
    samples = np.fromfile(path.with_suffix(".sigmf-data"), "<i2").astype(np.float32).view(np.complex64)
    for note in described["annotations"]:
        low_hz, high_hz = note["core:freq_lower_edge"], note["core:freq_upper_edge"]
        length, margin = note["core:sample_count"], round(1e-3 * rate_hz)
        if high_hz - low_hz > 31e3 or length < 8e-3 * rate_hz:
            continue
        start = note["core:sample_start"] - margin
        time_s = np.arange(length + 2 * margin) / rate_hz
        tone_hz = (low_hz + high_hz) / 2 - carrier_hz
        baseband = samples[start : start + time_s.size] * np.exp(-2j * np.pi * tone_hz * time_s)
        burst = resample_poly(baseband, round(RATE_HZ / rate_hz), 1)
        slots, best = round(length / rate_hz / 0.5e-3), None
        for offset in SEARCHED:
            received = symbols(burst, round(margin * RATE_HZ / rate_hz) + offset, slots)[None]
            flat = SymbolDecider(qpsk, np.ones_like(received), np.zeros(1))
            decisions = flat.decide(received, np.zeros(1, np.int64))
            if best is None or decisions.evm[0] < best[0].evm[0]:
                best = decisions, offset, received.size
        if best is not None:
            decisions, offset, count = best
            # consecutive symbols are 1/14 ms apart on average
            offset_hz = -decisions.path.delay_cells[0] / count * PER_SLOT / 0.5e-3
            snr_db, evm = 10 * np.log10(decisions.snr[0]), 100 * decisions.evm[0]
            print(
                f"{length / rate_hz * 1e3:.0f} ms at {tone_hz / 1e3:+.1f} kHz: {count} symbols, start {offset:+d}, "
                f"carrier offset {offset_hz:+.0f} Hz, SNR {snr_db:.1f} dB, EVM {evm:.1f} %, sure {decisions.sure[0]}"
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
