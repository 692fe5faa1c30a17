"""Coherence factors of a static recording: uncorrected, and corrected at the SNR that gives what is claimed."""

from dataclasses import replace

import numpy as np

from apertura.echo.sidelink import divide
from apertura.simulation.impairments import Impairments, Timing, UniformPhase
from apertura.simulation.recording import Geometry
from apertura.simulation.scene import Scatterers
from apertura.study.bench import Bench, Case, paper_bench, receive_pair
from apertura.study.focus import coherence_factors, divided_history, history
from apertura.study.paper.claims import Claim, compare
from apertura.study.paper.formulas import snr_of_coherence_factor

PULSES = 200
CORRECTED = (0.986, 0.9999, 0.9995)
DRAWS = 200


def coherence_claims(*, draws: int = DRAWS, seed: int = 1) -> list[Claim]:
    """Return uncorrected and corrected coherence factors of M = 200 static pulses with free-running clocks.

    Parameters
    ----------
    draws
        Over which the factors are averaged.
    seed
        Of everything random.
    """
    wild = Impairments(carrier_phase=UniformPhase(), timing=Timing(half_width_s=20e-9))
    bare = [_factors(wild, np.random.default_rng([seed, draw]))[0] for draw in range(draws)]
    note = f"mean of {draws} draws, spread {np.std(bare):.4f}; claimed is 1/M with M = {PULSES}"
    rows = [
        compare(
            "coherence factor, uncorrected (about 1/M)",
            1 / PULSES,
            float(np.mean(bare)),
            "1",
            within=3 / np.sqrt(draws),
            digits=2,
            note=note,
        )
    ]
    for claimed in CORRECTED:
        snr_db = 10 * float(np.log10(snr_of_coherence_factor(claimed, PULSES)))
        # of a whole pulse after compression: N subcarriers add up
        noisy = replace(wild, radar_snr_db=snr_db - 10 * float(np.log10(_static().waveform.codes.size)))
        few = max(1, draws // 4)
        found = [_factors(noisy, np.random.default_rng([seed, 1, draw]))[1] for draw in range(few)]
        note = f"at {snr_db:.1f} dB SNR of a compressed pulse, where closed form gives it; spread {np.std(found):.1g}"
        within = 0.1 * (1 - claimed)
        rows.append(
            compare(
                "coherence factor, corrected",
                claimed,
                float(np.mean(found)),
                "1",
                within=within,
                digits=5,
                note=note,
                relative=False,
            )
        )
    return rows


def _static() -> Bench:
    """Return a recording that does not move: one reflector 15 m away, receiver 4.7 m beside the transmitter."""
    bench = paper_bench(pulses=PULSES, subcarriers=128)
    sender = np.tile([0.0, 0.0, 4.8], (PULSES, 1))
    receiver = sender + [4.7, 0.0, 0.0]
    target = Scatterers(np.array([[2.35, 14.0, 0.0]]), np.ones(1, np.complex128))
    return replace(bench, scatterers=target, geometry=Geometry(sender, receiver, sender, receiver))


def _factors(impairments: Impairments, generator: np.random.Generator) -> tuple[float, float]:
    """Return the coherence factor at the reflector without and with division by the sidelink."""
    bench = _static()
    radar, sidelink, _ = receive_pair(bench, Case(impairments, Impairments()), generator)
    both = history(bench, radar), divided_history(bench, divide(radar, sidelink))
    before, after = (float(coherence_factors(one, bench.scatterers.position_m)[0]) for one in both)
    return before, after
