"""Claims that follow from the paper's parameters alone."""

from apertura.simulation.presets import paper_waveform
from apertura.study.paper import formulas as closed
from apertura.study.paper.claims import Claim, compare

BITS = 14
ADC_RATE_HZ = 4.096e9
"""Before decimation by 4."""


def parameter_claims() -> list[Claim]:
    """Return bandwidth, duty cycles, data rates, clock limits, timing requirements and chirp bandwidth.

    Examples
    --------
    >>> [claim.claim for claim in parameter_claims() if not claim.verdict.startswith("agrees")]
    ['OFDM symbol T against 1/Δf', 'effective chirp bandwidth ...']
    """
    return [*_waveform(), *_clocks(), *_timing()]


def _waveform() -> list[Claim]:
    wave = paper_waveform()
    band_hz = closed.bandwidth_hz(len(wave.codes), wave.subcarrier_spacing_hz)
    rows = [compare("bandwidth N·Δf", 409.6, band_hz / 1e6, "MHz", within=1e-6)]
    recorded = "γ from T + T_cp, not T alone"
    for prf_hz, percent, mbit_s in ((100.0, 0.15625, 44.8), (20.0, 0.03125, 8.96)):
        duty = closed.duty_cycle(wave.symbol_s, wave.cyclic_prefix_s, prf_hz)
        rate = closed.data_rate_bit_s(wave.sample_rate_hz, BITS, duty)
        where = f"at {prf_hz:.0f} Hz"
        rows.append(compare(f"duty cycle {where}", percent, 100 * duty, "%", within=1e-6, digits=5, note=recorded))
        counted = "I and Q both counted"
        rows.append(compare(f"mean data rate {where}", mbit_s, rate / 1e6, "Mbit/s", within=1e-6, note=counted))
    period_us = 1e6 / wave.subcarrier_spacing_hz
    rows.append(
        Claim(
            "OFDM symbol T against 1/Δf",
            f"{1e6 * wave.symbol_s:g}",
            f"{period_us:g}",
            "µs",
            f"the paper contradicts itself: T is {1e6 * wave.symbol_s / period_us:g} periods of 1/Δf; the symbol is "
            f"periodic, so a DFT of f_s/Δf = {wave.dft_samples} samples (not N = {len(wave.codes)}) still separates "
            f"the subcarriers exactly; prefix and symbol together are {wave.capture_samples} samples",
        )
    )
    chirp_hz = closed.effective_chirp_bandwidth_hz(band_hz, wave.symbol_s, wave.cyclic_prefix_s)
    rows.append(
        Claim(
            "effective chirp bandwidth B(T − Δt_max)/T, Δt_max = T_cp",
            "",
            f"{chirp_hz / 1e6:g}",
            "MHz",
            f"computed: {100 * chirp_hz / band_hz:g} % of B; the paper's formula, which names no delay",
        )
    )
    return rows


def _clocks() -> list[Claim]:
    wave = paper_waveform()
    band_hz = closed.bandwidth_hz(len(wave.codes), wave.subcarrier_spacing_hz)
    sfo_hz = closed.sfo_limit_hz(wave.sample_rate_hz, band_hz, wave.symbol_s)
    cfo_hz = closed.cfo_limit_hz(wave.subcarrier_spacing_hz)
    first = "binds first where one clock feeds both"
    ten_ppb = 1e-8
    swapped = (
        "the paper contradicts itself: one clock off by 10 ppb has a CFO of 12 Hz at the carrier of 1.2 GHz and an SFO "
        "of 41 Hz at the converter's 4.096 GS/s; the two values are swapped in print"
    )
    return [
        compare("SFO limit f_s(1 − 1/(1 + 1/BT))", 199.96, sfo_hz / 1e3, "kHz", within=1e-4, digits=5),
        compare("SFO limit", 195, closed.ppm(sfo_hz, wave.sample_rate_hz), "ppm", within=0.005),
        compare("CFO limit Δf/10", 10, cfo_hz / 1e3, "kHz", within=1e-6),
        compare("CFO limit", 8.3, closed.ppm(cfo_hz, wave.carrier_hz), "ppm", within=0.005, digits=3, note=first),
        compare("CFO of a clock off by 10 ppb", 12, ten_ppb * wave.carrier_hz, "Hz", within=0.01, note=swapped),
        compare("SFO of a clock off by 10 ppb", 41, ten_ppb * ADC_RATE_HZ, "Hz", within=0.01, note=swapped),
    ]


def _timing() -> list[Claim]:
    wave = paper_waveform()
    ps, ms = 1e12 * closed.timing_requirement_s(0.02), 1e3 * closed.time_tag_requirement_s(0.02, 10.0)
    interval = 1e3 * closed.association_requirement_s(wave.prf_hz)
    return [
        compare("timing of the samples 2δR/c, δR = 2 cm", 133, ps, "ps", within=0.005),
        compare("association of pulses 1/f_prf at 100 Hz", 10, interval, "ms", within=1e-6),
        compare("time tags 2δR/v at 10 m/s", 4, ms, "ms", within=1e-6),
    ]
