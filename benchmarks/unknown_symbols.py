"""Unknown symbols at sidelink SNRs from -5 to 30 dB: symbol errors against theory, and loss and floor of the image.

For each constellation and reflection of the sidelink, 64 pulses of 1024 subcarriers are drawn with random data, clock
phases and trigger delays. The image is the mean profile of one point without noise of its own, corrected as the
workflow does: by decided symbols, or by division where decisions are unsure. Printed is, for each SNR, the symbol error
rate / the theoretical rate, the share of sure pulses, the method, and loss and floor of the profile, dB.

    python benchmarks/unknown_symbols.py            the table of docs/theory/data_symbols.md, "Measured"
    python benchmarks/unknown_symbols.py --cost     CPU time per pulse of the decisions beside demodulation and division
"""

import sys
import time

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.core.echo.constellation import CONSTELLATIONS, Constellation
from apertura.core.echo.sidelink import LEAST_NOISE, METHODS, choose, measure
from apertura.core.echo.unknown_symbols import SymbolDecider

SUBCARRIERS, PULSES, ECHO_CELLS = 1024, 64, 40.0
SNRS_DB = (-5, 0, 5, 10, 15, 20, 25, 30)
REFLECTIONS_DB = (None, -20, -12, -6)
REFLECTION_CELLS = 5.4


def received(
    qam: Constellation, snr_db: float, reflection_db: float | None, *, pulses: int = PULSES
) -> tuple[NDArray[np.uint8], NDArray[np.complex64], NDArray[np.complex64], NDArray[np.float64]]:
    """Return labels, (pulse, subcarrier), radar and sidelink, and the power of the channel, (subcarrier,)."""
    random, number = np.random.default_rng(1), np.arange(SUBCARRIERS) - (SUBCARRIERS - 1) / 2
    labels = random.integers(0, len(qam.points), (pulses, SUBCARRIERS)).astype(np.uint8)
    delay, phase = random.uniform(-20, 20, (pulses, 1)), random.uniform(-np.pi, np.pi, (pulses, 1))
    level = 0.0 if reflection_db is None else 10 ** (reflection_db / 20)
    channel = 1 + level * np.exp(1.1j - 2j * np.pi * number * REFLECTION_CELLS / SUBCARRIERS)
    common = qam.points[labels] * np.exp(1j * phase - 2j * np.pi * number * delay / SUBCARRIERS)
    noise = random.normal(scale=np.sqrt(0.5 / 10 ** (snr_db / 10)), size=(*labels.shape, 2)) @ [1, 1j]
    radar = common * np.exp(-2j * np.pi * number * ECHO_CELLS / SUBCARRIERS)
    return labels, radar.astype(np.complex64), (common * channel + noise).astype(np.complex64), np.abs(channel) ** 2


def image(
    qam: Constellation, radar: NDArray[np.complex64], sidelink: NDArray[np.complex64]
) -> tuple[SymbolDecider, NDArray[np.uint8], float, str, float, float]:
    """Return decider, labels, share of sure pulses, method, and loss and floor of the mean profile, dB."""
    numbers = np.arange(len(sidelink))
    decider = SymbolDecider.measured([(numbers, sidelink)], qam)
    decisions = decider.decide(sidelink, numbers)
    divides = np.median(decisions.snr) < qam.least_snr
    used = decisions.path.locked if divides else decisions.sure
    echo, direct = radar[used] / decisions.symbols[used], sidelink[used] / decisions.symbols[used]
    state = measure(direct)
    method = "divide" if divides else choose(state, LEAST_NOISE)[0]
    corrected = METHODS[method](echo, direct, state.path) / state.path.amplitude[:, None]
    window = np.hanning(SUBCARRIERS) / np.hanning(SUBCARRIERS).sum()
    profile = np.abs((window * corrected[state.locked]).mean(0) @ np.exp(
        2j * np.pi * np.outer(np.arange(SUBCARRIERS) - (SUBCARRIERS - 1) / 2, np.arange(SUBCARRIERS)) / SUBCARRIERS
    ))  # fmt: skip
    peak = profile.argmax()
    far = np.abs(np.arange(SUBCARRIERS) - peak) > 30
    floor = np.sqrt(np.mean(profile[far] ** 2))
    return (
        decider,
        decisions.labels,
        float(decisions.sure.mean()),
        method,
        20 * np.log10(profile[peak]),
        20 * np.log10(floor / profile[peak]),
    )


def errors(decider: SymbolDecider, labels: NDArray[np.uint8], sidelink: NDArray[np.complex64]) -> float:
    """Return the symbol error rate after removal of the ambiguity by 16 known symbols."""
    decisions = decider.decide(sidelink, np.arange(len(sidelink)))
    return float(np.mean(decider.resolved(decisions, labels[:, :16]).labels != labels))


def main() -> None:
    """Print the table."""
    for name, qam in CONSTELLATIONS.items():
        for reflection_db in REFLECTIONS_DB:
            cells = []
            for snr_db in SNRS_DB:
                labels, radar, sidelink, power = received(qam, snr_db, reflection_db)
                theory = float(np.mean(qam.symbol_error_rate(10 ** (snr_db / 10) * power)))
                try:
                    decider, _, sure, method, loss_db, floor_db = image(qam, radar, sidelink)
                except CampaignError:
                    cells.append(f"{snr_db} dB: no path ({theory:.1e})")
                    continue
                rate = errors(decider, labels, sidelink)
                cells.append(
                    f"{snr_db} dB: {rate:.1e}/{theory:.1e} {100 * sure:.0f}% {method} {loss_db:+.2f} {floor_db:.0f}"
                )
            print(name, "-" if reflection_db is None else f"{reflection_db} dB", " | ".join(cells), sep=" | ")


def cost() -> None:
    """Print CPU time per pulse, interleaved, minimum of 15 runs."""
    qam = CONSTELLATIONS["16qam"]
    labels, radar, sidelink, _ = received(qam, 20, None)
    decider, numbers = SymbolDecider.measured([(np.arange(PULSES), sidelink)], qam), np.arange(PULSES)
    samples = np.tile(sidelink, 3)[:, :2560]
    direct, echo = sidelink / qam.points[labels], radar / qam.points[labels]
    path = measure(direct).path
    steps = {
        "demodulate one channel of 2560 samples": lambda: scipy.fft.fft(samples, axis=1),
        "fit the direct path and correct": lambda: METHODS["two_parameter"](echo, direct, measure(direct).path),
        "two_parameter alone": lambda: METHODS["two_parameter"](echo, direct, path),
        "decide unknown symbols": lambda: decider.decide(sidelink, numbers),
    }
    least = dict.fromkeys(steps, np.inf)
    for _ in range(15):
        for name, step in steps.items():
            start = time.process_time()
            step()
            least[name] = min(least[name], time.process_time() - start)
    for name, seconds in least.items():
        print(f"{name}: {1e6 * seconds / PULSES:.0f} us a pulse")


if __name__ == "__main__":
    cost() if "--cost" in sys.argv else main()
