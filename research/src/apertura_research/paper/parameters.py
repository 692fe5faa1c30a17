"""The paper's equations and derived parameters."""

import numpy as np

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.simulation.presets import paper_waveform
from apertura_research.paper.claims import PAPER, UNTESTABLE, Claim, compare, require

HALF_POWER_OF_SINC = 0.886
"""−3 dB width of |sinc(x)|²."""

HALF_POWER_OF_HANN = 1.441
"""−3 dB width of the response of a Hann window, in the same unit 1/B.

Source: F. J. Harris, "On the use of windows for harmonic analysis with the DFT", Proc. IEEE 66 (1978), table I.
"""


def sfo_limit_hz(sample_rate_hz: float, bandwidth_hz: float, symbol_s: float) -> float:
    """Return the SFO limit f_s(1 − 1/(1 + 1/(BT))), where the last subcarrier drifts by one cycle over the symbol.

    Examples
    --------
    >>> round(sfo_limit_hz(1.024e9, 409.6e6, 12.5e-6))
    199961
    """
    return sample_rate_hz * (1 - 1 / (1 + 1 / (bandwidth_hz * symbol_s)))


def cfo_limit_hz(subcarrier_spacing_hz: float) -> float:
    """Return the CFO limit Δf/10, with a loss of 20·lg sinc(0.1) = −0.14 dB.

    Examples
    --------
    >>> cfo_limit_hz(100e3)
    10000.0
    """
    return subcarrier_spacing_hz / 10


def ground_range_resolution_m(
    bandwidth_hz: float, ground_range_m: float, height_m: float, *, half_power: float = HALF_POWER_OF_SINC
) -> float:
    """Return the −3 dB width in ground range abreast of the track, half_power·c/2B·R/r_g.

    Examples
    --------
    >>> [round(100 * ground_range_resolution_m(409.6e6, r, 10.0), 1) for r in (5.0, 25.0)]
    [72.5, 34.9]
    """
    slant_m = np.hypot(ground_range_m, height_m)
    return float(half_power * SPEED_OF_LIGHT_M_S / (2 * bandwidth_hz) * slant_m / ground_range_m)


def cross_range_resolution_m(frequency_hz: float, slant_range_m: float, aperture_m: float) -> float:
    """Return the −3 dB width along the track of a short aperture, 0.886·λR/2L.

    Examples
    --------
    >>> round(100 * cross_range_resolution_m(1.40475e9, 12.51, 3.4), 1)
    34.8
    """
    wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz
    return HALF_POWER_OF_SINC * wavelength_m * slant_range_m / (2 * aperture_m)


def coherence_of_snr(snr: float, pulses: int) -> float:
    """Return the coherence factor Γ = (SNR + 1/M)/(SNR + 1) of M equal echoes at a power SNR per compressed pulse.

    Examples
    --------
    >>> round(coherence_of_snr(1e3, 200), 4)
    0.999
    """
    return (snr + 1 / pulses) / (snr + 1)


def snr_of_coherence_factor(coherence: float, pulses: int) -> float:
    """Return the power SNR per compressed pulse at which M equal echoes have a given coherence factor.

    Notes
    -----
    Source: docs/theory/study.md, "Coherence factor": Γ = E|Σs|²/(M·E Σ|s|²) = (SNR + 1/M)/(SNR + 1).

    Examples
    --------
    >>> [round(10 * float(np.log10(snr_of_coherence_factor(g, 200))), 1) for g in (0.986, 0.9995, 0.9999)]
    [18.5, 33.0, 40.0]
    """
    return (coherence - 1 / pulses) / (1 - coherence)


BITS = 14
ADC_RATE_HZ = 4.096e9
"""Sampling rate of the converter before decimation by 4."""

CLOCK_ERROR = 1e-8


def parameter_claims() -> list[Claim]:
    """Return the claims on bandwidth, duty cycle, data rate, clock limits, timing, sampling and chirp bandwidth.

    Examples
    --------
    >>> [claim.claim for claim in parameter_claims() if claim.verdict != "agrees"]
    ['OFDM symbol T against 1/Δf', 'effective chirp ...', 'CFO of a clock ...', 'SFO of a clock ...']
    """
    return [*_waveform(), *_clocks(), *_timing(), *_storage()]


def _waveform() -> list[Claim]:
    wave = paper_waveform()
    band_mhz = len(wave.codes) * wave.subcarrier_spacing_hz / 1e6
    rows = [compare("bandwidth N·Δf", band_mhz, "MHz", paper="409.6")]
    for prf_hz, percent, mbit_s in ((100.0, "0.156", "44.8"), (20.0, "0.031", "9.0")):
        duty, at = (wave.symbol_s + wave.cyclic_prefix_s) * prf_hz, f"at {prf_hz:.0f} Hz"
        note = "γ = (T + T_cp)·f_prf, not T alone"
        rows.append(compare(f"duty cycle {at}", 100 * duty, "%", paper=percent, style=".5g", note=note))
        note = "2·f_s·ν·γ, with I and Q"
        rows.append(
            compare(
                f"mean data rate {at}", 2 * wave.sample_rate_hz * BITS / 1e6 * duty, "Mbit/s", paper=mbit_s, note=note
            )
        )
    period_us, symbol_us = 1e6 / wave.subcarrier_spacing_hz, 1e6 * wave.symbol_s
    contradiction = (
        f"the paper prints T and Δf, but not that T contains {symbol_us / period_us:g} periods of 1/Δf; the symbol is "
        f"periodic, so that a DFT of f_s/Δf = {wave.dft_samples} samples (not N = {len(wave.codes)}) still separates "
        f"the subcarriers exactly; prefix and symbol together have {wave.capture_samples} samples"
    )
    rows.append(compare("OFDM symbol T against 1/Δf", period_us, "µs", paper="12.5", reason=contradiction))
    kept = (wave.symbol_s - wave.cyclic_prefix_s) / wave.symbol_s
    share = f"{100 * kept:g} % of B; the paper prints the formula without a delay"
    name = "effective chirp bandwidth B(T − Δt_max)/T, Δt_max = T_cp"
    rows.append(Claim(name, "", "", f"{band_mhz * kept:g}", "MHz", PAPER, UNTESTABLE, share))
    top_ghz, half_ghz = float(wave.frequency_hz[-1]) / 1e9, ADC_RATE_HZ / 2e9
    return [
        *rows,
        require("upper edge of the band, sampled at 4.096 GS/s", top_ghz, "GHz",
                limit=f"below half the converter's rate, {half_ghz:g} GHz", met=top_ghz < half_ghz,
                words="direct sampling of the RF signal is alias-free", note="carrier and band in the first zone"),
    ]  # fmt: skip


def _clocks() -> list[Claim]:
    wave = paper_waveform()
    band_hz = len(wave.codes) * wave.subcarrier_spacing_hz
    sfo_hz, cfo_hz = sfo_limit_hz(wave.sample_rate_hz, band_hz, wave.symbol_s), cfo_limit_hz(wave.subcarrier_spacing_hz)
    sfo_ppm, cfo_ppm = 1e6 * sfo_hz / wave.sample_rate_hz, 1e6 * cfo_hz / wave.carrier_hz
    at_carrier_hz, at_converter_hz = CLOCK_ERROR * wave.carrier_hz, CLOCK_ERROR * ADC_RATE_HZ
    opposite = f"two opposite clock errors differ by {sfo_ppm:.0f} ppm of f_s = 1.024 GS/s, the 200 kHz"
    first = f"{cfo_ppm:.1f} ppm of the carrier: reached before the SFO limit if one clock feeds carrier and converter"
    swapped = (
        "the paper contradicts itself: it prints 41 Hz for the CFO at the carrier of 1.2 GHz and 12 Hz for the SFO at "
        "the converter's 4.096 GS/s; the computed values are the other way round"
    )
    return [
        compare("SFO limit f_s(1 − 1/(1 + 1/BT))", sfo_hz / 1e3, "kHz", paper="200", style=".5g"),
        compare("clock error of each node at the SFO limit, ±", sfo_ppm / 2, "ppm", paper="100",
                reason=f"the paper assumes two clocks with opposite errors, and rounds: {opposite}"),
        compare("CFO limit Δf/10", cfo_hz / 1e3, "kHz", paper="10", note=first),
        compare("CFO of a clock error of 10 ppb", at_carrier_hz, "Hz", paper="41", reason=swapped),
        compare("SFO of a clock error of 10 ppb", at_converter_hz, "Hz", paper="12", reason=swapped),
    ]  # fmt: skip


def _timing() -> list[Claim]:
    range_error_m, speed_m_s, prf_hz = 0.02, 10.0, 100.0
    samples_ps, tags_ms = 2e12 * range_error_m / SPEED_OF_LIGHT_M_S, 2e3 * range_error_m / speed_m_s
    return [
        compare("timing of the samples 2δR/c, δR = 2 cm", samples_ps, "ps", paper="133"),
        compare("association of pulses 1/f_prf at 100 Hz", 1e3 / prf_hz, "ms", paper="10"),
        compare("time tags 2δR/v at 10 m/s", tags_ms, "ms", paper="4"),
    ]


STORAGE_MBIT_S = 240.0
"""Sustained rate of a memory card of video speed class V30, 30 MB/s (SD Physical Layer Specification)."""


def _storage() -> list[Claim]:
    """Return the storage rate of a node for files of int16 pairs, and for the paper's count of 14 bits."""
    wave = paper_waveform()
    stored = 2 * 16 * wave.capture_samples * float(wave.prf_hz) / 1e6
    counted = 2 * BITS * (wave.symbol_s + wave.cyclic_prefix_s) * wave.sample_rate_hz * float(wave.prf_hz) / 1e6
    continuous = 2 * 16 * wave.sample_rate_hz / 1e6
    wider = "recordings store 14 bits in 16, and a secondary node stores two channels"
    return [
        require("data rate of a secondary node at 100 Hz against storage", 2 * stored, "Mbit/s",
                limit=f"below {STORAGE_MBIT_S:g} Mbit/s, a V30 card, and without trigger above", style=".1f",
                met=2 * stored < STORAGE_MBIT_S < 2 * continuous,
                note=f"{wider}; without trigger {2 * continuous / 1e3:.1f} Gbit/s"),
        compare("stored data rate of a channel at 20 Hz", stored / 5, "Mbit/s",
                independent_model=counted / 5 * 16 / BITS,
                note=f"{wider}: {2 * stored / 5:.1f} Mbit/s, {2 * stored / 5 * 3600 / 8e3:.1f} GB an hour"),
    ]  # fmt: skip
